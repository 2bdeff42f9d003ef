"""A checkpoint holds any state of a training, and what is none is told in one line."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tcpipe.errors import ModelError
from tcpipe.formats.weights import write_arrays
from tcpipe.learning.fitting import TrainingProgress, read_checkpoint, write_checkpoint

PARTS = {part: {"a": np.arange(6.0), "b/c": np.ones((2, 3), np.float32)} for part in ("now", "best", "optimizer")}
LOSSES = st.floats()  # infinite and not a number, too


@given(LOSSES, st.lists(st.tuples(LOSSES, LOSSES), max_size=4), st.data())
def test_what_is_saved_is_read(tmp_path_factory, best_loss, losses, data):
    path = tmp_path_factory.mktemp("state") / "model.checkpoint"
    history = [(number + 1, *pair) for number, pair in enumerate(losses)]
    best = data.draw(st.integers(0, len(history)))
    progress = TrainingProgress("key", len(history), best, best_loss, history)
    write_checkpoint(path, progress, PARTS)
    found, parts = read_checkpoint(path, "key")
    assert repr(found) == repr(progress)  # nan is not nan
    assert parts.keys() == PARTS.keys()
    assert all(np.array_equal(parts[part][name], array) for part in PARTS for name, array in PARTS[part].items())


@given(st.data())
def test_a_damaged_one_is_told_or_as_it_was(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("state") / "model.checkpoint"
    write_checkpoint(path, TrainingProgress("key"), PARTS)
    raw = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(raw) - 1))
    if data.draw(st.booleans()):
        del raw[at:]
    else:
        raw[at] ^= data.draw(st.integers(1, 255))
    path.write_bytes(raw)
    told = ""
    try:
        found, parts = read_checkpoint(path, "key")
    except ModelError as error:
        told = str(error)
    if told:
        assert told.startswith(f"{path}: ")
        assert "\n" not in told
        return
    assert found == TrainingProgress("key")
    assert all(np.array_equal(parts[part][name], array) for part in PARTS for name, array in PARTS[part].items())


@pytest.mark.parametrize(
    "state",
    [
        {},
        {"best_loss": None},
        {"epoch": 1},
        {"epoch": 1, "history": [[1, 0.5]]},
        {"epoch": 1, "history": [[2, 0.5, 0.5]]},
        {"best_epoch": 1},
        {"best_epoch": None},
        {"more": 1},
    ],
)
def test_a_foreign_one_is_told(tmp_path, state):
    whole = {"key": "key", "epoch": 0, "best_epoch": 0, "best_loss": 1.0, "history": []}
    text = json.dumps({**whole, **state} if state else []).encode()
    write_arrays(tmp_path / "x.checkpoint", {"state": np.frombuffer(text, np.uint8)})
    with pytest.raises(ModelError, match=r"x.checkpoint: not a checkpoint; remove it, or start anew with --no-resume"):
        read_checkpoint(tmp_path / "x.checkpoint", "key")
