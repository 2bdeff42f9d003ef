"""Measurements for the estimators: arrays in base_link axes and in the datum's ENU plane; every number is usable.

The stage has already converted units and frames, applied mounting rotations, excluded and counted unusable rows, and
replaced variances that are unknown, implausible or too small. Lever arms are separate, since their effect depends on
the attitude. Rows are sorted by stamp, without repetitions.

A run is cut into sections, which are fused one by one. A step of the clock starts a new section, and so does a pause of
all sensors of more than 5 s: the estimate is too uncertain after it. Both estimators take the `Measurements` of a
section, its `InitialState` and the output stamps, increasing, inside the span of the measurements. They return a
`Trajectory`: state of base_link, its uncertainty, rejected measurements.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints, Mask
from tcpipe.fusion.signals import compute_median_period_ns, is_in_gap
from tcpipe.tables.facts import SectionFacts

GNSS, IMU, WHEELS, VISUAL, DOPPLER = "gnss", "imu", "wheel_odometry", "visual_odometry", "gnss_velocity"
"""Roles, as in the rejections table."""
_FIELDS = {GNSS: "gnss", DOPPLER: "doppler", IMU: "imu", WHEELS: "wheels", VISUAL: "visual"}
POSE = "pose"
FIXES = (GNSS, POSE)  # roles of positions: a pose is fused as fixes with an attitude

MAX_VARIANCE = 1e6
"""Largest variance [m² or m²/s²]; it marks values that are not measured. Larger variances would lose precision."""
NO_LEVER_ARM = (0.0, 0.0, 0.0)
STATED_ARM_STD_M = (0.05, 0.05, 0.1)
"""σ of a stated antenna position [m]: error of a tape measure, and of the height of base_link over the ground."""
UNSTATED_ARM_STD_M = (0.5, 0.5, 0.5)  # σ of an antenna position that is not stated [m]: the antenna is on the robot


UNMEASURED_RAD2 = 1e2  # Variance of a rotation about an axis that is not measured [rad²]


@dataclass(frozen=True, slots=True)
class Positions:
    """Positions of an antenna (GNSS), or another program's pose: positions of a sensor, and the robot's attitude.

    Attributes
    ----------
    stamp_ns : [ns], shape (N,), int64, increasing.
    position_enu_m : [m], shape (N, 3), antenna in the ENU plane of the datum.
    variance_m2 : [m²], shape (N, 3), east, north, up; floored, never unknown.
    lever_arm_m, lever_arm_std_m : [m], position of the antenna in base_link, and its standard deviation; 0: known
    exactly.
    unclaimed : shape (N,), whether the variance comes from the recipe because the receiver reports none; None if it
        always reports one.
    quat_xyzw, rotation_variance_rad2 : attitude enu_from_base_link, shape (N, 4), NaN where absent, and variance about
        the robot's axes, shape (N, 3); None: no attitude is measured.
    mounting_xyzw, mounting_std_rad : base_link_from_sensor of a pose, stated or estimated from the motion, and σ about
        each axis.
    lag_std_s : [s], standard deviation of the delay of the stamps: drivers stamp on arrival.
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
        """Whether the receiver reports a variance for most fixes."""
        return self.unclaimed is None or bool(self.unclaimed.mean() < 0.5)

    @property
    def has_heights(self) -> bool:
        """Whether any fix measures the height."""
        return bool((self.variance_m2[:, 2] < MAX_VARIANCE).any())


@dataclass(frozen=True, slots=True)
class GroundVelocities:
    """Velocity over ground of the antenna, measured by the receiver from Doppler.

    Attributes
    ----------
    stamp_ns : [ns], shape (N,), int64, increasing.
    velocity_enu_mps : [m/s], shape (N, 3), east, north, up; up is 0 if it is not measured, its variance
        `MAX_VARIANCE`.
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
    stamp_ns : [ns], shape (N,), int64, increasing. If a velocity comes from two poses, the middle of their stamps.
    velocity_mps : [m/s], shape (N, 3), velocity of the point at ``lever_arm_m``. Wheels: only x is measured, y and z
    are NaN.
    variance_m2ps2 : [m²/s²], shape (N, 3); NaN exactly where the velocity is.
    yaw_rate_radps : [rad/s], shape (N,), about base_link's z; NaN where it is not measured.
    lever_arm_m : [m], the measured point in base_link.
    turn_rate_radps : [rad/s], shape (N, 3), about all three axes of base_link, z as in ``yaw_rate_radps``; None where
        the source measures only yaw (wheels) or no turn rate.
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
        is_measured: Mask = (self.variance_m2ps2 < 1e3).mean(0) > 0.5  # above: not measured (by judgement)
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
    accelerometer_usable : False if the values are no specific force (gravity removed, other units); then only the
        gyroscope is used.
    accelerometer_noise_mps2 : noise around each sample, shape (N,), which includes vibration by the motion; None:
        constant noise.
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

    At least one of ``gnss``, ``wheels`` and ``visual`` is not None. ``nonholonomic_std_mps``: sideways and vertical
    body velocity are zero to within this. ``doppler`` is the velocity of the antenna of ``gnss``.
    """

    gnss: Positions | None = None
    imu: InertialMeasurements | None = None
    wheels: BodyVelocities | None = None
    visual: BodyVelocities | None = None
    nonholonomic_std_mps: float = 0.15
    doppler: GroundVelocities | None = None

    def sensors(self) -> dict[str, Sensor]:
        """Return the existing sensors by role."""
        sensors_by_role = {role: getattr(self, name) for role, name in _FIELDS.items()}
        return {role: sensor for role, sensor in sensors_by_role.items() if sensor is not None}

    def replace_sensors(self, changed: Mapping[str, Sensor | None]) -> Measurements:
        """Return the measurements with some sensors replaced, by role; None removes a sensor."""
        named: dict[str, Any] = {_FIELDS[role]: sensor for role, sensor in changed.items()}
        return replace(self, **named)

    @property
    def is_antenna_alone(self) -> bool:
        """Whether only fixes and a receiver's velocity measure motion: forward and backward are indistinguishable."""
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
        """Return the existing odometries by role, wheels first."""
        by_role = {WHEELS: self.wheels, VISUAL: self.visual}
        return {role: odometry for role, odometry in by_role.items() if odometry is not None}

    def turning_odometries(self) -> dict[str, BodyVelocities]:
        """Return the odometries that measure a yaw rate, by role: wheels (which skid), then the camera."""
        every = self.odometries().items()
        return {role: odometry for role, odometry in every if np.isfinite(odometry.yaw_rate_radps).any()}

    @property
    def first_odometry(self) -> BodyVelocities | None:
        """Wheel odometry, or visual odometry without wheels."""
        return self.wheels or self.visual


@dataclass(frozen=True, slots=True)
class InitialState:
    """State at the start of a section, estimated from all of its data (`tcpipe.fusion.initial`).

    Attributes
    ----------
    position_enu_m, position_std_m : [m], shape (3,), base_link.
    quat_xyzw : shape (4,), enu_from_base_link.
    tilt_std_rad, yaw_std_rad : standard deviation of roll and pitch, and of yaw.
    velocity_enu_mps, velocity_std_mps : [m/s], shape (3,) and scalar.
    gyro_bias_radps : [rad/s], shape (3,); zero if the robot is never stationary.
    heading_from : source of the yaw: ``course over ground``, ``pose``, ``orientation``, ``local frame`` or ``unknown``.
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
    """Return the measurements between two stamps, both included; a sensor without measurements is None."""
    found: dict[str, Sensor | None] = {}
    for role, source in whole.sensors().items():
        rows = slice(*np.searchsorted(source.stamp_ns, (start_ns, end_ns + 1)))
        found[role] = select_sensor_rows(source, rows) if rows.stop > rows.start else None
    return whole.replace_sensors(found)


def select_sensor_rows(source: _Source, rows: slice | Mask) -> _Source:
    """Return a sensor with the selected rows."""
    values = {field.name: getattr(source, field.name) for field in fields(source)}
    chosen: dict[str, Any] = {name: value[rows] for name, value in values.items() if isinstance(value, np.ndarray)}
    return replace(source, **chosen)


DISPLACEMENT_LAGS_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
"""Durations for which a smoother computes the uncertainty of a displacement [s]."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """States of base_link at ``stamp_ns``.

    Attributes
    ----------
    stamp_ns : [ns], shape (N,), int64: exactly the output stamps.
    position_enu_m, position_std_m : [m], shape (N, 3).
    quat_xyzw : shape (N, 4), enu_from_base_link, unit length.
    velocity_enu_mps : [m/s], shape (N, 3), velocity of base_link.
    angular_velocity_radps : [rad/s], shape (N, 3), base_link axes.
    yaw_std_rad : [rad], shape (N,).
    forward_velocity_std_mps : [m/s], shape (N,), of the velocity along base_link's x axis.
    rejections : measurements that the gate rejected, in time order: columns of the level REJECTIONS, shape (M,).
    displacement_std_m : [m], shape (N, 6), of the horizontal displacement from each row to the one
        `DISPLACEMENT_LAGS_S` later, along its direction, with the exact correlation of both ends; NaN where there
        is no such row, and always in a forward filter, which does not compute it. In between the variance may be
        interpolated in time, from zero at duration zero.
    facts : counts and estimated parameters of the filter.
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
    facts: SectionFacts


PAUSE_NS = 5_000_000_000
"""Longest pause of all sensors within a section [ns]; after a longer one the estimate is too uncertain."""


@dataclass(frozen=True, slots=True)
class TrackSection:
    """One section: its clock epoch, first and last stamp [ns] of a motion measurement, and its measurements."""

    clock_epoch: int
    start_ns: int
    end_ns: int
    measurements: Measurements


def cut_sections(measurements: Mapping[int, Measurements], cuts_ns: Sequence[int] = ()) -> list[TrackSection]:
    """Return the sections of all clock epochs in order of time; sections without motion measurements are left out.

    A section ends at a pause, and before each of the measurement stamps ``cuts_ns``.
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
    """Return the multiples of the period inside a section [ns], except those in a gap.

    A gap is a time without GNSS, wheels and visual odometry that is longer than ``max_gap_ns`` and than 2.5 times their
    usual period: an IMU alone does not determine a track. In the track a gap is a step of the stamps.
    """
    first = -(-section.start_ns // period_ns) * period_ns
    stamp = np.arange(first, section.end_ns + 1, period_ns, dtype=np.int64)
    motion = _make_stamps(section.measurements, with_imu=False)
    longest = max(max_gap_ns, int(2.5 * compute_median_period_ns(motion)))
    return stamp[~is_in_gap(motion, stamp, stamp, longest_ns=longest)]


def _make_stamps(measurements: Measurements, *, with_imu: bool) -> Ints:
    stamps = [sensor.stamp_ns for role, sensor in measurements.sensors().items() if with_imu or role != IMU]
    return np.unique(np.concatenate(stamps)) if stamps else np.empty(0, np.int64)
