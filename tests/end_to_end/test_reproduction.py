"""Train, evaluate and reproduce through the installed command, from a simulated site to the claims."""

import json
import re
import shutil
from dataclasses import replace
from unittest.mock import patch

import pytest
from installed_command import tcpipe

from tcpipe.simulation import find_scenario, scenarios

pytest.importorskip("torch")

ENV = {"OMP_NUM_THREADS": "1"}
LENGTH_M = 100.0
"""Length of the three drives [m]; `tcpipe reproduce --size quick` drives 190 m."""

OWN = """
import numpy as np

def predict(patches, features):
    return np.column_stack([150.0 + 300.0 * features.slope_rad, np.full(len(patches), 0.8)])
"""


def make_short_drives():
    spec = find_scenario("paper_quick")
    drives = tuple(replace(drive, plan=replace(drive.plan, length_m=LENGTH_M)) for drive in spec.drives)
    return replace(spec, drives=drives)


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory):
    here, short = tmp_path_factory.mktemp("reproduced"), make_short_drives()
    with patch.dict(scenarios.SCENARIOS, paper_quick=lambda: short):
        done = tcpipe("reproduce", "here", "--size", "quick", cwd=here, env=ENV)
        assert done.returncode == 0, done.stderr
        yield here, done


def test_every_claim_is_printed_as_it_stands(reproduced):
    here, done = reproduced
    found = json.loads((here / "here" / "reproduction.json").read_text())
    lines = done.stdout.splitlines()
    assert "simulated" in lines[0]
    verdicts = ("held", "open", "NOT held", "not measured")
    told = [line.partition(":")[0] for line in lines if line.partition(":")[0] in verdicts]
    assert told == [claim["verdict"] for claim in found["claims"]]
    assert len(told) == 8
    assert {claim["verdict"] for claim in found["claims"]} <= {"open", "not measured"}  # one training decides nothing


def test_table_four_is_of_the_same_samples(reproduced):
    here, _ = reproduced
    where = here / "here" / "dataset" / "resnet18-0" / "networks" / "networks.json"
    results = json.loads(where.read_text())["results"]
    assert len({row["baseline"] for row in results}) == 3
    for split in ("test", "unseen"):
        assert len({row["errors"]["count"] for row in results if row["split"] == split}) == 1


def test_the_benchmark_has_every_kind_and_resumes(reproduced):
    here, _ = reproduced
    rows = json.loads((here / "here" / "benchmark.json").read_text())["rows"]
    assert {row["kind"] for row in rows} == {"linear", "physics", "boosting", "resnet18"}
    of_all = [row for row in rows if row["terrain"] == "all" and row["quantity"] == "E"]
    assert all(row["rmse"]["value"] > 0.0 and 0.0 < row["largest_r2"] < 1.0 for row in of_all)
    (here / "here" / "own.py").write_text(OWN)
    command = ("benchmark", "dataset", "--kinds", "linear", "--seeds", "1", "--predictor", "own.py", "--out", "tables")
    assert "linear" in tcpipe(*command, cwd=here / "here", env=ENV).stdout
    said = json.loads(tcpipe(*command, "--json", "--quiet", cwd=here / "here", env=ENV).stdout)
    assert {row["kind"] for row in said["rows"]} == {"linear", "own"}
    whole = next(row for row in of_all if row["kind"] == "linear" and row["split"] == "test")
    again = json.loads((here / "here" / "tables" / "benchmark.json").read_text())["rows"]
    same = next(
        row
        for row in again
        if row["kind"] == "linear" and (row["terrain"], row["quantity"], row["split"]) == ("all", "E", "test")
    )
    assert same["rmse"] == whole["rmse"]


def test_even_a_quick_network_learns_that_slope_costs_time(reproduced):
    here, _ = reproduced
    values = json.loads((here / "here" / "dataset" / "resnet18-0" / "evaluation" / "evaluation.json").read_text())
    for split in ("test", "unseen"):
        ours, expected = (values["time"][who][split]["mape_percent"] for who in ("ours", "expected time"))
        assert ours < expected


def test_again_is_nothing_to_do(reproduced):
    here, first = reproduced
    before = (here / "here" / "reproduction.json").read_bytes()
    again = tcpipe("reproduce", "here", "--size", "quick", "--seeds", "1", "--jobs", "1", cwd=here, env=ENV)
    assert again.returncode == 0
    assert not {"fusing", "epoch"} & set(re.findall(r"\w+", again.stderr))
    assert (here / "here" / "reproduction.json").read_bytes() == before
    assert again.stdout.splitlines()[:-2] == first.stdout.splitlines()[:-2]


def test_without_baselines_their_claims_are_not_measured(reproduced, tmp_path):
    here, _ = reproduced
    shutil.copytree(here / "here", tmp_path / "here")
    done = tcpipe("reproduce", "here", "--size", "quick", "--no-baselines", "--json", "--quiet", cwd=tmp_path, env=ENV)
    assert done.returncode == 0, done.stderr
    with_them, without = (
        json.loads((at / "here" / "reproduction.json").read_text())["claims"] for at in (here, tmp_path)
    )
    assert json.loads(done.stdout)["values"]["claims"] == without
    for one, other in zip(with_them, without, strict=True):
        assert (other["verdict"] == "not measured") if "net per class" in other["says"] else (other == one)


def test_train_and_evaluate_by_hand(reproduced):
    here, _ = reproduced
    trained = tcpipe("train", "here/dataset", "model", "--width", "16", "--epochs", "1", cwd=here, env=ENV)
    assert trained.returncode == 0, trained.stderr
    done = tcpipe("evaluate", "model", "here/dataset", "--noise-draws", "1", "--json", cwd=here, env=ENV)
    assert set(json.loads(done.stdout)["splits"]) == {"test", "unseen"}
