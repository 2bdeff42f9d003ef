"""The user's own models, those of docs/examples: they can do all that shipped ones can, and run only where they are named."""

import json
from pathlib import Path

import numpy as np
import pytest
from installed_command import tcpipe as command
from synthetic_store import box, lonlat, region_file, small_store

import tcpipe
from tcpipe.dataset.extra_features import read_extra_features
from tcpipe.errors import ModelError, UsageError
from tcpipe.learning.models import load_model
from tcpipe.pipeline.verify import verify

EXAMPLES = {
    path.name: path.read_text()
    for path in (Path(__file__).parents[3] / "docs/examples").glob("*.py")
    if path.name != "open_data.py"  # no model
}
NEEDED = {"ridge.py": "sklearn", "small_network.py": "torch", "by_hand.py": "numpy"}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A directory with a store of one map, a dataset of it, a path, and the examples."""
    here = tmp_path_factory.mktemp("own")
    store = small_store(here)
    region = region_file(here / "region.geojson", box(-18, -18, 6, 18))
    tcpipe.build_dataset(here / "dataset", store=store.root, split=region)
    line = {"type": "LineString", "coordinates": lonlat([(-12.0, -5.0), (-2.0, -4.0)]).tolist()}
    (here / "path.geojson").write_text(json.dumps(line))
    for name, text in EXAMPLES.items():
        (here / name).write_text(text.replace("in range(5)", "in range(1)"))  # of one epoch
    return here, str(store.root)


def test_every_example_is_tested():
    assert EXAMPLES.keys() == NEEDED.keys()


@pytest.mark.parametrize("name", NEEDED)
def test_an_example_is_trained_evaluated_and_planned_with(place, monkeypatch, tmp_path, name):
    pytest.importorskip(NEEDED[name])
    here, store = place
    monkeypatch.chdir(here)
    model, own = tmp_path / "model", {"predictor": name}
    assert tcpipe.train("dataset", model, **own).status == "done"
    assert tcpipe.train("dataset", model, **own).status == "unchanged"
    assert verify(model).problems == ()
    split = tcpipe.open_dataset("dataset")["train"]
    assert sorted(load_model(model, name).residuals["sample_id"]) == sorted(split.column("sample_id"))
    found = tcpipe.evaluate(model, "dataset", tmp_path / "evaluation", noise_draws=1, **own).values
    assert {of.baseline for of in found.baselines} >= {"mean per class", "physics"}
    assert found.splits["test"].errors["E"]["all"].coverage_percent is not None
    cost = tcpipe.predict_path(model, "path.geojson", store=store, **own)
    assert cost.energy_interval_joule[0] < cost.energy_joule < cost.energy_interval_joule[1]
    start, goal = lonlat([(-12.0, -5.0), (-2.0, -4.0)]).tolist()
    rules = {"store": store, "out": tmp_path / "plan.geojson", "allow_extrapolation": True}
    plan = tcpipe.plan_path(model, start, goal, **rules, **own)
    assert plan.length_m >= 10.0


def test_the_command_takes_it_and_a_folder_alone_runs_nothing(place, tmp_path):
    here, store = place
    own, model = ("--predictor", here / "by_hand.py"), tmp_path / "model"
    done = command("train", "dataset", model, *own, "--json", cwd=here)
    assert json.loads(done.stdout)["model"] == "own"
    made = command("cost-map", model, tmp_path / "costs", "--cell-size", "4", "--store", store, *own, cwd=here)
    assert "cells with a cost" in made.stdout
    planning = ("--store", store, *own)
    ends = [",".join(map(str, end)) for end in lonlat([(-12.0, -5.0), (-2.0, -4.0)]).tolist()]
    plan = ("--from", ends[0], "--to", ends[1], "--allow-extrapolation", "--out", tmp_path / "plan.geojson")
    graph = ("--graph", "graph.geojson", "--out", tmp_path / "graph.geojson", "--origin", ends[0])
    line = [[0.0, 0.0], [8.0, 1.0]]
    nodes = [({"id": number}, {"type": "Point", "coordinates": at}) for number, at in enumerate(line)]
    edge = ({"id": 5, "startid": 0, "endid": 1}, {"type": "LineString", "coordinates": line})
    features = [{"type": "Feature", "properties": facts, "geometry": of} for facts, of in (*nodes, edge)]
    (here / "graph.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    for asked in (
        ("evaluate", model, "dataset", tmp_path / "evaluation", "--noise-draws", "1", *own),
        ("predict-path", model, "--path", "path.geojson", *planning),
        ("plan-path", model, *plan, *planning),
        ("route-graph", model, *graph, *planning),
    ):
        assert command(*asked, cwd=here).returncode == 0
    done = command("predict-path", model, "--path", "path.geojson", "--store", store, cwd=here)
    assert done.returncode == 2
    assert "was trained with your own code, which its folder lacks; give it with --predictor FILE.py" in done.stderr
    assert not any("by_hand" in path.read_text(errors="ignore") for path in model.iterdir())


def test_predictions_are_those_of_the_code_and_a_change_of_it_is_said(place, tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(place[0])
    code = tmp_path / "mine.py"
    code.write_text(EXAMPLES["by_hand.py"])
    tcpipe.train("dataset", tmp_path / "model", predictor=str(code))
    split = tcpipe.open_dataset("dataset")["test"]
    slope = split.column("slope_rad")
    features = tcpipe.dataset.extra_features.read_extra_features(split)
    model = load_model(tmp_path / "model", str(code))
    wanted = 60.0 + 0.8 * (90.0 + 400.0 * np.tan(slope))
    assert model.predict(split.patches, features).mean[:, 0] == pytest.approx(wanted, rel=1e-5)
    code.write_text(EXAMPLES["by_hand.py"].replace("60.0", "61.0"))
    changed = load_model(tmp_path / "model", str(code))
    assert "has changed since" in caplog.text
    assert changed.predict(split.patches, features).mean[:, 0] == pytest.approx(wanted + 1.0, rel=1e-5)
    assert changed.checksum != model.checksum


STATED = """
import numpy as np

def predict(patches, features):
    mean = np.column_stack([150.0 + 300.0 * features.slope_rad, np.full(len(patches), 0.8)])
    covariance = np.zeros((len(patches), 2, 2))
    covariance[:, 0, 0] = 1.0 + 1e4 * features.slope_rad**2
    return mean, covariance
"""


def test_covariances_of_an_own_model_reach_its_intervals(place, tmp_path):
    """What it states is kept beside held-out predictions; `predict` scales it by their errors, and fills in what is not stated."""
    here, _ = place
    (tmp_path / "mine.py").write_text(STATED)
    tcpipe.train(here / "dataset", tmp_path / "model", predictor=str(tmp_path / "mine.py"))
    model, split = (
        load_model(tmp_path / "model", str(tmp_path / "mine.py")),
        tcpipe.open_dataset(here / "dataset")["test"],
    )
    features = read_extra_features(split)
    kept = tcpipe.open_dataset(here / "dataset")["train"].column("slope_rad").astype(float)
    assert sorted(model.residuals["power_predicted_std_watt"]) == pytest.approx(sorted(np.sqrt(1.0 + 1e4 * kept**2)))
    said, asked = model.predict(split.patches, features), model.ask(split.patches, features)
    assert np.array_equal(said.mean, asked.mean)
    assert (asked.covariance[:, 1, 1] == 0.0).all()
    assert (np.linalg.eigvalsh(said.covariance) > 0.0).all()
    by_hand = model.errors["power"].compute_std(said.mean[:, 0], features.class_id, np.sqrt(asked.covariance[:, 0, 0]))
    assert np.sqrt(said.covariance[:, 0, 0]) == pytest.approx(by_hand)


@pytest.mark.parametrize(
    ("text", "error", "match"),
    [
        ("1 / 0", ModelError, r"mine.py: ZeroDivisionError: division by zero \(.*mine.py, line 1, in <module>\)"),
        ("def predict(patches, features):\n    return features.gone", ModelError, r"no attribute 'gone' \(.*line 2, in predict"),
        ("def predict(p, f):\n    return p[:, 0, 0]", ModelError, r"mine.py: predict returned shape \(50, 3\), expected \(50, 2\)"),
        ("class A:\n    def predict(self, p, f): return p[:, 0, 0, :2], p[:, 0, 0]", ModelError, r"A.predict returned covariances of"),
        ("def predict(p, f):\n    return p[:, 0, 0, :2], p[:, :2, :2, 0] * 0 - 1", ModelError, "50 of 50 covariances that are invalid"),
        ("x = 1", UsageError, "has no a class with a method predict, or a function predict; expected one"),
        ("class A:\n    predict = 1\nclass B(A): pass", UsageError, r"has A, B; expected one: name it as .*mine.py:NAME"),
        ("def predict(patches, features):\n    return patches[:, 0, 0, :2] * float('nan')", ModelError, "no finite prediction of"),
    ],
)  # fmt: skip
def test_code_that_cannot_be_used_is_one_line(place, tmp_path, text, error, match):
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(error, match=match) as told:
        tcpipe.train(place[0] / "dataset", tmp_path / "model", predictor=str(tmp_path / "mine.py"))
    assert len(told.value.problems) == 1
    assert not (tmp_path / "model").exists()


def test_a_shipped_kind_needs_no_code(place, tmp_path):
    tcpipe.train(place[0] / "dataset", tmp_path / "model", model="physics")
    with pytest.raises(UsageError, match="a model of kind physics needs no code; remove --predictor"):
        load_model(tmp_path / "model", "by_hand.py")
