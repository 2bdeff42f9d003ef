"""Whether a run shows its own noise: ``python benchmarks/densities.py [--seeds 701 702] [--length 500] [--only NAME] [--log PATH]``.

Simulated drives over hills with every sensor fault on but outages; the noise of the fixes is drawn here, from families
that the estimator does not contain too, 5/3 times as large upwards, and the fixes claim its total. ``10 s`` and ``40
s``: standard deviation of the change of a fix's error over so long, fitted over true, least, median and largest of the
seeds: what a filter takes, in the plane, then upwards. ``false``: the correlated part that it takes on white noise.
``CPU``: the largest.

With ``--log``, what real logs show: claimed, white and correlated parts of their fixes, their odometries and turns,
and, where the robot is stationary, the residuals themselves, which need no model.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from campaign_drives import HUSKY, WHOLE, MemoryLog, simulated

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.fusion.densities import GaussMarkov, NoiseModel, SensorNoise, fit_noise
from tcpipe.fusion.measurements import Measurements
from tcpipe.fusion.pair_residuals import find_residuals
from tcpipe.recipe import Recipe
from tcpipe.simulation.messages import make_streams
from tcpipe.simulation.sensors import Sensors, record
from tcpipe.stages.fuse_inputs import prepare_sections
from tcpipe.stages.read import read_run
from tcpipe.tables.levels import Streams

UPWARDS = 5.0 / 3.0
AFTER_S = (10.0, 40.0)


@dataclass(frozen=True)
class Family:
    """White noise [m] and Gauss-Markov processes (σ [m], time [s])."""

    white_m: float
    processes: tuple[tuple[float, float], ...] = ()

    def variance_m2(self) -> float:
        """Return the total variance."""
        return self.white_m**2 + sum(std**2 for std, _ in self.processes)

    def change_std_m(self, time_s: float) -> float:
        """Return the standard deviation of the change over a time."""
        parts = (GaussMarkov(std**2, tau).difference_variance(np.array(time_s)) for std, tau in self.processes)
        return float(np.sqrt(2.0 * self.white_m**2 + sum(parts)))

    def draw(self, time_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return errors at increasing times, (n, 3); the same upwards as in the plane."""
        error = self.white_m * rng.standard_normal((time_s.size, 3))
        for std, tau in self.processes:
            kept = np.exp(-np.diff(time_s, prepend=-np.inf) / tau)
            value = np.zeros(3)
            for row, share in enumerate(kept):
                value = share * value + np.sqrt(1.0 - share**2) * rng.standard_normal(3)
                error[row] += std * value
        return error


FAMILIES = {
    "white 1.5 cm": Family(0.015),
    "0.8 cm, 5 s": Family(0.01, ((0.008, 5.0),)),
    "0.8 cm, 15 s": Family(0.01, ((0.008, 15.0),)),
    "1.5 cm, 10 s": Family(0.005, ((0.015, 10.0),)),
    "2 cm, 20 s": Family(0.005, ((0.02, 20.0),)),
    "3 cm, 5 s": Family(0.005, ((0.03, 5.0),)),
    "3 cm, 60 s": Family(0.005, ((0.03, 60.0),)),
    "flicker 1.5 cm": Family(0.005, tuple((0.015 / 5**0.5, tau) for tau in (1.0, 3.0, 10.0, 30.0, 100.0))),
}
EVERY_TENTH = slice(None, None, 10)


def thin(measurements: Measurements) -> Measurements:
    """Keep every tenth fix."""
    gnss = measurements.gnss
    rows = {name: getattr(gnss, name)[EVERY_TENTH] for name in ("stamp_ns", "position_enu_m", "variance_m2")}
    return replace(measurements, gnss=replace(gnss, **rows))


SENSORS: dict[str, Callable[[Measurements], Measurements]] = {
    "all": lambda measurements: measurements,
    "no camera": lambda measurements: replace(measurements, visual=None),
    "1 Hz": thin,
    "no IMU": lambda measurements: replace(measurements, imu=None),
}


def prepare(streams: Streams) -> Iterator[Measurements]:
    for section in prepare_sections(streams, Recipe().ingest.fuse):
        yield section.measurements


def measure(seed: int, length_m: float) -> Measurements:
    """Return the measurements of a drive whose fixes do not err."""
    drive = simulated("hills", seed, length_m)
    faults = replace(WHOLE, gnss_noise=False)
    sensors = Sensors().mounted(faults)
    readings = record(drive.truth, drive.site, sensors, faults, drive.noise)
    messages = make_streams(readings, sensors, HUSKY)
    log = MemoryLog([each for each in messages if each.constants.get("transforms") != []])
    return next(prepare(read_run(log, Recipe().read, robot="husky", known=load_shipped_profiles())))


def add_noise(measurements: Measurements, family: Family, seed: int) -> Measurements:
    gnss = measurements.gnss
    scale = np.array([1.0, 1.0, UPWARDS])
    error = family.draw((gnss.stamp_ns - gnss.stamp_ns[0]) * 1e-9, np.random.default_rng([seed, 1]))
    claimed = np.tile(family.variance_m2() * scale**2, (gnss.stamp_ns.size, 1))
    changed = replace(gnss, position_enu_m=gnss.position_enu_m + scale * error, variance_m2=claimed)
    return replace(measurements, gnss=changed)


def change_std_m(noise: SensorNoise, time_s: float) -> float:
    return float(np.sqrt(2.0 * noise.white + noise.correlated.difference_variance(np.array(time_s))))


def simulate(seeds: list[int], length_m: float, only: str) -> None:
    drives = {seed: measure(seed, length_m) for seed in seeds}
    wide = [f"{axis} {after_s:.0f} s" for axis in ("plane", "up") for after_s in AFTER_S]
    print(f"{'noise':15} {'sensors':10}", *(f"{name:>16}" for name in wide), " false mm  CPU s")
    inside = []
    for name, family in FAMILIES.items():
        for which, choose in SENSORS.items():
            if only not in f"{name}, {which}":
                continue
            ratios, false_mm, cpu_s = [], [], []
            for seed, drive in drives.items():
                measurements = choose(add_noise(drive, family, seed))
                start = time.process_time()
                model = fit_noise(measurements, find_residuals(measurements))
                cpu_s.append(time.process_time() - start)
                axes = ((model.horizontal, 1.0), (model.vertical, UPWARDS))
                ratios.append(
                    [
                        change_std_m(each, after) / family.change_std_m(after) / up
                        for each, up in axes
                        for after in AFTER_S
                    ]
                )
                false_mm.append(1e3 * np.sqrt(model.horizontal.correlated.variance))
            found = np.array(ratios)
            inside.append((found[:, :2] > 0.85) & (found[:, :2] < 1.35))
            columns = (
                f"{low:.2f} {middle:.2f} {high:.2f}" for low, middle, high in np.quantile(found, [0, 0.5, 1], axis=0).T
            )
            false = f"{max(false_mm):8.1f}" if not family.processes else f"{'':8}"
            row = " ".join(f"{column:>16}" for column in columns)
            print(f"{name:15} {which:10} {row} {false}  {max(cpu_s):.2f}", flush=True)
    print(f"in the plane, {np.mean(inside):.0%} of ratios between 0.85 and 1.35")


def describe(model: NoiseModel) -> Iterator[str]:
    for axis, noise in (("plane", model.horizontal), ("up", model.vertical)):
        if noise is not None:
            claimed, white, slow = (
                1e3 * np.sqrt(each) for each in (noise.claimed_m2, noise.white, noise.correlated.variance)
            )
            yield (
                f"  fixes, {axis}: claimed {claimed:.1f} mm, white {white:.1f} mm, correlated {slow:.1f} mm over "
                f"{noise.correlated.time_s:.0f} s"
            )
    for role, each in model.odometries.items():
        yield (
            f"  {role}: {1e3 * np.sqrt(each.white):.1f} mm after 1 s, scale "
            f"{100 * np.sqrt(each.correlated.variance):.2f} % over {each.correlated.time_s:.0f} s"
        )
    for role, turn in model.turns.items():
        yield f"  turns, {role}: {1e3 * np.sqrt(turn.white):.2f} mrad after 1 s"


def read(path: Path) -> None:
    with open_log(path) as log:
        streams = read_run(log, Recipe().read, robot=None, known=load_shipped_profiles())
    for measurements in prepare(streams):
        start = time.process_time()
        residuals = find_residuals(measurements)
        model = fit_noise(measurements, residuals)
        print(f"{path.name}: {', '.join(measurements.sensors())}; CPU {time.process_time() - start:.2f} s")
        print(*describe(model), sep="\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[701, 702, 703, 704, 705, 706])
    parser.add_argument("--length", type=float, default=500.0, help="of a drive [m]")
    parser.add_argument("--only", default="", help="part of 'noise, sensors'")
    parser.add_argument("--log", type=Path, action="append", default=[])
    given = parser.parse_args()
    if not given.log:
        simulate(given.seeds, given.length, given.only)
    for path in given.log:
        read(path)


if __name__ == "__main__":
    main()
