"""Rotations and angles against scipy and by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tcpipe.geometry import rotation
from tcpipe.geometry.rotation import wrap_to_pi

QUAT = Rotation.random(200, rng=np.random.default_rng(1)).as_quat(canonical=True)
OTHER = Rotation.random(200, rng=np.random.default_rng(2)).as_quat(canonical=True)


def test_matrix_of_quaternion_is_scipys():
    assert np.allclose(rotation.matrix_from_quat(QUAT), Rotation.from_quat(QUAT).as_matrix(), atol=1e-14)


def test_quaternion_of_matrix_is_scipys_also_at_half_turns():
    half_turns = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0.6, 0.8, 0, 0]])
    for quat in (QUAT, half_turns):
        found = rotation.quat_from_matrix(Rotation.from_quat(quat).as_matrix())
        assert np.allclose(np.abs(np.sum(found * quat, -1)), 1, atol=1e-14)
    assert np.all(found[..., 3] >= 0)


def test_roll_pitch_yaw_turn_about_fixed_axes():
    rpy = Rotation.from_quat(QUAT).as_euler("xyz")
    assert np.allclose(rotation.rpy_from_quat(QUAT), rpy, atol=1e-12)
    assert np.allclose(rotation.quat_from_rpy(*rpy.T), QUAT, atol=1e-12)
    # By hand: yaw by a quarter turn takes forward (x) to left (y); positive pitch puts the nose down.
    assert np.allclose(rotation.rotate(rotation.quat_from_rpy(0, 0, np.pi / 2), [1, 0, 0]), [0, 1, 0])
    assert rotation.rotate(rotation.quat_from_rpy(0, 0.1, 0), [1, 0, 0])[2] == pytest.approx(-np.sin(0.1))


def test_yaw_of_half_a_turn_is_minus_pi():
    assert rotation.rpy_from_matrix(np.diag([-1.0, -1.0, 1.0]))[2] == -np.pi


def test_product_inverse_and_rotate_are_scipys():
    a, b = Rotation.from_quat(QUAT), Rotation.from_quat(OTHER)
    assert np.allclose(rotation.multiply(QUAT, OTHER), (a * b).as_quat(canonical=True), atol=1e-13)
    assert np.allclose(rotation.multiply(QUAT, rotation.invert(QUAT)), [0, 0, 0, 1], atol=1e-13)
    vector = np.random.default_rng(3).normal(size=(200, 3))
    assert np.allclose(rotation.rotate(QUAT, vector), a.apply(vector), atol=1e-13)


def test_exponential_and_logarithm_are_scipys_also_near_zero():
    vector = Rotation.from_quat(QUAT).as_rotvec()
    for scale in (1.0, 1e-5, 1e-14, 0.0):
        quat = rotation.quat_from_rotation_vector(vector * scale)
        assert np.allclose(quat, Rotation.from_rotvec(vector * scale).as_quat(canonical=True), atol=1e-15)
        assert np.allclose(rotation.rotation_vector_from_quat(quat), vector * scale, rtol=1e-9, atol=1e-18)


def test_unusable_quaternions_become_nan():
    quat = rotation.normalize([[0, 0, 0, 0.0], [np.nan, 0, 0, 1], [0, 0, 0, -2.0], [np.inf, 0, 0, 1]])
    assert np.isnan(quat[[0, 1, 3]]).all()
    assert quat[2].tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [
        (0.0, 0.0),
        (np.pi, -np.pi),
        (-np.pi, -np.pi),
        (3 * np.pi, -np.pi),
        (7.0, 7.0 - 2 * np.pi),
        (-4.0, 2 * np.pi - 4.0),
    ],
)
def test_wrap(angle, wrapped):
    assert wrap_to_pi(angle) == pytest.approx(wrapped, abs=1e-12)


def test_wrap_stays_in_the_half_open_interval():
    angle = np.nextafter(np.pi * np.arange(-41, 42, 2), np.repeat([-1e9], 41 + 1))
    assert np.all((wrap_to_pi(angle) >= -np.pi) & (wrap_to_pi(angle) < np.pi))
