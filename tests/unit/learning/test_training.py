"""Training: seeded, stopped by a fold of train, gone on from a checkpoint as if nothing had happened."""

import csv
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tcpipe.dataset import Split, open_dataset
from tcpipe.errors import DatasetError, ModelError, StoreError, UsageError
from tcpipe.formats.weights import read_arrays
from tcpipe.learning import network_model
from tcpipe.learning.fitting import FitConfig, compute_loss_factors
from tcpipe.learning.models import HISTORY, WEIGHTS, load_model
from tcpipe.learning.training import find_training_range, train
from tcpipe.terrain.layers import HEIGHT_NODATA, NODATA_ID

torch = pytest.importorskip("torch")

CONFIG = FitConfig(width=16, epochs=3, patience=3, learning_rate=1e-3)


def _weights(place):
    return read_arrays(place / WEIGHTS)


def _same(one, other):
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory):
    place = tmp_path_factory.mktemp("trained") / "model"
    return place, train(dataset, place, config=CONFIG)


def test_it_learns_and_says_how(trained):
    place, result = trained
    with (place / HISTORY).open() as stream:
        history = list(csv.DictReader(stream))
    held = [float(row["held_out_loss"]) for row in history]
    assert len(history) == result.epochs == 3
    assert result.best_epoch == 1 + int(np.argmin(held))
    assert result.held_out_loss == pytest.approx(min(held))
    assert float(history[-1]["loss"]) < float(history[0]["loss"])
    assert result.training_times_s.total_s > 0.0
    assert not list(place.parent.glob("*.checkpoint"))


def test_the_model_knows_what_it_was_trained_on(trained, dataset):
    place, _ = trained
    model, (fit, held) = load_model(place), open_dataset(dataset)["train"].fold(0)
    ids, counts = np.unique(fit.column("terrain_class"), return_counts=True)
    assert model.card.training_range.class_counts == dict(zip(ids.tolist(), counts.tolist(), strict=True))
    slopes = fit.column("slope_rad")
    assert model.card.training_range.ranges["slope_rad"] == (slopes.min(), slopes.max())
    heights = fit.layers(np.arange(len(fit)))["height"].astype(float) * 0.0005
    reliefs = heights.max(axis=(1, 2)) - heights.min(axis=(1, 2))
    assert model.card.training_range.ranges["relief_m"] == pytest.approx((reliefs.min(), reliefs.max()))
    assert model.card.inputs.scale == pytest.approx(tuple(open_dataset(dataset)["train"].labels.max(axis=0)))
    assert sorted(model.residuals["sample_id"]) == sorted(held.column("sample_id"))
    order = np.argsort(np.argsort(held.column("sample_id")))
    said = model.predict(held.patches).mean[np.argsort(held.column("sample_id"))][order]
    by_id = dict(zip(model.residuals["sample_id"], model.residuals["power_predicted_watt"], strict=True))
    assert said[:, 0] == pytest.approx([by_id[name] for name in held.column("sample_id")], rel=1e-4)


@pytest.mark.parametrize(
    ("held", "rate"),
    [
        ((), 1.0),
        ((5.0, 4.0, 3.0, 2.0), 1.0),
        ((5.0, 4.0, 4.5), 1.0),
        ((5.0, 4.0, 4.5, 4.0), 0.1),  # the same is not better
        ((5.0, 4.0, 4.5, 4.0, 3.9), 0.1),  # and it does not rise again
        ((5.0, 4.0, 4.5, 4.0, 3.9, 4.0, float("nan")), 0.01),
        (tuple(range(20, 4, -1)), 0.1),  # the last fifth of twenty
        ((5.0, 4.0, 4.5, 4.0, *[3.9] * 2, *np.arange(3.8, 2.8, -0.1)), 0.01),
    ],
)
def test_the_rate_falls_where_nothing_gets_better_and_at_the_end(held, rate):
    history = [(number + 1, 1.0, float(loss)) for number, loss in enumerate(held)]
    progress = network_model.TrainingProgress(len(history), history=history)
    config = replace(CONFIG, epochs=20, patience=4, learning_rate=1.0)
    assert network_model.compute_learning_rate(config, progress) == pytest.approx(rate)


def _stopped(monkeypatch, at, dataset, place, config, **options):
    """Train until the checkpoint after epoch ``at`` is written; return the epochs whose checkpoints were."""
    real, epochs = network_model._State.write, []

    def write_and_stop(state, path):
        real(state, path)
        epochs.append(state.progress.epoch)
        if state.progress.epoch == at and epochs.count(at) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(network_model, "_SECONDS_BETWEEN", 0.0)
    monkeypatch.setattr(network_model._State, "write", write_and_stop)
    with pytest.raises(KeyboardInterrupt):
        train(dataset, place, config=config, **options)
    monkeypatch.setattr(network_model._State, "write", real)
    assert not place.exists()
    return epochs


def _checkpoint(place):
    (found,) = place.parent.glob(f"{place.name}.*.checkpoint")
    return found


def test_a_training_stopped_after_any_checkpoint_goes_on_as_if_nothing_had_happened(
    trained, dataset, tmp_path, monkeypatch
):
    whole, place = trained[0], tmp_path / "model"
    for epoch in (0, 1, 2, 3):  # the last of them: all is trained, no model is written
        assert set(_stopped(monkeypatch, epoch, dataset, place, CONFIG)) == {max(epoch - 1, 0), epoch}
    checkpoint = _checkpoint(place)
    state = checkpoint.read_bytes()
    assert train(dataset, place, config=CONFIG).status == "done"
    assert _same(_weights(whole), _weights(place))
    assert (whole / HISTORY).read_bytes() == (place / HISTORY).read_bytes()
    checkpoint.write_bytes(state)  # ended before the state was removed
    assert train(dataset, place, config=CONFIG).status == "unchanged"
    assert not checkpoint.exists()


def test_an_interruption_writes_the_last_whole_epoch(dataset, tmp_path, monkeypatch, caplog):
    real = network_model._State.keep

    def keep_and_stop(state, path):
        real(state, path)
        if state.progress.epoch == 1:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(network_model._State, "keep", keep_and_stop)
        with pytest.raises(KeyboardInterrupt):
            train(dataset, tmp_path / "model", config=CONFIG)
    with caplog.at_level("INFO", "tcpipe"):
        train(dataset, tmp_path / "model", config=CONFIG)
    assert "resumes after epoch 1" in caplog.text


def test_a_state_of_another_training_is_kept_and_one_cut_short_is_told(dataset, tmp_path, monkeypatch):
    place, config = tmp_path / "other", replace(CONFIG, epochs=1)
    _stopped(monkeypatch, 0, dataset, place, config)
    checkpoint = _checkpoint(place)
    state = checkpoint.read_bytes()
    assert train(dataset, place, config=replace(config, seed=1)).status == "done"
    assert checkpoint.read_bytes() == state
    checkpoint.write_bytes(state[:-1000])
    with pytest.raises(
        ModelError, match=r"checkpoint: truncated or damaged .*; remove it, or start again with --no-"
    ) as told:
        train(dataset, place, config=config)
    assert len(told.value.problems) == 1
    assert train(dataset, place, config=config, no_resume=True).status == "done"


def test_a_place_that_cannot_be_written_is_found_before_the_first_epoch(dataset, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(network_model.NetworkModel, "_train_epoch", lambda *_: pytest.fail("an epoch was trained"))
    with pytest.raises(StoreError, match=r"model\..*\.checkpoint: cannot be written"):
        train(dataset, tmp_path / "file" / "model", config=CONFIG)


def test_a_fold_that_is_not_there_is_an_error(dataset, tmp_path):
    with pytest.raises(DatasetError, match="fold 9 of train leaves"):
        train(dataset, tmp_path / "model", config=replace(CONFIG, fold=9))


@pytest.mark.parametrize(
    ("name", "text"), [("thesis.txt", "important"), ("model.json", '{"kind": "of another program"}')]
)
def test_a_folder_of_something_else_is_left_alone(dataset, tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(UsageError, match="exists and is no model; it is not changed"):
        train(dataset, tmp_path, config=CONFIG)
    assert (tmp_path / name).read_text() == text


def test_what_lies_beside_a_model_is_not_replaced_with_it(trained, dataset, tmp_path):
    place = tmp_path / "model"
    shutil.copytree(trained[0], place)
    (place / "notes.txt").write_text("important")
    assert train(dataset, place, config=CONFIG).status == "unchanged"
    with pytest.raises(UsageError, match=r"contains notes.txt in the directory of a model"):
        train(dataset, place, config=replace(CONFIG, seed=1))
    assert (place / "notes.txt").exists()


def test_pixels_without_data_are_not_seen(dataset, monkeypatch):
    split = open_dataset(dataset)["train"]
    seen, real = find_training_range(split), Split.layers

    def with_a_hole(split, indices):
        layers = real(split, indices)
        layers["height"][:, 0, 0], layers["terrain"][:, 0, 0] = HEIGHT_NODATA, NODATA_ID
        return layers

    monkeypatch.setattr(Split, "layers", with_a_hole)
    holed = find_training_range(split)
    assert holed.pixel_classes == seen.pixel_classes
    assert holed.ranges["relief_m"] == pytest.approx(seen.ranges["relief_m"], abs=0.05)


def _make_state():
    from tcpipe.learning.network import Trainer, make_resnet18

    trainer = Trainer(make_resnet18(1, 1, 16, seed=0, start=[0.5]), compute_loss_factors("nrmse", [1.0]))
    return network_model._State(trainer, network_model.TrainingProgress(), trainer.copy_weights())


@given(st.data())
@settings(max_examples=10, deadline=None)
def test_a_damaged_one_is_told_or_as_it_was(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("state") / "model.checkpoint"
    state, again = _make_state(), _make_state()
    state.progress = network_model.TrainingProgress(1, 0, float("inf"), [(1, 0.5, float("nan"))])
    state.keep(path)
    state.write(path)
    raw = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(raw) - 1))
    if data.draw(st.booleans()):
        del raw[at:]
    else:
        raw[at] ^= data.draw(st.integers(1, 255))
    path.write_bytes(raw)
    told = ""
    try:
        again.read(path)
    except ModelError as error:
        told = str(error)
    if told:
        assert told.startswith(f"{path}: ")
        assert "\n" not in told
        return
    assert repr(again.progress) == repr(state.progress)
    wanted = state.trainer.copy_weights()
    assert all(torch.equal(array, wanted[name]) for name, array in again.trainer.copy_weights().items())
