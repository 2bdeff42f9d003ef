"""Mountings, units and signs told from made motion, against the rotation that was put in (by scipy)."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tcpipe.fusion.checks.lags import GRID_S, compute_moving_mean
from tcpipe.fusion.checks.mounting import (
    compute_levelling_rotation,
    find_forward_yaw_rad,
    find_nearest_mounting,
    find_up_axis,
    find_yaw_axis,
)

GRAVITY_MPS2 = 9.80665
T = np.arange(0.0, 120.0, GRID_S)
SPEED = np.clip(np.minimum(np.mod(T, 12.0) - 2.0, 10.5 - np.mod(T, 12.0)), 0.0, 1.0)
YAW_RATE = 0.4 * np.sin(0.9 * T) * (SPEED > 0)


def felt(base_from_sensor: Rotation, seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Angular velocity and specific force of a unit mounted so, with vibration."""
    rng = np.random.default_rng(seed)
    force = np.column_stack((np.gradient(SPEED, GRID_S), SPEED * YAW_RATE, np.full(T.size, GRAVITY_MPS2)))
    force += rng.normal(0.0, 0.5, force.shape)
    rate = np.column_stack((np.zeros((T.size, 2)), YAW_RATE)) + rng.normal(0.0, 0.02, force.shape)
    return base_from_sensor.inv().apply(rate), base_from_sensor.inv().apply(force)


MOUNTINGS = [(0, 0, 0), (180, 0, 90), (90, 0, -90), (0, 35, 100), (-20, -60, 170)]


@pytest.mark.parametrize("rpy_deg", MOUNTINGS)
def test_a_mounting_is_found_from_gravity_and_acceleration(rpy_deg):
    mounting = Rotation.from_euler("xyz", rpy_deg, degrees=True)
    rate, force = felt(mounting)
    level = compute_levelling_rotation(find_up_axis(force))
    np.testing.assert_allclose(level @ level.T, np.eye(3), atol=1e-12)
    yaw = find_forward_yaw_rad(np.column_stack((SPEED, YAW_RATE)), force @ level.T, 0.0)
    found = Rotation.from_euler("z", yaw) * Rotation.from_matrix(level)
    assert (found * mounting.inv()).magnitude() < 0.1
    axis = find_yaw_axis(compute_moving_mean(YAW_RATE[:, None], 0.1)[:, 0], compute_moving_mean(rate, 0.1))
    np.testing.assert_allclose(axis.axis, mounting.inv().apply([0.0, 0.0, 1.0]), atol=0.03)


def test_noise_shows_no_mounting():
    noise = np.random.default_rng(1).normal(0.0, 1.0, (T.size, 3))
    assert find_forward_yaw_rad(np.column_stack((SPEED, YAW_RATE)), noise, 0.0) is None
    assert find_yaw_axis(compute_moving_mean(YAW_RATE[:, None], 0.1)[:, 0], compute_moving_mean(noise, 0.1)) is None


def test_a_mounting_that_changes_halfway_is_none():
    (_, force), (_, later) = (felt(Rotation.from_euler("z", yaw, degrees=True)) for yaw in (0, 80))
    force[T.size // 2 :] = later[T.size // 2 :]
    assert find_forward_yaw_rad(np.column_stack((SPEED, YAW_RATE)), force, 0.0) is None


def test_a_mounting_near_the_axes_is_taken_as_along_them():
    turned = Rotation.from_euler("xyz", (92.0, 3.0, -88.0), degrees=True).as_matrix()
    np.testing.assert_allclose(
        find_nearest_mounting(turned), Rotation.from_euler("xyz", (90, 0, -90), degrees=True).as_matrix(), atol=1e-12
    )
    tilted = Rotation.from_euler("y", 30.0, degrees=True).as_matrix()
    np.testing.assert_array_equal(find_nearest_mounting(tilted), tilted)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, -0.6, 0.8)])
def test_levelling_turns_up_to_z(up):
    level = compute_levelling_rotation(np.array(up))
    np.testing.assert_allclose(level @ up, [0.0, 0.0, 1.0], atol=1e-12)
    assert np.linalg.det(level) == pytest.approx(1.0)


def test_up_is_told_by_what_force_there_is():
    assert find_up_axis(np.zeros((3, 3))) == pytest.approx([0.0, 0.0, 1.0])
    assert find_up_axis(np.array([[0.0, 0.0, 0.0], [0.0, 9.8, 0.0]])) == pytest.approx([0.0, 1.0, 0.0])
