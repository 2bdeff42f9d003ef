"""How uncertain an energy is because power was sampled, noisy and quantised, judged from the record itself.

The energy of a span is a weighted sum of samples; its error is that sum less the integral of what the current truly did. For a process
with covariance K(t - t') the variance of that error is the double integral of e(t) K(t - t') e(t'), where e is the samples' weights as
impulses less one over the span. It is exact for any sampling, regular or not, and for sources that average: there a sample's weight is
spread over its period, and e vanishes but where a segment's end divides a period. What the processes are is told by `fit_signal_model`.
Independent errors of samples add their variance times the sum of the squared weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.power.rails import Rail, Samples, interpolate_rail
from tcpipe.power.signal_model import SignalModel, estimate_local_scale, fit_signal_model

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

_NS = 1e-9
_NODES = 256  # cells of a span and the samples around it; four times as many change a deviation by 7 % at 20 Hz, at 2 Hz by nothing
_CHUNK = 1000  # spans at a time: some MB
_SETTLED_S = 0.2  # after a stop and before a start the motors still draw


@dataclass(frozen=True, slots=True)
class EnergyNoise:
    """Variances of each span's energy by cause, [J²], shape (M,), independent of each other; 0 without rails.

    Attributes
    ----------
    rate : what the current did between its samples.
    current : noise and rounding of the current.
    voltage : all of the voltage's.
    """

    rate: Floats
    current: Floats
    voltage: Floats

    def std_joule(self) -> Floats:
        """Return the standard deviation of each span's energy, [J], shape (M,)."""
        return np.sqrt(self.rate + self.current + self.voltage)


def estimate_energy_noise(
    rails: list[Rail], start_ns: Stamps, end_ns: Stamps, still_ns: Stamps, *, rate_hz: float | None = None
) -> EnergyNoise:
    """Return how uncertain each span's energy is from sampling, noise and quantisation.

    Parameters
    ----------
    rails : voltage and current of the drive.
    start_ns, end_ns : [ns], shape (M,), the spans of steady driving that a label is wanted of, in time order.
    still_ns : [ns], shape (S, 2), begin and end of every stretch in which the robot stands.
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
    return EnergyNoise(rate, current, voltage)


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
        stamp_ns = np.arange(stamp_ns[0], stamp_ns[-1] + period_ns, period_ns, dtype=np.int64)
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
    """Return the samples of a robot that stands, not within 0.2 s of its moving; of averages those whose period is such."""
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
    """Return the variance of a signal that stands on one level of its resolution, shape (M,): the error of all its samples is one."""
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
