"""Mountings, units and signs told from made motion, against the rotation that was put in (by scipy)."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tcpipe.fusion.checks.motions import (
    GRID_NS,
    GRID_S,
    average,
    compute_acceleration,
    find_lag,
    resample_imu,
)
from tcpipe.fusion.checks.sanity import find_nearest_mounting
from tcpipe.fusion.level_motion import compute_levelling_rotations
from tcpipe.fusion.measurements import InertialMeasurements

GRAVITY_MPS2 = 9.80665
T = np.arange(0.0, 120.0, GRID_S)
SPEED = np.clip(np.minimum(np.mod(T, 12.0) - 2.0, 10.5 - np.mod(T, 12.0)), 0.0, 1.0)
YAW_RATE = 0.4 * np.sin(0.9 * T) * (SPEED > 0)


TWIST = np.column_stack((SPEED, YAW_RATE))


def felt(base_from_sensor: Rotation, seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Angular velocity and specific force of a unit mounted so, with vibration."""
    rng = np.random.default_rng(seed)
    force = np.column_stack((np.gradient(SPEED, GRID_S), SPEED * YAW_RATE, np.full(T.size, GRAVITY_MPS2)))
    force += rng.normal(0.0, 0.5, force.shape)
    rate = np.column_stack((np.zeros((T.size, 2)), YAW_RATE)) + rng.normal(0.0, 0.02, force.shape)
    return base_from_sensor.inv().apply(rate), base_from_sensor.inv().apply(force)


def levelled(rate: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    at_ns = np.arange(T.size, dtype=np.int64) * GRID_NS
    return resample_imu(InertialMeasurements(at_ns, rate, force, np.full((T.size, 4), np.nan), 0.02, 0.5), at_ns)


MOUNTINGS = [(0, 0, 0), (180, 0, 90), (90, 0, -90), (0, 35, 100), (-20, -60, 170)]


@pytest.mark.parametrize("rpy_deg", MOUNTINGS)
def test_a_mounting_is_found_from_gravity_and_acceleration(rpy_deg):
    mounting = Rotation.from_euler("xyz", rpy_deg, degrees=True)
    turn, horizontal, level = levelled(*felt(mounting))
    np.testing.assert_allclose(level @ level.T, np.eye(3), atol=1e-12)
    yaw = np.angle(find_lag(compute_acceleration(TWIST), horizontal).factor)
    found = Rotation.from_euler("z", yaw) * Rotation.from_matrix(level)
    assert (found * mounting.inv()).magnitude() < 0.1
    assert find_lag(average(YAW_RATE, 0.1), average(turn, 0.1)).factor == pytest.approx(1.0, abs=0.05)


def test_noise_shows_no_mounting():
    noise = np.random.default_rng(1).normal(0.0, 1.0, (T.size, 3))
    turn, horizontal, _ = levelled(noise, noise)
    lags = find_lag(average(YAW_RATE, 0.1), average(turn, 0.1)), find_lag(compute_acceleration(TWIST), horizontal)
    assert all(lag is None or lag.explained < 0.1 for lag in lags)


def test_a_mounting_near_the_axes_is_taken_as_along_them():
    turned = Rotation.from_euler("xyz", (92.0, 3.0, -88.0), degrees=True).as_matrix()
    np.testing.assert_allclose(
        find_nearest_mounting(turned), Rotation.from_euler("xyz", (90, 0, -90), degrees=True).as_matrix(), atol=1e-12
    )
    tilted = Rotation.from_euler("y", 30.0, degrees=True).as_matrix()
    np.testing.assert_array_equal(find_nearest_mounting(tilted), tilted)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, -0.6, 0.8)])
def test_levelling_turns_up_to_z(up):
    (level,) = compute_levelling_rotations(np.array([up]))
    np.testing.assert_allclose(level @ up, [0.0, 0.0, 1.0], atol=1e-12)
    assert np.linalg.det(level) == pytest.approx(1.0)
