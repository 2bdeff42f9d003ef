"""Readings as the topics a Husky records: ROS 1 as husky_base names them, ROS 2 as clearpath's packages do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.formats.logs.writing import MessageStream
from tcpipe.simulation.sensors import Doppler, Gnss, Imu, Mounting, Power, Reading, Sensors, Values, Visual, Wheels

Dialect = Literal["ros1", "ros2"]
PowerType = Literal["husky_status", "clearpath_power", "battery_state", "battery_states"]

TOPICS: dict[Dialect, dict[str, str]] = {
    "ros1": {
        "gnss": "/navsat/fix",
        "doppler": "/navsat/fix_velocity",
        "imu": "/imu/data",
        "wheels": "/husky_velocity_controller/odom",
        "visual": "/zed2/zed_node/odom",
        "power": "/status",
        "command": "/husky_velocity_controller/cmd_vel",
        "tf_static": "/tf_static",
    },
    "ros2": {
        "gnss": "/a200_0000/sensors/gps_0/fix",
        "doppler": "/a200_0000/sensors/gps_0/fix_velocity",
        "imu": "/a200_0000/sensors/imu_0/data",
        "wheels": "/a200_0000/platform/odom",
        "visual": "/a200_0000/zed/zed_node/odom",
        "power": "/a200_0000/platform/mcu/status/power",
        "command": "/a200_0000/platform/cmd_vel",
        "tf_static": "/a200_0000/tf_static",
    },
}
"""Topic names by dialect and sensor."""

_FRAMES = {"gnss": "gps_link", "imu": "imu_link", "visual": "zed2_camera_center"}


@dataclass(frozen=True, slots=True)
class Recorder:
    """How a drive is recorded."""

    dialect: Dialect
    power: PowerType
    gnss: Literal["fix", "nmea"] = "fix"
    """NavSatFix, or GGA sentences."""
    placements: bool = True
    """Whether /tf_static states the extrinsics of the sensors."""


def make_streams(
    readings: Mapping[str, Reading], sensors: Sensors, recorder: Recorder, *, geoid_m: float
) -> list[MessageStream]:
    """Return the messages of all readings (by sensor: gnss, imu, wheels, visual, power, command), transforms first."""
    topics = TOPICS[recorder.dialect]
    first_ns = min(
        (int(reading.log_time_ns[0]) for reading in readings.values() if reading.log_time_ns.size), default=0
    )
    made = [_make_placements(topics["tf_static"], sensors, first_ns)] if recorder.placements else []
    for name, reading in readings.items():
        made += _make_messages(topics[name], reading, getattr(sensors, name), recorder, geoid_m)
    return made


def _make_messages(
    topic: str, reading: Reading, sensor: object, recorder: Recorder, geoid_m: float
) -> list[MessageStream]:
    match sensor:
        case Gnss():
            made = [_make_gnss(topic, reading) if recorder.gnss == "fix" else _make_nmea(reading, geoid_m)]
        case Doppler():
            made = [_make_doppler(topic, reading)]
        case Imu():
            made = [_make_imu(topic, reading, sensor)]
        case Wheels():
            made = [_make_wheels(topic, reading, sensor)]
        case Visual():
            made = [_make_visual(topic, reading, sensor)]
        case Power():
            made = _make_power(topic, reading, recorder.power)
        case _:
            made = [_make_command(topic, reading, recorder.dialect)]
    return made


def _make_stream(
    topic: str, type_name: str, reading: Reading, frame: str, columns: Values, **constants: Any
) -> MessageStream:
    columns = {**_make_header(reading.stamp_ns), **columns}
    fixed = {"header.frame_id": frame, **{name.replace("__", "."): value for name, value in constants.items()}}
    return MessageStream(topic, type_name, reading.log_time_ns, columns, fixed, publish_time_ns=reading.stamp_ns)


def _make_header(stamp_ns: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    sec, nanosec = np.divmod(stamp_ns, 1_000_000_000)
    return {"header.seq": np.arange(stamp_ns.size), "header.stamp.sec": sec, "header.stamp.nanosec": nanosec}


def _make_vector(prefix: str, values: NDArray[np.float64], axes: str = "xyz") -> dict[str, NDArray[np.float64]]:
    return {f"{prefix}.{axis}": values[:, i] for i, axis in enumerate(axes)}


def _make_gnss(topic: str, reading: Reading) -> MessageStream:
    values = reading.values
    columns = {"latitude": values["lat_deg"], "longitude": values["lon_deg"], "altitude": values["alt_m"]}
    columns |= {"position_covariance": values["covariance"], "position_covariance_type": values["covariance_type"]}
    columns |= {"status.status": values["status"]}
    return _make_stream(topic, "sensor_msgs/msg/NavSatFix", reading, _FRAMES["gnss"], columns, status__service=1)


def _make_doppler(topic: str, reading: Reading) -> MessageStream:
    columns = _make_vector("twist.twist.linear", reading.values["velocity_enu_mps"])
    columns |= {"twist.covariance": reading.values["covariance"]}
    return _make_stream(topic, "geometry_msgs/msg/TwistWithCovarianceStamped", reading, _FRAMES["gnss"], columns)


def _make_nmea(reading: Reading, geoid_m: float) -> MessageStream:
    """Return GGA sentences of fixed length; fixes that are none are left out."""
    kept = np.flatnonzero(reading.values["status"] >= 0)
    lon, lat, alt = (reading.values[name][kept].tolist() for name in ("lon_deg", "lat_deg", "alt_m"))
    fixes = zip(reading.stamp_ns[kept].tolist(), lat, lon, alt, strict=True)
    sentences = [_format_gga(stamp_ns, *place, geoid_m=geoid_m) for stamp_ns, *place in fixes]
    said = Reading(reading.stamp_ns[kept], reading.log_time_ns[kept], {})
    columns = {"sentence": np.array(sentences, "S")}
    return _make_stream("/nmea_sentence", "nmea_msgs/msg/Sentence", said, _FRAMES["gnss"], columns)


def _format_gga(stamp_ns: int, lat_deg: float, lon_deg: float, alt_m: float, *, geoid_m: float) -> str:
    seconds, rest = divmod(stamp_ns % 86_400_000_000_000, 1_000_000_000)
    clock = f"{seconds // 3600:02d}{seconds // 60 % 60:02d}{seconds % 60:02d}.{rest // 1_000_000:03d}"
    lat = f"{int(abs(lat_deg)):02d}{abs(lat_deg) % 1 * 60:010.7f},{'N' if lat_deg >= 0 else 'S'}"
    lon = f"{int(abs(lon_deg)):03d}{abs(lon_deg) % 1 * 60:010.7f},{'E' if lon_deg >= 0 else 'W'}"
    body = f"GNGGA,{clock},{lat},{lon},4,14,0.7,{alt_m - geoid_m:09.4f},M,{geoid_m:07.3f},M,1.0,0001"
    checksum = 0
    for byte in body.encode():
        checksum ^= byte
    return f"${body}*{checksum:02X}"


def _make_imu(topic: str, reading: Reading, sensor: Imu) -> MessageStream:
    columns = _make_vector("angular_velocity", reading.values["angular_velocity_radps"])
    columns |= _make_vector("linear_acceleration", reading.values["specific_force_mps2"])
    if sensor.orientation:
        columns |= _make_vector("orientation", reading.values["orientation_xyzw"], "xyzw")
    known = np.diag([1e-4, 1e-4, 1e-2]).ravel() if sensor.orientation else np.array([-1.0, *np.zeros(8)])
    return _make_stream(
        topic, "sensor_msgs/msg/Imu", reading, _FRAMES["imu"], columns,
        orientation__w=1.0,
        orientation_covariance=known,
        angular_velocity_covariance=np.diag(np.full(3, 1e-5)).ravel(),
        linear_acceleration_covariance=np.diag(np.full(3, 1e-2)).ravel(),
    )  # fmt: skip


def _make_wheels(topic: str, reading: Reading, sensor: Wheels) -> MessageStream:
    values = reading.values
    columns = {"twist.twist.linear.x": values["velocity_mps"], "twist.twist.angular.z": values["yaw_rate_radps"]}
    columns |= {"pose.pose.position.x": values["x_m"], "pose.pose.position.y": values["y_m"]}
    columns |= {
        "pose.pose.orientation.z": np.sin(values["yaw_rad"] / 2),
        "pose.pose.orientation.w": np.cos(values["yaw_rad"] / 2),
    }
    known = sensor.covariance == "known"
    twist = known * np.diag([sensor.std_mps**2, 1e-3, 1e6, 1e6, 1e6, sensor.yaw_rate_std_radps**2]).ravel()
    pose = known * np.diag([1e-3, 1e-3, 1e6, 1e6, 1e6, 1e-3]).ravel()
    return _make_stream(
        topic, "nav_msgs/msg/Odometry", reading, "odom", columns,
        child_frame_id="base_link", twist__covariance=twist, pose__covariance=pose,
    )  # fmt: skip


def _make_visual(topic: str, reading: Reading, sensor: Visual) -> MessageStream:
    columns = _make_vector("pose.pose.position", reading.values["position_m"])
    columns |= _make_vector("pose.pose.orientation", reading.values["orientation_xyzw"], "xyzw")
    known = sensor.covariance == "known"
    constants: Values = {"pose__covariance": known * np.diag(np.full(6, 1e-2)).ravel()}
    if sensor.says == "twist":
        columns |= _make_vector("twist.twist.linear", reading.values["linear_mps"])
        columns |= _make_vector("twist.twist.angular", reading.values["angular_radps"])
        constants["twist__covariance"] = (
            known * np.diag([*[sensor.std_mps**2] * 3, *[sensor.yaw_rate_std_radps**2] * 3]).ravel()
        )
    return _make_stream(
        topic, "nav_msgs/msg/Odometry", reading, "odom_visual", columns, child_frame_id=_FRAMES["visual"], **constants
    )


def _make_power(topic: str, reading: Reading, power: PowerType) -> list[MessageStream]:
    values = reading.values
    volt, left, right, rest = (values[name] for name in ("voltage_volt", "left_amp", "right_amp", "electronics_amp"))
    columns: Values
    if power == "husky_status":
        columns = {"battery_voltage": volt, "left_driver_voltage": volt, "right_driver_voltage": volt}
        columns |= {"left_driver_current": left, "right_driver_current": right, "mcu_and_user_port_current": rest}
        columns |= {"uptime": (reading.stamp_ns - reading.stamp_ns[0]) // 1_000_000}
        kind, constants = "husky_msgs/msg/HuskyStatus", {"ros_control_loop_freq": 10.0}
        return [_make_stream(topic, kind, reading, "base_link", columns, **constants)]
    if power == "clearpath_power":
        columns = {"measured_voltages": np.column_stack([volt, volt, volt])}
        columns |= {"measured_currents": np.column_stack([rest, left, right])}
        kind = "clearpath_platform_msgs/msg/Power"
        return [_make_stream(topic, kind, reading, "base_link", columns, battery_connected=1)]
    currents = {"/left_drive/battery_state": left, "/right_drive/battery_state": right}
    if power == "battery_state":
        currents = {"/battery_state": -(left + right)}  # REP-147: negative when discharging
    kind = "sensor_msgs/msg/BatteryState"
    return [
        _make_stream(name, kind, reading, "base_link", {"voltage": volt, "current": amp}, present=True)
        for name, amp in currents.items()
    ]


def _make_command(topic: str, reading: Reading, dialect: Dialect) -> MessageStream:
    velocity, yaw_rate = reading.values["velocity_mps"], reading.values["yaw_rate_radps"]
    if dialect == "ros2":
        columns = {"twist.linear.x": velocity, "twist.angular.z": yaw_rate}
        return _make_stream(topic, "geometry_msgs/msg/TwistStamped", reading, "base_link", columns)
    columns = {"linear.x": velocity, "angular.z": yaw_rate}
    return MessageStream(topic, "geometry_msgs/msg/Twist", reading.log_time_ns, columns)


def _make_placements(topic: str, sensors: Sensors, log_time_ns: int) -> MessageStream:
    placed: list[tuple[str, Mounting]] = [
        (_FRAMES[name], sensor.mounting)
        for name, sensor in (("gnss", sensors.gnss), ("imu", sensors.imu), ("visual", sensors.visual))
        if sensor is not None
    ]
    transforms = [_transform(frame, mounting) for frame, mounting in placed]
    return MessageStream(
        topic, "tf2_msgs/msg/TFMessage", np.array([log_time_ns]), constants={"transforms": transforms}, latched=True
    )


def _transform(frame: str, mounting: Mounting) -> dict[str, Any]:
    translation = dict(zip("xyz", mounting.xyz_m, strict=True))
    rotation = dict(zip("xyzw", mounting.quat_xyzw().tolist(), strict=True))
    return {
        "header": {"frame_id": "base_link"},
        "child_frame_id": frame,
        "transform": {"translation": translation, "rotation": rotation},
    }
