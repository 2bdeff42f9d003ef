"""A store that was copied by halves: whatever of a run is gone, every command says so, and does until it is back or made again."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from object_gateway import in_environment
from storage_server import object_store
from synthetic_store import add_run, add_world, lanes, make_fixes, open_world, segments, supersede, tag_run
from wheel_drives import ask_status

from tcpipe.formats import documents
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.prune import prune
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store
from tcpipe.tables.findings import select_findings


def find_files(root: Path, run_id: str) -> dict[str, Path]:
    """Return the parts of a run in a directory: its manifest, its folder of tables, and two files in it."""
    (run,) = Store(root).find_runs(run_id)
    folder = run.folder.path
    streams = root / "blobs" / run.facts.streams_blob / "streams"
    return {
        "manifest": root / run.document,
        "folder": folder,
        "segments": folder / "segments.parquet",
        "streams": streams,
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A store with a map and three runs, one of them made twice and tagged since."""
    here = tmp_path_factory.mktemp("incomplete")
    store = open_world(here)
    for number, run_id in enumerate(("a", "b", "twice")):
        for more in (0.0, 1.0) if run_id == "twice" else (0.0,):
            fixes = make_fixes((number * 10**12, number * 10**12 + 10**9), drive=number)
            add_run(store, run_id, segments(run_id, *lanes(3.0 * number, -10.0, 9.0 + more)), streams=fixes)
    tag_run(store, "twice", {"weather": "dry"})
    return here


@pytest.fixture(params=["directory", "bucket"])
def place(request, made, tmp_path, monkeypatch):
    """A copy of the store: where its files lie here, and what it is called."""
    documents._DECODED.clear()
    files = tmp_path / "served" / "sets" / "store"
    shutil.copytree(made / "store", files, copy_function=shutil.copy2)
    if request.param == "directory":
        yield files, files
        return
    with object_store(tmp_path / "served") as (environment, _):
        in_environment(monkeypatch, environment, tmp_path / "cache")
        yield files, "s3://sets/store"


def lose(part: Path) -> Callable[[], None]:
    """Remove a file or folder; return what puts it back."""
    held = {path: path.read_bytes() for path in (part, *part.rglob("*")) if path.is_file()}
    assert held
    shutil.rmtree(part) if part.is_dir() else part.unlink()

    def put_back() -> None:
        for path, data in held.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)

    return put_back


def list_problems(root, out):
    """Return the problems of runs in a dry run of build-dataset, and in status."""
    result = build_dataset(out, store=root, recipe=Recipe(), dry_run=True)
    build = [
        (of.code, of.subject.name)
        for of in select_findings(result.findings, "run-damaged", "run-gone", "run-incomplete")
    ]
    return build, [(of.code, of.subject.name) for of in ask_status(root, out.parent / "new.mcap").problems]


def test_a_folder_that_is_lost_is_a_problem_to_every_command_until_it_is_back(place, tmp_path):
    (files, root), run_id = place, "twice"
    (tmp_path / "new.mcap").write_bytes(b"to be ingested")
    before = Store(root).scan().runs
    put_back = lose(find_files(files, run_id)["folder"])
    for _ in range(2):  # what the first call writes hides nothing from the next
        build, status = list_problems(root, tmp_path / "out")
        assert build == [("run-damaged", run_id)]
        assert status == [("run-incomplete", run_id)]
        assert any(f"is missing (run {run_id})" in line for line in verify(root).problems)
        assert len(inspect(root, recipe=Recipe()).runs) == 2
        assert len(Store(root).runs()) == 2
    assert Store(root).scan().runs == before
    put_back()
    assert list_problems(root, tmp_path / "out") == ([], [])
    assert verify(root).problems == ()


def test_what_prune_removes_is_not_missed_and_what_a_person_removes_is(place, tmp_path):
    files, root = place
    (tmp_path / "new.mcap").write_bytes(b"to be ingested")
    supersede(Store(root), "b", "a")
    assert [each.what for each in prune(store=root, recipe=Recipe()).removed] != []
    assert ask_status(root, tmp_path / "new.mcap").problems == ()
    lose(find_files(files, "a")["folder"])
    assert [of.subject.name for of in ask_status(root, tmp_path / "new.mcap").problems] == ["a"]


def test_a_map_whose_folder_is_gone_is_a_problem_until_it_is_added_again(tmp_path):
    store = open_store(tmp_path, create=True)
    add_run(store, "a", segments("a", *lanes(0.0, 0.0, 5.0)))
    add_world(store)
    shutil.rmtree(tmp_path / "blobs" / store.scan().maps["site"].blob)
    (finding,) = (each for each in ask_status(tmp_path, tmp_path).problems if each.subject.kind == "map")
    assert (finding.code, finding.subject.name) == ("map-incomplete", "site")
    add_world(store)
    assert "map-incomplete" not in [finding.code for finding in ask_status(tmp_path, tmp_path).problems]
