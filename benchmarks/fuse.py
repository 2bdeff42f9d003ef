"""CPU time and memory of the estimators, paired with compiled C++: ``python benchmarks/fuse.py [--hours 1 6]``.

The log: a robot that winds over flat ground at 1 m/s with IMU 200 Hz, wheels 50 Hz, visual odometry 30 Hz and GNSS 10
Hz: 290 events a second, each one prediction and one update for the compiled C++; ``us/event`` is by these everywhere.
(tcpipe's filters take the IMU as their process input and step less often than messages come; the same log is the same
work.)

The compiled C++ is `eigen_ukf15.cpp`, the step of robot_localization's UKF core on the same events; it needs g++ and
Eigen (Debian: libeigen3-dev), else it is left out. Runs are interleaved, so that a busy machine slows all; the median
of the paired ratios counts. Compilation is not counted. The last part fuses an hour, and six, through the whole stage,
from streams to track, in processes of their own: how memory grows with the log.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tcpipe.fusion.error_state import run_error_state
from tcpipe.fusion.initial import find_initial_state, find_stationary_intervals
from tcpipe.fusion.measurements import Trajectory
from tcpipe.fusion.ukf15 import run_ukf15
from tcpipe.geometry.datum import geodetic_from_enu
from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse import fuse_run
from tcpipe.stages.fuse_inputs import prepare_sections
from tcpipe.tables.levels import STREAMS, Sensor, Streams

REPEATS = 7
FILTERPY = "forward filter by filterpy"
LEVER_M = (0.2, -0.1, 0.8)
DATUM_DEG_M = (15.0, 47.0, 500.0)
RATES_HZ = {"imu": 200, "wheel_odometry": 50, "visual_odometry": 30, "gnss": 10}
EIGEN_EVENTS = {
    "imu": ((3, 4, 9, 10, 11), 0.01),
    "wheel_odometry": ((6, 7, 8), 0.05),
    "visual_odometry": ((6, 7, 8), 0.05),
    "gnss": ((0, 1, 2), 0.02),
}
"""Measured states and standard deviation of the events of the compiled C++, by role."""
EIGEN = ("/usr/include/eigen3", "/usr/local/include/eigen3")


def compiled_eigen(directory: Path, seconds: float) -> list[str] | None:
    """Compile the C++ stand-in and write its events; the command to run, or None where there is no compiler or no Eigen."""
    include = next((path for path in EIGEN if Path(path).is_dir()), None)
    compiler = shutil.which("g++")
    if include is None or compiler is None:
        return None
    program, events = directory / "eigen_ukf15", directory / "events"
    source = Path(__file__).with_name("eigen_ukf15.cpp")
    subprocess.run([compiler, "-O2", "-std=c++17", f"-I{include}", source, "-o", program], check=True)
    rng = np.random.default_rng(0)
    parts = []
    for role, (
        entries,
        std,
    ) in EIGEN_EVENTS.items():  # a robot at rest: what is measured does not change what a step costs
        count, size = int(seconds * RATES_HZ[role]), len(entries)
        part = np.zeros((count, 17))
        part[:, 0] = np.arange(1, count + 1) / RATES_HZ[role]
        part[:, 1], part[:, 2 : 2 + size] = size, entries
        part[:, 7 : 7 + size], part[:, 12 : 12 + size] = rng.normal(0.0, std, (count, size)), std**2
        parts.append(part)
    rows = np.concatenate(parts)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    rows[:, 0] = np.diff(rows[:, 0], prepend=0.0)
    process_variance = np.repeat([1e-4, 1e-4, 1e-2, 1.0, 2.0], 3)
    events.write_bytes(process_variance.tobytes() + rows.tobytes())
    return [str(program), str(events)]


def eigen_us(command: list[str], seconds: float) -> float:
    numbers = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    return 1e6 * float(numbers[0]) / (seconds * sum(RATES_HZ.values()))


def made_streams(seconds: float) -> Streams:
    """Streams of the winding drive, with noise."""
    rng = np.random.default_rng(1)
    grid = np.arange(0.0, seconds, 0.01)
    rate = 0.25 * np.sin(grid / 7.0)
    yaw = np.concatenate(([0.3], 0.3 + np.cumsum(0.005 * (rate[1:] + rate[:-1]))))
    ahead = np.stack((np.cos(yaw), np.sin(yaw)), -1)
    xy = np.concatenate((np.zeros((1, 2)), np.cumsum(0.005 * (ahead[1:] + ahead[:-1]), axis=0)))
    tables = {}
    for role, hz in RATES_HZ.items():
        t = np.arange(0.001, seconds - 0.02, 1.0 / hz)
        turn = np.interp(t, grid, rate)
        columns = {
            "imu": _imu,
            "wheel_odometry": _odometry,
            "visual_odometry": _odometry,
            "gnss": _gnss,
        }[role](t, turn, rng, np.interp(t, grid, yaw), np.stack([np.interp(t, grid, xy[:, k]) for k in (0, 1)], -1))
        stamp_ns = np.rint(t * 1e9).astype(np.int64) + 1_700_000_000_000_000_000
        columns |= {"stamp_ns": stamp_ns, "log_time_ns": stamp_ns, "clock_epoch": np.zeros(t.size, np.int16)}
        rest = {name: np.full(t.size, np.nan) for name in STREAMS[role].names() if name not in columns}
        tables[role] = STREAMS[role].table(**columns, **rest)
    sensors = {
        role: Sensor(f"/{role}", "", role, "made", LEVER_M if role == "gnss" else (0.0, 0.0, 0.0), placed_by="recipe")
        for role in tables
    }
    return Streams(tables, sensors, "husky")


def _imu(t: np.ndarray, turn: np.ndarray, rng: np.random.Generator, *_: np.ndarray) -> dict[str, np.ndarray]:
    noise = rng.normal(size=(t.size, 6))
    values = noise * np.repeat([0.002, 0.05], 3) + np.stack((0 * t, 0 * t, turn, 0 * t, turn, 0 * t + 9.80665), -1)
    names = [f"angular_velocity_{axis}_radps" for axis in "xyz"] + [f"linear_acceleration_{a}_mps2" for a in "xyz"]
    return dict(zip(names, values.T, strict=True))


def _odometry(t: np.ndarray, turn: np.ndarray, rng: np.random.Generator, *_: np.ndarray) -> dict[str, np.ndarray]:
    velocity = rng.normal(size=(t.size, 3)) * 0.03 + [1.0, 0.0, 0.0]
    found = {f"velocity_{axis}_mps": velocity[:, k] for k, axis in enumerate("xyz")}
    found |= {f"velocity_var_{axis}_m2ps2": np.full(t.size, 0.03**2) for axis in "xyz"}
    return found | {"angular_velocity_z_radps": turn + 0.02 * rng.normal(size=t.size)}


def _gnss(
    t: np.ndarray, _: np.ndarray, rng: np.random.Generator, yaw: np.ndarray, xy: np.ndarray
) -> dict[str, np.ndarray]:
    lever = np.stack(
        (
            np.cos(yaw) * LEVER_M[0] - np.sin(yaw) * LEVER_M[1],
            np.sin(yaw) * LEVER_M[0] + np.cos(yaw) * LEVER_M[1],
        ),
        -1,
    )
    antenna = np.column_stack((xy + lever, np.full(t.size, LEVER_M[2]))) + 0.015 * rng.normal(size=(t.size, 3))
    place = geodetic_from_enu(antenna, datum_deg_m=DATUM_DEG_M)
    variance = {f"{axis}_var_m2": np.full(t.size, 0.015**2) for axis in ("east", "north", "up")}
    return dict(zip(("lon_deg", "lat_deg", "alt_m"), place, strict=True)) | variance | {"fix_status": np.zeros(t.size)}


class Drive:
    """The winding drive, for either estimator."""

    def __init__(self, seconds: float) -> None:
        streams = made_streams(seconds)
        self.measurements = prepare_sections(streams, FuseConfig())[0].measurements
        start_ns = int(self.measurements.imu.stamp_ns[0])
        standing = find_stationary_intervals(self.measurements)
        self.initial = find_initial_state(self.measurements, standing, start_ns)
        first, last = start_ns // 50_000_000 + 1, int(self.measurements.wheels.stamp_ns[-1]) // 50_000_000
        self.output_ns = np.arange(first, last + 1, dtype=np.int64) * 50_000_000
        self.events = sum(table.num_rows for table in streams.tables.values())

    def us(self, run: Callable[..., Trajectory] = run_error_state) -> float:
        """CPU microseconds a message."""
        begin = time.process_time()
        run(self.measurements, self.initial, output_ns=self.output_ns, gate_probability=0.999)
        return 1e6 * (time.process_time() - begin) / self.events


def print_paired(seconds: float) -> None:
    """Interleave every estimator and print medians and paired ratios."""
    short, drive = Drive(min(5.0, seconds)), Drive(seconds)
    short.us()
    found: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as directory:
        command = compiled_eigen(Path(directory), seconds)
        for _ in range(REPEATS):
            run = {
                FILTERPY: short.us(run_ukf15),
                "error-state forward + smoother": drive.us(),
            }
            if command is not None:
                run["C++ Eigen core, 15 states"] = eigen_us(command, seconds)
            for name, value in run.items():
                found.setdefault(name, []).append(value)
    for name, values in found.items():
        print(f"{name:<32} {statistics.median(values):8.2f} us/event")
    _ratios(found)


def _ratios(found: dict[str, list[float]]) -> None:
    core = "C++ Eigen core, 15 states"
    if core not in found:
        print("no g++ or no Eigen (libeigen3-dev): not compared with C++")
        return
    for name in (FILTERPY, "error-state forward + smoother"):
        ratio = statistics.median(a / b for a, b in zip(found[name], found[core], strict=True))
        print(f"{name} / {core}: {ratio:.2f}")


def fuse_hours(hours: float) -> None:
    """Fuse one long log through the stage and print its CPU time and memory."""
    fuse_run(made_streams(20.0), FuseConfig(), run_id="warm")
    streams = made_streams(3600.0 * hours)
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    begin = time.process_time()
    track = fuse_run(streams, FuseConfig(), run_id="long")
    seconds = time.process_time() - begin
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{hours:g} h, {sum(t.num_rows for t in streams.tables.values())} messages to {track.table.num_rows} rows: "
        f"{seconds:.1f} s of CPU, peak memory {peak_mb:.0f} MB (before fusing {before_mb:.0f} MB)"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, nargs="+", default=[1.0, 6.0], help="lengths of the long logs")
    parser.add_argument("--paired-seconds", type=float, default=600.0, help="length of the log of the paired runs")
    parser.add_argument("--only-long", action="store_true")
    given = parser.parse_args()
    if given.only_long:
        fuse_hours(given.hours[0])
        return
    print_paired(given.paired_seconds)
    for hours in given.hours:
        subprocess.run([sys.executable, __file__, "--only-long", "--hours", str(hours)], check=True)


if __name__ == "__main__":
    main()
