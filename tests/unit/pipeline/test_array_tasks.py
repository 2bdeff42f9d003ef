"""Tasks of an array, as real processes: one call after them ingests what killed tasks left."""

import os
import shutil
import subprocess
import sys
import time

import pytest
from object_gateway import open_bucket
from wheel_drives import START_NS, ask_status, drive_at

from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.log_sources import list_log_sources, select_shard
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe
from tcpipe.store import open_store

TASK = """
import os, pathlib, signal, sys, time
from tcpipe.pipeline import ingest
from tcpipe.recipe import Recipe

logs, store, share, marks, deadly = sys.argv[1:]
do = ingest.ingest_one

def ingest_one(task):
    pathlib.Path(marks, f"{task.source.stem}-{os.getpid()}").touch()
    time.sleep(0.2)
    if task.source.stem == deadly:
        os.kill(os.getpid(), signal.SIGKILL)
    return do(task)

ingest.ingest_one = ingest_one
sys.exit(ingest.ingest([logs], store=store, recipe=Recipe(), shard=(int(share), 3)).exit_code)
"""
"""A task that is killed when it comes to a log."""


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    folder = tmp_path_factory.mktemp("array") / "logs"
    for number in range(4):
        rows = 1500 - 100 * (number % 3)
        drive_at(folder / f"{number}.mcap", seed=number, start_ns=START_NS + number * 10**13, rows=rows)
    shutil.copy(folder / "3.mcap", folder / "00.mcap")
    for path in folder.iterdir():
        os.utime(path, ns=(10**18, 10**18))
    ingest([folder], store=folder.parent / "store", recipe=Recipe())
    return folder


@pytest.fixture(params=["directory", "gateway"])
def root(request, tmp_path, monkeypatch):
    """Where a store is to be."""
    if request.param == "directory":
        return tmp_path / "store"
    url = open_bucket(request.param, request, monkeypatch, tmp_path)
    return f"{url}/store"


def test_one_call_after_an_array_ingests_what_its_killed_tasks_left(root, drives, tmp_path):
    (marks := tmp_path / "marks").mkdir()
    sources = list_log_sources([drives], as_one=False, staging=tmp_path).sources
    own = {share: [sources[at].stem for at in select_shard(sources, (share, 3))] for share in range(1, 4)}
    deadly = {share: own[share][-1] for share in sorted(own, key=lambda share: len(own[share]))[-2:]}
    running = []
    for share in own:
        line = [sys.executable, "-c", TASK, drives, root, str(share), marks, deadly.get(share, "none")]
        running.append(subprocess.Popen(list(map(str, line))))
        time.sleep(0.5)
    codes = [task.wait(timeout=120) for task in running]
    assert codes == [-9 if share in deadly else 0 for share in own]
    assert ingest([drives], store=root, recipe=Recipe()).exit_code == 0
    assert ask_status(root, drives).counts == {"done": 5}
    assert verify(root).problems == ()
    assert len(open_store(root).runs()) == 4, "two of the logs are copies of one"
