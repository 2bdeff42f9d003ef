"""Twenty drives, each with one fault of a sensor or of what the log says of it, and the code under which tcpipe must find it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from changed_drives import NAMES, Columns, Drive

from tcpipe.formats.logs.writing import MessageStream, write_mcap
from tcpipe.simulation import Faults, find_scenario
from tcpipe.simulation.route import Wander
from tcpipe.simulation.site_files import simulate_messages

NOISE = ("gnss_noise", "wheel_noise", "imu_noise", "visual_noise", "power_noise", "gnss_lever_arm", "imu_mounting")
LENGTH_M = 60.0


def simulate_drive(*faults: str) -> Drive:
    demo = find_scenario("demo")
    spec = replace(demo.drives[0], plan=Wander(LENGTH_M, (110.0, 30.0)), faults=Faults.only(*NOISE, *faults))
    truth, messages = simulate_messages(replace(demo, drives=(spec,)), seed=5)
    return Drive(truth, tuple(messages))


def keep(drive: Drive, sensor: str, when) -> Drive:
    """Keep the messages of a sensor at some times since its first [s]."""

    def kept(m: MessageStream) -> MessageStream:
        if m.topic != NAMES[sensor]:
            return m
        rows = when((m.log_time_ns - m.log_time_ns[0]) * 1e-9)
        columns = {name: np.asarray(values)[rows] for name, values in m.columns.items()}
        published = None if m.publish_time_ns is None else m.publish_time_ns[rows]
        return replace(m, log_time_ns=m.log_time_ns[rows], columns=columns, publish_time_ns=published)

    return Drive(drive.truth, tuple(kept(m) for m in drive.messages))


def times(factor: float, *names: str):
    return lambda columns: {name: factor * columns[name] for name in names}


def freeze(columns: Columns) -> dict[str, np.ndarray]:
    """Keep the fix of one moment for a fifth of the drive."""
    names = ("latitude", "longitude", "altitude")
    count = len(columns["latitude"])
    rows = np.arange(count)
    rows = np.where((rows > 0.4 * count) & (rows < 0.6 * count), int(0.4 * count), rows)
    return {name: columns[name][rows] for name in names}


def shift_half(columns: Columns) -> dict[str, np.ndarray]:
    """Move the fixes by 8 m from half-time on."""
    latitude = columns["latitude"].copy()
    latitude[len(latitude) // 2 :] += 8.0 / 111_000.0
    return {"latitude": latitude}


@dataclass(frozen=True)
class Fault:
    name: str
    code: str
    drive: Drive


def make_faults() -> Iterator[Fault]:
    for role in ("gnss", "wheel", "imu", "visual", "power"):
        yield Fault(f"{role}_late", "time-offset", simulate_drive(f"{role}_clock_offset"))
    yield Fault("clock_step", "clock-step", simulate_drive("clock_step"))
    yield Fault("outage", "messages-unused", simulate_drive("gnss_outage"))
    drive = simulate_drive()
    gyro = [f"angular_velocity.{axis}" for axis in "xyz"]
    currents = ["measured_currents"]
    yield Fault("no_power", "?", drive.without("power"))
    yield Fault("no_gnss", "no-gnss", drive.without("gnss"))
    yield Fault("no_command", "?", drive.without("command"))
    yield Fault("gyro_deg", "?", drive.changed("imu", times(180.0 / np.pi, *gyro)))
    yield Fault("gyro_mirrored", "?", drive.changed("imu", times(-1.0, "angular_velocity.z")))
    yield Fault("wheel_kmh", "?", drive.changed("wheels", times(3.6, "twist.twist.linear.x")))
    yield Fault("wheel_scale", "?", drive.changed("wheels", times(1.3, "twist.twist.linear.x")))
    yield Fault("visual_scale", "?", drive.changed("visual", times(1.4, *(f"twist.twist.linear.{a}" for a in "xyz"))))
    yield Fault("negative_current", "?", drive.changed("power", times(-1.0, *currents)))
    yield Fault("milliamps", "?", drive.changed("power", times(1000.0, *currents)))
    yield Fault("frozen", "frozen", drive.changed("gnss", freeze))
    yield Fault(
        "swapped", "?", drive.changed("gnss", lambda c: {"latitude": c["longitude"], "longitude": c["latitude"]})
    )
    yield Fault("jump", "?", drive.changed("gnss", shift_half))
    yield Fault("slow_power", "?", keep(drive, "power", lambda t: np.diff(np.floor(t / 1.0), prepend=-1.0) > 0))
    yield Fault("power_gap", "?", keep(drive, "power", lambda t: (t < 20.0) | (t > 50.0)))
    yield Fault("gnss_gap", "?", keep(drive, "gnss", lambda t: (t < 20.0) | (t > 50.0)))
    yield Fault(
        "wheels_dead",
        "?",
        drive.changed(
            "wheels",
            times(0.0, "twist.twist.linear.x", "twist.twist.angular.z", "pose.pose.position.x", "pose.pose.position.y"),
        ),
    )
    yield Fault("no_acceleration", "?", drive.changed("imu", times(0.0, *(f"linear_acceleration.{a}" for a in "xyz"))))
    yield Fault("accel_g", "?", drive.changed("imu", times(1 / 9.80665, *(f"linear_acceleration.{a}" for a in "xyz"))))
    yield Fault("imu_still", "?", drive.changed("imu", times(0.0, *gyro)))
    yield Fault("half_log_power", "?", keep(drive, "power", lambda t: t < 30.0))


def write_logs(out: Path) -> dict[str, str]:
    """Write the logs; return the code of each by its name."""
    codes = {}
    for fault in make_faults():
        write_mcap(out / f"{fault.name}.mcap", fault.drive.messages)
        codes[fault.name] = fault.code
    return codes
