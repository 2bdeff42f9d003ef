"""Messages of autopilots as the messages that roles usually have: PX4 (its msg/ directory) and ArduPilot (LogStructure.h of its libraries).

Autopilots count time from boot, and use body axes forward, right, down and north, east, down over ground; here they become forward, left,
up and east, north, up (REP-103). base_link is the origin of the autopilot's body frame.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.logs.field_mapping import MAPPED_TYPES, make_message_fields, utc_from_gps_ns
from tcpipe.logs.messages import GNSS
from tcpipe.logs.roles import GPS_FIXES
from tcpipe.tables.findings import Finding, Subject, make_finding

Floats = NDArray[np.float64]
Int64 = NDArray[np.int64]
Fields = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class AutopilotMessages:
    """Messages of one name: times since boot [µs], shape (N,), and their fields by name."""

    time_us: Int64
    fields: Fields


@dataclass(frozen=True, slots=True)
class RoleMessages:
    """Messages that a role can use: topic, type, times since boot [µs], fields by dotted name, and the sensor's frame."""

    topic: str
    type_name: str
    time_us: Int64
    columns: Mapping[str, NDArray[Any]]
    frame: str


@dataclass(frozen=True, slots=True)
class Autopilot:
    """A log's messages by name; those of instances beside the first are called ``name_1`` …; and the parameters of the autopilot."""

    messages: Mapping[str, AutopilotMessages]
    parameters: Mapping[str, float]

    def find_nearest(self, name: str, time_us: Int64, *, within_us: int) -> Fields:
        """Return the fields of the last messages of a name at each time or before, NaN where that is long ago; {} without any."""
        other = self.messages.get(name)
        if other is None:
            return {}
        row = np.searchsorted(other.time_us, time_us, side="right") - 1
        stale = (row < 0) | (time_us - other.time_us[row] > within_us)
        return {
            name: np.where(stale, np.nan, values[row].astype(np.float64))
            for name, values in other.fields.items()
            if values.ndim == 1 and values.dtype.kind in "fiu"
        }


Convert = Callable[[Autopilot, str, AutopilotMessages], tuple[Int64, Mapping[str, NDArray[Any]]]]


@dataclass(frozen=True, slots=True)
class _Source:
    """Which messages become those of a role: the first of several names that there is, or with ``every`` each of its instances."""

    names: tuple[str, ...]
    topic: str
    role: str
    convert: Convert
    frame: str = ""
    every: bool = False


def make_role_messages(log: Autopilot, kind: str) -> tuple[list[RoleMessages], list[Finding]]:
    """Return what roles can use of a ``ulog`` or ``dataflash`` log, and findings on the messages that lack fields."""
    made: list[RoleMessages] = []
    findings: list[Finding] = []
    for source in _SOURCES[kind]:
        present = [found for name in source.names if (found := _list_instances(log, name))]
        for name in present[0][: None if source.every else 1] if present else ():
            topic = f"/{name}/{source.topic}"
            try:
                time_us, values = source.convert(log, name, log.messages[name])
            except KeyError as error:
                names = {"role": source.role, "fields": str(error.args[0])}
                findings.append(make_finding("fields-missing", Subject("topic", f"/{name}"), names=names))
                continue
            of_fix = "speed" in values
            type_name = GPS_FIXES[1] if of_fix else MAPPED_TYPES[source.role]
            columns = values if of_fix else make_message_fields(source.role, values, len(time_us))
            made.append(RoleMessages(topic, type_name, time_us, columns, source.frame))
    if any(of.type_name == MAPPED_TYPES["gnss"] for of in made) and not _has_ellipsoidal_heights(log, kind):
        findings.append(make_finding("geoid-separation-missing", GNSS))
    return made, findings


def _list_instances(log: Autopilot, name: str) -> list[str]:
    return sorted(found for found in log.messages if re.fullmatch(rf"{name}(_\d+)?", found))


def find_places(parameters: Mapping[str, float]) -> dict[str, tuple[float, float, float]]:
    """Return where sensors are, forward, left and up of base_link [m], by frame, as far as parameters say; all zero says nothing."""
    found = {}
    for frame, prefixes in _PLACES.items():
        for prefix in prefixes:
            forward, right, down = (parameters.get(f"{prefix}_{axis}", 0.0) for axis in "XYZ")
            if frame not in found and (forward, right, down) != (0.0, 0.0, 0.0):
                found[frame] = (forward, -right, -down)
    return found


_PLACES = {"gps": ("EKF2_GPS_POS", "GPS1_POS", "GPS_POS1", "GPS_POS"), "imu": ("EKF2_IMU_POS", "INS_POS1", "INS_POS")}


def find_utc_offset_us(log: Autopilot, kind: str) -> int:
    """Return what a receiver's UTC is ahead of the time since boot [µs], the median over its fixes; 0 where no receiver told the time."""
    name = next((found[0] for of in _RECEIVERS[kind] if (found := _list_instances(log, of))), None)
    if name is None:
        return 0
    fields, time_us = log.messages[name].fields, log.messages[name].time_us
    if kind == "ulog":
        utc_us = fields.get("time_utc_usec", np.zeros(len(time_us))).astype(np.int64)
        told_us = time_us + fields.get("timestamp_time_relative", np.zeros(len(time_us))).astype(np.int64)
    else:  # week and milliseconds of GPS; before 2015 they were called otherwise
        week, ms = fields.get("GWk", fields.get("Week")), fields.get("GMS", fields.get("TimeMS"))
        if week is None or ms is None:
            return 0
        utc_us = utc_from_gps_ns(_GPS_BEGAN_NS + week.astype(np.int64) * _WEEK_NS + ms.astype(np.int64) * 10**6) // 1000
        told_us = time_us
    known = (utc_us > _FIRST_US) & (utc_us < _LAST_US)
    return int(np.median((utc_us - told_us)[known])) if known.any() else 0


_GPS_BEGAN_NS, _WEEK_NS = 315_964_800 * 10**9, 7 * 86_400 * 10**9
_FIRST_US, _LAST_US = 1_100_000_000 * 10**6, 4_000_000_000 * 10**6
"""Receivers count from an epoch of their own until they know the time; no log is of before 2004."""
_RECEIVERS = {"ulog": ("vehicle_gps_position", "sensor_gps"), "dataflash": ("GPS",)}
_STATUS = np.array([-1, -1, 0, 0, 1, 2, 2, -1])
"""NavSatStatus by type of fix: none, none, 2D, 3D, differential, RTK float, RTK fixed; extrapolated ones are no fixes."""
_IN_3D = 3


def _read_status(kind: NDArray[Any]) -> NDArray[np.int64]:
    return _STATUS[np.minimum(kind, len(_STATUS) - 1)]


def _make_axes(
    name: str, forward: NDArray[Any], right: NDArray[Any], down: NDArray[Any], *, known: NDArray[np.bool_]
) -> dict[str, Floats]:
    """Return a vector's components forward, left and up, NaN where it is not known."""
    turned = zip("xyz", (forward, right, down), (1.0, -1.0, -1.0), strict=True)
    return {
        f"{name}_{axis}": np.where(known, sign * values.astype(np.float64), np.nan) for axis, values, sign in turned
    }


# ---------------------------------------------------------------- PX4
def _convert_px4_fix(_log: Autopilot, _name: str, of: AutopilotMessages) -> tuple[Int64, Fields]:
    f, kind = of.fields, of.fields["fix_type"]
    scaled = "latitude_deg" not in f  # until 2023
    lat, lon = (f["lat"] * 1e-7, f["lon"] * 1e-7) if scaled else (f["latitude_deg"], f["longitude_deg"])
    sea, ellipsoid = (
        (f["alt"] * 1e-3, f["alt_ellipsoid"] * 1e-3) if scaled else (f["altitude_msl_m"], f["altitude_ellipsoid_m"])
    )
    height = np.where(kind >= _IN_3D, ellipsoid if np.any(ellipsoid) else sea, np.nan)
    values = {"latitude": lat, "longitude": lon, "altitude": height, "status": _read_status(kind)}
    return of.time_us, values | {"east_std": f["eph"], "north_std": f["eph"], "up_std": f["epv"]}


def _convert_px4_velocity(_log: Autopilot, _name: str, of: AutopilotMessages) -> tuple[Int64, Fields]:
    f = of.fields
    known = (f["vel_ned_valid"] != 0) & (f["fix_type"] >= _IN_3D)
    axes = {"east": f["vel_e_m_s"], "north": f["vel_n_m_s"], "up": -f["vel_d_m_s"]}
    values = {name: np.where(known, values, np.nan) for name, values in axes.items()}
    return of.time_us, values | {f"{name}_std": f["s_variance_m_s"] for name in axes}


def _convert_px4_imu(_log: Autopilot, _name: str, of: AutopilotMessages) -> tuple[Int64, Fields]:
    rate, force = of.fields["gyro_rad"], of.fields["accelerometer_m_s2"]
    known = of.fields["accelerometer_timestamp_relative"] != np.iinfo(np.int32).max
    return of.time_us, {
        **_make_axes("angular_velocity", *rate.T, known=known),
        **_make_axes("linear_acceleration", *force.T, known=known),
    }


def _convert_px4_battery(_log: Autopilot, _name: str, of: AutopilotMessages) -> tuple[Int64, Fields]:
    """Return voltage and current, which BatteryState counts as negative where it is drawn."""
    voltage, current = of.fields["voltage_v"], of.fields["current_a"]
    return of.time_us, {
        "voltage": np.where(voltage > 0, voltage, np.nan),
        "current": np.where(current == -1, np.nan, -current),
    }


def _convert_px4_wheels(log: Autopilot, _name: str, of: AutopilotMessages) -> tuple[Int64, Fields]:
    """Return the mean of both wheels; drivers do not agree which is the left one."""
    radius = log.parameters.get("RDD_WHEEL_RADIUS", log.parameters.get("RD_WHEEL_RADIUS"))
    if radius is None:
        raise KeyError("a wheel radius")
    return of.time_us, {"linear_x": of.fields["wheel_speed"].mean(axis=1) * radius}


_PX4_SPEEDS = {
    "rover_speed_setpoint": "speed_body_x",
    "rover_differential_setpoint": "forward_speed_setpoint",
    "rover_ackermann_setpoint": "forward_speed_setpoint",
    "rover_mecanum_setpoint": "forward_speed_setpoint",
    "differential_drive_setpoint": "speed",
    "trajectory_setpoint": "velocity",
}


def _convert_px4_command(log: Autopilot, name: str, of: AutopilotMessages) -> tuple[Int64, Fields]:
    f = of.fields
    if name == "trajectory_setpoint":
        speed = np.hypot(*f["velocity"].T[:2]) if "velocity" in f else np.hypot(f["vx"], f["vy"])
    else:
        speed = f[_PX4_SPEEDS[name]]
    turn = f | log.find_nearest("rover_rate_setpoint", of.time_us, within_us=_HELD_US)
    right = next(
        (turn[key] for key in ("yaw_rate_setpoint", "yaw_rate", "yawspeed") if key in turn), np.zeros(len(speed))
    )
    return of.time_us, {"linear_x": speed, "angular_z": -np.nan_to_num(right)}


_HELD_US = 1_000_000


# ---------------------------------------------------------------- ArduPilot
def _find_accuracy(log: Autopilot, name: str, of: AutopilotMessages) -> Fields:
    """Return the accuracies that are logged with each fix; 0 means that the receiver does not tell."""
    return log.find_nearest(name.replace("GPS", "GPA"), of.time_us + _BESIDE_US, within_us=2 * _BESIDE_US)


_BESIDE_US = 50_000
_HIGHEST_M = 1e5


def _convert_ardupilot_fix(log: Autopilot, name: str, of: AutopilotMessages) -> tuple[Int64, Fields]:
    f, accuracy = of.fields, _find_accuracy(log, name, of)
    height = accuracy["AEl"] if _has_ellipsoidal_heights(log, "dataflash") else f["Alt"]
    height = np.where((f["Status"] >= _IN_3D) & (np.abs(height) < _HIGHEST_M), height, np.nan)
    values = {"latitude": f["Lat"], "longitude": f["Lng"], "altitude": height, "status": _read_status(f["Status"])}
    if "HAcc" in accuracy:
        values |= {"east_std": accuracy["HAcc"], "north_std": accuracy["HAcc"], "up_std": accuracy["VAcc"]}
    return of.time_us, values


def _convert_ardupilot_velocity(log: Autopilot, name: str, of: AutopilotMessages) -> tuple[Int64, Fields]:
    """Return the fields of GPSFix, which has speed and course; its errors are those of 95 per cent."""
    f, accuracy = of.fields, _find_accuracy(log, name, of)
    unknown = np.full(len(of.time_us), np.nan)
    climbs = accuracy.get("VV", unknown) == 1
    error = 2.0 * accuracy.get("SAcc", unknown)
    return of.time_us, {
        "speed": f["Spd"],
        "track": f["GCrs"],
        "climb": np.where(climbs, -f["VZ"], np.nan),
        "err_speed": error,
        "err_climb": error,
        "status.status": np.where(f["Status"] >= _IN_3D, _read_status(f["Status"]), -1),
    }


def _convert_ardupilot_imu(_log: Autopilot, _name: str, of: AutopilotMessages) -> tuple[Int64, Fields]:
    f = of.fields
    known = (f.get("GH", np.ones(1)) != 0) & (f.get("AH", np.ones(1)) != 0)
    rate, force = (_make_axes(role, *(f[f"{key}{axis}"] for axis in "XYZ"), known=known) for role, key in _IMU.items())
    return of.time_us, rate | force


_IMU = {"angular_velocity": "Gyr", "linear_acceleration": "Acc"}


def _convert_ardupilot_battery(_log: Autopilot, _name: str, of: AutopilotMessages) -> tuple[Int64, Fields]:
    voltage, current = of.fields["Volt"], of.fields["Curr"]
    if voltage.dtype.kind != "f":  # before 2015 in hundredths
        voltage, current = voltage / 100.0, current / 100.0
    return of.time_us, {"voltage": np.where(voltage > 0, voltage, np.nan), "current": -current}


def _convert_ardupilot_wheels(log: Autopilot, _name: str, of: AutopilotMessages) -> tuple[Int64, Fields]:
    """Return speed and turn between two messages from the distances of the wheels, stamped in the middle."""
    said = log.parameters
    sides = [
        side
        for side, of_side in ((0, "WENC"), (1, "WENC2"))
        if said.get(f"{of_side}_TYPE", np.ptp(of.fields[f"Dist{side}"]))
    ]
    step_s = np.diff(of.time_us, prepend=np.nan) * 1e-6
    speed = [np.diff(of.fields[f"Dist{side}"].astype(np.float64), prepend=np.nan) / step_s for side in sides]
    right_m = [said.get(f"{('WENC', 'WENC2')[side]}_POS_Y", 0.0) for side in sides]
    if not sides:
        raise KeyError("a wheel that turns")
    apart_m = right_m[-1] - right_m[0]
    turn = (speed[-1] - speed[0]) / apart_m if apart_m else np.zeros(len(step_s))
    ahead = speed[0] - turn * right_m[0] if apart_m else np.mean(speed, axis=0)
    middle_us = of.time_us - np.nan_to_num(np.round(step_s * 5e5)).astype(np.int64)
    return middle_us, {"linear_x": ahead, "angular_z": turn}


def _convert_ardupilot_command(log: Autopilot, _name: str, of: AutopilotMessages) -> tuple[Int64, Fields]:
    steering = log.find_nearest("STER", of.time_us, within_us=_HELD_US)
    right_deg = np.nan_to_num(steering.get("DesTurnRate", np.zeros(len(of.time_us))))
    return of.time_us, {"linear_x": of.fields["DesSpeed"], "angular_z": -np.radians(right_deg)}


def _has_ellipsoidal_heights(log: Autopilot, kind: str) -> bool:
    """Whether the receiver's heights above the ellipsoid are logged."""
    if kind == "ulog":
        of = [log.messages[name].fields for names in _RECEIVERS[kind] for name in _list_instances(log, names)[:1]]
        return bool(of) and any(np.any(of[0].get(name, 0)) for name in ("alt_ellipsoid", "altitude_ellipsoid_m"))
    accuracy = log.messages.get("GPA")
    return accuracy is not None and bool(np.all(np.abs(accuracy.fields.get("AEl", np.full(1, np.inf))) < _HIGHEST_M))


_BESIDE = {"GPA", "STER", "rover_rate_setpoint"}
_SOURCES: Mapping[str, tuple[_Source, ...]] = {
    "ulog": (
        _Source(_RECEIVERS["ulog"], "fix", "gnss", _convert_px4_fix, "gps"),
        _Source(_RECEIVERS["ulog"], "velocity", "gnss_velocity", _convert_px4_velocity),
        _Source(("sensor_combined",), "imu", "imu", _convert_px4_imu, "imu"),
        _Source(("wheel_encoders",), "odometry", "wheel_odometry", _convert_px4_wheels, "base_link"),
        _Source(("battery_status",), "battery", "power", _convert_px4_battery, every=True),
        _Source(tuple(_PX4_SPEEDS), "command", "command", _convert_px4_command),
    ),
    "dataflash": (
        _Source(("GPS",), "fix", "gnss", _convert_ardupilot_fix, "gps"),
        _Source(("GPS",), "velocity", "gnss_velocity", _convert_ardupilot_velocity),
        _Source(("IMU",), "imu", "imu", _convert_ardupilot_imu, "imu"),
        _Source(("WENC",), "odometry", "wheel_odometry", _convert_ardupilot_wheels, "base_link"),
        _Source(("BAT", "CURR"), "battery", "power", _convert_ardupilot_battery, every=True),
        _Source(("THR",), "command", "command", _convert_ardupilot_command),
    ),
}

CONVERTED = frozenset(name for sources in _SOURCES.values() for source in sources for name in source.names) | _BESIDE
"""Names of messages that are read here."""
