"""An update against the same written out in plain numpy and scipy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from unit.fusion import dense_reference
from unit.fusion.dense_reference import LEVER, RATE, P, X

from tcpipe.fusion import state_kernel, update_kernel


@pytest.mark.parametrize("kind", [1, 2, 3, 4, 5, 6, 7, 8])
def test_update_is_the_unscented_transform(kind):
    work, gain = state_kernel.workspace(17)
    z, r = np.array([0.2, -0.1, 0.3]), np.array([0.02, 0.03, 0.04])
    if kind in {state_kernel.SIDEWAYS, state_kernel.LEVEL}:
        z[2] = 0.0
    x, covariance = X.copy(), P.copy()
    nis = update_kernel.innovation_of(kind, x, covariance, z, r, RATE, LEVER, 1.0, work, gain)
    update_kernel.correct(x, covariance, work, gain, np.zeros((3, 3)))
    wanted = dense_reference.update(kind, X, P, z, r, RATE, LEVER)
    assert np.allclose(x, wanted[0], atol=1e-13)
    assert np.allclose(covariance, wanted[1], atol=1e-9)
    if kind == state_kernel.WHEEL_VELOCITY:  # only the wheels' own velocity is judged, not the constraint with it
        d, wm, wc = dense_reference.sigma(P)
        forward = np.array([dense_reference.expect(kind, dense_reference.plus(X, e), RATE, LEVER)[0] for e in d])
        wanted_nis = (z[0] - wm @ forward) ** 2 / (wc @ (forward - wm @ forward) ** 2 + r[0])
        assert nis == pytest.approx(wanted_nis, rel=1e-12)
    else:
        assert nis == pytest.approx(wanted[2], rel=1e-10)


def test_the_receivers_velocity_is_the_slope_of_the_antennas_places():
    """Of a body that turns and moves on evenly the antenna's place is known; its central difference is what is to be measured."""
    R, turn = X[:9].reshape(3, 3), RATE - X[9:12]
    step_s = 1e-5

    def place(at_s):
        return X[18:21] + X[15:18] * at_s + R @ Rotation.from_rotvec(turn * at_s).apply(LEVER)

    slope = (place(step_s) - place(-step_s)) / (2 * step_s)
    work, gain = state_kernel.workspace(17)
    tiny, r = 1e-18 * np.eye(17), np.ones(3)
    update_kernel.innovation_of(state_kernel.GNSS_VELOCITY, X.copy(), tiny, slope, r, RATE, LEVER, 1.0, work, gain)
    assert np.abs(gain[0]).max() < 1e-8
