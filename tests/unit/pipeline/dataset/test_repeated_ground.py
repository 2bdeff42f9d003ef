"""The repeatability in the card of a dataset, from a store with an analytic map."""

import json

import numpy as np
import pytest
from made_tracks import with_columns
from synthetic_store import add_run, box, lanes, open_world, region_file, segments

from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe

CLOSED = box(-19, -19, -5, 19)
NOISE_WATT = 7.0


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Eight lanes that are driven twice, the second time a little off and with other noise, and one that is driven back."""
    directory = tmp_path_factory.mktemp("repeated")
    store = open_world(directory)
    rng = np.random.default_rng(0)
    start, end = lanes(-15.0 + 4.0 * np.arange(8), -4.0, 16.0)
    for run_id, offset in (("once", 0.0), ("again", 0.1)):
        table = segments(run_id, start + offset, end + offset, start_ns=int(1e18 + offset * 1e15))
        power = 150.0 + rng.normal(0.0, NOISE_WATT, len(start))
        add_run(store, run_id, with_columns(table, power_watt=power))
    add_run(store, "back", segments("back", end[:20] + 0.05, start[:20] + 0.05, start_ns=int(2e18)))
    region = region_file(directory / "region.geojson", box(-20, -20, 20, 20), CLOSED, splits=(None, "exclude"))
    build_dataset(directory / "out", store=store.root, recipe=Recipe(), split=region)
    return directory / "out"


def test_what_was_driven_twice_gives_the_noise_that_was_put_in(built):
    found = json.loads((built / "dataset.json").read_text())["repeatability"]["power_watt"]
    assert found["pairs"] > 100
    assert found["std_low"] < NOISE_WATT < found["std_high"]
    assert found["std"] == pytest.approx(NOISE_WATT, rel=0.15)
