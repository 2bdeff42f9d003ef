"""A table is a model folder like any other: trained in a moment, asked, evaluated, replaced."""

import re

import numpy as np
import pytest
from installed_command import tcpipe

from tcpipe.dataset import open_dataset
from tcpipe.learning.fitting import FitConfig
from tcpipe.learning.models import HISTORY, WEIGHTS, load_model
from tcpipe.learning.training import train
from tcpipe.pipeline.verify import verify

pytest.importorskip("lightgbm")

CONFIG = FitConfig(model="boosting")


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory):
    place = tmp_path_factory.mktemp("table") / "model"
    return place, train(dataset, place, config=CONFIG)


def test_it_predicts_what_it_was_made_of(trained, dataset):
    place, result = trained
    model, split = load_model(place), open_dataset(dataset)["train"]
    assert result.samples == {"fitted": len(split), "held out": len(split)}
    assert f"boosting of {len(split)} samples, best {result.best_epoch} of" in str(result)
    said = model.predict(split.patches).mean
    errors = np.abs(said - split.labels).mean(axis=0)
    assert (errors < np.abs(split.labels - split.labels.mean(axis=0)).mean(axis=0)).all()
    assert model.predict(split.patches[3:4]).mean == pytest.approx(said[3:4])
    assert sum(model.card.training_range.class_counts.values()) == len(split)
    assert verify(place).problems == ()


def test_every_sample_was_held_out_once(trained, dataset):
    residuals, split = load_model(trained[0]).residuals, open_dataset(dataset)["train"]
    assert sorted(residuals["sample_id"]) == sorted(split.column("sample_id"))
    assert residuals["power_watt"] == pytest.approx(split.labels[:, 0])
    said = load_model(trained[0]).predict(split.patches).mean[:, 0]
    seen, unseen = (np.square(found - split.labels[:, 0]).mean() for found in (said, residuals["power_predicted_watt"]))
    assert seen < unseen


def test_the_same_again_is_nothing_to_do_and_the_same_bytes(trained, dataset, tmp_path):
    assert train(dataset, trained[0], config=CONFIG).status == "unchanged"
    train(dataset, tmp_path / "model", config=CONFIG)
    for name in (WEIGHTS, HISTORY, "residuals.parquet"):
        assert (tmp_path / "model" / name).read_bytes() == (trained[0] / name).read_bytes()


def test_settings_of_the_recipe_rule_the_trees_and_options_of_the_command_the_network(dataset, tmp_path):
    (tmp_path / "own.toml").write_text("[train]\ntrees = 3\ntree_leaves = 2\nepochs = 7\n")
    done = tcpipe(
        "train", dataset, "model", "--model", "boosting", "--recipe", "own.toml", "--epochs", "9", cwd=tmp_path
    )
    assert done.returncode == 0
    model = load_model(tmp_path / "model")
    config, texts = model.card.training.config, model.predictor.trees
    assert (config.trees, config.tree_leaves, config.epochs) == (3, 2, 9)
    assert all(1 <= text.count("Tree=") <= 3 for text in texts)
    assert {leaves for text in texts for leaves in re.findall(r"num_leaves=(\d+)", text)} == {"2"}
    (tmp_path / "own.toml").write_text("[train]\ntrees = 0\n")
    done = tcpipe("train", dataset, "other", "--recipe", "own.toml", cwd=tmp_path)
    assert "own.toml: train.trees is 0; expected a whole number from 1 to 10000" in done.stderr
