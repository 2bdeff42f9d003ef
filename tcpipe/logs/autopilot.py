"""Messages of autopilots converted to those of roles: PX4 (its msg/ directory) and ArduPilot (LogStructure.h).

Autopilots count time from boot, and use body axes forward, right, down and north, east, down over ground; here they
become forward, left, up and east, north, up (REP-103). base_link is the origin of the autopilot's body frame.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from tcpipe.arrays import Columns, Floats, Ints
from tcpipe.logs.field_mapping import MAPPED_TYPES, make_message_fields, utc_from_gps_ns
from tcpipe.logs.fix_quality import classify_fixes, find_status
from tcpipe.logs.messages import GNSS
from tcpipe.logs.roles import GPS_FIXES
from tcpipe.logs.topics import AutopilotKind
from tcpipe.robots import UNMEASURED_AMP
from tcpipe.tables.findings import Finding, Subject, make_finding

Stamped = tuple[Ints, Columns]
"""Times since boot [µs], shape (N,), and fields by name."""
LeverArms = dict[str, tuple[float, float, float]]


@dataclass(frozen=True, slots=True)
class Autopilot:
    """Log of an autopilot: messages by name (further instances are called ``name_1`` …), and parameters."""

    kind: AutopilotKind
    messages: Mapping[str, Stamped]
    parameters: Mapping[str, float]

    def list_instances(self, name: str) -> list[str]:
        """Return the names of all instances, the first first."""
        return sorted(found for found in self.messages if re.fullmatch(rf"{name}(_\d+)?", found))

    def find_last(self, name: str, at_us: Ints, *, within_us: int) -> Columns:
        """Return the numbers of the last message of a name at or before each time, NaN if old; {} without one."""
        time_us, fields = self.messages.get(name, (None, {}))
        if time_us is None:
            return {}
        row = np.searchsorted(time_us, at_us, side="right") - 1
        stale = (row < 0) | (at_us - time_us[row] > within_us)
        return {
            name: np.where(stale, np.nan, field[row].astype(float)) for name, field in fields.items() if field.ndim == 1
        }


@dataclass(frozen=True, slots=True)
class RoleMessages:
    """A topic for a role: type, times since boot [µs], the message's fields by dotted name, and the sensor's frame."""

    topic: str
    type_name: str
    time_us: Ints
    columns: Columns
    frame: str


def make_role_messages(log: Autopilot) -> tuple[list[RoleMessages], list[Finding]]:
    """Return the topics that roles can use, and findings: messages that lack fields, heights with another zero.

    Of the names of a source the first counts that there is, and of its instances the first; batteries count all.
    """
    made: list[RoleMessages] = []
    findings: list[Finding] = []
    for topic, (names, convert) in _SOURCES[log.kind].items():
        role, frame = _TOPICS[topic]
        present = next((found for name in names.split() if (found := log.list_instances(name))), [])
        for name in present if role == "power" else present[:1]:
            try:
                time_us, values = convert(log, name, *log.messages[name])
                lacking = "" if all(np.shape(value) == time_us.shape for value in values.values()) else "single numbers"
            except (KeyError, ValueError, TypeError) as error:
                lacking = str(error.args[0])
            if lacking:
                what = {"role": role, "fields": lacking}
                findings.append(make_finding("fields-missing", Subject("topic", f"/{name}"), names=what))
                continue
            of_gps_fix = "speed" in values
            type_name = GPS_FIXES[1] if of_gps_fix else MAPPED_TYPES[role]
            columns = values if of_gps_fix else make_message_fields(role, values, len(time_us))
            made.append(RoleMessages(f"/{name}/{topic}", type_name, time_us, columns, frame))
    if any(messages.type_name == MAPPED_TYPES["gnss"] for messages in made) and _find_ellipsoidal(log) is None:
        findings.append(make_finding("geoid-separation-missing", GNSS))
    return made, findings


def select_fields(columns: Columns) -> Columns:
    """Return the fields that can be converted: single numbers, and lists where a list is expected."""
    return {
        name: column
        for name, column in columns.items()
        if column.dtype.kind in "iuf" and (column.ndim == 1 or name in _LISTS)
    }


_LISTS = ("gyro_rad", "accelerometer_m_s2", "wheel_speed")


def find_lever_arms(parameters: Mapping[str, float]) -> LeverArms:
    """Return stated lever arms of sensors by frame: forward, left and up of base_link [m]; all zero is unstated."""
    found: LeverArms = {}
    for frame, prefixes in _LEVER_ARMS.items():
        stated = ([parameters.get(f"{prefix}_{axis}", 0.0) for axis in "XYZ"] for prefix in prefixes.split())
        if frd := next((place for place in stated if any(place) and np.isfinite(place).all()), None):
            found[frame] = (frd[0], -frd[1], -frd[2])
    return found


_LEVER_ARMS = {"gps": "EKF2_GPS_POS GPS1_POS GPS_POS1 GPS_POS", "imu": "EKF2_IMU_POS INS_POS1"}


def find_utc_offset_us(log: Autopilot) -> int:
    """Return a receiver's UTC minus the time since boot [µs], the median over its messages; 0 if it never knew UTC."""
    _, time_us, fields = _find_receiver(log)
    if "time_utc_usec" in fields:
        utc_us = fields["time_utc_usec"].astype(np.int64)
        time_us = time_us + fields.get("timestamp_time_relative", np.zeros(1)).astype(np.int64)
    else:  # week and milliseconds of GPS, which had other names before 2015
        week, ms = (fields.get(new, fields.get(old, np.zeros(1))).astype(np.int64) for new, old in _GPS_TIME)
        utc_us = utc_from_gps_ns((_GPS_BEGAN_MS + week * _WEEK_MS + ms) * 10**6) // 1000
    known = (utc_us > _FIRST_US) & (utc_us < LATEST_US)
    return int(np.median((utc_us - time_us)[known])) if known.any() else 0


_GPS_TIME = (("GWk", "Week"), ("GMS", "TimeMS"))
_GPS_BEGAN_MS, _WEEK_MS = 315_964_800_000, 7 * 86_400_000
_FIRST_US, LATEST_US = 1_100_000_000 * 10**6, 4_000_000_000 * 10**6
"""First and last valid time [s]: receivers without time count from their own epoch."""


_RECEIVERS = "vehicle_gps_position sensor_gps GPS"


def _find_receiver(log: Autopilot) -> tuple[str, Ints, Columns]:
    """Return the name and messages of the first receiver; without any one message at time 0 that has no fields."""
    names = [found for name in _RECEIVERS.split() for found in log.list_instances(name)]
    return (names[0], *log.messages[names[0]]) if names else ("", np.zeros(1, np.int64), {})


def _find_ellipsoidal(log: Autopilot) -> Floats | None:
    """Return a receiver's heights above the ellipsoid [m]; None if not logged: all 0, or a number for unknown."""
    name, time_us, fields = _find_receiver(log)
    known = {**fields, **_find_accuracy(log, name, time_us)}
    scales = {"altitude_ellipsoid_m": 1.0, "alt_ellipsoid": 1e-3, "AEl": 1.0}
    heights = next((known[name] * scale for name, scale in scales.items() if name in known), np.zeros(1))
    return heights if np.any(heights) and not np.any(np.abs(heights) > _HIGHEST_M) else None


_HIGHEST_M = 1e5
_IN_3D, _RTK_FIXED = 3, 6
"""Types of fixes; those beyond are no measurements."""


def _make_fix(log: Autopilot, kind: Ints, sea_m: Floats) -> Columns:
    """Return quality and height of fixes: above the ellipsoid where that is logged; a fix in the plane has none."""
    ellipsoidal = _find_ellipsoidal(log)
    height = np.where(kind >= _IN_3D, sea_m if ellipsoidal is None else ellipsoidal, np.nan)
    return {"quality": _find_quality(kind), "altitude": height}


def _find_quality(kind: Ints) -> Floats:
    return classify_fixes(np.where(kind > _RTK_FIXED, 0, kind), "mavlink")


def _turn_axes(name: str, forward: Floats, right: Floats, down: Floats) -> dict[str, Floats]:
    """Return a vector's components forward, left and up."""
    return {f"{name}_x": forward.astype(float), f"{name}_y": -right.astype(float), f"{name}_z": -down.astype(float)}


# ---------------------------------------------------------------- PX4
def _convert_px4_fix(log: Autopilot, _name: str, time_us: Ints, f: Columns) -> Stamped:
    if "latitude_deg" in f:
        lat, lon, sea = f["latitude_deg"], f["longitude_deg"], f["altitude_msl_m"]
    else:  # until 2023
        lat, lon, sea = f["lat"] * 1e-7, f["lon"] * 1e-7, f["alt"] * 1e-3
    accuracy = {"east_std": f["eph"], "north_std": f["eph"], "up_std": f["epv"]}
    return time_us, {"latitude": lat, "longitude": lon, **_make_fix(log, f["fix_type"], sea), **accuracy}


def _convert_px4_velocity(_log: Autopilot, _name: str, time_us: Ints, f: Columns) -> Stamped:
    known = (f["vel_ned_valid"] != 0) & (f["fix_type"] >= _IN_3D)
    axes = {"east": f["vel_e_m_s"], "north": f["vel_n_m_s"], "up": -f["vel_d_m_s"]}
    values = {name: np.where(known, axis, np.nan) for name, axis in axes.items()}
    return time_us, values | {f"{name}_std": f["s_variance_m_s"] for name in axes}


def _convert_px4_imu(_log: Autopilot, _name: str, time_us: Ints, f: Columns) -> Stamped:
    unknown = f["accelerometer_timestamp_relative"] == np.iinfo(np.int32).max
    force = np.where(unknown[:, None], np.nan, f["accelerometer_m_s2"])
    return time_us, _turn_axes("angular_velocity", *f["gyro_rad"].T) | _turn_axes("linear_acceleration", *force.T)


def _convert_px4_battery(_log: Autopilot, _name: str, time_us: Ints, f: Columns) -> Stamped:
    voltage, current = f["voltage_v"], f["current_a"]
    # A drawn current is negative in BatteryState.
    current_amp = np.where(np.isin(current, UNMEASURED_AMP["battery_status"]), np.nan, -current)
    return time_us, {"voltage": np.where(voltage > 0, voltage, np.nan), "current": current_amp}


def _convert_px4_wheels(log: Autopilot, _name: str, time_us: Ints, f: Columns) -> Stamped:
    """Return the mean of both wheels: drivers do not agree which is the left one."""
    if "RDD_WHEEL_RADIUS" not in log.parameters:
        raise KeyError("a wheel radius (RDD_WHEEL_RADIUS)")
    return time_us, {"linear_x": f["wheel_speed"].mean(axis=1) * log.parameters["RDD_WHEEL_RADIUS"]}


def _convert_px4_command(log: Autopilot, _name: str, time_us: Ints, f: Columns) -> Stamped:
    speed = f[next((name for name in _PX4_SPEEDS if name in f), _PX4_SPEEDS[0])]
    turn = {**log.find_last("rover_rate_setpoint", time_us, within_us=_HELD_US), **f}
    right = next((turn[name] for name in ("yaw_rate_setpoint", "yaw_rate") if name in turn), 0.0 * speed)
    return time_us, {"linear_x": speed, "angular_z": -np.nan_to_num(right)}


_PX4_SPEEDS = ("speed_body_x", "forward_speed_setpoint", "speed")
_HELD_US = 1_000_000


# ---------------------------------------------------------------- ArduPilot
def _find_accuracy(log: Autopilot, name: str, time_us: Ints) -> Columns:
    """Return the accuracies that are logged beside each fix."""
    return log.find_last(name.replace("GPS", "GPA"), time_us + _BESIDE_US, within_us=2 * _BESIDE_US)


_BESIDE_US = 50_000


def _convert_ardupilot_fix(log: Autopilot, name: str, time_us: Ints, f: Columns) -> Stamped:
    values = {"latitude": f["Lat"], "longitude": f["Lng"], **_make_fix(log, f["Status"], f["Alt"])}
    if accuracy := _find_accuracy(log, name, time_us):
        values |= {"east_std": accuracy["HAcc"], "north_std": accuracy["HAcc"], "up_std": accuracy["VAcc"]}
    return time_us, values


def _convert_ardupilot_velocity(log: Autopilot, name: str, time_us: Ints, f: Columns) -> Stamped:
    """Return the fields of GPSFix, which has speed and course; its errors are those of 95 per cent."""
    accuracy, unknown = _find_accuracy(log, name, time_us), np.full(len(time_us), np.nan)
    error = 2.0 * accuracy.get("SAcc", unknown)
    climb = np.where(accuracy.get("VV", unknown) == 1, -f["VZ"], np.nan)
    status = find_status(_find_quality(np.where(f["Status"] >= _IN_3D, f["Status"], 0)))
    values = {"speed": f["Spd"], "track": f["GCrs"], "climb": climb, "err_speed": error, "err_climb": error}
    return time_us, {**values, "status.status": status}


def _convert_ardupilot_imu(_log: Autopilot, _name: str, time_us: Ints, f: Columns) -> Stamped:
    broken = (f.get("GH", 1) == 0) | (f.get("AH", 1) == 0)
    rate, force = ([np.where(broken, np.nan, f[f"{sensor}{axis}"]) for axis in "XYZ"] for sensor in ("Gyr", "Acc"))
    return time_us, _turn_axes("angular_velocity", *rate) | _turn_axes("linear_acceleration", *force)


def _convert_ardupilot_battery(_log: Autopilot, _name: str, time_us: Ints, f: Columns) -> Stamped:
    scale = 1.0 if f["Volt"].dtype.kind == "f" else 0.01  # before 2015 in hundredths
    voltage, current_amp = f["Volt"] * scale, f["Curr"] * -scale
    return time_us, {"voltage": np.where(voltage > 0, voltage, np.nan), "current": current_amp}


def _convert_ardupilot_wheels(log: Autopilot, _name: str, time_us: Ints, f: Columns) -> Stamped:
    """Return speed and turn between two messages from the distances of the wheels, stamped in the middle."""
    step_s = np.diff(time_us, prepend=np.nan) * 1e-6
    speed, right_m = list[Floats](), list[float]()
    for distance_m, prefix in ((f["Dist0"], "WENC"), (f["Dist1"], "WENC2")):
        if log.parameters.get(f"{prefix}_TYPE", np.ptp(distance_m)):
            speed.append(np.diff(distance_m.astype(float), prepend=np.nan) / step_s)
            right_m.append(log.parameters.get(f"{prefix}_POS_Y", 0.0))
    if not speed or (len(speed) == 1 and right_m != [0.0]):
        raise KeyError("a second wheel")
    apart_m = right_m[-1] - right_m[0]
    turn = (speed[-1] - speed[0]) / apart_m if apart_m else 0.0 * step_s
    ahead = speed[0] - turn * right_m[0] if apart_m else np.mean(speed, axis=0)
    return time_us - np.nan_to_num(step_s * 5e5).astype(np.int64), {"linear_x": ahead, "angular_z": turn}


def _convert_ardupilot_command(log: Autopilot, _name: str, time_us: Ints, f: Columns) -> Stamped:
    steering = log.find_last("STER", time_us, within_us=_HELD_US)
    turn = -np.radians(np.nan_to_num(steering.get("DesTurnRate", np.zeros(len(time_us)))))
    return time_us, {"linear_x": f["DesSpeed"], "angular_z": turn}


_Convert = Callable[[Autopilot, str, Ints, Columns], Stamped]
_PX4_COMMANDS = """rover_speed_setpoint rover_differential_setpoint rover_ackermann_setpoint rover_mecanum_setpoint
differential_drive_setpoint"""
_TOPICS = {
    "fix": ("gnss", "gps"),
    "velocity": ("gnss_velocity", ""),
    "imu": ("imu", "imu"),
    "odometry": ("wheel_odometry", "base_link"),
    "battery": ("power", ""),
    "command": ("command", ""),
}
"""Role and frame of converted messages, by the last part of their topic."""
_SOURCES: dict[str, dict[str, tuple[str, _Convert]]] = {
    "ulog": {
        "fix": (_RECEIVERS, _convert_px4_fix),
        "velocity": (_RECEIVERS, _convert_px4_velocity),
        "imu": ("sensor_combined", _convert_px4_imu),
        "odometry": ("wheel_encoders", _convert_px4_wheels),
        "battery": ("battery_status", _convert_px4_battery),
        "command": (_PX4_COMMANDS, _convert_px4_command),
    },
    "dataflash": {
        "fix": (_RECEIVERS, _convert_ardupilot_fix),
        "velocity": (_RECEIVERS, _convert_ardupilot_velocity),
        "imu": ("IMU", _convert_ardupilot_imu),
        "odometry": ("WENC", _convert_ardupilot_wheels),
        "battery": ("BAT CURR", _convert_ardupilot_battery),
        "command": ("THR", _convert_ardupilot_command),
    },
}
"""Names of messages, best first, and how they are converted, by autopilot and topic."""

_BESIDE = "GPA STER rover_rate_setpoint"
CONVERTED = {name for sources in _SOURCES.values() for names, _ in sources.values() for name in names.split()} | {
    *_BESIDE.split()
}
"""Names of messages that are read here."""
