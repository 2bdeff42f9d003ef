"""Standard deviation of a span's energy due to sampling, noise and quantisation of its power record.

The energy of a span is a weighted sum of samples. Independent errors of samples add their variance times the sum of the
squared weights. For a process with covariance s exp(-d / tau) that is sampled every h seconds, the integral over a span
differs from the sum of samples by the variance s h² (coth(h / 2 tau) - 2 tau / h) for each interval. Means over periods
have this error only where an end of the span divides a period.

`fit_signal_model` describes a signal as a sum of such processes and independent errors. The scatter of a stationary
robot is the variance of the errors. Second differences at several spacings determine the processes: a process of tau
scatters more the wider the spacing, up to tau. Second differences are zero for a constant and for a steady rise, which
an integral of straight lines follows exactly. The model is of the whole record; near a span the second differences
there give the size of the processes.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from tcpipe.arrays import Floats, Ints, Mask, accumulate, count_before
from tcpipe.power.rails import Rail, SampledSignal, interpolate_rail, sum_power
from tcpipe.power.sampling import estimate_smoothing_variance
from tcpipe.tables.facts import Smoothing

_NS = 1e-9


@dataclass(frozen=True, slots=True)
class EnergyNoise:
    """Variances of each span's energy by cause [J²], shape (M,), independent of each other; 0 without rails.

    ``rate``: of the current between its samples, or within the time over which it is smoothed; ``current``: of its
    noise and rounding; ``voltage``: all of the voltage's.
    """

    rate: Floats
    current: Floats
    voltage: Floats

    def std_joule(self) -> Floats:
        """Return the standard deviation of each span's energy [J], shape (M,)."""
        return np.sqrt(self.rate + self.current + self.voltage)


def estimate_energy_noise(
    rails: list[Rail],
    start_ns: Ints,
    end_ns: Ints,
    still_ns: Ints,
    *,
    rate_hz: float | None = None,
    smoothing: Smoothing | None = None,
) -> EnergyNoise:
    """Return the uncertainty of each span's energy from sampling, noise and quantisation.

    Parameters
    ----------
    start_ns, end_ns : [ns], shape (M,), the spans of steady driving of the labels, in order of time.
    still_ns : [ns], shape (S, 2), begin and end of every span in which the robot is stationary, in order of time.
    rate_hz : [Hz], as if power had been sampled so; None as it was.
    """
    rate, current, voltage = np.zeros((3, len(start_ns)))
    middle = start_ns + (end_ns - start_ns) // 2
    for each in rails:
        if not len(each.stamp_ns) or not len(start_ns):
            continue
        volt, amp = interpolate_rail(each, middle)
        (between, error), of_voltage = (
            _estimate_integral_variance(signal, start_ns, end_ns, still_ns, averaged=each.averaged, rate_hz=rate_hz)
            for signal in (each.current, each.voltage)
        )
        rate += volt**2 * between
        current += volt**2 * error
        voltage += amp**2 * sum(of_voltage)
    if smoothing is not None and (power := sum_power(rails)) is not None:
        steady = _is_inside(power.stamp_ns, start_ns, end_ns)
        rate += np.square((end_ns - start_ns) * _NS) * estimate_smoothing_variance(power, steady, smoothing)
    return EnergyNoise(rate, current, voltage)


def compute_median_period_s(signal: SampledSignal) -> float:
    """Return the median time between samples [s]; infinite with fewer than two."""
    return float(np.median(np.diff(signal.stamp_ns))) * _NS if len(signal.stamp_ns) > 1 else np.inf


def estimate_resolution(signal: SampledSignal) -> float:
    """Return the quantisation step of a record, in its own unit; 0 if none shows (most values differ)."""
    levels = np.unique(signal.value)
    return float(np.median(np.diff(levels))) if 1 < len(levels) < 0.5 * len(signal.value) else 0.0


def _is_inside(at_ns: Ints, start_ns: Ints, end_ns: Ints) -> Mask:
    """Return whether each time, shape (N,), is inside one of several spans, (M,)."""
    return np.searchsorted(start_ns, at_ns, side="right") > np.searchsorted(end_ns, at_ns, side="left")


def _estimate_integral_variance(
    signal: SampledSignal, start_ns: Ints, end_ns: Ints, still_ns: Ints, *, averaged: bool, rate_hz: float | None
) -> tuple[Floats, Floats]:
    """Return the variance of the signal's time integral over each span, in its unit squared times s², shape (M,).

    The first is by changes of the signal between samples, the second by the errors of samples.
    """
    if len(signal.value) < 3:
        return np.zeros(len(start_ns)), np.zeros(len(start_ns))
    steady, still = (_is_inside(signal.stamp_ns, *spans) for spans in ((start_ns, end_ns), still_ns.T))
    model = fit_signal_model(signal, steady, still, averaged=averaged)
    sample_s, start_s, end_s = ((at_ns - signal.stamp_ns[0]) * _NS for at_ns in (signal.stamp_ns, start_ns, end_ns))
    if rate_hz is not None:  # all spans on one short grid, each at its phase
        start_s, end_s = start_s % (1.0 / rate_hz), end_s - start_s + start_s % (1.0 / rate_hz)
        sample_s = np.arange(end_s.max() * rate_hz + 2.0) / rate_hz
    interval_s = np.diff(sample_s)
    edge_s = sample_s if averaged else np.r_[sample_s[0], sample_s[1:] - interval_s / 2.0, sample_s[-1]]
    error = _sum_squared_shares(model.error_variance * np.diff(edge_s) ** 2, edge_s, start_s, end_s)
    if averaged:
        ends = (_find_cells(at_s, sample_s) for at_s in (start_s, end_s))
        between = sum(model.compute_divided_variance(interval_s[cell], share) for cell, share in ends)
    else:
        between = _sum_squared_shares(model.compute_interval_variance(interval_s), sample_s, start_s, end_s)
        between += model.slope_variance * np.median(interval_s) ** 4 / 72.0
    scale = estimate_local_scale(model, signal, steady, start_ns, end_ns)
    return scale * between, error + _estimate_rounding(signal, start_ns, end_ns)


def _find_cells(at_s: Floats, edge_s: Floats) -> tuple[Ints, Floats]:
    """Return the cell (edges: shape (N + 1,)) of each time, and the share of the cell before it, shape (M,)."""
    place = np.interp(at_s, edge_s, np.arange(len(edge_s)))
    cell = np.minimum(place.astype(np.int64), len(edge_s) - 2)
    return cell, place - cell


def _sum_squared_shares(variance: Floats, edge_s: Floats, start_s: Floats, end_s: Floats) -> Floats:
    """Sum the variances of cells, (N,), times the squared share of each cell that a span covers, shape (M,)."""
    (first, begin), (last, end) = (_find_cells(at_s, edge_s) for at_s in (start_s, end_s))
    sums = np.add.reduceat(variance, np.column_stack((first, last)).ravel())[::2] - variance[first]
    divided = variance[first] * (1.0 - begin) ** 2 + variance[last] * end**2
    return np.where(first < last, sums + divided, variance[first] * (end - begin) ** 2)


def _estimate_rounding(signal: SampledSignal, start_ns: Ints, end_ns: Ints) -> Floats:
    """Return the variance of a signal on one level of its resolution, shape (M,): all its samples have one error."""
    changes = count_before(np.diff(signal.value) != 0)
    first, last = (changes[np.maximum(np.searchsorted(signal.stamp_ns, at) - 1, 0)] for at in (start_ns, end_ns))
    return np.asarray((estimate_resolution(signal) * (end_ns - start_ns) * _NS) ** 2 / 12.0 / (1 + last - first))


_TAU = np.array([0.1, 1.0 / 3.0, 1.0, 3.0, 9.0, 27.0, 1.5, 4.5, 13.5])
"""Correlation times of exponentials, in sampling periods."""
_PROCESSES = np.vstack((np.eye(6, 9), 2.0 * np.eye(3, 9, 3) - np.eye(3, 9, 6)))
"""Covariances of unit variance by exponentials: six are rough, three smooth, 2 exp(-d / tau) - exp(-2 d / tau)."""
_SLOPES = np.append(np.zeros(6), 2.0 / _TAU[3:6] ** 2)
"""Slope variance of the smooth processes [1/s²]; h⁴ / 72 of it adds to an integral's error (Euler-Maclaurin)."""
_SPACINGS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)  # spacings of second differences, in samples: about two an octave
_FEWEST = 20  # fewest second differences at a spacing: their mean square is known to a third
_LOCAL_NS, _PRIOR_SAMPLES, _MIN_SCALE = 2_000_000_000, 4.0, 0.05
"""Processes near a span: time before and after it [ns], weight of the whole record in samples, least value."""
_CALM_S, _CALM_SAMPLES = 1.5, 8
"""Length of a calm section [s] (below that of a stop, above the correlation time of vibration), and fewest samples."""


@dataclass(frozen=True, slots=True)
class SignalModel:
    """Parts of a signal; variances in its unit squared.

    Attributes
    ----------
    error_variance : independent error of each sample.
    variance, tau_s : of each exponential of the processes' covariance, shape (K,), with its correlation time [s].
    curvature_variance, slope_variance : mean of `compute_curvature`, and slopes of smooth processes [per s²].
    """

    error_variance: float
    variance: Floats
    tau_s: Floats
    curvature_variance: float
    slope_variance: float

    def compute_interval_variance(self, interval_s: Floats) -> Floats:
        """Return the variance of the processes' integral less that by samples, for intervals [s], shape (N,)."""
        half = interval_s / (2.0 * self.tau_s[:, None])
        return np.maximum(interval_s**2 * (self.variance @ (1.0 / np.tanh(half) - 1.0 / half)), 0.0)

    def compute_divided_variance(self, period_s: Floats, share: Floats) -> Floats:
        """Return the variance of integrals over a share of periods [s] less that share of their means, shape (M,)."""
        before, after = (part * period_s / self.tau_s[:, None] for part in (share, 1.0 - share))
        squares = (1.0 - share) ** 2 * (before + np.expm1(-before)) + share**2 * (after + np.expm1(-after))
        products = share * (1.0 - share) * np.expm1(-before) * np.expm1(-after)
        return np.maximum(2.0 * (self.variance * self.tau_s**2) @ (squares - products), 0.0)


def fit_signal_model(signal: SampledSignal, steady: Mask, still: Mask, *, averaged: bool) -> SignalModel:
    """Return the model of a signal by its ``steady`` samples, shape (N,), or by all where these are too few.

    ``still``, shape (N,), marks samples of a stationary robot, where all scatter is error. A sample of an ``averaged``
    signal is the mean since the one before it.
    """
    period_s, size = compute_median_period_s(signal), np.zeros(len(_PROCESSES))
    spacing, observed, weight = _compute_second_differences(signal, steady, period_s)
    if not len(spacing):
        spacing, observed, weight = _compute_second_differences(signal, np.ones_like(steady), period_s)
    if not len(spacing):
        return SignalModel(0.0, np.zeros(len(_TAU)), period_s * _TAU, 0.0, 0.0)
    predicted = _PROCESSES @ _predict_second_differences(spacing, averaged=averaged)
    error = _estimate_error_variance(signal, still, period_s, averaged=averaged)
    if error is None:
        columns = np.vstack((np.ones(len(spacing)), predicted[2:]))  # faster processes look like independent errors
        error, *size[2:] = nnls((columns * weight).T, observed * weight)[0].tolist()
    else:
        error = min(error, float(observed.min()))
        size = nnls((predicted * weight).T, (observed - error) * weight)[0]
    slope_variance = float(size @ _SLOPES) / period_s**2
    return SignalModel(error, size @ _PROCESSES, period_s * _TAU, float(size @ predicted[:, 0]), slope_variance)


def estimate_local_scale(
    model: SignalModel, signal: SampledSignal, steady: Mask, start_ns: Ints, end_ns: Ints
) -> Floats:
    """Return the ratio of the processes' variance near each span to that of the record, shape (M,).

    Near are the steady samples from 2 s before to 2 s after the span; the whole record counts as 4 samples.
    """
    if model.curvature_variance <= 0.0:
        return np.ones(len(start_ns))
    near, used = signal.stamp_ns[1:-1], steady[1:-1]
    sums, counts = (accumulate(each) for each in (compute_curvature(signal) * used, used))
    first, last = np.searchsorted(near, start_ns - _LOCAL_NS), np.searchsorted(near, end_ns + _LOCAL_NS, side="right")
    expected = model.curvature_variance + model.error_variance
    local = (sums[last] - sums[first] + _PRIOR_SAMPLES * expected) / (counts[last] - counts[first] + _PRIOR_SAMPLES)
    return np.asarray(np.maximum((local - model.error_variance) / model.curvature_variance, _MIN_SCALE))


def compute_curvature(signal: SampledSignal) -> Floats:
    """Return inner samples' squared deviations from their neighbours' line, as one sample's variance, (N - 2,)."""
    t, x = signal.stamp_ns, signal.value
    right = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
    off_line = x[1:-1] - (1.0 - right) * x[:-2] - right * x[2:]
    return off_line**2 / (1.0 + right**2 + (1.0 - right) ** 2)


def _estimate_error_variance(signal: SampledSignal, still: Mask, period_s: float, *, averaged: bool) -> float | None:
    """Return the variance of a sample against its neighbours: the median of calm sections of a stationary robot.

    If no section is stationary throughout, use the calmest twentieth of means; for samples the variance is unknown.
    """
    count = max(_CALM_SAMPLES, round(_CALM_S / period_s))
    stationary = still[:-2] & still[1:-1] & still[2:]
    squares, is_still = (accumulate(each) for each in (compute_curvature(signal), stationary))
    means = (squares[count:] - squares[:-count]) / count
    calm = means[is_still[count:] - is_still[:-count] == count]
    if calm.size:
        return float(np.median(calm))
    return float(np.quantile(means, 0.05)) if averaged and means.size else None


def _compute_second_differences(signal: SampledSignal, steady: Mask, period_s: float) -> Floats:
    """Return spacings, the variance of one sample by second differences at each, and their weights, shape (3, S)."""
    found, x, t = list[tuple[int, float, float]](), signal.value, signal.stamp_ns
    unsteady = count_before(~steady)
    for m in (each for each in _SPACINGS if 2 * each < len(x)):
        whole = unsteady[2 * m + 1 :] == unsteady[: -2 * m - 1]
        whole &= np.abs((t[2 * m :] - t[: -2 * m]) * _NS - 2 * m * period_s) < 0.5 * period_s
        if whole.sum() < _FEWEST:
            break
        level = float(np.mean((x[: -2 * m] - 2.0 * x[m:-m] + x[2 * m :])[whole] ** 2)) / 6.0
        found.append((m, level, float(np.sqrt(whole.sum() / m)) / level if level > 0.0 else 0.0))
    return np.array(found).reshape(-1, 3).T


def _predict_second_differences(spacing: Floats, *, averaged: bool) -> Floats:
    """Return the second differences of each process of unit variance, as the variance of one sample, shape (J, S)."""
    rate = 1.0 / _TAU[:, None]
    apart, twice, own = np.exp(-rate * spacing), np.exp(-2.0 * rate * spacing), np.ones_like(rate)
    if averaged:  # covariances of means over a period
        gain = (2.0 * np.sinh(rate / 2.0) / rate) ** 2
        apart, twice, own = gain * apart, gain * twice, 2.0 * (rate + np.expm1(-rate)) / rate**2
    return (6.0 * own - 8.0 * apart + 2.0 * twice) / 6.0
