"""Attitude of a pose from another program (LIO, SLAM, motion capture), in the ENU plane and in robot axes.

A pose gives position and attitude of its sensor in one frame. If the frame belongs to a CRS, its axes are those of the
grid, and positions in both frames determine the angle between them. The mounting of a sensor with unknown extrinsics
comes from the motion: the robot drives forward and is upright on average.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tcpipe.arrays import Floats
from tcpipe.fusion.measurements import UNMEASURED_RAD2, BodyVelocities, Positions
from tcpipe.geometry.rotation import (
    invert,
    matrix_from_quat,
    multiply,
    quat_from_matrix,
    quat_from_rpy,
    rotate,
    rotation_vector_from_quat,
)
from tcpipe.robust import MEDIAN_OF_SQUARES

STATED_MOUNTING_STD_RAD, UNSTATED_MOUNTING_STD_RAD = 0.0175, 0.1
_MIN_COUNT = 20  # fewest attitudes, and fewest chords [1]
_CHORD_NS = 1_000_000_000  # duration of a chord


def add_attitude(
    fixes: Positions, frame_m: Floats, quat_xyzw: Floats, variance_rad2: Floats, mounting_xyzw: tuple[float, ...]
) -> Positions:
    """Return positions with the attitude of the robot.

    Parameters
    ----------
    fixes : positions of a pose in the ENU plane.
    frame_m : [m], shape (N, 2), the same positions in the frame of the pose.
    quat_xyzw, variance_rad2 : frame_from_sensor, shape (N, 4), and its variance about the frame's axes, shape (N, 3);
    NaN where unknown.
    mounting_xyzw : base_link_from_sensor.
    """
    known = np.isfinite(quat_xyzw).all(1)
    if known.sum() < _MIN_COUNT:
        return fixes
    east, frame = ((xy - xy.mean(0))[:, :2] @ np.array([1.0, 1j]) for xy in (fixes.position_enu_m, frame_m))
    grid_north_rad = np.angle(np.sum(east * np.conj(frame)))
    quat = multiply(multiply(quat_from_rpy(0.0, 0.0, grid_north_rad), quat_xyzw), invert(mounting_xyzw))
    observed_rad2 = np.median(np.square(np.diff(compute_turns(quat[known]), axis=0)), axis=0) / MEDIAN_OF_SQUARES / 6.0
    # Other programs may state no variance, or an arbitrary one; the lower bound is 3 mrad, the best localization.
    stated_rad2 = np.where(np.isfinite(variance_rad2), variance_rad2, 0.01**2)
    stated_rad2[:, :2] = stated_rad2[:, :2].mean(1, keepdims=True)  # one value for roll and pitch, independent of yaw
    variance = np.maximum(stated_rad2, np.maximum(observed_rad2, 0.003**2))  # lower bound [rad²]
    if np.ptp(matrix_from_quat(quat_xyzw[known])[:, 2], axis=0).max() < 1e-6:  # a pose in the plane measures only yaw
        variance[:, :2] = UNMEASURED_RAD2
    return replace(
        fixes,
        quat_xyzw=quat,
        rotation_variance_rad2=variance,
        mounting_xyzw=tuple(np.asarray(mounting_xyzw).tolist()),
        mounting_std_rad=STATED_MOUNTING_STD_RAD,
    )


def compute_turns(quat_xyzw: Floats, rows: int = 1) -> Floats:
    """Return rotation vectors [rad], shape (N - rows, 3), from each attitude to the one ``rows`` later, in its axes."""
    return rotation_vector_from_quat(multiply(invert(quat_xyzw[:-rows]), quat_xyzw[rows:]))


def align_mounting(fixes: Positions, odometry: BodyVelocities | None, *, is_stated: bool) -> Positions:
    """Return positions with the attitude of a robot that drives along its x axis; the odometry gives the sign.

    A stated mounting is replaced only if the motion contradicts it. Without a stated mounting, a robot that hardly
    drives gets no attitude. Source: the TRIAD method, with the direction of motion first and the vertical second (H. D.
    Black, "A passive system for determining the attitude of a satellite", AIAA Journal 2 (7), 1964).
    """
    if fixes.quat_xyzw is None:
        return fixes
    without = fixes if is_stated else replace(fixes, quat_xyzw=None, rotation_variance_rad2=None)
    stamp_ns, quat = fixes.stamp_ns, fixes.quat_xyzw
    last = np.searchsorted(stamp_ns, stamp_ns + _CHORD_NS)
    first = np.flatnonzero(last < stamp_ns.size)
    last = last[first]
    way = fixes.position_enu_m[last] - fixes.position_enu_m[first]
    length = np.linalg.norm(way, axis=1)
    turned = np.linalg.norm(rotation_vector_from_quat(multiply(invert(quat[first]), quat[last])), axis=1)
    # Least length [m] and largest turn [rad] of a chord.
    straight = (length > 0.3) & (turned < 0.1) & (stamp_ns[last] - stamp_ns[first] < 2 * _CHORD_NS)
    if straight.sum() < _MIN_COUNT:
        return without
    middle = (first + last)[straight] // 2
    direction = rotate(invert(quat[middle]), way[straight] / length[straight, None])
    if odometry is not None:
        forward = np.interp(stamp_ns[middle], odometry.stamp_ns, odometry.velocity_mps[:, 0])
        direction *= np.sign(forward)[:, None]
    ahead = np.nanmedian(direction, axis=0)
    up = np.nanmean(matrix_from_quat(quat)[:, 2], axis=0)
    aside = np.cross(up, ahead)
    if np.linalg.norm(aside) < 0.5 * np.linalg.norm(up) or np.linalg.norm(ahead) < 0.5:
        return without
    x, y = ahead / np.linalg.norm(ahead), aside / np.linalg.norm(aside)
    turn = quat_from_matrix(np.stack((x, y, np.cross(x, y))))
    if is_stated and np.linalg.norm(rotation_vector_from_quat(turn)) < 0.25:  # slopes cause about half
        return fixes
    mounting = tuple(multiply(turn, fixes.mounting_xyzw).tolist())
    quat = multiply(quat, invert(turn))
    return replace(fixes, quat_xyzw=quat, mounting_xyzw=mounting, mounting_std_rad=UNSTATED_MOUNTING_STD_RAD)
