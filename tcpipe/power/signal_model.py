"""What a sampled voltage or current is made of, by the time over which it changes, read off the record itself.

A signal is taken as a sum of processes, each with a variance and a correlation time, plus independent errors of its samples (noise,
rounding). What tells them apart is the scatter of second differences at several spacings: independent errors scatter alike at all of
them, a process that changes over a time tau scatters more the wider the spacing, up to tau. Second differences are blind to a level and a
steady rise, which an integral of straight lines follows exactly. Two families of processes are tried over a range of tau and fitted with
non-negative variances: exp(-d / tau), which is as rough as a random walk, and (1 + d / tau) exp(-d / tau), which is smooth (Rasmussen and
Williams, Gaussian Processes for Machine Learning, section 4.2.1: Matern with nu = 1/2 and 3/2). Independent errors are what samples
scatter by while the robot stands. Where it hardly does, they are fitted too, in place of what changes within a period; for means, which
differ from those, they are the scatter where the record is calmest.

A drive is not alike everywhere. The processes hold for the whole record; their size near a segment is that of the second
differences there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.power.least_squares import solve_non_negative
from tcpipe.power.rails import Samples

Mask = NDArray[np.bool_]

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

_NS = 1e-9
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
"""What scatters by more than this, against the calmest stretches, while a robot stands is more than the error of samples."""
_NOT_NOISE = 16.0
"""A square beyond so many variances is no noise: of a normal variate one in 16,000."""
_SIEVES = 5
_MEDIAN_OF_SQUARE = 0.4549
"""Of a normal variate of unit variance."""
_NODES = 24  # of the overlap of two periods


@dataclass(frozen=True, slots=True)
class SignalModel:
    """What a signal is made of; variances in its unit squared.

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
    """Return what the signal is made of where it counts.

    Parameters
    ----------
    steady : shape (N,), the samples that count.
    still : shape (N,), the samples of a robot that stands, where all scatter is error.
    averaged : whether a sample is the mean since the one before it.
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
    """Return the non-negative size of each row of ``made``, shape (J, S), whose sum is nearest to what is seen."""
    fitted: list[float] = solve_non_negative((made * weight).T, seen * weight).tolist()
    return fitted


def _estimate_stationary_error(signal: Samples, still: Mask) -> float | None:
    """Return the variance of a sample while the robot stands, in the signal's unit squared; None where it hardly does.

    From the squared differences of following samples, without those that a motor makes which starts or stops among them: what lies
    beyond four deviations is left out, again and again. A median, from which this begins, is a multiple of the record's resolution.
    """
    if still.sum() <= _FEWEST_STILL:
        return None
    square = np.diff(signal.value[still]) ** 2
    variance = float(np.median(square)) / _MEDIAN_OF_SQUARE
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
        u = (np.arange(-_NODES, _NODES) + 0.5) / _NODES
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
