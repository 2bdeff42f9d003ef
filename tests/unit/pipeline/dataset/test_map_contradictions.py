"""A map whose slopes or heights differ from the track is flagged sample by sample, a sound one is not."""

from dataclasses import replace

import numpy as np
import pytest
from made_tracks import with_columns
from map_worlds import write_tif
from rasterio import Affine
from synthetic_store import WORLD, add_run, make_fuse_facts, put_map, segments

from tcpipe import open_dataset
from tcpipe.formats.dataset_files import read_card
from tcpipe.formats.finding_lines import describe_finding
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.explain import explain
from tcpipe.report.label_sections import make_quality_section
from tcpipe.store import open_store
from tcpipe.tables.bits import Quality
from tcpipe.tables.facts import StageFacts
from tcpipe.tables.findings import judge, select_findings
from tcpipe.terrain.layers import HEIGHT_STEP_M

PIXEL_M = 0.1
SLOPE_RAD, HEIGHT_M = np.radians(3.0), 0.1
"""A sample is wrong beyond one of these."""


def height_at(xy_m):
    return WORLD.height(WORLD.x_m + xy_m[..., 0], WORLD.y_m + xy_m[..., 1])


def measured(table, start, end, rng, *, backwards=False):
    """Return segments with heights, pitch and roll as a robot measures them on the true ground; the IMU is mounted askew."""
    along = end - start
    left, middle = np.stack([-along[:, 1], along[:, 0]], axis=1), (start + end) / 2.0
    rise, cross = (height_at(middle + 0.4 * axis) - height_at(middle - 0.4 * axis) for axis in (along, left))
    sign, count = -1.0 if backwards else 1.0, len(start)
    tilt, roll = (sign * np.arctan(part / 0.8) + rng.normal(0.0, 0.004, count) for part in (rise, cross))
    return with_columns(
        table,
        start_z_m=height_at(start) - 600.0 + rng.normal(0.0, 0.004, count),
        end_z_m=height_at(end) - 600.0 + rng.normal(0.0, 0.004, count),
        pitch_rad=-tilt + 0.02,
        roll_rad=roll + 0.03,
        fused_velocity_mps=np.full(count, 0.9 * sign),
    )


def lay_out(*, north):
    """Return start and end of segments [m] on parallel lines through the middle of the site."""
    steps = np.stack(np.meshgrid(np.arange(-12.0, 12.0), np.arange(-12.0, 12.1, 3.0)), axis=-1).reshape(-1, 2)
    start = steps[:, ::-1] if north else steps
    return start, start + ((0.0, 1.0) if north else (1.0, 0.0))


def make_store(directory):
    """Make a store of three runs on the true ground: two with an IMU, one of them driven backwards, and one with neither."""
    store, rng = open_store(directory / "store", create=True), np.random.default_rng(1)
    fuse = make_fuse_facts().fuse
    for number, (name, backwards, sensors) in enumerate((("a", False, ("gnss", "imu")), ("b", True, ("gnss", "imu")))):
        start, end = lay_out(north=backwards)
        table = measured(segments(name, start, end, start_ns=number * 10**13), start, end, rng, backwards=backwards)
        add_run(store, name, table, facts=StageFacts(fuse=replace(fuse, sensors=sensors)))
    start, end = np.add(lay_out(north=False), (0.0, 1.5))
    add_run(store, "blind", segments("blind", start, end, start_ns=10**14), facts=StageFacts(fuse=fuse))
    return store


def write_height(path, change=None):
    """Write the site's heights; ``change(x, y, height)`` gives them a fault, at x and y from its middle [m]."""
    x, y = WORLD.centres(PIXEL_M)
    height = WORLD.height(x, y)
    height = height if change is None else change(x - WORLD.x_m, y - WORLD.y_m, height)
    corner = Affine(PIXEL_M, 0.0, WORLD.x_m - WORLD.side_m / 2.0, 0.0, -PIXEL_M, WORLD.y_m + WORLD.side_m / 2.0)
    return write_tif(path, height.astype(np.float32)[None], WORLD.crs, corner, nodata=np.nan)


def build(directory, store, change=None, name="site"):
    put_map(store, name, height=write_height(directory / f"{name}.tif", change))
    return build_dataset(directory / name, store=store.root, map=name)


def read_samples(directory):
    """Return by id the slopes [rad], the rise along the chord [m] and the quality bits of samples."""
    found = {}
    for split in open_dataset(directory).values():
        if not len(split):
            continue
        height = split.layers(np.arange(len(split)))["height"].astype(float) * HEIGHT_STEP_M
        rise = height[:, 19:21, -1].mean(axis=1) - height[:, 19:21, 0].mean(axis=1)
        slopes = np.stack([split.column("slope_rad"), split.column("cross_slope_rad")], axis=1)
        rows = zip(split.column("sample_id"), slopes, rise, split.column("quality"), strict=True)
        found |= {name: values for name, *values in rows}
    return found


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The store, and what a sound map gives."""
    directory = tmp_path_factory.mktemp("site")
    store = make_store(directory)
    result = build(directory, store, name="good")
    return directory, store, result, read_samples(directory / "good")


def is_flagged(quality):
    return bool(int(quality) & Quality.MAP_CONTRADICTS_TRACK)


def test_a_sound_map_is_not_flagged(site):
    _, _, result, good = site
    assert len(good) == 3 * 24 * 9
    assert not any(is_flagged(quality) for *_, quality in good.values())
    assert not select_findings(result.findings, "map-contradicts-track")


def raise_beyond(step_m, across=(1.0, 0.35)):
    return lambda x, y, z: z + step_m * (x * across[0] + y * across[1] > 0.4)


def dig(depth_m, radius_m=0.35):
    def change(x, y, z):
        holes = np.hypot((x + 0.8) % 5.0 - 2.5, (y + 0.3) % 3.0 - 1.5) < radius_m
        return np.where(holes, z - depth_m, z)

    return change


FAULTS = {
    **{f"step of {step} m": raise_beyond(step) for step in (0.1, 1.0)},
    "step along the lanes": raise_beyond(0.35, (0.0, 1.0)),
    "holes of 0": lambda x, y, z: np.where(dig(1.0)(x, y, z) == z, z, 0.0),
    "pits": dig(0.5),
    "collar of 0": lambda x, y, z: np.where(x + 0.5 * y > 9.0, 0.0, z),
    "tilted tile": lambda x, y, z: z + np.tan(np.radians(6.0)) * np.maximum(x + y - 2.0, 0.0),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_wrong_sample_is_flagged_and_hardly_a_right_one(site, tmp_path, fault):
    _, store, _, good = site
    result = build(tmp_path, store, FAULTS[fault], name=f"fault{list(FAULTS).index(fault)}")
    found = read_samples(tmp_path / result.path)
    wrong, flagged = set(), {name for name, (*_, quality) in found.items() if is_flagged(quality)}
    for name, (slopes, rise, _) in found.items():
        error_rad, error_m = np.abs(slopes - good[name][0]).max(), abs(rise - good[name][1])
        # the margin is the accuracy of the track
        if error_rad > 1.3 * SLOPE_RAD or error_m > 1.3 * HEIGHT_M:
            wrong.add(name)
        elif error_rad < 0.5 * SLOPE_RAD and error_m < 0.3 * HEIGHT_M and not fault.startswith(("pits", "holes")):
            assert name not in flagged
    has_witness = {name for name in wrong if not name.startswith("blind")}
    assert len(has_witness) > 4
    assert has_witness <= flagged
    assert not any(name.startswith("blind") for name in flagged)
    assert select_findings(result.findings, "map-contradicts-track")


def test_a_cluster_is_one_finding_with_place_and_size_and_the_bit_goes_the_way_of_the_others(site, tmp_path):
    _, store, _, _ = site
    pit = build(tmp_path, store, lambda x, y, z: np.where(np.hypot(x - 4.2, y - 6.1) < 1.1, z - 2.0, z), name="pit")
    (finding,) = select_findings(pit.findings, "map-contradicts-track")
    assert 2 <= finding.numbers["sample_count"] <= 12
    assert 1.4 < finding.numbers["extent_m"] < 7.0
    assert finding.numbers["slope_rad"] > 0.3
    assert len(describe_finding(finding)) < 220
    card = read_card(tmp_path / "pit")
    assert card.flagged_samples.by_bit["map_contradicts_track"] == finding.numbers["sample_count"]
    assert judge(card.findings).position == "usable with care"
    splits = open_dataset(tmp_path / "pit").values()
    left = sum(len(split.clean(["map_contradicts_track"])) for split in splits)
    assert left == card.samples - finding.numbers["sample_count"]
    bits = np.array([quality for *_, quality in read_samples(tmp_path / "pit").values()])
    assert ("map contradicts track", finding.numbers["sample_count"]) in make_quality_section(bits, "samples").rows
    flagged = next(name for name, (*_, quality) in read_samples(tmp_path / "pit").items() if is_flagged(quality))
    explained = explain(flagged, dataset=tmp_path / "pit", store=store.root)
    assert "map_contradicts_track" in str(explained)
