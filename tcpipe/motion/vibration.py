"""How a robot shakes: the specific force in a band of frequencies, without gravity and without what steering and slopes do to it.

Band-pass filtered as a Butterworth filter of fourth order does forwards and backwards (no delay; gain one half at either edge), in the
frequency domain. At a metre a second the band holds what is 5 cm to 33 cm long; an IMU of 50 Hz tells it as one of 400 Hz does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

LOW_HZ, HIGH_HZ = 3.0, 20.0
LEAST_RATE_HZ = 2.5 * HIGH_HZ
_ORDER = 4
_RATE_TOLERANCE = 0.98  # a 50 Hz IMU is 50 Hz though its stamps jitter
_GAP_PERIODS = 3.0
_RINGS_S = 1.0 / LOW_HZ  # so far from a gap the filter still tells of it
_NS = 1e-9


def compute_vibration_mps2(stamp_ns: Stamps, specific_force_mps2: Floats, start_ns: Stamps, end_ns: Stamps) -> Floats:
    """Return the root mean square over each span of the band-passed specific force, its axes together [m/s²], shape (M,).

    NaN where the sensor is slower than 50 Hz, has a gap of more than three periods in the span or near it, or does not reach over it.
    Samples are of one clock epoch, in any order; of several at one stamp the first counts. The force, shape (N, 3), is finite, in the
    sensor's axes.
    """
    unknown = np.full(len(start_ns), np.nan)
    if (np.diff(stamp_ns) <= 0).any():
        stamp_ns, first = np.unique(stamp_ns, return_index=True)
        specific_force_mps2 = specific_force_mps2[first]
    if len(stamp_ns) < 3 or not len(start_ns):
        return unknown
    period_s = float(np.median(np.diff(stamp_ns))) * _NS
    if 1.0 / period_s < _RATE_TOLERANCE * LEAST_RATE_HZ:
        return unknown
    mean = specific_force_mps2.mean(axis=0)
    square = sum(
        _filter_band(axis - mean_mps2, period_s) ** 2
        for axis, mean_mps2 in zip(specific_force_mps2.T, mean, strict=True)
    )
    total = np.concatenate(([0.0], np.cumsum(square)))
    begin, end = (np.searchsorted(stamp_ns, at_ns, side="right") for at_ns in (start_ns, end_ns))
    mean_square = np.divide(total[end] - total[begin], end - begin, out=unknown.copy(), where=end > begin)
    known = _is_without_gap(stamp_ns, start_ns, end_ns, longest_s=_GAP_PERIODS * period_s)
    rms: Floats = np.sqrt(np.where(known, np.maximum(mean_square, 0.0), np.nan))
    return rms


def _filter_band(values: Floats, period_s: float) -> Floats:
    """Return what of regularly sampled values, shape (N,), lies in the band."""
    spectrum = np.fft.rfft(values)
    frequency_hz = np.fft.rfftfreq(len(values), period_s)[1:]
    power = 2 * _ORDER
    gain = 1.0 / ((1.0 + (frequency_hz / HIGH_HZ) ** power) * (1.0 + (LOW_HZ / frequency_hz) ** power))
    spectrum[0], spectrum[1:] = 0.0, spectrum[1:] * gain
    passed: Floats = np.fft.irfft(spectrum, len(values))
    return passed


def _is_without_gap(stamp_ns: Stamps, start_ns: Stamps, end_ns: Stamps, *, longest_s: float) -> NDArray[np.bool_]:
    """Return the spans over which, and around which, samples follow one another."""
    gaps = np.concatenate(([0], np.cumsum(np.diff(stamp_ns) * _NS > longest_s)))
    last, near_ns = len(stamp_ns) - 1, round(_RINGS_S / _NS)
    before = np.searchsorted(stamp_ns, start_ns - near_ns, side="right") - 1
    after = np.searchsorted(stamp_ns, end_ns + near_ns, side="left")
    inside = (start_ns >= stamp_ns[0]) & (end_ns <= stamp_ns[-1])
    known: NDArray[np.bool_] = inside & (gaps[np.minimum(after, last)] == gaps[np.maximum(before, 0)])
    return known
