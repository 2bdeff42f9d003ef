"""How a power source samples: whether its messages repeat slower readings, a value is a mean over its period, or the record is smoothed.

A driver may publish one reading several times: a battery monitor that is read once a second, in messages at 20 Hz. Messages repeat
readings where values change only every so many messages, at almost constant intervals (a reading that equals the one before makes an
interval of twice the length), and often by more than one level. A true signal that is coarsely quantised changes at irregular times;
where it does so regularly (a ramp, an oscillation), it passes from level to level.

The motion shows whether a source averages: a mean lags the motion by half a period. A clock that is off by half a period looks the same,
and has the same effect: values that are held backwards from their stamps are right then.

A battery monitor may pass on a running mean over seconds, or a low-pass filter's output: power then follows the motion of all that time.
Where the power of a run wanders like a random walk, a mean over a seconds before and b seconds after the stamp errs by the variance
(a³ + b³) / (2 (a + b)³) times the mean squared change of the smoothed record over a + b seconds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.power.rails import Samples
from tcpipe.tables.facts import Smoothing
from tcpipe.tables.findings import read_threshold

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

_FEWEST_INTERVALS = 20
_LEAST_MESSAGES = 1.5
"""For which a reading lasts."""
_LONGEST_INTERVAL = 4
"""In reading periods: longer ones, as of a stationary robot, show no period."""
_REGULAR_SHARE = 0.9
_SINGLE_SHARE = 0.5
"""Of the intervals, one reading period long."""
_TOLERANCE = 0.3
"""Of a reading period: a reading shows at the next message, and no device is read at exact times."""
_JUMPING_SHARE = 0.1
"""Of the changes."""


def find_readings(stamp_ns: Stamps, values: Floats) -> NDArray[np.int64] | None:
    """Return the rows on which new readings arrived, shape (R,); None where messages do not surely repeat readings.

    A reading that equals the one before it shows no change: its row is the one at which it is expected. ``stamp_ns`` [ns], shape (N,), does
    not decrease; ``values``, shape (N, K), are quantities that are read together, finite.
    """
    changed = np.flatnonzero((values[1:] != values[:-1]).any(axis=1)) + 1
    if changed.size <= _FEWEST_INTERVALS or not _has_jumps(values[changed]):
        return None
    message_ns = float(np.median(np.diff(stamp_ns)))
    messages = _find_reading_period(np.diff(stamp_ns[changed]) / message_ns)
    if messages is None:
        return None
    at_ns = (stamp_ns - stamp_ns[0]).astype(np.float64)
    return _find_arrivals(at_ns, changed, period_ns=messages * message_ns, message_ns=message_ns)


def _has_jumps(values: Floats) -> bool:
    """Return whether successive values of one of the quantities often pass over a level that occurs elsewhere."""
    levels = [np.unique(column, return_inverse=True)[1] for column in values.T]
    return any(np.mean(np.abs(np.diff(level)) > 1) > _JUMPING_SHARE for level in levels)


def _find_reading_period(interval: Floats) -> float | None:
    """Return how many messages a reading lasts, by the intervals between changes [messages]; None where they are not regular."""
    period = float(interval[interval <= 1.5 * np.quantile(interval, 0.2)].mean())
    for _ in range(3):
        count = np.maximum(np.rint(interval / period), 1.0)
        judged = count <= _LONGEST_INTERVAL
        used = judged & (interval > 0.5 * period)
        period = float(interval[used].sum() / count[used].sum())
    regular = judged & (np.abs(interval - count * period) <= _TOLERANCE * period)
    is_repeated = (
        period > _LEAST_MESSAGES
        and judged.sum() >= _FEWEST_INTERVALS
        and regular.sum() >= _REGULAR_SHARE * judged.sum()
        and (regular & (count == 1.0)).sum() >= _SINGLE_SHARE * judged.sum()
    )
    return period if is_repeated else None


def _find_arrivals(
    at_ns: Floats, changed: NDArray[np.int64], *, period_ns: float, message_ns: float
) -> NDArray[np.int64]:
    """Return the rows that change, and those at which equal readings are expected: evenly between changes, and beyond the outer ones.

    Where messages are missing for a reading's period, the age of the first message after them is not known: it is no arrival.
    """
    resumed = np.flatnonzero(np.diff(at_ns) > period_ns) + 1
    found = [changed[:0]]
    for rows in np.split(np.arange(at_ns.size), resumed):
        mine = changed[(changed > rows[0]) & (changed <= rows[-1])]
        anchor = at_ns[mine] if mine.size else at_ns[rows[:1]]
        begin = anchor[0] - np.floor((anchor[0] - at_ns[rows[0]]) / period_ns) * period_ns
        end = anchor[-1] + np.floor((at_ns[rows[-1]] - anchor[-1]) / period_ns) * period_ns
        anchor = np.concatenate(([begin], anchor, [end]))
        between = np.diff(anchor)
        count = np.maximum(np.rint(between / period_ns), 1.0).astype(np.int64)
        step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        expected = np.repeat(anchor[:-1], count) + step * np.repeat(between / count, count)
        equal = np.setdiff1d(np.append(expected, end), at_ns[mine])
        found += [mine, np.maximum(np.searchsorted(at_ns, equal - 0.5 * message_ns), rows[0])]
    return np.unique(np.concatenate(found))


_FEWEST = 60
_LATE = np.linspace(-1.0, 1.5, 26)
"""Delays that are tried, in periods: 0 is a sample's, a half is a mean's."""
_NEAR = 0.25
_CLEARLY = 0.9
"""The better of two delays says so when its squared residuals are below this share of the other's."""


def is_stated_averaged(
    power_ns: Stamps, power_watt: Floats, motion_ns: Stamps, forward_mps: Floats, yaw_rate_radps: Floats
) -> bool | None:
    """Return whether each value is the mean since the one before it (True) or sampled (False); None where motion shows neither.

    Power is fitted by a constant, speed, its square, turning and the gain of speed, as means over one period about a time that is a delay
    before each stamp. The delay that fits best decides, unless it is neither's, or hardly better than the other.

    Parameters
    ----------
    power_ns, power_watt : [ns], [W], shape (N,), rising stamps, finite.
    motion_ns, forward_mps, yaw_rate_radps : [ns], [m/s], [rad/s], shape (M,), rising stamps, finite.
    """
    if min(power_ns.size, motion_ns.size) < _FEWEST:
        return None
    period_ns = float(np.median(np.diff(power_ns)))
    margin_ns = 2.0 * period_ns
    inside = (power_ns > motion_ns[0] + margin_ns) & (power_ns < motion_ns[-1] - margin_ns)
    if inside.sum() < _FEWEST:
        return None
    at_s, motion_s, period_s = (
        (power_ns[inside] - motion_ns[0]) / 1e9,
        (motion_ns - motion_ns[0]) / 1e9,
        period_ns / 1e9,
    )
    sums = _integrate_causes(motion_s, _collect_causes(motion_s, forward_mps, yaw_rate_radps))
    left = np.array(
        [
            _compute_unexplained(power_watt[inside], _mean_about(at_s - late * period_s, period_s, motion_s, sums))
            for late in _LATE
        ]
    )
    best = _LATE[int(np.argmin(left))]
    sampled, averaged = (float(np.interp(late, _LATE, left)) for late in (0.0, 0.5))
    if min(abs(best), abs(best - 0.5)) > _NEAR or min(sampled, averaged) > _CLEARLY * max(sampled, averaged):
        return None
    return averaged < sampled


def _collect_causes(motion_s: Floats, forward_mps: Floats, yaw_rate_radps: Floats) -> Floats:
    """Return what power follows, shape (M, 5)."""
    speed, turning = np.abs(forward_mps), np.abs(yaw_rate_radps)
    gained = np.gradient(0.5 * speed**2, motion_s)
    return np.column_stack((np.ones_like(speed), speed, speed**2, turning, gained))


def _integrate_causes(motion_s: Floats, causes: Floats) -> Floats:
    """Return the integral of each cause from the first time, shape (M, 5)."""
    steps = np.diff(motion_s)[:, None] * (causes[1:] + causes[:-1]) / 2.0
    return np.concatenate((np.zeros((1, causes.shape[1])), np.cumsum(steps, axis=0)))


def _mean_about(at_s: Floats, width_s: float, motion_s: Floats, sums: Floats) -> Floats:
    """Return the means of the causes over a width about each time, shape (N, 5)."""
    later, earlier = at_s + width_s / 2, at_s - width_s / 2
    return (
        np.column_stack(
            [np.interp(later, motion_s, integral) - np.interp(earlier, motion_s, integral) for integral in sums.T]
        )
        / width_s
    )


def _compute_unexplained(power_watt: Floats, causes: Floats) -> float:
    fitted = causes @ np.linalg.lstsq(causes, power_watt, rcond=None)[0]
    return float(np.sum((power_watt - fitted) ** 2))


_INSTANT_S = 0.1
"""Motion is averaged over so much about a sample."""
_WIDTHS_S = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)
_FEWEST_MEANS = 20
"""Of a width, one after the other in the record: to fewer the six causes fit by chance, where power wanders slowly."""


def find_smoothing(
    power: Samples, motion_ns: Stamps, motion: Floats, *, averaged: bool, corrected_s: float = 0.0
) -> Smoothing | None:
    """Return over how long power [W] is smoothed, by the motion that it follows; None where that is not sure.

    It has to explain clearly more than power as it is, and than means about the stamp, which fit better where the motion is noisy.

    Parameters
    ----------
    motion_ns, motion : rising stamps [ns], shape (M,), with forward velocity, yaw rate and rate of climb, shape (M, 3).
    averaged : whether a value is stated to be the mean since the one before it.
    corrected_s : what the recipe adds to the stamps [s]: a mean ends at the stamp before that.
    """
    if min(power.value.size, motion_ns.size) < _FEWEST:
        return None
    margin_ns = round(_WIDTHS_S[-1] * 1e9)
    inside = (power.stamp_ns > motion_ns[0] + margin_ns) & (power.stamp_ns < motion_ns[-1] - margin_ns)
    if inside.sum() < _FEWEST:
        return None
    stated_s = float(np.median(np.diff(power.stamp_ns))) / 1e9 if averaged else 0.0
    at_s, motion_s = (power.stamp_ns[inside] - motion_ns[0]) / 1e9, (motion_ns - motion_ns[0]) / 1e9
    sums = _integrate_causes(motion_s, np.column_stack((_collect_causes(motion_s, *motion[:, :2].T), motion[:, 2])))

    def judge(smoothing: Smoothing) -> float:
        width_s = max(stated_s + smoothing.width_s, _INSTANT_S)
        means = _mean_about(at_s - stated_s / 2.0 - smoothing.late_s, width_s, motion_s, sums)
        return _compute_unexplained(power.value[inside], means)

    after_s = max(-corrected_s, 0.0)
    longest_s = float(at_s[-1] - at_s[0]) / _FEWEST_MEANS
    tried = [Smoothing(width_s - after_s, after_s) for width_s in _WIDTHS_S if after_s < width_s <= longest_s]
    if not tried:
        return None
    about = [Smoothing(width_s / 2.0 - after_s, width_s / 2.0 + after_s) for width_s in _WIDTHS_S]
    unexplained = [judge(smoothing) for smoothing in tried]
    least = min(judge(smoothing) for smoothing in (Smoothing(0.0, 0.0), *about))
    if min(unexplained) > read_threshold("power-smoothed", "max_unexplained_fraction") * least:
        return None
    return tried[int(np.argmin(unexplained))]


def estimate_smoothing_variance(power: Samples, steady: NDArray[np.bool_], smoothing: Smoothing) -> float:
    """Return the variance of power [W²] that smoothing hides, by how smoothed power [W] changes while ``steady``, shape (N,)."""
    at_s = (power.stamp_ns - power.stamp_ns[0]) / 1e9
    earlier_s = at_s - smoothing.width_s
    change = power.value - np.interp(earlier_s, at_s, power.value)
    used = steady & (np.interp(earlier_s, at_s, steady) == 1.0) & (earlier_s > 0.0)
    if used.sum() < _FEWEST:
        used = earlier_s > 0.0
    share = (smoothing.before_s**3 + smoothing.after_s**3) / (2.0 * smoothing.width_s**3)
    return share * float(np.mean(np.square(change[used]))) if used.any() else 0.0
