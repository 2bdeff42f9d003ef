import json
import resource
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from stored_files import map_path
from synthetic_store import (
    add_run,
    add_world,
    box,
    lanes,
    lonlat,
    make_fixes,
    open_world,
    region_file,
    segments,
    tag_run,
)

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError, MapError, RecipeError, RegionError, StoreError, UsageError
from tcpipe.formats.documents import State
from tcpipe.formats.recipe_toml import make_recipe_id, parse_recipe
from tcpipe.formats.runs import Call
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import LabelConfig, Recipe
from tcpipe.report.dataset_report import render_dataset_report
from tcpipe.store import Store, open_store
from tcpipe.tables.findings import Subject, select_findings


@pytest.fixture(scope="module")
def map_store(tmp_path_factory):
    """A store with the map alone."""
    return open_world(tmp_path_factory.mktemp("maps"))


@pytest.fixture
def store(map_store, tmp_path):
    """A store of one's own, with the map in it."""
    return Store(shutil.copytree(map_store.root, tmp_path / "store"))


def add(
    store,
    run_id="a",
    y_m=(0.0,),
    *,
    x=(-10.0, 10.0),
    start_ns=0,
    recipe=None,
    fixes=None,
    tags=None,
    **keywords,
):
    """Add a run; ``fixes`` are options of `make_fixes`."""
    table = segments(run_id, *lanes(np.array(y_m), *x), start_ns=start_ns, **keywords)
    spans = (table["start_ns"][0].as_py(), table["end_ns"][-1].as_py())
    streams = None if fixes is None else make_fixes(spans, **fixes)
    add_run(store, run_id, table, recipe=recipe, streams=streams, tags=tags)


def build(store, tmp_path, *, page=False, **keywords):
    """Build into ``out``; only datasets of an odd kind get their page."""
    with pytest.MonkeyPatch.context() as patch:
        if page:
            patch.setattr("tcpipe.pipeline.dataset.writing.render_dataset_report", render_dataset_report)
        return build_dataset(tmp_path / "out", store=store.root, **{"recipe": Recipe(), **keywords})


def twice(result):
    """Return each run that was recorded twice, by which other, and how many of how many segments."""
    found = select_findings(result.findings, "drive-recorded-twice")
    return [
        (of.subject.name, of.names["others"], of.numbers["duplicate_count"], of.numbers["segment_count"])
        for of in found
    ]


def refused(store, tmp_path, error=DatasetError, **keywords):
    """The one line with which building fails; nothing is left behind."""
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(error) as caught:
        build(store, tmp_path, **keywords)
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert len(caught.value.problems) == 1
    return caught.value.problems[0]


def test_what_is_missing_is_named(store, tmp_path):
    assert "there is no store here" in refused(Store(tmp_path / "nowhere"), tmp_path, UsageError)
    assert "no runs in the store" in refused(store, tmp_path)
    bare = open_store(tmp_path / "bare", create=True)
    bare.put(State(), "calls", "0000000100000000", Call(command="ingest", version="2.0.0"))
    with pytest.raises(DatasetError) as caught:
        build(bare, tmp_path, map="site")
    runs, maps = caught.value.problems
    assert "no runs in the store" in runs
    assert "no map 'site' in the store" in maps


def test_several_maps_are_listed_with_the_flag(store, tmp_path):
    add(store)
    add_world(store, name="yard")
    line = refused(store, tmp_path)
    assert "(site, yard)" in line
    assert "--map" in line
    assert "no map 'field'" in refused(store, tmp_path, map="field")
    assert build(store, tmp_path, map="yard").card.samples == 20


def test_two_robots_are_not_pooled_unasked(store, tmp_path):
    add(store)
    add(store, "b", (3.0,), robot="warthog")
    line = refused(store, tmp_path)
    assert "husky, warthog" in line
    assert "--robot" in line
    assert "no run of robot 'jackal'" in refused(store, tmp_path, robot="jackal")
    assert build(store, tmp_path, robot="warthog").card.samples == 20


def test_runs_of_another_recipe_are_left_out_and_named(store, tmp_path):
    other = Recipe(label=LabelConfig(velocity="fused"))
    add(store, "b", recipe=other)
    assert "none ingested with this recipe" in refused(store, tmp_path)
    add(store)
    result = build(store, tmp_path)
    (found,) = select_findings(result.findings, "run-ingested-otherwise")
    assert (found.subject, found.names) == (
        Subject("run", "b"),
        {"what": "recipe", "has": make_recipe_id(other, "husky")},
    )
    assert [of.command for of in found.remedies] == ["tcpipe ingest /logs/b.mcap"]
    assert (result.card.samples, result.exit_code) == (20, 3)


@pytest.mark.parametrize(("names", "skew_ns"), [(("a", "b"), 0), (("b", "a"), 300_000_000), (("a", "b"), -900_000_000)])
def test_a_recording_that_overlaps_another_counts_once_where_it_does(store, tmp_path, names, skew_ns):
    """One drive of 40 m; its second recording has the last 20 m of the first one and 10 m more."""
    whole, late = names
    add(store, whole, x=(-19.0, 11.0), start_ns=10**18, fixes={})
    add(store, late, x=(-9.0, 18.0), start_ns=10**18 + 10 * 1_200_000_000 + skew_ns, fixes={"late_ns": skew_ns})
    result = build(store, tmp_path)
    starts_m = np.sort(pq.read_table(tmp_path / "out" / "samples.parquet")["start_lon_deg"].to_numpy())
    assert result.card.samples == 37
    assert np.diff(starts_m).min() > 0.9 * np.median(np.diff(starts_m))  # no metre of it twice
    assert result.card.distance_by_reason_m["recorded_twice"] == pytest.approx(20)
    second, first = sorted(names, reverse=True)
    assert twice(result) == [(second, first, 20, 30 if second == whole else 27)]
    assert sum(result.card.distance_by_reason_m.values()) == pytest.approx(30 + 27 + 5)
    assert verify(tmp_path / "out").problems == ()


def test_a_drive_that_was_recorded_in_two_pieces_is_one_and_a_short_one_after_it_too(store, tmp_path):
    add(store, "a", x=(-15.0, 5.0), start_ns=10**18)
    add(store, "b", x=(5.0, 7.0), start_ns=10**18 + 20 * 1_200_000_000 + 50_000_000)
    result = build(store, tmp_path)
    assert result.card.samples == 22
    assert twice(result) == []


OTHER_TOPIC = {"drive": 1, "topic": "/gps/fix"}


@pytest.mark.parametrize(
    ("fixes", "answer", "samples"), [(OTHER_TOPIC, "two_robots", 40), (None, "two_robots", 40), (None, "one_drive", 20)]
)
def test_runs_without_a_sensor_in_common_are_asked_for_and_a_tag_is_the_answer(store, tmp_path, fixes, answer, samples):
    add(store, start_ns=10**18, fixes={})
    add(store, "b", (1.5,), start_ns=10**18, fixes=fixes)
    result = build(store, tmp_path)
    assert result.card.samples == 40
    (found,) = select_findings(result.findings, "drives-overlap")
    assert (found.severity, found.subject.name, found.names["other"]) == ("warning", "b", "a")
    assert found.numbers["overlapping_count"] == 20
    command = {remedy.name: remedy.command for remedy in found.remedies}[answer]
    logs, tag = command.removeprefix("tcpipe ingest ").split(" --tag ")
    key, value = tag.split("=")
    for log in logs.split():  # what ingesting a known log again does
        tag_run(store, Path(log).stem, {key: value})
    result = build(store, tmp_path, force=True)
    assert result.card.samples == samples
    assert select_findings(result.findings, "drives-overlap") == []
    assert twice(result) == ([("b", "a", 20, 20)] if samples == 20 else [])


def test_no_segments(store, tmp_path):
    add_run(
        store,
        "a",
        segments("a", *lanes(0.0, 0.0, 1.0)).slice(0, 0),
        distance_by_reason_m={"kept": 0.0, "stationary": 3.0},
    )
    assert "no segment in them: 3 m stationary" in refused(store, tmp_path)


def test_the_card_says_what_the_power_of_any_run_feeds(store, tmp_path):
    add(store)
    for run_id, y_m, what in (("b", 3.0, "user ports"), ("c", 6.0, "computers"), ("d", 9.0, "computers")):
        add_run(store, run_id, segments(run_id, *lanes(y_m, -10.0, 10.0)), includes=(what,))
    build(store, tmp_path)
    assert open_dataset(tmp_path / "out").card.label.includes == ("computers", "user ports")


def test_a_map_that_does_not_cover_the_runs(store, tmp_path):
    add(store, x=(100.0, 120.0))
    line = refused(store, tmp_path)
    assert "none of 20 segments gives a sample (20 m outside map)" in line
    assert "the map covers" in line


@pytest.mark.parametrize("lost", ["terrain/c", "checksums.json", "height/zarr.json"])
def test_a_map_that_lost_a_part_is_refused_and_not_taken_for_a_hole(store, tmp_path, lost):
    add(store)
    part = map_path(store.root, "site") / lost
    for path in [part] if part.is_file() else sorted(path for path in part.rglob("*") if path.is_file()):
        path.unlink()
    line = refused(store, tmp_path, MapError)
    assert "map site: changed since it was written" in line
    assert "add the map again" in line


def test_a_map_is_verified_when_something_is_built(store, tmp_path):
    add(store)
    build(store, tmp_path)
    (map_path(store.root, "site") / "checksums.json").unlink()
    assert build(store, tmp_path).status == "unchanged"
    add(store, "b", (3.0,))
    assert "map site: changed since it was written" in refused(store, tmp_path, MapError)


SWAPPED = {"type": "Polygon", "coordinates": [lonlat([*box(-20, -20, 20, 20), (-20, -20)])[:, ::-1].tolist()]}
EVERYTHING = box(-20, -20, 20, 20)


@pytest.mark.parametrize(
    ("region", "error", "texts"),
    [
        ([box(1000, 0, 1100, 100)], DatasetError, ("covers none of the 20 samples", "about 0.99 km")),
        ([box(-20, -0.4, 20, 0.4)], DatasetError, ("no whole footprint",)),
        ([EVERYTHING, EVERYTHING], DatasetError, ("20 of 20 samples are in its exclude polygons",)),
        (json.dumps(SWAPPED), DatasetError, ("axes swapped",)),
        ("{", RegionError, ("not GeoJSON",)),
    ],
)
def test_a_region_that_leaves_no_sample_is_refused(store, tmp_path, region, error, texts):
    add(store)
    path = tmp_path / "r.geojson"
    if isinstance(region, str):
        path.write_text(region)
    else:
        region_file(path, *region, splits=(None, "exclude")[: len(region)])
    line = refused(store, tmp_path, error, split=path)
    assert all(text in line for text in texts)


def test_an_exclude_region_takes_samples_out_of_the_dataset(store, tmp_path):
    add(store)
    region = region_file(tmp_path / "r.geojson", box(-20, -20, 20, 20), box(-5, -2, 5, 2), splits=(None, "exclude"))
    result = build(store, tmp_path, page=True, split=region)
    # 20 segments from -10 to 10: 10 lie in the exclude region, 1 m of gap to each border goes to the buffer
    assert result.card.distance_by_reason_m["split_excluded"] == pytest.approx(10)
    assert result.card.splits["buffer"] == 4
    assert result.card.samples == 10


def test_holdout_and_seed_overrule_the_recipe(store, tmp_path):
    add(store)
    sample = build(store, tmp_path, holdout="sample")
    assert (sample.card.splits["train"], sample.card.splits["test"]) == (16, 4)
    first = set(open_dataset(tmp_path / "out")["test"].samples["sample_id"].to_pylist())
    build(store, tmp_path, holdout="sample", seed=1, force=True)
    assert set(open_dataset(tmp_path / "out")["test"].samples["sample_id"].to_pylist()) != first


def test_one_run_cannot_be_held_out_and_it_is_said(store, tmp_path):
    add(store)
    result = build(store, tmp_path, page=True, holdout="run")
    assert result.card.splits["test"] == 0
    (found,) = select_findings(result.findings, "split-empty")
    assert (found.subject, found.names) == (Subject("split", "test"), {"reason": "one_run"})
    assert result.exit_code == 3
    for remedy in found.remedies:
        cured = build(store, tmp_path, recipe=parse_recipe(remedy.recipe, where="remedy"), force=True)
        assert not select_findings(cured.findings, "split-empty")


def test_what_the_call_says_instead_of_the_recipe_is_checked_as_the_recipe_is(store, tmp_path):
    with pytest.raises(RecipeError, match=r'split\.holdout is "samples"'):
        build(store, tmp_path, holdout="samples")
    with pytest.raises(UsageError, match="seed is -1; expected a number from 0"):
        build(store, tmp_path, seed=-1)


@pytest.mark.parametrize("limit_bytes", [10_000, 40_000, 70_000])
def test_a_disk_that_fills_up_leaves_nothing_half_written(store, tmp_path, limit_bytes):
    """A limit on the size of files stands for a full disk: the write itself fails."""
    add(store)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        with pytest.raises((DatasetError, StoreError), match="cannot be written") as caught:
            build(store, tmp_path, page=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert len(caught.value.problems) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["store"]
