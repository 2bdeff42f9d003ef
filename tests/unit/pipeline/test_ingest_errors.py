"""Errors of an ingest name the output, or the log."""

import errno
import os

import pytest
from simulated_streams import log_of

from tcpipe.pipeline import ingest_run as module
from tcpipe.pipeline.ingest import ingest
from tcpipe.recipe import MaskConfig, Recipe, TimeWindow
from tcpipe.simulation import make_tiny


@pytest.mark.parametrize("number", [errno.EACCES, errno.EIO, errno.ENOSPC])
def test_a_disk_that_fails_in_mid_write_is_told_with_the_output(tmp_path, monkeypatch, number):
    scenario = make_tiny(seconds=16.0)
    log, store = log_of(scenario, scenario.drives[0], tmp_path / "site"), tmp_path / "store"

    def fail(*_, **__):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("tcpipe.formats.parquet.pq.ParquetWriter.write_table", fail)
    (result,) = ingest([log], store=store).results
    (line,) = result.problems
    assert line == f"{log}: {store}/streams/gnss.parquet: cannot be written ({os.strerror(number)})"
    assert {path.parent.name for path in store.rglob("*") if path.is_file()} == {"calls", "seen"}, (
        "nothing is left by halves"
    )


def test_a_time_window_that_fits_no_run_is_told_with_the_runs(tmp_path, caplog):
    scenario = make_tiny(seconds=16.0)
    log = log_of(scenario, scenario.drives[0], tmp_path / "site")
    patterns = (f"{log.stem[:3]}*", "feild_*")
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
