"""What is kept of a state, against a cloud of states."""

import numpy as np
import pytest
from unit.fusion import dense_reference
from unit.fusion.dense_reference import P, X

from tcpipe.fusion import state_kernel


def test_deviations_of_yaw_and_forward_velocity_are_those_of_a_cloud():
    out = np.zeros(state_kernel.SAVED)
    small = P * 1e-4
    state_kernel.saved(X, small, out)
    cloud = np.random.default_rng(6).multivariate_normal(np.zeros(17), small, 20_000)
    states = np.array([dense_reference.plus(X, d) for d in cloud])
    yaw = np.arctan2(states[:, 3], states[:, 0])
    forward = np.sum(states[:, [0, 3, 6]] * states[:, 15:18], axis=1)
    assert np.var(yaw) == pytest.approx(out[26], rel=0.05)
    assert np.var(forward) == pytest.approx(out[27], rel=0.05)
