"""What a command that fails prints with ``--json``: a scheduler reads there whether to try again."""

import errno
import json
import os
import signal
import sys

import pytest
from installed_command import tcpipe

from tcpipe.__main__ import main
from tcpipe.cli import Terminated
from tcpipe.errors import DatasetError, MapError, RecipeError, StoreError, UsageError
from tcpipe.pipeline.ingest import IngestSummary
from tcpipe.pipeline.plan import IngestResult

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "store")


def raised_from(error, cause):
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "code", "transient"),
    [
        (UsageError("--split: no such file"), 2, False),
        (raised_from(UsageError("store: cannot be listed"), FULL), 2, False),
        (RecipeError("recipe fuse.foo: unknown key"), 2, False),
        (MapError("dem.tif: has no CRS"), 1, False),
        (DatasetError("dataset: no runs"), 1, False),
        (ModuleNotFoundError("No module named 'lightgbm'", name="lightgbm"), 1, False),
        (ZeroDivisionError("a bug"), 1, False),
        (FULL, 1, True),
        (raised_from(StoreError("store: cannot be written"), FULL), 1, True),
        (MemoryError(), 1, True),
        (KeyboardInterrupt(), 130, True),
        (Terminated(signal.SIGTERM), 143, True),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_a_failure_states_whether_the_same_call_may_succeed_later(error, code, transient, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("tcpipe.pipeline.dataset.build.run_build_dataset", fail)
    monkeypatch.setattr("tcpipe.pipeline.maps.run_add_map", fail)
    for command in (["build-dataset"], ["add-map", "site", "--height", "dem.tif"]):
        done = tcpipe(*command, "--json", cwd=tmp_path)
        answer = json.loads(done.stdout)
        assert (done.returncode, answer["kind"], answer["exit_code"]) == (code, "failure", code)
        assert answer["transient"] is transient
        assert [f"tcpipe: {problem}" for problem in answer["problems"]] == done.stderr.strip().splitlines()


def test_a_wrong_option_is_a_failure_that_does_not_pass(tmp_path):
    done = tcpipe("ingest", "log.mcap", "--nosuch", "--json", cwd=tmp_path)
    answer = json.loads(done.stdout)
    assert (answer["kind"], answer["exit_code"], answer["transient"]) == ("failure", 2, False)


@pytest.mark.parametrize("causes", [(), (False,), (False, True)])
def test_the_summary_of_ingest_states_whether_the_same_call_may_succeed_later(causes, tmp_path, monkeypatch):
    results = tuple(IngestResult(f"{number}.mcap", "failed", transient=is_so) for number, is_so in enumerate(causes))
    monkeypatch.setattr("tcpipe.pipeline.ingest.run_ingest", lambda _: IngestSummary(tmp_path, results))
    (tmp_path / "log.mcap").touch()
    summary = json.loads(tcpipe("ingest", "log.mcap", "--json", cwd=tmp_path).stdout.splitlines()[-1])
    assert (summary["kind"], summary["transient"]) == ("summary", any(causes))


class Interrupted:
    """A finder during which the user presses Ctrl-C."""

    def find_spec(self, name, *_):
        if name == "tcpipe.cli":
            raise KeyboardInterrupt


def test_an_interrupt_while_the_command_line_is_loaded_ends_in_one_line(monkeypatch, capsys):
    monkeypatch.delitem(sys.modules, "tcpipe.cli")
    monkeypatch.setattr(sys, "meta_path", [Interrupted(), *sys.meta_path])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130
    assert capsys.readouterr().err == "tcpipe: interrupted before the command began\n"
