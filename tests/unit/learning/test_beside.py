"""Models that are told more than the patch: trained, asked, planned with; and datasets that cannot tell it."""

from dataclasses import replace

import numpy as np
import pytest
from installed_command import tcpipe

from tcpipe.dataset import Split, open_dataset
from tcpipe.dataset.extra_features import read_extra_features
from tcpipe.errors import DatasetError, ModelError, UsageError
from tcpipe.learning.fitting import FitConfig
from tcpipe.learning.models import load_model, set_speed
from tcpipe.learning.predictions import predict_costs
from tcpipe.learning.training import train
from tcpipe.pipeline.verify import verify

real_column, real_labels = Split.column, Split.labels.func


@pytest.fixture(scope="module")
def told(dataset):
    """The dataset as if runs had been driven with turns, and commanded half or all of their speed, which cost power."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Split, "column", _column)
        patch.setattr(Split, "labels", property(_labels))
        yield dataset


def _column(split, name):
    if name == "mean_abs_yaw_rate_radps":
        return 0.01 * (real_column(split, "start_ns") // 1_200_000_000 % 7)
    if name == "commanded_velocity_mps":
        return np.where(real_column(split, "start_ns") // 1_200_000_000 % 2, 0.5, 1.0)
    return real_column(split, name)


def _labels(split):
    extra_features = read_extra_features(split)
    return (
        real_labels(split) + np.column_stack([400.0 * extra_features.turn_radpm, 1.0 * extra_features.command_mps])
    ).astype(np.float32)


@pytest.mark.parametrize("kind", ["boosting", "resnet18"])
def test_what_is_told_beside_a_patch_is_heeded(told, tmp_path, kind):
    pytest.importorskip("lightgbm" if kind == "boosting" else "torch")
    config = FitConfig(model=kind, extra_features=True, epochs=1, width=16, batch_size=32)
    train(told, tmp_path / "model", config=config)
    model, split = load_model(tmp_path / "model"), open_dataset(told)["test"]
    assert [of.name for of in model.card.inputs.extra_features] == ["turn_radpm", "command_mps"]
    assert model.card.inputs.extra_features[1].training_range == (0.5, 1.0)
    assert model.takes_turns
    extra_features = read_extra_features(split)
    said = model.predict(split.patches, extra_features).mean
    uncentred = predict_costs(replace(model, residuals={}), split)
    assert uncentred.costs["w"] == pytest.approx(said[:, 0])
    usual = model.predict(split.patches).mean
    straight = replace(
        extra_features,
        turn_radpm=np.full(len(split), model.card.inputs.extra_features[0].usual),
        command_mps=np.full(len(split), np.nan),
    )
    assert model.predict(split.patches, straight).mean == pytest.approx(usual, rel=1e-5)
    assert np.abs(said - usual).max() > 0.0
    full, half = (set_speed(model, mps).predict(split.patches).mean[:, 1] for mps in (1.0, 0.5))
    assert np.abs(full - half).max() > 0.0
    if kind == "boosting":
        assert 0.35 < (full - half).mean() < 0.6  # 0.5 was put in
        assert np.std(said[:, 0] - split.labels[:, 0]) < np.std(usual[:, 0] - split.labels[:, 0])


def test_physics_is_a_model_like_the_others(told, tmp_path):
    done = tcpipe("train", told, "model", "--model", "physics", cwd=tmp_path)
    assert "physics of" in done.stdout
    model, split = load_model(tmp_path / "model"), open_dataset(told)["train"]
    assert verify(tmp_path / "model").problems == ()
    assert model.takes_turns
    assert sorted(model.residuals["sample_id"]) == sorted(split.column("sample_id"))
    assert set(model.card.training_range.pixel_classes) >= {4, 5}
    said = model.predict(split.with_channels("height").patches, read_extra_features(split)).mean
    centred = predict_costs(model, split).costs["w"] / said[:, 0]
    for of in (4, 5):
        assert np.ptp(centred[split.column("terrain_class") == of]) < 1e-5, "a class is centred as one"
    assert np.std(said[:, 0] - split.labels[:, 0]) < np.std(split.labels[:, 0])
    with pytest.raises(ModelError, match="physics needs the slope and class of each patch"):
        model.predict(split.with_channels("height").patches)
    assert tcpipe("train", told, "model", "--model", "physics", cwd=tmp_path).stdout.startswith("model: nothing to do")
    with pytest.raises(UsageError, match="has no input for the commanded speed; remove --speed"):
        set_speed(load_model(str(tmp_path / "model")), 0.5)


def test_a_speed_that_nobody_drove_is_refused(told, tmp_path):
    pytest.importorskip("lightgbm")
    train(told, tmp_path / "model", config=FitConfig(model="boosting", extra_features=True))
    with pytest.raises(
        UsageError, match=r"--speed 2: .* trained at commanded speeds of 0\.5 to 1 m/s; give one of these"
    ):
        set_speed(load_model(str(tmp_path / "model")), 2.0)


def test_an_older_dataset_cannot_tell_and_says_so(dataset, tmp_path, monkeypatch, caplog):
    pytest.importorskip("lightgbm")
    absent = {"commanded_velocity_mps"}
    monkeypatch.setattr(
        Split, "column", lambda split, name: np.full(len(split), np.nan) if name in absent else real_column(split, name)
    )
    monkeypatch.setattr(Split, "labels", property(real_labels))
    config = FitConfig(model="boosting", extra_features=True)
    train(dataset, tmp_path / "model", config=config)
    assert "its samples have no commanded speed (commanded_velocity_mps): the model does not use it" in caplog.text
    assert [of.name for of in load_model(tmp_path / "model").card.inputs.extra_features] == ["turn_radpm"]
    absent.add("mean_abs_yaw_rate_radps")
    with pytest.raises(
        DatasetError,
        match=r"no turn \(mean_abs_yaw_rate_radps\) and no commanded speed .* or train without --extra-features",
    ):
        train(dataset, tmp_path / "other", config=config)
    train(dataset, tmp_path / "physics", config=FitConfig(model="physics"))
    assert not load_model(tmp_path / "physics").takes_turns
