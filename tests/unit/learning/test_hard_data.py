"""Datasets that a model is not easily made of: few layers, few samples of a class, labels that say nothing or are not there."""

import json

import numpy as np
import pytest
from installed_command import plain_lines, tcpipe
from synthetic_store import add_run, box, lanes, lonlat, open_world, region_file, segments

from tcpipe.dataset import Split
from tcpipe.errors import DatasetError
from tcpipe.learning.evaluation import EvaluateConfig
from tcpipe.learning.evaluation_files import run_evaluation
from tcpipe.learning.fitting import FitConfig
from tcpipe.learning.models import load_model
from tcpipe.learning.training import train
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe

pytest.importorskip("lightgbm")

CONFIG = EvaluateConfig(noise_draws=1)
real_column, real_labels = Split.column, Split.labels.func


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """A store whose map has heights alone, and its dataset."""
    here = tmp_path_factory.mktemp("bare")
    store = open_world(here, layers=())
    for run_id, first in (("north", 1.0), ("south", -15.5)):
        start, end = lanes(first + 2.0 * np.arange(8), -14.0, 14.0)
        add_run(store, run_id, segments(run_id, start, end, start_ns=int(1e18 + first * 1e12)))
    region = region_file(here / "region.geojson", box(-18, -18, 6, 18))
    build_dataset(here / "dataset", store=store.root, split=region, recipe=Recipe())
    return here


def test_one_run_left_to_train_wants_another_or_blocks(bare, tmp_path):
    """Of two runs one tests; the other is one fold, of whatever length."""
    build_dataset(tmp_path / "dataset", store=bare / "store", holdout="run", recipe=Recipe())
    with pytest.raises(DatasetError, match="they are of whole runs: drive once more, or build it with --holdout block"):
        train(tmp_path / "dataset", tmp_path / "model", config=FitConfig(model="boosting"))


@pytest.mark.parametrize("kind", ["boosting", "physics"])
def test_heights_alone_are_enough(bare, tmp_path, kind):
    train(bare / "dataset", tmp_path / "model", config=FitConfig(model=kind))
    model = load_model(tmp_path / "model")
    assert model.card.inputs.channels == ("height",)
    found = run_evaluation(tmp_path / "model", bare / "dataset", tmp_path / "evaluation", config=CONFIG)
    assert np.isfinite(found.values.splits["unseen"].errors["E"]["all"].rmse)
    assert "unseen, energy E: " in str(found)
    if kind == "physics":
        path = {"type": "LineString", "coordinates": lonlat([(-10.0, 0.0), (5.0, 0.0)]).tolist()}
        (tmp_path / "path.geojson").write_text(json.dumps(path))
        done = tcpipe("predict-path", "model", "--path", "path.geojson", "--store", bare / "store", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        away = {"type": "LineString", "coordinates": (lonlat([(0.0, 0.0), (9.0, 0.0)]) + 1.0).tolist()}
        (tmp_path / "away.geojson").write_text(json.dumps(away))
        lines = plain_lines(
            tcpipe("predict-path", "model", "--path", "away.geojson", "--store", bare / "store", cwd=tmp_path), 1
        )
        assert "is not on map site" in lines


@pytest.mark.parametrize("kind", ["boosting", "physics"])
def test_labels_that_are_all_equal_are_predicted_and_compared_with_nothing(dataset, tmp_path, kind, monkeypatch):
    monkeypatch.setattr(Split, "labels", property(lambda split: np.full((len(split), 2), [150.0, 0.8], np.float32)))
    train(dataset, tmp_path / "model", config=FitConfig(model=kind))
    values = run_evaluation(tmp_path / "model", dataset, tmp_path / "evaluation", config=CONFIG).values
    assert values.splits["test"].errors["w"]["all"].rmse < 1.0
    assert np.isfinite([row.errors.rmse for row in values.baselines]).all()


@pytest.mark.parametrize("kind", ["boosting", "physics"])
def test_samples_without_a_label_are_left_out_and_counted(dataset, tmp_path, kind, monkeypatch, caplog):
    def labels(split):
        some = real_column(split, "start_ns") // 1_200_000_000 % 40 == 0
        return np.where(some[:, None], np.nan, real_labels(split)) if split.name == "train" else real_labels(split)

    monkeypatch.setattr(Split, "labels", property(labels))
    caplog.set_level("INFO", "tcpipe")
    train(dataset, tmp_path / "model", config=FitConfig(model=kind))
    assert "samples of train have no label and are not used" in caplog.text
    assert np.isfinite(load_model(tmp_path / "model").residuals["power_predicted_watt"]).all()
    monkeypatch.setattr(Split, "labels", property(lambda split: np.full((len(split), 2), np.nan, np.float32)))
    with pytest.raises(DatasetError, match="no labelled samples in split train"):
        train(dataset, tmp_path / "none", config=FitConfig(model=kind))


def test_who_gives_the_network_s_options_gets_the_network(dataset, tmp_path):
    pytest.importorskip("torch")
    tcpipe("train", dataset, "model", "--epochs", "1", "--width", "16", "--quiet", cwd=tmp_path)
    assert load_model(tmp_path / "model").card.training.kind == "resnet18"
