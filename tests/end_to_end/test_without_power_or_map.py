"""One drive with and without its power, with and without the map of its site, from the log to a model, as a user types it."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from installed_command import tcpipe

from tcpipe import open_dataset
from tcpipe.simulation import simulate
from tcpipe.simulation.scenarios import find_scenario

NO_POWER = '[read]\nignore_topics = ["/a200_0000/platform/mcu/status/power"]\n'
NO_GNSS = '[read]\nignore_topics = ["/a200_0000/sensors/gps_0/fix"]\n'


def run(*arguments, cwd, code=0):
    done = tcpipe(*arguments, cwd=cwd)
    assert done.returncode == code, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A directory with stores of one log: ``with`` and ``power`` (without power) have the map, ``map`` has none."""
    here = tmp_path_factory.mktemp("archive")
    spec = find_scenario("paper_quick")
    (drive, *_) = spec.drives
    drive = replace(drive, plan=replace(drive.plan, length_m=130.0))
    site = simulate(here / "site", scenario=replace(spec, drives=(drive,)))
    (here / "power.toml").write_text(NO_POWER)
    (here / "gnss.toml").write_text(NO_GNSS)
    layers = [word for name, path in site.rasters.items() for word in (f"--{name}", path)]
    for store in ("with", "power"):
        run("add-map", "site", *layers, "--store", store, cwd=here)
    run("ingest", "site/logs", "--store", "with", cwd=here)
    run("ingest", "site/logs", "--store", "power", "--recipe", "power.toml", cwd=here)
    return here


@pytest.fixture(scope="module")
def datasets(place):
    run("build-dataset", "with-all", "--store", "with", cwd=place)
    run("build-dataset", "without-power", "--store", "power", "--recipe", "power.toml", cwd=place)
    run("build-dataset", "without-map", "--store", "with", "--without-patches", "--labels", "time,slip", cwd=place)
    return {name: open_dataset(place / name) for name in ("with-all", "without-power", "without-map")}


def read_rows(data):
    rows = [row for split in data.values() for row in split.samples.to_pylist()]
    return {row["sample_id"]: row for row in rows}


def test_power_changes_neither_ids_nor_times_nor_slip(datasets):
    with_all, without = (read_rows(datasets[name]) for name in ("with-all", "without-power"))
    assert with_all.keys() == without.keys()
    for name, row in without.items():
        assert [row[key] for key in ("duration_s", "slip_fraction", "split", "fold")] == [
            with_all[name][key] for key in ("duration_s", "slip_fraction", "split", "fold")
        ]
        assert row["energy_joule"] is row["power_watt"] is None
    assert datasets["without-power"].labels == ("time", "slip", "vibration")


def test_without_patches_samples_are_a_table_with_an_audited_split(datasets):
    with_all, without = (read_rows(datasets[name]) for name in ("with-all", "without-map"))
    assert with_all.keys() <= without.keys()  # what the map loses is in the table
    assert datasets["without-map"].labels == ("energy", "time", "slip", "vibration")
    assert all(row["slip_fraction"] is not None for row in without.values())
    assert {row["split"] for row in without.values()} == {"train", "test"}
    assert all(row["slip_std_fraction"] > 0.0 and row["vibration_std_mps2"] > 0.0 for row in without.values())
    audit, ours = (datasets[name].card.split.audit for name in ("with-all", "without-map"))
    assert ours == audit  # the map loses nothing of this drive


def test_time_alone_is_trained_evaluated_and_predicted(place, datasets):
    run("train", "without-power", "model", "--model", "linear", cwd=place)
    told = run("evaluate", "model", "without-power", "evaluation", "--json", cwd=place).stdout
    splits = json.loads(told)["splits"]
    assert set(splits["test"]["errors"]) == {"v", "T"}
    assert splits["test"]["errors"]["T"]["all"]["mape_percent"] < 15.0
    ends = [datasets["without-power"]["train"].samples.to_pylist()[row] for row in (0, 1)]
    line = [[row["start_lon_deg"], row["start_lat_deg"]] for row in ends]
    (place / "path.geojson").write_text(json.dumps({"type": "LineString", "coordinates": line}))
    told = tcpipe("predict-path", "model", "--path", "path.geojson", "--store", "power", "--json", cwd=place).stdout
    cost = json.loads(told)
    assert cost["energy_joule"] is cost["energy_interval_joule"] is None
    low, high = cost["duration_interval_s"]
    assert low < cost["duration_s"] < high
    goal = [",".join(map(str, point)) for point in line]
    failed = run("plan-path", "model", "--store", "power", "--from", goal[0], "--to", goal[1], cwd=place, code=1)
    assert "predicts time alone" in failed.stderr
    failed = run("train", "without-map", "other", cwd=place, code=1)
    assert "has no patches" in failed.stderr


def test_a_drive_without_gnss_gives_samples_in_its_own_frame(place):
    run("ingest", "site/logs", "--store", "local", "--recipe", "gnss.toml", cwd=place)
    done = run("build-dataset", "local-dataset", "--store", "local", "--recipe", "gnss.toml", "--json", cwd=place)
    card = json.loads(done.stdout)["card"]
    assert card["plane"] == "local"
    assert card["labels"]["energy"] == card["labels"]["time"] == card["samples"] > 100
    assert sum(card["splits"].values()) == card["samples"]
