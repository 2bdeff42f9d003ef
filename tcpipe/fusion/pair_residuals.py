"""Residuals of every pair of sensors over windows of several lengths, and the densities that explain their variance.

A residual is the motion by one sensor minus the motion by another, over a window of Δ seconds. Fixes and an odometry
are compared along and across the heading in the window's middle, and upward; two odometries only along it. The variance
of a residual is a sum of densities times features, which are integrals over the path driven in the window:

- fixes: white noise and Gauss-Markov processes, on each axis, also when stationary;
- an odometry: white velocity noise, and a scale as Gauss-Markov processes; a common scale of all odometries, which
cancels in the comparison of two odometries;
- slide: white noise of the sideways velocity; heading and pitch: Gauss-Markov errors of the direction in which an
odometry is integrated.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from tcpipe.arrays import Floats, Ints, Mask
from tcpipe.fusion.level_motion import (
    COURSE,
    STEP_S,
    Attitude,
    OdometryTrack,
    average_grid,
    find_level_motion,
    integrate_grid,
    make_free_track,
)
from tcpipe.fusion.measurements import GNSS, Measurements, Positions
from tcpipe.fusion.signals import compute_seconds, find_longest_step_ns, interpolate_signal, is_in_gap, remove_spikes

ALONG, ACROSS, UP = "along", "across", "up"
FIX_S, SCALE_S = (1.0, 3.0, 10.0, 30.0, 100.0), (3.0, 10.0, 30.0, 100.0)
"""Correlation times of processes [s]: of fixes, of scales and directions."""

_STILL_MPS = 0.02  # slower: stationary
_PAIR_STEP_S = 0.1  # between window ends of two odometries


@dataclass(frozen=True, slots=True)
class Residuals:
    """Residuals of a pair of sensors along one axis over windows of one length, one row a window.

    Attributes
    ----------
    start_ns, end_ns : [ns], shape (M,).
    value : [m], shape (M,).
    features : by density name, the factor of the density in the variance of each value, shape (M,).
    is_still : shape (M,), whether the robot is stationary in the whole window.
    """

    pair: tuple[str, str]
    axis: str
    time_s: float
    start_ns: Ints
    end_ns: Ints
    value: Floats
    features: Mapping[str, Floats]
    is_still: Mask


@dataclass(frozen=True, slots=True)
class _Section:
    """Measurements and attitude of a section; rows where windows of odometries may end, and their stamps [ns]."""

    measurements: Measurements
    attitude: Attitude
    zero_ns: int
    rows: Ints
    at_ns: Ints

    def choose_windows(self, at_ns: Ints, sources: Sequence[Ints]) -> Iterator[tuple[float, Ints, Ints]]:
        """Yield time difference, first rows and last rows of windows among increasing stamps (N,).

        No window contains a gap of a source; ``sources`` are their stamps.
        """
        at_s = compute_seconds(at_ns, self.zero_ns)
        period_s = max(float(np.median(np.diff(at_s))), 1e-3) if at_s.size > 1 else np.inf
        gaps_ns = [find_longest_step_ns(stamp_ns, 300_000_000) for stamp_ns in sources]  # longest gap [ns]
        for time_s in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 80.0):  # time differences [s]
            if time_s < 0.9 * period_s:
                continue
            # Eight windows start within the length of one; at most 600 windows have one length.
            first = np.arange(0, at_s.size, max(1, round(time_s / 8 / period_s), -(-at_s.size // 600)))
            last = np.searchsorted(at_s, at_s[first] + time_s - 0.5 * period_s)
            first, last = first[last < at_s.size], last[last < at_s.size]
            length_s = at_s[last] - at_s[first]
            usable = np.abs(length_s - time_s) < max(0.05 * time_s, 0.6 * period_s)
            for stamp_ns, longest_ns in zip(sources, gaps_ns, strict=True):
                usable &= ~is_in_gap(stamp_ns, at_ns[first], at_ns[last], longest_ns=longest_ns)
            if usable.sum() >= 8:
                yield float(np.median(length_s[usable])), first[usable], last[usable]


def find_residuals(measurements: Measurements) -> list[Residuals]:
    """Return the residuals of all pairs of sensors that can be compared; empty without odometry or turn rates."""
    motion, gnss = find_level_motion(measurements), measurements.gnss
    if motion is None or motion.attitude.role == COURSE:
        return []
    zero_ns, attitude, forward, tracks = motion.zero_ns, motion.attitude, motion.forward_mps, motion.tracks
    rows = np.arange(0, attitude.time_s.size, round(_PAIR_STEP_S / STEP_S))
    at_ns = zero_ns + np.rint(attitude.time_s[rows] * 1e9).astype(np.int64)
    section = _Section(measurements, attitude, zero_ns, rows, at_ns)
    residuals = list[Residuals]()
    speed = np.abs(average_grid(np.column_stack([*forward.values()]), 0.5)).max(axis=1)  # averages noise [s]
    for role, track in tracks.items():
        residuals += _compare_fixes(section, gnss, role, track, speed) if gnss is not None else []
    if len(tracks) < len(forward):
        tracks = {role: make_free_track(each, attitude) for role, each in forward.items()}
    for first, second in combinations(tracks, 2):
        residuals += _compare_odometries(section, (first, second), tracks[first], tracks[second])
    return residuals


def _compare_fixes(
    section: _Section, gnss: Positions, role: str, track: OdometryTrack, speed_mps: Floats
) -> list[Residuals]:
    """Return the residuals of fixes against an aligned track; ``speed_mps`` (n,) determines whether the robot moves."""
    attitude = section.attitude
    fix_s = compute_seconds(gnss.stamp_ns, section.zero_ns)
    difference = gnss.position_enu_m - interpolate_signal(attitude.time_s, track.path_m + track.arm_m, fix_s)
    difference = np.stack([remove_spikes(axis, fill=np.nan) for axis in difference.T], -1)
    if gnss.unclaimed is not None and gnss.has_claims:  # the recipe's variance for unclaimed fixes is a guess
        difference[gnss.unclaimed] = np.nan
    has_others = len(section.measurements.odometries()) > 1
    sources = (section.measurements.odometries()[role].stamp_ns, attitude.source_ns)
    residuals = []
    for time_s, first, last in section.choose_windows(gnss.stamp_ns, sources):
        window = _Window(track, attitude, fix_s[first], fix_s[last])
        change = difference[last] - difference[first]
        cosine, sine = np.cos(window.heading_rad), np.sin(window.heading_rad)
        values = {
            ALONG: cosine * change[:, 0] + sine * change[:, 1],
            ACROSS: cosine * change[:, 1] - sine * change[:, 0],
            UP: change[:, 2],
        }
        is_still = window.is_still(speed_mps)
        if not attitude.is_level:
            values[UP] = np.where(is_still, values[UP], np.nan)
        for axis, value in values.items():
            features = _describe_fixes(gnss, axis, first, last, time_s)
            features |= window.describe(role, axis, has_others=has_others)
            stamps = gnss.stamp_ns[first], gnss.stamp_ns[last]
            residuals.append(Residuals((GNSS, role), axis, time_s, *stamps, value, features, is_still))
    return residuals


def _describe_fixes(gnss: Positions, axis: str, first: Ints, last: Ints, time_s: float) -> dict[str, Floats]:
    """Return the factors of the fixes' densities, which belong to a fix with the median claim."""
    claimed = gnss.variance_m2[:, 2] if axis == UP else gnss.variance_m2[:, :2].mean(1)
    share = claimed / np.median(claimed)
    a, b = share[first], share[last]
    name = "up" if axis == UP else "fix"
    features = {f"{name} white": a + b}
    for tau in FIX_S:
        features[f"{name} process {tau:g}"] = a + b - 2.0 * np.sqrt(a * b) * np.exp(-time_s / tau)
    return features


def _compare_odometries(
    section: _Section, pair: tuple[str, str], first: OdometryTrack, second: OdometryTrack
) -> list[Residuals]:
    """Return the residuals of two odometries along the heading of the first, the second scaled to it."""
    rows, at_ns, time_s = section.rows, section.at_ns, section.attitude.time_s
    at_s = time_s[rows]
    length = [integrate_grid(track.speed_mps)[rows] for track in (first, second)]
    step = max(1, round(5.0 / _PAIR_STEP_S))
    moved = [each[step:] - each[:-step] for each in length]
    moves = np.abs(moved[0]) > 0.2
    if not moves.any():
        return []
    scale = float(np.median(moved[1][moves] / moved[0][moves]))
    if scale <= 0.0:
        return []
    difference = length[0] - length[1] / scale
    residuals = []
    straight = replace(first, heading_rad=np.zeros(time_s.size))
    sources = [section.attitude.source_ns, *(section.measurements.odometries()[role].stamp_ns for role in pair)]
    for window_s, i, j in section.choose_windows(at_ns, sources):
        window = _Window(straight, section.attitude, at_s[i], at_s[j])
        features = window.describe_odometry(pair[0], ALONG) | window.describe_odometry(pair[1], ALONG)
        is_still = window.length_m < _STILL_MPS * window_s
        residuals.append(
            Residuals(pair, ALONG, window_s, at_ns[i], at_ns[j], difference[j] - difference[i], features, is_still)
        )
    return residuals


def _take_nodes(values: Floats, start_s: Floats, end_s: Floats) -> Floats:
    """Return the grid values at the middles of equal parts of each window, (M, nodes)."""
    nodes = max(2, min(40, round(float(np.median(end_s - start_s)) / STEP_S)))
    part = (np.arange(nodes) + 0.5) / nodes
    rows = np.rint((start_s[:, None] + (end_s - start_s)[:, None] * part) / STEP_S).astype(np.int64)
    return np.asarray(values[rows.clip(0, values.size - 1)])


def _integrate_process(weight: Floats, window_s: float, tau_s: float) -> Floats:
    """Return the variance of the integral of weights (M, nodes) times a unit Gauss-Markov process, shape (M,)."""
    step_s = window_s / weight.shape[1]
    node = np.arange(weight.shape[1])
    covariance = np.exp(-np.abs(node[:, None] - node) * (step_s / tau_s)) * step_s**2
    return np.asarray(np.einsum("mj,mj->m", np.einsum("mi,ij->mj", weight, covariance), weight))


class _Window:
    """The path of a track within windows of one length."""

    def __init__(self, track: OdometryTrack, attitude: Attitude, start_s: Floats, end_s: Floats) -> None:
        self._span = (start_s, end_s)
        self._yaw = attitude.yaw_rad
        self.time_s = float(np.median(end_s - start_s))
        self.heading_rad = np.interp(0.5 * (start_s + end_s), attitude.time_s, track.heading_rad)
        direction = _take_nodes(track.heading_rad, start_s, end_s) - self.heading_rad[:, None]
        self._speed = _take_nodes(track.speed_mps, start_s, end_s)
        self._climb = _take_nodes(np.gradient(track.path_m[:, 2], STEP_S), start_s, end_s)
        self._ahead, self._aside = np.cos(direction), np.sin(direction)
        self._step_s = self.time_s / self._speed.shape[1]
        self.length_m = np.abs(self._speed).sum(1) * self._step_s

    def is_still(self, speed_mps: Floats) -> Mask:
        """Return, for each window, whether the robot neither moves nor turns."""
        turned = np.ptp(_take_nodes(self._yaw, *self._span), axis=1)
        return np.asarray(
            (_take_nodes(speed_mps, *self._span) < _STILL_MPS).all(1) & (turned < 0.02 + 0.01 * self.time_s)  # rad
        )

    def describe(self, role: str, axis: str, *, has_others: bool) -> dict[str, Floats]:
        """Return the factors of the densities of an odometry in a comparison with fixes."""
        if axis == UP:
            pitch = {f"pitch scale {tau:g}": _integrate_process(self._speed, self.time_s, tau) for tau in SCALE_S}
            return pitch | {
                f"{role} scale {tau:g}": _integrate_process(self._climb, self.time_s, tau) for tau in SCALE_S
            }
        features = self.describe_odometry(role, axis)
        if has_others:  # of a single odometry the common scale is indistinguishable from its own
            features |= {f"shared scale {tau:g}": features[f"{role} scale {tau:g}"] for tau in SCALE_S}
        other = self._speed * (self._aside if axis == ALONG else self._ahead)
        features |= {f"heading scale {tau:g}": _integrate_process(other, self.time_s, tau) for tau in SCALE_S}
        features["slide velocity"] = self._integrate_moving(self._aside if axis == ALONG else self._ahead)
        return features

    def describe_odometry(self, role: str, axis: str) -> dict[str, Floats]:
        """Return the factors of the own densities of an odometry."""
        direction = self._ahead if axis == ALONG else self._aside
        forward = self._speed * direction
        features = {f"{role} scale {tau:g}": _integrate_process(forward, self.time_s, tau) for tau in SCALE_S}
        features[f"{role} velocity"] = self._integrate_moving(direction)
        return features

    def _integrate_moving(self, direction: Floats) -> Floats:
        """Return the time in motion [s], weighted with the square of a direction cosine (M, nodes)."""
        moving = np.abs(self._speed) > 1e-3
        return np.asarray((moving * direction**2).sum(1) * self._step_s)
