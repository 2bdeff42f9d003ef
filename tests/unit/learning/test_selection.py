"""The kind that is chosen: the simplest that other runs do not tell from the best; and the kinds that are chosen from."""

import numpy as np
import pytest
from installed_command import tcpipe

from tcpipe.dataset import Split, open_dataset
from tcpipe.learning.fitting import FitConfig
from tcpipe.learning.models import load_model
from tcpipe.learning.training import choose_kind, is_within_error


def noise(split):
    """Of each sample the same, whatever split it is in."""
    seeds = split.column("start_ns").astype(np.int64) % 1_000_003
    return np.array([np.random.default_rng(seed).normal(size=2) for seed in seeds])


def by_class(split):
    return np.column_stack([100.0 + 10.0 * split.column("terrain_class"), 0.9 - 0.05 * split.column("terrain_class")])


def by_slope(split):
    slope = split.column("slope_rad").astype(np.float64)
    return by_class(split) + np.column_stack([300.0 * slope, -1.0 * slope])


def by_picture(split):
    """What only the patch shows: how bright the ground is."""
    bright = split.with_channels("ortho").patches[..., 0].mean(axis=(1, 2)).astype(np.float64)
    return by_slope(split) + np.column_stack([2000.0 * (bright - 0.4), 0.0 * bright])


@pytest.fixture
def labelled(monkeypatch):
    """Replace the labels of all splits."""

    def replace_labels(form):
        made = lambda split: (form(split) + noise(split) * [4.0, 0.01]).astype(np.float32)  # noqa: E731
        monkeypatch.setattr(Split, "labels", property(made))

    return replace_labels


def test_what_follows_a_simple_rule_gets_the_simple_kind(dataset, labelled):
    labelled(by_slope)
    assert choose_kind(open_dataset(dataset), FitConfig(model="auto")) == "linear"


def test_what_only_the_patch_shows_gets_trees(dataset, labelled):
    pytest.importorskip("lightgbm")
    labelled(by_picture)
    assert choose_kind(open_dataset(dataset), FitConfig(model="auto")) == "boosting"


def test_one_standard_error_is_of_the_clusters():
    rng = np.random.default_rng(0)
    clusters = np.repeat(np.arange(10), 20)
    assert is_within_error(np.zeros(200), clusters)
    assert not is_within_error(np.full(200, 0.1), clusters)
    assert is_within_error(np.full(200, -0.1), clusters)
    own = rng.normal(size=10)[clusters] * 0.3
    assert is_within_error(own - own.mean() + 0.05, clusters)  # runs differ by more
    assert not is_within_error(rng.normal(size=200) * 0.3 + 0.1, clusters)


def test_the_command_says_what_it_compared_and_chooses_once(dataset, tmp_path):
    done = tcpipe("train", dataset, "model", cwd=tmp_path)
    card = load_model(tmp_path / "model").card
    assert card.training.config.model == "auto"
    assert f"chooses {card.training.kind}, the simplest within one standard error of the best (" in done.stderr
    assert "predicted by other runs: linear" in done.stderr
    again = tcpipe("train", dataset, "model", cwd=tmp_path)
    assert "nothing to do" in again.stdout
    assert "chooses" not in again.stderr
