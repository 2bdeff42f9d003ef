"""A map that is off the tracks is said to be, run by run, when a dataset is built."""

import numpy as np
import pytest
import rasterio
from made_tracks import with_columns
from raster_commands import run_rio
from synthetic_store import (
    GEOID_M,
    WORLD,
    add_run,
    add_world,
    lanes,
    open_world,
    put_map,
    segments,
    track_at,
    winding,
)

from tcpipe import open_dataset
from tcpipe.errors import MapError
from tcpipe.formats.dataset_files import read_card
from tcpipe.formats.finding_lines import describe_finding
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe, SampleConfig
from tcpipe.store import open_store
from tcpipe.tables.findings import Subject, select_findings


def build_with(directory, track, recipe=None):
    """Build a dataset of one run with this track."""
    store = open_world(directory)
    add_run(store, "a", segments("a", *lanes([0.0], -10.0, 10.0)), track=track)
    return build_dataset(directory / "out", store=store.root, recipe=recipe or Recipe())


ALIGN = Recipe(sample=SampleConfig(align=True))
SHIFT_M = (-1.5, 0.8)


@pytest.fixture(scope="module")
def moved(tmp_path_factory):
    """Two runs whose map lies elsewhere, and where their ground is by the map; one of them is too uncertain to be moved."""
    directory = tmp_path_factory.mktemp("moved")
    store = open_world(directory)
    xy, (start, end) = winding(), lanes([-6.0, 2.0], -10.0, 10.0)
    add_run(store, "off", segments("off", start, end), track=track_at(xy, np.add(xy, SHIFT_M)))
    short = track_at(xy[:300], np.add(xy[:300], SHIFT_M))
    add_run(store, "short", segments("short", *lanes([6.0], -10.0, 10.0), start_ns=10**13), track=short)
    result = build_dataset(directory / "out", store=store.root, recipe=ALIGN)
    there = open_store(directory / "there", create=True)
    add_world(there)
    add_run(there, "off", segments("off", np.add(start, SHIFT_M), np.add(end, SHIFT_M)))
    build_dataset(directory / "truth", store=there.root, recipe=Recipe())
    return directory, result


def read_run(directory, run_id):
    """Return a run's samples by id: its row, and its patch (channels, px, px)."""
    found = {}
    for split in open_dataset(directory).values():
        for row, patch in zip(split.samples.to_pylist(), split.patches, strict=True):
            found |= {row["sample_id"]: (row, patch)} if row["run_id"] == run_id else {}
    return found


def test_an_aligned_run_gets_the_patches_of_its_ground(moved):
    directory, result = moved
    aligned, truth = (read_run(directory / name, "off") for name in ("out", "truth"))
    assert aligned.keys() == truth.keys()
    assert len(aligned) == 40
    off = [np.abs(patch - truth[name][1]).mean() for name, (_, patch) in aligned.items()]
    assert max(off) < 0.02
    (entry,) = (of for of in result.card.maps[0].registration if of.run_id == "off")
    assert entry.shift_xy_m == pytest.approx(SHIFT_M, abs=0.1)
    assert np.abs(np.subtract(entry.shift_xy_m, SHIFT_M)).max() < 2.0 * entry.applied_std_m
    for name, (row, _) in aligned.items():
        there = truth[name][0]
        assert row["position_std_m"] == np.hypot(there["position_std_m"], entry.applied_std_m)
        assert row["start_lon_deg"] != there["start_lon_deg"]  # the track stays where it was measured
        assert row["terrain_name"] == there["terrain_name"]


def test_the_shift_is_said_and_a_run_without_one_is_not_moved(moved):
    directory, result = moved
    (said,) = select_findings(result.findings, "map-aligned")
    assert (said.subject, said.severity, said.action) == (Subject("run", "off"), "note", "corrected")
    assert said.numbers["shift_m"] == pytest.approx(1.7, abs=0.1)
    assert not select_findings(result.findings, "map-shifted")
    (refused,) = select_findings(result.findings, "map-not-aligned")
    assert refused.subject == Subject("run", "short")
    assert result.card.verdict.position == "usable with care"
    assert {row["position_std_m"] for row, _ in read_run(directory / "out", "short").values()} == {0.02}
    assert refused.names["reason"] == "too few points on the map"
    assert [of.run_id for of in result.card.maps[0].registration] == ["off"]
    assert describe_finding(said).startswith("off: moved by 1.7")


@pytest.mark.parametrize(
    ("shift_m", "rows", "limit_m", "reason"),
    [
        ((-1.5, 0.8), 1200, 0.08, "the shift is known only to 0.09"),
        ((-1.5, 0.8), 1200, 0.093, "the shift is known only to 0.09"),  # with the track's own deviation it is too much
        ((3.9, 0.0), 3000, 0.1, "the shift may be beyond 4 m"),
    ],
)
def test_a_shift_that_is_not_known_well_enough_is_not_applied(tmp_path, shift_m, rows, limit_m, reason):
    recipe = Recipe(sample=SampleConfig(align=True, max_position_std_m=limit_m))
    xy = winding()[:rows]
    found = build_with(tmp_path, track_at(xy, np.add(xy, shift_m), std_m=0.03), recipe)
    (refused,) = select_findings(found.findings, "map-not-aligned")
    assert refused.names["reason"].startswith(reason)
    assert not select_findings(found.findings, "map-aligned")
    assert found.card.maps[0].registration[0].applied_std_m is None


HEIGHTS = ("map-heights-differ", "map-height-scale")


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    directory = tmp_path_factory.mktemp("registered")
    store = open_world(directory)
    xy = winding()
    for number, (run_id, shift_m, std_m) in enumerate(
        [("fits", (0.0, 0.0), 0.02), ("off", (-1.5, 0.8), 0.02), ("vague", (-1.5, 0.8), 0.5)]
    ):
        start, end = lanes([4.0 * number - 6.0], -10.0, 10.0)
        track = track_at(xy, np.add(xy, shift_m), std_m=std_m)
        add_run(store, run_id, segments(run_id, start, end, start_ns=number * 10**12), track=track)
    result = build_dataset(directory / "out", store=store.root, recipe=Recipe())
    return result, read_card(directory / "out")


def test_a_run_whose_ground_lies_elsewhere_on_the_map_is_a_warning(built):
    result, _ = built
    (shifted,) = select_findings(result.findings, "map-shifted")
    assert (shifted.subject, shifted.names, shifted.severity) == (Subject("run", "off"), {"map": "site"}, "error")
    sizes = [shifted.numbers[name] for name in ("shift_m", "east_m", "north_m")]
    assert sizes == pytest.approx([1.7, -1.5, 0.8], abs=0.05)
    assert shifted.numbers["std_m"] < 0.1
    assert result.card.verdict.position == "not usable"
    assert "error: off: the terrain is shifted by 1.7" in str(result)


def test_the_card_keeps_every_runs_registration(built):
    result, card = built
    found = {entry.run_id: entry for entry in card.maps[0].registration}
    assert sorted(found) == ["fits", "off"]  # the third is never sure enough of its place
    assert found["fits"].shift_xy_m == pytest.approx([0.0, 0.0], abs=0.03)
    assert not found["fits"].significant
    assert found["off"].shift_xy_m == pytest.approx([-1.5, 0.8], abs=0.03)
    assert found["off"].height_offset_m == pytest.approx(GEOID_M, abs=0.02)
    assert found["off"].misfit_m > 3.0 * found["off"].shifted_misfit_m
    assert found["fits"].height_scale == pytest.approx(1.0, abs=0.01)
    assert found["fits"].expected_misfit_m == pytest.approx(0.1)  # the tracks claim no error of height
    assert not [of for of in select_findings(result.findings, *HEIGHTS) if of.subject.name == "fits"]


@pytest.mark.parametrize(
    ("per_metre", "text"),
    [
        (1.0 / 0.3048, r"in feet.*rio edit-info height.tif --bidx 1 --units ft"),
        (2.0, r"scaled.*rio calc .* height.tif scaled.tif"),
    ],
)
def test_heights_that_are_no_metres_stop_the_build_until_the_command_is_typed(tmp_path, per_metre, text):
    """Heights of the site above 612 m, so that the numbers are those of dry land in any unit."""
    paths = WORLD.write(tmp_path)
    with rasterio.open(paths["height"], "r+") as dataset:
        dataset.write(np.float32(per_metre) * (dataset.read() - np.float32(570.0)))
    store = open_store(tmp_path / "store", create=True)
    put_map(store, "site", height=paths["height"])
    add_run(store, "a", segments("a", *lanes([0.0], -10.0, 10.0)), track=track_at(winding(), winding()))
    with pytest.raises(MapError, match=text) as caught:
        build_dataset(tmp_path / "out", store=store.root, recipe=Recipe())
    assert not (tmp_path / "out").exists()
    run_rio(caught.value.problems[0], tmp_path)
    scaled = tmp_path / "scaled.tif"
    put_map(store, "site", height=scaled if scaled.exists() else paths["height"])
    found = build_dataset(tmp_path / "out", store=store.root, recipe=Recipe())
    assert not select_findings(found.findings, *HEIGHTS)
    assert found.card.maps[0].registration[0].height_scale == pytest.approx(1.0, abs=0.02)


def test_a_scale_below_the_limit_is_named(tmp_path):
    found = build_with(tmp_path, track_at(winding(), winding(), scale=1.18))
    (scaled,) = select_findings(found.findings, *HEIGHTS)
    assert (scaled.code, scaled.numbers["map_rise_m"]) == ("map-height-scale", pytest.approx(0.85, abs=0.005))


def test_ground_that_is_not_the_maps_is_a_warning(tmp_path):
    """Heights of 1.5 m of brushwood that the map has not."""
    track = track_at(winding(), winding())
    bumps = 1.5 * np.sin(np.arange(track.num_rows) / 15.0)
    found = build_with(tmp_path, with_columns(track, alt_m=track.column("alt_m").to_numpy() + bumps))
    (other,) = select_findings(found.findings, *HEIGHTS)
    assert (other.code, other.numbers["expected_m"]) == ("map-heights-differ", pytest.approx(0.1, abs=0.001))
