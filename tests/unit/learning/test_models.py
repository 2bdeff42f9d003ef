"""Model folders: what is read is what was written, and anything else is one plain line."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_models import CARD, made_model
from stored_files import flip

from tcpipe.errors import ModelError, UsageError
from tcpipe.formats.integrity import write_sealed
from tcpipe.learning.models import WEIGHTS, load_model
from tcpipe.pipeline.verify import verify

pytest.importorskip("torch")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return made_model(tmp_path_factory.mktemp("made") / "model")


def _refused(place, match):
    with pytest.raises((ModelError, UsageError), match=match) as told:
        load_model(place)
    assert len(told.value.problems) == 1


def test_it_predicts_the_same_in_any_company(place):
    model = load_model(place)
    assert replace(model.card, checksums={}) == CARD
    patches = np.random.default_rng(3).random((300, 40, 40, 3), np.float32)
    whole = model.predict(patches).mean
    assert whole.shape == (300, 2)
    assert model.predict(patches[7:8]).mean == pytest.approx(whole[7:8], rel=1e-4)
    assert model.predict(patches[:0]).mean.shape == (0, 2)
    assert model.checksum == load_model(place).checksum


def test_velocity_is_never_nothing(tmp_path):
    slow = load_model(made_model(tmp_path / "slow", scale=(400.0, 1e-3)))
    assert slow.predict(np.zeros((2, 40, 40, 3), np.float32)).mean[:, 1] == pytest.approx(0.05)


def test_patches_of_another_shape(place):
    with pytest.raises(
        ModelError, match=r"patches of shape \(40, 40, 2\), expected \(40, 40, 3\): ortho, terrain, height"
    ):
        load_model(place).predict(np.zeros((1, 40, 40, 2), np.float32))


def test_no_model_and_half_a_model(tmp_path, place):
    _refused(tmp_path / "nowhere", "there is no such model; run 'tcpipe train' first")
    _refused(tmp_path, "not a model: it has no model.json")
    cut = made_model(tmp_path / "card")
    (cut / "model.json").write_text((cut / "model.json").read_text()[:200])
    _refused(
        cut,
        r"model.json: not a readable JSON file \(.*\); .* lists all changed files; remove the folder and train the model again",
    )
    cut = made_model(tmp_path / "cut")
    (cut / WEIGHTS).write_bytes((cut / WEIGHTS).read_bytes()[:-100])
    _refused(cut, "weights.npz: has .* bytes, expected .*; train the model again")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"schema_version": 2}, "written by model schema 2, expected 6; train the model again"),
        ({"schema_version": 99}, "written by model schema 99, expected 6; train the model again"),
        ({"kind": "tcpipe dataset"}, "not the card of a tcpipe model"),
        (
            {"inputs": None},
            "model.json: does not have the format of this version: inputs: expected an object, got null; remove the folder and",
        ),
    ],
)
def test_another_card(tmp_path, change, match):
    place = made_model(tmp_path / "model")
    card = json.loads((place / "model.json").read_text())
    write_sealed(place / "model.json", {**card, **change})
    _refused(place, match)


def test_an_edited_card_is_refused_and_every_damaged_file_is_named(tmp_path):
    place = made_model(tmp_path / "model")
    (place / "weights.npz").write_bytes(b"")
    (place / "residuals.parquet").unlink()
    with pytest.raises(ModelError) as told:
        load_model(place)
    assert [line.split(":")[0] for line in told.value.problems] == [
        str(place / "residuals.parquet"),
        str(place / "weights.npz"),
    ]
    card = (place / "model.json").read_text()
    assert '"robot": "husky"' in card
    (place / "model.json").write_text(card.replace('"robot": "husky"', '"robot": "jackal"'))
    _refused(place, r"model\.json: has changed since it was written.*; remove the folder and train the model again")


def test_without_torch_there_is_one_line(place, monkeypatch):
    monkeypatch.setattr("tcpipe.learning.network_model.find_spec", lambda _: None)
    with pytest.raises(ModelError, match=r"torch not installed, .* pip install 'tcpipe\[train\]'"):
        load_model(place).predict(np.zeros((1, 40, 40, 3), np.float32))


@pytest.mark.parametrize("name", ["model.json", "weights.npz", "residuals.parquet", "history.csv"])
def test_a_changed_byte_is_found_and_its_file_is_named(tmp_path, place, name):
    model = Path(shutil.copytree(place, tmp_path / "model"))
    assert (verify(model).kind, verify(model).problems) == ("model", ())
    flip(model / name)
    (problem,) = verify(model).problems
    assert str(model / name) in problem
