"""How true the physics is: drive a simulated robot whose plant has the fitted form, and one whose turning saturates; and real drives.

python benchmarks/physics.py                   # 1,000 segments of the plain plant: coefficients against what was put in
python benchmarks/physics.py --saturating      # the simulator's usual plant, whose scrub falls on wide curves: the bias of the form
python benchmarks/physics.py --log run.mcap    # any log: R² and MAPE of E on held-out fifths, with and without turning
"""

import argparse
import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from tcpipe import ingest
from tcpipe.cost.physics import FitSamples, fit_and_validate_physics
from tcpipe.formats.recipe_toml import load_recipe
from tcpipe.pipeline.dataset.card import compute_mean_idle_power
from tcpipe.report.label_sections import describe_physics
from tcpipe.simulation import Faults, find_scenario, simulate
from tcpipe.simulation.robot import GRAVITY_MPS2, SimulatedRobot
from tcpipe.simulation.route import Wander
from tcpipe.simulation.scenarios import RasterSpec, Scenario
from tcpipe.simulation.world import World
from tcpipe.stages.label import make_fit_samples
from tcpipe.store import Store

NAMES = {4: "grass", 5: "mud", 6: "unpaved", 7: "paved"}


def plain_robot(*, half_radius_m: float = math.inf) -> SimulatedRobot:
    """Return a robot without slip that loses 45 N in its drivetrain; by default its torque on curves is the same at every radius."""
    usual = SimulatedRobot()
    ground = {name: replace(of, slip=0.0) for name, of in usual.ground.items()}
    return replace(usual, ground=ground, slope_slip=0.0, scrub_half_radius_m=half_radius_m, drivetrain_loss_newton=45.0)


def drive_of(robot: SimulatedRobot, *, metres: float) -> Scenario:
    """Return a scenario of one drive over hills and all classes, without sensor faults but noise."""
    hills = find_scenario("hills12")
    noise = Faults.only("gnss_noise", "wheel_noise", "imu_noise", "power_noise")
    plan = Wander(metres, (14.0, 34.0), shares=tuple((k, 0.25) for k in NAMES), climbing=0.5, odd_manoeuvres=False)
    drive = replace(hills.drives[0], plan=plan, faults=noise, robot=robot)
    world = replace(hills.world, resistance=())  # a resistance of its own for every place is no class's
    return replace(hills, world=world, drives=(drive,), rasters=RasterSpec(1.0, 1.0, 1.0))


def with_terrain(segments: pa.Table, world: World) -> FitSamples:
    """Return segments with the class of the world under their middle: no map has a part in it."""
    lonlat = [
        np.mean([segments[f"{end}_{axis}_deg"].to_numpy() for end in ("start", "end")], axis=0)
        for axis in ("lon", "lat")
    ]
    class_id = world.terrain_class(*world.site.map_xy_m(*lonlat))
    return replace(make_fit_samples(segments), terrain=np.array([NAMES.get(k, "other") for k in class_id.tolist()]))


def of_simulation(robot: SimulatedRobot, *, metres: float, seed: int) -> Sequence[str]:
    """Return the fit in words, and each coefficient against the plant's."""
    chosen = drive_of(robot, metres=metres)
    with tempfile.TemporaryDirectory() as directory:
        made = simulate(Path(directory) / "site", scenario=chosen, seed=seed)
        ingest(made.logs, store=Path(directory) / "store")
        run = Store(Path(directory) / "store").runs()[0]
        segments = run.segments()
    found = fit_and_validate_physics(with_terrain(segments, chosen.world), idle_watt=compute_mean_idle_power(segments))
    assert found is not None
    lines = [describe_physics("simulated robot", found)]
    weight = robot.mass_kg * GRAVITY_MPS2 / robot.drive_efficiency
    ground = {name: robot.ground[k].rolling_resistance for k, name in NAMES.items()}
    true = {
        "idle": robot.idle_watt,
        "drivetrain": robot.drivetrain_loss_newton / robot.drive_efficiency,
        "grade": weight,
        "turning": robot.scrub_torque_nm / robot.drive_efficiency,
    }
    others = (of for of in found.terms if of.term != "rolling")
    lines += [_against(f"{of.term} {of.terrain} [{of.unit}]", of.value, of.std, true[of.term]) for of in others]
    lines += [
        _against(f"C_rr {name}", *of, ground[name]) for name, of in found.rolling_resistance.items() if name in ground
    ]
    return lines


def _against(name: str, value: float, std: float, true: float) -> str:
    return f"{name:26} {value:9.3f} ± {std:7.3f}   true {true:9.3f}   off {100.0 * (value / true - 1.0):+6.2f} %"


def of_log(log: Path, recipe: Path | None) -> str:
    """Return the fit of a real log in words."""
    with tempfile.TemporaryDirectory() as directory:
        ingest([log], store=Path(directory) / "store", recipe=load_recipe(recipe))
        segments = Store(Path(directory) / "store").runs()[0].segments()
    found = fit_and_validate_physics(make_fit_samples(segments), idle_watt=compute_mean_idle_power(segments))
    return f"{log.name}: no fit" if found is None else describe_physics(log.stem, found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--metres", type=float, default=1100.0)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--saturating", action="store_true")
    parser.add_argument("--log", type=Path, nargs="*", default=[])
    parser.add_argument("--recipe", type=Path)
    told = parser.parse_args()
    if told.log:
        print(*(of_log(log, told.recipe) for log in told.log), sep="\n")
        return
    robot = plain_robot(half_radius_m=0.4) if told.saturating else plain_robot()
    print(*of_simulation(robot, metres=told.metres, seed=told.seed), sep="\n")


if __name__ == "__main__":
    main()
