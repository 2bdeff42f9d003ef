"""What goes from a store and what stays: nothing of a dataset, nothing of somebody else, each thing whole or not at all."""

import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_store import add_run, commit_run, lanes, segments, supersede
from tcpipe.formats.commits import Dataset, Entries

from tcpipe.errors import UsageError
from tcpipe.formats.integrity import seal_page
from tcpipe.pipeline import prune as prune_module
from tcpipe.pipeline.calls import open_log
from tcpipe.pipeline.prune import prune
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import ReadConfig, Recipe
from tcpipe.store import open_store

OLDER = replace(Recipe(), read=ReadConfig(ignore_topics=["/others"]))
OLD = replace(Recipe(), read=ReadConfig(ignore_topics=["/none"]))


@pytest.fixture
def store(tmp_path):
    """Runs a and b under an older recipe and the ruling one, c under the older alone; b is superseded by a."""
    store = open_store(tmp_path / "store", create=True)
    for recipe in (OLD, Recipe()):
        for number, run_id in enumerate(("a", "b", "c")[: 3 if recipe is OLD else 2]):
            add_run(store, run_id, segments(run_id, *lanes(np.array([number]), -10.0, 10.0)), recipe=recipe)
    supersede(store, "b", "a")
    return store


def old_recipe(store):
    return next((store.root / "runs" / "c").glob("[!r]*")).name


def there(store):
    return {(path.parent.parent.name, path.parent.name) for path in store.root.glob("runs/*/*/manifest-1.json")}


def test_old_recipes_and_superseded_runs_go_and_a_dry_run_says_the_same(store):
    before, old = there(store), old_recipe(store)
    planned = prune(store=store.root, recipe=Recipe(), dry_run=True)
    assert there(store) == before
    size = sum(path.stat().st_size for path in store.root.glob(f"runs/a/{old}/**/*") if path.is_file())
    assert (planned.removed[0].what, planned.removed[0].size_bytes) == ("old recipe", size)
    done = prune(store=store.root, recipe=Recipe())
    assert (done.removed, done.size_bytes) == (planned.removed, planned.size_bytes)
    assert [(each.what, each.path) for each in done.removed] == [
        ("old recipe", str(store.root / "runs" / "a" / old)),
        ("superseded run", str(store.root / "runs" / "b")),
    ]
    assert {run for run, _ in there(store)} == {"a", "c"}, "c has no other"
    assert len(there(store)) == 2
    assert not (store.root / "runs" / "b").exists()
    assert str(prune(store=store.root, recipe=Recipe())).endswith("there is nothing to remove")
    assert not list(store.root.rglob(".tmp-*"))


def test_what_is_newer_than_the_ruling_recipe_is_not_old(store):
    assert not [each for each in prune(store=store.root, recipe=OLD).removed if each.what == "old recipe"]


def test_what_a_dataset_refers_to_stays_also_where_that_was_moved(store, tmp_path):
    ids = {run_id: recipe_id for run_id, recipe_id in there(store) if recipe_id == old_recipe(store)}
    dataset = Dataset(str(tmp_path / "moved"), "0" * 64, (("a", ids["a"]), ("b", ids["b"])))
    open_log(store).commit("built", Entries(datasets=(dataset,)))
    found = prune(store=store.root, recipe=Recipe())
    assert found.removed == ()
    assert {each.stays for each in found.kept} == {f"dataset {tmp_path / 'moved'} refers to it"}
    assert len(there(store)) == 5
    with pytest.raises(UsageError, match="not a dataset of this store; nothing is removed"):
        prune(store=store.root, recipe=Recipe(), forget=["nosuch"])
    assert len(prune(store=store.root, recipe=Recipe(), forget=[str(tmp_path / "moved")]).removed) == 2


def test_nothing_goes_while_a_commit_cannot_be_read(store):
    log = open_log(store)
    log.commit("built", Entries(datasets=(Dataset("/nowhere", "0" * 64),)))
    commit = store.root / "log" / f"{log.state.number:010}.json"
    whole = commit.read_bytes()
    commit.write_bytes(b"")
    found = prune(store=store.root, recipe=Recipe())
    assert found.removed == ()
    assert len(found.kept) == 2
    assert {each.stays for each in found.kept} == {
        f"{commit} is missing or damaged: it may name what a dataset refers to"
    }
    commit.write_bytes(whole)
    assert len(prune(store=store.root, recipe=Recipe()).removed) == 2


def test_what_is_kept_and_what_is_somebody_else_s_stays(store):
    old = old_recipe(store)
    (store.root / "runs" / "b" / "notes.txt").write_text("mine")
    found = prune(store=store.root, recipe=Recipe(), keep=[old])
    assert found.removed == ()
    stays = [each.stays for each in found.kept]
    assert stays == ["--keep names it", "--keep names it"]
    found = prune(store=store.root, recipe=Recipe(), keep=["a"])
    assert [each.stays for each in found.kept] == [
        "--keep names it",
        f"{store.root / 'runs' / 'b' / 'notes.txt'} is no file of this store",
    ]
    with pytest.raises(UsageError, match="no run or recipe is called nosuch; nothing is removed"):
        prune(store=store.root, recipe=Recipe(), keep=["nosuch"])


def test_what_a_killed_call_left_goes_when_it_is_old(store):
    holder, other = (store.root / f".tmp-{name}-12345678" for name in "de")
    (holder / "d").mkdir(parents=True)

    def planned():
        found = prune(store=store.root, recipe=Recipe(), keep=["a", "b"], dry_run=True)
        return [each.path for each in found.removed]

    assert planned() == []
    os.utime(holder, (0, 0))
    assert planned() == [str(holder)]
    other.mkdir()
    os.utime(other, (0, 0))
    assert len(prune(store=store.root, recipe=Recipe(), keep=["a", "b"]).removed) == 2
    assert not holder.exists()
    assert not other.exists()


def test_the_scratch_of_a_killed_call_goes(store, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    left = tmp_path / f"tcpipe-{os.getuid()}-0123abcd"
    left.mkdir()
    prune(store=store.root, recipe=Recipe(), dry_run=True)
    assert left.is_dir()
    prune(store=store.root, recipe=Recipe())
    assert not left.exists()


def test_a_directory_that_a_killed_prune_left_empty_goes_when_it_is_old(store):
    empty = store.root / "runs" / "gone" / "0123abcd"
    empty.mkdir(parents=True)
    prune(store=store.root, recipe=Recipe(), min_age_s=60.0)
    assert empty.is_dir()
    prune(store=store.root, recipe=Recipe(), min_age_s=0.0)
    assert not empty.parent.exists()
    assert len(there(store)) == 2


def files(store):
    """What lies in a store, besides the times and processes of calls."""
    paths = (path.relative_to(store.root) for path in store.root.rglob("*"))
    return {str(path): (store.root / path).is_dir() for path in paths if path.parts[0] not in ("log", "index")}


def kill_at(patch, step):
    """Kill what follows before its removal of this number: of a file, or of a directory that has become empty."""
    unlink, rmdir, left = Path.unlink, Path.rmdir, [step]

    def make_killed(real):
        def killed(path, *args, **kwargs):
            if "runs" in path.parts:
                if not left[0]:
                    raise KeyboardInterrupt
                left[0] -= 1
            real(path, *args, **kwargs)

        return killed

    patch.setattr(Path, "unlink", make_killed(unlink))
    patch.setattr(Path, "rmdir", make_killed(rmdir))


def test_a_kill_at_any_step_leaves_what_no_reader_sees_and_the_next_call_completes(tmp_path, monkeypatch):
    store, whole = open_store(tmp_path / "store", create=True), tmp_path / "whole"
    for run_id, recipe in (("a", OLD), ("b", OLD), ("a", OLDER), ("a", Recipe()), ("b", Recipe())):
        add_run(store, run_id, segments(run_id, *lanes(np.array([0.0]), -10.0, 10.0)), recipe=recipe)
    supersede(store, "b", "a")
    for manifest in store.root.glob("runs/*/*/manifest-1.json"):
        manifest.with_name("report.html").write_text(seal_page("<html></html>"))
    shutil.copytree(store.root, whole)
    removed = prune(store=store.root, recipe=Recipe(), min_age_s=0.0).removed
    assert len(removed) == 3
    wanted, step, begun = files(store), 0, set[str]()
    while True:
        shutil.rmtree(store.root)
        shutil.copytree(whole, store.root)
        with monkeypatch.context() as patch:
            kill_at(patch, step)
            try:
                prune(store=store.root, recipe=Recipe(), min_age_s=0.0)
            except KeyboardInterrupt:
                step += 1
            else:
                break
        assert not store.ingestions().lost, step
        problems = verify(store.root).problems
        told = "was left by a killed command; 'tcpipe prune' removes it"
        assert [line for line in problems if not line.endswith(told)] == [], step
        planned = prune(store=store.root, recipe=Recipe(), min_age_s=0.0, dry_run=True)
        done = prune(store=store.root, recipe=Recipe(), min_age_s=0.0)
        assert (done.removed, done.kept) == (planned.removed, ()), step
        assert files(store) == wanted, step
        assert verify(store.root).problems == ()
        begun |= {each.what for each in done.removed}
    assert step > 20
    assert begun >= {"left by a killed prune", "old recipe", "superseded run"}


def test_what_a_killed_prune_left_stays_where_it_was_ingested_again_and_while_it_is_young(store, monkeypatch):
    old = old_recipe(store)
    with monkeypatch.context() as patch:
        kill_at(patch, 0)
        with pytest.raises(KeyboardInterrupt):
            prune(store=store.root, recipe=Recipe())
    assert [run.recipe_id for run in store.recipes_of("a")] != [old]
    assert not [each for each in prune(store=store.root, recipe=Recipe()).removed if "/a/" in each.path]
    commit_run(store, "a")
    assert not [each for each in prune(store=store.root, recipe=Recipe(), min_age_s=0.0).removed if "/a/" in each.path]
    assert old in {run.recipe_id for run in store.recipes_of("a")}
    assert verify(store.root).problems == ()


@pytest.mark.parametrize("change", ["built", "ingested"])
def test_what_another_call_uses_or_makes_meanwhile_stays(store, monkeypatch, change):
    """It commits between the moment at which prune looks and its own commit."""
    log, old, real = open_log(store), old_recipe(store), prune_module._measure_size
    row = replace(log.state.runs["a", old], tags={"weather": "wet"})
    dataset = Dataset("/nowhere", "0" * 64, (("a", old),))

    def meanwhile(place):
        log.commit(change, Entries(datasets=(dataset,)) if change == "built" else Entries(runs=(row,)))
        monkeypatch.setattr(prune_module, "_measure_size", real)
        return real(place)

    monkeypatch.setattr(prune_module, "_measure_size", meanwhile)
    found = prune(store=store.root, recipe=Recipe())
    assert [each.stays for each in found.kept] == ["another call has changed its run meanwhile"]
    assert ("a", old) in store.state().runs
    assert verify(store.root).problems == ()


def test_earlier_generations_go_when_they_are_old_and_the_last_stays(store):
    add_run(store, "c", segments("c", *lanes(np.array([2.0]), -10.0, 5.0)), recipe=OLD)
    files = {path for path in store.root.glob("runs/c/**/*") if path.is_file()}
    prune(store=store.root, recipe=OLD, min_age_s=0.0)
    gone = {path.name for path in files if not path.exists()}
    assert gone == {"manifest-1.json", "segments.parquet"} | {"track.parquet", "rejections.parquet"}
    assert [run.segments().num_rows for run in store.recipes_of("c")] == [15]
    assert verify(store.root).problems == ()


def test_a_document_that_cannot_be_read_keeps_what_lies_beside_it_and_stops_nothing_else(store):
    for run_id in ("a", "c"):
        add_run(store, run_id, segments(run_id, *lanes(np.array([2.0]), -10.0, 5.0)), recipe=OLD)
    damaged = store.root / "runs" / "c" / old_recipe(store) / "manifest-2.json"
    damaged.write_bytes(b"")
    found = prune(store=store.root, recipe=OLD, min_age_s=0.0)
    assert {"manifest-1.json", "segments.parquet"} <= {each.path.rpartition("/")[2] for each in found.removed}
    assert not any("/runs/c/" in each.path for each in found.removed)
    assert {each.stays for each in found.kept} == {
        next(problem for problem in verify(store.root).problems if str(damaged) in problem)
    }
