"""Spans in which fixes err together (a wrong ambiguity, a reflection), determined from both ends.

A filter that comes to a jump cannot know which side of it is wrong, and one that was led off by a ramp takes the return for the jump.
Offline both sides are known. For each span in which the fixes may have erred the filter is run with an error of theirs in its state there
and nowhere else, and never follows what it refuses. What contradicts the rest then shows in the squared normalised innovations of all
that counts: fixes outside of the span, wheels and camera. The span with the least of it is taken; each span, and each second of it, costs
a little, so that of two that explain as much the simpler is taken. Where one that shares little with the best explains about as much,
nobody can tell.

`find_fix_errors` estimates the part of a fix's error that scatters from one to the next, and the part that lasts. A receiver's covariance
is one number for both; the part that scatters averages out, the part that lasts (a float solution's ambiguities, satellite-based
corrections, multipath) moves a track with it. Fixes are laid, over twenty seconds, on the path that odometry and gyroscope draw, by
rotation, scale and the bend of a gyroscope's bias. Second differences of the residual are the white part. Where it is a quarter of the
claimed variance or less, the rest of the claim lasts; where it is far more, it counts instead. A residual that is far larger than claimed
is an error that lasts and was not claimed. Where a receiver claims nothing, the scatter is the white part, and nothing lasts except where
the fixes bend off the path by more than an odometry does in twenty seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import Measurements, Positions
from tcpipe.fusion.process import turn_sources
from tcpipe.fusion.signals import compute_median_period_ns, compute_seconds, integrate_signal

Span = tuple[int, int]
"""First and last stamp [ns]."""
Spans = tuple[Span, ...]

_LASTS_NS = 2_000_000_000  # shorter rejections are outliers
_FEWEST = 5  # fewer rejections are outliers
_TOGETHER_NS = 3_000_000_000  # rejections this close are one event
_ALONE = 3  # fewer rejections in a row explain nothing
_MOST = 3  # events tried, longest first
_A_SECOND = 2.0  # cost of a second of a span
_A_SPAN = 50.0  # cost of a span
_SURELY = 100.0  # certain improvement; a wrong fix costs hundreds
_SHARED = 0.5  # overlap below which two explanations differ
_MOST_OF = 0.6  # share of a run that is no span
_REACH_NS = 60_000_000_000  # inflated on both sides of an unplaced jump; judged
_RETURNS_NS = 180_000_000_000  # a receiver corrects a wrong ambiguity until then; judged
_LEADS_NS = (3_000_000_000, 10_000_000_000, 20_000_000_000)


@dataclass(frozen=True, slots=True)
class Innovations:
    """What gates saw of the measurements of one role, in order of time.

    Stamps [ns], squared normalised innovations, which were refused, the gate, and how far fixes are off, horizontally [m].
    """

    stamp_ns: NDArray[np.int64]
    squared: NDArray[np.float64]
    refused: NDArray[np.bool_]
    gate: float
    off_m: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FaultHypothesis:
    """How much the sensors contradict each other if fixes err in ``spans``, and the spans of rejected fixes that remain."""

    spans: Spans
    cost: float
    refused: Spans
    size_m: float
    """By how far fixes were then off."""


Try = Callable[[Spans], FaultHypothesis]


def compute_unexplained_innovation(
    spans: Spans, fixes: Innovations, others: Sequence[Innovations], usual: float
) -> FaultHypothesis:
    """Return what a run leaves unexplained in which the fixes err in ``spans``.

    ``fixes`` and ``others`` are what the gates saw. ``usual`` is the squared innovation of a right fix: single outliers count as much, and
    so do fixes inside the spans.
    """
    free = is_inside(fixes.stamp_ns, spans)
    single = fixes.refused & ~_is_in_runs(fixes.refused, _ALONE)
    squared = np.where(free | single, usual, np.minimum(fixes.squared, fixes.gate))
    cost = float(squared.sum()) + sum(float(np.minimum(o.squared, o.gate).sum()) for o in others)
    off = fixes.refused & ~free & ~single
    size_m = float(np.median(fixes.off_m[off])) if off.any() else 0.0
    return FaultHypothesis(spans, cost + _A_SECOND * _compute_length(spans), _find_rejected_spans(fixes, free), size_m)


def is_inside(stamp_ns: NDArray[np.int64], spans: Spans) -> NDArray[np.bool_]:
    """Return which stamps lie in a span."""
    found = np.zeros(stamp_ns.size, np.bool_)
    for first, last in spans:
        found |= (stamp_ns >= first) & (stamp_ns < last)
    return found


def _find_runs(of: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return first and one past the last index of each run of True, shape (R, 2)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], of.astype(np.int8), [0]))))
    return edges.reshape(-1, 2)


def _is_in_runs(of: NDArray[np.bool_], fewest: int) -> NDArray[np.bool_]:
    found = np.zeros_like(of)
    for first, end in _find_runs(of):
        found[first:end] = end - first >= fewest
    return found


def _find_rejected_spans(fixes: Innovations, free: NDArray[np.bool_]) -> Spans:
    """Return the spans in which fixes were rejected for seconds, almost without exception."""
    found: list[tuple[int, int, int]] = []
    for first, end in _find_runs(_is_in_runs(fixes.refused & ~free, _ALONE)):
        begin_ns, end_ns = int(fixes.stamp_ns[first]), int(fixes.stamp_ns[min(end, fixes.stamp_ns.size - 1)])
        if found and begin_ns - found[-1][1] < _TOGETHER_NS:
            begin_ns, _, count = found.pop()
            found.append((begin_ns, end_ns, count + int(end - first)))
        else:
            found.append((begin_ns, end_ns, int(end - first)))
    return tuple((a, b) for a, b, count in found if count >= _FEWEST and b - a >= _LASTS_NS)


@dataclass(frozen=True, slots=True)
class GnssFaults:
    """When fixes err together, when they may as well have, as far as a minute from where they jump, and by how much [m]."""

    spans: Spans
    doubtful: Spans
    size_m: float

    def doubt_m2(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the variance of undecided errors at each stamp [m²], east, north and up, shape (N, 3)."""
        unsure = is_inside(stamp_ns, self.doubtful) & ~is_inside(stamp_ns, self.spans)
        return np.asarray(unsure[:, None] * np.array([1.0, 1.0, 0.0]) * self.size_m**2)


@dataclass(frozen=True, slots=True)
class Jump:
    """When rejected fixes were accepted at last, and their difference, east and north [m]."""

    stamp_ns: int
    off_m: NDArray[np.float64]


def find_returned_fixes(jumps: Sequence[Jump]) -> GnssFaults | None:
    """Return from when to when fixes jumped and back, where nothing else carries the pose: which side is wrong, nobody can tell for sure.

    Those in between are doubted: they are the fewer.
    """
    spans: list[Span] = []
    size_m, rest = 0.0, list(jumps)
    while len(rest) > 1:
        first, second = rest[0], rest[1]
        there, back = np.linalg.norm(first.off_m), np.linalg.norm(second.off_m)
        soon = second.stamp_ns - first.stamp_ns < _RETURNS_NS
        if soon and np.linalg.norm(first.off_m + second.off_m) < _SHARED * max(there, back):
            spans.append((first.stamp_ns - _LEADS_NS[0], second.stamp_ns))
            size_m = max(size_m, float(there), float(back))
            rest.pop(0)
        rest.pop(0)
    return GnssFaults((), _merge_spans(tuple(spans)), size_m) if spans else None


def find_wrong_fixes(tried: Try, whole: Span, known: Spans) -> GnssFaults | None:
    """Return the spans in which fixes were wrong, as all sensors together explain it best; None where no spans explain it.

    ``tried`` runs the filter with the error of the fixes free in spans; ``known`` are spans in which fixes were off in a run that follows
    them in the end.
    """
    plain = tried(())
    events = _merge_spans((*plain.refused, *known))
    if not events or _compute_length(events) > _MOST_OF * _compute_length((whole,)):
        return None
    found = [tried(spans) for spans in _iterate_candidates(events, whole)]
    best = min(found, key=lambda each: _weight(each) + (_SURELY if _is_endless(each.spans, whole) else 0.0))
    begun, alternatives = best, tuple(found)
    for lead_ns in _LEADS_NS[1:]:
        longer = tuple((max(whole[0], first - lead_ns + _LEADS_NS[0]), last) for first, last in begun.spans)
        found.append(tried(_merge_spans(longer)))
        best = found[-1] if _weight(found[-1]) < _weight(best) - _A_SPAN else best
    if _weight(best) > _weight(plain) - _SURELY:
        return None
    doubtful = [
        span
        for other in alternatives
        if _has_rival(other, best, alike=len(events) > 1)
        for span in _iterate_near(other.spans, events)
    ]
    return GnssFaults(best.spans, _merge_spans(tuple(doubtful)), plain.size_m)


def _weight(each: FaultHypothesis) -> float:
    """Return what an explanation costs, each of its spans included."""
    return each.cost + _A_SPAN * len(each.spans)


def _is_endless(spans: Spans, whole: Span) -> bool:
    """Return whether the fixes were not seen to be right before, or afterwards."""
    return spans[0][0] <= whole[0] or spans[-1][1] >= whole[1]


def _has_rival(other: FaultHypothesis, best: FaultHypothesis, *, alike: bool) -> bool:
    """Return whether another explanation is about as good and shares little with the best.

    The innovations after a single jump do not show when it ends: then one that is much longer is no more ``alike``. Nor is one span alike
    several short ones: a filter without other position sensors follows wrong fixes after seconds.
    """
    shared = sum(max(0, min(b, d) - max(a, c)) * 1e-9 for a, b in best.spans for c, d in other.spans)
    longer = max(_compute_length(best.spans), _compute_length(other.spans))
    whole = _compute_length(best.spans) if alike and len(best.spans) == 1 else longer
    better = _weight(other) - _weight(best)
    if not alike:
        better -= _A_SECOND * (_compute_length(other.spans) - _compute_length(best.spans))
    return better < _SURELY and shared < _SHARED * whole


def _iterate_near(spans: Spans, events: Spans) -> Iterator[Span]:
    """Yield what of the spans lies within a minute of where an event begins."""
    for first, last in spans:
        for at, _ in events:
            begin, end = max(first, at - _REACH_NS), min(last, at + _REACH_NS)
            if end > begin:
                yield begin, end


def _compute_length(spans: Spans) -> float:
    return sum((last - first) * 1e-9 for first, last in spans)


def _merge_spans(spans: Spans) -> Spans:
    """Return spans in order of time, those that overlap or follow each other at once as one."""
    found: list[Span] = []
    for first, last in sorted(spans):
        if found and first <= found[-1][1] + _TOGETHER_NS:
            found[-1] = (found[-1][0], max(last, found[-1][1]))
        else:
            found.append((first, last))
    return tuple(found)


def _iterate_candidates(events: Spans, whole: Span) -> Iterator[Spans]:
    """Yield in which spans fixes may err that were off at some times: in these, between two such times, or ever before or after one."""
    longest = sorted(sorted(events, key=lambda span: span[0] - span[1])[:_MOST])
    lead_ns = _LEADS_NS[0]
    yield _merge_spans(tuple((max(whole[0], first - lead_ns), last) for first, last in longest))
    for (first, _), (second, _) in combinations(longest, 2):
        yield ((max(whole[0], first - lead_ns), second),)
    for first, _ in longest:
        yield ((max(whole[0], first - lead_ns), whole[1]),)
        if first - lead_ns > whole[0]:
            yield ((whole[0], first),)


Floats = NDArray[np.float64]

_BLOCK_S = 20.0  # span of fitting fixes to the drawn path
_FEWEST_FIXES = 15
_WINDOW_S = 6.0  # window of the scatter
_LITTLE = 0.25  # variance ratio below which the rest lasts
_FAR_MORE = 6.0  # variance ratio above which scatter replaces the claim
_UNCLAIMED = 3.0  # σ beyond which an error was not claimed
_DRAWN_HOLDS_M = 0.15  # bend of a drawn path in 20 s
_SHARE_SEEN = 6.0  # ratio of a two-minute error to 20 s
_BENDS_M = 0.09  # bend above that of clean drives (0.02 to 0.06 m)
_LEAST_M = 0.01  # no fix is better (`fuse.gnss_std_floor_m`)
_FLOAT_M = 0.5  # float solutions are better
_LASTS_S = 45.0  # correlation time of a float solution
_METRES_LAST_S = 120.0  # correlation time of metre-size errors
_LARGE_M = 0.03  # smaller lasting errors go into σ
_SQUARES_OF_TWO = 1.3863  # median of χ², two degrees of freedom
_SQUARES_OF_ONE = 0.4549  # median of χ², one degree


@dataclass(frozen=True, slots=True)
class FixErrors:
    """Errors of fixes: variances [m²] of the white part and of the part that lasts, shape (N, 3), and how long that lasts [s], (N,)."""

    white_m2: Floats
    lasting_m2: Floats
    lasts_s: Floats

    @property
    def matters(self) -> bool:
        """Whether the part that lasts is larger anywhere than what odometry holds over seconds, and is not one of metres throughout."""
        return bool((self.lasting_m2[:, :2] > _LARGE_M**2).any()) and not self.of_metres

    @property
    def of_metres(self) -> bool:
        """Whether an error of half a metre or more lasts most of the time."""
        return float(np.median(self.lasting_m2[:, 0])) > _FLOAT_M**2


def find_fix_errors(measurements: Measurements) -> FixErrors | None:
    """Return the errors of the fixes; None without any."""
    gnss = measurements.gnss
    if gnss is None or gnss.stamp_ns.size == 0:
        return None
    claimed = gnss.variance_m2
    white, lasting = claimed.copy(), np.zeros_like(claimed)
    drawn = _draw_path(measurements, gnss)
    left = _compute_residual_path(gnss, drawn)
    scatter = np.empty_like(claimed)
    second = _compute_second_differences(left)
    scatter[:, 0] = scatter[:, 1] = _compute_rolling_median(gnss, second) / (6 * _SQUARES_OF_TWO)
    scatter[:, 2] = _compute_rolling_median(gnss, _compute_second_differences(gnss.position_enu_m[:, 2])) / (
        6 * _SQUARES_OF_ONE
    )
    least = np.minimum(np.maximum(0.01 * claimed, _LEAST_M**2), claimed)  # a robot that stands does not show it
    little = scatter < _LITTLE * claimed
    white[little] = np.maximum(scatter, least)[little]
    lasting[little] = np.minimum(claimed - scatter, 0.99 * claimed)[little]
    if drawn is not None and gnss.unclaimed is not None:
        unclaimed = gnss.unclaimed & np.isfinite(scatter).all(1)
        white[unclaimed] = np.maximum(scatter, _LEAST_M**2)[unclaimed]
        lasting[unclaimed] = _compute_bends(gnss, np.abs(left) ** 2)[unclaimed]
    if drawn is not None:
        much = scatter > _FAR_MORE * claimed
        white[much] = scatter[much]
        wander_m2 = float(np.nanmedian(np.abs(left) ** 2)) / _SQUARES_OF_TWO if np.isfinite(left).any() else 0.0
        if wander_m2 > max(_UNCLAIMED**2 * float(np.median(claimed[:, 0])), _DRAWN_HOLDS_M**2):
            white = np.maximum(scatter, least)
            lasting[:] = np.maximum(lasting, _SHARE_SEEN**2 * wander_m2)
    lasts_s = np.where(lasting[:, 0] > _FLOAT_M**2, _METRES_LAST_S, _LASTS_S)
    return FixErrors(white, lasting, lasts_s)


def _compute_bends(gnss: Positions, left_m2: Floats) -> Floats:
    """Return what lasts of fixes that claim nothing: where they bend off the drawn path by more than an odometry does, shape (N, 3)."""
    wander_m2 = _compute_rolling_median(gnss, left_m2, _BLOCK_S) / _SQUARES_OF_TWO
    seen = np.where(wander_m2 > _BENDS_M**2, _SHARE_SEEN**2 * wander_m2, 0.0)
    return np.asarray(seen[:, None] * np.array([1.0, 1.0, 4.0]))


def _draw_path(measurements: Measurements, gnss: Positions) -> NDArray[np.complex128] | None:
    """Return the antenna's places as odometry and turn rates draw them, from any yaw; None where they do not."""
    odometries = list(measurements.odometries().values())
    imu, sources = measurements.imu, turn_sources(measurements)
    if not odometries or (imu is None and not sources):
        return None
    zero = int(gnss.stamp_ns[0])
    source = odometries[-1]
    if imu is not None:
        turn_s, turn = compute_seconds(imu.stamp_ns, zero), imu.angular_velocity_radps[:, 2:]
    else:
        known = np.isfinite(sources[-1].yaw_rate_radps)
        turn_s, turn = compute_seconds(sources[-1].stamp_ns[known], zero), sources[-1].yaw_rate_radps[known, None]
    at_s, driven_s = compute_seconds(gnss.stamp_ns, zero), compute_seconds(source.stamp_ns, zero)
    yaw = integrate_signal(turn_s, turn, driven_s)[:, 0]
    velocity = source.velocity_mps[:, :1] * np.stack((np.cos(yaw), np.sin(yaw)), -1)
    places = integrate_signal(driven_s, velocity, at_s) @ np.array([1.0, 1j])
    lever = complex(*gnss.lever_arm_m[:2])
    return np.asarray(places + lever * np.exp(1j * integrate_signal(turn_s, turn, at_s)[:, 0]), np.complex128)


def _compute_residual_path(gnss: Positions, drawn: NDArray[np.complex128] | None) -> NDArray[np.complex128]:
    """Return what is left of the fixes, east and i times north [m], when the drawn path is laid on them block by block; NaN in between."""
    places = gnss.position_enu_m[:, :2] @ np.array([1.0, 1j])
    at_s = compute_seconds(gnss.stamp_ns, int(gnss.stamp_ns[0]))
    length_s = max(_BLOCK_S, _FEWEST_FIXES * 1e-9 * compute_median_period_ns(gnss.stamp_ns))
    left = np.full(places.size, np.nan + 0j)
    for first_s in np.arange(0.0, at_s[-1], length_s):
        rows = slice(*np.searchsorted(at_s, (first_s, first_s + length_s)))
        if rows.stop - rows.start < _FEWEST_FIXES:
            continue
        block = places[rows] - np.mean(places[rows])
        if drawn is not None:
            step = np.diff(drawn[rows], prepend=drawn[rows][:1])
            bent = np.cumsum(1j * (at_s[rows] - first_s) * step)  # by a gyroscope's bias
            columns = np.column_stack((np.ones(block.size), drawn[rows] - drawn[rows][0], bent))
            block = block - columns @ np.linalg.lstsq(columns, block, rcond=1e-6)[0]
        left[rows] = block
    return left


def _compute_second_differences(values: NDArray[np.complex128] | Floats) -> Floats:
    """Return the squared size of each second difference, NaN at the ends and beside NaN, shape (N,)."""
    squared = np.full(values.size, np.nan)
    squared[1:-1] = np.abs(np.diff(values, n=2)) ** 2
    return squared


def _compute_rolling_median(gnss: Positions, values: Floats, window_s: float = _WINDOW_S) -> Floats:
    """Return the median of the known values over some seconds around each fix, shape (N,); where none is known, that of all."""
    count = max(_FEWEST_FIXES, round(window_s * 1e9 / compute_median_period_ns(gnss.stamp_ns)))
    known = np.flatnonzero(np.isfinite(values))
    if known.size < count:
        return np.full(values.size, np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(values[known], count)[:: max(1, count // 6)]
    medians = np.median(windows, axis=1)
    centres = known[count // 2 :][:: max(1, count // 6)][: medians.size]
    return np.asarray(np.interp(np.arange(values.size), centres, medians))
