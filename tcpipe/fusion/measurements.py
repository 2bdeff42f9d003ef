"""Measurements for the estimators: arrays in base_link axes and in the datum's ENU plane, every number usable.

What the stage has already done when one of these exists: units and frames converted, mounting rotations applied (lever
arms are kept beside the values, since they act through the attitude), unusable rows taken out and counted, unknown or
absurd variances replaced and floored. Rows are sorted by stamp, without repetitions.

A run is cut into sections, which are fused one by one. A clock epoch is a section of its own: nothing is integrated
across a step of the clock. So is what follows a pause of all sensors of more than 5 s: the estimator does not carry its
certainty over it. Both estimators take the `Measurements` of a section, its `InitialState` and the wanted stamps,
increasing, inside the span of the measurements, and return a `Trajectory`: state of base_link, its uncertainty,
rejected measurements.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints, Mask
from tcpipe.fusion.signals import compute_median_period_ns, is_in_gap
from tcpipe.tables.facts import StretchFacts

GNSS, IMU, WHEELS, VISUAL, DOPPLER = "gnss", "imu", "wheel_odometry", "visual_odometry", "gnss_velocity"
"""Roles, as in the rejections table."""
_FIELDS = {GNSS: "gnss", DOPPLER: "doppler", IMU: "imu", WHEELS: "wheels", VISUAL: "visual"}
POSE = "pose"
FIXES = (GNSS, POSE)
"""Roles of positions: a pose is fused as fixes with an attitude."""

NO_TRUST = 1e6
"""Largest variances, of a kilometre or a kilometre a second; larger ones would cost digits of differences."""
NO_LEVER_ARM = (0.0, 0.0, 0.0)
STATED_ARM_STD_M = (0.05, 0.05, 0.1)
"""σ of a stated place of the antenna [m]: a tape measure, and the height of base_link over the ground."""
UNSTATED_ARM_STD_M = (0.5, 0.5, 0.5)
"""σ of a place that is not stated [m]: the antenna is on the robot."""


UNMEASURED_RAD2 = 1e2
"""Variance of a rotation about an axis that is not measured."""


@dataclass(frozen=True, slots=True)
class Positions:
    """GNSS: positions of an antenna. Or another program's pose: positions of a sensor, and the robot's attitude.

    Attributes
    ----------
    stamp_ns : [ns], shape (N,), int64, increasing.
    position_enu_m : [m], shape (N, 3), antenna in the ENU plane of the datum.
    variance_m2 : [m²], shape (N, 3), east, north, up; floored, never unknown.
    lever_arm_m, lever_arm_std_m : [m], position of the antenna in base_link, and its standard deviation; 0: known
    exactly.
    unclaimed : shape (N,), where the receiver claims none and the variance is the recipe's; None where it always claims
    one.
    quat_xyzw, rotation_variance_rad2 : attitude enu_from_base_link, shape (N, 4), NaN where absent, and variance about
        the robot's axes, shape (N, 3); None: no attitude is measured.
    mounting_xyzw, mounting_std_rad : base_link_from_sensor of a pose, stated or as the motion shows it, and σ about
    each axis.
    lag_std_s : [s], standard deviation of the delay of its stamps: drivers stamp on arrival.
    """

    stamp_ns: Ints
    position_enu_m: Floats
    variance_m2: Floats
    lever_arm_m: tuple[float, float, float] = NO_LEVER_ARM
    lever_arm_std_m: tuple[float, float, float] = STATED_ARM_STD_M
    unclaimed: Mask | None = None
    quat_xyzw: Floats | None = None
    rotation_variance_rad2: Floats | None = None
    mounting_xyzw: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    mounting_std_rad: float = 0.0
    lag_std_s: float = 0.02

    @property
    def has_claims(self) -> bool:
        """Whether the receiver claims a variance for most fixes."""
        return self.unclaimed is None or bool(self.unclaimed.mean() < 0.5)

    @property
    def has_heights(self) -> bool:
        """Whether any fix measures the height."""
        return bool((self.variance_m2[:, 2] < NO_TRUST).any())


@dataclass(frozen=True, slots=True)
class GroundVelocities:
    """A receiver's own velocity: that of the antenna of its fixes over ground, from Doppler.

    Attributes
    ----------
    stamp_ns : [ns], shape (N,), int64, increasing.
    velocity_enu_mps : [m/s], shape (N, 3), east, north, up; up is 0 where it is not measured, its variance `NO_TRUST`.
    variance_m2ps2 : [m²/s²], shape (N, 3); floored, never unknown.
    """

    stamp_ns: Ints
    velocity_enu_mps: Floats
    variance_m2ps2: Floats


@dataclass(frozen=True, slots=True)
class BodyVelocities:
    """Odometry: velocity of a point of the body, in base_link axes.

    Attributes
    ----------
    stamp_ns : [ns], shape (N,), int64, increasing. Middle of the interval where a velocity comes from two poses.
    velocity_mps : [m/s], shape (N, 3), velocity of the point at ``lever_arm_m``. Wheels: only x is measured, y and z
    are NaN.
    variance_m2ps2 : [m²/s²], shape (N, 3); NaN exactly where the velocity is.
    yaw_rate_radps : [rad/s], shape (N,), about base_link's z; NaN where the source gives none.
    lever_arm_m : [m], the measured point in base_link.
    turn_rate_radps : [rad/s], shape (N, 3), about all three axes of base_link, z as in ``yaw_rate_radps``; None where
        the source is flat (wheels) or gives none.
    """

    stamp_ns: Ints
    velocity_mps: Floats
    variance_m2ps2: Floats
    yaw_rate_radps: Floats
    lever_arm_m: tuple[float, float, float] = NO_LEVER_ARM
    turn_rate_radps: Floats | None = None

    @property
    def measured(self) -> Mask:
        """Axes along which most rows have a velocity, shape (3,)."""
        is_measured: Mask = (self.variance_m2ps2 < 1e3).mean(0) > 0.5  # above: not measured (ruling)
        return is_measured


@dataclass(frozen=True, slots=True)
class InertialMeasurements:
    """IMU, rotated into base_link axes by its mounting.

    Attributes
    ----------
    stamp_ns : [ns], shape (N,), int64, increasing.
    angular_velocity_radps : [rad/s], shape (N, 3), base_link axes.
    specific_force_mps2 : [m/s²], shape (N, 3), base_link axes; +g along the upward axis at rest.
    quat_xyzw : shape (N, 4), enu_from_base_link by the unit's own attitude filter; NaN where absent. Yaw may be
    magnetic or offset.
    gyro_std_radps, accelerometer_std_mps2 : white noise at the unit's rate, one axis.
    accelerometer_usable : False where the specific force is not one (gravity removed, other units): the gyroscope alone
    is used.
    accelerometer_noise_mps2 : the same around each sample, shape (N,): the motion causes vibration; None:
    the same throughout.
    """

    stamp_ns: Ints
    angular_velocity_radps: Floats
    specific_force_mps2: Floats
    quat_xyzw: Floats
    gyro_std_radps: float
    accelerometer_std_mps2: float
    accelerometer_usable: bool = True
    accelerometer_noise_mps2: Floats | None = None


Sensor = Positions | GroundVelocities | InertialMeasurements | BodyVelocities


@dataclass(frozen=True, slots=True)
class Measurements:
    """All measurements of one section of one clock epoch without a long gap; a role without measurements is None.

    At least one of ``gnss``, ``wheels`` and ``visual`` is there. ``nonholonomic_std_mps``: sideways and vertical body
    velocity are zero to within this. ``doppler`` is the velocity of the antenna of ``gnss``.
    """

    gnss: Positions | None = None
    imu: InertialMeasurements | None = None
    wheels: BodyVelocities | None = None
    visual: BodyVelocities | None = None
    nonholonomic_std_mps: float = 0.15
    doppler: GroundVelocities | None = None

    def sensors(self) -> dict[str, Sensor]:
        """Return the sensors that are there, by role."""
        every = {role: getattr(self, name) for role, name in _FIELDS.items()}
        return {role: sensor for role, sensor in every.items() if sensor is not None}

    def replace_sensors(self, changed: Mapping[str, Sensor | None]) -> Measurements:
        """Return the measurements with other sensors, by role; None takes one out."""
        named: dict[str, Any] = {_FIELDS[role]: sensor for role, sensor in changed.items()}
        return replace(self, **named)

    @property
    def is_antenna_alone(self) -> bool:
        """Whether only fixes, and a receiver's own velocity, measure motion: forward and backward look the same."""
        return self.gnss is not None and self.imu is None and not self.odometries() and not self.has_attitude

    @property
    def has_attitude(self) -> bool:
        """Whether a pose measures the attitude, or yaw alone."""
        return self.gnss is not None and self.gnss.quat_xyzw is not None

    @property
    def has_tilt(self) -> bool:
        """Whether an IMU or a pose measures roll and pitch, or a camera their changes."""
        return self.has_absolute_tilt or (self.visual is not None and self.visual.turn_rate_radps is not None)

    @property
    def has_absolute_tilt(self) -> bool:
        """Whether an IMU or a pose measures roll and pitch."""
        variance = None if self.gnss is None else self.gnss.rotation_variance_rad2
        return self.imu is not None or (variance is not None and float(variance[0, 0]) < UNMEASURED_RAD2)

    def odometries(self) -> dict[str, BodyVelocities]:
        """Return the odometries that are there, by role; the wheels' first."""
        every = {WHEELS: self.wheels, VISUAL: self.visual}
        return {role: odometry for role, odometry in every.items() if odometry is not None}

    def turning_odometries(self) -> dict[str, BodyVelocities]:
        """Return the odometries that have a yaw rate, by role: the wheels, which skid, then the camera."""
        every = self.odometries().items()
        return {role: odometry for role, odometry in every if np.isfinite(odometry.yaw_rate_radps).any()}

    @property
    def first_odometry(self) -> BodyVelocities | None:
        """The wheels, else visual odometry."""
        return self.wheels or self.visual


@dataclass(frozen=True, slots=True)
class InitialState:
    """Where a section starts, found offline from all of its data (`tcpipe.fusion.initial`).

    Attributes
    ----------
    position_enu_m, position_std_m : [m], shape (3,), base_link.
    quat_xyzw : shape (4,), enu_from_base_link.
    tilt_std_rad, yaw_std_rad : standard deviation of roll and pitch, and of yaw.
    velocity_enu_mps, velocity_std_mps : [m/s], shape (3,) and scalar.
    gyro_bias_radps : [rad/s], shape (3,); zero where the robot never stands.
    heading_from : how yaw was found: ``course over ground``, ``pose``, ``orientation``, ``local frame`` or ``unknown``.
    """

    position_enu_m: Floats
    position_std_m: Floats
    quat_xyzw: Floats
    tilt_std_rad: float
    yaw_std_rad: float
    velocity_enu_mps: Floats = field(default_factory=lambda: np.zeros(3))
    velocity_std_mps: float = 0.3
    gyro_bias_radps: Floats = field(default_factory=lambda: np.zeros(3))
    gyro_bias_std_radps: float = 0.02
    heading_from: str = "unknown"


_Source = TypeVar("_Source", bound=Sensor)


def select_measurements(whole: Measurements, start_ns: int, end_ns: int) -> Measurements:
    """Return the measurements between two stamps, both included; a sensor without any is None."""
    found: dict[str, Sensor | None] = {}
    for role, source in whole.sensors().items():
        rows = slice(*np.searchsorted(source.stamp_ns, (start_ns, end_ns + 1)))
        found[role] = select_sensor_rows(source, rows) if rows.stop > rows.start else None
    return whole.replace_sensors(found)


def select_sensor_rows(source: _Source, rows: slice | Mask) -> _Source:
    """Return a sensor with some of its rows."""
    values = {field.name: getattr(source, field.name) for field in fields(source)}
    chosen: dict[str, Any] = {name: value[rows] for name, value in values.items() if isinstance(value, np.ndarray)}
    return replace(source, **chosen)


DISPLACEMENT_LAGS_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
"""Durations over which a smoother states the uncertainty of a displacement [s]."""


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
    rejections : what the gate rejected, in time order: columns of the level REJECTIONS, shape (M,).
    displacement_std_m : [m], shape (N, 6), of the horizontal displacement from each row to the one
        `DISPLACEMENT_LAGS_S` later, along its direction, the correlation of both ends counted exactly; NaN where there
        is no such row, and throughout in a forward filter, which does not know it. In between the variance may be
        interpolated in time, from zero at no time.
    facts : what the filter counted and settled on.
    """

    stamp_ns: Ints
    position_enu_m: Floats
    quat_xyzw: Floats
    velocity_enu_mps: Floats
    angular_velocity_radps: Floats
    position_std_m: Floats
    yaw_std_rad: Floats
    forward_velocity_std_mps: Floats
    rejections: Mapping[str, NDArray[Any]]
    displacement_std_m: Floats
    facts: StretchFacts


PAUSE_NS = 5_000_000_000
"""A longer pause of all sensors begins a new section [ns]: the estimator does not carry its certainty over it."""


@dataclass(frozen=True, slots=True)
class TrackSection:
    """One section: its clock epoch, first and last stamp [ns] of a motion measurement, and its measurements."""

    clock_epoch: int
    start_ns: int
    end_ns: int
    measurements: Measurements


def cut_sections(measurements: Mapping[int, Measurements], cuts_ns: Sequence[int] = ()) -> list[TrackSection]:
    """Return the sections of measurements by clock epoch, in order of epoch and time, without those without motion.

    A section ends at a pause, and before each of the stamps ``cuts_ns`` of a measurement.
    """
    found = []
    for epoch in sorted(measurements):
        whole = measurements[epoch]
        stamp = _make_stamps(whole, with_imu=True)
        if stamp.size == 0:
            continue
        pause = np.flatnonzero((np.diff(stamp) > PAUSE_NS) | np.isin(stamp[1:], cuts_ns))
        first = stamp[np.concatenate(([0], pause + 1))]
        last = stamp[np.concatenate((pause, [stamp.size - 1]))]
        for start, end in zip(first.tolist(), last.tolist(), strict=True):
            inside = select_measurements(whole, start, end)
            motion = _make_stamps(inside, with_imu=False)
            if motion.size > 1:
                found.append(TrackSection(epoch, int(motion[0]), int(motion[-1]), inside))
    return found


def make_track_stamps(section: TrackSection, *, period_ns: int, max_gap_ns: int) -> Ints:
    """Return the multiples of the period inside a section [ns], without those in a gap.

    A gap is a time without any of GNSS, wheels and visual odometry longer than ``max_gap_ns`` and than 2.5 times their
    usual spacing: the IMU alone does not determine a track. A gap is a step in the stamps.
    """
    first = -(-section.start_ns // period_ns) * period_ns
    stamp = np.arange(first, section.end_ns + 1, period_ns, dtype=np.int64)
    motion = _make_stamps(section.measurements, with_imu=False)
    longest = max(max_gap_ns, int(2.5 * compute_median_period_ns(motion)))
    return stamp[~is_in_gap(motion, stamp, stamp, longest_ns=longest)]


def _make_stamps(measurements: Measurements, *, with_imu: bool) -> Ints:
    stamps = [sensor.stamp_ns for role, sensor in measurements.sensors().items() if with_imu or role != IMU]
    return np.unique(np.concatenate(stamps)) if stamps else np.empty(0, np.int64)
