"""A call that was killed is a problem until a later one has done its work, or somebody accepts it; one that runs is none."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import nullcontext, suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import pytest
from click.testing import CliRunner
from object_gateway import open_bucket
from tcpipe.formats.commits import Begun, Entries
from wheel_drives import START_NS, ask_status, drive_at

from tcpipe.cli import cli
from tcpipe.errors import StoreError, UsageError
from tcpipe.pipeline import calls
from tcpipe.pipeline import ingest as ingest_module
from tcpipe.pipeline import status as status_module
from tcpipe.pipeline.calls import commit_call, identify_process, list_begun_calls, open_log
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.problems import acknowledge
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import ReadConfig, Recipe
from tcpipe.store import open_store

OTHER = replace(Recipe(), read=ReadConfig(ignore_topics=["/none"]))
NIGHT_S = 86_400


@pytest.fixture(params=["directory", "bucket"])
def root(request, tmp_path, monkeypatch):
    """Where a store is to be."""
    if request.param == "directory":
        return tmp_path / "store"
    url = open_bucket(request.param, request, monkeypatch, tmp_path)
    return f"{url}/store"


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    folder = tmp_path_factory.mktemp("killed")
    drive_at(folder / "one.mcap")
    drive_at(folder / "two.mcap", seed=1, start_ns=START_NS + 10**13)
    return folder


@pytest.fixture
def logs(drives, tmp_path):
    """Two logs that were written long ago."""
    shutil.copytree(drives, tmp_path / "logs")
    for path in (tmp_path / "logs").iterdir():
        os.utime(path, ns=(10**18, 10**18))
    return tmp_path / "logs"


def kill(logs, store, monkeypatch, **how):
    """Let an ingest end as if it were killed, by what no handler of errors sees, and its process be gone."""

    def died(*_, **__):
        raise SystemExit

    with monkeypatch.context() as patch, suppress(SystemExit):
        patch.setattr(ingest_module, "_iterate_results", died)
        patch.setattr(ingest_module, "remove_if_empty", lambda _: nullcontext())
        patch.setattr(calls, "identify_process", lambda: replace(identify_process(), start="1"))
        ingest([logs], store=store, **{"recipe": Recipe(), **how})


def test_a_first_night_that_is_killed_is_a_problem_and_the_next_one_deals_with_it(tmp_path, logs):
    code = (
        "import os, signal, sys; from tcpipe.pipeline import ingest; from tcpipe.recipe import Recipe\n"
        "ingest._iterate_results = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)\n"
        "ingest.ingest([sys.argv[1]], store=sys.argv[2], recipe=Recipe())"
    )
    done = subprocess.run([sys.executable, "-c", code, logs, tmp_path / "store"], check=False)
    assert done.returncode == -9
    found = CliRunner().invoke(cli, ["status", str(tmp_path / "store"), "--json"], standalone_mode=False)
    assert found.return_value == 3
    (finding,) = json.loads(found.stdout)["problems"]
    assert (finding["code"], finding["names"]["command"]) == ("call-killed", "ingest")
    lines = CliRunner().invoke(cli, ["status", str(tmp_path / "store")], standalone_mode=False).stderr
    assert "was killed. To acknowledge it: 'tcpipe acknowledge call-1' [call-killed]" in lines
    assert json.loads(found.stdout)["counts"] == {"pending": 2}
    assert ingest([logs], store=tmp_path / "store", recipe=Recipe()).exit_code == 0
    assert (ask_status(tmp_path / "store").exit_code, ask_status(tmp_path / "store").begun) == (0, ())


def test_a_call_that_runs_is_no_problem_and_one_with_nothing_to_do_writes_nothing(root, logs):
    assert ingest([logs], store=root, recipe=Recipe()).exit_code == 0
    store = open_store(root)
    with commit_call(open_log(store), "ingest", [str(logs)]):
        found = ask_status(root)
        assert (found.exit_code, [call.state for call in found.begun]) == (0, ["running"])
        assert "running: ingest of 20" in str(found)
    before = store.place.entries()
    again = ingest([logs], store=root, recipe=Recipe())
    assert [result.status for result in again.results] == ["unchanged"] * 2
    assert store.place.entries() == before
    assert verify(root).problems == ()


def test_a_killed_call_is_told_until_the_same_work_is_done(root, logs, monkeypatch):
    kill(logs, root, monkeypatch)
    assert ask_status(root).exit_code == 3
    ingest([logs / "one.mcap"], store=root, recipe=Recipe())
    ingest([logs], store=root, recipe=OTHER)
    assert len(list_begun_calls(open_store(root).state())) == 1, "other logs, another recipe: none is its work"
    ingest([logs], store=root, recipe=Recipe(), shard=(2, 2))
    assert ask_status(root).exit_code == 3, "a task of an array does its share alone"
    ingest([logs], store=root, recipe=Recipe())
    assert ask_status(root).exit_code == 0
    kill(logs, root, monkeypatch, shard=(2, 2), force=True)
    assert ask_status(root).exit_code == 3
    assert ingest([logs.parent / "logs"], store=root, recipe=Recipe()).exit_code == 0
    assert ask_status(root).exit_code == 0
    kill(logs / "two.mcap", root, monkeypatch, force=True)
    ingest([logs], store=root, recipe=Recipe())
    assert ask_status(root).exit_code == 0, "a folder is all the logs in it"


def test_a_killed_call_may_be_acknowledged_and_the_next_one_is_told_again(root, logs, monkeypatch):
    kill(logs, root, monkeypatch)
    (call,) = ask_status(root).begun
    with pytest.raises(UsageError, match="nosuch: is no run or log with a known problem"):
        acknowledge(["nosuch"], store=root)
    assert [of.finding.code for of in acknowledge([call.name], store=root).acknowledged] == ["call-killed"]
    assert (ask_status(root).exit_code, ask_status(root).begun) == (0, ())
    kill(logs, root, monkeypatch)
    assert ask_status(root).exit_code == 3


def test_an_error_ends_a_call_and_an_interrupt_leaves_it(tmp_path):
    store = open_store(tmp_path, create=True)
    for error, left in ((StoreError("full"), 0), (KeyboardInterrupt(), 1)):
        with suppress(StoreError, KeyboardInterrupt), commit_call(open_log(store), "ingest", ["/logs"]):
            raise error
        assert len(list_begun_calls(store.state())) == left


HERE = {"host": "lab", "machine": "m", "boot": "b", "namespace": "pid:[1]", "pid": os.getpid()}


@pytest.mark.parametrize(
    ("other", "age_s", "state"),
    [
        ({}, 0, "running"),
        ({}, 9 * NIGHT_S, "running"),
        ({"start": "1"}, 0, "killed"),  # its number was given to another process since
        ({"pid": 2**22 + 1}, 0, "killed"),
        ({"boot": "a"}, 0, "killed"),  # the power was lost
        ({"host": "node7"}, 60, "perhaps running"),
        ({"host": "node7"}, NIGHT_S + 60, "killed"),
        ({"host": "node7"}, -600, "perhaps running"),  # its clock is ahead
        ({"host": "node7"}, -900 * NIGHT_S, "killed"),
        ({"machine": "another of this name"}, 60, "perhaps running"),
        ({"namespace": "pid:[2]"}, 60, "perhaps running"),  # a container
        ({"boot": "", "start": ""}, 60, "perhaps running"),  # no Linux
    ],
)
def test_a_call_that_runs_is_told_from_a_killed_one_as_far_as_can_be_seen(tmp_path, monkeypatch, other, age_s, state):
    here = replace(identify_process(), **HERE)
    monkeypatch.setattr(calls, "identify_process", lambda: here)
    begin = (datetime.now(UTC) - timedelta(seconds=age_s)).isoformat(timespec="milliseconds")
    store = open_store(tmp_path, create=True)
    begun = Begun("ingest", "0.9", ("/logs",), "", 1, begin, replace(here, **other))
    open_log(store).commit("begun", Entries(begun=(begun,)))
    (call,) = list_begun_calls(store.state())
    assert call.state == state
    if state == "killed":
        assert call.problem.finding.code == ("call-lost" if "host" in other else "call-killed")


def test_logs_that_nobody_takes_in_for_more_than_two_nights_are_a_problem(tmp_path, logs, monkeypatch):
    store, now_ns = tmp_path / "store", status_module.time.time_ns
    ingest([logs], store=store, recipe=Recipe())
    drive_at(logs / "new.mcap", seed=2, start_ns=START_NS + 10**14)
    drive_at(logs / "future.mcap", seed=3, start_ns=START_NS + 2 * 10**14)
    os.utime(logs / "new.mcap", ns=(10**18, 10**18))
    os.utime(logs / "future.mcap", ns=(4 * 10**18, 4 * 10**18))

    def after(nights):
        later = SimpleNamespace(time_ns=lambda: now_ns() + nights * NIGHT_S * 10**9 + 10**9)
        monkeypatch.setattr(status_module, "time", later)
        return ask_status(store)

    assert after(0).exit_code == 0, "a copy keeps its old modification time; it came today"
    assert after(1).exit_code == 0
    found = after(2)
    assert (found.exit_code, found.counts) == (3, {"done": 2, "pending": 1, "growing": 1})
    assert {(of.code, of.subject.name, of.names["state"]) for of in found.problems} == {
        ("log-waiting", str(logs / "new.mcap"), "pending"),
        ("log-waiting", str(logs / "future.mcap"), "growing"),
    }
    with commit_call(open_log(open_store(store)), "ingest", [str(logs)]):
        assert after(2).exit_code == 0, "somebody is at it"
    elsewhere = drive_at(tmp_path / "archive" / "old.mcap", seed=4)
    os.utime(elsewhere, ns=(10**18, 10**18))
    monkeypatch.setattr(status_module, "time", SimpleNamespace(time_ns=lambda: now_ns() + 9 * NIGHT_S * 10**9))
    assert ask_status(store, elsewhere.parent).exit_code == 0, "no ingest was asked for it"
    acknowledge([str(logs / "new.mcap"), str(logs / "future.mcap")], store=store)
    assert after(9).exit_code == 0
    os.utime(logs / "future.mcap")
    assert ingest([logs], store=store, recipe=Recipe()).exit_code == 0
    assert after(9).counts == {"done": 4}


def test_a_store_that_cannot_be_written_is_built_from_and_asked_as_ever(tmp_path, logs, monkeypatch):
    ingest([logs], store=tmp_path / "store", recipe=Recipe())
    store = open_store(tmp_path / "store")

    def refused(*_, **__):
        raise StoreError("read-only")

    for verb in ("put", "put_new", "delete"):
        monkeypatch.setattr(type(store.place), verb, refused)
    with commit_call(open_log(store), "build-dataset", ["/out"]):
        assert list_begun_calls(store.state()) == []
    assert ask_status(tmp_path / "store").exit_code == 0
    assert ingest([logs], store=tmp_path / "store", recipe=Recipe()).exit_code == 0, "there is nothing new"
    drive_at(logs / "later.mcap", seed=7)
    with pytest.raises(StoreError, match="read-only; name another with --store"):
        ingest([logs], store=tmp_path / "store", recipe=Recipe())
