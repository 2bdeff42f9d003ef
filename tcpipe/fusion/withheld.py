"""Compare a track with measurements that were withheld from it: their errors, and whether σ is of that size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

from tcpipe.errors import FusionError
from tcpipe.fusion.measurements import GNSS, BodyVelocities, Positions
from tcpipe.fusion.process import SCALE_STD
from tcpipe.fusion.signals import compute_seconds, integrate_signal, is_covered, is_in_gap
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_rpy

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

CHORDS_S = (1.0, 4.0)
"""Durations over which the distance of an odometry is compared [s]: a track states the σ of its displacement over these."""

END_S = 5.0  # at either end of a run the sensor stays this long, to start from and to end at
LEAST_WINDOW_M = 1.0  # a window in which the robot drives less compares a robot that is stationary
_LEAST_MPS = 0.1  # slower chords have no direction
_SCALE_CHORDS = 10  # fewer chords outside the windows give no scale
_NOMINAL = (0.6827, 0.9545)
_FEWEST_WINDOWS = 5  # fewer can share one place or one fault, and decide nothing
_TAIL = 0.025  # of a share's interval, on either side

Calibration = Literal["overconfident", "calibrated", "underconfident", "undecided"]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Withheld measurements less those that the track predicts, one value a second or a chord.

    Attributes
    ----------
    role : the sensor that was withheld.
    window_s, chord_s : length of the windows, and of the chords of an odometry; None for fixes.
    window : number of the window, shape (N,).
    error_m : east and north for fixes, shape (N, 2); along the chord for an odometry, shape (N, 1).
    std_m : σ of the error, both the track's and the sensor's, same shape.
    straight_m : horizontal error of a straight line between the fixes at the window's ends, shape (N,); NaN for an odometry.
    """

    role: str
    window_s: float
    chord_s: float | None
    window: Ints
    error_m: Floats
    std_m: Floats
    straight_m: Floats


@dataclass(frozen=True, slots=True)
class WithheldScore:
    """Errors against a withheld sensor over windows of one length [m], and the share of errors inside the σ that is claimed of them.

    The values of a window share its errors: ``calibration`` counts a window as one observation. It names a share whose exact binomial 95 %
    interval excludes that of the normal distribution; fewer than five windows are ``undecided``. The σ of an odometry is the prior of
    its scale, which is wide: it cannot show that a track is underconfident.
    """

    role: str
    window_s: float
    chord_s: float | None
    windows: int
    compared: int
    median_error_m: float
    p95_error_m: float
    median_std_m: float
    within_1_sigma: float
    within_2_sigma: float
    straight_median_m: float | None
    straight_p95_m: float | None
    calibration: Calibration


def score_comparisons(comparisons: Sequence[Comparison]) -> WithheldScore:
    """Return the score of comparisons of one kind, of one run or of several."""
    first = comparisons[0]
    error_m = np.concatenate([np.linalg.norm(each.error_m, axis=1) for each in comparisons])
    std_m = np.concatenate([np.linalg.norm(each.std_m, axis=1) for each in comparisons])
    normalized = np.concatenate([np.abs(each.error_m / each.std_m) for each in comparisons])
    straight_m = np.concatenate([each.straight_m for each in comparisons])
    windows = sum(len(np.unique(each.window)) for each in comparisons)
    within = (float(np.mean(normalized < 1.0)), float(np.mean(normalized < 2.0)))
    is_fix = first.chord_s is None
    return WithheldScore(
        role=first.role,
        window_s=first.window_s,
        chord_s=first.chord_s,
        windows=windows,
        compared=len(error_m),
        median_error_m=float(np.median(error_m)),
        p95_error_m=float(np.quantile(error_m, 0.95)),
        median_std_m=float(np.median(std_m)),
        within_1_sigma=within[0],
        within_2_sigma=within[1],
        straight_median_m=float(np.median(straight_m)) if is_fix else None,
        straight_p95_m=float(np.quantile(straight_m, 0.95)) if is_fix else None,
        calibration=_judge_coverage(within, windows, is_fix=is_fix),
    )


def _judge_coverage(within: tuple[float, float], windows: int, *, is_fix: bool) -> Calibration:
    if windows < _FEWEST_WINDOWS:
        return "undecided"
    count_1, count_2 = (share * windows for share in within)
    if count_2 < windows and betaincinv(count_2 + 1.0, windows - count_2, 1.0 - _TAIL) < _NOMINAL[1]:
        return "overconfident"
    is_low = is_fix and count_1 > 0.0 and betaincinv(count_1, windows - count_1 + 1.0, _TAIL) > _NOMINAL[0]
    return "underconfident" if is_low else "calibrated"


def place_windows(span_s: float, length_s: float) -> Floats:
    """Return start and end of windows spread evenly over a span [s], shape (N, 2); as much data as a window is long lies between two."""
    inner_s = span_s - 2.0 * END_S
    count = max(int((inner_s + length_s) / (2.0 * length_s)), 0)
    gap_s = (inner_s - count * length_s) / max(count - 1, 1)
    first_s = END_S + (0.5 * gap_s if count == 1 else 0.0)
    starts_s = first_s + np.arange(count) * (length_s + gap_s)
    return np.stack([starts_s, starts_s + length_s], -1)


class TrackRows:
    """The rows of a track's clock epoch, between which it is interpolated: stamps, and columns of the level TRACK by name."""

    def __init__(self, stamp_ns: Ints, columns: Mapping[str, Floats], rate_hz: float) -> None:
        self.stamp_ns, self.columns = stamp_ns, columns
        self._longest_ns = round(1.5e9 / rate_hz)
        """A longer step is a gap."""

    def find(self, stamp_ns: Ints) -> NDArray[np.bool_]:
        """Return whether there is a track at each stamp, shape (N,)."""
        return ~is_in_gap(self.stamp_ns, stamp_ns, stamp_ns, longest_ns=self._longest_ns)

    def interpolate(self, name: str, stamp_ns: Ints, *, is_angle: bool = False) -> Floats:
        """Return a column at stamps [ns], shape (N,)."""
        values = np.unwrap(self.columns[name]) if is_angle else self.columns[name]
        zero_ns = int(self.stamp_ns[0])
        return np.interp(compute_seconds(stamp_ns, zero_ns), compute_seconds(self.stamp_ns, zero_ns), values)

    def measure_length_m(self, start_ns: int, end_ns: int) -> float:
        """Return the horizontal length of the track between two stamps, without gaps."""
        rows = slice(*np.searchsorted(self.stamp_ns, (start_ns, end_ns)))
        steps = np.hypot(np.diff(self.columns["x_m"][rows]), np.diff(self.columns["y_m"][rows]))
        return float(steps[np.diff(self.stamp_ns[rows]) <= self._longest_ns].sum())

    def integrate_forward(self, arm_m: Sequence[float], start_ns: Ints, end_ns: Ints) -> Floats:
        """Return the distance along base_link's x axis of a point of the body between stamps, shape (N,)."""
        velocity = self.columns["forward_velocity_mps"] - arm_m[1] * self.columns["yaw_rate_radps"]
        return integrate_between(self.stamp_ns, velocity, start_ns, end_ns)


def integrate_between(stamp_ns: Ints, values: Floats, start_ns: Ints, end_ns: Ints) -> Floats:
    """Return the integral of a signal [u s], shape (N,), from one stamp to another."""
    zero_ns = int(stamp_ns[0])
    stamp_s = compute_seconds(stamp_ns, zero_ns)
    start, end = (
        integrate_signal(stamp_s, values[:, None], compute_seconds(at_ns, zero_ns))[:, 0]
        for at_ns in (start_ns, end_ns)
    )
    return end - start


def compare_fixes(
    fixes: Positions,
    rows: TrackRows,
    windows_ns: Ints,
    numbers: Ints,
    *,
    arm_m: Floats,
    arm_std_m: Floats,
    window_s: float,
) -> Comparison:
    """Compare one fix a second: those of a second share the error of the track, and much of their own.

    The uncertainty of the arm is part of base_link's σ, not of the antenna's: an error of the arm moves both.
    """
    number = np.searchsorted(windows_ns[:, 0], fixes.stamp_ns) - 1
    start_ns, end_ns = windows_ns[np.maximum(number, 0)].T
    inside = np.flatnonzero(np.isin(number, numbers) & (fixes.stamp_ns < end_ns) & rows.find(fixes.stamp_ns))
    second = (fixes.stamp_ns - start_ns) // 1_000_000_000
    kept = inside[np.unique([number[inside], second[inside]], axis=1, return_index=True)[1]]
    if not kept.size:
        raise FusionError("no fix lies on the track of the rest")
    stamp_ns, places = fixes.stamp_ns[kept], fixes.position_enu_m[:, :2]
    before = np.searchsorted(fixes.stamp_ns, start_ns[kept], "right") - 1
    after = np.searchsorted(fixes.stamp_ns, end_ns[kept])
    share = (stamp_ns - fixes.stamp_ns[before]) / (fixes.stamp_ns[after] - fixes.stamp_ns[before])
    straight_m = np.hypot(*(places[before] + share[:, None] * (places[after] - places[before]) - places[kept]).T)
    rpy = [rows.interpolate(f"{name}_rad", stamp_ns, is_angle=True) for name in ("roll", "pitch", "yaw")]
    rotation = matrix_from_quat(quat_from_rpy(*rpy))[:, :2]
    predicted = np.stack([rows.interpolate(f"{axis}_m", stamp_ns) for axis in "xy"], -1) + rotation @ arm_m
    std = np.stack([rows.interpolate(f"{axis}_std_m", stamp_ns) for axis in "xy"], -1)
    variance = np.maximum(std**2 - rotation**2 @ arm_std_m**2, 0.0)
    return Comparison(
        GNSS, window_s, None, number[kept], places[kept] - predicted,
        np.sqrt(variance + fixes.variance_m2[kept, :2]), straight_m,
    )  # fmt: skip


def compare_chords(
    role: str,
    odometry: BodyVelocities,
    rows: TrackRows,
    windows_ns: Ints,
    numbers: Ints,
    *,
    chord_s: float,
    window_s: float,
) -> Comparison:
    """Compare distances along the odometry's own axis, one chord a second; its scale is that of the rest of the run."""
    chord_ns = round(chord_s * 1e9)
    start_ns = np.arange(int(rows.stamp_ns[0]), int(rows.stamp_ns[-1]) - chord_ns, 1_000_000_000, dtype=np.int64)
    row = np.searchsorted(rows.stamp_ns, start_ns)
    start_ns = rows.stamp_ns[row]
    end_ns = start_ns + chord_ns
    track_m = rows.integrate_forward(odometry.lever_arm_m, start_ns, end_ns)
    sensor_m = integrate_between(odometry.stamp_ns, odometry.velocity_mps[:, 0], start_ns, end_ns)
    std_m = rows.columns[f"displacement_std_{chord_s:.0f}s_m"][row]
    usable = (
        is_covered(odometry.stamp_ns, start_ns, end_ns)
        & np.isfinite(std_m)
        & is_covered(rows.stamp_ns, start_ns, end_ns)
    )
    usable &= np.abs(track_m) > _LEAST_MPS * chord_s
    number = np.searchsorted(windows_ns[:, 0], start_ns, "right") - 1
    window_end_ns = np.where(number < 0, start_ns, windows_ns[np.maximum(number, 0), 1])
    outside = usable & (start_ns >= window_end_ns) & (np.searchsorted(windows_ns[:, 0], end_ns) - 1 == number)
    scale = float(np.median(sensor_m[outside] / track_m[outside])) if outside.sum() >= _SCALE_CHORDS else 1.0
    inside = usable & (end_ns <= window_end_ns) & np.isin(number, numbers)
    error_m = (sensor_m[inside] / scale - track_m[inside])[:, None]
    std_m = np.hypot(std_m[inside], SCALE_STD[role] * track_m[inside])[:, None]
    return Comparison(role, window_s, chord_s, number[inside], error_m, std_m, np.full(len(error_m), np.nan))
