"""The errors that the simulator itself implies: those of a predictor that knows its plant and reads the world without error.

It sees what a map shows, class and height along the chord of a sample, where the pipeline believes the chord to be. What is left is
the labels' noise and what no map layer shows: the hidden resistance, its fluctuation, curves, weaving, the lag of the wheels.
"""

from __future__ import annotations

import numpy as np

from tcpipe.dataset import Split
from tcpipe.learning.metrics import Array, costs
from tcpipe.simulation.robot import SimulatedRobot
from tcpipe.simulation.world import World

_STEP_M = 0.05


def plant_costs(world: World, robot: SimulatedRobot, split: Split) -> dict[str, Array]:
    """Return w, v, T, E of every sample as the plant has it on the flat truth, shape (N,) each.

    Parameters
    ----------
    world, robot
        What was simulated.
    split
        Samples, by the ends of their chords.

    """
    ends = [split.column(f"{end}_{axis}_deg").astype(np.float64) for end in ("start", "end") for axis in ("lon", "lat")]
    x0, y0 = world.site.map_xy_m(ends[0], ends[1])
    x1, y1 = world.site.map_xy_m(ends[2], ends[3])
    half = robot.wheelbase_m / 2.0
    along = np.arange(-half, 1.0 + half + _STEP_M / 2.0, _STEP_M)
    x = x0[:, None] + (x1 - x0)[:, None] * along
    y = y0[:, None] + (y1 - y0)[:, None] * along
    direction = np.arctan2(y1 - y0, x1 - x0)[:, None]
    scale, _ = world.site.ground_from_map(x.ravel(), y.ravel(), (world.height_m(x, y) + world.site.geoid_m).ravel())
    rise_x, rise_y = world.gradient(x, y)
    slope = np.arctan((rise_x * np.cos(direction) + rise_y * np.sin(direction)) / np.reshape(scale, x.shape))
    ground = robot.ground_table()[world.terrain_class(x, y)]
    under = [_mean_over(ground[..., column], round(robot.wheelbase_m / _STEP_M) + 1) for column in range(3)]
    cut = (x.shape[1] - under[0].shape[1]) // 2
    slope = slope[:, cut : x.shape[1] - cut]
    wheel = robot.max_velocity_mps * robot.speed_factor(under[0], np.sin(slope))
    velocity = wheel * (1.0 - robot.slip(under[1], np.sin(slope))) * np.cos(slope)
    still = np.zeros_like(slope)
    mechanical = robot.wheel_power_watt(
        wheel_velocity_mps=wheel,
        acceleration_mps2=still,
        yaw_rate_radps=still,
        slope_rad=slope,
        rolling_resistance=under[2],
    )
    power = robot.propulsion_watt(mechanical, wheel)
    seconds_per_m = np.mean(1.0 / velocity, axis=1)
    joule_per_m = np.mean(power / velocity, axis=1)
    return costs(joule_per_m / seconds_per_m, 1.0 / seconds_per_m, 1.0)


def _mean_over(values: Array, count: int) -> Array:
    """Return the running mean of ``count`` neighbours, shape (N, K - count + 1)."""
    sums = np.cumsum(np.pad(values, ((0, 0), (1, 0))), axis=1)
    return np.asarray((sums[:, count:] - sums[:, :-count]) / count)
