"""What the poses of an odometry tell of its velocity: the way from pose to pose, and along whose axes its twist is.

By nav_msgs/Odometry a twist is along the axes of its child frame, the robot's. Some drivers write it along those of the pose's frame, as
the derivative of the position is: then the velocity of a robot that only drives forward turns round with its yaw.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.geometry.rotation import invert, multiply, normalize, rotate, rotation_vector_from_quat

_MAX_INCREMENT_S = 1.0
_MOVED_M = 0.1
_FEWEST = 20
_MOVES_MPS = 0.2
_FITS, _FITS_NOT = 0.1, 0.3
_TURNED_RAD = 0.2

Floats = NDArray[np.float64]


def has_twist(velocity_mps: Floats, pose_m: Floats) -> bool:
    """Whether the velocities are measurements: finite somewhere, and not zero throughout while the poses move."""
    known = np.isfinite(velocity_mps).any(1)
    if not known.any():
        return False
    posed = pose_m[np.isfinite(pose_m).all(1)]
    moves = posed.size > 0 and float(np.ptp(posed, axis=0).max()) > _MOVED_M
    return bool(np.nansum(np.abs(velocity_mps[known])) > 0) or not moves


def compute_increments(
    stamp_ns: NDArray[np.int64], pose_m: Floats, quat_xyzw: Floats
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Return stamps, velocity and angular velocity in the child frame, in the middle of each two successive poses."""
    stamp, position, quat = _select_posed_rows(stamp_ns, pose_m, quat_xyzw)
    step_ns = np.diff(stamp)
    step_s = np.asarray(step_ns, np.float64)[:, None] * 1e-9
    turn = rotation_vector_from_quat(multiply(invert(quat[:-1]), quat[1:]))
    velocity = rotate(invert(_interpolate_half_way(quat[:-1], quat[1:])), np.diff(position, axis=0)) / step_s
    near = step_s[:, 0] <= _MAX_INCREMENT_S
    return stamp[:-1][near] + step_ns[near] // 2, velocity[near], (turn / step_s)[near]


def compute_orientation_rates(
    stamp_ns: NDArray[np.int64], rate_radps: Floats, quat_xyzw: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return angular velocities, by the orientation about every axis about which it turns while they are missing or zero throughout.

    Parameters
    ----------
    stamp_ns : [ns], shape (N,), not decreasing.
    rate_radps : in the child frame, shape (N, 3), NaN where not measured.
    quat_xyzw : shape (N, 4), NaN without.

    Returns
    -------
    Angular velocities, shape (N, 3), and which axes are the orientation's, shape (3,).
    """
    zero = (np.nan_to_num(rate_radps) == 0.0).all(axis=0)
    known = np.flatnonzero(np.isfinite(quat_xyzw).all(axis=1))
    known = known[np.concatenate(([True], np.diff(stamp_ns[known]) > 0))] if known.size else known
    if not zero.any() or known.size < _FEWEST:
        return rate_radps, np.zeros(3, np.bool_)
    stamp, quat = stamp_ns[known], quat_xyzw[known]
    turned_rad = np.cumsum(rotation_vector_from_quat(multiply(invert(quat[:-1]), quat[1:])), axis=0)
    turns = zero & (np.ptp(turned_rad, axis=0) > _TURNED_RAD)
    # Over two steps, so that the rate is that in the middle, at the stamp itself.
    step_s = (stamp[2:] - stamp[:-2])[:, None] * 1e-9
    rate = rotation_vector_from_quat(multiply(invert(quat[:-2]), quat[2:])) / step_s
    inner, near = known[1:-1], step_s[:, 0] <= _MAX_INCREMENT_S
    rates = np.where(turns, np.nan, rate_radps)
    rates[inner[near]] = np.where(turns, rate[near], rate_radps[inner[near]])
    return rates, turns


def is_along_pose_axes(stamp_ns: NDArray[np.int64], velocity_mps: Floats, pose_m: Floats, quat_xyzw: Floats) -> bool:
    """Return whether velocities are surely along the axes of the pose's frame: its increments fit them so, and not turned by the pose.

    Parameters
    ----------
    stamp_ns : [ns], shape (N,). velocity_mps : shape (N, 3), NaN where an axis is not told. pose_m, quat_xyzw : shapes (N, 3), (N, 4).
    """
    known = np.isfinite(velocity_mps[:, :2]).all(1) & np.isfinite(pose_m).all(1) & np.isfinite(quat_xyzw).all(1)
    stamp, place, quat = stamp_ns[known], pose_m[known, :2], quat_xyzw[known]
    told = np.nan_to_num(velocity_mps[known])
    step_s = np.diff(stamp) * 1e-9
    good = (step_s > 0) & (step_s <= _MAX_INCREMENT_S)
    way = np.diff(place, axis=0)[good] / step_s[good, None]
    moving = np.linalg.norm(way, axis=1) > _MOVES_MPS
    if moving.sum() < _FEWEST:
        return False
    turned = rotate(quat, told)
    as_told, as_turned = (_compute_misfit((v[1:] + v[:-1])[good, :2] / 2.0, way, moving) for v in (told, turned))
    return as_told < _FITS and as_turned > _FITS_NOT


def rotate_to_child_axes(velocity_mps: Floats, quat_xyzw: Floats) -> Floats:
    """Return velocities (N, 3) that are along the pose's axes along those of the child frame; NaN where the pose is none."""
    turned = rotate(invert(quat_xyzw), np.nan_to_num(velocity_mps))
    turned[np.isnan(velocity_mps)] = np.nan
    return np.where(np.isfinite(quat_xyzw).all(1, keepdims=True), turned, np.nan)


def _compute_misfit(said: Floats, way: Floats, moving: NDArray[np.bool_]) -> float:
    """Return the share of the squares of a way that a velocity, whatever its scale, leaves unexplained (medians: poses may jump)."""
    size = np.linalg.norm(way[moving], axis=1)
    scale = np.median(np.linalg.norm(said[moving], axis=1) / size)
    return float(np.median(np.sum((said[moving] - scale * way[moving]) ** 2, axis=1) / (scale * size) ** 2))


def _select_posed_rows(
    stamp_ns: NDArray[np.int64], pose_m: Floats, quat_xyzw: Floats
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Return the rows with a pose, in order of time, one a stamp."""
    posed = np.flatnonzero(np.isfinite(pose_m).all(1) & np.isfinite(quat_xyzw).all(1))
    _, first = np.unique(stamp_ns[posed], return_index=True)
    rows = posed[first]
    return stamp_ns[rows], pose_m[rows], quat_xyzw[rows]


def _interpolate_half_way(a: Floats, b: Floats) -> Floats:
    """Rotation half-way between two: the normalised sum of the quaternions of one hemisphere."""
    sign = np.where(np.sum(a * b, axis=-1, keepdims=True) < 0, -1.0, 1.0)
    return normalize(a + sign * b)
