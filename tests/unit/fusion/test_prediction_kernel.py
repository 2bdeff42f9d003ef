"""A prediction against the same written out in plain numpy and scipy."""

import numpy as np
import pytest
from unit.fusion import dense_reference
from unit.fusion.dense_reference import FORCE, RATE, P, X

from tcpipe.fusion import prediction_kernel, state_kernel


@pytest.mark.parametrize(("mode", "scaled"), [(0, 0), (1, 0), (1, 1), (2, 0), (3, 0)])
def test_prediction_is_the_unscented_transform(mode, scaled):
    x, covariance, moved = X.copy(), P.copy(), np.zeros((12, 9))
    work, _ = state_kernel.workspace(17)
    q = np.concatenate((np.linspace(0.01, 0.02, 19), [scaled, 0.03]))
    prediction_kernel.predict(x, covariance, q, 0.03, 0.4, RATE, FORCE, mode, moved, work)
    wanted_x, wanted_P, cross = dense_reference.predict(X, P, q, 0.03, 0.4, RATE, FORCE, mode)
    assert np.allclose(x, wanted_x, atol=1e-13)
    assert np.allclose(covariance, wanted_P, atol=1e-13)
    transposed = np.linalg.solve(P, cross)  # the linear map with the sigma points' second moments
    among = [0, 1, 2, *range(9, 15)]
    assert np.allclose(moved, transposed[:12, among], atol=1e-9)
    transposed[np.ix_(range(12), among)] = 0.0
    stays = np.array([0, 0, 0, *[1] * 6, *[0] * 3, *[1] * 3, 1 - 0.4 * q[17], 1])
    assert np.allclose(transposed, np.diag(stays), atol=1e-9)


def test_a_covariance_that_is_none_is_repaired_and_counted():
    work, _ = state_kernel.workspace(17)
    broken = P.copy()
    broken[3, 3] = -1e-12
    prediction_kernel.predict(X.copy(), broken, np.zeros(21), 0.0, 0.1, RATE, FORCE, 3, np.zeros((12, 9)), work)
    assert work[8][0] > 0
    assert np.isfinite(broken).all()
    assert np.linalg.eigvalsh(broken).min() > 0
