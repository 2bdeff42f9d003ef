"""Vibration: root mean square of the specific force between 3 and 20 Hz, without gravity, steering and slopes.

The band-pass filter is a Butterworth filter of fourth order, forwards and backwards (no delay; gain one half at either
edge), computed in the frequency domain. At 1 m/s the band contains wavelengths of 5 to 33 cm; an IMU at 50 Hz measures
it as well as one at 400 Hz.

A segment is short, so that its mean square varies by chance from one segment of the same ground to the next. The
standard deviation of a vibration is that variation. For a stationary process the variance of a mean square over T
seconds is its square times k / T (Bendat and Piersol, Random Data, 4th ed., 8.2.2: k = 1 / B for white noise of
bandwidth B); k is estimated from differences of near batches.
"""

import math

import numpy as np

from tcpipe.arrays import Floats, Ints, Mask, accumulate, count_before

LOW_HZ, HIGH_HZ = 3.0, 20.0
LEAST_RATE_HZ = 2.5 * HIGH_HZ
_ORDER = 4
_RATE_TOLERANCE = 0.98  # a 50 Hz IMU is 50 Hz though its stamps jitter
_GAP_PERIODS = 3.0
_RINGS_S = 1.0 / LOW_HZ  # time around a gap that the filter spreads it over [s]
_BATCH_S = 1.0
"""Length of a batch whose mean square is compared with that of the next but one [s]: longer than the correlation time
of a resonance."""
_MEDIAN_CHI2 = 0.4549  # median of a chi-square distribution with one degree of freedom
_NS = 1e-9


def compute_vibration_mps2(
    stamp_ns: Ints, specific_force_mps2: Floats, start_ns: Ints, end_ns: Ints
) -> tuple[Floats, Floats]:
    """Return the RMS over each span of the band-passed specific force, and its σ [m/s²], shape (M,) each.

    The three axes are combined. NaN if the sensor is slower than 50 Hz, has a gap of more than three periods in or near
    the span, or does not cover it. Samples are of one clock epoch, in any order; of several at one stamp the first
    counts. The force, shape (N, 3), is finite, in the sensor's axes.
    """
    unknown = np.full(len(start_ns), np.nan)
    if (np.diff(stamp_ns) <= 0).any():
        stamp_ns, first = np.unique(stamp_ns, return_index=True)
        specific_force_mps2 = specific_force_mps2[first]
    if len(stamp_ns) < 3 or not len(start_ns):
        return unknown, unknown
    period_s = float(np.median(np.diff(stamp_ns))) * _NS
    if 1.0 / period_s < _RATE_TOLERANCE * LEAST_RATE_HZ:
        return unknown, unknown
    mean = specific_force_mps2.mean(axis=0)
    square: Floats = np.sum(
        [
            _filter_band(axis - mean_mps2, period_s) ** 2
            for axis, mean_mps2 in zip(specific_force_mps2.T, mean, strict=True)
        ],
        axis=0,
    )
    total = accumulate(square)
    begin, end = (np.searchsorted(stamp_ns, at_ns, side="right") for at_ns in (start_ns, end_ns))
    mean_square = np.divide(total[end] - total[begin], end - begin, out=unknown.copy(), where=end > begin)
    known = _is_without_gap(stamp_ns, start_ns, end_ns, longest_s=_GAP_PERIODS * period_s)
    rms: Floats = np.sqrt(np.where(known, np.maximum(mean_square, 0.0), np.nan))
    edges = np.zeros(len(square) + 1)
    np.add.at(edges, begin, 1.0)
    np.add.at(edges, end, -1.0)
    variance_s = _estimate_relative_variance_s(square[np.cumsum(edges)[:-1] > 0.0], period_s)
    return rms, 0.5 * rms * np.sqrt(variance_s / ((end_ns - start_ns) * _NS))


def _estimate_relative_variance_s(square: Floats, period_s: float) -> float:
    """Return k [s]: a mean square over T seconds has relative variance k / T; NaN for less than three batches."""
    size = round(_BATCH_S / period_s)
    means = square[: len(square) // size * size].reshape(-1, size).mean(axis=1)
    both = means[:-2] + means[2:]
    if not (both > 0.0).any():
        return math.nan
    relative = 2.0 * ((means[2:] - means[:-2])[both > 0.0] / both[both > 0.0]) ** 2
    return float(np.median(relative)) / _MEDIAN_CHI2 * size * period_s


def _filter_band(values: Floats, period_s: float) -> Floats:
    """Return the part of regularly sampled values, shape (N,), that is in the band."""
    spectrum = np.fft.rfft(values)
    frequency_hz = np.fft.rfftfreq(len(values), period_s)[1:]
    power = 2 * _ORDER
    gain = 1.0 / ((1.0 + (frequency_hz / HIGH_HZ) ** power) * (1.0 + (LOW_HZ / frequency_hz) ** power))
    spectrum[0], spectrum[1:] = 0.0, spectrum[1:] * gain
    return np.fft.irfft(spectrum, len(values))


def _is_without_gap(stamp_ns: Ints, start_ns: Ints, end_ns: Ints, *, longest_s: float) -> Mask:
    """Return which spans have no gap in them or near them."""
    gaps = count_before(np.diff(stamp_ns) * _NS > longest_s)
    last, near_ns = len(stamp_ns) - 1, round(_RINGS_S / _NS)
    before = np.searchsorted(stamp_ns, start_ns - near_ns, side="right") - 1
    after = np.searchsorted(stamp_ns, end_ns + near_ns, side="left")
    inside = (start_ns >= stamp_ns[0]) & (end_ns <= stamp_ns[-1])
    return np.asarray(inside & (gaps[np.minimum(after, last)] == gaps[np.maximum(before, 0)]))
