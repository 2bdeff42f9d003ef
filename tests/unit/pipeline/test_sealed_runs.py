"""A run that is not as it was written is no part of a dataset, and build-dataset says so where a dataset has fewer runs than it should."""

import shutil

import pytest
from stored_files import flip, manifest, table
from synthetic_store import add_run, lanes, open_world, segments, tag_run

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError, StoreError
from tcpipe.formats import documents
from tcpipe.formats.stored_runs import read_streams
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.problems import acknowledge
from tcpipe.recipe import LabelConfig, Recipe
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
    documents._DECODED.clear()  # as another process
    return Store(tmp_path / "store")


def build(store, **how):
    return build_dataset(store.root.parent / "out", store=store.root, recipe=Recipe(), holdout="sample", **how)


def problems(result):
    return [(finding.code, finding.subject.name) for finding in result.findings if is_problem(finding)]


def runs(store):
    return [run.run_id for run in open_dataset(store.root.parent / "out").card.runs]


DAMAGE = {
    "a flipped bit of the segments": lambda run: flip(table(run, "segments")),
    "a flipped bit of the track": lambda run: flip(table(run, "track")),
    "a lost track": lambda run: table(run, "track").unlink(),
    "a lost folder": lambda run: shutil.rmtree(run.folder.path),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_run_that_is_not_as_it_was_written_is_named_and_excluded(store, damage):
    DAMAGE[damage](store.find_runs("b")[0])
    result = build(store)
    assert problems(result) == [("run-damaged", "b")]
    assert (result.exit_code, runs(store)) == (3, ["a", "c", "d"])
    again = build(store, min_runs=3)
    assert (again.status, problems(again)) == ("unchanged", [("run-damaged", "b")]), "until it is repaired"


def test_a_manifest_that_has_changed_is_no_document(store):
    """The run is known by the dataset before, and by `inspect` as a damaged document."""
    build(store)
    flip(manifest(store.find_runs("b")[0]))
    documents._DECODED.clear()
    (store.root / "index.parquet").unlink(missing_ok=True)
    assert [run.run_id for run in store.runs()] == ["a", "c", "d"]
    found = inspect(store.root, recipe=Recipe())
    assert ([run.run_id for run in found.runs], len(found.damaged)) == (["a", "c", "d"], 1)
    assert problems(build(store)) == [("run-gone", "b")]


def remove(store, run_id):
    """Remove a run with all that the store knows of it."""
    for run in store.find_runs(run_id):
        shutil.rmtree(run.folder.path)
        manifest(run).unlink()


def under_another_recipe(store, *run_ids):
    for run_id in run_ids:
        remove(store, run_id)
        laid = segments(run_id, *lanes(3.0 * ord(run_id), -10.0, 10.0))
        add_run(store, run_id, laid, recipe=Recipe(label=LabelConfig(velocity="fused")))


def test_runs_that_have_to_be_ingested_again_are_told_and_fail_the_first_time_unless_so_many_are_enough(store):
    assert build(store).exit_code == 0
    under_another_recipe(store, "b", "c", "d")
    before = (store.root.parent / "out" / "dataset.json").read_bytes()
    with pytest.raises(DatasetError, match=r"1 runs, expected 2 or more \(--min-runs\); nothing is written"):
        build(store, min_runs=2)
    assert (store.root.parent / "out" / "dataset.json").read_bytes() == before
    for status, exit_code in (("done", 3), ("unchanged", 0)):  # it is known then
        result = build(store)
        assert problems(result) == [("run-ingested-otherwise", run_id) for run_id in "bcd"]
        (line,) = result.finding_lines(problems=True)
        assert line.startswith("warning: 3 of 4 runs: Run excluded: ingested with another recipe")
        assert "To ingest the logs again, with this --recipe: 'tcpipe ingest /logs'" in line
        assert (result.status, result.exit_code) == (status, exit_code)
    assert build(store, min_runs=1).exit_code == 0
    assert runs(store) == ["a"]


def test_runs_that_are_gone_are_told_until_somebody_gives_them_up(store):
    build(store)
    shutil.rmtree(store.find_runs("c")[0].folder.path)
    for _ in range(2):
        assert problems(build(store)) == [("run-damaged", "c")]
    acknowledge(["c"], store=store.root)
    assert build(store).exit_code == 0
    assert store.find_runs("c") == []


def test_runs_of_the_dataset_before_that_the_store_no_longer_knows_are_told_once(store):
    build(store)
    remove(store, "c")
    assert problems(build(store)) == [("run-gone", "c")]
    assert build(store).exit_code == 0


def test_what_a_user_leaves_out_by_choice_is_no_problem(store):
    tag_run(store, "d", {"weather": "wet"})
    build(store)
    assert build(store, tag={"weather": "wet"}, force=True).exit_code == 0
    add_run(store, "e", segments("e", *lanes(14.0, -10.0, 10.0), robot="warthog"))
    under_another_recipe(store, "c")
    assert build(store, robot="warthog", force=True).exit_code == 0
    assert build(store, robot="husky", force=True).exit_code == 3


def test_streams_that_are_not_as_they_were_written_are_made_again(store):
    """A lever arm is in the footer, which no page's checksum covers."""
    sensor = Sensor("/fix", "sensor_msgs/msg/NavSatFix", "gps", "the only one", (0.1, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0))
    streams = Streams({"gnss": STREAMS["gnss"].empty()}, {"gnss": sensor}, "husky")
    add_run(store, "e", segments("e", *lanes(14.0, -10.0, 10.0)), streams=streams)
    (run,) = store.find_runs("e")
    assert run.streams().sensors["gnss"].xyz_m == (0.1, 0.0, 0.3)
    path = run.stream_files()["gnss"]
    data = path.read_bytes()
    assert data.count(b"0.3") == 1
    path.write_bytes(data.replace(b"0.3", b"0.7"))
    assert read_streams(store.place, run.facts) is None
    with pytest.raises(StoreError, match="its streams cannot be read; ingest the log again with --force"):
        run.streams()
