"""Runs without power, with and without patches, from the dataset to a model of time, as a user types it.

Labels, splits and frames of such datasets: tests/unit/pipeline/dataset/test_chosen_labels.py.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from installed_command import tcpipe
from synthetic_store import add_run, add_world, lanes, segments

from tcpipe import open_dataset
from tcpipe.store import open_store


def run(*arguments, cwd, code=0):
    done = tcpipe(*arguments, cwd=cwd)
    assert done.returncode == code, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A directory with a store of a map and a run without power, and its datasets ``patches`` and ``table``."""
    here = tmp_path_factory.mktemp("archive")
    store = open_store(here / "tcpipe-store", create=True)
    add_world(store)
    add_run(store, "a", segments("a", *lanes(-13.0 + 2.0 * np.arange(14), -14.0, 14.0), powered=False))
    run("build-dataset", "patches", cwd=here)
    run("build-dataset", "table", "--without-patches", "--labels", "time,slip", cwd=here)
    return here


def test_time_alone_is_trained_evaluated_and_predicted(place):
    run("train", "patches", "model", "--model", "linear", cwd=place)
    told = run("evaluate", "model", "patches", "evaluation", "--json", cwd=place).stdout
    splits = json.loads(told)["splits"]
    assert set(splits["test"]["errors"]) == {"v", "T"}
    assert splits["test"]["errors"]["T"]["all"]["mape_percent"] < 15.0
    (first,) = open_dataset(place / "patches")["train"].samples.slice(0, 1).to_pylist()
    line = [[first[f"{end}_lon_deg"], first[f"{end}_lat_deg"]] for end in ("start", "end")]
    (place / "path.geojson").write_text(json.dumps({"type": "LineString", "coordinates": line}))
    cost = json.loads(run("predict-path", "model", "--path", "path.geojson", "--json", cwd=place).stdout)
    assert cost["energy_joule"] is cost["energy_interval_joule"] is None
    low, high = cost["duration_interval_s"]
    assert low < cost["duration_s"] < high
    goal = [",".join(map(str, point)) for point in line]
    failed = run("plan-path", "model", "--from", goal[0], "--to", goal[1], cwd=place, code=1)
    assert "predicts time alone" in failed.stderr
    failed = run("train", "table", "other", cwd=place, code=1)
    assert "has no patches" in failed.stderr
