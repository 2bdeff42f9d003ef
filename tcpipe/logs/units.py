"""Units of message fields: what REP-103 and the definitions' own comments say, by message type and field.

A definition's text states its units in comments that no program reads; here they are once, for the types a ground robot's log is made of.
What is not listed has no unit that is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from tcpipe.logs.wire_types import Array, Record, WireType

_TIME = {"sec": "s", "nanosec": "ns"}
_XYZ = dict.fromkeys("xyz", "m")
_JACKAL_STATUS = {
    "mcu_temperature": "degC",
    **dict.fromkeys(("measured_battery", "measured_48v", "measured_24v", "measured_12v", "measured_5v"), "V"),
    **dict.fromkeys(("drive_current", "user_current", "computer_current", "total_current", "total_current_peak"), "A"),
    **dict.fromkeys(("current_battery", "current_48v", "current_24v", "current_12v"), "A"),
    **dict.fromkeys(("current_computer", "current_battery_peak"), "A"),
    "total_power_consumed": "W h",
}
_RAILS = {"measured_voltages": "V", "measured_currents": "A"}
_LASER = {
    **dict.fromkeys(("angle_min", "angle_max", "angle_increment"), "rad"),
    **dict.fromkeys(("time_increment", "scan_time"), "s"),
    **dict.fromkeys(("range_min", "range_max", "ranges"), "m"),
}

UNITS: Mapping[str, Mapping[str, str]] = {
    "builtin_interfaces/msg/Time": _TIME,
    "builtin_interfaces/msg/Duration": _TIME,
    "geometry_msgs/msg/Point": _XYZ,
    "geometry_msgs/msg/Point32": _XYZ,
    "geometry_msgs/msg/Pose2D": {"x": "m", "y": "m", "theta": "rad"},
    "geometry_msgs/msg/Quaternion": dict.fromkeys("xyzw", "1"),
    "geometry_msgs/msg/Transform": {"translation": "m"},
    "geometry_msgs/msg/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/msg/Accel": {"linear": "m/s2", "angular": "rad/s2"},
    "geometry_msgs/msg/Wrench": {"force": "N", "torque": "N m"},
    "geometry_msgs/msg/Inertia": {
        "m": "kg",
        "com": "m",
        **dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "kg m2"),
    },
    "geometry_msgs/msg/PoseWithCovariance": {"covariance": "m2, m rad, rad2"},
    "geometry_msgs/msg/TwistWithCovariance": {"covariance": "m2/s2, m rad/s2, rad2/s2"},
    "geometry_msgs/msg/AccelWithCovariance": {"covariance": "m2/s4, m rad/s4, rad2/s4"},
    "nav_msgs/msg/MapMetaData": {"resolution": "m"},
    "sensor_msgs/msg/Imu": {
        "orientation_covariance": "rad2",
        "angular_velocity": "rad/s",
        "angular_velocity_covariance": "rad2/s2",
        "linear_acceleration": "m/s2",
        "linear_acceleration_covariance": "m2/s4",
    },
    "sensor_msgs/msg/NavSatFix": {"latitude": "deg", "longitude": "deg", "altitude": "m", "position_covariance": "m2"},
    "sensor_msgs/msg/BatteryState": {
        "voltage": "V",
        "current": "A",
        "temperature": "degC",
        **dict.fromkeys(("charge", "capacity", "design_capacity"), "A h"),
        "percentage": "1",
        "cell_voltage": "V",
        "cell_temperature": "degC",
    },
    "sensor_msgs/msg/JointState": {"position": "rad or m", "velocity": "rad/s or m/s", "effort": "N m or N"},
    "sensor_msgs/msg/MagneticField": {"magnetic_field": "T", "magnetic_field_covariance": "T2"},
    "sensor_msgs/msg/Temperature": {"temperature": "degC", "variance": "degC2"},
    "sensor_msgs/msg/FluidPressure": {"fluid_pressure": "Pa", "variance": "Pa2"},
    "sensor_msgs/msg/RelativeHumidity": {"relative_humidity": "1", "variance": "1"},
    "sensor_msgs/msg/Illuminance": {"illuminance": "lx", "variance": "lx2"},
    "sensor_msgs/msg/Range": {
        "field_of_view": "rad",
        **dict.fromkeys(("min_range", "max_range", "range"), "m"),
        "variance": "m2",
    },
    "sensor_msgs/msg/LaserScan": _LASER,
    "sensor_msgs/msg/MultiEchoLaserScan": _LASER,
    "husky_msgs/msg/HuskyStatus": {
        "uptime": "ms",
        "ros_control_loop_freq": "Hz",
        **dict.fromkeys(("mcu_and_user_port_current", "left_driver_current", "right_driver_current"), "A"),
        **dict.fromkeys(("battery_voltage", "left_driver_voltage", "right_driver_voltage"), "V"),
        **dict.fromkeys(("left_driver_temp", "right_driver_temp", "left_motor_temp", "right_motor_temp"), "degC"),
        "capacity_estimate": "W h",
        "charge_estimate": "%",
    },
    "clearpath_platform_msgs/msg/Power": _RAILS,
    "jackal_msgs/msg/Power": _RAILS,
    "jackal_msgs/msg/Status": _JACKAL_STATUS,
    "warthog_msgs/msg/Status": _JACKAL_STATUS,
}
"""Unit by message type and field; that of a nested message holds for all its numbers."""


def field_units(of: Record) -> dict[str, str]:
    """Return the unit of every number of a message of which it is known, by dotted name; elements of arrays by their array's name.

    The outermost type that names a field rules: a ``Vector3`` has no unit of its own, inside a ``Twist`` it has.
    """
    return dict(_units(of, "", ()))


def _units(of: WireType, name: str, within: tuple[tuple[str, str], ...]) -> Iterator[tuple[str, str]]:
    """Yield (name, unit) below ``name``; ``within`` holds those types around it that have units, and the name inside each."""
    if isinstance(of, Array):
        of = of.element
    if isinstance(of, Record):
        for field, inner in of.fields:
            around = tuple((kind, f"{path}.{field}") for kind, path in within)
            if of.name in UNITS:
                around += ((of.name, field),)
            yield from _units(inner, f"{name}.{field}" if name else field, around)
        return
    units = (UNITS.get(kind, {}).get(part) for kind, path in within for part in _beginnings(path))
    unit = next((unit for unit in units if unit is not None), None)
    if unit is not None:
        yield name, unit


def _beginnings(path: str) -> Iterator[str]:
    """Yield a dotted name and what it begins with, the longest first."""
    parts = path.split(".")
    return (".".join(parts[:count]) for count in range(len(parts), 0, -1))
