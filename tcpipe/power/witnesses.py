"""Witnesses of electric power: measurements that do not use the current sensor and show whether its scale is possible.

A factor of 10 or 100 is one line of a driver, and no statistics of the power can show it. Each witness is coarse, but
independent:

- *slopes*: climbing costs m g sin(slope) v over an efficiency, which is known within a factor of three;
- *weight*: energy per metre of level ground is a fraction of the weight, bounded by rolling resistance and efficiency;
- *charge*: the battery's charge or state of charge falls by the integral of the current;
- *second meter*: a meter of the whole pack follows the power of the drives with slope 1;
- *sides*: in straight driving both sides of a skid-steered robot draw power.

The limits were measured on logs of two Warthogs and a rover and on simulated drives (docs/explanation/uncertainty.md).
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from tcpipe.arrays import Floats, Ints, Mask
from tcpipe.robust import estimate_robust_std
from tcpipe.tables.findings import WITNESSES_OF_LABEL, Finding, Severity, Subject, make_finding, read_threshold

IMPLAUSIBLE = "power-implausible"
_GRAVITY_MPS2 = 9.80665

_MIN_SEGMENTS = 20  # fewest segments on which power is compared with slopes or weight
_INSTRUMENT_SHIFT = 2
"""Distance of the slope that serves as instrument [segments]: its height noise is independent, the hill is the same."""
_BLOCK_SEGMENTS = 5  # neighbouring segments have correlated residuals; σ is computed from blocks of this length
_HUBER = 1.5  # residuals beyond this many robust standard deviations get less weight
_ITERATIONS = 12
_LEVEL_RISE = 0.05  # largest tangent of the slope of level ground
_MIN_CHARGE_FALL = 0.05
"""Smallest fall of a charge or state of charge that is compared, as a fraction: these counters have steps of 1 %."""
_MIN_STRAIGHT_ROWS = 30
_MIN_METER_ROWS = 50


class Climb(NamedTuple):
    """Power of climbing: … + factor · m g sin(slope) v. ``factor`` is 1 / efficiency, ``std`` its standard deviation.

    ``reliability`` is the correlation of the slope with that of its neighbours, in [-1, 1].
    """

    factor: float
    std: float
    reliability: float

    def is_certain(self) -> bool:
        """Return whether the slopes exceed noise, and the factor can confirm or contradict the scale of power."""
        least, most = (
            read_threshold(IMPLAUSIBLE, name) for name in ("min_slope_reliability", "max_climb_std_fraction")
        )
        return self.reliability >= least and 0.0 < self.std < most * abs(self.factor)


def estimate_climb(
    *,
    power_watt: Floats,
    velocity_mps: Floats,
    rise: Floats,
    mean_abs_yaw_rate_radps: Floats,
    piece: Ints,
    mass_kg: float,
) -> Climb | None:
    """Fit power = a + b v + factor · m g sin(slope) v + c |yaw rate|; None for under 20 segments, or level ground.

    The slopes of the segments two before and two behind are the instruments, so that noise of heights adds no bias.

    Parameters
    ----------
    power_watt, velocity_mps, mean_abs_yaw_rate_radps : of each segment, in driving order, [W], [m/s], [rad/s], shape
        (M,).
    rise : tangent of the slope along travel, shape (M,).
    piece : number of the uninterrupted section that each segment is in, shape (M,).
    mass_kg : mass of the robot [kg].
    """
    slope = rise / np.hypot(1.0, rise)
    instrument = _average_neighbours(slope, piece)
    turn = np.nan_to_num(mean_abs_yaw_rate_radps)
    used = np.isfinite(power_watt + velocity_mps + slope + instrument)
    if used.sum() < _MIN_SEGMENTS or not slope[used].std() > 0.0 or not instrument[used].std() > 0.0:
        return None
    ones, velocity = np.ones(int(used.sum())), velocity_mps[used]
    weight = mass_kg * _GRAVITY_MPS2 * velocity
    columns, instruments = (
        np.column_stack([ones, velocity, weight * each[used], turn[used]]) for each in (slope, instrument)
    )
    factor, std = _fit_with_instruments(columns, instruments, power_watt[used], column=2)
    return Climb(factor, std, float(np.corrcoef(slope[used], instrument[used])[0, 1]))


def _average_neighbours(values: Floats, piece: Ints) -> Floats:
    """Return the mean of the values two before and two behind in the same piece, shape (M,); NaN without either."""
    neighbours = np.full((2, len(values)), np.nan)
    shift = _INSTRUMENT_SHIFT
    same = piece[shift:] == piece[:-shift]
    neighbours[0, shift:][same] = values[:-shift][same]
    neighbours[1, :-shift][same] = values[shift:][same]
    count = np.isfinite(neighbours).sum(axis=0)
    return np.where(count > 0, np.nansum(neighbours, axis=0) / np.maximum(count, 1), np.nan)


def _fit_with_instruments(columns: Floats, instruments: Floats, target: Floats, *, column: int) -> tuple[float, float]:
    """Return a coefficient of a robust two-stage least-squares fit and its σ; columns, instruments: shape (M, K)."""
    size = np.maximum(np.abs(columns).max(axis=0), 1e-12)
    columns, instruments = columns / size, instruments / size
    fitted = instruments @ np.linalg.lstsq(instruments, columns, rcond=None)[0]
    weight, residual = np.ones(len(target)), target
    inverse: Floats = np.eye(columns.shape[1])
    value: Floats = np.zeros(columns.shape[1])
    for _ in range(_ITERATIONS):
        inverse = np.asarray(np.linalg.pinv(fitted.T @ (weight[:, None] * columns)), float)
        value = inverse @ (fitted.T @ (weight * target))
        residual = target - columns @ value
        limit = _HUBER * max(estimate_robust_std(residual), 1e-12)
        weight = np.minimum(1.0, limit / np.maximum(np.abs(residual), 1e-300)).astype(float)
    starts = np.arange(0, len(target), _BLOCK_SEGMENTS)
    sums = np.add.reduceat(fitted * (weight * residual)[:, None], starts, axis=0)
    covariance = inverse @ (sums.T @ sums) @ inverse.T * (len(starts) / max(len(starts) - columns.shape[1], 1))
    return float(value[column] / size[column]), float(np.sqrt(covariance[column, column]) / size[column])


def compute_weight_ratio(net_energy_jpm: Floats, rise: Floats, mass_kg: float) -> float | None:
    """Return the median net energy per metre of level ground over the weight [1]; None for fewer than 20 such segments.

    ``net_energy_jpm``: energy above idle power [J/m]; ``rise``: tangent of the slope, shape (M,); ``mass_kg`` [kg].
    """
    level = net_energy_jpm[np.isfinite(net_energy_jpm) & (np.abs(rise) < _LEVEL_RISE)]
    return float(np.median(level)) / (mass_kg * _GRAVITY_MPS2) if len(level) >= _MIN_SEGMENTS else None


def compare_charge(time_s: Floats, current_amp: Floats, charge_ah: Floats) -> float | None:
    """Return the current's integral over the fall of the charge [1]; None if the charge falls by less than 5 %.

    ``time_s`` [s], ``current_amp`` [A] (positive when drawn), ``charge_ah`` [Ah]: shape (N,); NaN is not measured.
    """
    known = np.isfinite(charge_ah) & (charge_ah > 0.0)
    is_known = np.isfinite(current_amp)
    if known.sum() < 2 or is_known.sum() < 2:
        return None
    first, last = np.flatnonzero(known)[[0, -1]]
    fall_ah = float(charge_ah[first] - charge_ah[last])
    if fall_ah < _MIN_CHARGE_FALL * charge_ah[first]:
        return None
    inside = is_known & (time_s >= time_s[first]) & (time_s <= time_s[last])
    return float(np.trapezoid(current_amp[inside], time_s[inside])) / 3600.0 / fall_ah if inside.sum() > 1 else None


def compare_meters(drive_watt: Floats, pack_watt: Floats) -> tuple[float, float] | None:
    """Return the slope of the pack's power over the drives', shape (N,), and their correlation; None for few rows.

    A constant load of the pack (computers) does not change the slope.
    """
    known = np.isfinite(drive_watt + pack_watt)
    drive, pack = drive_watt[known], pack_watt[known]
    if known.sum() < _MIN_METER_ROWS or not drive.std() > 0.0 or not pack.std() > 0.0:
        return None
    (of_drive, both), (_, of_pack) = np.cov(drive, pack)
    return float(both / of_drive), float(both / np.sqrt(of_drive * of_pack))


_MAX_HALF_SHARE = 0.36  # half a side that is not measured leaves a share of a third


def estimate_missing_std_fraction(side_share: float | None) -> float:
    """Return σ of the gain for an unmeasured part of a side; sound robots have side shares of 0.13 to 0.50."""
    share = 0.5 if side_share is None else min(side_share, 1.0 - side_share)
    return (1.0 - 2.0 * share) / 3.0**0.5 if share < _MAX_HALF_SHARE else 0.0


def compute_side_share(first_amp: Floats, second_amp: Floats, is_straight: Mask) -> float | None:
    """Return the share of the first of two sides in their current in straight driving [1]; None for fewer than 30 rows.

    The currents [A], shape (N,), are positive when drawn. Below 0.05 or above 0.95 one whole side is not measured.
    """
    used = is_straight & np.isfinite(first_amp + second_amp)
    total = float((first_amp + second_amp)[used].sum())
    return float(first_amp[used].sum()) / total if used.sum() >= _MIN_STRAIGHT_ROWS and total > 0.0 else None


_BATTERY = "battery-resistance-differs"
RESISTANCE_OHM = "battery_ohm"
"""Number in a finding on the witnesses of energy: resistance of the battery by its sag [ohm]."""


def compare_batteries(runs: Iterable[tuple[str, str, Iterable[Finding]]]) -> Iterator[Finding]:
    """Yield a finding for each run whose battery differs in resistance from the other runs of its robot.

    ``runs``: run, robot and findings of each. The voltage sags in proportion to the current, so that another scale of a
    run's current shows as another resistance.
    """
    by_robot: dict[str, dict[str, float]] = {}
    for run_id, robot, findings in runs:
        for finding in findings:
            if finding.code == WITNESSES_OF_LABEL and RESISTANCE_OHM in finding.numbers:
                by_robot.setdefault(robot, {})[run_id] = finding.numbers[RESISTANCE_OHM]
    most, most_of_batteries = (read_threshold(_BATTERY, name) for name in ("max_ratio", "max_ratio_of_batteries"))
    for robot, by_run in by_robot.items():
        for run_id, ohm in by_run.items():
            # Two runs are compared with each other; of three or more, one deviating run does not affect the others.
            compared = [other for other_id, other in by_run.items() if other_id != run_id or len(by_run) != 2]
            ratio = ohm / float(np.median(compared))
            excess = max(ratio, 1.0 / ratio)
            if excess > most:
                severity: Severity | None = "error" if excess > most_of_batteries else None
                names = {"robot": robot}
                yield make_finding(_BATTERY, Subject("run", run_id), severity=severity, names=names, ratio=ratio)
