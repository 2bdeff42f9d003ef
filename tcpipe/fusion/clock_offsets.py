"""The clock doctor: constant offsets between the stamps of a run's sensors, from what they say of the same motion.

Speed of the wheels against that of the fixes, yaw rate against the gyroscope, power against what speed and acceleration cost. Each pair
that can be compared gives a lag with its standard deviation (`lags`); the pairs together give each sensor's offset from the clock that
most of them share. Nothing is corrected here: a person decides. The course of the fixes is not held against the gyroscope: an antenna
that sits ahead of the turning point by l leads the body's course by l / v, 0.1 s for 10 cm.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.gridded_motion import FIXES_S, fix_velocity, on_grid, twist_on_grid
from tcpipe.fusion.lags import GRID_S, Floats, averaged, find_lag, grid_ns
from tcpipe.fusion.measurements import GNSS, IMU, VISUAL, WHEELS, Measurements
from tcpipe.fusion.signals import median_period_ns

POWER = "power"
ROLES = (IMU, WHEELS, VISUAL, GNSS, POWER)
"""In the order in which a clock is taken for the right one where as many agree with either: a gyroscope has the least to compute."""

_NOTED_S = {POWER: 0.08}
_NOTED_MOTION_S = 0.05
_SURE = 4.0  # standard deviations
_MAX_STD_S = {POWER: 0.04}
_MAX_MOTION_STD_S = 0.02
_MIN_EXPLAINED = 0.25
_ODOMETRY_S = 0.1
_POWER_S = 0.2
_SLOW_S = 4.0
_STOPPED_MPS = 0.1
_NEAR_STOP_S = 3.0
_LONG_ENOUGH_NS = 1_800_000_000_000


@dataclass(frozen=True, slots=True)
class Pair:
    """Two sensors compared: by what, how late the first's stamps are against the second's [s], and how much one explains the other."""

    late: str
    against: str
    by: str
    offset_s: float
    std_s: float
    explained: float

    @property
    def determined(self) -> bool:
        """Whether the offset is known well enough to be spoken of: to a small error, or as surely not zero."""
        limit_s = _MAX_STD_S.get(self.late, _MAX_MOTION_STD_S)
        known = self.std_s <= limit_s or (self.std_s <= 3 * limit_s and abs(self.offset_s) > _SURE * self.std_s)
        return known and self.explained >= _MIN_EXPLAINED


@dataclass(frozen=True, slots=True)
class Offset:
    """How late a sensor's stamps are against the reference's [s], its standard deviation, and whether a person should act on it."""

    offset_s: float
    std_s: float
    noted: bool


@dataclass(frozen=True, slots=True)
class PowerSignal:
    """The robot's power: stamps [ns] and values [W], shape (N,); ``averaged`` over the period that ends at each stamp."""

    stamp_ns: NDArray[np.int64]
    power_watt: Floats
    averaged: bool


@dataclass(frozen=True, slots=True)
class ClockOffsets:
    """Every pair compared, the sensor whose clock the others are held against, and the offsets of those connected to it."""

    pairs: tuple[Pair, ...]
    reference: str
    offsets: Mapping[str, Offset]


def find_clock_offsets(measurements: Measurements, power: PowerSignal | None) -> ClockOffsets:
    """Return the constant offsets between the stamps of a clock epoch's sensors.

    Parameters
    ----------
    measurements : of one clock epoch; mountings need not be right, since a yaw rate is compared with all three axes of a gyroscope.
    power : sum over the drive rails; None without.
    """
    sources = [measurements.gnss, measurements.imu, measurements.wheels, measurements.visual]
    stamps = [source.stamp_ns for source in sources if source is not None and source.stamp_ns.size > 1]
    if len(stamps) + (power is not None) < 2:
        return ClockOffsets((), "", {})
    first_ns, last_ns = min(int(stamp[0]) for stamp in stamps), max(int(stamp[-1]) for stamp in stamps)
    at_ns = grid_ns(first_ns, min(last_ns, first_ns + _LONG_ENOUGH_NS))
    pairs = tuple(_pairs(measurements, power, at_ns))
    return _settled(pairs)


def _pairs(m: Measurements, power: PowerSignal | None, at_ns: NDArray[np.int64]) -> Iterable[Pair]:
    odometries = [(role, source) for role, source in ((WHEELS, m.wheels), (VISUAL, m.visual)) if source is not None]
    twists = {role: twist_on_grid(source, at_ns) for role, source in odometries}
    gyro = (
        None if m.imu is None else averaged(on_grid(m.imu.stamp_ns, m.imu.angular_velocity_radps, at_ns), _ODOMETRY_S)
    )
    if gyro is not None:
        for role, _ in odometries:
            yield from _pair(role, IMU, "yaw rate", averaged(twists[role], _ODOMETRY_S)[:, 1], gyro)
    if len(odometries) == 2:
        speeds = {role: _quick(averaged(np.abs(twists[role][:, :1]), _ODOMETRY_S)) for role, _ in odometries}
        yield from _pair(VISUAL, WHEELS, "speed", speeds[VISUAL][:, 0], speeds[WHEELS])
    if m.gnss is not None and odometries:
        role = odometries[0][0]
        seen = averaged(averaged(_antenna_speed(twists[role], m.gnss.lever_arm_m), FIXES_S), FIXES_S)
        fixes = np.abs(fix_velocity(m.gnss, at_ns))
        yield from _pair(GNSS, role, "speed", _quick(fixes[:, None])[:, 0], _quick(seen))
    if power is not None and odometries:
        role = odometries[0][0]
        yield from _pair(POWER, role, "power of speed, acceleration and turning", *_power(power, twists[role], at_ns))


def _pair(late: str, against: str, by: str, target: Floats, regressors: Floats) -> Iterable[Pair]:
    lag = find_lag(target, regressors)
    if lag is not None:
        yield Pair(late, against, by, lag.offset_s, lag.std_s, lag.explained)


def _quick(values: Floats) -> Floats:
    """Return (M, k) values without their slow parts, which slip and terrain change, and starts, stops and turns do not need."""
    return values - averaged(values, _SLOW_S)


def _antenna_speed(twist: Floats, lever_arm_m: tuple[float, float, float]) -> Floats:
    forward, yaw_rate = twist.T
    speed: Floats = np.hypot(forward - yaw_rate * lever_arm_m[1], yaw_rate * lever_arm_m[0])
    return speed[:, None]


def _power(power: PowerSignal, twist: Floats, at_ns: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return power, and what it may depend on, without their slow parts."""
    stamp_ns = power.stamp_ns
    if power.averaged:
        stamp_ns = stamp_ns - median_period_ns(stamp_ns) // 2
    drawn = on_grid(stamp_ns, power.power_watt[:, None], at_ns)
    speed, turning = np.abs(twist).T
    causes = averaged(np.column_stack((drawn, speed, turning, turning * speed, speed**2)), _POWER_S)
    # Speed times acceleration, as half the slope of the squared speed: smoothed like the power itself.
    causes[:, -1] = np.gradient(causes[:, -1], GRID_S) / 2
    fast = _quick(causes)
    near_stop = averaged((speed < _STOPPED_MPS).astype(np.float64)[:, None], _NEAR_STOP_S)[:, 0] > 0
    return np.where(near_stop, fast[:, 0], np.nan), fast[:, 1:]


def _settled(pairs: tuple[Pair, ...]) -> ClockOffsets:
    """Return each sensor's offset from the clock that most sensors share, by weighted least squares over the pairs that are determined."""
    known = [pair for pair in pairs if pair.determined]
    linked = [role for role in ROLES if any(role in {pair.late, pair.against} for pair in known)]
    best: dict[str, Offset] = {}
    reference = ""
    for role in linked:
        offsets = _against(role, linked, known)
        if not best or _agreeing(offsets) > _agreeing(best):
            best, reference = offsets, role
    return ClockOffsets(pairs, reference, {role: offset for role, offset in best.items() if role != reference})


def _agreeing(offsets: Mapping[str, Offset]) -> int:
    """Count the sensors that are near the reference; how surely does not matter: against a doubtful clock nobody is surely off."""
    return sum(abs(offset.offset_s) <= _NOTED_S.get(role, _NOTED_MOTION_S) for role, offset in offsets.items())


def _against(reference: str, roles: list[str], pairs: list[Pair]) -> dict[str, Offset]:
    """Return the offsets of the sensors that pairs connect to the reference, its own (zero) included."""
    connected = {reference}
    for _ in roles:
        connected |= {r for p in pairs if connected & {p.late, p.against} for r in (p.late, p.against)}
    free = [role for role in roles if role in connected and role != reference]
    used = [pair for pair in pairs if pair.late in connected]
    design = np.array([[(r == p.late) - float(r == p.against) for r in free] for p in used]).reshape(len(used), -1)
    weight = 1.0 / np.maximum([pair.std_s for pair in used], 1e-3)
    covariance = np.linalg.inv((design * weight[:, None] ** 2).T @ design) if free else np.zeros((0, 0))
    solved = covariance @ (design * weight[:, None] ** 2).T @ np.array([pair.offset_s for pair in used])
    found = {reference: Offset(0.0, 0.0, noted=False)}
    for role, offset_s, std_s in zip(free, solved.tolist(), np.sqrt(np.diagonal(covariance)).tolist(), strict=True):
        least_s = max(_NOTED_S.get(role, _NOTED_MOTION_S), _SURE * std_s)
        found[role] = Offset(offset_s, std_s, noted=abs(offset_s) > least_s)
    return found
