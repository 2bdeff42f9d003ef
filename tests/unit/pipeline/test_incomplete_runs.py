"""A store that was copied by halves: whatever of a run is gone, every command says so, and does until it is back or made again."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from object_gateway import in_environment
from storage_server import object_store
from synthetic_store import add_run, commit_run, lanes, open_world, segments, supersede
from wheel_drives import START_NS, ask_status, drive_at

from tcpipe.pipeline import report as reporting
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.options import IngestOptions
from tcpipe.pipeline.prune import prune
from tcpipe.pipeline.status import find_status
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe
from tcpipe.store import Store
from tcpipe.tables.findings import Subject, make_finding, select_findings

LOST = {
    "the only manifest": "runs/b/*/manifest-1.json",
    "all manifests": "runs/twice/*/manifest-*.json",
    "the last manifest": "runs/twice/*/manifest-2.json",
    "the last run.json": "runs/twice/run-2.json",
    "the only run.json": "runs/b/run-1.json",
    "the last tags": "runs/twice/tags-1.json",
    "segments": "runs/b/*/*/segments.parquet",
    "a track": "runs/b/*/*/track.parquet",
    "a run": "runs/b",
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A store with a map and three runs, one of them made twice and tagged since; its index is there."""
    here = tmp_path_factory.mktemp("incomplete")
    store = open_world(here)
    for number, run_id in enumerate(("a", "b", "twice")):
        for more in (0.0, 1.0) if run_id == "twice" else (0.0,):
            add_run(store, run_id, segments(run_id, *lanes(3.0 * number, -10.0, 9.0 + more)))
            known = store.run_json(run_id)
            if more:
                store.write_run_json(
                    run_id, type(known)(known.source, damage=(make_finding("file-cut", Subject("file", "cut")),))
                )
    store.tag_run("twice", {"weather": "dry"})
    commit_run(store, "twice")
    return here


@pytest.fixture(params=["directory", "bucket"])
def place(request, made, tmp_path, monkeypatch):
    """A copy of the store: where its files lie here, and what it is called."""
    files = tmp_path / "served" / "sets" / "store"
    shutil.copytree(made / "store", files, copy_function=shutil.copy2)
    if request.param == "directory":
        yield files, files
        return
    with object_store(tmp_path / "served") as (environment, _):
        in_environment(monkeypatch, environment, tmp_path / "cache")
        yield files, "s3://sets/store"


def lose(files: Path, pattern: str) -> Callable[[], None]:
    """Remove part of a store; return what puts it back."""
    held = {
        path: path.read_bytes() for part in files.glob(pattern) for path in (part, *part.rglob("*")) if path.is_file()
    }
    assert held
    for path in held:
        path.unlink()
    shutil.rmtree(files / pattern, ignore_errors=True)

    def put_back() -> None:
        for path, data in held.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)

    return put_back


@pytest.mark.parametrize(
    ("place", "lost"),
    [*(("directory", lost) for lost in LOST), ("bucket", "the only manifest"), ("bucket", "a run")],
    indirect=["place"],
)
def test_what_a_run_lost_is_a_problem_to_every_command_until_it_is_back(place, tmp_path, lost):
    files, root = place
    before, new = Store(root).state(), tmp_path / "new.mcap"
    new.write_bytes(b"to be ingested")
    put_back = lose(files, LOST[lost])
    name = LOST[lost].split("/")[1]
    for _ in range(2):  # what the first call writes hides nothing from the next
        result = build_dataset(tmp_path / "out", store=root, recipe=Recipe(), dry_run=True)
        assert result.exit_code == 3
        assert [of.subject.name for of in select_findings(result.findings, "run-damaged", "run-gone")] == [name]
        found = ask_status(root, new)
        assert (found.exit_code, [of.code for of in found.problems]) == (3, ["run-incomplete"])
        assert verify(root).problems
        assert list(inspect(root, recipe=Recipe()).damaged_runs)
        assert len(Store(root).ingestions().finished) == 2
    reporting.report(root, runs=False)
    assert "files changed or missing" in (files / "report.html").read_text()
    assert Store(root).state() == before
    put_back()
    assert not Store(root).ingestions().damaged
    assert build_dataset(tmp_path / "out", store=root, recipe=Recipe(), dry_run=True).exit_code == 0
    assert verify(root).problems == ()


@pytest.mark.parametrize("lost", LOST)
def test_a_copy_whose_files_have_other_times_misses_the_same(made, tmp_path, lost):
    store = Store(shutil.copytree(made / "store", tmp_path / "store", copy_function=shutil.copyfile))
    lose(tmp_path / "store", LOST[lost])
    for _ in range(2):
        assert {run_id for run_id, _ in store.ingestions().damaged} == {LOST[lost].split("/")[1]}


def test_what_no_commit_names_is_seen_by_verify_alone_until_it_is_committed(place, tmp_path):
    files, root = place
    store, new = Store(root), tmp_path / "new.mcap"
    new.write_bytes(b"to be ingested")
    shutil.rmtree(files / "log")
    assert store.ingestions().rows == {}
    assert find_status(IngestOptions([new], store=root, recipe=Recipe(), min_age_s=600.0), create=True).problems == ()
    assert sum("no commit names it; ingest its log again" in line for line in verify(root).problems) == 3
    for run_id in ("a", "b", "twice"):
        commit_run(store, run_id)
    assert len(store.ingestions().finished) == 3
    assert verify(root).problems == ()


def test_what_prune_removes_is_not_missed_and_what_a_person_removes_is(place):
    files, root = place
    store = Store(root)
    supersede(store, "b", "a")
    assert [each.what for each in prune(store=root, recipe=Recipe(), min_age_s=0.0).removed] != []
    assert not store.runs_place.entries("b")
    assert not store.ingestions().damaged
    shutil.rmtree(files / "runs" / "a")
    assert [run_id for run_id, _ in store.ingestions().damaged] == ["a"]


@pytest.fixture(scope="module")
def ingested(tmp_path_factory):
    """Two logs and the store that they were ingested into, one of them tagged."""
    here = tmp_path_factory.mktemp("ingested")
    drive_at(here / "logs" / "one.mcap")
    drive_at(here / "logs" / "two.mcap", seed=1, start_ns=START_NS + 10**13)
    ingest([here / "logs"], store=here / "store", recipe=Recipe())
    ingest([here / "logs" / "one.mcap"], store=here / "store", recipe=Recipe(), tags={"load": "12"})
    return here


@pytest.mark.parametrize(
    "lost", ["runs/one-*/*/manifest-1.json", "runs/one-*", "runs/one-*/run-1.json", "runs/*/tags-1.json"]
)
def test_what_is_lost_is_made_again_from_the_log(ingested, tmp_path, lost):
    logs, root = ingested / "logs", shutil.copytree(ingested / "store", tmp_path / "store", copy_function=shutil.copy2)
    for part in root.glob(lost):
        shutil.rmtree(part) if part.is_dir() else part.unlink()
    (finding,) = ask_status(root).problems
    assert finding.code == "run-incomplete"
    assert ingest([logs], store=root, recipe=Recipe()).exit_code == 0
    found = ask_status(root)
    assert (found.exit_code, found.problems, found.counts) == (0, (), {"done": 2})
    assert verify(root).problems == ()
