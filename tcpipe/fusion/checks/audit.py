"""Check whether the track follows any sensor: an outlier gate cannot show that the track is wrong, since it rejects what contradicts it.

In windows of five seconds the track's displacement is compared with that of every sensor, rejected measurements too: an odometry's
velocity, integrated, along the track's own axes (wheels: forward only); the later fixes less the earlier, against the antenna. The track
is astray where it is further off than a metre, and than four standard deviations of the sensor, from each of them. What a sensor claims
lasts through the window: fixes do not average out, an odometry may be off by its scale and a little velocity throughout. Standard
deviations are inflated there by the smallest difference.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.attitude import compute_turns
from tcpipe.fusion.measurements import (
    DISPLACEMENT_LAGS_S,
    GNSS,
    WHEELS,
    BodyVelocities,
    Measurements,
    Positions,
    Trajectory,
)
from tcpipe.fusion.process import SCALE_STD
from tcpipe.fusion.signals import (
    MAX_GAP_NS,
    compute_interval_means,
    compute_median_period_ns,
    compute_seconds,
    compute_window_means,
    interpolate_signal,
    is_covered,
    remove_spikes,
)
from tcpipe.geometry.rotation import matrix_from_quat
from tcpipe.robust import MIN_SIGMAS, estimate_robust_std
from tcpipe.tables.facts import Disagreement

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_WINDOW_S = 5.0  # about four chords; longer than odometry's gate
_STANDS_MPS = 0.1  # slower is stationary; faster wheels are stuck
_MOVES_M, _FEWEST = 0.5, 4  # windows that show a scale
_SCALES = (0.5, 2.0)
_ASTRAY_M = 1.0  # a larger difference in 5 s is divergence
_MAX_ASTRAY = 0.1  # share of windows that may be astray
_LASTING_MPS = 0.02  # lasting odometry error (`preparation._VELOCITY_FLOOR_MPS`)


@dataclass(frozen=True, slots=True)
class Audit:
    """Where the track of a section is astray, in order of time.

    ``windows``: in how many windows a sensor measures the distance; ``astray``: in how many of them the track is astray.
    """

    disagreements: tuple[Disagreement, ...] = ()
    windows: int = 0
    astray: int = 0


def is_astray(windows: int, astray: int) -> bool:
    """Return whether the track contradicts every sensor in more than a few of the windows in which one measures the distance."""
    return astray > max(1.0, _MAX_ASTRAY * windows)


def audit_trajectory(found: Trajectory, measurements: Measurements) -> tuple[Trajectory, Audit]:
    """Return the trajectory of one section with standard deviations inflated where it is astray, and where that is."""
    windows = _find_windows(found.stamp_ns)
    compared = dict(_iterate_comparisons(found, measurements, windows)) if windows.size else {}
    if not compared:
        return found, Audit()
    size_m, std_m = np.array([*compared.values()]).swapaxes(0, 1)
    is_known = np.isfinite(size_m)
    is_far = is_known & (size_m > np.maximum(_ASTRAY_M, MIN_SIGMAS * std_m))
    astray = is_known.any(0) & (is_far | ~is_known).all(0)
    least = np.argmin(np.where(is_known, size_m, np.inf), axis=0)
    rows_m = np.zeros(found.stamp_ns.size)
    for window in np.flatnonzero(astray).tolist():
        first, last = windows[window].tolist()
        rows_m[first : last + 1] = np.maximum(rows_m[first : last + 1], size_m[least[window], window])
    if astray.any():
        velocity_std_mps = np.hypot(found.forward_velocity_std_mps, rows_m / _WINDOW_S)
        displacement_m = rows_m[:, None] / _WINDOW_S * DISPLACEMENT_LAGS_S
        displacement_std_m = np.hypot(found.displacement_std_m, displacement_m)
        found = replace(found, forward_velocity_std_mps=velocity_std_mps, displacement_std_m=displacement_std_m)
    roles, numbers = list(compared), np.arange(len(windows))
    nearest_m, expected_m = size_m[least, numbers], std_m[least, numbers]
    spans = []
    rows = np.flatnonzero(astray)
    breaks = np.flatnonzero(windows[rows[1:], 0] > windows[rows[:-1], 1]) + 1
    for run in np.split(rows, breaks) if rows.size else ():
        worst = int(run[np.argmax(nearest_m[run])])
        start_ns, end_ns = (int(found.stamp_ns[row]) for row in (windows[run[0], 0], windows[run[-1], 1]))
        spans.append(
            Disagreement(start_ns, end_ns, roles[least[worst]], float(nearest_m[worst]), float(expected_m[worst]))
        )
    return found, Audit(tuple(spans), int(is_known.any(0).sum()), int(astray.sum()))


def _find_windows(stamp_ns: Ints) -> Ints:
    """Return first and last row of each window, shape (W, 2): each begins in the middle of the one before; none bridges a hole."""
    if stamp_ns.size < 2:
        return np.empty((0, 2), np.int64)
    rows = max(2, round(_WINDOW_S * 1e9 / compute_median_period_ns(stamp_ns)))
    first = np.arange(0, stamp_ns.size - rows, max(1, rows // 2), dtype=np.int64)
    first = first[(stamp_ns[first + rows] - stamp_ns[first]) * 1e-9 < 1.1 * _WINDOW_S]
    return np.column_stack((first, first + rows))


def _iterate_comparisons(
    found: Trajectory, m: Measurements, windows: Ints
) -> Iterator[tuple[str, tuple[Floats, Floats]]]:
    """Yield by sensor how far its displacement is off the track's in each window, NaN where unknown, and what it claims [m], shape (W,)."""
    rotation = matrix_from_quat(found.quat_xyzw)
    if m.gnss is not None:
        yield GNSS, _compare_fixes(found, rotation, m.gnss, windows)
    turned = compute_turns(found.quat_xyzw)
    way = np.einsum("kji,kj->ki", rotation[:-1] + rotation[1:], np.diff(found.position_enu_m, axis=0)) / 2.0
    for role, source in m.odometries().items():
        track = (way + np.cross(turned, source.lever_arm_m))[:, : 2 if source.measured[1] else 1]
        yield role, _compare_odometry(found.stamp_ns, role, source, track, windows, scale_seen=m.gnss is not None)


def _compare_odometry(
    stamp_ns: Ints, role: str, source: BodyVelocities, track: Floats, windows: Ints, *, scale_seen: bool
) -> tuple[Floats, Floats]:
    """Compare with an odometry; its scale is removed where fixes show it."""
    zero, period_ns = int(stamp_ns[0]), compute_median_period_ns(source.stamp_ns)
    at_s = compute_seconds(stamp_ns, zero)
    step_s = np.diff(at_s)[:, None]
    velocity = source.velocity_mps[:, : track.shape[1]]
    sensor_m = compute_interval_means(compute_seconds(source.stamp_ns, zero), velocity, at_s[:-1], at_s[1:]) * step_s
    sensor_m[~is_covered(source.stamp_ns, stamp_ns[:-1], stamp_ns[1:], least_ns=MAX_GAP_NS)] = np.nan
    if role == WHEELS:  # that turn while the robot stands: it is stuck, and they are right
        sensor_m[(np.abs(track[:, :1]) < _STANDS_MPS * step_s) & (np.abs(sensor_m) > _STANDS_MPS * step_s)] = np.nan
    sensor_m, track = (np.stack([values[first:last].sum(0) for first, last in windows]) for values in (sensor_m, track))
    far = np.isfinite(sensor_m[:, 0]) & (np.abs(track[:, 0]) > _MOVES_M)
    if scale_seen and far.sum() >= _FEWEST:
        sensor_m = sensor_m / np.clip(np.median(sensor_m[far, 0] / track[far, 0]), *_SCALES)
    noise_m = float(np.sqrt(np.median(source.variance_m2ps2[:, 0]) * period_ns * 1e-9 * _WINDOW_S))
    lasting_m = np.hypot(SCALE_STD[role] * np.linalg.norm(track, axis=1), _LASTING_MPS * _WINDOW_S)
    return np.linalg.norm(sensor_m - track, axis=1), np.hypot(lasting_m, noise_m)


def _compare_fixes(found: Trajectory, rotation: Floats, gnss: Positions, windows: Ints) -> tuple[Floats, Floats]:
    """Compare with the fixes, spikes removed, by their means over the halves of a window; their scatter counts where they claim less."""
    inside = (gnss.stamp_ns >= found.stamp_ns[0]) & (gnss.stamp_ns <= found.stamp_ns[-1])
    if not inside.any():
        return np.full(len(windows), np.nan), np.full(len(windows), np.nan)
    zero, fix_ns = int(found.stamp_ns[0]), gnss.stamp_ns[inside]
    fix_s, at_s = compute_seconds(fix_ns, zero), compute_seconds(found.stamp_ns, zero)
    antenna = (found.position_enu_m + rotation @ np.asarray(gnss.lever_arm_m))[:, :2]
    off = gnss.position_enu_m[inside, :2] - interpolate_signal(at_s, antenna, fix_s)
    second = np.diff(gnss.position_enu_m[inside, :2], n=2, axis=0)
    scatter = estimate_robust_std(second) / np.sqrt(6.0) if second.size else 0.0
    claim = np.maximum(np.sqrt(gnss.variance_m2[inside, :2].mean(1)), scatter)
    both = np.column_stack((*(remove_spikes(axis) for axis in off.T), claim))
    begin_ns, end_ns = found.stamp_ns[windows].T
    quarter_ns = (end_ns - begin_ns) // 4
    half_ns = 2 * int(np.median(quarter_ns))
    earlier, later = (
        compute_window_means(fix_ns, both, at, half_ns).T for at in (begin_ns + quarter_ns, end_ns - quarter_ns)
    )
    return 2.0 * np.hypot(*(later - earlier)[:2]), 2.0 * np.hypot(earlier[2], later[2])
