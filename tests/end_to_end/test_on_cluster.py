"""Commands whose work a Dask cluster does: its scheduler and workers are processes that share the files alone with the caller."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="the extra cluster is not installed")

from dask_cluster import dask_cluster
from installed_command import plain_lines, tcpipe

from tcpipe.pipeline.dataset import sampling
from tcpipe.pipeline.maps import add_map
from tcpipe.simulation import Faults, make_tiny, simulate

KILLED = """
import os, signal, sys
from tcpipe.pipeline.dataset import sampling
from tcpipe.pipeline.dataset.build import build_dataset
def sound(outcome):
    if outcome.index == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return outcome.result
sampling.unwrap_result, sampling._BATCH_ROWS = sound, int(sys.argv[2])
build_dataset("far", store="there", cluster=sys.argv[1])
"""
"""A build that is killed when the second batch is there."""


def _files(directory: Path) -> dict[str, bytes]:
    """The files but for the history and the index, which hold times and inodes."""
    files = (path for path in directory.rglob("*") if path.is_file() and path.parent.name not in ("log", "index"))
    return {str(path.relative_to(directory)): path.read_bytes() for path in files}


def test_a_cluster_makes_the_bytes_that_this_machine_makes(tmp_path, monkeypatch):
    site = simulate(tmp_path / "site", scenario=make_tiny(Faults.every()))
    logs = [path.relative_to(tmp_path) for path in site.logs]
    assert tcpipe("ingest", *logs, "--store", "here", cwd=tmp_path).returncode == 0
    with dask_cluster(tmp_path, workers=1) as cluster:
        there = tcpipe("ingest", *logs, "--store", "there", "--cluster", cluster.address, cwd=tmp_path)
        add_map("site", **site.rasters, store=tmp_path / "there")
        monkeypatch.setattr(sampling, "_BATCH_ROWS", 3)
        killed = subprocess.run([sys.executable, "-c", KILLED, cluster.address, "3"], cwd=tmp_path, check=False)
        assert killed.returncode == -signal.SIGKILL
        built = tcpipe("build-dataset", "far", "--store", "there", "--cluster", cluster.address, cwd=tmp_path)
    assert "resuming: " in built.stderr
    assert not (tmp_path / "there" / "spool").exists()
    monkeypatch.undo()
    tcpipe("build-dataset", "near", "--store", "there", cwd=tmp_path)
    assert (built.returncode, _files(tmp_path / "far")) == (3, _files(tmp_path / "near")), built.stderr
    assert (there.returncode, "segments from" in there.stdout) == (0, True), there.stderr
    assert _files(tmp_path / "there" / "runs") == _files(tmp_path / "here" / "runs")
    again = tcpipe("ingest", *logs, "--store", "there", "--cluster", cluster.address, cwd=tmp_path)
    assert "nothing to do" in again.stdout, "what needs no worker asks for none: the cluster is gone"
    gone = tcpipe("ingest", *logs, "--store", "there", "--force", cwd=tmp_path, env={"TCPIPE_CLUSTER": cluster.address})
    assert "no Dask scheduler answers" in plain_lines(gone, 2)
