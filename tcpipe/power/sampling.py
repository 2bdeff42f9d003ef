"""Sampling of a power source: repeated readings, means over the message period, and smoothing of the record.

A driver may publish one reading several times: a battery monitor that is read once a second, in messages at 20 Hz.
Messages repeat readings if values change only every few messages, at almost constant intervals (an equal next reading
doubles an interval), and often by more than one level. A true signal that is coarsely quantised changes at irregular
times; where it changes regularly (a ramp, an oscillation), it passes from level to level.

The motion shows whether a source averages: a mean is half a period later than the motion. A clock offset of half a
period looks the same and has the same effect: values that apply backwards from their stamps are right in both cases.

A battery monitor may publish a running mean over seconds, or a low-pass filter's output: power then follows the motion
of all that time. If the power of a run is a random walk, the variance of a mean over a seconds before and b seconds
after the stamp is (a³ + b³) / (2 (a + b)³) times the mean squared change of the smoothed record over a + b seconds.
"""

from dataclasses import dataclass

import numpy as np

from tcpipe.arrays import Floats, Ints, Mask, number_within
from tcpipe.power.rails import Rail, Rule, SampledSignal, integrate_energy
from tcpipe.tables.facts import Smoothing
from tcpipe.tables.findings import read_threshold

_FEWEST_INTERVALS = 20
_LEAST_MESSAGES = 1.5  # fewest messages per reading
_LONGEST_INTERVAL = 4  # in reading periods: longer ones, as of a stationary robot, show no period
_REGULAR_SHARE = 0.9
_SINGLE_SHARE = 0.5  # smallest share of intervals that are one reading period long
_TOLERANCE = 0.3
"""Tolerance in reading periods: the next message shows a reading, and devices are not read at exact times."""
_JUMPING_SHARE = 0.1  # smallest share of changes by more than one level


def find_readings(stamp_ns: Ints, values: Floats) -> Ints | None:
    """Return the rows on which new readings arrived, shape (R,); None if messages do not certainly repeat readings.

    A reading equal to the one before it shows no change: its row is where it is expected. ``stamp_ns`` [ns], shape
    (N,), does not decrease; ``values``, shape (N, K), finite, are quantities that are read together.
    """
    changed = np.flatnonzero((values[1:] != values[:-1]).any(axis=1)) + 1
    if changed.size <= _FEWEST_INTERVALS or not _has_jumps(values[changed]):
        return None
    message_ns = float(np.median(np.diff(stamp_ns)))
    messages = _find_reading_period(np.diff(stamp_ns[changed]) / message_ns)
    if messages is None:
        return None
    at_ns = (stamp_ns - stamp_ns[0]).astype(float)
    return _find_arrivals(at_ns, changed, period_ns=messages * message_ns, message_ns=message_ns)


def _has_jumps(values: Floats) -> bool:
    """Return whether successive values of one of the quantities often pass over a level that occurs elsewhere."""
    levels = [np.unique(column, return_inverse=True)[1] for column in values.T]
    return any(np.mean(np.abs(np.diff(level)) > 1) > _JUMPING_SHARE for level in levels)


def _find_reading_period(interval: Floats) -> float | None:
    """Return the period of readings in messages, from intervals between changes; None if they are irregular."""
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


def _find_arrivals(at_ns: Floats, changed: Ints, *, period_ns: float, message_ns: float) -> Ints:
    """Return rows that change or where equal readings are expected: evenly between changes and beyond the outer ones.

    If messages are missing for a reading's period, the age of the first message after them is unknown: it is no
    arrival.
    """
    resumed = np.flatnonzero(np.diff(at_ns) > period_ns) + 1
    found = [changed[:0]]
    for rows in np.split(np.arange(at_ns.size), resumed):
        changed_rows = changed[(changed > rows[0]) & (changed <= rows[-1])]
        anchor = at_ns[changed_rows] if changed_rows.size else at_ns[rows[:1]]
        begin = anchor[0] - np.floor((anchor[0] - at_ns[rows[0]]) / period_ns) * period_ns
        end = anchor[-1] + np.floor((at_ns[rows[-1]] - anchor[-1]) / period_ns) * period_ns
        anchor = np.concatenate(([begin], anchor, [end]))
        between = np.diff(anchor)
        count = np.maximum(np.rint(between / period_ns), 1.0).astype(np.int64)
        expected = np.repeat(anchor[:-1], count) + number_within(count) * np.repeat(between / count, count)
        equal = np.setdiff1d(np.append(expected, end), at_ns[changed_rows])
        found += [changed_rows, np.maximum(np.searchsorted(at_ns, equal - 0.5 * message_ns), rows[0])]
    return np.unique(np.concatenate(found))


_FEWEST = 60
_DELAYS = np.linspace(-1.0, 1.5, 26)  # delays that are tried, in periods: 0 is a sample's, a half is a mean's
_NEAR = 0.25
_MAX_RESIDUAL_RATIO = 0.9  # largest ratio of squared residuals at which the better delay is accepted


def is_stated_averaged(
    power_ns: Ints, power_watt: Floats, motion_ns: Ints, forward_mps: Floats, yaw_rate_radps: Floats
) -> bool | None:
    """Return whether values are means since the one before (True) or samples (False); None if motion shows neither.

    Power is fitted by a constant, speed, its square, turning and the gain of speed, as means over one period about a
    delay before each stamp. The delay that fits best decides, unless it fits neither case, or only slightly better than
    the other.

    Parameters
    ----------
    power_ns, power_watt : [ns], [W], shape (N,), rising stamps, finite.
    motion_ns, forward_mps, yaw_rate_radps : [ns], [m/s], [rad/s], shape (M,), rising stamps, finite.
    """
    if power_ns.size < _FEWEST:
        return None
    period_s = float(np.median(np.diff(power_ns))) / 1e9
    power, motion = SampledSignal(power_ns, power_watt), np.column_stack((forward_mps, yaw_rate_radps, forward_mps**2))
    fit = make_power_fit(power, motion_ns, motion, averaged=False, margin_s=2.0 * period_s)
    if fit is None:
        return None
    squares = np.array([fit.fit_means(late * period_s, period_s).sum() for late in _DELAYS])
    best = _DELAYS[int(np.argmin(squares))]
    sampled, averaged = (float(np.interp(late, _DELAYS, squares)) for late in (0.0, 0.5))
    if min(abs(best), abs(best - 0.5)) > _NEAR or min(sampled, averaged) > _MAX_RESIDUAL_RATIO * max(sampled, averaged):
        return None
    return averaged < sampled


_INSTANT_S = 0.1  # span around a sample over which motion is averaged [s]
_WIDTHS_S = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)
_DELAYS_S = np.linspace(-2.0, 2.0, 81)
SMOOTHING_MARGIN_S, DELAY_MARGIN_S = _WIDTHS_S[-1], 2.0 + _INSTANT_S
"""Motion that must be known before and after a power sample [s]."""
_DELAY_GROUPS = 8  # parts of the run, each of which is left out once
_MAX_ROWS = 20_000  # power samples that are compared with the motion, evenly taken of more
_FEWEST_MEANS = 20  # fewest means of a width in the record: five causes fit fewer by chance if power wanders slowly


@dataclass(frozen=True, slots=True)
class PowerFit:
    """Power samples and the motion around them, for fits of one by the other.

    Attributes
    ----------
    at_s, power_watt : times of the samples (the middle of a stated mean) and values, shape (N,).
    motion_s, sums : times of the motion, shape (M,), and integrals of the causes of power from the first time, shape
        (M, 5): constant, speed, turning, gain of kinetic energy, and one more.
    stated_s : width of the means that the source states; 0 for instantaneous values.
    """

    at_s: Floats
    power_watt: Floats
    motion_s: Floats
    sums: Floats
    stated_s: float

    def compute_squared_residuals(self, smoothing: Smoothing) -> Floats:
        """Return the squared residuals [W²], shape (N,), of power smoothed and delayed so; width 0: a delay only."""
        return self.fit_means(smoothing.late_s, max(self.stated_s + smoothing.width_s, _INSTANT_S))

    def fit_means(self, late_s: float, width_s: float) -> Floats:
        """Return squared residuals [W²], shape (N,), of power by its causes' means over a width, with a delay."""
        later, earlier = (
            np.column_stack([np.interp(self.at_s - late_s + half_s, self.motion_s, each) for each in self.sums.T])
            for half_s in (width_s / 2.0, -width_s / 2.0)
        )
        causes = (later - earlier) / width_s
        found = np.linalg.lstsq(causes, self.power_watt, rcond=None)[0]
        return np.asarray(np.square(self.power_watt - causes @ found))


def make_power_fit(
    power: SampledSignal, motion_ns: Ints, motion: Floats, *, averaged: bool, margin_s: float
) -> PowerFit | None:
    """Return the power samples that have known motion around them; None for fewer than 60.

    Parameters
    ----------
    motion_ns, motion : rising stamps [ns], shape (M,), and forward velocity, yaw rate and one more cause of power (rate
        of climb), shape (M, 3).
    averaged : whether a value is stated to be the mean since the one before it.
    margin_s : motion that must be known before and after a sample [s].
    """
    if min(power.value.size, motion_ns.size) < _FEWEST:
        return None
    margin_ns = round(margin_s * 1e9)
    inside = np.flatnonzero((power.stamp_ns > motion_ns[0] + margin_ns) & (power.stamp_ns < motion_ns[-1] - margin_ns))
    if inside.size < _FEWEST:
        return None
    inside = inside[:: -(-inside.size // _MAX_ROWS)]
    stated_s = float(np.median(np.diff(power.stamp_ns))) / 1e9 if averaged else 0.0
    at_s, motion_s = (power.stamp_ns[inside] - motion_ns[0]) / 1e9 - stated_s / 2.0, (motion_ns - motion_ns[0]) / 1e9
    speed, steps_s = np.abs(motion[:, 0]), np.diff(motion_s)[:, None]
    gained = np.gradient(0.5 * speed**2, motion_s)
    causes = np.column_stack((np.ones_like(speed), speed, np.abs(motion[:, 1]), gained, motion[:, 2]))
    sums = np.concatenate((np.zeros((1, 5)), np.cumsum(steps_s * (causes[1:] + causes[:-1]) / 2.0, axis=0)))
    return PowerFit(at_s, power.value[inside], motion_s, sums, stated_s)


def find_delay(fit: PowerFit) -> tuple[float, float] | None:
    """Return the delay of power behind motion [s] and its standard deviation; None if motion does not determine it.

    The standard deviation is that of the delete-a-group jackknife over parts of the run.
    """
    part = np.arange(fit.at_s.size) * _DELAY_GROUPS // fit.at_s.size
    squares = np.array([np.bincount(part, fit.compute_squared_residuals(Smoothing(d, -d))) for d in _DELAYS_S])
    whole = squares.sum(axis=1)
    total = fit.power_watt.size * float(np.var(fit.power_watt))
    explained = (total - whole.min()) / max(total, 1.0)  # 0 for constant power
    delay_s, *others_s = (_find_minimum(whole - left_out) for left_out in (0.0, *squares.T))
    std_s = float(np.sqrt((_DELAY_GROUPS - 1) * np.var(others_s)))
    least, most_s = (read_threshold("power-delayed", name) for name in ("min_explained_fraction", "max_std_s"))
    return (delay_s, std_s) if explained >= least and std_s <= most_s and np.isfinite(delay_s) else None


def _find_minimum(squares: Floats) -> float:
    """Return the delay [s] of the least sum of squares, by a parabola through its neighbours; NaN at the ends."""
    best = int(np.argmin(squares))
    if best in {0, squares.size - 1}:
        return np.nan
    before, at, after = squares[best - 1 : best + 2]
    curvature = before - 2.0 * at + after
    step_s = float(_DELAYS_S[1] - _DELAYS_S[0])
    return float(_DELAYS_S[best] + (0.5 * step_s * (before - after) / curvature if curvature > 0.0 else 0.0))


def find_smoothing(fit: PowerFit, *, corrected_s: float = 0.0) -> Smoothing | None:
    """Return over how long power [W] is smoothed, by the motion that it follows; None if that is not sure.

    A mean must explain more than a delay alone, and clearly more than means about the stamp, which fit better if the
    motion is noisy. ``corrected_s`` is the recipe's correction of the stamps [s]: a mean ends at the uncorrected stamp.
    """
    after_s = max(-corrected_s, 0.0)
    longest_s = float(fit.at_s[-1] - fit.at_s[0]) / _FEWEST_MEANS
    tried = [Smoothing(width_s - after_s, after_s) for width_s in _WIDTHS_S if after_s < width_s <= longest_s]
    if not tried:
        return None
    about = [Smoothing(width_s / 2.0 - after_s, width_s / 2.0 + after_s) for width_s in _WIDTHS_S]
    delayed = [Smoothing(delay_s, -delay_s) for delay_s in _DELAYS_S[::2]]
    unexplained, least, by_delay = (
        [fit.compute_squared_residuals(smoothing).sum() for smoothing in each]
        for each in (tried, [Smoothing(0.0, 0.0), *about], delayed)
    )
    limit = min(read_threshold("power-smoothed", "max_unexplained_fraction") * min(least), *by_delay)
    return tried[int(np.argmin(unexplained))] if min(unexplained) <= limit else None


def estimate_smoothing_variance(power: SampledSignal, steady: Mask, smoothing: Smoothing) -> float:
    """Return the variance of power [W²] that smoothing hides, by changes of smoothed power [W]; ``steady``: (N,)."""
    at_s = (power.stamp_ns - power.stamp_ns[0]) / 1e9
    earlier_s = at_s - smoothing.width_s
    change = power.value - np.interp(earlier_s, at_s, power.value)
    used = steady & (np.interp(earlier_s, at_s, steady) == 1.0) & (earlier_s > 0.0)
    if used.sum() < _FEWEST:
        used = earlier_s > 0.0
    share = (smoothing.before_s**3 + smoothing.after_s**3) / (2.0 * smoothing.width_s**3)
    return share * float(np.mean(np.square(change[used]))) if used.any() else 0.0


_USUAL_DELAY_S = 0.03  # σ of the delay of power where clocks are synchronised [s]: a period of 20 Hz or less


def estimate_delay_variance(
    rails: list[Rail], start_ns: Ints, end_ns: Ints, delay_s: float, std_s: float, *, rule: Rule
) -> Floats:
    """Return the mean squared change of each span's energy by a delay of power [J²], shape (M,); 0 if unknown.

    The energies of two consecutive spans change by opposite amounts at their border: over a path the error averages
    out. The mean is over the normal distribution of the delay (``delay_s``, ``std_s`` [s]), by three nodes of
    Gauss-Hermite quadrature. A delay inside 2σ is weighted with the usual delay of a synchronised driver.
    """
    if abs(delay_s) < 2.0 * std_s:
        weight = _USUAL_DELAY_S**2 / (_USUAL_DELAY_S**2 + std_s**2)
        delay_s, std_s = weight * delay_s, weight**0.5 * std_s
    stamped = integrate_energy(rails, start_ns, end_ns, rule=rule)
    squares = []
    for node_s in delay_s + std_s * np.sqrt(3.0) * np.array([-1.0, 0.0, 1.0]):
        shift_ns = round(node_s * 1e9)
        squares.append((integrate_energy(rails, start_ns + shift_ns, end_ns + shift_ns, rule=rule) - stamped) ** 2)
    return np.nan_to_num(np.average(squares, axis=0, weights=[1 / 6, 2 / 3, 1 / 6]))
