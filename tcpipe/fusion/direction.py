"""Direction of travel of a robot that only an antenna follows: its fixes look the same whether it drives forward or backward."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import Trajectory
from tcpipe.fusion.signals import compute_median_period_ns
from tcpipe.geometry.rotation import matrix_from_quat, multiply

Floats = NDArray[np.float64]

_COMMANDED_MPS = 0.05  # slower commands show no direction
_SHOWN_M = 0.2  # a shorter drive in one direction may be noise of a stationary robot
_HALF_TURN = np.array([0.0, 0.0, 1.0, 0.0])


def assume_forward(found: Trajectory, arm_m: tuple[float, float, float], commanded_mps: Floats) -> Trajectory:
    """Return the trajectory of an antenna with a robot that drives forward, or backward where it is commanded to.

    Where the estimate drives the other way, the robot is turned by half a turn about its z axis. The antenna stays in its place.

    Parameters
    ----------
    arm_m : [m], position of the antenna in base_link.
    commanded_mps : [m/s], shape (N,), commanded forward velocity; NaN where unknown.
    """
    rotation, velocity = matrix_from_quat(found.quat_xyzw), found.velocity_enu_mps
    ahead_mps = np.sum(rotation[:, :, 0] * velocity, axis=1) * np.where(commanded_mps < -_COMMANDED_MPS, -1.0, 1.0)
    # Rows up to the next change of sign are one drive; short ones keep the direction of the one before.
    part = np.cumsum(np.diff(np.sign(ahead_mps), prepend=0.0) != 0.0)
    period_s = compute_median_period_ns(found.stamp_ns) * 1e-9
    shown = np.flatnonzero(period_s * np.bincount(part, np.abs(ahead_mps))[part] > _SHOWN_M)
    if not shown.size:
        return found
    last = np.searchsorted(shown, np.arange(part.size), "right") - 1
    turned = (ahead_mps[shown[np.maximum(last, 0)]] < 0.0)[:, None]
    moved_m = 2.0 * np.array([*arm_m[:2], 0.0])
    moved_mps = np.cross(found.angular_velocity_radps, moved_m)
    return replace(
        found,
        position_enu_m=found.position_enu_m + turned * (rotation @ moved_m),
        quat_xyzw=np.where(turned, multiply(found.quat_xyzw, _HALF_TURN), found.quat_xyzw),
        velocity_enu_mps=velocity + turned * np.einsum("nij,nj->ni", rotation, moved_mps),
        angular_velocity_radps=found.angular_velocity_radps * np.where(turned, [-1.0, -1.0, 1.0], 1.0),
    )
