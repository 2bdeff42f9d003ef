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


@pytest.mark.parametrize("loss", ["nrmse", "paper_eq4"])
def test_tensors_of_torch_have_the_same_loss_and_its_gradient(loss):
    factors = compute_loss_factors(loss, SCALE)
    errors = PREDICTED - LABELS
    lengths = np.sqrt((errors**2 * factors).sum(axis=1))
    assert mean_loss(PREDICTED, LABELS, factors) == pytest.approx(lengths.mean(), rel=1e-6)
    said = torch.from_numpy(PREDICTED).requires_grad_()
    told = mean_loss(said, *map(torch.from_numpy, (LABELS, factors)))
    told.backward()
    assert told.item() == pytest.approx(lengths.mean(), rel=1e-6)
    slope = errors * factors / lengths[:, None] / len(LABELS)
    assert said.grad.numpy() == pytest.approx(slope, rel=1e-6)


def test_odd_batches_of_a_narrow_network_on_two_threads():
    """With 8 filters this ends the process: "corrupted size vs. prev_size" (torch 2.13.0)."""
    from tcpipe.learning.network import Trainer, make_resnet18

    trainer = Trainer(make_resnet18(1, 1, 16, seed=0, start=[0.5]), np.ones(1, np.float32))
    rng, threads = np.random.default_rng(0), torch.get_num_threads()
    torch.set_num_threads(2)
    losses = [
        trainer.step(rng.random((count, 40, 40, 1), np.float32), rng.random((count, 1), np.float32), 1e-3)
        for count in (11, 35, 3)
    ]
    torch.set_num_threads(threads)
    assert np.isfinite(losses).all()


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


def test_a_batch_of_one_sample_of_one_pixel_is_trained_on():
    """The last stage sees a patch of 16 pixels as one, of which a batch normalisation has no deviation."""
    from tcpipe.learning.network import Trainer, make_resnet18

    trainer = Trainer(make_resnet18(1, 1, 16, seed=0, start=[0.5]), np.ones(1, np.float32))
    patch, label = np.full((1, 16, 16, 1), 0.5, np.float32), np.array([[0.7]], np.float32)
    losses = [trainer.step(patch, label, 1e-2) for _ in range(5)]
    assert losses[0] == pytest.approx(0.2, abs=0.1)
    assert min(losses[1:]) < losses[0]
