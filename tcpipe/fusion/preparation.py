"""Convert columns of streams to measurements: base_link axes, the datum's plane, usable variances, one row per stamp.

Rows without a measurement (neither velocity nor pose, a fix at 0, 0, a sample beyond any sensor's range) are excluded
and returned, so that they can be listed. A variance that is unknown, zero, negative or not finite is replaced by the
larger of the recipe's variance and the median of the stated variances. A variance below a floor is raised to it. The
rounding error of coordinates with few decimals is added.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from tcpipe.arrays import Floats, Ints, Mask
from tcpipe.fusion.attitude import add_attitude, compute_turns
from tcpipe.fusion.measurements import (
    IMU,
    MAX_VARIANCE,
    VISUAL,
    WHEELS,
    BodyVelocities,
    GroundVelocities,
    InertialMeasurements,
    Positions,
    select_sensor_rows,
)
from tcpipe.fusion.signals import (
    compute_median_period_ns,
    compute_seconds,
    compute_slopes,
    compute_window_means,
    estimate_white_noise,
    integrate_signal,
)
from tcpipe.geometry.datum import enu_from_geodetic
from tcpipe.geometry.rotation import invert, matrix_from_quat, multiply, normalize, rotate
from tcpipe.tables.findings import Finding, Subject, make_finding

Columns = Mapping[str, Floats]  # columns of a stream by name, null as NaN

_IMU = Subject("role", IMU)
_QUAT = ("quat_x", "quat_y", "quat_z", "quat_w")
_VELOCITY_FLOOR_MPS = 0.02  # no odometry is better
_MAX_VELOCITY_MPS = 50.0  # no robot is faster
GRAVITY_BAND_MPS2 = (8.0, 12.0)  # Median size of a specific force that contains gravity [m/s²]
_SLICE_ROWS = 1 << 16
_MIN_COUNT = 20  # fewest samples to find a grid or a turn [1]
_JITTER_STEPS = 41  # pairs of fixes in a window of the estimate of jitter


@dataclass(frozen=True, slots=True)
class Prepared:
    """Result of preparing a stream: stamps of unusable rows, counts of repeated and replaced rows; findings."""

    invalid_ns: Ints
    repeated: int = 0
    variances_replaced: int = 0
    findings: tuple[Finding, ...] = ()


def find_datum(lon_deg: Floats, lat_deg: Floats, alt_m: Floats) -> tuple[float, float, float] | None:
    """Return longitude [deg], latitude [deg], height [m]: the median of the first ten fixes; None without fixes."""
    usable = np.flatnonzero(_is_fix(lon_deg, lat_deg, alt_m))[:10]
    if usable.size == 0:
        return None
    first = lon_deg[usable[0]]
    rotated = (lon_deg[usable] - first + 180.0) % 360.0 - 180.0  # for fixes on both sides of the date line
    lon = (first + float(np.median(rotated)) + 180.0) % 360.0 - 180.0
    return float(lon), float(np.median(lat_deg[usable])), float(np.median(alt_m[usable]))


def _is_fix(lon_deg: Floats, lat_deg: Floats, alt_m: Floats) -> Mask:
    is_place: Mask = (np.abs(lat_deg) <= 90) & (np.abs(lon_deg) <= 360) & ((lon_deg != 0) | (lat_deg != 0))
    return is_place & np.isfinite(alt_m)


def prepare_positions(
    stamp_ns: Ints,
    columns: Columns,
    *,
    datum_deg_m: tuple[float, float, float],
    lever_arm_m: tuple[float, float, float],
    lever_arm_std_m: tuple[float, float, float],
    default_std_m: float,
    floor_std_m: float,
    mounting_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0),
) -> tuple[Positions, Prepared]:
    """Prepare GNSS fixes (columns of the role gnss); unknown σ: ``default_std_m`` horizontally, twice vertically.

    Also for a pose (columns of the role pose); ``mounting_xyzw`` rotates its sensor's axes to base_link.
    """
    lon, lat, alt = columns["lon_deg"], columns["lat_deg"], columns["alt_m"]
    is_fix = _is_fix(lon, lat, alt)
    usable, repeated = _select_usable_rows(stamp_ns, is_fix)
    variance = _stack_columns(columns, [f"{axis}_var_m2" for axis in ("east", "north", "up")])[usable]
    default = np.square(default_std_m * np.array([1.0, 1.0, 2.0]))
    unclaimed = np.asarray(~_is_known(variance[:, :2]).all(1))
    variance, replaced = _clean_variances(variance, default, floor_std_m**2)
    degree_m = 111_320.0 * np.array([np.cos(np.radians(datum_deg_m[1])), 1.0])  # degree of longitude, and of latitude
    rounding = _compute_rounding_variances(np.column_stack((lon, lat))[usable]) * degree_m**2
    unclaimed |= (rounding > variance[:, :2]).any(1)  # the receiver's claim ignores the rounding of its coordinates
    variance[:, :2] += rounding
    fixes = enu_from_geodetic(lon[usable], lat[usable], alt[usable], datum_deg_m=datum_deg_m)
    prepared = Prepared(stamp_ns[~is_fix], repeated, replaced)
    unclaimed_rows = unclaimed if unclaimed.any() else None
    positions = Positions(stamp_ns[usable], fixes, variance, lever_arm_m, lever_arm_std_m, unclaimed_rows)
    if "quat_x" in columns:
        frame, quat = _stack_columns(columns, ("x_m", "y_m")), _stack_columns(columns, _QUAT)
        rotation_variance = _stack_columns(columns, [f"rotation_{axis}_var" for axis in "xyz"])
        positions = add_attitude(positions, frame[usable], quat[usable], rotation_variance[usable], mounting_xyzw)
    return positions, prepared


def _compute_rounding_variances(values: Floats) -> Floats:
    """Return the rounding variance of each axis of values (N, k), shape (k,): grid²/12 times the rows per value.

    All axes have one grid: the smallest step between values, of which every step is a multiple. Rows with one value
    have the same error, which does not average out.
    """
    # Rounding removes the smaller differences of binary fractions.
    steps = np.concatenate([np.diff(np.unique(axis.round(10))) for axis in values.T])
    multiples = steps / steps.min() if steps.size >= _MIN_COUNT else np.array([0.5])
    if (np.abs(multiples - np.rint(multiples)) > 0.01).any():
        return np.zeros(values.shape[1])
    rows = values.shape[0] / (1 + np.count_nonzero(np.diff(values, axis=0), axis=0))
    return np.asarray(steps.min() ** 2 * np.minimum(rows / 12.0, 1.0))


def drop_repeated_fixes(gnss: Positions, odometry: BodyVelocities | None) -> tuple[Positions, list[list[int]]]:
    """Return the fixes without exact repetitions, and the repetitions while the robot drives.

    Each of the latter is a list of first stamp [ns], last stamp [ns] and number of repetitions. Causes are a receiver
    that hangs, or a slow receiver whose fixes are published at a higher rate. Repetitions carry no information. They
    are kept if the robot may be stationary: without odometry, if they last longer than a second and two periods, and if
    fixes never change.
    """
    stamp_ns = gnss.stamp_ns
    changes = np.concatenate(([True], (np.diff(gnss.position_enu_m, axis=0) != 0.0).any(1)))
    first = np.flatnonzero(changes)
    if first.size < 2 or first.size == stamp_ns.size:
        return gnss, []
    last = np.append(first[1:], stamp_ns.size) - 1
    kept_ns = stamp_ns[last] - stamp_ns[first]
    lasting = kept_ns >= max(1_000_000_000, 2 * compute_median_period_ns(stamp_ns[first]))  # shorter: a slow receiver
    if odometry is None:
        kept = changes | np.repeat(lasting, last - first + 1)
        return (gnss if kept.all() else select_sensor_rows(gnss, kept)), []
    zero = int(stamp_ns[0])
    speed = np.nan_to_num(np.abs(odometry.velocity_mps[:, :1]))
    driven_m = integrate_signal(compute_seconds(odometry.stamp_ns, zero), speed, compute_seconds(stamp_ns, zero))[:, 0]
    frozen = np.flatnonzero(lasting & (driven_m[last] - driven_m[first] > 0.2 * kept_ns * 1e-9))  # faster than 0.2 m/s
    found = np.stack((stamp_ns[first], stamp_ns[last], last - first), -1)[frozen].tolist()
    return select_sensor_rows(gnss, changes), found


def inflate_jittery_fixes(gnss: Positions, odometry: BodyVelocities) -> tuple[Positions, Floats]:
    """Return the fixes with variances inflated for jitter of stamps, and the σ of each stamp [s], shape (N,).

    If a driver stamps a fix when it sends it, positions seem to stop and then to jump. The distance between two fixes
    is compared with that of the odometry, times the local ratio of the two (slip). Jitter is the scatter of this
    residual beyond the stated noise, divided by speed. It is 0 if it is small or unknown; a stationary robot has the
    jitter of the nearest motion. The variance grows by (2 speed jitter)², because errors of successive late fixes are
    correlated.
    """
    zero = int(gnss.stamp_ns[0])
    stamp_s, odometry_s = compute_seconds(gnss.stamp_ns, zero), compute_seconds(odometry.stamp_ns, zero)
    speed = np.abs(odometry.velocity_mps[:, :1])
    driven_m = np.diff(integrate_signal(odometry_s, speed, stamp_s), axis=0)[:, 0]
    interval_s = np.diff(stamp_s)
    moved_m = np.hypot(*np.diff(gnss.position_enu_m[:, :2], axis=0).T)
    moving = (driven_m > 0.3 * interval_s) & (interval_s < 2.0)  # faster than 0.3 m/s, without a gap
    if moving.sum() < _JITTER_STEPS:
        return gnss, np.zeros(stamp_s.size)
    driven_m, moved_m, mean_speed = driven_m[moving], moved_m[moving], driven_m[moving] / interval_s[moving]
    # The median ignores slip and single outliers.
    residual_s = (moved_m - np.median(_make_windows(moved_m / driven_m), axis=1) * driven_m) / mean_speed
    claimed_m2 = gnss.variance_m2[:, :2].mean(1)
    claimed_s2 = _make_windows((claimed_m2[:-1] + claimed_m2[1:])[moving] / 2 / mean_speed**2).mean(1)
    # One outlier affects two pairs: the 80 % quantile tolerates one outlier in ten, but includes tails.
    spread_s = np.quantile(_make_windows(np.abs(residual_s)), 0.8, axis=1) / 1.2816
    excess_s2 = spread_s**2 / 2 - claimed_s2
    matters = excess_s2 > np.maximum(0.05**2, 4 * claimed_s2)  # ignore less than 0.05 s
    middle_s = (0.5 * (stamp_s[1:] + stamp_s[:-1]))[moving]
    jitter_s = np.interp(stamp_s, middle_s, np.sqrt(np.where(matters, excess_s2, 0.0)))
    variance = gnss.variance_m2.copy()
    variance[:, :2] += ((2 * np.interp(stamp_s, odometry_s, speed[:, 0]) * jitter_s) ** 2)[:, None]
    unclaimed = jitter_s > 0.0 if gnss.unclaimed is None else gnss.unclaimed | (jitter_s > 0.0)
    return replace(gnss, variance_m2=variance, unclaimed=unclaimed), jitter_s


def inflate_late_fixes(gnss: Positions, late_s: float) -> Positions:
    """Inflate the variances of fixes if their receiver is late by ``late_s``, since it probably filters its positions.

    A first-order low-pass of time τ delays positions by τ. After correction of the delay, an error of τ² times the
    acceleration remains. Correlation with speeds finds a delay below τ, so the remaining delay may be as large as the
    found delay.
    """
    if late_s < 0.2:  # [s]: no position filter
        return gnss
    axes = list(gnss.position_enu_m[:, :2].T)
    for _ in range(2):
        axes = [compute_slopes(gnss.stamp_ns, axis, max(2.0 * late_s, 1.0)) for axis in axes]  # shortest window [s]
    variance = gnss.variance_m2.copy()
    variance[:, :2] += ((late_s**2 * np.hypot(*axes)) ** 2)[:, None]
    return replace(gnss, variance_m2=variance, unclaimed=np.ones(len(variance), np.bool_), lag_std_s=late_s)


def _make_windows(values: Floats) -> Floats:
    """Return the 41 values around each value, shape (N, 41), mirrored at the ends."""
    return np.lib.stride_tricks.sliding_window_view(np.pad(values, _JITTER_STEPS // 2, mode="reflect"), _JITTER_STEPS)


def prepare_ground_velocities(
    stamp_ns: Ints, columns: Columns, *, default_std_mps: float
) -> tuple[GroundVelocities, Prepared]:
    """Prepare a receiver's velocities (columns of the role gnss_velocity); unknown σ: ``default_std_mps``, twice up."""
    velocity = _stack_columns(columns, [f"{axis}_velocity_mps" for axis in ("east", "north", "up")])
    variance = _stack_columns(columns, [f"{axis}_var_m2ps2" for axis in ("east", "north", "up")])
    measured = np.asarray(np.isfinite(velocity[:, :2]).all(1) & ~(np.abs(velocity) >= _MAX_VELOCITY_MPS).any(1))
    usable, repeated = _select_usable_rows(stamp_ns, measured)
    velocity, variance = velocity[usable], variance[usable]
    default = np.square(default_std_mps * np.array([1.0, 1.0, 2.0]))
    variance, replaced = _clean_variances(variance, default, _VELOCITY_FLOOR_MPS**2)
    variance[np.isnan(velocity[:, 2]), 2] = MAX_VARIANCE
    velocities = GroundVelocities(stamp_ns[usable], np.nan_to_num(velocity), variance)
    return velocities, Prepared(stamp_ns[~measured], repeated, replaced)


def prepare_body_velocities(
    stamp_ns: Ints,
    columns: Columns,
    *,
    xyz_m: tuple[float, float, float],
    quat_xyzw: tuple[float, float, float, float],
    default_std_mps: float,
    only_forward: bool,
) -> tuple[BodyVelocities, Prepared]:
    """Prepare an odometry (columns of wheel_odometry or visual_odometry), whose child frame has the given extrinsics.

    The twist is used if it is valid. A twist without forward velocity, or that is always zero while the poses move, is
    invalid. Then the velocity comes from increments between poses, at the middle of two stamps and in the mean of the
    two attitudes. Of wheels, ``only_forward`` velocity (along base_link's x) is measured.
    """
    pose = _stack_columns(columns, ("x_m", "y_m", "z_m"))
    velocity = _stack_columns(columns, [f"velocity_{axis}_mps" for axis in "xyz"])
    rate = _stack_columns(columns, [f"angular_velocity_{axis}_radps" for axis in "xyz"])
    variance = _stack_columns(columns, [f"velocity_var_{axis}_m2ps2" for axis in "xyz"])
    subject = Subject("role", WHEELS if only_forward else VISUAL)
    findings: list[Finding] = []
    quat = normalize(_stack_columns(columns, _QUAT))
    rotation = matrix_from_quat(quat_xyzw)
    if not has_twist(_rotate_vectors(rotation, velocity)[:, :1], pose):
        stamp_ns, velocity, rate = compute_increments(stamp_ns, pose, quat)
        variance = np.full_like(velocity, np.nan)
        findings.append(make_finding("pose-increments", subject))
    else:
        rates, of_orientation = compute_orientation_rates(stamp_ns, rate, quat)
        if of_orientation[2] or not only_forward:
            rate = rates
            findings += _find_orientation_rates(of_orientation, subject)
    rotated = _rotate_vectors(rotation, velocity)
    measured = np.isfinite(rotated[:, 0]) & ~(np.abs(rotated) >= _MAX_VELOCITY_MPS).any(1)
    usable, repeated = _select_usable_rows(stamp_ns, measured)
    # Off-diagonal terms by the rotation are ignored.
    variance = _rotate_vectors(rotation**2, variance[usable])
    rotated = rotated[usable]
    variance[np.isnan(rotated)] = MAX_VARIANCE
    variance, replaced = _clean_variances(variance, np.full(3, default_std_mps**2), _VELOCITY_FLOOR_MPS**2)
    turn_rate = _rotate_vectors(rotation, rate)[usable]
    if only_forward:
        rotated[:, 1:] = np.nan
        variance[:, 1:] = np.nan
    else:  # an axis that is not measured: zero with a large variance
        rotated[np.isnan(rotated)] = 0.0
    spatial = None if only_forward or not np.isfinite(turn_rate).all() else turn_rate
    made = BodyVelocities(stamp_ns[usable], rotated, variance, turn_rate[:, 2], xyz_m, spatial)
    return made, Prepared(stamp_ns[~measured], repeated, replaced, tuple(findings))


def _find_orientation_rates(of_orientation: Mask, subject: Subject) -> list[Finding]:
    axes = ", ".join(np.array(["x", "y", "z"])[of_orientation])
    return [make_finding("rate-from-orientation", subject, names={"axes": axes})] if axes else []


def _rotate_vectors(matrix: Floats, values: Floats) -> Floats:
    """Return ``matrix`` (3, 3) times vectors (N, 3); an axis is NaN if an unmeasured component contributes to it."""
    unknown = np.isnan(values)
    rotated = np.where(unknown, 0.0, values) @ matrix.T
    return np.where(unknown @ (np.abs(matrix).T > 0.1), np.nan, rotated)  # cosine: 6° off the axis


def prepare_imu(
    stamp_ns: Ints,
    columns: Columns,
    *,
    xyz_m: tuple[float, float, float],
    quat_xyzw: tuple[float, float, float, float],
    gyro_std_radps: float,
    accelerometer_std_mps2: float,
) -> tuple[InertialMeasurements, Prepared]:
    """Prepare an IMU (columns of the role imu): rotate and move it to base_link, and check its specific force.

    The noise is the larger of the given noise and the noise of the samples, which includes motion too fast for the
    unit's rate.
    """
    rate = _stack_columns(columns, [f"angular_velocity_{axis}_radps" for axis in "xyz"])
    force = _stack_columns(columns, [f"linear_acceleration_{axis}_mps2" for axis in "xyz"])
    of_orientation, is_changing = np.zeros(3, np.bool_), np.nan_to_num(np.diff(force, axis=0)).any()
    if is_changing and (np.nan_to_num(rate) == 0.0).all(0).any():
        quat = normalize(_stack_columns(columns, _QUAT))
        rate, of_orientation = compute_orientation_rates(stamp_ns, rate, quat)
    # No gyroscope measures 100 rad/s, no accelerometer 1,000 m/s²; NaN compares false.
    good: Mask = np.all(np.abs(rate) < 100.0, 1) & np.all(np.abs(force) < 1000.0, 1)
    usable, repeated = _select_usable_rows(stamp_ns, good)
    if usable.size < stamp_ns.size:
        rate, force = rate[usable], force[usable]
    norm = float(np.median(np.linalg.norm(force, axis=1))) if usable.size else 0.0
    low, high = GRAVITY_BAND_MPS2
    findings = _find_orientation_rates(of_orientation, _IMU)
    weighs = not usable.size or low <= norm <= high
    if not weighs:
        findings.append(make_finding("specific-force-implausible", _IMU, force_mps2=norm))
    gyro_std = max(gyro_std_radps, estimate_white_noise(rate))
    noise = np.maximum(accelerometer_std_mps2, _estimate_local_noise(stamp_ns[usable], force))
    accelerometer_std = max(accelerometer_std_mps2, estimate_white_noise(force))
    for piece in _iterate_slices(usable.size):
        rate[piece], force[piece] = rotate(quat_xyzw, rate[piece]), rotate(quat_xyzw, force[piece])
    _move_to_base_link(stamp_ns[usable], rate, force, np.asarray(xyz_m))
    quat = _read_orientations(columns, usable, quat_xyzw)
    made = InertialMeasurements(
        stamp_ns[usable], rate, force, quat, gyro_std, accelerometer_std, weighs, accelerometer_noise_mps2=noise
    )
    return made, Prepared(stamp_ns[~good], repeated, 0, tuple(findings))


def _iterate_slices(rows: int) -> Iterator[slice]:
    """Yield slices of rows; they keep temporary arrays small for a log of any length."""
    return (slice(first, first + _SLICE_ROWS) for first in range(0, rows, _SLICE_ROWS))


def _read_orientations(columns: Columns, usable: Ints, quat_xyzw: tuple[float, float, float, float]) -> Floats:
    """Return enu_from_base_link from the unit's own filter, shape (N, 4); NaN where it is missing."""
    components = [columns[name] for name in _QUAT]
    if any(np.isnan(component).all() for component in components):
        return np.broadcast_to(np.nan, (usable.size, 4))
    found = np.empty((usable.size, 4))
    for piece in _iterate_slices(usable.size):
        unit = normalize(np.stack([component[usable[piece]] for component in components], -1))
        found[piece] = multiply(unit, invert(quat_xyzw))
    return found


def _move_to_base_link(stamp_ns: Ints, turn_radps: Floats, force_mps2: Floats, lever_m: Floats) -> None:
    """Subtract the acceleration of the unit relative to base_link, dw x l + w x (w x l) [m/s²], in base_link axes.

    The angular acceleration dw is the slope of a line through five samples (Savitzky and Golay 1964): its noise, added
    over time, cancels out.
    """
    if stamp_ns.size < 5 or not lever_m.any():
        return
    ten_periods_s = 10e-9 * compute_median_period_ns(stamp_ns)
    for piece in _iterate_slices(stamp_ns.size):
        rows = np.arange(piece.start - 2, min(piece.stop, stamp_ns.size) + 2)
        smooth = turn_radps[rows.clip(0, stamp_ns.size - 1)]
        slope = (2 * (smooth[4:] - smooth[:-4]) + smooth[3:-1] - smooth[1:-3]) / ten_periods_s
        force_mps2[piece] -= np.cross(slope, lever_m) + np.cross(smooth[2:-2], np.cross(smooth[2:-2], lever_m))


def _estimate_local_noise(stamp_ns: Ints, values: Floats) -> Floats:
    """Return the σ of white noise in two seconds around each sample, largest axis, (N,); 0 for few samples."""
    largest = np.zeros(stamp_ns.size)
    for axis in values.T if stamp_ns.size > 2 else ():
        square = np.square(np.diff(axis, n=2))[:, None] / 6.0
        np.fmax(largest, compute_window_means(stamp_ns[1:-1], square, stamp_ns, 2_000_000_000)[:, 0], out=largest)
    return np.sqrt(largest)


def _stack_columns(columns: Columns, names: list[str] | tuple[str, ...]) -> Floats:
    return np.stack([columns[name] for name in names], -1)


def _select_usable_rows(stamp_ns: Ints, good: Mask) -> tuple[Ints, int]:
    """Return usable rows in order of time, the first of each stamp, and the number of rows with a repeated stamp."""
    rows = np.flatnonzero(good)
    if (np.diff(stamp_ns[rows]) > 0).all():
        return rows, 0
    _, first = np.unique(stamp_ns[rows], return_index=True)
    return rows[first], int(rows.size - first.size)


def _is_known(variance: Floats) -> Mask:
    known: Mask = np.isfinite(variance) & (variance > 0)
    return known


def _clean_variances(variance: Floats, default: Floats, floor: float) -> tuple[Floats, int]:
    """Return usable variances (N, k), and the number of replaced rows: default, or the median if larger."""
    known = _is_known(variance)
    medians = [np.median(axis[rows]) if rows.any() else 0.0 for axis, rows in zip(variance.T, known.T, strict=True)]
    filled = np.clip(np.where(known, variance, np.maximum(default, medians)), floor, MAX_VARIANCE)
    return filled, int((~known).any(1).sum())


_MAX_INCREMENT_S = 1.0  # longer increments give no velocity


def has_twist(velocity_mps: Floats, pose_m: Floats) -> bool:
    """Return whether the velocities are valid: finite, and not always zero while the poses move."""
    posed = pose_m[np.isfinite(pose_m).all(1)]
    moves = posed.size > 0 and float(np.ptp(posed, axis=0).max()) > 0.1  # m: smaller changes may be noise
    return bool(np.isfinite(velocity_mps).any() and (np.nan_to_num(velocity_mps).any() or not moves))


def compute_increments(stamp_ns: Ints, pose_m: Floats, quat_xyzw: Floats) -> tuple[Ints, Floats, Floats]:
    """Return stamp, velocity and angular velocity (child frame) at the middle of each two successive poses."""
    posed = np.isfinite(np.hstack((pose_m, quat_xyzw))).all(axis=1)
    rows, _ = _select_usable_rows(stamp_ns, np.asarray(posed))
    stamp, position, quat = stamp_ns[rows], pose_m[rows], quat_xyzw[rows]
    step_ns = np.diff(stamp)
    step_s = np.asarray(step_ns, np.float64)[:, None] * 1e-9
    turn = compute_turns(quat)
    # Mean attitude: the normalized sum of both quaternions in one hemisphere.
    sign = np.where(np.sum(quat[:-1] * quat[1:], axis=-1, keepdims=True) < 0, -1.0, 1.0)
    velocity = rotate(invert(normalize(quat[:-1] + sign * quat[1:])), np.diff(position, axis=0)) / step_s
    near = step_s[:, 0] <= _MAX_INCREMENT_S
    return stamp[:-1][near] + step_ns[near] // 2, velocity[near], (turn / step_s)[near]


def compute_orientation_rates(stamp_ns: Ints, rate_radps: Floats, quat_xyzw: Floats) -> tuple[Floats, Mask]:
    """Return angular velocities, shape (N, 3), and the axes that come from the orientation, shape (3,).

    The orientation gives an axis if it turns about it while ``rate_radps``, in the child frame, is missing or always
    zero. ``stamp_ns`` does not decrease; NaN is not measured.
    """
    zero = (np.nan_to_num(rate_radps) == 0.0).all(axis=0)
    known = np.flatnonzero(np.isfinite(quat_xyzw).all(axis=1))
    known = known[np.concatenate(([True], np.diff(stamp_ns[known]) > 0))] if known.size else known
    if not zero.any() or known.size < _MIN_COUNT:
        return rate_radps, np.zeros(3, np.bool_)
    stamp, quat = stamp_ns[known], quat_xyzw[known]
    turned_rad = np.cumsum(compute_turns(quat), axis=0)
    turns = zero & (np.ptp(turned_rad, axis=0) > 0.2)  # a larger turn contradicts zero [rad]
    # Differences over two steps give the rate in the middle, at the stamp itself.
    step_s = (stamp[2:] - stamp[:-2])[:, None] * 1e-9
    rate = compute_turns(quat, 2) / step_s
    inner, near = known[1:-1], step_s[:, 0] <= _MAX_INCREMENT_S
    rates = np.where(turns, np.nan, rate_radps)
    rates[inner[near]] = np.where(turns, rate[near], rate_radps[inner[near]])
    return rates, turns
