"""Rotations of an IMU's mounting: gravity shows its up, since a robot stands upright on average."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.geometry.rotation import matrix_from_quat, quat_from_rotation_vector

_MIN_STEADINESS = 0.4
"""Least length of the mean direction of the force that shows up [1]: that of a unit whose gravity is removed changes."""
_AXIS_ALIGNED_RAD = 0.25
"""Angle within which a mounting is taken as along the axes."""

Floats = NDArray[np.float64]


def find_up_axis(force: Floats) -> Floats:
    """Return the mean direction of the specific force (N, 3), shape (3,); z where the force has no steady direction."""
    size = np.linalg.norm(force, axis=1, keepdims=True)
    mean: Floats = np.mean(np.divide(force, size, out=np.zeros_like(force), where=size > 0), axis=0)
    length = np.linalg.norm(mean)
    return mean / length if length > _MIN_STEADINESS else np.array([0.0, 0.0, 1.0])


def compute_levelling_rotation(up: Floats) -> Floats:
    """Return the smallest rotation, as a matrix (3, 3), that turns a unit vector to +z."""
    cross = np.cross(up, [0.0, 0.0, 1.0])
    size = float(np.linalg.norm(cross))
    if size < 1e-9:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    matrix: Floats = matrix_from_quat(quat_from_rotation_vector(cross / size * np.arctan2(size, up[2])))
    return matrix


def find_nearest_mounting(base_from_sensor: Floats) -> Floats:
    """Return the rotation (3, 3) with axes along axes that is nearest, or the given one where none is near."""
    largest = np.argmax(np.abs(base_from_sensor), axis=1)
    aligned = np.zeros((3, 3))
    aligned[np.arange(3), largest] = np.sign(base_from_sensor[np.arange(3), largest])
    if abs(np.linalg.det(aligned) - 1.0) > 1e-9:
        return base_from_sensor
    angle = np.arccos(np.clip((np.trace(aligned.T @ base_from_sensor) - 1) / 2, -1.0, 1.0))
    return aligned if angle < _AXIS_ALIGNED_RAD else base_from_sensor


def rotate_about_z(yaw_rad: float) -> Floats:
    """Return the rotation (3, 3) by a yaw."""
    return matrix_from_quat(quat_from_rotation_vector(np.array([0.0, 0.0, yaw_rad])))
