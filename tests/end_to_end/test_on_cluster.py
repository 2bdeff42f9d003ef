"""Commands whose work a Dask cluster does: its scheduler and workers are processes that share the files alone with the caller."""

import pytest

pytest.importorskip("distributed", reason="the extra cluster is not installed")

from dask_cluster import dask_cluster
from installed_command import plain_lines, tcpipe
from stored_files import checksums

from tcpipe.simulation import Faults, make_tiny, simulate


def test_a_cluster_makes_the_bytes_that_this_machine_makes(tmp_path):
    site = simulate(tmp_path / "site", scenario=make_tiny(Faults.every()))
    logs = [path.relative_to(tmp_path) for path in site.logs]
    assert tcpipe("ingest", *logs, "--store", "here", cwd=tmp_path).returncode == 0
    with dask_cluster(tmp_path, workers=1) as cluster:
        there = tcpipe("ingest", *logs, "--store", "there", "--cluster", cluster.address, cwd=tmp_path)
    assert (there.returncode, "segments from" in there.stdout) == (0, True), there.stderr
    assert checksums(tmp_path / "there") == checksums(tmp_path / "here") != {}
    again = tcpipe("ingest", *logs, "--store", "there", "--cluster", cluster.address, cwd=tmp_path)
    assert "nothing to do" in again.stdout, "what needs no worker asks for none: the cluster is gone"
    gone = tcpipe("ingest", *logs, "--store", "there", "--force", cwd=tmp_path, env={"TCPIPE_CLUSTER": cluster.address})
    assert "no Dask scheduler answers" in plain_lines(gone, 2)
