"""One drive without its power, with and without patches, from the log to a model of time, as a user types it.

Labels, splits and frames of such datasets: tests/unit/pipeline/dataset/test_chosen_labels.py.
"""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from installed_command import tcpipe

from tcpipe import open_dataset
from tcpipe.simulation import simulate
from tcpipe.simulation.scenarios import find_scenario

NO_POWER = '[read]\nignore_topics = ["/a200_0000/platform/mcu/status/power"]\n'


def run(*arguments, cwd, code=0):
    done = tcpipe(*arguments, cwd=cwd)
    assert done.returncode == code, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A directory with a store of a map and a run without power, and its datasets ``patches`` and ``table``."""
    here = tmp_path_factory.mktemp("archive")
    spec = find_scenario("paper_quick")
    (drive, *_) = spec.drives
    drive = replace(drive, plan=replace(drive.plan, length_m=130.0))
    site = simulate(here / "site", scenario=replace(spec, drives=(drive,)))
    (here / "tcpipe.toml").write_text(NO_POWER)
    run("add-map", "site", *(word for name, path in site.rasters.items() for word in (f"--{name}", path)), cwd=here)
    run("ingest", "site/logs", cwd=here)
    run("build-dataset", "patches", cwd=here)
    run("build-dataset", "table", "--without-patches", "--labels", "time,slip", cwd=here)
    return here


def test_without_patches_samples_are_a_table_with_the_same_audited_split(place):
    patches, table = (open_dataset(place / name) for name in ("patches", "table"))
    assert patches.labels == table.labels == ("time", "slip", "vibration")
    for name in ("train", "test"):
        rows = patches[name].samples.to_pylist()
        assert {row["sample_id"] for row in rows} <= set(table[name].samples["sample_id"].to_pylist())
        assert all(row["energy_joule"] is row["power_watt"] is None for row in rows)
        assert all(row["slip_std_fraction"] > 0.0 and row["vibration_std_mps2"] > 0.0 for row in rows)
    assert table.card.split.audit == patches.card.split.audit  # the map covers the whole drive


def test_time_alone_is_trained_evaluated_and_predicted(place):
    run("train", "patches", "model", "--model", "linear", cwd=place)
    told = run("evaluate", "model", "patches", "evaluation", "--json", cwd=place).stdout
    splits = json.loads(told)["splits"]
    assert set(splits["test"]["errors"]) == {"v", "T"}
    assert splits["test"]["errors"]["T"]["all"]["mape_percent"] < 15.0
    ends = [open_dataset(place / "patches")["train"].samples.to_pylist()[row] for row in (0, 1)]
    line = [[row["start_lon_deg"], row["start_lat_deg"]] for row in ends]
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
