"""Prune removes old results; it keeps files of datasets and of users, and waits for running calls."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_store import add_run, add_world, lanes, make_fixes, segments, supersede, tag_run

from tcpipe.errors import UsageError
from tcpipe.formats import documents
from tcpipe.formats.documents import BLOBS, make_key
from tcpipe.formats.runs import Output
from tcpipe.pipeline import calls
from tcpipe.pipeline.calls import INGEST, identify_process, list_open_calls, record_call
from tcpipe.pipeline.prune import prune
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import ReadConfig, Recipe
from tcpipe.store import open_store

OLD = replace(Recipe(), read=ReadConfig(ignore_topics=["/none"]))


@pytest.fixture
def store(tmp_path):
    """Runs a and b under an older recipe and the ruling one, c under the older alone; b is superseded by a under the ruling recipe."""
    store = open_store(tmp_path / "store", create=True)
    for recipe in (OLD, Recipe()):
        for number, run_id in enumerate(("a", "b", "c")[: 3 if recipe is OLD else 2]):
            add_run(store, run_id, segments(run_id, *lanes(np.array([number]), -10.0, 10.0)), recipe=recipe)
    supersede(store, "b", "a")
    return store


def list_tables(store):
    """The runs whose tables are there, as RUN/RECIPE."""
    state = store.scan()
    return {f"{row.run_id}/{row.recipe_id}" for row in state.list_rows() if row.blob and state.has_payload(row)}


def name(store, run_id, recipe=OLD):
    """The run under a recipe as a command names it."""
    rows = store.scan().list_rows(run_id)
    keys = {row.recipe_id: row.ingest_key for row in rows}
    ruling = {row.ingest_key for row in store.scan().list_rows("c")}
    (recipe_id,) = [each for each, key in keys.items() if (key in ruling) == (recipe is OLD)]
    return f"{run_id}/{recipe_id}"


def blob(store, run_id, recipe=OLD):
    (row,) = [
        row for row in store.scan().list_rows(run_id) if f"{run_id}/{row.recipe_id}" == name(store, run_id, recipe)
    ]
    return store.root / BLOBS / row.blob


def put_output(store, where, *runs, inputs="0" * 64):
    output = Output(where=str(where), inputs=inputs, runs=tuple(tuple(run.split("/")) for run in runs))
    store.put(store.scan(), "outputs", make_key(str(where)), output)


def describe(lines):
    return [(each.what, each.name) for each in lines]


def test_old_recipes_and_superseded_runs_go_and_a_dry_run_lists_the_same(store):
    before = list_tables(store)
    sizes = {each: sum(path.stat().st_size for path in blob(store, each).iterdir()) for each in "ab"}
    planned = prune(store=store.root, recipe=Recipe(), dry_run=True)
    assert list_tables(store) == before
    assert store.scan().calls == []
    done = prune(store=store.root, recipe=Recipe())
    assert (done.removed, done.kept, done.documents) == (planned.removed, planned.kept, planned.documents)
    gone = {
        ("old recipe", name(store, "a")),
        *(("superseded run", name(store, "b", recipe)) for recipe in (OLD, Recipe())),
    }
    assert {*describe(done.removed)} == gone
    assert done.removed[0].size_bytes == sizes["a"], "its files are counted"
    assert list_tables(store) == {name(store, "a", Recipe()), name(store, "c")}, "c has no other recipe"
    stay = blob(store, "a", Recipe()), blob(store, "c")
    assert {*(store.root / BLOBS).iterdir()} == {*stay}
    assert "there is nothing to remove" not in str(done)
    again = prune(store=store.root, recipe=Recipe())
    assert (again.removed, again.kept, again.size_bytes) == ((), (), 0)
    assert verify(store.root).problems == ()


def test_a_run_that_is_named_goes_alone_and_its_log_stays_known(store):
    with pytest.raises(UsageError, match=r"no run of .* has this name; nothing is removed"):
        prune(["a", "nosuch"], store=store.root, recipe=Recipe())
    before = list_tables(store)
    assert describe(prune([name(store, "c")], store=store.root, recipe=Recipe()).removed) == [("run", name(store, "c"))]
    assert before - list_tables(store) == {name(store, "c")}
    assert [row.run_id for row in store.scan().list_rows("c")] == ["c"]
    assert prune(["c"], store=store.root, recipe=Recipe()).removed == ()
    prune(["a"], store=store.root, recipe=Recipe())
    assert not any(each.startswith("a/") for each in list_tables(store))


def test_streams_that_another_recipe_uses_stay_and_the_tables_beside_them_go(tmp_path):
    store = open_store(tmp_path / "store", create=True)
    laid = segments("a", *lanes(np.array([0.0]), -10.0, 10.0))
    add_run(store, "a", laid, recipe=OLD, streams=make_fixes((0, 10**9)))
    (old,) = store.scan().list_rows("a")
    add_run(store, "a", laid)
    state = store.scan()
    (new,) = [run for run in store.find_runs("a") if run.recipe_id != old.recipe_id]
    store.put_run(state, replace(new.manifest, streams_blob=old.blob, streams=old.streams))
    assert describe(prune(store=store.root, recipe=Recipe()).removed) == [("old recipe", f"a/{old.recipe_id}")]
    assert [path.name for path in (store.root / BLOBS / old.blob).iterdir()] == ["streams"]
    assert verify(store.root).problems == ()


def test_what_a_dataset_refers_to_stays_until_it_is_forgotten_or_replaced(store, tmp_path):
    put_output(store, tmp_path / "moved", name(store, "a"), name(store, "b", Recipe()))
    found = prune(store=store.root, recipe=Recipe())
    assert {each.name for each in found.kept} == {name(store, "a"), name(store, "b", Recipe())}
    hint = f"; if it no longer exists: 'tcpipe prune --forget {tmp_path / 'moved'}'"
    assert {each.stays for each in found.kept} == {f"dataset {tmp_path / 'moved'} refers to it{hint}"}
    assert {name(store, "a"), name(store, "b", Recipe())} <= list_tables(store)
    assert prune([name(store, "a")], store=store.root, recipe=Recipe()).kept, "also one that is named"
    with pytest.raises(UsageError, match="nosuch: is no output of this store; nothing is removed"):
        prune(store=store.root, recipe=Recipe(), forget=["nosuch"])
    found = prune(store=store.root, recipe=Recipe(), forget=[str(tmp_path / "moved")])
    assert len(found.removed) == 2
    assert store.scan().outputs == {}


def test_replaced_documents_and_their_payload_go(store):
    add_world(store)
    first = store.scan().maps["site"].blob
    add_world(store)
    add_run(store, "c", segments("c", *lanes(np.array([2.0]), -10.0, 5.0)), recipe=OLD)
    tag_run(store, "c", {"weather": "wet"})
    tag_run(store, "c", {"weather": "dry"})
    found = prune(store=store.root, recipe=OLD)
    assert ("payload that no document names", str(store.root / BLOBS / first)) in describe(found.removed)
    assert not (store.root / BLOBS / first).exists()
    assert len(store.scan().replaced) == 1, "the number 1 of this call"
    (run,) = store.find_runs("c")
    assert run.segments().num_rows == 15
    assert run.facts.tags == {"weather": "dry"}
    assert verify(store.root).problems == ()


def test_a_damaged_manifest_keeps_all_payload_and_stops_nothing_else(store):
    path = store.root / store.find_runs(name(store, "a"))[0].document
    path.write_bytes(b"")
    documents._DECODED.clear()
    tag_run(store, "c", {"weather": "wet"})
    tag_run(store, "c", {"weather": "dry"})
    before = {path.name for path in (store.root / BLOBS).iterdir()}
    found = prune(store=store.root, recipe=Recipe())
    assert {path.name for path in (store.root / BLOBS).iterdir()} == before
    assert {each.stays for each in found.kept} == {
        f"{path.relative_to(store.root)} is damaged and may name it; 'tcpipe verify' lists repairs"
    }
    assert found.documents >= 1
    path.unlink()
    assert ("payload that no document names") in {
        each.what for each in prune(store=store.root, recipe=Recipe()).removed
    }


def test_files_of_others_stay(store):
    inside = blob(store, "b") / "notes.txt"
    theirs = [inside, store.root / "notes.txt", store.root / "runs" / "notes.json", store.root / BLOBS / "mine" / "x"]
    theirs[-1].parent.mkdir()
    for path in theirs:
        path.write_text("mine")
    (blob(store, "a") / ".DS_Store").touch()
    gone = blob(store, "a")
    found = prune(store=store.root, recipe=Recipe())
    assert all(path.read_text() == "mine" for path in theirs)
    assert [each.stays for each in found.kept] == ["it contains notes.txt, which tcpipe did not write"]
    assert not gone.exists()


def test_nothing_goes_while_a_call_runs_or_may_run(store, monkeypatch):
    before = list_tables(store)
    for how in ({}, {"host": "node7"}):
        here = identify_process()
        with monkeypatch.context() as patch:
            patch.setattr(calls, "identify_process", lambda how=how, here=here: replace(here, **how))
            running = record_call(store, INGEST, ["/logs"])
            running.__enter__()
        found = prune(store=store.root, recipe=Recipe())
        assert (found.removed, found.documents, list_tables(store)) == ((), 0, before)
        (call,) = list_open_calls(store.scan())
        assert "ingest of 20" in found.waits_for
        assert ("is running" in found.waits_for) == (not how)
        assert (f"tcpipe acknowledge {call.name}" in found.waits_for) == bool(how)
        assert found.waits_for in str(prune(store=store.root, recipe=Recipe(), dry_run=True))
        running.__exit__(None, None, None)
    assert len(prune(store=store.root, recipe=Recipe()).removed) == 3


def test_the_payload_of_a_killed_call_goes_at_once(store, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(calls, "identify_process", lambda: replace(identify_process(), start="1"))
        record_call(store, INGEST, ["/logs"]).__enter__()
    left = store.root / BLOBS / "0123456789abcdef"
    left.mkdir()
    (left / "track.parquet").write_bytes(b"half")
    (holder := store.root / ".tmp-new-01234567").mkdir()
    assert any(line.startswith(f"{left}: was left by a killed command") for line in verify(store.root).problems)
    found = prune(store=store.root, recipe=Recipe(), dry_run=True)
    assert {("payload that no document names", str(left)), ("left by a killed call", str(holder))} <= {
        *describe(found.removed)
    }
    assert left.exists()
    assert prune(store=store.root, recipe=Recipe()).removed == found.removed
    assert not left.exists()
    assert not holder.exists()
