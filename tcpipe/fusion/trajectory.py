"""What an estimator returns: the state of base_link at the wanted stamps, how certain it is, and what was refused on the way.

Both estimators are called alike::

    run_error_state(measurements, initial, *, output_ns, gate_probability, smooth=True) -> Trajectory
    run_ukf15(measurements, initial, *, output_ns, gate_probability, engine) -> Trajectory

``output_ns`` are the wanted stamps, increasing, inside the span of the measurements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.tables.facts import StretchFacts

DISPLACEMENT_LAGS_S = (0.5, 1.0, 2.0, 4.0)
"""Durations over which a smoother tells the uncertainty of a displacement [s]."""


@dataclass(frozen=True, slots=True)
class Rejections:
    """Measurements that the gate refused, in time order.

    Attributes
    ----------
    stamp_ns : [ns], shape (M,), int64.
    role : shape (M,), str; gnss, gnss_velocity, imu, wheel_odometry or visual_odometry.
    reason : shape (M,), str; gate (chi-square), invalid (not finite) or covariance (unusable).
    normalized_innovation_squared : [1], shape (M,); NaN where it was not computed.
    threshold : [1], shape (M,), the gate; NaN where it was not computed.
    """

    stamp_ns: NDArray[np.int64]
    role: NDArray[np.str_]
    reason: NDArray[np.str_]
    normalized_innovation_squared: NDArray[np.float64]
    threshold: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Trajectory:
    """States of base_link at ``stamp_ns``.

    Attributes
    ----------
    stamp_ns : [ns], shape (N,), int64: exactly the wanted stamps.
    position_enu_m, position_std_m : [m], shape (N, 3).
    quat_xyzw : shape (N, 4), enu_from_base_link, unit length.
    velocity_enu_mps : [m/s], shape (N, 3), velocity of base_link.
    angular_velocity_radps : [rad/s], shape (N, 3), base_link axes.
    yaw_std_rad : [rad], shape (N,).
    forward_velocity_std_mps : [m/s], shape (N,), of the velocity along base_link's x axis.
    rejections : what the gate refused.
    displacement_std_m : [m], shape (N, 4), of the horizontal displacement from each row to the one `DISPLACEMENT_LAGS_S` later, along
        its direction, the correlation of both ends counted exactly; NaN where no row stands there, and throughout in a forward filter,
        which does not know it. In between the variance may be interpolated in time, from zero at no time.
    facts : what the filter counted and settled on.
    """

    stamp_ns: NDArray[np.int64]
    position_enu_m: NDArray[np.float64]
    quat_xyzw: NDArray[np.float64]
    velocity_enu_mps: NDArray[np.float64]
    angular_velocity_radps: NDArray[np.float64]
    position_std_m: NDArray[np.float64]
    yaw_std_rad: NDArray[np.float64]
    forward_velocity_std_mps: NDArray[np.float64]
    rejections: Rejections
    displacement_std_m: NDArray[np.float64]
    facts: StretchFacts
