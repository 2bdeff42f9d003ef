"""How often 90 % intervals of a table model hold what further drives measure: metres, and paths of 10, 30 and 100 m.

    python benchmarks/path_coverage.py [--train 10] [--metres 700] [--further 24] [--trainings 1]

Drives wander over the paper's simulated site. They are simulated as labels, metre by metre, not as logs: time and energy of the plant
at 11 points of a metre, with the hidden resistance of the place, a level of the run's own (5 % of the resistance, 2 % of the speed), the
fluctuation in time, and end points that err by 2 cm, whose errors neighbours share with opposite sign. The table is the one that `train`
fits, curves and trees; it sees class, slope, its change and cross slope, as of a patch. Its residuals are those of blocks of 10 m, as
training has them. Coverage is the mean over the further drives, with the 95 % interval of drawing them anew (percentile bootstrap, 2000
draws); 90 is to lie in it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.cost.prediction_errors import Errors, fit_bias_correction, fit_errors
from tcpipe.learning.table_model import TableModel, fit_table
from tcpipe.planning.path_cost import cut_path
from tcpipe.simulation import find_scenario
from tcpipe.simulation.robot import SimulatedRobot
from tcpipe.simulation.route import Leg, Wander
from tcpipe.simulation.world import World

Floats = NDArray[np.float64]

LENGTHS = (1, 10, 30, 100)
POINTS = 11
END_STD_M, RUN_RESISTANCE, RUN_SPEED = 0.02, 0.05, 0.02
QUANTITIES = ("duration", "energy")
CHANNELS, CLASS_COUNT = ("height", "terrain"), 7


@dataclass(frozen=True)
class Held:
    """Share of paths that intervals hold, the 95 % interval of that over drives, and the median half-width [of the prediction]."""

    share: float
    low: float
    high: float
    half_width: float


@dataclass(frozen=True)
class Drive:
    """Metres of one run, in order: what a table sees, what was measured, and where."""

    run: str
    features: Floats
    class_id: NDArray[np.int64]
    power_watt: Floats
    velocity_mps: Floats
    start_ns: NDArray[np.int64]
    block: NDArray[np.int64]


def wandering(world: World, rng: np.random.Generator, metres: float) -> Floats:
    """Return start and end of consecutive metres [map m], shape (N, 2, 2)."""
    site = world.site
    while True:
        start = (float(rng.uniform(20.0, site.width_m - 20.0)), float(rng.uniform(20.0, site.height_m - 20.0)))
        if world.terrain_class(np.array(start[0] + site.west_m), np.array(start[1] + site.south_m)) >= 4:
            plan = Wander(metres, start, odd_manoeuvres=False).plan(world, rng)
            points = np.array([start, *(at for leg in plan if isinstance(leg, Leg) for at in leg.waypoints_m)])
            pieces = cut_path(points + np.array([site.west_m, site.south_m]), chord_m=1.0, scale=1.0)
            return np.stack([pieces.start_xy_m, pieces.end_xy_m], axis=1)[:-1]


def drive(world: World, robot: SimulatedRobot, rng: np.random.Generator, *, metres: float, run: str) -> Drive:
    """Return a drive's labels."""
    ends = wandering(world, rng, metres)
    share = np.linspace(0.0, 1.0, POINTS)
    x, y = (ends[:, 0, axis, None] + (ends[:, 1] - ends[:, 0])[:, axis, None] * share for axis in (0, 1))
    course = np.arctan2(*(ends[:, 1] - ends[:, 0]).T[::-1])[:, None]
    east, north = world.gradient(x, y)
    slope = np.arctan(east * np.cos(course) + north * np.sin(course))
    cross = np.arctan(north * np.cos(course) - east * np.sin(course))
    classes = world.terrain_class(x, y)
    ground = robot.ground_table()[classes]
    fluctuation = robot.resistance_noise * rng.standard_normal(x.shape) * 0.4
    resistance = (
        ground[..., 2] * world.resistance_factor(x, y) * (1.0 + RUN_RESISTANCE * rng.standard_normal() + fluctuation)
    )
    pace = 1.0 + RUN_SPEED * rng.standard_normal()
    wheel = pace * robot.max_velocity_mps * robot.speed_factor(ground[..., 0], np.sin(slope))
    velocity = wheel * (1.0 - robot.slip(ground[..., 1], np.sin(slope))) * np.cos(slope)
    still = np.zeros_like(slope)
    mechanical = robot.wheel_power_watt(
        wheel_velocity_mps=wheel,
        acceleration_mps2=still,
        yaw_rate_radps=still,
        slope_rad=slope,
        rolling_resistance=resistance,
    )
    power = robot.propulsion_watt(mechanical, wheel)
    length = 1.0 + np.diff(END_STD_M * rng.standard_normal(len(x) + 1))  # of ground in what was taken for a metre
    duration, energy = length * np.mean(1.0 / velocity, axis=1), length * np.mean(power / velocity, axis=1)
    begun = np.concatenate([[0.0], np.cumsum(duration)[:-1]])
    shares = np.stack([(classes == k + 1).mean(axis=1) for k in range(CLASS_COUNT)], axis=1)
    unknown = np.zeros((len(x), 3))  # curvature across, roughness and relief
    features = np.column_stack([slope.mean(axis=1), np.abs(cross.mean(axis=1)), np.ptp(slope, axis=1), unknown, shares])
    blocks = np.floor(ends.mean(axis=1) / 10.0).astype(np.int64)
    under = np.array([np.bincount(row).argmax() for row in classes])
    return Drive(
        run, features, under, energy / duration, 1.0 / duration, (begun * 1e9).astype(np.int64), blocks @ [1_000_003, 1]
    )


def trained(drives: list[Drive]) -> tuple[TableModel, dict[str, NDArray[np.generic]]]:
    """Return a table of all metres, and what the other folds said of each."""
    features = np.concatenate([of.features for of in drives])
    labels = np.column_stack(
        [np.concatenate([getattr(of, name) for of in drives]) for name in ("power_watt", "velocity_mps")]
    )
    folds = np.random.default_rng(0).permuted(np.arange(5).repeat(200_000))[
        np.concatenate([of.block for of in drives]) % 1_000_000
    ]
    weights = np.ones_like(labels)
    table, said = fit_table(features, labels, weights, folds, channels=CHANNELS, class_count=CLASS_COUNT)
    return table, {
        "run_id": np.concatenate([[of.run] * len(of.block) for of in drives]),
        "start_ns": np.concatenate([of.start_ns for of in drives]),
        "terrain_class": np.concatenate([of.class_id for of in drives]),
        "power_watt": labels[:, 0],
        "velocity_mps": labels[:, 1],
        "power_predicted_watt": said[:, 0],
        "velocity_predicted_mps": said[:, 1],
    }


def held(errors: dict[str, Errors], said: dict[str, Floats], of: Drive) -> Iterator[tuple[str, int, float, float]]:
    """Yield for each quantity and length what share of a drive's paths an interval holds, and its half-width over the prediction."""
    true = {"duration": 1.0 / of.velocity_mps, "energy": of.power_watt / of.velocity_mps}
    for name in QUANTITIES:
        for metres in LENGTHS:
            first = range(0, len(of.block) - metres + 1, metres)
            ends = [
                errors[name].compute_sum_interval(said[name][k : k + metres], of.class_id[k : k + metres])
                for k in first
            ]
            if metres == 1:
                ends = list(zip(*errors[name].compute_intervals(said[name], of.class_id), strict=True))
            measured = np.add.reduceat(true[name], first)[: len(ends)]
            measured[-1] = true[name][first[-1] : first[-1] + metres].sum()
            low, high = np.array(ends).T
            width = float(np.median((high - low) / 2.0 / np.abs(np.add.reduceat(said[name], first))))
            yield name, metres, float(np.mean((measured >= low) & (measured <= high))), width


def coverage(*, train: int, metres: float, further: int, seed: int, sites: int = 1) -> dict[tuple[str, int], Held]:
    """Return by quantity and length how many paths of further drives are held, over ``sites`` trainings of so many drives each."""
    found: dict[tuple[str, int], list[tuple[float, float]]] = {}
    rng = np.random.default_rng(seed)
    for _ in range(sites):
        for name, length, share, width in trial(rng, train=train, metres=metres, further=further):
            found.setdefault((name, length), []).append((share, width))
    out = {}
    for key, values in found.items():
        shares, widths = np.array(values).T
        draws = shares[rng.integers(0, len(shares), (2000, len(shares)))].mean(axis=1)
        low, high = np.quantile(draws, (0.025, 0.975)).tolist()
        out[key] = Held(float(shares.mean()), low, high, float(np.median(widths)))
    return out


def trial(
    rng: np.random.Generator, *, train: int, metres: float, further: int
) -> Iterator[tuple[str, int, float, float]]:
    """Train on drives and yield `held` of further ones."""
    site = find_scenario("paper")
    made = [drive(site.world, site.drives[0].robot, rng, metres=metres, run=f"run{k}") for k in range(train + further)]
    table, residuals = trained(made[:train])
    centring, errors = fit_bias_correction(residuals), fit_errors(residuals)
    assert errors is not None
    for of in made[train:]:
        power, velocity = centring.apply(*table.predict(of.features).T, of.class_id)
        yield from held(errors, {"duration": 1.0 / velocity, "energy": power / velocity}, of)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", type=int, default=10)
    parser.add_argument("--metres", type=float, default=700.0)
    parser.add_argument("--further", type=int, default=24)
    parser.add_argument("--trainings", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    told = parser.parse_args()
    found = coverage(train=told.train, metres=told.metres, further=told.further, seed=told.seed, sites=told.trainings)
    print(
        f"{told.trainings} x {told.train} drives of {told.metres:.0f} m to train on, {told.further} further ones each"
    )
    for (name, metres), of in found.items():
        verdict = "holds 90" if of.low <= 0.9 <= of.high else "does NOT hold 90"
        percent = [100.0 * value for value in (of.share, of.low, of.high, of.half_width)]
        print(
            f"{name:8} {metres:4d} m: {percent[0]:5.1f} % ({percent[1]:.1f} to {percent[2]:.1f}: {verdict}), ± {percent[3]:.1f} %"
        )


if __name__ == "__main__":
    main()
