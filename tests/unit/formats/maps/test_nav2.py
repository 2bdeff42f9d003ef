"""Nav2 maps: every reader finds the costs that were written."""

import numpy as np
import pytest
from ruamel.yaml import YAML

from tcpipe.formats.maps.nav2 import HIGHEST, LETHAL, write_nav2_map
from tcpipe.terrain.target_grid import MapGrid


def _nav2(share):
    """As Nav2's map_io scales between the thresholds."""
    return np.rint(100.0 * share)


def _nav2_since_2025(share):
    """As it does in whole arrays: half is rounded up, and the thresholds themselves are free and lethal."""
    return np.where(share >= 1.0, LETHAL, np.where(share <= 0.0, 0, np.floor(100.0 * share + 0.5)))


def _ros1(share):
    """As ROS 1's image_loader does, and those made after it: 1 to 99."""
    return np.rint(1.0 + 98.0 * share)


@pytest.mark.parametrize(("reader", "tolerance"), [(_nav2, 0), (_nav2_since_2025, 0), (_ros1, 1)])
def test_costs_are_read_as_written_and_only_lethal_is_lethal(tmp_path, reader, tolerance):
    cost = np.append(np.arange(HIGHEST + 1), [LETHAL, LETHAL, LETHAL]).astype(np.uint8).reshape(2, 51)
    grid = MapGrid("ENU", 100.0, 1_000.0, 2.0, 2, 51)
    write_nav2_map(tmp_path / "map.yaml", cost, grid, frame="true east and north", meaning="a cost")
    about = YAML(typ="safe").load((tmp_path / "map.yaml").read_text())
    needed = {"image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"}  # loadMapYaml throws without
    assert needed <= about.keys()
    assert (about["mode"], about["negate"], about["resolution"]) == ("scale", 0, 2.0)
    assert about["origin"] == [100.0, 1_000.0 - 4.0, 0.0]
    head, pixels = (tmp_path / about["image"]).read_bytes().split(b"\n255\n", 1)
    assert head == b"P5\n51 2"
    occupied = 1.0 - np.frombuffer(pixels, np.uint8).reshape(2, 51) / 255.0
    low, high = about["free_thresh"], about["occupied_thresh"]
    share = (occupied - low) / (high - low)
    read = np.where(occupied > high, LETHAL, np.where(occupied < low, 0, reader(share)))
    np.testing.assert_array_equal(read == LETHAL, cost == LETHAL)
    assert np.abs(read - cost.astype(int)).max() <= tolerance
