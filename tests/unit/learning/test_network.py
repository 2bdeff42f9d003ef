"""The network alone: its first weights, its widths, and that a narrow one trains on odd batches and several threads."""

import resource

import numpy as np
import pytest

from tcpipe.errors import ModelError, StoreError
from tcpipe.learning.fitting import compute_loss_factors, mean_loss
from tcpipe.learning.network_model import TrainingProgress, _State, check_trainable

torch = pytest.importorskip("torch")

SCALE = (400.0, 1.0)
LABELS = np.array([[150.0, 0.8], [200.0, 0.9]]) / SCALE
PREDICTED = np.array([[154.0, 0.77], [188.0, 0.94]]) / SCALE


@pytest.mark.parametrize(
    ("loss", "lengths"),
    [
        ("nrmse", [np.hypot(4.0 / 400.0, 0.03), np.hypot(12.0 / 400.0, 0.04)]),
        ("paper_eq4", [np.sqrt(4.0**2 / 400.0 + 0.03**2), np.sqrt(12.0**2 / 400.0 + 0.04**2)]),
    ],
)
def test_both_readings_of_equation_4_by_hand(loss, lengths):
    found = mean_loss(PREDICTED, LABELS, compute_loss_factors(loss, SCALE))
    assert found == pytest.approx(np.mean(lengths), rel=1e-6)


@pytest.mark.parametrize("size", [1, 1_000, 100_000])
def test_a_state_for_which_there_is_no_room_is_one_error_that_names_it(tmp_path, size):
    from tcpipe.learning.network import Trainer, make_resnet18

    trainer = Trainer(make_resnet18(1, 1, 16, seed=0, start=[0.5]), np.ones(1, np.float32))
    state = _State(trainer, TrainingProgress(), trainer.copy_weights())
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        with pytest.raises(StoreError, match=r"checkpoint: cannot be written \(File too large\)"):
            state.keep(tmp_path / "checkpoint")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []
    state.keep(tmp_path / "checkpoint")
    assert trainer.read_state(tmp_path / "checkpoint")["progress"]["epoch"] == 0


@pytest.mark.parametrize("width", [4, 8, 24])
def test_widths_that_are_no_multiple_of_sixteen(width):
    with pytest.raises(ModelError, match=f"a network of width {width}: expected a multiple of 16"):
        check_trainable(3, 2, width)


def test_first_weights_are_he_s_of_the_seed():
    """Variance 2 / inputs of a filter, nothing beyond two deviations of the uncut normal; the head starts with what it is given."""
    from tcpipe.learning.network import make_resnet18

    one, other, third = (make_resnet18(3, 2, 32, seed=seed, start=[0.4, 0.8]).arrays() for seed in (0, 0, 1))
    assert all(np.array_equal(one[name], other[name]) for name in one)
    kernel = "stage3_block2.first.convolution.weight"
    assert one[kernel].shape == (128, 128, 3, 3)
    assert not np.array_equal(one[kernel], third[kernel])
    assert one[kernel].var() == pytest.approx(2.0 / (9 * 128), rel=0.02)
    assert np.abs(one[kernel]).max() <= 2.0 * np.sqrt(2.0 / (9 * 128)) / 0.8796
    assert one["head.bias"] == pytest.approx([0.4, 0.8])
