"""Scenarios of `tcpipe simulate`: a world, drives over it, their sensors and faults, and how the rasters are cut.

The paper's site follows the paper as far as described there: ``paper_site.toml`` has its numbers, each with its source.
"""

import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib.resources import files
from typing import Any, Literal

import numpy as np

from tcpipe.errors import UsageError
from tcpipe.simulation.messages import Recorder
from tcpipe.simulation.robot import GroundModel, SimulatedRobot, Wheels
from tcpipe.simulation.route import AlongRoad, Leg, Manoeuvre, Pause, Reverse, Stuck, Turn, Wander
from tcpipe.simulation.sensors import Faults, Gnss, Imu, Power, Sensors, Visual
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
    World,
    draw_waves,
)

HUSKY_ROS2 = Recorder("ros2", "clearpath_power")
HUSKY_ROS1 = Recorder("ros1", "husky_status")

Container = Literal["mcap", "bag", "rosbag2", "rosbag2_mcap"]
"""ROS 2 messages in MCAP (ROS 1 with the ROS 1 recorder); ROS 1 bag; ROS 2 bag directories with sqlite3 or MCAP."""

# Two thirds of the small world, with a bent border.
_WEST = ((1.0, 1.0), (80.0, 2.0), (74.0, 40.0), (80.0, 79.0), (2.0, 78.0))
_FIRST_START_NS = 1_700_000_000_000_000_000
_BETWEEN_DRIVES_NS = 3_600_000_000_000


@dataclass(frozen=True, slots=True)
class DriveSpec:
    """One drive: its route, its sensors, and their faults."""

    name: str
    plan: tuple[Manoeuvre, ...] | Wander | AlongRoad
    start_m: tuple[float, float]  # from the site's south-west corner
    container: Container = "mcap"
    recorder: Recorder = HUSKY_ROS2
    sensors: Sensors = field(default_factory=Sensors)
    faults: Faults = field(default_factory=Faults)
    robot: SimulatedRobot = field(default_factory=SimulatedRobot)
    weave_m: float = 0.04


@dataclass(frozen=True, slots=True)
class RasterSpec:
    """Pixel size and shift of each raster of the world; no two rasters share a grid."""

    height_pitch_m: float = 0.05
    ortho_pitch_m: float = 0.06
    terrain_pitch_m: float = 0.05
    ortho_shift_m: tuple[float, float] = (0.013, -0.021)
    terrain_shift_m: tuple[float, float] = (0.017, 0.008)


_COARSE = RasterSpec(0.1, 0.12, 0.1)
_WESTERN_HALF = ((2.0, 2.0), (60.0, 2.0), (60.0, 78.0), (2.0, 78.0))


@dataclass(frozen=True, slots=True)
class Scenario:
    """A site with its drives."""

    name: str
    world: World
    drives: tuple[DriveSpec, ...]
    region_m: tuple[tuple[float, float], ...]
    """The part to train and test in: a polygon from the site's south-west corner."""
    rasters: RasterSpec = RasterSpec()

    def start_ns(self, drive: int) -> int:
        """Return when a drive starts; they are an hour apart."""
        return _FIRST_START_NS + drive * _BETWEEN_DRIVES_NS


def make_small_world(site: Site | None = None) -> World:
    """Return 120 m × 80 m with three hills of up to 22.5°, two roads, mud, trees, and a hole in the rasters."""
    return World(
        site=Site() if site is None else site,
        base_m=598.0,
        hills=(
            Hill(34.0, 52.0, 6.1, 10.0, 11.5), Hill(86.0, 26.0, 6.4, 12.5, 10.0),
            Hill(92.0, 66.0, 4.2, 14.0, 9.0), Hill(52.0, 12.0, -2.6, 16.0, 9.0),
        ),
        waves=draw_waves(11, count=5, total=0.10, wavelength_m=(9.0, 22.0)),
        regions=(
            Band(UNPAVED, 62.0, 40.0, 1.35, 4.0, 3.0, 70.0, 0.4), Band(PAVED, 60.0, 24.0, 0.12, 4.6, 4.0, 85.0, 1.0),
            Ellipse(MUD, 22.0, 22.0, 8.0, 5.5, 0.5), Ellipse(MUD, 100.0, 48.0, 9.0, 6.0, 2.2),
            Ellipse(MUD, 50.0, 66.0, 6.0, 5.0, 0.0),
            Ellipse(VEGETATION, 112.0, 12.0, 6.0, 8.0, 0.2), Ellipse(VEGETATION, 9.0, 70.0, 7.0, 6.0, 0.0),
            Ellipse(TREE, 74.0, 52.0, 2.2, 2.2), Ellipse(TREE, 40.0, 36.0, 2.0, 2.0),
            Ellipse(OBSTACLE, 30.0, 8.0, 3.0, 1.5, 0.9),
        ),
        holes=(Ellipse(0, 118.0, 78.0, 9.0, 7.0), Ellipse(0, 71.0, 30.4, 2.2, 1.6)),
        texture=draw_waves(12, count=10, total=0.05, wavelength_m=(0.8, 5.0)),
        resistance=draw_waves(13, count=8, total=0.03, wavelength_m=(1.5, 12.0)),
    )  # fmt: skip


def _make_visible_world() -> World:
    """Return the small world as a drone sees it one morning: sunlit, wet here and there, with a wood and a hedge.

    Trees and hedges are within 5 m of the border, away from all drives, which are those of the small world.
    """
    world = make_small_world()
    edges = (
        Band(VEGETATION, 60.0, 1.2, 0.0, 2.2, 0.5, 17.0),
        Band(TREE, 30.0, 79.6, 0.02, 3.6, 0.7, 7.3, 1.0),
        Band(TREE, 30.0, 79.2, 0.02, 3.0, 0.9, 4.1),
    )
    surface = replace(make_paper_surface(), wetness=draw_waves(31, count=16, total=1.0, wavelength_m=(4.0, 28.0)))
    return replace(world, regions=(*edges, *world.regions), surface=surface, sun=(0.5, 0.35, 0.79))


Numbers = dict[str, Any]
_GROUNDS = {"grass": GRASS, "mud": MUD, "unpaved_road": UNPAVED, "paved_road": PAVED}


@dataclass(frozen=True, slots=True)
class PaperSite:
    """World, robot, sensors, and where it is driven."""

    world: World
    robot: SimulatedRobot
    sensors: Sensors
    tours: tuple[Wander | AlongRoad, ...]


def read_paper_parameters() -> Numbers:
    """Return the tables of ``paper_site.toml`` without the ``source`` of each."""
    return _drop_sources(
        tomllib.loads(files("tcpipe.simulation").joinpath("paper_site.toml").read_text(encoding="utf-8"))
    )


def _drop_sources(table: Numbers) -> Numbers:
    kept = {name: value for name, value in table.items() if name != "source"}
    return {name: _drop_sources(value) if isinstance(value, dict) else value for name, value in kept.items()}


def make_paper_site() -> PaperSite:
    """Return a site of the paper's size, heights, slopes (section IV-A), its robot, and drives by its class shares."""
    parameters = read_paper_parameters()
    ground = {_GROUNDS[name]: GroundModel(**table) for name, table in parameters["ground"].items()}
    robot = SimulatedRobot(**parameters["robot"], ground=ground, wheels=Wheels(**parameters["wheels"]))
    sensors = Sensors(gnss=Gnss(**parameters["gnss"]), power=Power(**parameters["power"]))
    return PaperSite(make_paper_world(), robot, sensors, tuple(_iterate_tours(parameters["drives"])))


def make_paper_surface() -> Surface:
    """Return the variation of the ground from metre to metre."""
    parameters = read_paper_parameters()
    states = parameters["states"]
    fields = (
        ("wetness", 16),
        ("cover", 16),
        ("roughness", 10),
        ("grain", 24),
        ("bumps", 20),
        ("ridges", 6),
        ("noise", 16),
    )
    waves = {
        name: draw_waves(
            31 + number, count=count, total=1.0, wavelength_m=tuple(states[f"{name}_m"]),
            direction_rad=tuple(states["ridges_rad"]) if name == "ridges" else (0.0, np.pi),
        )
        for number, (name, count) in enumerate(fields)
    }  # fmt: skip
    looks = {_GROUNDS[name]: SurfaceEffect(**table) for name, table in parameters["look"].items()}
    return Surface(looks, **waves, map_noise_std_m=states["map_noise_std_m"], swing=states["swing"])


def _iterate_tours(drives: Numbers) -> Iterator[Wander | AlongRoad]:
    """Yield the drives: to and fro along roads, and random tours of grass and mud that stay in one of the areas."""
    for run in drives["road"]:
        yield AlongRoad(_PAPER_ROADS[run["road"]], run["from_m"], run["to_m"], run["length_m"])
    for run in drives["field"]:
        shares = ((GRASS, 1.0 - run["mud_share"]), (MUD, run["mud_share"]))
        start_m, x_range_m = (run["start_m"][0], run["start_m"][1]), (run["x_range_m"][0], run["x_range_m"][1])
        steep = {"max_slope_deg": drives["slope_deg"], "climbing": drives["climbing"]}
        yield Wander(run["length_m"], start_m, shares=shares, x_range_m=x_range_m, **steep)


_PAPER_ROADS = (
    Band(UNPAVED, 150.0, 150.0, 1.40, 4.2, 9.0, 170.0, 0.4),
    Band(UNPAVED, 300.0, 215.0, 0.06, 4.2, 12.0, 230.0, 2.0),
    Band(UNPAVED, 470.0, 150.0, 1.75, 4.2, 8.0, 150.0, 1.1),
    Band(PAVED, 300.0, 95.0, -0.04, 5.0, 14.0, 260.0, 0.0),
    Band(PAVED, 330.0, 150.0, 1.25, 5.0, 10.0, 210.0, 2.6),
)


def make_paper_world() -> World:
    """Return a site of the paper's extent and heights (section IV-A): 596 m × 305 m, 574.8 m to 661.3 m high.

    Its shape is invented: a long slope with knolls, two paved and three unpaved roads, mud in hollows, hedges.
    """
    parameters = read_paper_parameters()
    about, surface = parameters["site"], parameters["surface"]
    rng = np.random.default_rng(about["seed"])
    site = Site(west_m=697300.0, south_m=5208300.0, width_m=about["width_m"], height_m=about["height_m"])
    slope = (Hill(420.0, 210.0, 60.0, 170.0, 130.0), Hill(120.0, 60.0, -16.0, 120.0, 80.0))
    places = _scatter_places(site, rng, about["knolls"], size_m=(14.0, 26.0), margin_m=25.0)
    knolls = tuple(Hill(x, y, float(rng.uniform(3.0, 7.5)), *sigmas_m) for x, y, *sigmas_m, _ in places)
    plants = tuple(
        Ellipse(class_id, *place)
        for class_id, name, size_m, margin_m in (
            (MUD, "mud_patches", (5.0, 13.0), 25.0), (VEGETATION, "hedges", (3.0, 14.0), 0.0),
            (TREE, "trees", (1.5, 4.5), 0.0),
        )
        for place in _scatter_places(site, rng, about[name], size_m=size_m, margin_m=margin_m)
    )  # fmt: skip
    world = World(
        site,
        base_m=600.0,
        hills=slope + knolls,
        waves=draw_waves(21, count=6, total=0.12, wavelength_m=(9.0, 24.0)),
        regions=(
            *plants, *_PAPER_ROADS,
            Ellipse(OBSTACLE, 60.0, 245.0, 9.0, 6.0, 0.3), Ellipse(OBSTACLE, 520.0, 40.0, 7.0, 5.0),
        ),
        holes=(
            Ellipse(0, 0.0, 305.0, 70.0, 40.0), Ellipse(0, 596.0, 0.0, 60.0, 35.0), Ellipse(0, 250.0, 60.0, 3.0, 2.0),
        ),
        texture=draw_waves(22, count=12, total=surface["texture_share"], wavelength_m=(0.8, 6.0)),
        resistance=draw_waves(23, count=10, total=surface["hidden_resistance_share"], wavelength_m=(1.5, 15.0)),
        surface=make_paper_surface(),
    )  # fmt: skip
    x, y = site.west_m + np.arange(0.5, site.width_m), site.south_m + np.arange(0.5, site.height_m)
    heights = world.height_m(x[None, :], y[:, None]) - world.base_m
    factor = (about["highest_m"] - about["lowest_m"]) / float(heights.max() - heights.min())
    return replace(
        world,
        base_m=about["lowest_m"] - factor * float(heights.min()),
        hills=tuple(replace(hill, height_m=factor * hill.height_m) for hill in world.hills),
        waves=tuple(replace(wave, amplitude=factor * wave.amplitude) for wave in world.waves),
    )


def _scatter_places(
    site: Site, rng: np.random.Generator, count: int, *, size_m: tuple[float, float], margin_m: float
) -> list[list[float]]:
    """Return random places on the paper's site: x, y, two radii [m], rotation [rad]."""
    low = (margin_m, margin_m, *[size_m[0]] * 2, 0.0)
    high = (site.width_m - margin_m, site.height_m - margin_m, *[size_m[1]] * 2, np.pi)
    return rng.uniform(low, high, (count, 5)).tolist()  # type: ignore[no-any-return]


def _make_paper() -> Scenario:
    """Drives over the paper's site, mcap and bag in turn; its western part is to train and test in."""
    site = make_paper_site()
    drives = tuple(
        DriveSpec(
            f"paper_{number:02d}", tour, tour.start_m, "mcap" if number % 2 else "bag",
            HUSKY_ROS2 if number % 2 else HUSKY_ROS1, site.sensors, Faults.every(), site.robot,
        )
        for number, tour in enumerate(site.tours, 1)
    )  # fmt: skip
    region = ((1.0, 1.0), (398.0, 1.0), (386.0, 120.0), (412.0, 200.0), (396.0, 304.0), (1.0, 304.0))
    return Scenario("paper", site.world, drives, region)


def _make_paper_quick() -> Scenario:
    """Return the paper's robot and sensors on the small world for some minutes, with coarse rasters."""
    site = make_paper_site()
    starts = ((14.0, 34.0), (40.0, 60.0), (110.0, 30.0))
    drives = tuple(
        DriveSpec(
            f"quick_{number}", Wander(190.0, start, odd_manoeuvres=False), start, "mcap", HUSKY_ROS2, site.sensors,
            Faults.only("gnss_noise", "wheel_slip", "wheel_noise", "imu_noise", "visual_noise", "power_noise"),
            site.robot,
        )
        for number, start in enumerate(starts, 1)
    )  # fmt: skip
    world = replace(make_small_world(), surface=make_paper_surface(), resistance=site.world.resistance)
    return Scenario("paper_quick", world, drives, _WEST, _COARSE)


def _make_demo() -> Scenario:
    pose_only = replace(Sensors(), visual=Visual(says="pose"), imu=Imu(rate_hz=100.0, orientation=False))
    first, second = (Wander(170.0, start_m) for start_m in ((110.0, 30.0), (90.0, 55.0)))
    drives = (
        DriveSpec("husky_2023-11-14_a", first, first.start_m, faults=Faults.every()),
        DriveSpec("husky_2023-11-14_b", second, second.start_m, "bag", HUSKY_ROS1, pose_only, Faults.every()),
    )
    return Scenario("demo", _make_visible_world(), drives, _WEST)


def _make_hills12() -> Scenario:
    plan, sensors = Wander(500.0, (14.0, 34.0), climbing=0.5), replace(Sensors(), imu=Imu(rate_hz=200.0))
    drive = DriveSpec("hills12", plan, plan.start_m, sensors=sensors, faults=Faults.every())
    return Scenario("hills12", make_small_world(), (drive,), _WEST)


def make_tiny(
    faults: Faults | None = None,
    *,
    container: Container = "mcap",
    recorder: Recorder = HUSKY_ROS2,
    sensors: Sensors | None = None,
    seconds: float = 30.0,
) -> Scenario:
    """Return a short drive with chosen faults, over a slope, a curve and a turn in place; its rasters are coarse."""
    length_m = max(seconds - 14.0, 4.0) * 0.85 / 2.0
    plan = (
        Pause(2.0),
        Leg(((14.0 + length_m * 0.6, 34.0), (14.0 + length_m, 34.0 + length_m * 0.3))),
        Pause(1.0),
        Turn(2.0),
        Leg(((14.0 + length_m * 0.5, 34.0 + length_m * 0.55), (14.0, 34.0 + length_m * 0.4)), radius_m=1.5),
        Pause(1.0),
    )
    drive = DriveSpec(
        "tiny", plan, (14.0, 34.0), container, recorder, sensors if sensors is not None else Sensors(),
        faults if faults is not None else Faults(),
    )  # fmt: skip
    return Scenario("tiny", make_small_world(), (drive,), _WESTERN_HALF, _COARSE)


def _make_manoeuvres() -> Scenario:
    plan = (
        Pause(3.0), Leg(((30.0, 34.0),)), Pause(1.0), Turn(np.pi / 2), Turn(-np.pi), Pause(0.5), Reverse(3.0),
        Pause(0.5),
        Leg(((36.0, 44.0), (30.0, 50.0)), radius_m=1.2), Stuck(3.0), Leg(((20.0, 56.0),), command=0.5), Pause(2.0),
    )  # fmt: skip
    drive = DriveSpec("manoeuvres", plan, (14.0, 34.0))
    return Scenario("manoeuvres", make_small_world(), (drive,), _WESTERN_HALF, _COARSE)


SCENARIOS: Mapping[str, Callable[[], Scenario]] = {
    "demo": _make_demo,
    "hills12": _make_hills12,
    "paper": _make_paper,
    "paper_quick": _make_paper_quick,
    "tiny": make_tiny,
    "manoeuvres": _make_manoeuvres,
}
"""Scenarios by name: demo (two drives of 4 min), hills12 (12 min, all faults), paper (eleven drives of 0.5 to 1.5 km),
paper_quick (three short ones of the same robot), tiny (half a minute), manoeuvres (one of each, no faults)."""


def find_scenario(name: str) -> Scenario:
    """Return a scenario by name; `UsageError` lists those there are."""
    if name not in SCENARIOS:
        raise UsageError(f"scenario {name!r} is unknown; there are {', '.join(SCENARIOS)}")
    return SCENARIOS[name]()
