"""Twenty drives, each with one fault of a sensor or of what the log says of it, and the code under which tcpipe finds it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from changed_drives import NAMES, Columns, Drive

from tcpipe.formats.logs.writing import MessageStream, write_mcap
from tcpipe.simulation import Faults, find_scenario
from tcpipe.simulation.route import Wander
from tcpipe.simulation.site_files import simulate_messages

NOISE = ("gnss_noise", "wheel_noise", "imu_noise", "visual_noise", "power_noise", "gnss_lever_arm", "imu_mounting")
LENGTH_M = 50.0
SHORT_M = 35.0
"""Length of drives whose labels are tested [m]; pages show a longer one."""
GYROSCOPE, ACCELEROMETER, TWIST = (
    tuple(f"{name}.{axis}" for axis in "xyz")
    for name in ("angular_velocity", "linear_acceleration", "twist.twist.linear")
)
ODOMETRY = ("twist.twist.linear.x", "twist.twist.angular.z", "pose.pose.position.x", "pose.pose.position.y")


def simulate_drive(*faults: str, length_m: float = LENGTH_M) -> Drive:
    demo = find_scenario("demo")
    spec = replace(demo.drives[0], plan=Wander(length_m, (110.0, 30.0)), faults=Faults.only(*NOISE, *faults))
    truth, messages = simulate_messages(replace(demo, drives=(spec,)), seed=5)
    return Drive(truth, tuple(messages))


def keep_power(drive: Drive, find_rows: Callable[[np.ndarray], np.ndarray]) -> Drive:
    """Keep the messages of power at some times since the first [s]."""

    def select(m: MessageStream) -> MessageStream:
        if m.topic != NAMES["power"]:
            return m
        rows = find_rows((m.log_time_ns - m.log_time_ns[0]) * 1e-9)
        columns = {name: np.asarray(values)[rows] for name, values in m.columns.items()}
        return replace(m, log_time_ns=m.log_time_ns[rows], columns=columns, publish_time_ns=m.publish_time_ns[rows])

    return Drive(drive.truth, tuple(select(m) for m in drive.messages))


def move_fixes(columns: Columns) -> Columns:
    """Move the fixes north by 8 m from half-time on."""
    latitude = columns["latitude"].copy()
    latitude[len(latitude) // 2 :] += 8.0 / 111_000.0
    return {"latitude": latitude}


def swap_axes(columns: Columns) -> Columns:
    return {"latitude": columns["longitude"], "longitude": columns["latitude"]}


def scale(drive: Drive, sensor: str, factor: float, *names: str) -> Drive:
    return drive.changed(sensor, lambda columns: {name: factor * columns[name] for name in names})


CODES = {
    **{f"{sensor}_late": "time-offset" for sensor in ("gnss", "wheel", "imu", "visual")},
    "power_late": "power-delayed",
    "no_power": "no-power",
    "no_gnss": "no-gnss",
    "gyroscope_in_degrees": "imu-units",
    "gyroscope_mirrored": "yaw-rate-sign",
    "acceleration_in_g": "imu-units",
    "no_acceleration": "specific-force-implausible",
    "wheels_in_kmh": "distance-contradicted",
    "wheels_frozen": "frozen",
    "wheels_too_fast": "wheels-slip",
    "axes_swapped": "yaw-rate-sign",
    "fixes_jump": "position-jumps",
    "currents_in_milliamperes": "power-rejected",
    "currents_negative": "power-rejected",
    "power_cut": "power-gaps",
    "power_slow": "power-too-slow",
}


def make_drives(*names: str, length_m: float = LENGTH_M) -> dict[str, Drive]:
    """Return the drive of each fault that is named."""
    drive = simulate_drive(length_m=length_m)
    late = {
        name: simulate_drive(name.replace("late", "clock_offset"), length_m=length_m)
        for name in names
        if name.endswith("late")
    }
    of_one = {
        "no_power": drive.without("power"),
        "no_gnss": drive.without("gnss"),
        "gyroscope_in_degrees": scale(drive, "imu", 180.0 / np.pi, *GYROSCOPE),
        "gyroscope_mirrored": scale(drive, "imu", -1.0, "angular_velocity.z"),
        "acceleration_in_g": scale(drive, "imu", 1.0 / 9.80665, *ACCELEROMETER),
        "no_acceleration": scale(drive, "imu", 0.0, *ACCELEROMETER),
        "wheels_in_kmh": scale(drive, "wheels", 3.6, TWIST[0]),
        "wheels_frozen": scale(drive, "wheels", 0.0, *ODOMETRY),
        "wheels_too_fast": scale(drive, "wheels", 1.3, TWIST[0]),
        "axes_swapped": drive.changed("gnss", swap_axes),
        "fixes_jump": drive.changed("gnss", move_fixes),
        "currents_in_milliamperes": scale(drive, "power", 1000.0, "measured_currents"),
        "currents_negative": scale(drive, "power", -1.0, "measured_currents"),
        "power_cut": keep_power(drive, lambda at_s: (at_s < 20.0) | (at_s > 45.0)),
        "power_slow": keep_power(drive, lambda at_s: np.diff(np.floor(at_s), prepend=-1.0) > 0),
    }
    return {name: (late | of_one)[name] for name in names}


def write_logs(out: Path) -> list[Path]:
    paths = {out / f"{name}.mcap": drive for name, drive in make_drives(*CODES).items()}
    for path, drive in paths.items():
        write_mcap(path, drive.messages)
    return list(paths)
