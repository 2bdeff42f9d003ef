"""The two readings of equation 4, by hand and against Keras."""

import numpy as np
import pytest

from tcpipe.learning.losses import keras_loss, loss_factors, mean_loss

SCALE = (400.0, 1.0)
LABELS = np.array([[150.0, 0.8], [200.0, 0.9]]) / SCALE
PREDICTED = np.array([[154.0, 0.77], [188.0, 0.94]]) / SCALE


def test_nrmse_divides_by_the_maxima_squared():
    by_hand = np.mean([np.hypot(4.0 / 400.0, 0.03), np.hypot(12.0 / 400.0, 0.04)])
    assert mean_loss(PREDICTED, LABELS, loss_factors("nrmse", SCALE)) == pytest.approx(by_hand, rel=1e-6)


def test_equation_4_as_printed_divides_by_the_maxima():
    by_hand = np.mean([np.sqrt(4.0**2 / 400.0 + 0.03**2), np.sqrt(12.0**2 / 400.0 + 0.04**2)])
    assert mean_loss(PREDICTED, LABELS, loss_factors("paper_eq4", SCALE)) == pytest.approx(by_hand, rel=1e-6)


@pytest.mark.parametrize("loss", ["nrmse", "paper_eq4"])
def test_keras_minimises_the_same(loss):
    pytest.importorskip("torch")
    to_tensor = pytest.importorskip("keras").ops.convert_to_tensor
    factors, weights = loss_factors(loss, SCALE), np.array([[1.0, 2.0], [0.5, 1.0]])
    told = keras_loss(factors)(
        to_tensor(np.concatenate([LABELS, weights], axis=1).astype(np.float32)), to_tensor(PREDICTED.astype(np.float32))
    )
    assert float(told) == pytest.approx(mean_loss(PREDICTED, LABELS, factors, weights), rel=1e-4)
