"""Every call on a store is recorded: how it ended and why; one that was killed is a problem until another has done its work."""

import json
import os
import shutil
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest
from click.testing import CliRunner
from wheel_drives import START_NS, ask_status, drive_at

from tcpipe.cli import cli
from tcpipe.errors import StoreError, TcpipeError
from tcpipe.formats.runs import Call
from tcpipe.pipeline import calls
from tcpipe.pipeline import ingest as ingest_module
from tcpipe.pipeline.calls import identify_process, list_open_calls, record_call
from tcpipe.pipeline.ingest import CallOptions, ingest
from tcpipe.pipeline.problems import acknowledge
from tcpipe.recipe import LabelConfig, Recipe
from tcpipe.store import open_store

NIGHT_S = 86_400


@pytest.fixture
def root(tmp_path):
    """Where a store is to be."""
    return tmp_path / "store"


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
    """End an ingest as a kill does, past all error handlers, with a process that is gone."""

    def died(*_, **__):
        raise SystemExit

    with monkeypatch.context() as patch, suppress(SystemExit):
        patch.setattr(ingest_module, "_iterate_results", died)
        patch.setattr(calls, "identify_process", lambda: replace(identify_process(), start="1"))
        ingest([logs], store=store, **{"recipe": Recipe(), **how})


def test_a_first_night_that_is_killed_is_a_problem_and_the_next_one_deals_with_it(tmp_path, logs, monkeypatch):
    kill(logs, tmp_path / "store", monkeypatch)
    found = CliRunner().invoke(cli, ["status", str(tmp_path / "store"), "--json"], standalone_mode=False)
    assert found.return_value == 3
    (finding,) = json.loads(found.stdout)["problems"]
    assert (finding["code"], finding["names"]["command"]) == ("call-killed", "ingest")
    lines = CliRunner().invoke(cli, ["status", str(tmp_path / "store")], standalone_mode=False).stderr
    (killed,) = ask_status(tmp_path / "store").open_calls
    assert f"was killed. To acknowledge it: 'tcpipe acknowledge {killed.name}' [call-killed]" in lines
    assert json.loads(found.stdout)["counts"] == {"pending": 2}
    assert ingest([logs], store=tmp_path / "store", recipe=Recipe()).exit_code == 0
    assert (ask_status(tmp_path / "store").exit_code, ask_status(tmp_path / "store").open_calls) == (0, ())


def read_calls(root):
    """Return command, exit code and the first words of the message of each call, the earliest first."""
    calls_of = [call for _, call in reversed(open_store(root).scan().calls)]
    return [(call.command, call.exit_code, call.message.partition(":")[0]) for call in calls_of]


def test_every_call_is_recorded_with_its_exit_code_and_message_also_one_that_is_refused_at_once(root, logs):
    ingest([logs], store=root, recipe=Recipe())
    ingest([logs], store=root, recipe=Recipe())
    junk = logs / "junk.bag"
    junk.write_bytes(b"junk" * 100)
    assert ingest([logs], store=root, recipe=Recipe()).exit_code == 3
    wrong = [
        lambda: ingest([logs], store=root, recipe=Recipe(), robot="nosuch"),
        lambda: ingest([logs / "gone"], store=root, recipe=Recipe()),
        lambda: ingest([logs], store=root, recipe=logs / "nosuch.toml"),
        lambda: acknowledge(["nosuch"], store=root),
    ]
    for call in wrong:
        with pytest.raises(TcpipeError):
            call()
    assert acknowledge([str(junk)], store=root).acknowledged
    found = read_calls(root)
    assert [call[:2] for call in found] == [
        ("ingest", 0), ("ingest", 0), ("ingest", 3), ("ingest", 2), ("ingest", 2), ("ingest", 2), ("acknowledge", 2), ("acknowledge", 0),
    ]  # fmt: skip
    assert [message for _, _, message in found[2:7]] == [
        str(junk), "robot 'nosuch' is not known; known", str(logs / "gone"), str(logs / "nosuch.toml"), "nosuch",
    ]  # fmt: skip
    assert [call.exit_code for call in ask_status(root).history] == [code for _, code, _ in reversed(found)]
    assert f"exit code 3: {junk}: " in str(ask_status(root))
    assert ask_status(root).open_calls == ()


def test_an_internal_error_ends_a_call_with_exit_code_1(root, logs, monkeypatch):
    ingest([logs / "one.mcap"], store=root, recipe=Recipe())
    monkeypatch.setattr(ingest_module, "plan_ingestion", lambda *_: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        ingest([logs], store=root, recipe=Recipe())
    assert read_calls(root)[-1] == ("ingest", 1, "ZeroDivisionError")


@pytest.mark.parametrize("how", ["robot", "log", "recipe", "existing store"])
def test_a_call_that_is_refused_on_a_new_store_creates_nothing(tmp_path, logs, how, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wrong = {
        "robot": {"robot": "nosuch"},
        "log": {"logs": [tmp_path / "gone"]},
        "recipe": {"recipe": tmp_path / "nosuch.toml"},
        "existing store": {"existing_store": True},
    }
    told = []
    with pytest.raises(TcpipeError):
        ingest(**{"logs": [logs], "store": tmp_path / "new", "recipe": Recipe(), "on_note": told.append, **wrong[how]})
    assert told == []
    assert not (tmp_path / "new").exists()


def test_a_store_that_has_to_be_there_and_is_not_is_one_line_and_a_new_one_is_said(root, logs):
    told = []
    with pytest.raises(TcpipeError) as caught:
        ingest([logs], store=root, recipe=Recipe(), existing_store=True, on_note=told.append)
    assert caught.value.problems == (f"{root}: there is no store here (--existing-store); is a disk not mounted?",)
    assert (caught.value.exit_code, told) == (1, [])
    for _ in range(2):
        assert ingest([logs / "one.mcap"], store=root, recipe=Recipe(), on_note=told.append).exit_code == 0
    assert told == [f"new store: {root}"]
    assert ingest([logs], store=root, recipe=Recipe(), existing_store=True, on_note=told.append).exit_code == 0
    assert len(told) == 1


def test_a_call_that_runs_is_no_problem(root, logs):
    assert ingest([logs], store=root, recipe=Recipe()).exit_code == 0
    with record_call(open_store(root), "ingest", [str(logs)], CallOptions()):
        found = ask_status(root)
        assert (found.exit_code, [call.state for call in found.open_calls]) == (0, ["running"])
        assert "running: ingest of 20" in str(found)
    assert ask_status(root).open_calls == ()


def test_a_killed_call_is_told_until_the_same_work_is_done(root, logs, monkeypatch):
    kill(logs, root, monkeypatch)
    assert ask_status(root).exit_code == 3
    ingest([logs / "one.mcap"], store=root, recipe=Recipe())
    ingest([logs], store=root, recipe=Recipe(), robot="jackal")
    assert len(list_open_calls(open_store(root).scan())) == 1, "other logs, another robot: none is its work"
    ingest([logs], store=root, recipe=Recipe(), shard=(1, 1))
    assert ask_status(root).exit_code == 3, "a task of an array does its share alone"
    ingest([logs], store=root, recipe=Recipe())
    assert ask_status(root).exit_code == 0
    kill(logs, root, monkeypatch, shard=(1, 1), force=True)
    assert ask_status(root).exit_code == 3
    assert ingest([logs.parent / "logs"], store=root, recipe=Recipe()).exit_code == 0
    assert ask_status(root).exit_code == 0
    kill(logs / "two.mcap", root, monkeypatch, force=True)
    ingest([logs], store=root, recipe=Recipe())
    assert ask_status(root).exit_code == 0, "a folder is all the logs in it"


def test_a_killed_call_is_not_closed_by_one_under_another_recipe(root, logs, monkeypatch):
    kill(logs, root, monkeypatch)
    ingest([logs], store=root, recipe=Recipe(label=LabelConfig(velocity="fused")))
    assert [call.state for call in list_open_calls(open_store(root).scan())] == ["killed"]
    assert ask_status(root).counts == {"outdated": 2}, "status asks under the recipe that rules now"
    ingest([logs], store=root, recipe=Recipe())
    assert list_open_calls(open_store(root).scan()) == []


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
    begun = Call(command="ingest", version="2", works_on=("/logs",), process=replace(here, **other), begin=begin)
    store.put(store.scan(), "calls", f"{1:016x}", begun)
    (call,) = list_open_calls(store.scan())
    assert call.state == state
    if state == "killed":
        assert call.problem.finding.code == ("call-lost" if "host" in other else "call-killed")


def test_a_store_that_cannot_be_written_is_built_from_and_asked_as_ever(tmp_path, logs, monkeypatch):
    ingest([logs], store=tmp_path / "store", recipe=Recipe())
    store = open_store(tmp_path / "store")

    def refused(*_, **__):
        raise StoreError("read-only")

    for verb in ("put", "put_files", "delete"):
        monkeypatch.setattr(type(store.place), verb, refused)
    with record_call(store, "build-dataset", ["/out"]):
        assert list_open_calls(store.scan()) == []
    assert ask_status(tmp_path / "store").exit_code == 0
    assert ingest([logs], store=tmp_path / "store", recipe=Recipe()).exit_code == 0, "there is nothing new"
    drive_at(logs / "later.mcap", seed=7)
    monkeypatch.setattr(ingest_module, "ingest_one", lambda *_: pytest.fail("it is read before that is known"))
    with pytest.raises(StoreError, match="read-only"):
        ingest([logs], store=tmp_path / "store", recipe=Recipe())


# --- the options of a call ------------------------------------------------------------------------------------------


def test_status_without_logs_asks_with_the_options_that_the_latest_call_was_given(tmp_path, logs):
    store = tmp_path / "store"
    assert ingest([logs], store=store, recipe=Recipe(), robot="jackal").exit_code == 0
    assert ask_status(store).counts == {"done": 2}
    assert ask_status(store, logs).counts == {"outdated": 2}, "who names the logs names the options, too"
    assert ingest([logs], store=store, recipe=Recipe()).exit_code == 0
    assert ask_status(store).counts == {"done": 2}
