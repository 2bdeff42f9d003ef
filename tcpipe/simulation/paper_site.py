"""The paper's site as far as it can be told from the paper: its numbers stand in ``paper_site.toml``, each with where it comes from."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from typing import Any

import numpy as np

from tcpipe.simulation.robot import GroundModel, SimulatedRobot, Wheels
from tcpipe.simulation.route import AlongRoad, Wander
from tcpipe.simulation.sensors import Gnss, Power, Sensors
from tcpipe.simulation.world import (
    GRASS,
    MUD,
    OBSTACLE,
    PAVED,
    TREE,
    UNPAVED,
    VEGETATION,
    Band,
    Ellipse,
    Hill,
    Site,
    Surface,
    SurfaceEffect,
    Wave,
    World,
    draw_waves,
)

_GROUNDS = {"grass": GRASS, "mud": MUD, "unpaved_road": UNPAVED, "paved_road": PAVED}


@dataclass(frozen=True, slots=True)
class PaperSite:
    """World, robot, sensors, and where it is driven."""

    world: World
    robot: SimulatedRobot
    sensors: Sensors
    tours: tuple[Wander | AlongRoad, ...]


def read_paper_parameters() -> dict[str, Any]:
    """Return ``paper_site.toml``: tables of numbers, each with its ``source``."""
    return tomllib.loads(files("tcpipe.simulation").joinpath("paper_site.toml").read_text(encoding="utf-8"))


def make_paper_site() -> PaperSite:
    """Return a site as large, as high and as steep as the paper's (section IV-A), its robot, and drives with its class shares."""
    told = read_paper_parameters()
    ground = {_GROUNDS[name]: GroundModel(**_read_numbers(table)) for name, table in told["ground"].items()}
    wheels = Wheels(**_read_table(Wheels, told["wheels"]))
    robot = SimulatedRobot(**_read_table(SimulatedRobot, told["robot"]), ground=ground, wheels=wheels)
    sensors = Sensors(gnss=Gnss(**_read_table(Gnss, told["gnss"])), power=Power(**_read_table(Power, told["power"])))
    return PaperSite(make_paper_world(), robot, sensors, tuple(_iterate_tours(told["drives"])))


def make_paper_surface() -> Surface:
    """Return what the ground is like from metre to metre."""
    told = read_paper_parameters()
    states = told["states"]

    def field(seed: int, name: str, count: int, **options: Any) -> tuple[Wave, ...]:
        return draw_waves(seed, count=count, total=1.0, wavelength_m=tuple(states[f"{name}_m"]), **options)

    return Surface(
        looks={
            _GROUNDS[name]: SurfaceEffect(**_read_table(SurfaceEffect, table)) for name, table in told["look"].items()
        },
        wetness=field(31, "wetness", 16),
        cover=field(32, "cover", 16),
        roughness=field(33, "roughness", 10),
        grain=field(34, "grain", 24),
        bumps=field(35, "bumps", 20),
        ridges=field(36, "ridges", 6, direction_rad=tuple(states["ridges_rad"])),
        noise=field(37, "noise", 16),
        map_noise_std_m=states["map_noise_std_m"],
        swing=states["swing"],
    )


def scale_hidden_variance(world: World, factor: float) -> World:
    """Return a world in which what nothing shows has ``factor`` times its variance."""
    hidden = tuple(replace(wave, amplitude=float(np.sqrt(factor)) * wave.amplitude) for wave in world.resistance)
    return replace(world, resistance=hidden)


def _read_numbers(table: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in table.items() if name != "source"}


def _read_table(kind: type, table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table's numbers; a name that the dataclass has not is a mistake in the file."""
    unknown = set(_read_numbers(table)) - {field.name for field in fields(kind)}
    if unknown:
        raise ValueError(f"paper_site.toml: {kind.__name__} has no {', '.join(sorted(unknown))}")
    return _read_numbers(table)


def _iterate_tours(drives: Mapping[str, Any]) -> Iterator[Wander | AlongRoad]:
    """Yield the drives: to and fro along roads, and random tours of grass and mud that stay in one of the areas."""
    for run in drives["road"]:
        yield AlongRoad(_PAPER_ROADS[run["road"]], run["from_m"], run["to_m"], run["length_m"])
    for run in drives["field"]:
        yield Wander(
            run["length_m"],
            (run["start_m"][0], run["start_m"][1]),
            shares=((GRASS, 1.0 - run["mud_share"]), (MUD, run["mud_share"])),
            x_range_m=(run["x_range_m"][0], run["x_range_m"][1]),
            max_slope_deg=drives["slope_deg"],
            climbing=drives["climbing"],
        )


_PAPER_ROADS = (
    Band(UNPAVED, 150.0, 150.0, 1.40, 4.2, 9.0, 170.0, 0.4),
    Band(UNPAVED, 300.0, 215.0, 0.06, 4.2, 12.0, 230.0, 2.0),
    Band(UNPAVED, 470.0, 150.0, 1.75, 4.2, 8.0, 150.0, 1.1),
    Band(PAVED, 300.0, 95.0, -0.04, 5.0, 14.0, 260.0, 0.0),
    Band(PAVED, 330.0, 150.0, 1.25, 5.0, 10.0, 210.0, 2.6),
)


def make_paper_world() -> World:
    """Return a site as large, as high and as steep as the paper's (section IV-A): 596 m × 305 m, 574.8 m to 661.3 m above sea level.

    Its shape is made up: a long slope with knolls, two paved and three unpaved roads, mud in the hollows, trees and hedges.
    """
    told = read_paper_parameters()
    about, surface = told["site"], told["surface"]
    rng = np.random.default_rng(about["seed"])
    site = Site(west_m=697300.0, south_m=5208300.0, width_m=about["width_m"], height_m=about["height_m"])
    slope = (Hill(420.0, 210.0, 60.0, 170.0, 130.0), Hill(120.0, 60.0, -16.0, 120.0, 80.0))
    knolls = tuple(
        Hill(x, y, float(rng.uniform(3.0, 7.5)), x_sigma, y_sigma)
        for x, y, x_sigma, y_sigma, _ in _scatter_places(site, rng, about["knolls"], size_m=(14.0, 26.0), margin_m=25.0)
    )
    mud = tuple(
        Ellipse(MUD, *place)
        for place in _scatter_places(site, rng, about["mud_patches"], size_m=(5.0, 13.0), margin_m=25.0)
    )
    hedges = tuple(
        Ellipse(VEGETATION, *place) for place in _scatter_places(site, rng, about["hedges"], size_m=(3.0, 14.0))
    )
    trees = tuple(Ellipse(TREE, *place) for place in _scatter_places(site, rng, about["trees"], size_m=(1.5, 4.5)))
    world = World(
        site,
        base_m=600.0,
        hills=slope + knolls,
        waves=draw_waves(21, count=6, total=0.12, wavelength_m=(9.0, 24.0)),
        regions=(
            *mud,
            *hedges,
            *trees,
            *_PAPER_ROADS,
            Ellipse(OBSTACLE, 60.0, 245.0, 9.0, 6.0, 0.3),
            Ellipse(OBSTACLE, 520.0, 40.0, 7.0, 5.0),
        ),
        holes=(
            Ellipse(0, 0.0, 305.0, 70.0, 40.0),
            Ellipse(0, 596.0, 0.0, 60.0, 35.0),
            Ellipse(0, 250.0, 60.0, 3.0, 2.0),
        ),
        texture=draw_waves(22, count=12, total=surface["texture_share"], wavelength_m=(0.8, 6.0)),
        resistance=draw_waves(23, count=10, total=surface["hidden_resistance_share"], wavelength_m=(1.5, 15.0)),
        surface=make_paper_surface(),
    )
    return _stretch_heights(world, about["lowest_m"], about["highest_m"])


def _scatter_places(
    site: Site, rng: np.random.Generator, count: int, *, size_m: tuple[float, float], margin_m: float = 0.0
) -> list[tuple[float, float, float, float, float]]:
    """Return random places on the paper's site: x, y, two radii [m], rotation [rad]."""
    low, high = (
        (margin_m, margin_m, *[size_m[0]] * 2, 0.0),
        (site.width_m - margin_m, site.height_m - margin_m, *[size_m[1]] * 2, np.pi),
    )
    drawn = rng.uniform(low, high, (count, 5)).tolist()
    return [(x, y, x_radius, y_radius, rotation) for x, y, x_radius, y_radius, rotation in drawn]


def _stretch_heights(world: World, lowest_m: float, highest_m: float) -> World:
    """Scale and shift the heights so that they span the given range (on a 1 m grid)."""
    x = world.site.west_m + np.arange(0.5, world.site.width_m)
    y = world.site.south_m + np.arange(0.5, world.site.height_m)
    heights = world.height_m(x[None, :], y[:, None]) - world.base_m
    factor = (highest_m - lowest_m) / float(heights.max() - heights.min())
    return replace(
        world,
        base_m=lowest_m - factor * float(heights.min()),
        hills=tuple(replace(hill, height_m=factor * hill.height_m) for hill in world.hills),
        waves=tuple(replace(wave, amplitude=factor * wave.amplitude) for wave in world.waves),
    )
