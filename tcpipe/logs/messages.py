"""Conversion of a topic's fields to the SI columns of its role, row by row; excluded rows are counted by reason.

Columns in, columns out, named as in the levels' tables. Sources: the definitions of sensor_msgs, nav_msgs and
geometry_msgs (their comments fix units, frames and what -1 and 0 mean), REP-103, REP-105, REP-145.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from tcpipe.arrays import AnyArray, Columns, Floats, Ints, Mask
from tcpipe.geometry.rotation import normalize
from tcpipe.logs import roles
from tcpipe.logs.extrinsics import is_base
from tcpipe.logs.fix_quality import (
    NO_HEIGHT_M2,
    add_quality_std,
    classify_fixes,
    classify_status,
    convert_gps_fix,
    find_status,
)
from tcpipe.logs.nmea import add_date, read_gga, read_over_ground
from tcpipe.recipe.suggestions import suggest
from tcpipe.tables.findings import Findings, Subject, make_finding, read_threshold

LOG_TIME = "log_time_ns"
GNSS, GNSS_VELOCITY = Subject("role", "gnss"), Subject("role", "gnss_velocity")
HEADER_STAMP = ("header.stamp.sec", "header.stamp.nanosec")
Arrays = dict[str, AnyArray]


@dataclass(frozen=True, slots=True)
class Readings:
    """A topic's usable rows.

    ``row`` is each one's place in the table, ``header_ns`` its own stamp (0 where unset, None if the type has none),
    ``dropped`` counts the rows that are not used by reason, ``notes`` counts values that were set aside inside used
    rows.
    """

    row: Ints
    log_time_ns: Ints
    header_ns: Ints | None
    columns: Arrays
    dropped: dict[str, int] = field(default_factory=dict)
    notes: dict[str, int] = field(default_factory=dict)
    findings: Findings = ()
    own_time_ns: Ints | None = None
    """Time that the measurement itself carries (NMEA), as `read_header_ns`."""

    def select(self, rows: Ints | Mask | slice) -> Readings:
        """Return some of the rows."""
        return replace(
            self,
            row=self.row[rows],
            log_time_ns=self.log_time_ns[rows],
            header_ns=None if self.header_ns is None else self.header_ns[rows],
            columns={name: values[rows] for name, values in self.columns.items()},
            own_time_ns=None if self.own_time_ns is None else self.own_time_ns[rows],
        )


def read_messages(
    columns: Columns, role: str, type_name: str, *, fix_std_m: Mapping[str, float] = MappingProxyType({})
) -> Readings:
    """Return the readings of a topic that is used as ``role`` (power is read by `tcpipe.power.readings`).

    ``columns`` are ``log_time_ns`` and the message's fields by dotted name, shape (N,); covariances have shape (N, k),
    frames and sentences are arrays of str. `KeyError`: its type lacks the field that this names. ``fix_std_m`` is the
    recipe's ``read.fix_std_m``.
    """
    found = _READERS[role, type_name]({name: _mask_impossible(name, values) for name, values in columns.items()})
    if role != "gnss":
        return found
    columns, count = add_quality_std(found.columns, fix_std_m)
    return replace(found, columns=columns, notes=found.notes | ({"std_by_quality": count} if count else {}))


_IMPOSSIBLE = 1e9  # largest position, velocity or acceleration in SI units; squares of larger values overflow


def _mask_impossible(name: str, values: AnyArray) -> AnyArray:
    """Return the values of a field, NaN for those that no sensor can report; covariances are checked when used."""
    if not np.issubdtype(values.dtype, np.floating) or name.endswith("covariance"):
        return values
    possible = np.abs(values) <= _IMPOSSIBLE
    return values if possible.all() else np.where(possible, values, np.nan)


def count_frames(columns: Columns, type_name: str) -> dict[str, int]:
    """Return the frames of a topic's measurements with their counts, most frequent first; leading slashes are removed.

    A pose names only its reference frame, not the frame of its sensor, so the latter is "".
    """
    name = "child_frame_id" if type_name == roles.ODOMETRY else "header.frame_id"
    if name not in columns or type_name in (roles.POSE_STAMPED, roles.POSE_WITH_COVARIANCE_STAMPED):
        return {}
    column = columns[name]
    is_constant = column.size > 0 and column.strides[0] == 0
    texts, counts = (column[:1], [column.size]) if is_constant else np.unique(column.astype(str), return_counts=True)
    found: dict[str, int] = {}
    for text, count in zip(texts, counts, strict=True):
        found[text.lstrip("/")] = found.get(text.lstrip("/"), 0) + int(count)
    return dict(sorted(found.items(), key=lambda item: (-item[1], item[0])))


def read_header_ns(columns: Columns) -> Ints | None:
    """Return header stamps [ns], 0 where unset; None if the message has no header."""
    if not set(HEADER_STAMP) <= columns.keys():
        return None
    seconds, nanoseconds = (columns[name].astype(np.int64) for name in HEADER_STAMP)
    return np.asarray(seconds * 1_000_000_000 + nanoseconds)


def _select_rows(columns: Columns, values: Arrays, drops: Mapping[str, Mask], **extra: Any) -> Readings:
    """Return the readings of the rows that no reason drops; a row counts under its first reason."""
    keep = np.ones(len(columns[LOG_TIME]), bool)
    dropped: dict[str, int] = {}
    for reason, mask in drops.items():
        if count := int(np.count_nonzero(mask & keep)):
            dropped[reason] = count
        keep &= ~mask
    row = np.flatnonzero(keep)
    every = slice(None) if row.size == keep.size else row  # no copy if all rows are used
    stamps = read_header_ns(columns)
    return Readings(
        row,
        columns[LOG_TIME][every].astype(np.int64, copy=False),
        None if stamps is None else stamps[every],
        {name: value[every] for name, value in values.items()},
        dropped,
        **extra,
    )


def _read_vector(columns: Columns, prefix: str) -> Floats:
    """Return fields x, y, z as shape (N, 3)."""
    return np.stack([columns[f"{prefix}.{axis}"].astype(float) for axis in "xyz"], -1)


def _name_axes(name: str, suffix: str, values: Floats) -> Arrays:
    return {f"{name}_{axis}_{suffix}": values[:, i] for i, axis in enumerate("xyz")}


def _read_variances(columns: Columns, name: str, *diagonal: int) -> Floats:
    """Return diagonal entries of a covariance, shape (N, k); NaN for unusable ones: zero, negative or not finite."""
    if name not in columns:
        return np.full((len(columns[LOG_TIME]), len(diagonal)), np.nan)
    chosen = columns[name].astype(float)[:, list(diagonal)]
    return np.where(np.isfinite(chosen) & (chosen > 0), chosen, np.nan)


def _is_absent(columns: Columns, name: str) -> Mask:
    """Whether a covariance marks its quantity as not measured: first element -1 (sensor_msgs/Imu), or all vast."""
    if name not in columns:
        return np.zeros(len(columns[LOG_TIME]), bool)
    return np.asarray((columns[name][:, 0] == -1) | (columns[name][:, [0, 4, 8]] >= _UNMEASURED_VAR).all(1))


_UNMEASURED_VAR = 1e3
"""Smallest variance [SI units squared] that means "not measured": drivers write 1e3 to 1e9 for such components."""


def _find_unmeasured(columns: Columns, name: str, twist: Floats) -> Mask:
    """Return components of a twist (N, 6) that are not measured: variance -1 or very large, or all zero in motion.

    Forward velocity keeps its variance. The last digit distinguishes a constant from a calm sensor, only in some rows.
    """
    found = np.zeros(twist.shape, bool)
    if name in columns and columns[name].shape[1] >= 36:
        variance = columns[name][:, ::7]
        found = (variance == -1) | (variance >= _UNMEASURED_VAR)
    if len(twist) >= _FEWEST_ZEROS and np.any(twist[:, 0]):
        found |= ~np.any(twist, axis=0)
    found[:, 0] = False
    return found


_FEWEST_ZEROS = 20


def _read_orientation(columns: Columns, prefix: str) -> tuple[Floats, Mask]:
    """Return unit quaternions (N, 4), NaN for other values, and the rows of these."""
    given = np.stack([columns[f"{prefix}.{c}"].astype(float) for c in "xyzw"], -1)
    length = np.linalg.norm(given, axis=-1)
    bad = ~(np.abs(length - 1.0) < _QUAT_TOLERANCE)
    return normalize(np.where(bad[:, None], np.nan, given)), bad


_QUAT_TOLERANCE = 0.01


def _is_outside(lat_deg: Floats, lon_deg: Floats) -> Mask:
    return (np.abs(lat_deg) > 90) | (np.abs(lon_deg) > 180)


def _read_gnss(lon: Floats, lat: Floats, alt: Floats, variances: Floats, quality: Floats) -> Arrays:
    return {
        "lon_deg": lon,
        "lat_deg": lat,
        "alt_m": alt,
        **{f"{axis}_var_m2": variances[:, i] for i, axis in enumerate(("east", "north", "up"))},
        "fix_status": find_status(quality),
        "fix_quality": quality,
    }


def _read_nav_sat_fix(columns: Columns) -> Readings:
    lat, lon, alt = (columns[name].astype(float) for name in ("latitude", "longitude", "altitude"))
    variances = _read_variances(columns, "position_covariance", 0, 4, 8)
    unknown = columns["position_covariance_type"] == 0
    variances[unknown] = np.nan
    status = columns["status.status"].astype(np.int64)
    drops = {
        "no_fix": status < 0,
        "not_finite": ~np.isfinite(lat + lon),
        "null_island": (lat == 0) & (lon == 0),
        "outside_the_globe": _is_outside(lat, lon),
    }
    fixed = ~np.any(list(drops.values()), axis=0)
    alt, unmeasured = _read_altitude(alt, fixed)
    variances[unmeasured, 2] = NO_HEIGHT_M2
    missing, fixes = int(np.count_nonzero(unmeasured & fixed)), int(np.count_nonzero(fixed))
    notes = {"without_covariance": int(np.count_nonzero(np.isnan(variances[:, 0]))), "without_altitude": missing}
    findings = (make_finding("altitude-missing", GNSS, missing_count=missing, fixes_count=fixes),) if missing else ()
    quality = columns["fix_quality"] if "fix_quality" in columns else classify_status(status, "navsat")
    values = _read_gnss(lon, lat, alt, variances, quality) | {"fix_status": status.astype(np.int8)}
    return _select_rows(columns, values, drops, notes=notes, findings=findings)


def _read_altitude(alt: Floats, fixed: Mask) -> tuple[Floats, Mask]:
    """Return heights, the median of the known ones where a height is missing, and the rows of these.

    NaN is sensor_msgs/NavSatFix's word for it; measured digits always change, so one constant means
    it too.
    """
    unknown = ~np.isfinite(alt)
    known = alt[~unknown & fixed]
    if known.size >= read_threshold("altitude-missing", "min_equal_count") and np.ptp(known) == 0.0:
        unknown = np.ones_like(unknown)
    return np.where(unknown, np.median(known) if known.size else 0.0, alt), unknown


def _read_nmea(columns: Columns) -> Readings:
    sentences = columns["sentence"]
    gga = read_gga([str(sentence) for sentence in sentences])
    of_gga = {name: values[gga.row] for name, values in columns.items()}
    known = np.isfinite(gga.separation_m)
    separation = np.where(known, gga.separation_m, np.median(gga.separation_m[known]) if known.any() else 0.0)
    quality = classify_fixes(gga.quality, "gga")
    alt = gga.alt_m + separation
    drops = {
        "broken": gga.broken,
        "no_fix": quality < 0,
        "not_finite": ~np.isfinite(gga.lat_deg + gga.lon_deg + alt),
        "null_island": (gga.lat_deg == 0) & (gga.lon_deg == 0),
        "outside_the_globe": _is_outside(gga.lat_deg, gga.lon_deg),
    }
    without_geoid = len(gga.row) > 0 and not known.any()
    values = _read_gnss(gga.lon_deg, gga.lat_deg, alt, np.full((alt.size, 3), np.nan), quality)
    values["dop"] = np.where(gga.hdop > 0, gga.hdop, 1.0)
    found = _select_rows(of_gga, values, drops)
    others = len(sentences) - len(gga.row)
    own_time_ns = add_date(gga.time_of_day_ns[found.row], found.log_time_ns)
    return Readings(
        gga.row[found.row],
        found.log_time_ns,
        found.header_ns,
        found.columns,
        {**({"not_gga": others} if others else {}), **found.dropped},
        {"without_separation": int(np.count_nonzero(~known[found.row]))},
        (make_finding("geoid-separation-missing", GNSS),) if without_geoid else (),
        own_time_ns,
    )


def find_utc_offset(readings: Readings) -> Findings:
    """Return the finding that the used UTC of a receiver's sentences is further from their headers than a transfer."""
    own_time_ns, stamps_ns = readings.own_time_ns, readings.header_ns
    if own_time_ns is None or stamps_ns is None or not (known := (own_time_ns > 0) & (stamps_ns > 0)).any():
        return ()
    apart_s = float(np.median(own_time_ns[known] - stamps_ns[known])) / 1e9
    if abs(apart_s) <= read_threshold("utc-differs-from-header", "max_offset_s"):
        return ()
    remedies = suggest("header", {"read.time_source": {"gnss": "header"}})
    return (make_finding("utc-differs-from-header", GNSS, offset_s=apart_s, remedies=remedies),)


def _make_ground_velocity(velocity: Floats, variances: Floats, status: AnyArray | int = -1) -> Arrays:
    """Return the columns of velocities east, north, up (N, 3) and their variances."""
    axes = ("east", "north", "up")
    return {
        **{f"{axis}_velocity_mps": velocity[:, i] for i, axis in enumerate(axes)},
        **{f"{axis}_var_m2ps2": variances[:, i] for i, axis in enumerate(axes)},
        "fix_status": np.broadcast_to(status, velocity.shape[:1]).astype(np.int8),
    }


_HELD_COURSE_MPS = 0.3
"""Speed [m/s] below which a receiver repeats or invents a course: the velocity is somewhere on that circle."""
_SLOW_STD_MPS = 0.1


def _compute_course_velocity(speed: Floats, course_rad: Floats, var: Floats) -> tuple[Floats, Floats]:
    """Return velocities east, north (N, 2) from speed [m/s] and course (clockwise from north); variances (N, 2)."""
    slow = speed < _HELD_COURSE_MPS
    velocity = speed[:, None] * np.column_stack((np.sin(course_rad), np.cos(course_rad)))
    circle = speed**2 / 2 + np.where(np.isfinite(var), var, _SLOW_STD_MPS**2)
    return np.where(slow[:, None], 0.0, velocity), np.repeat(np.where(slow, circle, var)[:, None], 2, axis=1)


def _read_velocity_sentences(columns: Columns) -> Readings:
    texts = [str(sentence) for sentence in columns["sentence"]]
    ground_velocity, gga = read_over_ground(texts), read_gga(texts)
    of_velocity = {name: values[ground_velocity.row] for name, values in columns.items()}
    at_ns = of_velocity[LOG_TIME].astype(np.int64)
    time_of_day_ns = ground_velocity.time_of_day_ns
    # VTG has no time: the time of the nearest fix is used.
    if ground_velocity.row.size and gga.row.size and (time_of_day_ns < 0).all():
        beside_ns = columns[LOG_TIME].astype(np.int64)[gga.row]
        after = np.clip(np.searchsorted(beside_ns, at_ns), 1, max(1, gga.row.size - 1))
        before_is_nearer = at_ns - beside_ns[after - 1] <= beside_ns[np.minimum(after, gga.row.size - 1)] - at_ns
        nearest = np.where(before_is_nearer, after - 1, np.minimum(after, gga.row.size - 1))
        near = np.abs(beside_ns[nearest] - at_ns) < _BESIDE_NS
        time_of_day_ns = np.where(near, gga.time_of_day_ns[nearest], -1)
    over_ground, variances = _compute_course_velocity(
        ground_velocity.speed_mps, ground_velocity.course_rad, np.full(ground_velocity.row.size, np.nan)
    )
    unknown = np.full((ground_velocity.row.size, 1), np.nan)
    values = _make_ground_velocity(
        np.hstack((over_ground, unknown)), np.hstack((variances, unknown)), ground_velocity.status
    )
    drops = {
        "broken": ground_velocity.broken,
        "no_fix": ground_velocity.status < 0,
        "not_finite": ~np.isfinite(over_ground.sum(-1)),
    }
    found = _select_rows(
        of_velocity, values, drops, notes={"course_unknown": int((ground_velocity.speed_mps < _HELD_COURSE_MPS).sum())}
    )
    own_time_ns = add_date(time_of_day_ns[found.row], found.log_time_ns)
    others = len(texts) - len(ground_velocity.row)
    dropped = {**({"no_velocity": others} if others else {}), **found.dropped}
    return replace(found, row=ground_velocity.row[found.row], dropped=dropped, own_time_ns=own_time_ns)


_BESIDE_NS = 500_000_000


def _read_gps_fix(columns: Columns) -> Readings:
    speed, climb, err_speed, err_climb, err_track = (
        columns[name].astype(float) if name in columns else np.full(len(columns[LOG_TIME]), np.nan)
        for name in ("speed", "climb", "err_speed", "err_climb", "err_track")
    )
    course = np.radians(columns["track"].astype(float))
    std = np.fmax(
        np.where(err_speed > 0, err_speed, np.nan), np.where(err_track > 0, speed * np.radians(err_track), np.nan)
    )
    over_ground, variances = _compute_course_velocity(speed, course, (std / _STDS_OF_95) ** 2)
    climb_var = np.where(err_climb > 0, (err_climb / _STDS_OF_95) ** 2, np.nan)
    climb = climb if np.any(climb) else np.full_like(climb, np.nan)
    velocity = np.column_stack((over_ground, climb))
    status = columns["status.status"].astype(np.int64) if "status.status" in columns else np.zeros(speed.size, np.int64)
    values = _make_ground_velocity(velocity, np.column_stack((variances, climb_var)), np.clip(status, -1, 2))
    drops = {"no_fix": status < 0, "not_finite": ~np.isfinite(over_ground.sum(-1)) | (speed < 0)}
    return _select_rows(columns, values, drops)


_STDS_OF_95 = 2.0  # gps_common/GPSFix: errors are stated at 95 per cent confidence


def _read_velocity_twist(columns: Columns) -> Readings:
    """Return the linear part as east, north, up, as receivers' drivers write it; without north it is of the body."""
    with_covariance = "twist.twist.linear.x" in columns
    prefix = "twist.twist" if with_covariance else "twist"
    velocity = _read_vector(columns, f"{prefix}.linear")
    variances = _read_variances(columns, "twist.covariance", 0, 7, 14)
    unmeasured = _find_unmeasured(columns, "twist.covariance", np.hstack((velocity, velocity)))[:, :3]
    if "twist.covariance" in columns:
        first = columns["twist.covariance"][:, 0]
        unmeasured[:, 0] = (first == -1) | (first >= _UNMEASURED_VAR)
    of_body = bool(len(velocity) >= _FEWEST_ZEROS and np.any(velocity[:, 0]) and not np.any(velocity[:, 1]))
    velocity[unmeasured[:, 2], 2] = variances[unmeasured[:, 2], 2] = np.nan
    drops = {
        "not_measured": unmeasured[:, :2].any(1) & (not of_body),
        "not_finite": ~np.isfinite(velocity[:, :2].sum(-1)),
        "of_the_body": np.full(len(velocity), of_body),
    }
    findings = (make_finding("velocity-not-over-ground", GNSS_VELOCITY),) if of_body else ()
    return _select_rows(columns, _make_ground_velocity(velocity, variances), drops, findings=findings)


def _read_imu(columns: Columns) -> Readings:
    rate = _read_vector(columns, "angular_velocity")
    force = _read_vector(columns, "linear_acceleration")
    quat, bad = _read_orientation(columns, "orientation")
    absent = _is_absent(columns, "orientation_covariance")
    # A driver without a filter sends one constant orientation; measured digits always change.
    constant = len(quat) > 10 and not absent.any() and bool(np.all(quat == quat[0]))
    quat[absent | constant] = np.nan
    variances = {
        f"{name}_var": np.mean(_read_variances(columns, f"{name}_covariance", 0, 4, 8), axis=-1)
        for name in ("angular_velocity", "linear_acceleration", "orientation")
    }
    variances["orientation_var"][np.isnan(quat[:, 0])] = np.nan
    values = {
        **_name_axes("angular_velocity", "radps", rate),
        **_name_axes("linear_acceleration", "mps2", force),
        **{f"quat_{c}": quat[:, i] for i, c in enumerate("xyzw")},
        **variances,
    }
    drops = {
        "not_measured": _is_absent(columns, "angular_velocity_covariance")
        | _is_absent(columns, "linear_acceleration_covariance"),
        "not_finite": ~np.isfinite(rate.sum(-1) + force.sum(-1)),
    }
    notes = {
        "without_orientation": int(np.count_nonzero(absent)),
        "bad_quaternions": int(np.count_nonzero(bad & ~absent)),
    }
    findings = (make_finding("orientation-constant", Subject("role", "imu")),) if constant else ()
    return _select_rows(columns, values, drops, notes=notes, findings=findings)


_POSE = ("x_m", "y_m", "z_m", "quat_x", "quat_y", "quat_z", "quat_w")


def _read_body_twist(columns: Columns, prefix: str) -> tuple[Arrays, Floats]:
    """Return a twist's columns, null where it is not measured, and the twist as published, shape (N, 6)."""
    linear, angular = _read_vector(columns, f"{prefix}.linear"), _read_vector(columns, f"{prefix}.angular")
    twist = np.concatenate((linear, angular), -1)
    unmeasured = _find_unmeasured(columns, "twist.covariance", twist)
    linear, angular = (np.where(unmeasured[:, part], np.nan, twist[:, part]) for part in (slice(3), slice(3, 6)))
    variances = np.where(
        unmeasured[:, [0, 1, 2, 5]], np.nan, _read_variances(columns, "twist.covariance", 0, 7, 14, 35)
    )
    values = {
        **_name_axes("velocity", "mps", linear),
        **_name_axes("angular_velocity", "radps", angular),
        **_name_axes("velocity_var", "m2ps2", variances),
        "yaw_rate_var": variances[:, 3],
    }
    return values, twist


def _read_odometry(columns: Columns, role: str) -> Readings:
    values, twist = _read_body_twist(columns, "twist.twist")
    position = _read_vector(columns, "pose.pose.position")
    quat, bad = _read_orientation(columns, "pose.pose.orientation")
    pose = np.concatenate((position, quat), -1)
    pose[~np.isfinite(pose).all(-1)] = np.nan
    moved_m = float(np.nansum(np.linalg.norm(np.diff(position, axis=0), axis=-1)))
    empty = not np.any(twist) and moved_m > read_threshold("twist-zero", "min_moved_m")
    findings = (make_finding("twist-zero", Subject("role", role), moved_m=moved_m),) if empty else ()
    if empty:
        values = {name: np.full(len(twist), np.nan) for name in values}
    values |= {name: pose[:, i] for i, name in enumerate(_POSE)}
    lost = np.asarray(np.isnan(pose).any(-1) if empty else ~np.isfinite(twist.sum(-1)))
    notes = {"bad_quaternions": int(np.count_nonzero(bad))}
    return _select_rows(columns, values, {"not_finite": lost}, notes=notes, findings=findings)


def _read_twist_stamped(columns: Columns) -> Readings:
    with_covariance = "twist.twist.linear.x" in columns
    values, twist = _read_body_twist(columns, "twist.twist" if with_covariance else "twist")
    values |= {name: np.full(len(twist), np.nan) for name in _POSE}
    return _select_rows(columns, values, {"not_finite": ~np.isfinite(twist.sum(-1))})


def _read_command(columns: Columns) -> Readings:
    prefix = "twist." if "twist.linear.x" in columns else ""
    forward, yaw_rate = (columns[f"{prefix}{name}"].astype(float) for name in ("linear.x", "angular.z"))
    values: Arrays = {"forward_velocity_mps": forward, "yaw_rate_radps": yaw_rate}
    return _select_rows(columns, values, {"not_finite": ~np.isfinite(forward + yaw_rate)})


def _read_pose(columns: Columns) -> Readings:
    prefix = "pose.pose.position" if "pose.pose.position.x" in columns else "pose.position"
    place, variances = _read_vector(columns, prefix), _read_variances(columns, "pose.covariance", 0, 7, 14, 21, 28, 35)
    quat, bad = _read_orientation(columns, prefix.replace("position", "orientation"))
    if np.all(quat == quat[:1]):  # positions alone
        quat[:] = np.nan
    if np.all(place[:, 2] == place[:1, 2]):  # a map in the plane
        variances[:, 2] = NO_HEIGHT_M2
    values: Arrays = {f"{axis}_m": place[:, i] for i, axis in enumerate("xyz")}
    values |= dict.fromkeys(("lon_deg", "lat_deg", "alt_m"), np.full(len(place), np.nan))
    values |= {f"{axis}_var_m2": variances[:, i] for i, axis in enumerate(("east", "north", "up"))}
    values |= {f"quat_{c}": quat[:, i] for i, c in enumerate("xyzw")}
    values |= {f"rotation_{axis}_var": variances[:, 3 + i] for i, axis in enumerate("xyz")}
    counted = {"without_covariance": np.isnan(variances[:, 0]), "bad_quaternions": bad}
    notes = {name: int(np.count_nonzero(rows)) for name, rows in counted.items()}
    return _select_rows(columns, values, {"not_finite": ~np.isfinite(place.sum(-1))}, notes=notes)


_READERS: dict[tuple[str, str], Callable[[Columns], Readings]] = {
    ("gnss", roles.NAV_SAT_FIX): _read_nav_sat_fix,
    ("gnss", roles.NMEA_SENTENCE): _read_nmea,
    **{
        ("gnss", type_name): lambda columns: _read_nav_sat_fix(convert_gps_fix(columns))
        for type_name in roles.GPS_FIXES
    },
    ("gnss_velocity", roles.NMEA_SENTENCE): _read_velocity_sentences,
    ("gnss_velocity", roles.TWIST_STAMPED): _read_velocity_twist,
    ("gnss_velocity", roles.TWIST_WITH_COVARIANCE_STAMPED): _read_velocity_twist,
    **{("gnss_velocity", type_name): _read_gps_fix for type_name in roles.GPS_FIXES},
    ("imu", roles.IMU): _read_imu,
    ("command", roles.TWIST): _read_command,
    ("command", roles.TWIST_STAMPED): _read_command,
    **{("pose", type_name): _read_pose for type_name in roles.ROLE_TYPES["pose"]},
    **{
        (role, type_name): read
        for role in ("wheel_odometry", "visual_odometry")
        for type_name, read in (
            (roles.ODOMETRY, partial(_read_odometry, role=role)),
            (roles.TWIST_STAMPED, _read_twist_stamped),
            (roles.TWIST_WITH_COVARIANCE_STAMPED, _read_twist_stamped),
        )
    },
}


def select_ground_velocity(readings: Readings, frame: str, topic: str) -> Readings:
    """Return a receiver's velocities; none, with a finding, if their frame is the body's, whose axes are unknown."""
    if not is_base(frame):
        return readings
    remedies = suggest("use", {"read.topics": {"gnss_velocity": [topic]}})
    found = make_finding("velocity-not-over-ground", GNSS_VELOCITY, names={"frame": frame}, remedies=remedies)
    return replace(readings.select(slice(0, 0)), findings=(*readings.findings, found))
