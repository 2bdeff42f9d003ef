"""Rows of a regular track in uninterrupted pieces: runs, durations, windows and slopes that never cross a gap.

A piece ends at a step of the stamps other than the track's period, or at a new clock epoch
(docs/explanation/rulings.md, Gaps).
"""

from dataclasses import dataclass

import numpy as np

from tcpipe.arrays import Floats, Ints, Mask, accumulate


@dataclass(frozen=True, slots=True)
class MotionRows:
    """Motion of a robot: one value for each row of a regular track.

    Attributes
    ----------
    velocity_mps : [m/s], shape (N,), fused forward velocity.
    yaw_rate_radps : [rad/s], shape (N,).
    wheel_velocity_mps : [m/s], shape (N,), forward velocity by the wheels; NaN where unknown.
    commanded_mps : [m/s], shape (N,), commanded forward velocity; NaN where unknown.
    piece : shape (N,), number of the row's uninterrupted piece (`number_pieces`).
    period_s : [s], the track's period.
    """

    velocity_mps: Floats
    yaw_rate_radps: Floats
    wheel_velocity_mps: Floats
    commanded_mps: Floats
    piece: Ints
    period_s: float

    def count(self, duration_s: float) -> int:
        """Return a duration in rows, to the nearest."""
        return round(duration_s / self.period_s)


def number_pieces(stamp_ns: Ints, epoch: Ints, *, period_ns: float) -> Ints:
    """Return for each row the number of its uninterrupted piece, 0 upward, shape (N,).

    A piece ends at a clock epoch, and at a step that differs from ``period_ns`` by half of it or more.
    """
    broken = (np.abs(np.diff(stamp_ns) - period_ns) >= 0.5 * period_ns) | (np.diff(epoch) != 0)
    return np.concatenate((np.zeros(min(len(stamp_ns), 1), dtype=np.int64), np.cumsum(broken)))


def find_runs(mask: Mask, piece: Ints) -> Ints:
    """Return first and last row of every maximal run of true rows inside one piece, shape (R, 2)."""
    joined = mask[:-1] & mask[1:] & (piece[:-1] == piece[1:])
    edge = np.zeros(min(len(mask), 1), dtype=bool)
    first = np.flatnonzero(mask & ~np.concatenate((edge, joined)))
    last = np.flatnonzero(mask & ~np.concatenate((joined, edge)))
    return np.column_stack((first, last)).astype(np.int64)


def make_mask(spans: Ints, size: int) -> Mask:
    """Return the mask that is true on every span of rows (first, last), shape (size,)."""
    edges = np.zeros(size + 1, dtype=np.int64)
    np.add.at(edges, spans[:, 0], 1)
    np.add.at(edges, spans[:, 1] + 1, -1)
    return np.cumsum(edges)[:size] > 0


def find_piece_spans(piece: Ints) -> Ints:
    """Return first and last row of every piece, shape (P, 2)."""
    return find_runs(np.ones(len(piece), dtype=bool), piece)


def find_piece_bounds(piece: Ints) -> tuple[Ints, Ints]:
    """Return for each row the first and the last row of its piece, both of shape (N,)."""
    spans = find_piece_spans(piece)
    return spans[piece, 0], spans[piece, 1]


def drop_short_runs(mask: Mask, piece: Ints, *, min_rows: int) -> Mask:
    """Return the mask without runs of fewer than ``min_rows`` rows."""
    spans = find_runs(mask, piece)
    return make_mask(spans[spans[:, 1] - spans[:, 0] + 1 >= min_rows], len(mask))


def dilate_mask(mask: Mask, piece: Ints, *, before: int, after: int) -> Mask:
    """Return the mask with every run widened by ``before`` and ``after`` rows, inside its piece."""
    spans = find_runs(mask, piece)
    low, high = find_piece_bounds(piece)
    spans[:, 0] = np.maximum(spans[:, 0] - before, low[spans[:, 0]])
    spans[:, 1] = np.minimum(spans[:, 1] + after, high[spans[:, 1]])
    return make_mask(spans, len(mask))


def compute_window_mean(value: Floats, piece: Ints, *, before: int, after: int) -> Floats:
    """Return the mean over rows k - before … k + after, clipped to the piece, shape (N,).

    ``before=10, after=-1`` is the ten rows ahead of k. NaN where the window is empty.
    """
    first, last = _make_window(piece, before, after)
    total = accumulate(value)
    count = last - first + 1
    mean = np.full(len(value), np.nan)
    np.divide(total[last + 1] - total[first], count, out=mean, where=count > 0)
    return mean


def fit_slope(value: Floats, piece: Ints, *, half_window: int, period_s: float) -> Floats:
    """Return the slope over 2 half_window + 1 rows around each [1/s], one-sided at a piece's ends, shape (N,).

    By least squares: the first derivative of Savitzky and Golay (1964) of order one or two; white noise s in the value
    gives s / period_s / sqrt(n (n² - 1) / 12) in the slope of n rows. A piece of one row has slope 0.
    """
    first, last = _make_window(piece, half_window, half_window)
    low, _ = find_piece_bounds(piece)
    position = np.arange(len(value)) - low
    level = value - value[low]
    total, moment = (accumulate(x) for x in (level, level * position))
    n = last - first + 1
    middle = 0.5 * (position[first] + position[last])
    covariance = (moment[last + 1] - moment[first]) - middle * (total[last + 1] - total[first])
    spread = n * (n.astype(float) ** 2 - 1.0) / 12.0
    result = np.zeros(len(value))
    np.divide(covariance, spread * period_s, out=result, where=spread > 0)
    return result


def _make_window(piece: Ints, before: int, after: int) -> tuple[Ints, Ints]:
    low, high = find_piece_bounds(piece)
    row = np.arange(len(piece))
    return np.maximum(row - before, low), np.minimum(row + after, high)
