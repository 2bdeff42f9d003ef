"""Measurements as the topics of a Husky: in ROS 1 with the names of husky_base, in ROS 2 of Clearpath's packages."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from tcpipe.arrays import Floats
from tcpipe.formats.logs.message_tables import make_stamp_fields
from tcpipe.formats.logs.writing import MessageStream
from tcpipe.simulation.sensors import (
    Doppler,
    Gnss,
    Imu,
    Joystick,
    Power,
    Reading,
    Sensors,
    Values,
    Visual,
    WheelOdometry,
)

Dialect = Literal["ros1", "ros2"]
PowerType = Literal["husky_status", "clearpath_power"]

_TOPICS = {
    "gnss": ("/navsat/fix", "/a200_0000/sensors/gps_0/fix"),
    "doppler": ("/navsat/fix_velocity", "/a200_0000/sensors/gps_0/fix_velocity"),
    "imu": ("/imu/data", "/a200_0000/sensors/imu_0/data"),
    "wheels": ("/husky_velocity_controller/odom", "/a200_0000/platform/odom"),
    "visual": ("/zed2/zed_node/odom", "/a200_0000/zed/zed_node/odom"),
    "power": ("/status", "/a200_0000/platform/mcu/status/power"),
    "command": ("/husky_velocity_controller/cmd_vel", "/a200_0000/platform/cmd_vel"),
    "tf_static": ("/tf_static", "/a200_0000/tf_static"),
}
TOPICS: dict[Dialect, dict[str, str]] = {
    "ros1": {name: ros1 for name, (ros1, _) in _TOPICS.items()},
    "ros2": {name: ros2 for name, (_, ros2) in _TOPICS.items()},
}
"""Topic names by dialect and sensor."""

_POWER_VALUES = ("voltage_volt", "left_amp", "right_amp", "electronics_amp")
_FRAMES = {"gnss": "gps_link", "imu": "imu_link", "visual": "zed2_camera_center"}


@dataclass(frozen=True, slots=True)
class Recorder:
    """How a drive is recorded."""

    dialect: Dialect
    power: PowerType
    placements: bool = True  # whether /tf_static states the extrinsics of the sensors


def make_streams(readings: Mapping[str, Reading], sensors: Sensors, recorder: Recorder) -> list[MessageStream]:
    """Return the messages of all readings (by sensor: gnss, imu, wheels, visual, power, command), transforms first."""
    topics = TOPICS[recorder.dialect]
    makers: dict[str, Callable[[str, Reading, Any], MessageStream]] = {
        "gnss": _make_gnss, "doppler": _make_doppler, "imu": _make_imu, "wheels": _make_wheels, "visual": _make_visual,
        "power": _make_husky_status if recorder.power == "husky_status" else _make_clearpath_power,
        "command": partial(_make_command, is_stamped=recorder.dialect == "ros2"),
    }  # fmt: skip
    first_ns = min((int(of.log_time_ns[0]) for of in readings.values() if of.log_time_ns.size), default=0)
    placements = [_make_placements(topics["tf_static"], sensors, first_ns)] if recorder.placements else []
    return placements + [makers[name](topics[name], of, getattr(sensors, name)) for name, of in readings.items()]


def _make_stream(
    topic: str, type_name: str, reading: Reading, frame: str, columns: Values, **constants: Any
) -> MessageStream:
    fixed = {"header.frame_id": frame, **{name.replace("__", "."): value for name, value in constants.items()}}
    columns = {"header.seq": np.arange(reading.stamp_ns.size), **make_stamp_fields(reading.stamp_ns), **columns}
    return MessageStream(topic, type_name, reading.log_time_ns, columns, fixed, publish_time_ns=reading.stamp_ns)


def _make_vector(prefix: str, values: Floats, axes: str = "xyz") -> dict[str, Floats]:
    return {f"{prefix}.{axis}": values[:, i] for i, axis in enumerate(axes)}


def _make_gnss(topic: str, reading: Reading, _: Gnss) -> MessageStream:
    values = reading.values
    columns = {"latitude": values["lat_deg"], "longitude": values["lon_deg"], "altitude": values["alt_m"]}
    columns |= {"position_covariance": values["covariance"], "position_covariance_type": values["covariance_type"]}
    columns |= {"status.status": values["status"]}
    return _make_stream(topic, "sensor_msgs/msg/NavSatFix", reading, _FRAMES["gnss"], columns, status__service=1)


def _make_doppler(topic: str, reading: Reading, _: Doppler) -> MessageStream:
    columns = _make_vector("twist.twist.linear", reading.values["velocity_enu_mps"])
    columns |= {"twist.covariance": reading.values["covariance"]}
    return _make_stream(topic, "geometry_msgs/msg/TwistWithCovarianceStamped", reading, _FRAMES["gnss"], columns)


def _make_imu(topic: str, reading: Reading, sensor: Imu) -> MessageStream:
    columns = _make_vector("angular_velocity", reading.values["angular_velocity_radps"])
    columns |= _make_vector("linear_acceleration", reading.values["specific_force_mps2"])
    if sensor.orientation:
        columns |= _make_vector("orientation", reading.values["orientation_xyzw"], "xyzw")
    known = np.diag([1e-4, 1e-4, 1e-2]).ravel() if sensor.orientation else np.array([-1.0, *np.zeros(8)])
    return _make_stream(
        topic, "sensor_msgs/msg/Imu", reading, _FRAMES["imu"], columns,
        orientation__w=1.0, orientation_covariance=known,
        angular_velocity_covariance=np.diag(np.full(3, 1e-5)).ravel(),
        linear_acceleration_covariance=np.diag(np.full(3, 1e-2)).ravel(),
    )  # fmt: skip


def _make_wheels(topic: str, reading: Reading, sensor: WheelOdometry) -> MessageStream:
    values = reading.values
    columns = {"twist.twist.linear.x": values["velocity_mps"], "twist.twist.angular.z": values["yaw_rate_radps"]}
    columns |= {"pose.pose.position.x": values["x_m"], "pose.pose.position.y": values["y_m"]}
    half_rad = values["yaw_rad"] / 2
    columns |= {"pose.pose.orientation.z": np.sin(half_rad), "pose.pose.orientation.w": np.cos(half_rad)}
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
        variances = np.repeat([sensor.std_mps**2, sensor.yaw_rate_std_radps**2], 3)
        constants["twist__covariance"] = known * np.diag(variances).ravel()
    return _make_stream(
        topic, "nav_msgs/msg/Odometry", reading, "odom_visual", columns, child_frame_id=_FRAMES["visual"], **constants
    )


def _make_husky_status(topic: str, reading: Reading, _: Power) -> MessageStream:
    volt, left, right, rest = (reading.values[name] for name in _POWER_VALUES)
    columns = {"battery_voltage": volt, "left_driver_voltage": volt, "right_driver_voltage": volt}
    columns |= {"left_driver_current": left, "right_driver_current": right, "mcu_and_user_port_current": rest}
    columns |= {"uptime": (reading.stamp_ns - reading.stamp_ns[0]) // 1_000_000}
    return _make_stream(topic, "husky_msgs/msg/HuskyStatus", reading, "base_link", columns, ros_control_loop_freq=10.0)


def _make_clearpath_power(topic: str, reading: Reading, _: Power) -> MessageStream:
    volt, left, right, rest = (reading.values[name] for name in _POWER_VALUES)
    columns = {"measured_voltages": np.column_stack([volt, volt, volt])}
    columns |= {"measured_currents": np.column_stack([rest, left, right])}
    kind = "clearpath_platform_msgs/msg/Power"
    return _make_stream(topic, kind, reading, "base_link", columns, battery_connected=1)


def _make_command(topic: str, reading: Reading, _: Joystick, *, is_stamped: bool) -> MessageStream:
    columns = {"linear.x": reading.values["velocity_mps"], "angular.z": reading.values["yaw_rate_radps"]}
    if not is_stamped:
        return MessageStream(topic, "geometry_msgs/msg/Twist", reading.log_time_ns, columns)
    columns = {f"twist.{name}": values for name, values in columns.items()}
    return _make_stream(topic, "geometry_msgs/msg/TwistStamped", reading, "base_link", columns)


def _make_placements(topic: str, sensors: Sensors, log_time_ns: int) -> MessageStream:
    transforms = []
    for name, frame in _FRAMES.items():
        if (sensor := getattr(sensors, name)) is not None:
            translation = dict(zip("xyz", sensor.mounting.xyz_m, strict=True))
            rotation = dict(zip("xyzw", sensor.mounting.quat_xyzw().tolist(), strict=True))
            pose = {"translation": translation, "rotation": rotation}
            transforms.append({"header": {"frame_id": "base_link"}, "child_frame_id": frame, "transform": pose})
    constants = {"transforms": transforms}
    return MessageStream(topic, "tf2_msgs/msg/TFMessage", np.array([log_time_ns]), constants=constants, latched=True)
