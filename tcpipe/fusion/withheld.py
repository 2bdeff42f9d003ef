"""Compare a track with fixes that were withheld from it: their errors, and whether σ is of that size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

from tcpipe.arrays import Floats, Ints
from tcpipe.errors import FusionError
from tcpipe.fusion.measurements import Positions
from tcpipe.fusion.signals import compute_seconds, is_in_gap
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_rpy

END_S = 5.0
"""Time at either end of a run in which fixes stay [s]: the track starts from them and ends at them."""
LEAST_WINDOW_M = 1.0
"""Least distance of a window [m]: in a shorter one the robot is stationary."""

Calibration = Literal["overconfident", "calibrated", "underconfident", "undecided"]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Withheld fixes less the antenna that the track predicts, one a second.

    Attributes
    ----------
    window_s : length of the windows.
    window : number of the window, shape (N,).
    error_m, std_m : east and north, and its σ, both the track's and the fix's, shape (N, 2).
    """

    window_s: float
    window: Ints
    error_m: Floats
    std_m: Floats


@dataclass(frozen=True, slots=True)
class WithheldScore:
    """Errors against withheld fixes over windows of one length [m], and the share of errors within the claimed σ.

    The values of a window share its errors: ``calibration`` counts a window as one observation. It names a share whose
    exact binomial 95 % interval excludes that of the normal distribution; fewer than five windows are ``undecided``.
    """

    window_s: float
    windows: int
    compared: int
    median_error_m: float
    p95_error_m: float
    median_std_m: float
    within_1_sigma: float
    within_2_sigma: float
    calibration: Calibration


def score_comparisons(comparisons: Sequence[Comparison]) -> WithheldScore:
    """Return the score of comparisons of one length, of one run or of several."""
    error_m, std_m = (np.concatenate([getattr(each, name) for each in comparisons]) for name in ("error_m", "std_m"))
    normalized, sizes_m = np.abs(error_m / std_m), np.linalg.norm(error_m, axis=1)
    windows = sum(len(np.unique(each.window)) for each in comparisons)
    within = (float(np.mean(normalized < 1.0)), float(np.mean(normalized < 2.0)))
    return WithheldScore(
        window_s=comparisons[0].window_s,
        windows=windows,
        compared=len(error_m),
        median_error_m=float(np.median(sizes_m)),
        p95_error_m=float(np.quantile(sizes_m, 0.95)),
        median_std_m=float(np.median(np.linalg.norm(std_m, axis=1))),
        within_1_sigma=within[0],
        within_2_sigma=within[1],
        calibration=_judge_coverage(within, windows),
    )


def _judge_coverage(within: tuple[float, float], windows: int) -> Calibration:
    """Compare the shares inside 1σ and 2σ with a normal distribution's; few windows can share one place or fault."""
    if windows < 5:
        return "undecided"
    count_1, count_2 = (share * windows for share in within)
    if count_2 < windows and betaincinv(count_2 + 1.0, windows - count_2, 0.975) < 0.9545:
        return "overconfident"
    is_low = count_1 > 0.0 and betaincinv(count_1, windows - count_1 + 1.0, 0.025) > 0.6827
    return "underconfident" if is_low else "calibrated"


def place_windows(span_s: float, length_s: float) -> Floats:
    """Return start and end of even windows of a span [s], shape (N, 2), with a window's length between them."""
    inner_s = span_s - 2.0 * END_S
    count = max(int((inner_s + length_s) / (2.0 * length_s)), 0)
    gap_s = (inner_s - count * length_s) / max(count - 1, 1)
    first_s = END_S + (0.5 * gap_s if count == 1 else 0.0)
    starts_s = first_s + np.arange(count) * (length_s + gap_s)
    return np.stack([starts_s, starts_s + length_s], -1)


class TrackRows:
    """The rows of a track's clock epoch, for interpolation: stamps, and columns of the level TRACK by name."""

    def __init__(self, stamp_ns: Ints, columns: Mapping[str, Floats], rate_hz: float) -> None:
        self.stamp_ns, self.columns = stamp_ns, columns
        self._longest_ns = round(1.5e9 / rate_hz)
        """A longer step is a gap."""

    def find(self, stamp_ns: Ints) -> NDArray[np.bool_]:
        """Return whether there is a track at each stamp, shape (N,)."""
        return ~is_in_gap(self.stamp_ns, stamp_ns, stamp_ns, longest_ns=self._longest_ns)

    def interpolate(self, name: str, stamp_ns: Ints) -> Floats:
        """Return a column at stamps [ns], shape (N,); an angle is continuous."""
        values = np.unwrap(self.columns[name]) if name.endswith("_rad") else self.columns[name]
        zero_ns = int(self.stamp_ns[0])
        return np.interp(compute_seconds(stamp_ns, zero_ns), compute_seconds(self.stamp_ns, zero_ns), values)

    def measure_length_m(self, start_ns: int, end_ns: int) -> float:
        """Return the horizontal length of the track between two stamps, without gaps."""
        rows = slice(*np.searchsorted(self.stamp_ns, (start_ns, end_ns)))
        steps = np.hypot(np.diff(self.columns["x_m"][rows]), np.diff(self.columns["y_m"][rows]))
        return float(steps[np.diff(self.stamp_ns[rows]) <= self._longest_ns].sum())


def compare_fixes(
    fixes: Positions, rows: TrackRows, windows_ns: Ints, numbers: Ints, *, arm_m: Floats, arm_std_m: Floats
) -> Comparison:
    """Compare one fix a second of some windows: those of a second share the error of the track, and much of their own.

    The uncertainty of the arm is part of base_link's σ, not of the antenna's: an error of the arm moves both.
    """
    number = np.searchsorted(windows_ns[:, 0], fixes.stamp_ns) - 1
    start_ns, end_ns = windows_ns[np.maximum(number, 0)].T
    inside = np.flatnonzero(np.isin(number, numbers) & (fixes.stamp_ns < end_ns) & rows.find(fixes.stamp_ns))
    second = (fixes.stamp_ns - start_ns) // 1_000_000_000
    kept = inside[np.unique([number[inside], second[inside]], axis=1, return_index=True)[1]]
    if not kept.size:
        raise FusionError("no fix lies on the track of the rest")
    stamp_ns = fixes.stamp_ns[kept]
    rpy = [rows.interpolate(f"{name}_rad", stamp_ns) for name in ("roll", "pitch", "yaw")]
    rotation = matrix_from_quat(quat_from_rpy(*rpy))[:, :2]
    predicted = np.stack([rows.interpolate(f"{axis}_m", stamp_ns) for axis in "xy"], -1) + rotation @ arm_m
    std = np.stack([rows.interpolate(f"{axis}_std_m", stamp_ns) for axis in "xy"], -1)
    variance = np.maximum(std**2 - rotation**2 @ arm_std_m**2, 0.0) + fixes.variance_m2[kept, :2]
    window_s = float(windows_ns[0, 1] - windows_ns[0, 0]) * 1e-9
    return Comparison(window_s, number[kept], fixes.position_enu_m[kept, :2] - predicted, np.sqrt(variance))
