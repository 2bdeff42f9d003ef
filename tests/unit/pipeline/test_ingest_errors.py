"""Errors of an ingest name the output, or the log."""

import errno
import os

import pytest
from wheel_drives import drive_at

from tcpipe.execution import Outcome
from tcpipe.pipeline import ingest as ingest_module
from tcpipe.pipeline import ingest_run as module
from tcpipe.pipeline.ingest import ingest
from tcpipe.recipe import MaskConfig, Recipe, TimeWindow


@pytest.mark.parametrize("number", [errno.EACCES, errno.EIO, errno.ENOSPC])
def test_a_disk_that_fails_in_mid_write_is_told_with_the_output(tmp_path, monkeypatch, number):
    log, store = drive_at(tmp_path / "run.mcap"), tmp_path / "store"

    def fail(*_, **__):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("tcpipe.formats.parquet.pq.ParquetWriter.write_table", fail)
    (result,) = ingest([log], store=store).results
    (line,) = result.problems
    assert line == f"{log}: {store}/streams/wheel_odometry.parquet: cannot be written ({os.strerror(number)})"
    assert {path.parent.name for path in store.rglob("*") if path.is_file()} == {"calls", "seen"}, (
        "nothing is left by halves"
    )


def test_a_time_window_that_fits_no_run_is_told_with_the_runs(tmp_path, caplog):
    log = drive_at(tmp_path / "field_1.mcap")
    patterns = ("field_*", "feild_*")
    recipe = Recipe(mask=MaskConfig(windows=[TimeWindow(pattern, "drop", 0.0, 1.0) for pattern in patterns]))
    (result,) = ingest([log], store=tmp_path / "store", recipe=recipe).results
    (line,) = (record.getMessage() for record in caplog.records if "fits no run" in record.getMessage())
    assert "'feild_*'" in line
    assert line.endswith(f"runs: {result.run.run_id}")


def test_a_file_that_cannot_be_opened_is_named(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied", "/store/blobs/x")

    monkeypatch.setattr(module, "open_logs", fail)
    (tmp_path / "a.mcap").write_bytes(b"a")
    (result,) = ingest([tmp_path / "a.mcap"], store=tmp_path / "store").results
    assert result.problems == (f"{tmp_path / 'a.mcap'}: /store/blobs/x: Permission denied",)


def test_a_worker_that_is_killed_and_a_bug_cost_only_their_own_logs(tmp_path, monkeypatch, caplog):
    """Both are tried again, the bug with --retry-failed."""
    logs = [drive_at(tmp_path / f"{name}.mcap", seed=seed) for seed, name in enumerate(("good", "killed", "bug"))]
    stages = module.run_stages

    def run_all(act, tasks, **_):
        for index, task in enumerate(tasks):
            died = task.source.stem == "killed"
            yield Outcome(index, None if died else act(task), died=died)

    def run_stages(streams, sections, *, run_id):
        if run_id.startswith("bug"):
            raise ZeroDivisionError("boom")
        return stages(streams, sections, run_id=run_id)

    with monkeypatch.context() as patch, caplog.at_level("DEBUG", "tcpipe"):
        patch.setattr(ingest_module, "run_all", run_all)
        patch.setattr(module, "run_stages", run_stages)
        good, killed, bug = ingest(logs, store=tmp_path / "store").results
    assert (good.status, killed.status, bug.status) == ("done", "failed", "failed")
    assert killed.problems[0].startswith(f"{logs[1]}: its worker process died")
    assert bug.problems[0].startswith(f"{logs[2]}: internal error, ZeroDivisionError: boom")
    assert any(line.startswith(f"{logs[2]}: ") and "in run_stages" in line for line in caplog.messages), "--debug"
    again = ingest(logs, store=tmp_path / "store", retry_failed=True).results
    assert [result.status for result in again] == ["unchanged", "done", "done"]
