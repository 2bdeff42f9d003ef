"""The two readings of equation 4, by hand and by torch."""

import numpy as np
import pytest

from tcpipe.learning.architecture import compute_loss_factors, mean_loss

SCALE = (400.0, 1.0)
LABELS = np.array([[150.0, 0.8], [200.0, 0.9]]) / SCALE
PREDICTED = np.array([[154.0, 0.77], [188.0, 0.94]]) / SCALE


def test_nrmse_divides_by_the_maxima_squared():
    by_hand = np.mean([np.hypot(4.0 / 400.0, 0.03), np.hypot(12.0 / 400.0, 0.04)])
    assert mean_loss(PREDICTED, LABELS, compute_loss_factors("nrmse", SCALE), 1.0) == pytest.approx(by_hand, rel=1e-6)


def test_equation_4_as_printed_divides_by_the_maxima():
    by_hand = np.mean([np.sqrt(4.0**2 / 400.0 + 0.03**2), np.sqrt(12.0**2 / 400.0 + 0.04**2)])
    assert mean_loss(PREDICTED, LABELS, compute_loss_factors("paper_eq4", SCALE), 1.0) == pytest.approx(
        by_hand, rel=1e-6
    )


@pytest.mark.parametrize("loss", ["nrmse", "paper_eq4"])
def test_weights_count_and_torch_s_tensors_have_the_same_loss_and_its_slope(loss):
    torch = pytest.importorskip("torch")
    factors, weights = compute_loss_factors(loss, SCALE), np.array([[1.0, 2.0], [0.5, 1.0]])
    errors = PREDICTED - LABELS
    lengths = np.sqrt((errors**2 * factors * weights).sum(axis=1))
    assert mean_loss(PREDICTED, LABELS, factors, weights) == pytest.approx(lengths.mean(), rel=1e-6)
    said = torch.from_numpy(PREDICTED).requires_grad_()
    told = mean_loss(said, *map(torch.from_numpy, (LABELS, factors, weights)))
    told.backward()
    assert told.item() == pytest.approx(lengths.mean(), rel=1e-6)
    slope = errors * factors * weights / lengths[:, None] / len(LABELS)
    assert said.grad.numpy() == pytest.approx(slope, rel=1e-6)
