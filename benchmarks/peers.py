"""tcpipe beside another estimator on the same drives: ``python benchmarks/peers.py [--seeds 2] [--only REGEX]``.

The peer is pyins (PyPI: python-ins), a filter for inertial navigation with error states; ``make compare-peers``
installs it. Without it the program says so and compares the rest. Drives are those of `campaign_drives.py` over a
valley, with fixes, IMU and wheels. They have no outliers, no wrong stamps and no unstated antenna, since the peer
models none of them. Noise of fixes is white, or correlated in time by exp(-t / 10 s); its covariance is stated. In the
middle half of the drive there are no fixes for a minute.

All estimators get what `tcpipe.stages.read` made of the log. The peer starts at the true course after the first metres,
with the noise of the simulated IMU; its wheels have a scale by the distance between fixes, are averaged to 10 Hz and
moved to the IMU. It filters forward only, while tcpipe smooths. ``simplest``: fixes interpolated and differenced over a
second, yaw from their course; without fixes the wheels with that scale, and the gyroscope less its mean at rest.

A row shows RMS errors of position (horizontal, base_link) [mm], forward velocity [mm/s] and yaw [deg] outside the
outage; the share of the position's errors, east and north, inside 1 and 2 of the stated standard deviations; RMS error
within the outage [mm] and the share of its errors inside 2; CPU seconds for an hour of log. Rows of the track within
ten seconds of either end count for none.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from campaign_drives import HUSKY, WHOLE, Drive, Fault, MemoryLog, simulated
from honesty_cells import HonestCell, claim_noise, cut_fixes, gauss_markov

from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.geometry.datum import enu_from_geodetic
from tcpipe.geometry.rotation import rotate, rpy_from_quat
from tcpipe.recipe import FuseConfig, ReadConfig
from tcpipe.simulation.messages import make_streams
from tcpipe.simulation.sensors import record
from tcpipe.stages.fuse import fuse_run
from tcpipe.stages.read import read_run
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.levels import Streams

FIRST_SEED = 9101
NOISES_S = {"white": 1e-3, "10 s": 10.0}
"""Correlation time of the noise of fixes, by name."""
FIX_STD_M = 0.015
OUTAGE_S = 60.0
_FAULTS = replace(
    WHOLE, gnss_outliers=False, gnss_stamp_jitter=False, transport_delay=False, duplicates=False, command_jitter=False
)
_SENSORS = "no visual"
_MARGIN_S = 10.0
_START_M = 3.0  # the course is known then
_EARTH_M = 6_371_000.0


@dataclass(frozen=True)
class Inputs:
    """Measurements of a drive's sensors, on one clock [s] and in the axes of base_link (x forward, y left, z up)."""

    streams: Streams
    fix_s: np.ndarray
    fix_deg_m: np.ndarray
    """Longitude, latitude [deg], altitude [m], shape (N, 3)."""
    fix_enu_m: np.ndarray
    fix_std_m: float
    imu_s: np.ndarray
    rate_radps: np.ndarray
    force_mps2: np.ndarray
    wheel_s: np.ndarray
    wheel_mps: np.ndarray
    """Scaled so that its distance is that between fixes."""
    arm_m: np.ndarray
    imu_arm_m: np.ndarray
    track_s: np.ndarray
    """The times that are compared."""

    @property
    def datum_deg_m(self) -> tuple[float, float, float]:
        """The origin of ``fix_enu_m``."""
        lon, lat, alt = self.fix_deg_m[0].tolist()
        return lon, lat, alt


@dataclass(frozen=True)
class Estimate:
    """base_link at the compared times: east and north of the datum [m] with σ, forward velocity [m/s], yaw [rad]; NaN: unknown."""

    place_m: np.ndarray
    velocity_mps: np.ndarray
    yaw_rad: np.ndarray
    std_m: np.ndarray
    cpu_s: float


def record_drive(drive: Drive, lasts_s: float, outage_s: float) -> Streams:
    """Return what the sensors of a drive measured."""
    sensors = HonestCell(_SENSORS, Fault("")).fitted(drive).mounted(_FAULTS)
    readings = record(drive.truth, drive.site, sensors, _FAULTS, drive.noise)
    white_m = sensors.gnss.std_m if sensors.gnss else 0.0
    std_m = float(np.sqrt(FIX_STD_M**2 - white_m**2))
    readings = claim_noise("noise", std_m, gauss_markov(std_m, lasts_s))(readings, drive)
    readings = cut_fixes(outage_s)(readings, drive)
    log = MemoryLog(make_streams(readings, sensors, HUSKY))
    return read_run(log, ReadConfig(), robot=drive.robot, known=load_shipped_profiles())


def make_inputs(streams: Streams, track_ns: np.ndarray, first_ns: int) -> Inputs:
    """Return the streams as arrays; rotations and lever arms are those that the log states."""

    def seconds(role: str) -> np.ndarray:
        return (to_integers(streams.tables[role], "stamp_ns") - first_ns) * 1e-9

    def columns(role: str, *names: str) -> np.ndarray:
        return np.column_stack([to_floats(streams.tables[role], name) for name in names])

    fixes = columns("gnss", "lon_deg", "lat_deg", "alt_m")
    fix_enu_m = enu_from_geodetic(*fixes.T, datum_deg_m=tuple(fixes[0]))
    imu = streams.sensors["imu"]
    axes = (_name_axes("angular_velocity", "radps"), _name_axes("linear_acceleration", "mps2"))
    fix_s, wheel_s = seconds("gnss"), seconds("wheel_odometry")
    wheel_mps = to_floats(streams.tables["wheel_odometry"], "velocity_x_mps")
    return Inputs(
        streams, fix_s, fixes, fix_enu_m, float(np.sqrt(np.median(columns("gnss", "east_var_m2")))),
        seconds("imu"), *(rotate(np.array(imu.quat_xyzw), columns("imu", *names)) for names in axes),
        wheel_s, wheel_mps / _compare_distances(fix_s, fix_enu_m, wheel_s, wheel_mps),
        np.array(streams.sensors["gnss"].xyz_m), np.array(imu.xyz_m), (track_ns - first_ns) * 1e-9,
    )  # fmt: skip


def _name_axes(name: str, unit: str) -> list[str]:
    return [f"{name}_{axis}_{unit}" for axis in "xyz"]


def _compare_distances(fix_s: np.ndarray, enu_m: np.ndarray, wheel_s: np.ndarray, wheel_mps: np.ndarray) -> float:
    """Return the distance of the wheels over that between fixes 5 s apart, the median."""
    way_m = np.concatenate(([0.0], np.cumsum(np.diff(wheel_s) * (wheel_mps[1:] + wheel_mps[:-1]) / 2.0)))
    step = round(5.0 / float(np.median(np.diff(fix_s))))
    whole = np.abs(fix_s[step:] - fix_s[:-step] - 5.0) < 0.5
    apart_m = np.linalg.norm(enu_m[step:] - enu_m[:-step], axis=1)[whole]
    fix_way_m = np.interp(fix_s, wheel_s, way_m)
    by_wheels_m = np.abs(fix_way_m[step:] - fix_way_m[:-step])[whole]
    far = apart_m > 1.0
    return float(np.median(by_wheels_m[far] / apart_m[far]))


# Estimators


def run_tcpipe(given: Inputs) -> Estimate:
    """Fuse by the default recipe, which knows a stated antenna to 5 cm."""
    begun_s = time.process_time()
    track = fuse_run(given.streams, FuseConfig(), run_id="run")
    cpu_s = time.process_time() - begun_s
    table = track.table
    place_m = enu_from_geodetic(
        *(to_floats(table, name) for name in ("lon_deg", "lat_deg", "alt_m")), datum_deg_m=given.datum_deg_m
    )
    std_m = np.column_stack([to_floats(table, f"{axis}_std_m") for axis in "xy"])
    return Estimate(place_m[:, :2], to_floats(table, "forward_velocity_mps"), to_floats(table, "yaw_rad"), std_m, cpu_s)


def run_simplest(given: Inputs) -> Estimate:
    """Difference fixes; dead-reckon from the last one during gaps of more than two seconds."""
    begun_s = time.process_time()
    at_s, half_s = given.track_s, 0.5
    antenna_m, before_m, after_m = (
        np.column_stack([np.interp(at_s + offset_s, given.fix_s, axis) for axis in given.fix_enu_m.T])
        for offset_s in (0.0, -half_s, half_s)
    )
    step_m = after_m - before_m
    wheel_mps = np.interp(at_s, given.wheel_s, given.wheel_mps)
    velocity_mps = np.linalg.norm(step_m, axis=1) * np.where(wheel_mps < 0.0, -1.0, 1.0) / (2.0 * half_s)
    is_driving = np.abs(velocity_mps) > 0.3
    course = np.arctan2(step_m[:, 1], step_m[:, 0]) + np.pi * (wheel_mps < 0.0)
    known = np.flatnonzero(is_driving)
    yaw_rad = np.interp(np.arange(at_s.size), known, np.unwrap(course[known]))
    rest = np.abs(np.interp(given.imu_s, given.wheel_s, given.wheel_mps)) < 1e-6
    turn_radps = given.rate_radps[:, 2] - np.mean(given.rate_radps[rest, 2])
    turned_rad = np.concatenate(([0.0], np.cumsum(np.diff(given.imu_s) * turn_radps[1:])))
    for first, last in find_outages(given):
        rows = np.arange(first, last)
        turn = np.interp(at_s, given.imu_s, turned_rad)
        yaw_rad[rows] = yaw_rad[first - 1] + turn[rows] - turn[first - 1]
        velocity_mps[rows] = wheel_mps[rows]
        steps_m = (np.diff(at_s[first - 1 : last]) * wheel_mps[rows])[:, None] * np.column_stack(
            (np.cos(yaw_rad[rows]), np.sin(yaw_rad[rows]))
        )
        antenna_m[rows, :2] = antenna_m[first - 1, :2] + np.cumsum(steps_m, axis=0)
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    x_m, y_m, _ = given.arm_m
    place_m = antenna_m[:, :2] - np.column_stack((cosine * x_m - sine * y_m, sine * x_m + cosine * y_m))
    return Estimate(place_m, velocity_mps, yaw_rad, np.full_like(place_m, np.nan), time.process_time() - begun_s)


def run_pyins(given: Inputs) -> Estimate:
    """Filter forward by pyins, from when the course is known."""
    import pandas as pd
    from pyins import filters, inertial_sensor, strapdown, transform
    from pyins.measurements import BodyVelocity, Position

    begun_s = time.process_time()
    down = np.array([1.0, -1.0, -1.0])  # its axes are forward, right, down, and north, east, down
    start_s, heading_deg, speed_mps = _find_start(given)
    imu = pd.DataFrame(
        np.column_stack((given.rate_radps * down, given.force_mps2 * down)), given.imu_s,
        columns=["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"],
    )  # fmt: skip
    increments = strapdown.compute_increments_from_imu(imu[imu.index >= start_s], "rate")
    lla = pd.DataFrame(given.fix_deg_m[:, [1, 0, 2]], given.fix_s, columns=["lat", "lon", "alt"])
    antenna_m = (given.arm_m - given.imu_arm_m) * down
    fixes = Position(lla[lla.index > start_s], given.fix_std_m, antenna_m)
    # The mean of a tenth of a second at its middle; the IMU's velocity is that of base_link and of the turn.
    count = round(0.1 / float(np.median(np.diff(given.wheel_s))))
    rows = given.wheel_s.size // count * count
    wheel_s, wheel_mps = (of[:rows].reshape(-1, count).mean(axis=1) for of in (given.wheel_s, given.wheel_mps))
    turn_radps = np.column_stack([np.interp(wheel_s, given.imu_s, _smooth(axis)) for axis in given.rate_radps.T])
    body_mps = np.column_stack((wheel_mps, np.zeros((wheel_mps.size, 2)))) + np.cross(turn_radps, given.imu_arm_m)
    wheels = pd.DataFrame(body_mps * down, wheel_s, columns=["VX", "VY", "VZ"])
    odometry = BodyVelocity(wheels[wheels.index > start_s], _WHEEL_STD_MPS)
    force = given.force_mps2[(given.imu_s > start_s - 1.0) & (given.imu_s <= start_s)].mean(axis=0)
    roll, pitch = np.arctan2(force[1], force[2]), np.arctan2(force[0], np.hypot(force[1], force[2]))
    rph = [np.degrees(roll), np.degrees(pitch), heading_deg]
    rotation = transform.mat_from_rph(rph)
    place = transform.perturb_lla(lla.to_numpy()[np.searchsorted(given.fix_s, start_s)], -rotation @ antenna_m)
    velocity = rotation @ np.array([speed_mps, 0.0, 0.0])
    pva = pd.Series(
        [*place, *velocity, *rph], index=["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"],
        name=float(imu.index[imu.index >= start_s][0]),
    )  # fmt: skip
    found = filters.run_feedback_filter(
        pva, 0.05, 0.1, 2.0, 5.0, increments,
        inertial_sensor.EstimationModel(**_GYRO), inertial_sensor.EstimationModel(**_ACCELEROMETER), [fixes, odometry],
    )  # fmt: skip
    return _describe_pyins(given, found, time.process_time() - begun_s)


_WHEEL_STD_MPS = 0.15
"""Slip by slope of some per cent, which lasts: of 0.05, 0.15 and 0.5 m/s this gave the smallest errors on seed 9101."""
_GYRO = {"bias_sd": 0.01, "noise": 2e-4, "bias_walk": 1e-4}
_ACCELEROMETER = {"bias_sd": 0.1, "noise": 0.025, "bias_walk": 1.5e-3}
"""The simulated unit's: white noise and vibration at 100 Hz, a bias that drifts by a fifth within 100 s."""


def _smooth(values: np.ndarray) -> np.ndarray:
    return np.convolve(values, np.full(11, 1.0 / 11.0), "same")


def _find_start(given: Inputs) -> tuple[float, float, float]:
    """Return when the antenna is some metres from where it began, the course then [deg, from north] and the speed [m/s]."""
    away_m = np.linalg.norm(given.fix_enu_m[:, :2] - given.fix_enu_m[0, :2], axis=1)
    row = int(np.argmax(away_m > _START_M))
    back = int(np.flatnonzero(np.linalg.norm(given.fix_enu_m[:row, :2] - given.fix_enu_m[row, :2], axis=1) > 0.5)[-1])
    step_m = given.fix_enu_m[row] - given.fix_enu_m[back]
    seconds = float(given.fix_s[row] - given.fix_s[back])
    heading_deg = float(np.degrees(np.arctan2(step_m[0], step_m[1])))
    return float(given.fix_s[row]), heading_deg, float(np.linalg.norm(step_m[:2])) / seconds


def _describe_pyins(given: Inputs, found: Any, cpu_s: float) -> Estimate:
    """Return base_link's motion by the IMU's."""
    from pyins import transform

    track_s = given.track_s
    known = (track_s > found.trajectory.index[0]) & (track_s < found.trajectory.index[-1])
    states = transform.resample_state(found.trajectory, track_s[known])
    down = np.array([1.0, -1.0, -1.0])
    rotation = transform.mat_from_rph(states[["roll", "pitch", "heading"]].to_numpy())
    lla = transform.perturb_lla(states[["lat", "lon", "alt"]].to_numpy(), -rotation @ (given.imu_arm_m * down))
    place_m = enu_from_geodetic(lla[:, 1], lla[:, 0], lla[:, 2], datum_deg_m=given.datum_deg_m)[:, :2]
    turn_radps = np.column_stack([np.interp(track_s[known], given.imu_s, axis) for axis in given.rate_radps.T])
    forward_mps = np.einsum("nij,ni->nj", rotation, states[["VN", "VE", "VD"]].to_numpy())[:, 0]
    forward_mps = forward_mps - np.cross(turn_radps, given.imu_arm_m)[:, 0]
    std = np.column_stack([
        np.interp(track_s[known], found.trajectory_sd.index, found.trajectory_sd[axis]) for axis in ("east", "north")
    ])  # fmt: skip

    def spread(values: np.ndarray) -> np.ndarray:
        whole = np.full((track_s.size, *values.shape[1:]), np.nan)
        whole[known] = values
        return whole

    yaw_rad = np.pi / 2.0 - np.radians(states["heading"].to_numpy())
    return Estimate(spread(place_m), spread(forward_mps), spread(yaw_rad), spread(std), cpu_s)


def find_outages(given: Inputs) -> list[tuple[int, int]]:
    """Return the rows of the track, first and one past the last, between fixes more than two seconds apart."""
    wide = np.flatnonzero(np.diff(given.fix_s) > 2.0)
    return [tuple(np.searchsorted(given.track_s, given.fix_s[[k, k + 1]]).tolist()) for k in wide]


# Figures


@dataclass(frozen=True)
class Errors:
    """Errors of the rows that all estimators have, in or outside the outage."""

    place_m: np.ndarray
    velocity_mps: np.ndarray
    yaw_rad: np.ndarray
    scaled: np.ndarray
    """Errors of the place over their σ."""
    is_outage: np.ndarray
    cpu_s_per_hour: float


def compare(estimate: Estimate, given: Inputs, drive: Drive, track_ns: np.ndarray, rows: np.ndarray) -> Errors:
    """Return errors of an estimate at rows of the track."""
    at = drive.truth.at(track_ns)
    true_m = enu_from_geodetic(at.lon_deg, at.lat_deg, at.alt_m, datum_deg_m=given.datum_deg_m)[:, :2]
    place_m = estimate.place_m - true_m
    yaw_rad = np.angle(np.exp(1j * (estimate.yaw_rad - rpy_from_quat(at.quat_xyzw)[:, 2])))
    is_outage = np.zeros(track_ns.size, bool)
    for first, last in find_outages(given):
        is_outage[first:last] = True
    hours = float(given.track_s[-1] - given.track_s[0]) / 3600.0
    return Errors(
        place_m[rows], (estimate.velocity_mps - at.forward_velocity_mps)[rows], yaw_rad[rows],
        np.abs(place_m / estimate.std_m)[rows], is_outage[rows], estimate.cpu_s / hours,
    )  # fmt: skip


def format_row(noise: str, name: str, drives: Sequence[Errors]) -> str:
    """Return a line of the table."""

    def rms(key: str, *, outage: bool = False) -> float:
        values = np.concatenate([getattr(of, key)[of.is_outage == outage] for of in drives])
        return float(np.sqrt(np.mean(np.square(values)) * (2.0 if values.ndim > 1 else 1.0))) if values.size else np.nan

    def share(within: float, *, outage: bool) -> str:
        values = np.concatenate([of.scaled[of.is_outage == outage] for of in drives])
        return f"{np.mean(values < within):6.0%}" if values.size and np.isfinite(values).all() else f"{'-':>6}"

    cpu_s = float(np.mean([of.cpu_s_per_hour for of in drives]))
    gap = rms("place_m", outage=True)
    in_gap = f"{1e3 * gap:8.0f}" if np.isfinite(gap) else f"{'-':>8}"
    return (
        f"{noise:<6} {name:<9} {1e3 * rms('place_m'):7.1f} {1e3 * rms('velocity_mps'):7.1f} {np.degrees(rms('yaw_rad')):7.3f} "
        f"{share(1.0, outage=False)} {share(2.0, outage=False)} {in_gap} {share(2.0, outage=True)} {cpu_s:8.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--length", type=float, default=210.0, help="about how far each drive goes [m]")
    parser.add_argument("--outage", type=float, default=OUTAGE_S, help="[s]")
    parser.add_argument("--only", default="", help="noises whose name this regular expression finds")
    given = parser.parse_args()
    estimators: Mapping[str, Callable[[Inputs], Estimate]] = {"tcpipe": run_tcpipe, "simplest": run_simplest}
    if find_spec("pyins"):
        estimators = {"tcpipe": run_tcpipe, "pyins": run_pyins, "simplest": run_simplest}
    else:
        print("pyins is not installed (make compare-peers): the comparison is without it")
    print(
        f"{'noise':<6} {'':<9} {'xy mm':>7} {'v mm/s':>7} {'yaw deg':>7} {'in 1σ':>6} {'in 2σ':>6} "
        f"{'gap mm':>8} {'in 2σ':>6} {'CPU s/h':>8}"
    )
    is_warm = False
    for noise, lasts_s in NOISES_S.items():
        if not re.search(given.only, noise):
            continue
        drives: dict[str, list[Errors]] = {name: [] for name in estimators}
        for seed in range(FIRST_SEED, FIRST_SEED + given.seeds):
            drive = simulated("valley", seed, given.length)
            streams = record_drive(drive, lasts_s, given.outage)
            track = fuse_run(streams, FuseConfig(), run_id="run")
            track_ns = to_integers(track.table, "stamp_ns")
            inputs = make_inputs(streams, track_ns, drive.first_ns)
            if (
                not is_warm and "pyins" in estimators
            ):  # its kernels are compiled before time is measured, as tcpipe's are
                short_s = inputs.imu_s < _find_start(inputs)[0] + 1.0
                imu = {name: getattr(inputs, name)[short_s] for name in ("imu_s", "rate_radps", "force_mps2")}
                run_pyins(replace(inputs, **imu, track_s=inputs.track_s[:0]))
            is_warm = True
            found = {name: run(inputs) for name, run in estimators.items()}
            rows = np.flatnonzero(np.all([np.isfinite(of.place_m).all(axis=1) for of in found.values()], axis=0))
            ends_s = inputs.track_s[rows[[0, -1]]]
            rows = rows[(inputs.track_s[rows] > ends_s[0] + _MARGIN_S) & (inputs.track_s[rows] < ends_s[1] - _MARGIN_S)]
            for name, estimate in found.items():
                drives[name].append(compare(estimate, inputs, drive, track_ns, rows))
        for name, errors in drives.items():
            print(format_row(noise, name, errors), flush=True)


if __name__ == "__main__":
    main()
