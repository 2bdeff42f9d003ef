"""Compare the track with each sensor that fed it, in windows, before its standard deviations are used.

Each comparison is the sensor's motion in a window less the track's, with the uncertainty that both claim.

============ ============================================ =====================================================
what         the sensor's                                 the track's
============ ============================================ =====================================================
position     median position of the fixes, east and north antenna at their stamps
displacement median of its later fixes less the earlier   the same of the antenna
displacement integral of an odometry's velocity           distance along its own axes (wheels: forward only)
displacement integral of the receiver's own velocity      the same of the antenna
turn         integral of a rate about the vertical axis   change of attitude about it
============ ============================================ =====================================================

A claimed error lasts through the window: the standard deviation of fixes is not divided by the root of their number, an odometry may be
off by its scale and a little velocity throughout, a gyroscope by the wander of its bias. What is constant over the run and observable by
other sensors is no disagreement: the scale of an odometry where fixes show it, the bias of a rate. A window disagrees where the squared
difference over both variances exceeds the χ² bound that one window in a hundred runs would exceed by chance. A sensor is alone where two
others of the same quantity agree with each other and exclude it: the track is kept. So it is with fixes that are further off than an
antenna could be, where two other sensors agree with the track. Otherwise the track's standard deviations are inflated there by the size
of the disagreement.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import DOPPLER, GNSS, IMU, VISUAL, WHEELS, BodyVelocities, Measurements, Positions
from tcpipe.fusion.process import DOPPLER_LASTS_S, VISUAL_SCALE_STD, WHEEL_SCALE_STD
from tcpipe.fusion.signals import (
    compute_interval_means,
    compute_median_period_ns,
    compute_seconds,
    find_chi_square_threshold,
    is_in_gap,
)
from tcpipe.fusion.trajectory import DISPLACEMENT_LAGS_S, Trajectory
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_matrix, rotation_vector_from_quat
from tcpipe.robust import MEDIAN_OF_SQUARES
from tcpipe.tables.facts import Disagreement

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
What = Literal["position", "displacement", "turn"]

UNITS: Mapping[str, str] = {"position": "m", "displacement": "m", "turn": "rad"}

_WINDOW_S = 5.0  # about four chords; longer than odometry's gate
_CHANCE = 0.01  # chance of a false window in a hundred runs
_FEWEST_FIXES = 5  # for a robust median
_MAX_GAP_NS = 500_000_000
_MOVES_M = 0.5  # distance in a window with motion
_STANDS_MPS = 0.1  # slower is stationary; faster wheels are stuck
_MOSTLY = 0.5  # share that counts as most
_LITTLE = 0.1  # share that agreeing sensors may disagree
_NO_ARM_M = 1.0  # no lever arm is off by more
_FEWEST_WINDOWS = 4  # fewer say nothing about a run
_SCALES = (0.5, 2.0)
_ASTRAY_M = 1.0  # a larger difference in 5 s is divergence
_SURELY = 4.0  # and by this many σ of the sensor
_LASTING_MPS = 0.02  # lasting odometry error (`preparation._VELOCITY_FLOOR_MPS`)
_SCALE_STD = {WHEELS: WHEEL_SCALE_STD, VISUAL: VISUAL_SCALE_STD}
_TURN_SCALE_STD = {WHEELS: 0.3, VISUAL: 0.03, IMU: 0.01}
_LASTING_RADPS = {WHEELS: 0.02, VISUAL: 0.004, IMU: 0.003}


@dataclass(frozen=True, slots=True)
class Comparison:
    """One sensor against the track, in W windows.

    Attributes
    ----------
    sensor, what : its role, and what is compared.
    difference : [m] or [rad], shape (W, k), the sensor's less the track's; NaN where the sensor does not tell. Displacements are along and
        aside of the body in the middle of the window, positions east and north.
    std : shape (W,), what the sensor claims, of each component.
    track_std : shape (W,), what the track claims.
    """

    sensor: str
    what: What
    difference: Floats
    std: Floats
    track_std: Floats

    @property
    def told(self) -> Mask:
        """Where the sensor has a value, shape (W,)."""
        return np.asarray(np.isfinite(self.difference).all(1))

    @property
    def size(self) -> Floats:
        """Length of the difference, shape (W,); 0 where it is unknown."""
        return np.where(self.told, np.linalg.norm(self.difference, axis=1), 0.0)

    @property
    def disagrees(self) -> Mask:
        """Where the difference is beyond what both claim, shape (W,)."""
        return np.asarray(self.size > self._bound * np.hypot(self.std, self.track_std))

    def excludes(self, other: Comparison) -> Mask:
        """Where both cannot be right, by what they have in common, shape (W,)."""
        common = min(self.difference.shape[1], other.difference.shape[1])
        apart = np.linalg.norm(self.difference[:, :common] - other.difference[:, :common], axis=1)
        return np.asarray(self.told & other.told & (apart > self._bound * np.hypot(self.std, other.std)))

    @property
    def _bound(self) -> float:
        windows = max(1, int(self.told.sum()))
        return float(np.sqrt(find_chi_square_threshold(self.difference.shape[1], 1.0 - _CHANCE / windows)))


@dataclass(frozen=True, slots=True)
class Tally:
    """Number of windows of motion in which a sensor has a value, disagrees with the track undecided, and is alone."""

    sensor: str
    what: What
    moving: int
    undecided: int
    alone: int


@dataclass(frozen=True, slots=True)
class Audit:
    """The audit of one section: disagreements in order of time, and over how much of the distance each sensor disagrees.

    In ``windows`` a sensor measures the robot's distance; in those ``astray`` the track's is far from that of every such sensor.
    """

    disagreements: tuple[Disagreement, ...]
    tallies: tuple[Tally, ...]
    windows: int = 0
    astray: int = 0


def audit_trajectory(found: Trajectory, measurements: Measurements) -> tuple[Trajectory, Audit]:
    """Return the trajectory of one section with standard deviations inflated where sensors disagree with it, and what was found."""
    windows = _find_windows(found.stamp_ns)
    if not windows.size:
        return found, Audit((), ())
    compared = list(_iterate_comparisons(found, measurements, windows))
    alone = {id(one): _find_isolated(one, compared) for one in compared}
    moving = _find_moving_rows(found, windows)
    tallies = tuple(
        Tally(
            one.sensor,
            one.what,
            int((one.told & moving).sum()),
            int((one.disagrees & ~alone[id(one)] & moving).sum()),
            int((alone[id(one)] & moving).sum()),
        )
        for one in compared
    )
    told = [each for one in compared for each in _find_disagreements(one, alone[id(one)], found.stamp_ns, windows)]
    way_m = _compute_distance_error_m(compared, _compare_all_fixes(found, measurements.gnss, windows), windows.shape[0])
    for what in UNITS:
        same = [(one.size, one.disagrees & ~alone[id(one)]) for one in compared if one.what == what]
        same += [(way_m, way_m > 0.0)] if what == "displacement" else []
        found = _inflate_trajectory(found, what, _find_largest_differences(same, windows, found.stamp_ns.size))
    return found, Audit(
        tuple(sorted(told, key=lambda each: each.start_ns)),
        tallies,
        int(np.isfinite(way_m).sum()),
        int((way_m > 0.0).sum()),
    )


def is_astray(windows: int, astray: int) -> bool:
    """Return whether the track contradicts every sensor in more than a few of the windows in which one measures the distance."""
    return astray > max(1.0, _LITTLE * windows)


def find_undecided_sensors(tallies: Iterable[Tally]) -> tuple[tuple[str, What], ...]:
    """Return the sensors and quantities that contradict the track over most of the distance, where no third sensor decides.

    A position that is off while ways and turns agree is known to be off by how much, and stands in the deviations.
    """
    return tuple(
        (t.sensor, t.what)
        for t in _sum_tallies(tallies)
        if t.what != "position" and _is_most(t.undecided + t.alone, t.moving) and not _is_most(t.alone, t.moving)
    )


def _is_most(windows: int, moving: int) -> bool:
    return moving >= _FEWEST_WINDOWS and windows > _MOSTLY * moving


def _sum_tallies(tallies: Iterable[Tally]) -> list[Tally]:
    """Return the tallies of all sections, one by sensor and thing."""
    total: dict[tuple[str, What], Tally] = {}
    for each in tallies:
        had = total.get((each.sensor, each.what), Tally(each.sensor, each.what, 0, 0, 0))
        total[each.sensor, each.what] = replace(
            had, moving=had.moving + each.moving, undecided=had.undecided + each.undecided, alone=had.alone + each.alone
        )
    return list(total.values())


def _find_windows(stamp_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return first and last row of each window, shape (W, 2): each begins in the middle of the one before; none bridges a hole."""
    if stamp_ns.size < 2:
        return np.empty((0, 2), np.int64)
    rows = max(2, round(_WINDOW_S * 1e9 / compute_median_period_ns(stamp_ns)))
    first = np.arange(0, stamp_ns.size - rows, max(1, rows // 2), dtype=np.int64)
    length_s = (stamp_ns[first + rows] - stamp_ns[first]) * 1e-9
    first = first[length_s < 1.1 * _WINDOW_S]
    return np.column_stack((first, first + rows))


def _find_moving_rows(found: Trajectory, windows: NDArray[np.int64]) -> Mask:
    way_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(found.position_enu_m[:, :2], axis=0).T))))
    moving: Mask = way_m[windows[:, 1]] - way_m[windows[:, 0]] > _MOVES_M
    return moving


def _iterate_comparisons(found: Trajectory, m: Measurements, windows: NDArray[np.int64]) -> Iterable[Comparison]:
    """Yield every comparison that the sensors allow."""
    zero = int(found.stamp_ns[0])
    at_s = compute_seconds(found.stamp_ns, zero)
    step_s = np.diff(at_s)[:, None]
    rotation = matrix_from_quat(found.quat_xyzw)
    turned = rotation_vector_from_quat(quat_from_matrix(np.einsum("kji,kjl->kil", rotation[:-1], rotation[1:])))
    way = np.einsum("kji,kj->ki", rotation[:-1] + rotation[1:], np.diff(found.position_enu_m, axis=0)) / 2.0
    turn_std, way_std = found.yaw_std_rad[windows[:, 0]], _compute_distance_std_m(found)[windows[:, 0]]

    def means(stamp_ns: NDArray[np.int64], values: Floats) -> Floats:
        told = compute_interval_means(compute_seconds(stamp_ns, zero), values, at_s[:-1], at_s[1:])
        longest_ns = max(_MAX_GAP_NS, 3 * compute_median_period_ns(stamp_ns))
        told[is_in_gap(stamp_ns, found.stamp_ns[:-1], found.stamp_ns[1:], longest_ns=longest_ns)] = np.nan
        return told

    if m.gnss is not None:
        yield from _compare_fixes(found, rotation, m.gnss, windows, way_std)
    if m.gnss is not None and m.doppler is not None:
        said = means(m.doppler.stamp_ns, m.doppler.velocity_enu_mps[:, :2]) * step_s
        antenna = (found.position_enu_m + rotation @ np.asarray(m.gnss.lever_arm_m))[:, :2]
        moved = _sum_increments(said - np.diff(antenna, axis=0), windows)
        variance = float(np.median(m.doppler.variance_m2ps2[:, :2]))
        std = np.hypot(_LASTING_MPS * _WINDOW_S, np.sqrt(variance * DOPPLER_LASTS_S * _WINDOW_S))
        difference = _split_along_and_aside(moved, rotation[windows.sum(1) // 2])
        yield Comparison(DOPPLER, "displacement", difference, np.full(way_std.size, std), way_std)
    if m.imu is not None:
        rate = means(m.imu.stamp_ns, m.imu.angular_velocity_radps[:, 2:]) * step_s
        noise = m.imu.gyro_std_radps * np.sqrt(compute_median_period_ns(m.imu.stamp_ns) * 1e-9)
        yield _turn(IMU, _sum_increments(rate, windows), _sum_increments(turned[:, 2:], windows), noise, turn_std)
    for role, source in m.odometries().items():
        axes = slice(0, 2 if source.measured[1] else 1)
        point = way + np.cross(turned, source.lever_arm_m)
        said = means(source.stamp_ns, source.velocity_mps[:, axes]) * step_s
        if role == WHEELS:  # that turn while the robot stands: it is stuck, and they are right
            said[(np.abs(point[:, :1]) < _STANDS_MPS * step_s) & (np.abs(said) > _STANDS_MPS * step_s)] = np.nan
        yield _compare_distances(
            role,
            _sum_increments(said, windows),
            _sum_increments(point[:, axes], windows),
            _compute_noise_density(source.variance_m2ps2[:, 0], source),
            way_std,
            scale_seen=m.gnss is not None,
        )
        known = np.asarray(np.isfinite(source.yaw_rate_radps))
        skids = role == WHEELS and m.imu is not None  # their turn is not what fed the track
        if known.sum() > 1 and not skids:
            rate = means(source.stamp_ns[known], source.yaw_rate_radps[known, None]) * step_s
            noise = _compute_noise_density(source.yaw_rate_var[known], source)
            yield _turn(role, _sum_increments(rate, windows), _sum_increments(turned[:, 2:], windows), noise, turn_std)


def _compute_noise_density(variance: Floats, source: BodyVelocities) -> float:
    """Return the root of the density of a velocity's white noise."""
    return float(np.sqrt(np.median(variance) * compute_median_period_ns(source.stamp_ns) * 1e-9))


def _sum_increments(values: Floats, windows: NDArray[np.int64]) -> Floats:
    """Return the sum of (N - 1, k) increments over each window, shape (W, k); NaN where one is unknown."""
    known = np.asarray(np.isfinite(values).all(1))
    total = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(np.where(known[:, None], values, 0.0), axis=0)))
    lost = np.concatenate(([0], np.cumsum(~known)))
    first, last = windows.T
    whole = lost[last] == lost[first]
    return np.where(whole[:, None], total[last] - total[first], np.nan)


def _compute_distance_std_m(found: Trajectory) -> Floats:
    """Return the track's uncertainty of its displacement over a window [m], shape (N,): that of the longest lag, extended."""
    last_s = DISPLACEMENT_LAGS_S[-1]
    told = found.displacement_std_m[:, -1] * _WINDOW_S / last_s
    return np.where(np.isfinite(told), told, found.forward_velocity_std_mps * _WINDOW_S)


def _compare_distances(
    role: str, said: Floats, track: Floats, noise: float, track_std: Floats, *, scale_seen: bool
) -> Comparison:
    """Return the displacement by an odometry in each window; its scale is removed where fixes show it."""
    if scale_seen:
        said = said / _scale(said[:, 0], track[:, 0])
    length_m = np.linalg.norm(track, axis=1)
    lasting = np.hypot(_SCALE_STD[role] * length_m, _LASTING_MPS * _WINDOW_S)
    return Comparison(role, "displacement", said - track, np.hypot(lasting, noise * np.sqrt(_WINDOW_S)), track_std)


def _scale(said: Floats, track: Floats) -> float:
    """Return how many times as far as the track an odometry goes, over all; 1 where it hardly goes."""
    far = np.isfinite(said) & (np.abs(track) > _MOVES_M)
    return float(np.clip(np.median(said[far] / track[far]), *_SCALES)) if far.sum() >= _FEWEST_WINDOWS else 1.0


def _turn(role: str, said: Floats, track: Floats, noise: float, track_std: Floats) -> Comparison:
    """Return what a rate says of the turn in each window; its bias, constant over the run, is taken out."""
    difference = said - track
    known = np.isfinite(difference[:, 0])
    bias = np.median(difference[known]) if known.sum() >= _FEWEST_WINDOWS else 0.0
    lasting = np.hypot(_TURN_SCALE_STD[role] * np.abs(track[:, 0]), _LASTING_RADPS[role] * _WINDOW_S)
    return Comparison(role, "turn", difference - bias, np.hypot(lasting, noise * np.sqrt(_WINDOW_S)), track_std)


def _compare_fixes(
    found: Trajectory, rotation: Floats, gnss: Positions, windows: NDArray[np.int64], way_std: Floats
) -> Iterable[Comparison]:
    """Yield where the fixes are, and how those that the gate took move along and aside, against the antenna on the track."""
    inside, off = _find_fix_residuals(found, rotation, gnss)
    stamp_ns, zero = gnss.stamp_ns[inside], int(found.stamp_ns[0])
    fix_s, at_s = compute_seconds(stamp_ns, zero), compute_seconds(found.stamp_ns, zero)
    claim = np.sqrt(gnss.variance_m2[inside, :2].mean(1))
    begin, end = at_s[windows].T
    more_s = max(0.0, _FEWEST_FIXES * 1e-9 * compute_median_period_ns(stamp_ns) - _WINDOW_S) / 2.0
    place, std = _compute_medians(fix_s, off, claim, begin - more_s, end + more_s)
    place_std = found.position_std_m[windows[:, 0], :2].max(1)
    yield Comparison(GNSS, "position", place, std, place_std)
    refused = found.rejections.stamp_ns[found.rejections.role == GNSS]
    fed = ~np.isin(stamp_ns, refused)
    moved = _compare_fix_displacements(fix_s[fed], off[fed], claim[fed], begin, end)
    difference = _split_along_and_aside(moved.difference, rotation[windows.sum(1) // 2])
    yield replace(moved, difference=difference, track_std=way_std)


def _find_fix_residuals(found: Trajectory, rotation: Floats, gnss: Positions) -> tuple[Mask, Floats]:
    """Return which fixes lie inside the track's time, and how far those are off its antenna, east and north [m], shape (F, 2)."""
    inside = (gnss.stamp_ns >= found.stamp_ns[0]) & (gnss.stamp_ns <= found.stamp_ns[-1])
    antenna = (found.position_enu_m + rotation @ np.asarray(gnss.lever_arm_m))[:, :2]
    zero = int(found.stamp_ns[0])
    fix_s, at_s = compute_seconds(gnss.stamp_ns[inside], zero), compute_seconds(found.stamp_ns, zero)
    return inside, gnss.position_enu_m[inside, :2] - np.column_stack(
        [np.interp(fix_s, at_s, axis) for axis in antenna.T]
    )


def _compare_fix_displacements(
    fix_s: Floats, off_m: Floats, claim_m: Floats, begin_s: Floats, end_s: Floats
) -> Comparison:
    """Return by how much fixes move otherwise than the track in each window, east and north: the later half against the earlier."""
    middle_s = (begin_s + end_s) / 2.0
    (first, first_std), (last, last_std) = (
        _compute_medians(fix_s, off_m, claim_m, *half) for half in ((begin_s, middle_s), (middle_s, end_s))
    )
    claimed = 2.0 * np.hypot(first_std, last_std)
    return Comparison(GNSS, "displacement", 2.0 * (last - first), claimed, np.zeros_like(claimed))


def _split_along_and_aside(moved: Floats, rotation: Floats) -> Floats:
    """Return horizontal displacements (W, 2) along and aside of bodies whose attitudes are (W, 3, 3)."""
    ahead = rotation[:, :2, 0] / np.linalg.norm(rotation[:, :2, 0], axis=1, keepdims=True)
    aside = moved[:, 1] * ahead[:, 0] - moved[:, 0] * ahead[:, 1]
    return np.column_stack((np.sum(moved * ahead, axis=1), aside))


def _compute_medians(
    at_s: Floats, values: Floats, claim: Floats, begin_s: Floats, end_s: Floats
) -> tuple[Floats, Floats]:
    """Return the medians of values (N, 2) and of claims between times, shapes (W, 2) and (W,); NaN and 0 where there are none."""
    found = np.full((begin_s.size, 3), np.nan)
    both = np.column_stack((values, claim))
    bounds = zip(np.searchsorted(at_s, begin_s, "left"), np.searchsorted(at_s, end_s, "right"), strict=True)
    for window, (first, last) in enumerate(bounds):
        if last > first:
            found[window] = np.median(both[first:last], axis=0)
    return found[:, :2], np.nan_to_num(found[:, 2])


def _find_isolated(one: Comparison, compared: Sequence[Comparison]) -> Mask:
    """Return where two others contradict one, and not each other, shape (W,)."""
    if one.what == "position":
        return one.disagrees & (one.size > _NO_ARM_M) & (_count_agreeing(compared) >= 2)
    against = [(each, one.excludes(each)) for each in compared if each.what == one.what and each is not one]
    alone = np.zeros(one.told.size, np.bool_)
    for (a, by_a), (b, by_b) in combinations(against, 2):
        alone |= by_a & by_b & ~a.excludes(b)
    return alone


def _count_agreeing(compared: Sequence[Comparison]) -> NDArray[np.int64]:
    """Return how many sensors besides the fixes agree with the track in every quantity, shape (W,)."""
    others = {each.sensor: [c for c in compared if c.sensor == each.sensor] for each in compared if each.sensor != GNSS}
    holds = [np.all([c.told & ~c.disagrees for c in told], axis=0) for told in others.values()]
    return np.sum(holds, axis=0) if holds else np.zeros(1, np.int64)


def _find_disagreements(
    one: Comparison, alone: Mask, stamp_ns: NDArray[np.int64], windows: NDArray[np.int64]
) -> Iterable[Disagreement]:
    """Yield a disagreement for every row of windows that overlap."""
    for kind in (False, True):
        rows = np.flatnonzero(one.disagrees & (alone == kind))
        breaks = np.flatnonzero(windows[rows[1:], 0] > windows[rows[:-1], 1]) + 1
        for run in np.split(rows, breaks) if rows.size else ():
            worst = int(run[np.argmax(one.size[run])])
            yield Disagreement(
                start_ns=int(stamp_ns[windows[run[0], 0]]),
                end_ns=int(stamp_ns[windows[run[-1], 1]]),
                sensor=one.sensor,
                what=one.what,
                size=float(one.size[worst]),
                unit=UNITS[one.what],
                expected_std=float(np.hypot(one.std[worst], one.track_std[worst])),
                alone=kind,
            )


def _compute_distance_error_m(compared: Sequence[Comparison], fixes: Iterable[Comparison], windows: int) -> Floats:
    """Return how far the track's distance in each window is off that of every sensor [m], shape (W,); 0 where one agrees, NaN without any.

    The track's uncertainty and its outlier gate do not count: an estimate that has lost the robot rejects what is right.
    """
    ways = [one for one in compared if one.what == "displacement" and one.sensor != GNSS]
    off_m = np.full(windows, np.nan)
    for one in (*ways, *fixes):
        off = np.where(one.size > np.maximum(_ASTRAY_M, _SURELY * one.std), one.size, 0.0)
        off_m = np.where(one.told, np.fmin(off_m, off), off_m)
    return off_m


def _compare_all_fixes(found: Trajectory, gnss: Positions | None, windows: NDArray[np.int64]) -> Iterable[Comparison]:
    """Yield the displacement of all fixes, rejected or not, and of the antenna on the track; their scatter counts where they claim less."""
    if gnss is None:
        return
    inside, off = _find_fix_residuals(found, matrix_from_quat(found.quat_xyzw), gnss)
    zero = int(found.stamp_ns[0])
    begin, end = compute_seconds(found.stamp_ns, zero)[windows].T
    second = np.diff(gnss.position_enu_m[inside, :2], n=2, axis=0)
    scatter = np.sqrt(np.median(second**2) / (6 * MEDIAN_OF_SQUARES)) if second.size else 0.0
    claim = np.maximum(np.sqrt(gnss.variance_m2[inside, :2].mean(1)), scatter)
    yield _compare_fix_displacements(compute_seconds(gnss.stamp_ns[inside], zero), off, claim, begin, end)


def _find_largest_differences(disputed: Iterable[tuple[Floats, Mask]], windows: NDArray[np.int64], rows: int) -> Floats:
    """Return the largest difference by any sensor at each of the track's rows, in the windows that are disputed; 0 elsewhere."""
    size = np.zeros(rows)
    for off, where in disputed:
        for (first, last), of_window in zip(windows[where].tolist(), off[where].tolist(), strict=True):
            np.maximum(size[first : last + 1], of_window, out=size[first : last + 1])
    return size


def _inflate_trajectory(found: Trajectory, what: str, size: Floats) -> Trajectory:
    """Return the trajectory with its standard deviations inflated by the size of the disagreement at each row, shape (N,)."""
    if not size.any():
        return found
    if what == "turn":
        return replace(found, yaw_std_rad=np.hypot(found.yaw_std_rad, size))
    if what == "position":
        return replace(found, position_std_m=np.hypot(found.position_std_m, size[:, None] * [1.0, 1.0, 0.0]))
    rate = size / _WINDOW_S
    return replace(
        found,
        forward_velocity_std_mps=np.hypot(found.forward_velocity_std_mps, rate),
        displacement_std_m=np.hypot(found.displacement_std_m, rate[:, None] * DISPLACEMENT_LAGS_S),
    )
