"""Standard deviation of an energy, since power was sampled, noisy and quantised; estimated from the record itself.

The energy of a span is a weighted sum of samples; its error is that sum less the integral of the true current. For a process with
covariance K(t - t') the variance of that error is the double integral of e(t) K(t - t') e(t'), where e is the samples' weights as
impulses less one over the span. It is exact for any sampling, regular or not, and for sources that average: there a sample's weight is
spread over its period, and e vanishes except where a segment's end divides a period. Independent errors of samples add their variance
times the sum of the squared weights.

`fit_signal_model` describes a signal as a sum of processes, each with a variance and a correlation time, plus independent errors of its
samples (noise, rounding). Second differences at several spacings separate them: independent errors scatter alike at all spacings, a
process that changes over a time tau scatters more the wider the spacing, up to tau. Second differences do not see a level and a steady
rise, which an integral of straight lines follows exactly. Two families of processes are fitted over a range of tau with non-negative
variances: exp(-d / tau), rough as a random walk, and (1 + d / tau) exp(-d / tau), which is smooth (Rasmussen and Williams, Gaussian
Processes for Machine Learning, section 4.2.1: Matern with nu = 1/2 and 3/2). Independent errors are the scatter while the robot is
stationary. Where it hardly is, they are fitted too, in place of what changes within a period; for means they are then the scatter where
the record is calmest. The processes hold for the whole record; their size near a segment is that of the second differences there.

Least squares with sizes that cannot be negative.

scipy.optimize has it too, and is what the tests compare with; to load that takes longer than all fits of a run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.power.rails import Rail, Rule, Samples, integrate_energy, interpolate_rail, sum_power
from tcpipe.power.sampling import estimate_smoothing_variance
from tcpipe.robust import MEDIAN_OF_SQUARES
from tcpipe.tables.facts import Smoothing

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

_NS = 1e-9
_NODES = 256  # cells of a span and the samples around it; four times as many change a deviation by 7 % at 20 Hz, at 2 Hz by nothing
_CHUNK = 1000  # spans at a time: some MB
_LONGEST_GAP_NS = 60_000_000_000  # samples at another rate are assumed across gaps up to this length
_SETTLED_S = 0.2  # after a stop and before a start the motors still draw


@dataclass(frozen=True, slots=True)
class EnergyNoise:
    """Variances of each span's energy by cause [J²], shape (M,), independent of each other; 0 without rails.

    ``rate`` is of the current between its samples, or within the time over which it is smoothed, ``current`` of its noise and rounding,
    ``voltage`` all of the voltage's.
    """

    rate: Floats
    current: Floats
    voltage: Floats

    def std_joule(self) -> Floats:
        """Return the standard deviation of each span's energy, [J], shape (M,)."""
        return np.sqrt(self.rate + self.current + self.voltage)


def estimate_energy_noise(
    rails: list[Rail],
    start_ns: Stamps,
    end_ns: Stamps,
    still_ns: Stamps,
    *,
    rate_hz: float | None = None,
    smoothing: Smoothing | None = None,
) -> EnergyNoise:
    """Return the uncertainty of each span's energy from sampling, noise and quantisation.

    Parameters
    ----------
    start_ns, end_ns : [ns], shape (M,), the spans of steady driving of the labels, in order of time.
    still_ns : [ns], shape (S, 2), begin and end of every span in which the robot is stationary.
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
        steady = _select_used_samples(power.stamp_ns, start_ns, end_ns)
        rate += np.square((end_ns - start_ns) * _NS) * estimate_smoothing_variance(power, steady, smoothing)
    return EnergyNoise(rate, current, voltage)


_USUAL_DELAY_S = 0.03
"""σ of the delay of power where clocks are synchronised [s]: a period of 20 Hz or less."""


def estimate_delay_variance(
    rails: list[Rail], start_ns: Stamps, end_ns: Stamps, delay_s: float, std_s: float, *, rule: Rule
) -> Floats:
    """Return the mean square of what a delay of power changes of each span's energy [J²], shape (M,); 0 where it is unknown.

    The energies of two spans in a row change by opposite amounts at their border: over a path the error averages out. The mean is over
    the normal distribution of the delay (``delay_s``, ``std_s`` [s]), by Gauss and Hermite's three nodes. A delay inside 2σ is weighted
    with the usual delay of a synchronised driver.
    """
    if abs(delay_s) < 2.0 * std_s:
        weight = _USUAL_DELAY_S**2 / (_USUAL_DELAY_S**2 + std_s**2)
        delay_s, std_s = weight * delay_s, weight**0.5 * std_s
    stamped = integrate_energy(rails, start_ns, end_ns, rule=rule)
    squares = []
    for node_s in delay_s + std_s * np.sqrt(3.0) * np.array([-1.0, 0.0, 1.0]):
        shift_ns = round(node_s / _NS)
        squares.append((integrate_energy(rails, start_ns + shift_ns, end_ns + shift_ns, rule=rule) - stamped) ** 2)
    return np.nan_to_num(np.average(squares, axis=0, weights=[1 / 6, 2 / 3, 1 / 6]))


def compute_median_period_s(signal: Samples) -> float:
    """Return the median time between samples [s]; infinite with fewer than two."""
    return float(np.median(np.diff(signal.stamp_ns))) * _NS if len(signal.stamp_ns) > 1 else np.inf


def estimate_resolution(signal: Samples) -> float:
    """Return the quantisation step of a record, in its own unit; 0 where none shows (most values differ)."""
    levels = np.unique(signal.value)
    return float(np.median(np.diff(levels))) if 1 < len(levels) < 0.5 * len(signal.value) else 0.0


def _estimate_integral_variance(
    signal: Samples, start_ns: Stamps, end_ns: Stamps, still_ns: Stamps, *, averaged: bool, rate_hz: float | None
) -> tuple[Floats, Floats]:
    """Return the variance of the signal's time integral over each span, in its unit squared times s², shape (M,).

    From what it did between samples, and from the samples' errors.
    """
    if len(signal.value) < 3:
        return np.zeros(len(start_ns)), np.zeros(len(start_ns))
    steady = _select_used_samples(signal.stamp_ns, start_ns, end_ns)
    model = fit_signal_model(
        signal, steady, _select_stationary_samples(signal, still_ns, averaged=averaged), averaged=averaged
    )
    stamp_ns = signal.stamp_ns
    if rate_hz is not None:
        period_ns = round(1e9 / rate_hz)
        sections = np.split(stamp_ns, np.flatnonzero(np.diff(stamp_ns) > _LONGEST_GAP_NS) + 1)
        stamp_ns = np.concatenate([np.arange(each[0], each[-1] + period_ns, period_ns) for each in sections])
    between = np.empty(len(start_ns))
    for first in range(0, len(start_ns), _CHUNK):
        part = slice(first, first + _CHUNK)
        between[part] = _process_variance(model, stamp_ns, start_ns[part], end_ns[part], averaged=averaged)
    between *= estimate_local_scale(model, signal, steady, start_ns, end_ns)
    error = model.error_variance * sum_squared_weights(stamp_ns, start_ns, end_ns, averaged=averaged)
    return between, error + _estimate_rounding(signal, start_ns, end_ns)


def _select_used_samples(stamp_ns: Stamps, start_ns: Stamps, end_ns: Stamps) -> NDArray[np.bool_]:
    """Return the samples that the spans use: those inside, and one on either side."""
    edges = np.zeros(len(stamp_ns) + 1, dtype=np.int64)
    np.add.at(edges, np.maximum(np.searchsorted(stamp_ns, start_ns, side="right") - 1, 0), 1)
    np.add.at(edges, np.minimum(np.searchsorted(stamp_ns, end_ns, side="left") + 1, len(stamp_ns)), -1)
    used: NDArray[np.bool_] = np.cumsum(edges)[:-1] > 0
    return used


def _select_stationary_samples(signal: Samples, still_ns: Stamps, *, averaged: bool) -> NDArray[np.bool_]:
    """Return the samples of a stationary robot, 0.2 s from any motion; of averages those whose whole period is such."""
    edge_ns = round(_SETTLED_S / _NS)
    still = _is_inside(signal.stamp_ns, still_ns, edge_ns)
    if averaged:
        begin_ns = np.concatenate((signal.stamp_ns[:1], signal.stamp_ns[:-1]))
        still &= _is_inside(begin_ns, still_ns, edge_ns) & (
            np.searchsorted(still_ns[:, 0], begin_ns) == np.searchsorted(still_ns[:, 0], signal.stamp_ns)
        )
    return still


def _is_inside(at_ns: Stamps, span_ns: Stamps, edge_ns: int) -> NDArray[np.bool_]:
    begun = np.searchsorted(span_ns[:, 0] + edge_ns, at_ns, side="right")
    ended = np.searchsorted(span_ns[:, 1] - edge_ns, at_ns, side="left")
    inside: NDArray[np.bool_] = begun > ended
    return inside


def _estimate_rounding(signal: Samples, start_ns: Stamps, end_ns: Stamps) -> Floats:
    """Return the variance of a signal that stays on one level of its resolution, shape (M,): all its samples have one error."""
    changes = np.concatenate(([0], np.cumsum(np.diff(signal.value) != 0)))
    first, last = (np.clip(np.searchsorted(signal.stamp_ns, at) - 1, 0, len(changes) - 1) for at in (start_ns, end_ns))
    duration_s = (end_ns - start_ns) * _NS
    variance: Floats = (estimate_resolution(signal) * duration_s) ** 2 / 12.0 / (1 + changes[last] - changes[first])
    return variance


def _process_variance(
    model: SignalModel, stamp_ns: Stamps, start_ns: Stamps, end_ns: Stamps, *, averaged: bool
) -> Floats:
    """Return the double integral of e K e over each span, on a grid over all samples that it uses, shape (M,)."""
    first, last = _find_first_and_last(stamp_ns, start_ns, end_ns)
    zero = stamp_ns[first]
    end_s, last_s = _compute_seconds(end_ns, zero), _compute_seconds(stamp_ns[last], zero)
    step_s = np.maximum(last_s, end_s) / (_NODES - 1)
    edge_s: Floats = (np.arange(_NODES + 1) - 0.5) * step_s[:, None]
    mass = -_integrate_overlap(edge_s, _compute_seconds(start_ns, zero), end_s)
    if averaged:
        mass += _mean_up_to(edge_s, stamp_ns, end_ns, zero) - _mean_up_to(edge_s, stamp_ns, start_ns, zero)
    else:
        span, sample, weight_s = _compute_weights_s(stamp_ns, start_ns, end_ns)
        place = np.clip(_compute_seconds(stamp_ns[sample], zero[span]) / step_s[span], 0.0, _NODES - 1.0)
        node = np.minimum(place.astype(np.int64), _NODES - 2)
        np.add.at(mass, (span, node), weight_s * (1.0 - (place - node)))
        np.add.at(mass, (span, node + 1), weight_s * (place - node))
    pairs = np.fft.irfft(np.abs(np.fft.rfft(mass, 2 * _NODES, axis=1)) ** 2, axis=1)[:, :_NODES]
    pairs[:, 1:] *= 2.0
    lag_s: Floats = np.arange(_NODES) * step_s[:, None]
    variance: Floats = np.sum(pairs * model.covariance(lag_s), axis=1)
    return np.maximum(variance, 0.0)


def _compute_seconds(at_ns: Stamps, zero_ns: Stamps) -> Floats:
    return (at_ns - zero_ns).astype(np.float64) * _NS


def _mean_up_to(edge_s: Floats, stamp_ns: Stamps, at_ns: Stamps, zero_ns: Stamps) -> Floats:
    """Return how much every cell counts in the sum of means up to a time, [s], shape (M, C): a divided period counts by its share."""
    right = np.clip(np.searchsorted(stamp_ns, at_ns, side="left"), 1, len(stamp_ns) - 1)
    before_s, after_s, at_s = (
        _compute_seconds(each, zero_ns) for each in (stamp_ns[right - 1], stamp_ns[right], at_ns)
    )
    share: Floats = np.clip((at_s - before_s) / (after_s - before_s), 0.0, 1.0)
    return _integrate_overlap(edge_s, edge_s[:, 0], before_s) + share[:, None] * _integrate_overlap(
        edge_s, before_s, after_s
    )


def _integrate_overlap(edge_s: Floats, low_s: Floats, high_s: Floats) -> Floats:
    """Return how much of each cell between edges, shape (M, C + 1), lies between two times, [s], shape (M, C)."""
    covered: Floats = np.diff(np.clip(edge_s, low_s[:, None], np.maximum(low_s, high_s)[:, None]), axis=1)
    return covered


def _find_first_and_last(
    stamp_ns: Stamps, start_ns: Stamps, end_ns: Stamps
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first and last sample that each span uses, shape (M,): one beyond either end where there is one."""
    first = np.clip(np.searchsorted(stamp_ns, start_ns, side="right") - 1, 0, len(stamp_ns) - 2)
    return first, np.clip(np.searchsorted(stamp_ns, end_ns, side="left"), first + 1, len(stamp_ns) - 1)


def sum_squared_weights(stamp_ns: Stamps, start_ns: Stamps, end_ns: Stamps, *, averaged: bool) -> Floats:
    """Return the sum of the squared weights that samples have in the integral over each span, [s²], shape (M,)."""
    span, _, weight_s = _compute_weights_s(stamp_ns, start_ns, end_ns, averaged=averaged)
    total: Floats = np.bincount(span, weight_s**2, minlength=len(start_ns)).astype(np.float64)
    return total


def _compute_weights_s(
    stamp_ns: Stamps, start_ns: Stamps, end_ns: Stamps, *, averaged: bool = False
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Return span, sample and weight [s] of every sample that a span uses, each of shape (W,).

    The weight is the integral over the span of the sample's hat function, or, if averaged, of the period that ends at it.
    """
    t = (stamp_ns - stamp_ns[0]) * _NS
    start, end = (start_ns - stamp_ns[0]) * _NS, (end_ns - stamp_ns[0]) * _NS
    first, last = _find_first_and_last(stamp_ns, start_ns, end_ns)
    count = last - first + 1
    span = np.repeat(np.arange(len(start)), count)
    sample = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count - first, count)
    integral = _integrate_period if averaged else _integrate_hat
    return span, sample, integral(t, sample, end[span]) - integral(t, sample, start[span])


def _integrate_period(t: Floats, sample: NDArray[np.int64], until: Floats) -> Floats:
    """Return how much of the period that ends at each sample lies before a time, [s]."""
    before = t[np.maximum(sample - 1, 0)]
    return np.clip(until - before, 0.0, t[sample] - before)


def _integrate_hat(t: Floats, sample: NDArray[np.int64], until: Floats) -> Floats:
    """Return the integral of each sample's hat function up to a time, [s]."""
    left, right = t[np.maximum(sample - 1, 0)], t[np.minimum(sample + 1, len(t) - 1)]
    rise, fall = t[sample] - left, right - t[sample]
    up, down = np.clip(until - left, 0.0, rise), np.clip(until - t[sample], 0.0, fall)
    rising = np.divide(up**2, 2.0 * rise, out=np.zeros_like(up), where=rise > 0)
    falling = down - np.divide(down**2, 2.0 * fall, out=np.zeros_like(down), where=fall > 0)
    integral: Floats = rising + falling
    return integral


Mask = NDArray[np.bool_]


_ROUGH_TAU = (0.1, 1.0 / 3.0, 1.0, 3.0, 9.0, 27.0)
"""Correlation times tried, in sampling periods; what changes within less than one looks like independent errors, unless these are known."""
_SMOOTH_TAU = (1.0, 3.0, 9.0, 27.0)
_SPACINGS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)  # of second differences, in samples: about two an octave
_LONGEST_S = 5.0  # of a spacing: what changes more slowly a segment of a second or two follows exactly
_FEWEST = 20  # second differences at a spacing: their mean square is known to a third
_LOCAL_NS = 2_000_000_000  # a drive changes within seconds, and a current's scatter wants some samples
_PRIOR_SAMPLES = 4.0  # that the whole record counts for beside those near a segment
_CALM_S, _CALM_SAMPLES = 1.5, 8  # shorter than a halt, longer than what vibration correlates over
_FEWEST_STILL = 8
_MOST_OF_CALMEST = 2.0
"""A stationary scatter above this, relative to the calmest spans, is more than the error of samples."""
_NOT_NOISE = 16.0
"""A square beyond so many variances is no noise: of a normal variate one in 16,000."""
_SIEVES = 5
_OVERLAP_NODES = 24  # of the overlap of two periods


@dataclass(frozen=True, slots=True)
class SignalModel:
    """Parts of a signal; variances in its unit squared.

    Attributes
    ----------
    period_s : [s], between samples.
    error_variance : independent error of each sample.
    variance, tau_s, smooth : of each process, shape (J,), with its correlation time [s] and family.
    curvature_variance : expected variance of a sample against its neighbours that the processes make (`compute_curvature` less the errors).
    """

    period_s: float
    error_variance: float
    variance: Floats
    tau_s: Floats
    smooth: Mask
    curvature_variance: float

    def covariance(self, lag_s: Floats) -> Floats:
        """Return the covariance of the processes at each lag [s], any shape."""
        total = np.zeros_like(lag_s)
        for variance, tau_s, smooth in zip(self.variance, self.tau_s, self.smooth, strict=True):
            total += variance * _estimate_correlation(lag_s / tau_s, smooth=bool(smooth))
        return total


def fit_signal_model(signal: Samples, steady: Mask, still: Mask, *, averaged: bool) -> SignalModel:
    """Return the model of a signal by its ``steady`` samples, shape (N,).

    ``still`` are the samples of a stationary robot, shape (N,), where all scatter is error. Of ``averaged`` signals a sample is the mean
    since the one before it.
    """
    period_s = float(np.median(np.diff(signal.stamp_ns))) * _NS
    spacing, seen, weight = _compute_second_differences(signal, steady, period_s)
    if not len(spacing):
        everywhere = np.ones_like(steady)
        spacing, seen, weight = _compute_second_differences(signal, everywhere, period_s)
    tau_s = period_s * np.array(_ROUGH_TAU + _SMOOTH_TAU)
    smooth = np.arange(len(tau_s)) >= len(_ROUGH_TAU)
    if not len(spacing):
        return SignalModel(period_s, 0.0, np.zeros(len(tau_s)), tau_s, smooth, 0.0)
    made = np.stack(
        [
            _predict_second_differences(spacing, period_s, tau, smooth=bool(kind), averaged=averaged)
            for tau, kind in zip(tau_s, smooth, strict=True)
        ]
    )
    error, calmest = _estimate_stationary_error(signal, still), estimate_calmest_variance(signal, period_s)
    if averaged or error is not None:
        error = calmest if error is None else min(error, _MOST_OF_CALMEST * calmest)
    variance = np.zeros(len(tau_s))
    if error is None:
        slow = tau_s >= period_s
        *slowly, error = _fit_sizes(np.vstack((made[slow], np.ones(len(spacing)))), seen, weight)
        variance[slow] = slowly
    else:
        error = min(error, float(seen.min()))
        variance[:] = _fit_sizes(made, seen - error, weight)
    return SignalModel(period_s, error, variance, tau_s, smooth, float(variance @ made[:, 0]))


def estimate_local_scale(model: SignalModel, signal: Samples, steady: Mask, start_ns: Stamps, end_ns: Stamps) -> Floats:
    """Return how large the processes' variance is near each span against the record's, [1], shape (M,).

    Taken over the steady samples from 2 s before to 2 s after the span, with the whole record as a prior of 4 samples.
    """
    if model.curvature_variance <= 0.0 or len(signal.value) < 3:
        return np.ones(len(start_ns))
    counted = steady[1:-1]
    if not counted.any():
        counted = np.ones_like(counted)
    off = np.where(counted, compute_curvature(signal), 0.0)
    sums, counts = (np.concatenate(([0.0], np.cumsum(each))) for each in (off, counted))
    inner = signal.stamp_ns[1:-1]
    first = np.searchsorted(inner, start_ns - _LOCAL_NS, side="left")
    last = np.searchsorted(inner, end_ns + _LOCAL_NS, side="right")
    expected = model.curvature_variance + model.error_variance
    here = (sums[last] - sums[first] + _PRIOR_SAMPLES * expected) / (counts[last] - counts[first] + _PRIOR_SAMPLES)
    scale: Floats = np.maximum(here - model.error_variance, 0.05 * model.curvature_variance) / model.curvature_variance
    return scale


def compute_curvature(signal: Samples) -> Floats:
    """Return each inner sample's squared deviation from the line through its neighbours, as the variance of one sample, shape (N - 2,)."""
    stamp_ns, value = signal.stamp_ns, signal.value
    right = (stamp_ns[1:-1] - stamp_ns[:-2]) / (stamp_ns[2:] - stamp_ns[:-2])
    off_line = value[1:-1] - (1.0 - right) * value[:-2] - right * value[2:]
    single: Floats = off_line**2 / (1.0 + right**2 + (1.0 - right) ** 2)
    return single


def _fit_sizes(made: Floats, seen: Floats, weight: Floats) -> list[float]:
    """Return the non-negative size of each row of ``made``, shape (J, S), whose sum is nearest to ``seen``."""
    fitted: list[float] = solve_non_negative((made * weight).T, seen * weight).tolist()
    return fitted


def _estimate_stationary_error(signal: Samples, still: Mask) -> float | None:
    """Return the variance of a sample while the robot is stationary, in the signal's unit squared; None where it hardly is.

    It is that of the squared differences of successive samples without those beyond four deviations, which a motor makes that starts or
    stops; repeated from their median, which is a multiple of the record's resolution.
    """
    if still.sum() <= _FEWEST_STILL:
        return None
    square = np.diff(signal.value[still]) ** 2
    variance = float(np.median(square)) / MEDIAN_OF_SQUARES
    for _ in range(_SIEVES):
        variance = float(np.mean(square[square <= _NOT_NOISE * variance]))
    return variance / 2.0


def estimate_calmest_variance(signal: Samples, period_s: float) -> float:
    """Return the variance of a sample against its neighbours where the record is calmest, as while standing, in its unit squared.

    Of all stretches of 1.5 s, and of 8 samples at least, one in twenty is calmer.
    """
    count = max(_CALM_SAMPLES, round(_CALM_S / period_s))
    if len(signal.value) < count + 2:
        return 0.0
    sums = np.concatenate(([0.0], np.cumsum(compute_curvature(signal))))
    return float(np.quantile((sums[count:] - sums[:-count]) / count, 0.05))


def _compute_second_differences(signal: Samples, steady: Mask, period_s: float) -> tuple[Stamps, Floats, Floats]:
    """Return spacings, the variance that second differences at each show for one sample, and the weight of each."""
    found = []
    x, t = signal.value, signal.stamp_ns
    unsteady = np.concatenate(([0], np.cumsum(~steady)))
    for m in _SPACINGS:
        if m * period_s > _LONGEST_S or len(x) <= 2 * m:
            break
        whole = unsteady[2 * m + 1 :] == unsteady[: -2 * m - 1]
        whole &= np.abs((t[2 * m :] - t[: -2 * m]) * _NS - 2 * m * period_s) < 0.5 * period_s
        if whole.sum() < _FEWEST:
            break
        square = (x[: -2 * m] - 2.0 * x[m:-m] + x[2 * m :])[whole] ** 2 / 6.0
        found.append((m, float(square.mean()), float(np.sqrt(whole.sum() / m))))
    spacing, seen, weight = (np.array(each) for each in zip(*found, strict=True)) if found else (np.empty(0),) * 3
    return spacing.astype(np.int64), seen, np.divide(weight, seen, out=np.zeros_like(weight), where=seen > 0.0)


def _predict_second_differences(
    spacing: Stamps, period_s: float, tau_s: float, *, smooth: bool, averaged: bool
) -> Floats:
    """Return what second differences show of a process of unit variance, as the variance of one sample, shape (S,)."""
    lag_s = np.stack((0 * spacing, spacing, 2 * spacing)).astype(np.float64) * period_s
    each: Floats
    if averaged:  # covariance of means: that of the process, weighted with the overlap of two periods
        u = (np.arange(-_OVERLAP_NODES, _OVERLAP_NODES) + 0.5) / _OVERLAP_NODES
        weight = (1.0 - np.abs(u)) / np.sum(1.0 - np.abs(u))
        apart: Floats = np.abs(lag_s[..., None] + u * period_s)
        each = _estimate_correlation(apart / tau_s, smooth=smooth) @ weight
    else:
        each = _estimate_correlation(lag_s / tau_s, smooth=smooth)
    expected: Floats = (6.0 * each[0] - 8.0 * each[1] + 2.0 * each[2]) / 6.0
    return expected


def _estimate_correlation(lag: Floats, *, smooth: bool) -> Floats:
    correlation: Floats = (1.0 + lag) * np.exp(-lag) if smooth else np.exp(-lag)
    return correlation


def solve_non_negative(made: Floats, seen: Floats) -> Floats:
    """Return the sizes, none negative, shape (J,), with which the columns of ``made`` (S, J) add up nearest to ``seen`` (S,).

    Lawson and Hanson, Solving Least Squares Problems (1974), algorithm 23.10 (NNLS): columns that would lessen the residual most become
    free one by one; what would become negative stops at zero.
    """
    size, free, vain = np.zeros(made.shape[1]), np.zeros(made.shape[1], np.bool_), np.zeros(made.shape[1], np.bool_)
    rounding = 10.0 * np.finfo(np.float64).eps * np.linalg.norm(made, axis=0) * np.linalg.norm(seen)
    for _ in range(3 * made.shape[1]):
        gain = np.where(free | vain, -np.inf, made.T @ (seen - made @ size))
        best = int(np.argmax(gain))
        if gain[best] <= rounding[best] or free.sum() == len(seen):
            break
        free[best] = True
        tried = _solve_subset(made, seen, free)
        if tried[best] <= 0.0:  # its gain was rounding
            free[best], vain[best] = False, True
            continue
        while (negative := free & (tried <= 0.0)).any():
            share = size[negative] / (size[negative] - tried[negative])
            size = size + share.min() * (tried - size)
            size[np.flatnonzero(negative)[share == share.min()]] = 0.0
            free &= size > 0.0
            tried = _solve_subset(made, seen, free)
        size, vain = tried, np.zeros_like(vain)
    return size


def _solve_subset(made: Floats, seen: Floats, free: NDArray[np.bool_]) -> Floats:
    sizes = np.zeros(made.shape[1])
    sizes[free] = np.linalg.lstsq(made[:, free], seen, rcond=None)[0]
    return sizes
