"""Rotations: quaternions (x, y, z, w), matrices, rotation vectors, and roll, pitch, yaw of REP-103.

A rotation ``a_from_b`` transforms coordinates in b to coordinates in a: ``v_a = a_from_b @ v_b``. Roll, pitch and yaw
turn about the fixed axes x, y, z in this order: R = Rz(yaw) Ry(pitch) Rx(roll). All functions work on stacks: shape
(..., 4), (..., 3) or (..., 3, 3).

Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter", 2017 (arXiv 1711.02508), sections 1 to 3;
the quaternion of a matrix follows S. W. Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1 (3),
1978.
"""

import numpy as np
from numpy.typing import ArrayLike

from tcpipe.arrays import Floats


def wrap_to_pi(angle_rad: ArrayLike) -> Floats:
    """Return the same directions in [-pi, pi).

    Parameters
    ----------
    angle_rad : [rad], any shape.

    Returns
    -------
    [rad], the same shape; values that are not finite do not change.
    """
    angle = np.asarray(angle_rad, float)
    wrapped = angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))
    # Rounding may land on +pi itself, or a hair below -pi.
    return np.maximum(np.where(wrapped >= np.pi, -np.pi, wrapped), -np.pi)


def normalize(quat_xyzw: ArrayLike) -> Floats:
    """Return quaternions of unit length with w >= 0; NaN where the length is zero or not finite. Shape (..., 4)."""
    quat = np.asarray(quat_xyzw, float)
    length = np.linalg.norm(quat, axis=-1, keepdims=True)
    usable = np.isfinite(length) & (length > 1e-9)
    unit = np.where(usable, quat, np.nan) / np.where(usable, length, 1.0)
    return np.where(unit[..., 3:] < 0, -unit, unit)


def matrix_from_quat(quat_xyzw: ArrayLike) -> Floats:
    """Return the rotation matrix (..., 3, 3) of unit quaternions (..., 4). Solà eq. 115."""
    x, y, z, w = np.moveaxis(np.asarray(quat_xyzw, float), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quat_from_matrix(rotation: ArrayLike) -> Floats:
    """Return unit quaternions (..., 4), w >= 0, of rotation matrices (..., 3, 3); divides by the largest component."""
    R = np.asarray(rotation, float)
    trace = np.trace(R, axis1=-2, axis2=-1)
    # Each row is the quaternion times four times one of its own components.
    candidates = np.empty((*R.shape[:-2], 4, 4))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        candidates[..., i, i] = 1 + 2 * R[..., i, i] - trace
        candidates[..., i, j] = candidates[..., j, i] = R[..., i, j] + R[..., j, i]
        candidates[..., i, 3] = candidates[..., 3, i] = R[..., k, j] - R[..., j, k]
    candidates[..., 3, 3] = 1 + trace
    best = np.argmax(np.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    return normalize(np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :])


def quat_from_rpy(roll_rad: ArrayLike, pitch_rad: ArrayLike, yaw_rad: ArrayLike) -> Floats:
    """Return unit quaternions (..., 4) of fixed-axis roll, pitch, yaw [rad]."""
    r, p, y = np.broadcast_arrays(*(np.asarray(a, float) / 2 for a in (roll_rad, pitch_rad, yaw_rad)))
    sr, cr, sp, cp, sy, cy = np.sin(r), np.cos(r), np.sin(p), np.cos(p), np.sin(y), np.cos(y)
    return normalize(
        np.stack(
            (
                sr * cp * cy - cr * sp * sy,
                cr * sp * cy + sr * cp * sy,
                cr * cp * sy - sr * sp * cy,
                cr * cp * cy + sr * sp * sy,
            ),
            -1,
        )
    )


def rpy_from_matrix(rotation: ArrayLike) -> Floats:
    """Return roll, pitch, yaw [rad] (..., 3), [-pi, pi), pitch in [-pi/2, pi/2], of rotation matrices (..., 3, 3)."""
    R = np.asarray(rotation, float)
    pitch = np.arcsin(np.clip(-R[..., 2, 0], -1.0, 1.0))
    rpy = np.stack((np.arctan2(R[..., 2, 1], R[..., 2, 2]), pitch, np.arctan2(R[..., 1, 0], R[..., 0, 0])), -1)
    return np.where(rpy >= np.pi, -np.pi, rpy)


def rpy_from_quat(quat_xyzw: ArrayLike) -> Floats:
    """Return roll, pitch, yaw [rad] (..., 3) of unit quaternions (..., 4)."""
    return rpy_from_matrix(matrix_from_quat(quat_xyzw))


def multiply(a_from_b_xyzw: ArrayLike, b_from_c_xyzw: ArrayLike) -> Floats:
    """Return a_from_c (..., 4), w >= 0: the quaternion product. Solà eq. 12."""
    x1, y1, z1, w1 = np.moveaxis(np.asarray(a_from_b_xyzw, float), -1, 0)
    x2, y2, z2, w2 = np.moveaxis(np.asarray(b_from_c_xyzw, float), -1, 0)
    return normalize(
        np.stack(
            (
                w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
                w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
                w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
                w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            ),
            -1,
        )
    )


def invert(a_from_b_xyzw: ArrayLike) -> Floats:
    """Return b_from_a (..., 4) of unit quaternions: the conjugate."""
    return np.asarray(np.asarray(a_from_b_xyzw, float) * np.array([-1.0, -1.0, -1.0, 1.0]))


def rotate(a_from_b_xyzw: ArrayLike, vector: ArrayLike) -> Floats:
    """Return vectors (..., 3) given in b as coordinates in a."""
    return np.asarray(np.einsum("...ij,...j->...i", matrix_from_quat(a_from_b_xyzw), np.asarray(vector)))


def quat_from_rotation_vector(rotation_vector_rad: ArrayLike) -> Floats:
    """Return the exponential: unit quaternions (..., 4) of rotation vectors [rad] (..., 3). Solà eq. 101."""
    vector = np.asarray(rotation_vector_rad, float)
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    half_sinc = 0.5 * np.sinc(angle / (2 * np.pi))
    return normalize(np.concatenate((half_sinc * vector, np.cos(angle / 2)), -1))


def rotation_vector_from_quat(quat_xyzw: ArrayLike) -> Floats:
    """Return rotation vectors [rad] (..., 3), length in [0, pi], of quaternions (..., 4): logarithm, Solà eq. 105."""
    quat = normalize(quat_xyzw)
    sine = np.linalg.norm(quat[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quat[..., 3:])
    return quat[..., :3] * np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 2.0)
