"""Withhold a sensor in windows, fuse the rest, and compare what was withheld with the track: a judgement by data that made no part of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import FusionError
from tcpipe.fusion.measurements import DOPPLER, GNSS, VISUAL, WHEELS, BodyVelocities, Positions
from tcpipe.fusion.process import VISUAL_SCALE_STD, WHEEL_SCALE_STD
from tcpipe.fusion.signals import compute_seconds, integrate_signal, is_covered
from tcpipe.geometry.rotation import quat_from_rpy, rotate
from tcpipe.progress import step
from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse import fuse_run
from tcpipe.stages.fuse_inputs import FusionInputs, convert_pose_to_fixes, find_longest_epoch, prepare_inputs
from tcpipe.tables.arrays import number_column, select_rows
from tcpipe.tables.columns import FloatColumns, to_integers
from tcpipe.tables.levels import Streams, Track

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

WINDOWS_S = (10.0, 30.0, 60.0)
"""Lengths of the windows without a sensor [s]."""
CHORDS_S = (1.0, 4.0)
"""Durations over which the distance of an odometry is compared [s]: a track states the σ of its displacement over these."""

_END_S = 5.0  # at either end of a run the sensor stays this long, to start from and to end at
_LEAST_WINDOW_M = 1.0  # a window in which the robot drives less compares a robot that is stationary
_LEAST_MPS = 0.1  # slower chords have no direction
_SCALE_CHORDS = 10  # fewer chords outside the windows give no scale
_SCALE_STD = {WHEELS: WHEEL_SCALE_STD, VISUAL: VISUAL_SCALE_STD}
_NOMINAL = (0.6827, 0.9545)
_SIGNIFICANT = 2.0  # standard deviations of a share of windows

Calibration = Literal["overconfident", "calibrated", "underconfident"]


@dataclass(frozen=True, slots=True)
class Comparison:
    """What was withheld less what the track predicts, one value a second or a chord.

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

    A window is one observation: ``calibration`` names a share that differs from the normal distribution's beyond 2σ of so many windows.
    The σ of an odometry is the prior of its scale, which is wide: it cannot show that a track is underconfident.
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


@dataclass(frozen=True, slots=True)
class WithheldComparisons:
    """Every comparison of a run; why others are missing; without fixes the track's length over that of each odometry."""

    comparisons: tuple[Comparison, ...]
    skipped: tuple[tuple[str, str], ...]
    """Role and reason."""
    length_ratios: dict[str, float]


def score_comparisons(comparisons: Sequence[Comparison]) -> WithheldScore:
    """Return the score of comparisons of one kind, of one run or of several."""
    first = comparisons[0]
    error_m = np.concatenate([np.linalg.norm(each.error_m, axis=1) for each in comparisons])
    std_m = np.concatenate([np.linalg.norm(each.std_m, axis=1) for each in comparisons])
    normalized = np.concatenate([np.abs(each.error_m / each.std_m) for each in comparisons])
    straight_m = np.concatenate([each.straight_m for each in comparisons])
    windows = sum(len(np.unique(each.window)) for each in comparisons)
    within = (float(np.mean(normalized < 1.0)), float(np.mean(normalized < 2.0)))
    line = (float(np.median(straight_m)), float(np.quantile(straight_m, 0.95))) if first.chord_s is None else None
    return WithheldScore(
        first.role, first.window_s, first.chord_s, windows, len(error_m),
        float(np.median(error_m)), float(np.quantile(error_m, 0.95)), float(np.median(std_m)), *within,
        *(line or (None, None)), _judge_coverage(within, windows, is_fix=line is not None),
    )  # fmt: skip


def _judge_coverage(within: tuple[float, float], windows: int, *, is_fix: bool) -> Calibration:
    spread = [_SIGNIFICANT * float(np.sqrt(share * (1.0 - share) / windows)) for share in _NOMINAL]
    if within[1] < _NOMINAL[1] - spread[1]:
        return "overconfident"
    return "underconfident" if is_fix and within[0] > _NOMINAL[0] + spread[0] else "calibrated"


def place_windows(start_s: float, end_s: float, length_s: float) -> Floats:
    """Return start and end of windows spread evenly over a span [s], shape (N, 2); as much data as a window is long lies between two."""
    span_s = end_s - start_s - 2.0 * _END_S
    count = max(int((span_s + length_s) / (2.0 * length_s)), 0)
    gap_s = (span_s - count * length_s) / max(count - 1, 1)
    first_s = start_s + _END_S + (0.5 * gap_s if count == 1 else 0.0)
    starts_s = first_s + np.arange(count) * (length_s + gap_s)
    return np.stack([starts_s, starts_s + length_s], -1)


def compare_withheld(streams: Streams, config: FuseConfig, *, run_id: str) -> WithheldComparisons:
    """Withhold fixes, wheels and camera in turn in windows of each length, and compare them with the track of the rest.

    All windows of a length are withheld together, so that a sensor and a length cost one fusion.

    Raises
    ------
    FusionError : no sensor measures motion.
    """
    streams, _ = convert_pose_to_fixes(streams)
    inputs = prepare_inputs(streams, config)
    if not inputs.measurements:
        raise FusionError(f"{run_id}: no sensor measures motion")
    epoch = find_longest_epoch(inputs)
    comparisons, skipped = list[Comparison](), list[tuple[str, str]]()
    motion = [role for role in (GNSS, WHEELS, VISUAL) if role in inputs.measurements[epoch].sensors()]
    if len(motion) == 1:
        skipped.append((motion[0], "no other sensor measures motion"))
    for role in motion if len(motion) > 1 else ():
        for length_s in WINDOWS_S:
            try:
                comparisons += _compare_role(role, length_s, epoch, inputs, streams, config, run_id=run_id)
            except FusionError as error:
                skipped.append((role, f"{length_s:.0f} s: {error.problems[0]}"))
    ratios = {} if GNSS in motion else _compare_lengths(fuse_run(streams, config, run_id=run_id), epoch, inputs)
    return WithheldComparisons(tuple(comparisons), tuple(skipped), ratios)


def _compare_role(
    role: str, length_s: float, epoch: int, inputs: FusionInputs, streams: Streams, config: FuseConfig, *, run_id: str
) -> Iterator[Comparison]:
    measurements = inputs.measurements[epoch]
    sensor = measurements.sensors()[role]
    zero_ns = int(sensor.stamp_ns[0])
    last_s = float(compute_seconds(sensor.stamp_ns[-1:], zero_ns)[0])
    windows_s = place_windows(0.0, last_s, length_s)
    if not windows_s.size:
        raise FusionError(f"the sensor covers {last_s:.0f} s, {length_s + 2.0 * _END_S:.0f} s are needed")
    windows_ns = zero_ns + np.round(windows_s * 1e9).astype(np.int64)
    step(f"fusing without {role} for {len(windows_ns)} x {length_s:.0f} s")
    track = fuse_run(withhold(streams, role, epoch, windows_ns), config, run_id=run_id)
    facts = track.info.report.facts
    if role == GNSS and facts.sensor_checks is not None and role in facts.sensor_checks.excluded:
        raise FusionError("tcpipe excludes the other fixes of the run")
    rows = TrackRows(track, epoch)
    moving = np.array([rows.measure_length_m(*window) >= _LEAST_WINDOW_M for window in windows_ns])
    if not moving.any():
        raise FusionError("the rest has no track in the windows, or the robot is stationary there")
    numbers = np.flatnonzero(moving)
    if isinstance(sensor, Positions):
        moved_m = facts.mounting.antenna_moved_m if facts.mounting else None
        arm_m = np.asarray(streams.sensors[GNSS].xyz_m) + (np.zeros(3) if moved_m is None else np.asarray(moved_m))
        yield _compare_fixes(sensor, rows, windows_ns, numbers, arm_m=arm_m, window_s=length_s)
    elif isinstance(sensor, BodyVelocities):
        for chord_s in CHORDS_S:
            found = _compare_chords(role, sensor, rows, windows_ns, numbers, chord_s=chord_s, window_s=length_s)
            if found.window.size:
                yield found


def withhold(streams: Streams, role: str, epoch: int, windows_ns: Ints) -> Streams:
    """Return the streams without a sensor in windows [ns], shape (N, 2), of a clock epoch; a receiver loses its velocity with its fixes."""

    def keep(table: pa.Table) -> pa.Table:
        stamp_ns = to_integers(table, "stamp_ns")
        inside = np.searchsorted(windows_ns[:, 0], stamp_ns, "right") > np.searchsorted(windows_ns[:, 1], stamp_ns)
        return table.filter(number_column(~(inside & (to_integers(table, "clock_epoch") == epoch))))

    without = (GNSS, DOPPLER) if role == GNSS else (role,)
    return replace(
        streams, tables={name: keep(table) if name in without else table for name, table in streams.tables.items()}
    )


class TrackRows:
    """The rows of a track's clock epoch, between which it is interpolated."""

    def __init__(self, track: Track, epoch: int) -> None:
        table = select_rows(track.table, "clock_epoch", epoch)
        self.stamp_ns = to_integers(table, "stamp_ns")
        self.columns = FloatColumns(table)
        self._longest_ns = round(1.5e9 / track.info.rate_hz)
        """A longer step is a gap."""

    def find(self, stamp_ns: Ints) -> NDArray[np.bool_]:
        """Return whether there is a track at each stamp, shape (N,)."""
        after = np.searchsorted(self.stamp_ns, stamp_ns)
        inside = (after > 0) & (after < self.stamp_ns.size)
        after = np.clip(after, 1, max(self.stamp_ns.size - 1, 1))
        if self.stamp_ns.size < 2:  # noqa: PLR2004  nothing to interpolate
            return np.zeros(stamp_ns.size, np.bool_)
        found: NDArray[np.bool_] = inside & (self.stamp_ns[after] - self.stamp_ns[after - 1] <= self._longest_ns)
        return found

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
        return _integrate(self.stamp_ns, velocity, start_ns, end_ns)


def _integrate(stamp_ns: Ints, values: Floats, start_ns: Ints, end_ns: Ints) -> Floats:
    zero_ns = int(stamp_ns[0])
    stamp_s = compute_seconds(stamp_ns, zero_ns)
    start, end = (
        integrate_signal(stamp_s, values[:, None], compute_seconds(at_ns, zero_ns))[:, 0] for at_ns in (start_ns, end_ns)
    )
    return end - start


def _compare_fixes(
    fixes: Positions, rows: TrackRows, windows_ns: Ints, numbers: Ints, *, arm_m: Floats, window_s: float
) -> Comparison:
    """Compare one fix a second: those of a second share the error of the track, and much of their own."""
    chosen, window, straight = [], [], []
    for number in numbers.tolist():
        start_ns, end_ns = windows_ns[number].tolist()
        inside = np.flatnonzero((fixes.stamp_ns > start_ns) & (fixes.stamp_ns < end_ns))
        inside = inside[rows.find(fixes.stamp_ns[inside])]
        second = (fixes.stamp_ns[inside] - start_ns) // 1_000_000_000
        inside = inside[np.unique(second, return_index=True)[1]]
        ends = [np.searchsorted(fixes.stamp_ns, start_ns, "right") - 1, np.searchsorted(fixes.stamp_ns, end_ns)]
        at_s, ends_s = (compute_seconds(fixes.stamp_ns[of], start_ns) for of in (inside, ends))
        line = [np.interp(at_s, ends_s, fixes.position_enu_m[ends, axis]) for axis in (0, 1)]
        straight.append(np.hypot(*(np.stack(line) - fixes.position_enu_m[inside, :2].T)))
        chosen.append(inside)
        window.append(np.full(inside.size, number))
    kept, stamp_ns = np.concatenate(chosen), fixes.stamp_ns[np.concatenate(chosen)]
    if not kept.size:
        raise FusionError("no fix lies on the track of the rest")
    rpy = [rows.interpolate(f"{name}_rad", stamp_ns, is_angle=True) for name in ("roll", "pitch", "yaw")]
    arm = rotate(quat_from_rpy(*rpy), np.tile(arm_m, (kept.size, 1)))[:, :2]
    predicted = np.stack([rows.interpolate(f"{axis}_m", stamp_ns) for axis in "xy"], -1) + arm
    std = np.stack([rows.interpolate(f"{axis}_std_m", stamp_ns) for axis in "xy"], -1)
    return Comparison(
        GNSS, window_s, None, np.concatenate(window), fixes.position_enu_m[kept, :2] - predicted,
        np.sqrt(std**2 + fixes.variance_m2[kept, :2]), np.concatenate(straight),
    )  # fmt: skip


def _compare_chords(
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
    start_ns = np.arange(rows.stamp_ns[0], rows.stamp_ns[-1] - chord_ns, 1_000_000_000, np.int64)
    row = np.searchsorted(rows.stamp_ns, start_ns)
    start_ns = rows.stamp_ns[row]
    end_ns = start_ns + chord_ns
    track_m = rows.integrate_forward(odometry.lever_arm_m, start_ns, end_ns)
    sensor_m = _integrate(odometry.stamp_ns, odometry.velocity_mps[:, 0], start_ns, end_ns)
    std_m = rows.columns[f"displacement_std_{chord_s:.0f}s_m"][row]
    usable = is_covered(odometry.stamp_ns, start_ns, end_ns) & np.isfinite(std_m) & is_covered(rows.stamp_ns, start_ns, end_ns)
    usable &= np.abs(track_m) > _LEAST_MPS * chord_s
    number = np.searchsorted(windows_ns[:, 0], start_ns, "right") - 1
    before_end = end_ns <= windows_ns[np.maximum(number, 0), 1]
    outside = usable & ((number < 0) | (start_ns >= windows_ns[np.maximum(number, 0), 1]))
    scale = float(np.median(sensor_m[outside] / track_m[outside])) if outside.sum() >= _SCALE_CHORDS else 1.0
    inside = usable & (number >= 0) & before_end & np.isin(number, numbers)
    error_m = (sensor_m[inside] / scale - track_m[inside])[:, None]
    std_m = np.hypot(std_m[inside], _SCALE_STD[role] * track_m[inside])[:, None]
    return Comparison(role, window_s, chord_s, number[inside], error_m, std_m, np.full(len(error_m), np.nan))


def _compare_lengths(track: Track, epoch: int, inputs: FusionInputs) -> dict[str, float]:
    """Return the horizontal length of the track over the distance that each odometry measures, by role; turns in place count for neither."""
    rows = TrackRows(track, epoch)
    if rows.stamp_ns.size == 0:
        return {}
    length_m = rows.measure_length_m(int(rows.stamp_ns[0]), int(rows.stamp_ns[-1]) + 1)
    ratios = {}
    for role, odometry in inputs.measurements[epoch].odometries().items():
        speed = np.abs(odometry.velocity_mps[:, 0])
        odometer_m = float(_integrate(odometry.stamp_ns, speed, rows.stamp_ns[:1], rows.stamp_ns[-1:])[0])
        if odometer_m > _LEAST_WINDOW_M:
            ratios[role] = length_m / odometer_m
    return ratios
