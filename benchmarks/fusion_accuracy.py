"""Measure the errors of the fused track and of its covariance: ``python benchmarks/fusion_accuracy.py [--drives 24] [--only NAME]``.

Simulated drives over hills with every sensor fault on; `fault_amplitudes.toml` has their amplitudes, which were written
before any tuning, as were the seeds. Errors include those of the standing robot; rows inside an outage and within half
a second of its ends are reported apart. ``xy`` is the length of the horizontal error vector, RMS; ``v`` that of the
forward velocity.

NEES is that of place, yaw and forward velocity by the deviations that a track carries, 5 degrees of freedom; ``inside``
the share of rows between the 2.5 % and 97.5 % quantiles of chi-square, ``below`` that under the upper one. Without GNSS
neither position nor yaw has anything to be compared with. The next columns ask the same of the displacement over one
second: the share of its errors within one and two of its deviations (68 % and 95 % are wanted). The last are the RMS of
error over deviation.

``possible``: the smallest error of forward velocity that a smoother can reach at constant speed if every bias, scale
and slip is known. With white accelerometer noise of density q, velocities that measure with r_v and positions with r_p
[unit² s], the error's variance is the integral of 1 / (w²/q + 1/r_v + 1/(r_p w²)) dw / 2 pi (Wiener's smoother).
Vibration dominates it: the case "quiet accelerometer" has 0.08 m/s², as a well damped unit has, and is otherwise the
same.
"""

from __future__ import annotations

import argparse
import tempfile
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.fusion.error_state import run_error_state
from tcpipe.fusion.initial import find_initial_state, find_stationary_intervals
from tcpipe.fusion.measurements import cut_sections, make_track_stamps
from tcpipe.geometry.datum import geodetic_from_enu
from tcpipe.geometry.rotation import invert, multiply, rotate, rotation_vector_from_quat
from tcpipe.recipe import FuseConfig, ReadConfig
from tcpipe.simulation import Faults, Truth, read_truth, simulate
from tcpipe.simulation.route import Wander
from tcpipe.simulation.scenarios import DriveSpec, RasterSpec, Scenario, make_small_world
from tcpipe.simulation.sensors import Gnss, Imu, Sensors, Visual, WheelOdometry
from tcpipe.stages.fuse_inputs import drop_implausible_sensors, prepare_sections
from tcpipe.stages.read import read_run
from tcpipe.tables.levels import Streams

AMPLITUDES = tomllib.loads(Path(__file__).with_name("fault_amplitudes.toml").read_text())
STARTS_M = ((14.0, 34.0), (30.0, 20.0), (40.0, 60.0), (60.0, 30.0), (70.0, 70.0), (90.0, 55.0))
BAND = chi2.ppf([0.025, 0.975], 5)
MARGIN_S = 0.5


def sensors(gnss_std_m: float, outage_s: float, vibration_mps2: float | None) -> Sensors:
    given: dict[str, dict[str, Any]] = {name: dict(AMPLITUDES[name]) for name in ("gnss", "wheels", "imu", "visual")}
    vertical = given["gnss"].pop("vertical_factor") * gnss_std_m
    given["gnss"] |= {"std_m": gnss_std_m, "vertical_std_m": vertical, "outage_s": outage_s}
    if vibration_mps2 is not None:
        given["imu"]["vibration_mps2"] = vibration_mps2
    return Sensors(
        Gnss(**given["gnss"]), WheelOdometry(**given["wheels"]), Imu(**given["imu"]), Visual(**given["visual"])
    )


def possible_mps(gnss_std_m: float, vibration_mps2: float | None) -> float:
    """Return the smallest error of the forward velocity at 0.9 m/s, RMS; see the module's text."""
    wheels, imu, visual, gnss = (AMPLITUDES[name] for name in ("wheels", "imu", "visual", "gnss"))
    vibration = 0.9 * (imu["vibration_mps2"] if vibration_mps2 is None else vibration_mps2)
    q = (imu["accelerometer_std_mps2"] ** 2 + vibration**2) / imu["rate_hz"]
    heard = wheels["rate_hz"] / wheels["std_mps"] ** 2 + visual["rate_hz"] / visual["std_mps"] ** 2
    w = np.geomspace(1e-4, 1e4, 100_001)
    variance = np.trapezoid(1 / (w**2 / q + heard + gnss["rate_hz"] / (gnss_std_m * w) ** 2), w) / np.pi
    return float(np.sqrt(variance))


def made_drive(
    out: Path, seed: int, *, gnss_std_m: float, outage_s: float, vibration_mps2: float | None = None
) -> tuple[Streams, Truth]:
    start = STARTS_M[seed % len(STARTS_M)]
    wander = Wander(AMPLITUDES["drive_m"], start, climbing=0.4)
    drive = DriveSpec(
        "drive", wander, start, sensors=sensors(gnss_std_m, outage_s, vibration_mps2), faults=Faults.every()
    )
    region = ((1.0, 1.0), (100.0, 1.0), (100.0, 79.0), (1.0, 79.0))
    site = simulate(
        out, scenario=Scenario("accuracy", make_small_world(), (drive,), region, RasterSpec(2.0, 2.0, 2.0)), seed=seed
    )
    with open_log(site.logs[0]) as log:
        return read_run(log, ReadConfig(), robot=None, known=load_shipped_profiles()), read_truth(site.truths[0])


@dataclass
class Errors:
    """Errors of one drive at the track's rows: position (N, 3) [m], forward velocity, yaw; NEES; the deviations claimed of each."""

    position: np.ndarray
    velocity: np.ndarray
    yaw: np.ndarray
    nees: np.ndarray
    outage: np.ndarray
    displacement: np.ndarray
    displacement_std: np.ndarray
    normalized: np.ndarray


def errors(streams: Streams, truth: Truth) -> Errors:
    """Fuse and compare, over every section."""
    config = FuseConfig()
    inputs = drop_implausible_sensors(prepare_sections(streams, config), streams)
    parts = []
    for section in cut_sections({each.clock_epoch: each.measurements for each in inputs}):
        output_ns = make_track_stamps(section, period_ns=50_000_000, max_gap_ns=int(config.max_gap_s * 1e9))
        output_ns = output_ns[(output_ns > truth.stamp_ns[0]) & (output_ns < truth.stamp_ns[-1])]
        initial = find_initial_state(
            section.measurements, find_stationary_intervals(section.measurements), section.start_ns
        )
        found = run_error_state(
            section.measurements, initial, output_ns=output_ns, gate_probability=config.gate_probability
        )
        at = truth.at(output_ns)
        position = found.position_enu_m
        if inputs[0].datum_deg_m is not None:
            lon, lat, alt = geodetic_from_enu(position, datum_deg_m=inputs[0].datum_deg_m)
            scale = np.array([np.cos(np.radians(at.lat_deg)), np.ones_like(at.lat_deg)]).T * 6_371_000.0
            position_error = np.column_stack(
                (np.radians(np.stack((lon - at.lon_deg, lat - at.lat_deg), -1)) * scale, alt - at.alt_m)
            )
        else:
            position_error = np.full_like(position, np.nan)
        parts.append(_compared(found, at, position_error, _in_outage(section.measurements.gnss, output_ns)))
    return Errors(*(np.concatenate([getattr(part, name) for part in parts]) for name in Errors.__dataclass_fields__))


def _in_outage(gnss: Any, at_ns: np.ndarray) -> np.ndarray:
    if gnss is None:
        return np.zeros(at_ns.size, bool)
    steps = np.diff(gnss.stamp_ns)
    long = np.flatnonzero(steps > 2e9)
    inside = np.zeros(at_ns.size, bool)
    for k in long:
        inside |= (at_ns > gnss.stamp_ns[k] - MARGIN_S * 1e9) & (at_ns < gnss.stamp_ns[k + 1] + MARGIN_S * 1e9)
    return inside


def _compared(found: Any, at: Any, position_error: np.ndarray, outage: np.ndarray) -> Errors:
    turn = rotation_vector_from_quat(multiply(invert(found.quat_xyzw), at.quat_xyzw))
    forward = rotate(invert(found.quat_xyzw), found.velocity_enu_mps)[:, 0] - at.forward_velocity_mps
    lag = 20
    way = found.position_enu_m[lag:, :2] - found.position_enu_m[:-lag, :2]
    length = np.linalg.norm(way, axis=1)
    along = np.full(len(turn), np.nan)
    change = position_error[lag:, :2] - position_error[:-lag, :2]
    along[:-lag] = np.where(length > 0.3, np.sum(change * way, 1) / np.maximum(length, 1e-9), np.nan)
    yaw = -rotate(at.quat_xyzw, turn)[:, 2]
    deviations = np.column_stack((found.position_std_m, found.forward_velocity_std_mps, found.yaw_std_rad))
    normalized = np.column_stack((position_error, forward, yaw)) / deviations
    nees = np.sum(normalized**2, axis=1)
    return Errors(position_error, forward, yaw, nees, outage, along, found.displacement_std_m[:, 1], normalized)


def row(name: str, drives: list[Errors], *, outage: bool | None) -> str:
    """Format one line: RMS of all rows of all drives."""
    joined = Errors(*(np.concatenate([getattr(d, key) for d in drives]) for key in Errors.__dataclass_fields__))
    chosen = np.ones(joined.outage.size, bool) if outage is None else joined.outage == outage
    if not chosen.any():
        return f"{name:<34} (no rows)"

    def rms(e: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.square(e[chosen]))))

    xy, z = float(np.sqrt(2)) * rms(joined.position[:, :2]), rms(joined.position[:, 2])
    nees = joined.nees[chosen]
    band = np.mean((nees > BAND[0]) & (nees < BAND[1]))
    ratio = np.abs(joined.displacement / joined.displacement_std)[chosen]
    ratio = ratio[np.isfinite(ratio)]
    relative = f"{np.mean(ratio < 1):4.0%} {np.mean(ratio < 2):4.0%}" if ratio.size else "   -    -"
    spread = " ".join(f"{v:4.2f}" for v in np.sqrt(np.mean(joined.normalized[chosen] ** 2, axis=0)))
    return (
        f"{name:<34} {1e3 * xy:7.1f} {1e3 * z:7.1f} {1e3 * rms(joined.velocity):7.1f} "
        f"{np.degrees(rms(joined.yaw)):7.3f} {np.mean(nees):6.1f} {np.mean(nees < BAND[1]):6.1%} {band:6.1%}  {relative}  {spread}"
    )


def without(streams: Streams, *roles: str) -> Streams:
    return replace(streams, tables={role: table for role, table in streams.tables.items() if role not in roles})


ROLES = ("imu", "wheel_odometry", "visual_odometry", "gnss")


QUIET_MPS2 = 0.08


def cases(seeds: range, only: str) -> Iterator[tuple[str, float, float, tuple[str, ...], range]]:
    """Yield name, sigma, outage, removed roles, seeds."""
    found = [
        ("RTK 1.5 cm", 0.015, 10.0, (), seeds),
        ("RTK 5 cm", 0.05, 10.0, (), seeds),
        ("quiet accelerometer", 0.015, 10.0, (), seeds[:8]),
        ("outage of a minute", 0.015, 60.0, (), seeds[:8]),
        *((f"without {role}", 0.015, 10.0, (role,), seeds[:8]) for role in ROLES),
        ("GNSS and IMU alone", 0.015, 10.0, ("wheel_odometry", "visual_odometry"), seeds[:8]),
        ("GNSS and wheels alone", 0.015, 10.0, ("imu", "visual_odometry"), seeds[:8]),
        ("GNSS alone", 0.015, 10.0, ("imu", "visual_odometry", "wheel_odometry"), seeds[:8]),
    ]
    yield from (case for case in found if only in case[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=24)
    parser.add_argument("--only", default="", help="cases whose name holds this")
    parser.add_argument("--first-seed", type=int, default=AMPLITUDES["seeds"][0])
    parser.add_argument("--keep", type=Path, help="keep the simulated logs here")
    given = parser.parse_args()
    seeds = range(given.first_seed, given.first_seed + given.drives)
    print(
        f"{'':<34} {'xy mm':>7} {'z mm':>7} {'v mm/s':>7} {'yaw deg':>7} {'NEES':>6} {'below':>6} {'inside':>6}  "
        f"{'displ.':>9}  error over deviation: x y z v yaw"
    )
    with tempfile.TemporaryDirectory() as temporary:
        directory = temporary if given.keep is None else given.keep
        for name, std_m, outage_s, removed, chosen in cases(seeds, given.only):
            drives: list[Errors] = []
            vibration = QUIET_MPS2 if "quiet" in name else None
            for seed in chosen:
                place = Path(directory) / f"{seed}_{std_m}_{outage_s}_{vibration}"
                streams, truth = made_drive(place, seed, gnss_std_m=std_m, outage_s=outage_s, vibration_mps2=vibration)
                drives.append(errors(without(streams, *removed), truth))
            print(row(name, drives, outage=False), flush=True)
            print(row(f"{name}, in outages", drives, outage=True), flush=True)
            if not removed:
                print(f"{'  possible':<34} {'':15} {1e3 * possible_mps(std_m, vibration):7.1f}", flush=True)


if __name__ == "__main__":
    main()
