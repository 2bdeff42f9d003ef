"""Tasks of an array, as real processes: with staggered starts and killed tasks no log is left, and the store is that of one call."""

import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import pytest
from object_gateway import open_bucket
from wheel_drives import START_NS, ask_status, drive_at

from tcpipe.formats.place import Place
from tcpipe.pipeline import log_queue
from tcpipe.pipeline.calls import identify_process
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.log_queue import Claims, hold_claims
from tcpipe.recipe import Recipe
from tcpipe.store import open_store

TASK = """
import os, pathlib, signal, sys, time
from tcpipe.pipeline import log_queue as claims, ingest
from tcpipe.recipe import Recipe

logs, store, share, marks, deadly = sys.argv[1:]
claims.LEASE_S = 4.0
do = ingest.ingest_one

def ingest_one(task):
    pathlib.Path(marks, f"{task.source.stem}-{os.getpid()}").touch()
    time.sleep(0.2)
    if task.source.stem == deadly:
        os.kill(os.getpid(), signal.SIGKILL)
    return do(task)

ingest.ingest_one = ingest_one
sys.exit(ingest.ingest([logs], store=store, recipe=Recipe(), shard=(int(share[0]), 4)).exit_code)
"""
"""A task that is killed when it comes to a log."""


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    folder = tmp_path_factory.mktemp("array") / "logs"
    for number in range(6):
        rows = 1500 - 100 * (number % 3)
        drive_at(folder / f"{number}.mcap", seed=number, start_ns=START_NS + number * 10**13, rows=rows)
    shutil.copy(folder / "5.mcap", folder / "00.mcap")
    for path in folder.iterdir():
        os.utime(path, ns=(10**18, 10**18))
    ingest([folder], store=folder.parent / "store", recipe=Recipe())
    return folder


def read_runs(root):
    place = open_store(root).place.below("runs")
    return {entry.name: place.read(entry.name) for entry in place.entries()}


@pytest.fixture(params=["directory", "bucket", "gateway"])
def root(request, tmp_path, monkeypatch):
    """Where a store is to be."""
    if request.param == "directory":
        return tmp_path / "store"
    url = open_bucket(request.param, request, monkeypatch, tmp_path)
    return f"{url}/store"


def test_an_array_with_late_and_killed_tasks_makes_the_store_of_one_call(root, drives, tmp_path):
    (marks := tmp_path / "marks").mkdir()
    running = []
    for share, deadly in ((1, "3"), (2, "none"), (3, "none"), (4, "2")):
        line = [sys.executable, "-c", TASK, drives, root, str(share), marks, deadly]
        running.append(subprocess.Popen(list(map(str, line))))
        time.sleep(0.5)
    codes = [task.wait(timeout=120) for task in running]
    assert codes[:3] == [-9, 0, 0]
    assert codes[3] in (0, -9), "by then another task may have its log"
    assert read_runs(root) == read_runs(drives.parent / "store")
    assert open_store(root).place.entries("spool") == []
    begun = [mark.name.partition("-")[0] for mark in marks.iterdir()]
    assert {name for name in begun if begun.count(name) > 1} <= {"2", "3"}, "only logs of killed tasks are begun twice"
    assert ask_status(root, drives).counts == {"done": 7}


def test_a_task_lists_the_store_once_and_a_share_with_nothing_new_writes_nothing(tmp_path, drives, monkeypatch):
    listed = []
    for verb in ("entries", "folders", "files"):
        true = getattr(Place, verb)
        monkeypatch.setattr(
            Place, verb, lambda self, *of, true=true, **how: (listed.append(self.where(*of)), true(self, *of, **how))[1]
        )
    found = ingest([drives], store=tmp_path / "store", recipe=Recipe(), shard=(3, 4))
    assert [result.status for result in found.results].count("done") == 6
    whole = [str(tmp_path / "store" / name) for name in ("", "runs")]
    assert [where for where in listed if where in whole] == whole[1:], "once, to see that it is new"
    before = open_store(tmp_path / "store").place.entries()
    again = ingest([drives], store=tmp_path / "store", recipe=Recipe(), shard=(1, 4))
    assert [result.status for result in again.results] == ["unchanged"] * 2
    assert open_store(tmp_path / "store").place.entries() == before
    claim_elsewhere(tmp_path / "store", "killed after its commit", lease_s=-1.0)
    ingest([drives], store=tmp_path / "store", recipe=Recipe(), shard=(1, 4))
    assert open_store(tmp_path / "store").place.entries() == before


def claim_elsewhere(store, key, *, lease_s):
    """Claim as a task of another machine that has that long to go."""
    theirs = Claims(open_store(store, create=True).place.below("spool/claims"))
    theirs._process = replace(identify_process(), host="node7")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(log_queue, "LEASE_S", lease_s)
        assert theirs.claim(key, "log", take_over=True, most=9) == "mine"
    return theirs


def test_a_claim_is_taken_over_when_its_lease_is_over_and_a_killer_of_tasks_is_given_up(tmp_path):
    theirs = claim_elsewhere(tmp_path, "a", lease_s=60.0)
    with hold_claims(open_store(tmp_path).place) as mine:
        assert mine.claim("a", "log", take_over=True, most=3) == "theirs"
        theirs.release_all()
        assert mine.claim("a", "log", take_over=False, most=3) == "mine"
        mine.release("a")
        for _ in range(3):
            claim_elsewhere(tmp_path, "a", lease_s=-1.0)
        assert mine.claim("a", "log", take_over=False, most=3) == "theirs"
        assert mine.claim("a", "log", take_over=True, most=3) == "given up"
        assert mine.claim("a", "log", take_over=True, most=9) == "mine"
        assert len(mine._place.files()) == 4
    assert not (tmp_path / "spool").exists()


def test_a_store_without_runs_stays_while_another_task_is_at_it(tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "junk.mcap").write_bytes(b"junk")

    def try_junk(elsewhere):
        ingest([tmp_path / "logs"], store=tmp_path / "store", recipe=Recipe(), on_found=elsewhere)
        return (tmp_path / "store" / "log").exists()

    assert not try_junk(None)
    assert try_junk(lambda _: claim_elsewhere(tmp_path / "store", "a", lease_s=60.0))


def test_a_task_that_lives_renews_its_claims(tmp_path, monkeypatch):
    monkeypatch.setattr(log_queue, "LEASE_S", 0.4)
    place = open_store(tmp_path, create=True).place
    with hold_claims(place) as mine:
        mine._process = replace(identify_process(), host="node7")
        mine.claim("a", "log", take_over=False, most=1)
        time.sleep(1.0)
        with hold_claims(place) as other:
            assert other.claim("a", "log", take_over=True, most=9) == "theirs"


def test_the_first_idle_task_waits_for_claims_of_others_and_the_next_ends(tmp_path, drives, monkeypatch):
    theirs, claim = list[Claims](), Claims.claim

    def be_late(self, key, log, **how):
        if log.endswith("4.mcap") and not theirs:
            theirs.append(claim_elsewhere(tmp_path / "store", key, lease_s=600.0))
        return claim(self, key, log, **how)

    def list_waiting(share):
        found = ingest([drives], store=tmp_path / "store", recipe=Recipe(), shard=(share, 2))
        assert found.exit_code == 0
        return [(of.log[-6:], *of.notes) for of in found.results if of.status == "waiting"]

    monkeypatch.setattr(Claims, "claim", be_late)
    with monkeypatch.context() as patch:
        patch.setattr(log_queue.LogQueue, "_wait", lambda _: False)
        assert list_waiting(1) == []
        assert list_waiting(2) == [("4.mcap", "another task of the array ingests it")]
    monkeypatch.setattr(log_queue, "LEASE_S", 1.0)
    theirs[0].renew()
    assert list_waiting(1) == []
    assert read_runs(tmp_path / "store") == read_runs(drives.parent / "store")
