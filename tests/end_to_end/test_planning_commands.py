"""predict-path, cost-map and plan-path as a user runs them, with a model folder and a map in a store."""

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pyarrow.csv
import pytest
from installed_command import plain_lines, tcpipe
from map_worlds import World

from tcpipe.pipeline.maps import add_map

pytestmark = pytest.mark.skipif(find_spec("torch") is None, reason="torch, the extra train, is not installed")

_ONE_THREAD = {"OMP_NUM_THREADS": "1"}
_FROM, _TO = "14.99990,46.95345", "15.00010,46.95360"


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A directory with a store of one map, a model, and a path."""
    from made_models import CARD, made_model  # needs torch

    from tcpipe.learning.model_card import TrainingRange

    here = tmp_path_factory.mktemp("planning")
    layers = World("EPSG:32633", 500_000.0, 5_200_000.0, 30.0).write(here, 0.1)
    add_map("site", **layers, store=here / "tcpipe-store")
    ranges = {"slope_rad": (-0.5, 0.5), "cross_slope_rad": (-0.5, 0.5), "relief_m": (0.0, 1.0)}
    made_model(
        here / "model", training_range=TrainingRange(CARD.training_range.class_counts | {5: 10}, (4, 5, 6, 7), ranges)
    )
    line = {"type": "LineString", "coordinates": [[14.9999, 46.9534], [15.0001, 46.9535]]}
    (here / "path.geojson").write_text(json.dumps(line))
    return here


def _run(*arguments: str | Path, cwd: Path, code: int = 0) -> str:
    done = tcpipe(*arguments, cwd=cwd, env=_ONE_THREAD)
    assert done.returncode == code, done.stderr
    return done.stdout


def test_a_path_is_costed_and_its_segments_add_up(place: Path):
    command = ("predict-path", "model", "--path", "path.geojson", "--out", "path-segments.csv")
    said = json.loads(_run(*command, "--json", "--quiet", cwd=place))
    table = pyarrow.csv.read_csv(place / "path-segments.csv")
    assert table.num_rows == said["path_segments"] == 19
    for name in ("duration_s", "energy_joule"):
        assert np.sum(table.column(name).to_numpy()) == pytest.approx(said[name], rel=1e-9)
    assert said["energy_interval_joule"][0] < said["energy_interval_joule"][1]


def test_a_plan_over_a_cost_map_costs_what_predict_path_says_of_it(place: Path):
    made = _run("cost-map", "model", "costs", "--cell-size", "2", "--store", "tcpipe-store", "--quiet", cwd=place)
    assert "cells with a cost" in made
    plan = ("plan-path", "model", "--from", _FROM, "--to", _TO, "--objective", "time", "--cost-map", "costs")
    said = json.loads(_run(*plan, "--out", "plan.geojson", "--origin", _FROM, "--json", "--quiet", cwd=place))
    assert said["objective"] == "time"
    message = json.loads((place / said["nav2_path"]).read_text())
    assert message["poses"][0]["pose"]["position"] == pytest.approx({"x": 0.0, "y": 0.0, "z": 0.0}, abs=1e-3)
    found = json.loads((place / "plan.geojson").read_text())["features"][0]
    assert found["geometry"]["coordinates"][0] == pytest.approx([14.9999, 46.95345], abs=1e-8)
    costed = json.loads(_run("predict-path", "model", "--path", "plan.geojson", "--json", cwd=place))
    assert costed["duration_s"] == pytest.approx(found["properties"]["duration_s"], rel=1e-4)
    assert costed["energy_joule"] == pytest.approx(said["energy_joule"], rel=1e-4)
    (place / "costs" / "energy.pgm").write_bytes(b"")
    assert "energy.pgm: has 0 bytes, expected" in _run("verify", "costs", cwd=place, code=1)


def test_a_budget_comes_with_its_probability(place: Path):
    plan = ("plan-path", "model", "--from", _FROM, "--to", _TO, "--out", "there.geojson", "--cell-size", "2", "--json")
    said = json.loads(_run(*plan, "--budget", "1kWh", "--risk", "0.9", "--quiet", cwd=place))
    assert said["budget_joule"] == 3.6e6
    assert said["budget_probability"] == pytest.approx(1.0)
    assert said["risk_cost"] >= said["energy_joule"]
    little = json.loads(_run(*plan, "--budget", f"{0.5 * said['energy_joule']:.0f}J", "--quiet", cwd=place, code=3))
    assert little["budget_probability"] < 0.05


def test_a_route_graph_gets_the_costs_of_its_edges(place: Path):
    points = [
        {"type": "Feature", "properties": {"id": number}, "geometry": {"type": "Point", "coordinates": at}}
        for number, at in enumerate(([0.0, 0.0], [8.0, 6.0]))
    ]
    edge = {"id": 5, "startid": 0, "endid": 1}
    line = {"type": "LineString", "coordinates": [[0.0, 0.0], [8.0, 6.0]]}
    features = [*points, {"type": "Feature", "properties": edge, "geometry": line}]
    (place / "graph.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    command = ("route-graph", "model", "--graph", "graph.geojson", "--out", "costs.geojson", "--origin", _FROM)
    options = ("--two-way", "--map", "site", "--store", "tcpipe-store", "--json", "--quiet")
    said = json.loads(_run(*command, *options, cwd=place))
    assert (said["nodes"], said["edges"], said["one_way_edges"]) == (2, 2, 0)
    found = json.loads((place / "costs.geojson").read_text())["features"]
    there, back = (of["properties"]["metadata"] for of in found[2:])
    assert there["length_m"] == back["length_m"] == pytest.approx(10.0, rel=1e-3)
    assert there["energy_joule"] != back["energy_joule"]
    assert there["energy_std_joule"] > 0.0
    assert "no input for the commanded speed" in tcpipe(*command, "--speed", "1", cwd=place, env=_ONE_THREAD).stderr


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("predict-path", "model", "--path", "path.geojson", "--out", "path-segments.txt"), 2, "ends in .csv"),
        (
            ("plan-path", "model", "--from", _FROM, "--to", _TO, "--budget", "300"),
            2,
            "expected an energy with its unit",
        ),
        (("plan-path", "model", "--from", "15.0,nan", "--to", _TO), 2, "expected LON,LAT"),
        (("plan-path", "model", "--from", _FROM, "--to", "200,46.9"), 1, "no lon/lat"),
        (("cost-map", "model", "--map", "other"), 1, "no map 'other'"),
        (("cost-map", "model", "--cell-size", "0"), 2, "--cell-size"),
        (("cost-map", "model", "--speed", "0.5"), 2, "has no input for the commanded speed"),
    ],
)
def test_bad_input_is_one_line(place: Path, arguments, code, words):
    done = tcpipe(*arguments, cwd=place, env=_ONE_THREAD)
    assert words in plain_lines(done, code, most=1)
