"""A run that is not as it was written is no part of a dataset, and a dataset of fewer runs than it should be is told."""

import json
import shutil
from dataclasses import replace

import pytest
from stored_files import flip, manifest, run_document, table
from synthetic_store import add_run, box, commit_run, lanes, open_world, region_file, segments, supersede
from tcpipe.formats.commits import Entries

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError, StoreError
from tcpipe.pipeline.calls import open_log
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.problems import acknowledge
from tcpipe.pipeline.report import report
from tcpipe.recipe import LabelConfig, Recipe, SplitConfig
from tcpipe.store import Store
from tcpipe.tables.findings import is_problem
from tcpipe.tables.levels import STREAMS, Sensor, Streams


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Four runs beside each other."""
    directory = tmp_path_factory.mktemp("made")
    store = open_world(directory)
    for number, run_id in enumerate("abcd"):
        add_run(store, run_id, segments(run_id, *lanes(3.0 * number, -10.0, 10.0), start_ns=number * 10**15))
    return store


@pytest.fixture
def store(made, tmp_path):
    shutil.copytree(made.root, tmp_path / "store")
    return Store(tmp_path / "store")


def build(store, **how):
    return build_dataset(store.root.parent / "out", store=store.root, recipe=Recipe(), holdout="sample", **how)


def problems(result):
    return [(finding.code, finding.subject.name) for finding in result.findings if is_problem(finding)]


def runs(store):
    return [run.run_id for run in open_dataset(store.root.parent / "out").card.runs]


def edit(path, **values):
    """Change values without the seal, as an editor does."""
    found = json.loads(path.read_text())
    for name, of in values.items():
        found[name] = found[name] | of if isinstance(of, dict) else of
    path.write_text(json.dumps(found, indent=2, sort_keys=True) + "\n")


DAMAGE = {
    "the robot in the manifest": lambda run: edit(manifest(run), robot="warthog"),
    "the ledger": lambda run: edit(manifest(run), distance_by_reason_m={"kept": 1.0}),
    "the log's sha256": lambda run: edit(run_document(run), source={"sha256": "0" * 64}),
    "a flipped bit of the manifest": lambda run: flip(manifest(run)),
    "a flipped bit of the segments": lambda run: flip(table(run, "segments")),
    "a flipped bit of the track": lambda run: flip(table(run, "track")),
    "a lost track": lambda run: table(run, "track").unlink(),
    "a lost run.json": lambda run: run_document(run).unlink(),
    "a lost manifest": lambda run: manifest(run).unlink(),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_run_that_is_not_as_it_was_written_is_named_and_left_out(store, damage):
    DAMAGE[damage](store.recipes_of("b")[0])
    result = build(store)
    assert problems(result) == [("run-damaged", "b")]
    assert (result.exit_code, runs(store)) == (3, ["a", "c", "d"])
    again = build(store, min_runs=3)
    assert (again.status, problems(again)) == ("unchanged", [("run-damaged", "b")]), (
        "damage is a problem until it is repaired"
    )


def test_a_manifest_of_another_run_is_not_believed_though_its_seal_is_whole(store):
    ours, theirs = (store.recipes_of(name)[0] for name in "bc")
    shutil.copy(manifest(theirs), manifest(ours))
    assert problems(build(store)) == [("run-damaged", "b")]


def test_damaged_runs_are_told_by_inspect_and_report(store):
    path = manifest(store.recipes_of("b")[0])
    path.write_bytes(path.read_bytes()[:-1])
    found = inspect(store.root, recipe=Recipe())
    assert [run.run_id for run in found.runs] == ["a", "c", "d"]
    assert len(found.damaged_runs) == 1
    with pytest.raises(StoreError, match="bytes, expected"):
        report(store.root / "runs" / "b")


def remove(store, run_id):
    shutil.rmtree(store.root / "runs" / run_id)
    open_log(store).commit("pruned", Entries(removed=tuple(store.ingestions(run_id).rows)))


def under_another_recipe(store, *run_ids):
    for run_id in run_ids:
        remove(store, run_id)
        laid = segments(run_id, *lanes(3.0 * ord(run_id), -10.0, 10.0))
        add_run(store, run_id, laid, recipe=Recipe(label=LabelConfig(velocity="fused")))


def test_runs_that_have_to_be_ingested_again_are_told_each_time_unless_so_many_are_enough(store):
    assert build(store).exit_code == 0
    under_another_recipe(store, "b", "c", "d")
    before = (store.root.parent / "out" / "dataset.json").read_bytes()
    with pytest.raises(DatasetError, match=r"1 runs, expected 2 or more \(--min-runs\); nothing is written"):
        build(store, min_runs=2)
    assert (store.root.parent / "out" / "dataset.json").read_bytes() == before
    for status in ("done", "unchanged"):
        result = build(store)
        assert problems(result) == [("run-ingested-otherwise", run_id) for run_id in "bcd"]
        (line,) = result.finding_lines(problems=True)
        assert line.startswith("warning: 3 of 4 runs: Run excluded: ingested with another recipe")
        assert "To ingest the logs again, with this --recipe: 'tcpipe ingest /logs'" in line
        assert (result.status, result.exit_code) == (status, 3)
    assert build(store, min_runs=1).exit_code == 0
    assert runs(store) == ["a"]


def test_runs_that_are_gone_are_told_until_somebody_gives_them_up(store):
    build(store)
    shutil.rmtree(store.root / "runs" / "c")
    for _ in range(2):
        assert problems(build(store)) == [("run-damaged", "c")]
    acknowledge(["c"], store=store.root)
    assert build(store).exit_code == 0
    assert "c" not in {run_id for run_id, _ in store.state().runs}


def test_runs_of_the_dataset_before_that_the_store_no_longer_knows_are_told_once(store):
    build(store)
    remove(store, "c")
    assert problems(build(store)) == [("run-gone", "c")]
    assert build(store).exit_code == 0


def test_a_run_that_another_has_taken_the_place_of_is_not_gone(store):
    build(store)
    supersede(store, "b", "a")
    result = build(store)
    assert (problems(result), runs(store)) == ([], ["a", "c", "d"])
    assert ("run-superseded", "b") in {(of.code, of.subject.name) for of in result.findings}


def test_what_a_user_leaves_out_by_choice_is_no_problem(store):
    store.tag_run("d", {"weather": "wet"})
    commit_run(store, "d")
    build(store)
    assert build(store, tags={"weather": "wet"}, force=True).exit_code == 0
    add_run(store, "e", segments("e", *lanes(14.0, -10.0, 10.0), robot="warthog"))
    under_another_recipe(store, "c")
    assert build(store, robot="warthog", force=True).exit_code == 0
    assert build(store, robot="husky", force=True).exit_code == 3


@pytest.mark.parametrize(("x_m", "holdout", "empty"), [(20, "sample", "unseen"), (0, "run", "test")])
def test_a_split_that_is_empty_is_told_each_time(store, tmp_path, x_m, holdout, empty):
    for run_id in "bcd":
        remove(store, run_id)
    region = region_file(tmp_path / "region.geojson", box(-20, -20, x_m, 20))
    for _ in range(2):
        result = build_dataset(tmp_path / "out", store=store.root, recipe=Recipe(), holdout=holdout, split=region)
        assert problems(result) == [("split-empty", empty)]
        assert result.exit_code == 3


def test_no_test_is_no_problem_where_none_is_wanted(store, tmp_path):
    recipe = Recipe(split=SplitConfig(test_fraction=0.0))
    assert build_dataset(tmp_path / "out", store=store.root, recipe=recipe).exit_code == 0


def test_streams_that_are_not_as_they_were_written_are_made_again(store):
    """A lever arm stands in a footer that no page's checksum covers."""
    sensor = Sensor("/fix", "sensor_msgs/msg/NavSatFix", "gps", "the only one", (0.1, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0))
    files = store.write_streams("a", Streams({"gnss": STREAMS["gnss"].empty()}, {"gnss": sensor}, "husky"), key="k")
    store.write_run_json("a", replace(store.run_json("a"), streams=files, streams_key="k"))
    assert store.read_streams("a", key="k").sensors["gnss"].xyz_m == (0.1, 0.0, 0.3)
    (path,) = store.root.glob("runs/a/streams/*/gnss.parquet")
    data = path.read_bytes()
    assert data.count(b"0.3") == 1
    path.write_bytes(data.replace(b"0.3", b"0.7"))
    assert store.read_streams("a", key="k") is None
