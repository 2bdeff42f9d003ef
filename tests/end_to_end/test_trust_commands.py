"""verify, explain and diff as a user runs them, from a simulated log on; and a build that is killed half-way."""

import json
import os
import signal
import subprocess
import time

import pyarrow.parquet as pq
import pytest
from installed_command import COMMAND, plain_lines, tcpipe

from tcpipe.simulation import simulate


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    here = tmp_path_factory.mktemp("trust")
    site = simulate(here / "site", scenario="tiny", seed=3)
    layers = [item for name in ("height", "ortho", "terrain", "classes") for item in (f"--{name}", site.rasters[name])]
    for arguments in (("ingest", *site.logs), ("add-map", "site", *layers), ("build-dataset",)):
        done = tcpipe(*arguments, "--quiet", cwd=here)
        # so small a site is one block, and that is told: nothing tests
        assert (done.returncode, done.stderr[:24]) == (
            (3, "tcpipe: no sample tests:") if arguments == ("build-dataset",) else (0, "")
        )
    return here


@pytest.fixture(scope="module")
def ids(work):
    return pq.read_table(work / "dataset" / "samples.parquet")["sample_id"].to_pylist()


def test_verify_reads_everything_again(work):
    for path, kind in (("dataset", "dataset"), ("tcpipe-store", "store")):
        done = tcpipe("verify", path, cwd=work)
        assert done.returncode == 0, done.stdout
        (line,) = done.stdout.splitlines()
        assert f": {kind}; " in line
        assert line.endswith("all as it was written")


def test_verify_names_what_is_wrong_one_line_each_and_fails(work):
    path = work / "dataset" / "samples.parquet"
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + b"!")
    (work / "dataset" / "mine.txt").touch()
    try:
        done, as_json = tcpipe("verify", "dataset", cwd=work), tcpipe("verify", "dataset", "--json", cwd=work)
    finally:
        path.write_bytes(whole)
        (work / "dataset" / "mine.txt").unlink()
    assert (done.returncode, as_json.returncode) == (1, 1)
    head, *problems = done.stdout.splitlines()
    assert head.endswith(f"{len(problems)} problems")
    assert any(line.startswith("dataset/samples.parquet: its sha256 is") for line in problems)
    assert "dataset/mine.txt: is no file of this dataset" in problems
    assert json.loads(as_json.stdout)["problems"] == problems


def test_a_sample_is_traced_to_its_log_and_made_again_bit_for_bit(work, ids):
    done = tcpipe("explain", ids[0], "--quiet", cwd=work)
    assert done.returncode == 0, done.stdout
    lines = done.stdout.splitlines()
    assert lines[-1] == "made again from the streams: equal, bit for bit"
    assert {"labels", "log", "stamps", "messages", "map", "recipe", "versions"} <= {
        line.split()[0] for line in lines[1:-1]
    }
    found = json.loads(tcpipe("explain", ids[-1], "--json", "--quiet", cwd=work).stdout)
    assert found["differences"] == []
    facts, gnss = found["facts"], found["facts"]["messages"]["gnss"]
    assert facts["sample"]["start_ns"] <= gnss["first_ns"] <= gnss["last_ns"] < facts["sample"]["end_ns"]
    assert facts["log"]["paths"][0].endswith(".mcap")


def test_diff_names_cause_and_effect(work):
    same = tcpipe("diff", "dataset", "dataset", cwd=work)
    assert (same.returncode, len(same.stdout.splitlines())) == (0, 1)
    done = tcpipe("build-dataset", "other", "--holdout", "sample", "--quiet", cwd=work)
    assert done.returncode == 0, done.stderr
    other = tcpipe("diff", "dataset", "other", cwd=work)
    assert other.returncode == 1
    assert "recipe: split.holdout block → sample" in other.stdout.splitlines()
    found = json.loads(tcpipe("diff", "dataset", "other", "--json", cwd=work).stdout)
    assert (found["same"], found["causes"]) == (False, ["recipe: split.holdout block → sample"])
    assert found["samples"]["other patches"] == 0


def test_what_cannot_be_asked_is_said_in_a_line(work):
    plain_lines(tcpipe("verify", "nowhere", cwd=work), 2)
    plain_lines(tcpipe("explain", "no-such-sample", cwd=work), 1)
    plain_lines(tcpipe("diff", "dataset", "tcpipe-store", cwd=work), 2)


def test_a_build_that_is_killed_leaves_what_the_next_one_clears_away(work):
    before = sorted(path.name for path in work.iterdir())
    with subprocess.Popen(
        [COMMAND, "build-dataset", "killed", "--quiet"], cwd=work, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as building:
        while building.poll() is None and not any(work.glob(".tmp-killed-*/killed/spool")):
            time.sleep(0.01)
        os.kill(building.pid, signal.SIGKILL)
    assert building.returncode == -signal.SIGKILL, "it was done before it could be killed"
    assert not (work / "killed").exists()
    assert any(work.glob(".tmp-killed-*"))
    done = tcpipe("build-dataset", "killed", "--quiet", cwd=work)
    assert done.returncode == 3, done.stderr
    assert sorted(path.name for path in work.iterdir()) == sorted([*before, "killed"])
    assert tcpipe("verify", "killed", cwd=work).returncode == 0
