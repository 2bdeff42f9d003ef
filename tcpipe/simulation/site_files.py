"""The files of a simulated site: rasters, class table, split region, logs, truth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tcpipe import __version__
from tcpipe.arrays import Floats
from tcpipe.errors import clean_lines
from tcpipe.formats.atomic import check_new, clear_beside, write_atomic_directory, write_text
from tcpipe.formats.json_files import to_json, write_json
from tcpipe.formats.logs.writing import MessageStream, write_bag, write_mcap, write_rosbag2
from tcpipe.formats.maps.geotiff import write_geotiff
from tcpipe.formats.parquet import read_table, write_table
from tcpipe.simulation.messages import make_streams
from tcpipe.simulation.route import simulate_drive
from tcpipe.simulation.scenarios import DriveSpec, RasterSpec, Scenario
from tcpipe.simulation.scenarios import find_scenario as scenario_by_name
from tcpipe.simulation.sensors import Noise, Reading, record
from tcpipe.simulation.truth import Truth
from tcpipe.simulation.world import World
from tcpipe.terrain.layers import PAPER_CLASSES, Pixels
from tcpipe.terrain.target_grid import MapGrid

_HEIGHT_NODATA = -9999.0
_PALETTE = {
    0: (255, 255, 255), 10: (200, 60, 60), 20: (20, 80, 30), 30: (70, 130, 50),
    40: (150, 200, 90), 50: (120, 85, 50), 60: (210, 180, 130), 70: (130, 130, 140),
}  # fmt: skip
"""Raster values are ten times the class id, so that the class table's ``value`` column matters."""


@dataclass(frozen=True, slots=True)
class SimulatedSite:
    """Where everything was written; one log and one truth a drive, in order."""

    directory: Path
    logs: tuple[Path, ...]
    rasters: dict[str, Path]  # height, ortho, terrain, classes (the class table)
    region: Path
    truths: tuple[Path, ...]
    world: Path
    unchanged: bool = False  # it was there already

    def __str__(self) -> str:
        """Return the written files, one a line."""
        lines = [*self.logs, *self.rasters.values(), self.region, *self.truths]
        done = [f"nothing to do: {self.directory} already contains the site"] if self.unchanged else []
        return clean_lines([*map(str, lines), *done])


def simulate(out: Path, *, scenario: str | Scenario = "demo", seed: int = 1) -> SimulatedSite:
    """Write a simulated site to ``out``, whole or not at all, unless it exists; bytes follow from scenario and seed.

    Raises `UsageError`: the scenario is unknown, or ``out`` has other content.
    """
    chosen = scenario_by_name(scenario) if isinstance(scenario, str) else scenario
    about = {"seed": seed, "datum": chosen.world.site.datum, "scenario": chosen, "tcpipe_version": __version__}
    clear_beside(out)
    site = _read_site(out, chosen)
    files = (*site.logs, *site.rasters.values(), site.region, *site.truths, site.world)
    if all(path.exists() for path in files) and site.world.read_bytes() == to_json(about).encode():
        return replace(site, unchanged=True)
    check_new(out, f"site of scenario {chosen.name}, seed {seed}")
    with write_atomic_directory(out) as directory:
        half = _read_site(directory, chosen)
        for index, spec in enumerate(chosen.drives):
            truth, messages = simulate_messages(chosen, index, seed=seed)
            write_table(truth.table(), half.truths[index])
            _write_log(half.logs[index], spec, messages)
        write_json(half.region, _make_region(chosen))
        write_rasters(directory / "maps", chosen.world, chosen.rasters)
        write_json(half.world, about)
    return site


def _read_site(out: Path, scenario: Scenario) -> SimulatedSite:
    suffixes = {"mcap": ".mcap", "bag": ".bag"}
    return SimulatedSite(
        out,
        tuple(out / "logs" / f"{spec.name}{suffixes.get(spec.container, '')}" for spec in scenario.drives),
        _make_raster_paths(out / "maps"),
        out / "region.geojson",
        tuple(out / "truth" / f"{spec.name}.parquet" for spec in scenario.drives),
        out / "world.json",
    )


def simulate_readings(scenario: Scenario, index: int = 0, *, seed: int = 1) -> tuple[Truth, dict[str, Reading]]:
    """Return the truth of one drive of a scenario, and its sensor messages; nothing is written."""
    spec, noise = scenario.drives[index], Noise(seed, index)
    plan = spec.plan if isinstance(spec.plan, tuple) else spec.plan.plan(scenario.world, noise("plan"))
    truth = simulate_drive(
        scenario.world, plan, start_m=spec.start_m, start_ns=scenario.start_ns(index), robot=spec.robot,
        weave_m=spec.weave_m, rng=noise("drive"),
    )  # fmt: skip
    return truth, record(truth, scenario.world.site, spec.sensors.mounted(spec.faults), spec.faults, noise)


def simulate_messages(scenario: Scenario, index: int = 0, *, seed: int = 1) -> tuple[Truth, list[MessageStream]]:
    """Return the truth of one drive of a scenario, and its recorded messages; nothing is written."""
    spec, (truth, readings) = scenario.drives[index], simulate_readings(scenario, index, seed=seed)
    stated = spec.sensors.mounted(spec.faults).stated(spec.faults, Noise(seed, index))
    return truth, make_streams(readings, stated, spec.recorder)


def read_truth(path: Path) -> Truth:
    """Read a truth file that `simulate` wrote."""
    return Truth.from_table(read_table(path))


def _write_log(path: Path, spec: DriveSpec, messages: Sequence[MessageStream]) -> None:
    if spec.container == "mcap":
        write_mcap(path, messages, encoding="ros1" if spec.recorder.dialect == "ros1" else "cdr")
    elif spec.container == "bag":
        write_bag(path, messages)
    else:
        write_rosbag2(path, messages, storage="mcap" if spec.container == "rosbag2_mcap" else "sqlite3")


def write_rasters(directory: Path, world: World, spec: RasterSpec) -> dict[str, Path]:
    """Write height (float32), ortho (RGBA) and terrain (palette) GeoTIFFs and the class table."""
    paths = _make_raster_paths(directory)
    height = {"dtype": "float32", "nodata": _HEIGHT_NODATA}
    terrain = {"dtype": "uint8", "nodata": 0, "palette": _PALETTE}
    for name, pixel_size_m, shift_m, pixels, options in (
        ("height", spec.height_pitch_m, (0.0, 0.0), _make_height_pixels, height),
        ("ortho", spec.ortho_pitch_m, spec.ortho_shift_m, _make_ortho_pixels, {"dtype": "uint8", "bands": 4}),
        ("terrain", spec.terrain_pitch_m, spec.terrain_shift_m, _make_terrain_pixels, terrain),
    ):
        _write_raster(paths[name], world, pixel_size_m, shift_m, pixels, **options)
    lines = [f"{10 * c.id},{c.id},{c.name},{str(c.traversable).lower()}" for c in PAPER_CLASSES.classes]
    write_text(paths["classes"], "\n".join(["value,id,name,traversable", *lines, ""]))
    return paths


def _make_raster_paths(directory: Path) -> dict[str, Path]:
    rasters = {name: directory / f"{name}.tif" for name in ("height", "ortho", "terrain")}
    return {**rasters, "classes": directory / "classes.csv"}


def _write_raster(
    path: Path,
    world: World,
    pixel_size_m: float,
    shift_m: tuple[float, float],
    pixels: Callable[[World, Floats, Floats], Pixels],
    **options: Any,
) -> None:
    site = world.site
    rows, cols = round(site.height_m / pixel_size_m), round(site.width_m / pixel_size_m)
    west, north = site.west_m + shift_m[0], site.south_m + site.height_m + shift_m[1]
    x = (west + (np.arange(cols) + 0.5) * pixel_size_m).astype(float)

    def strip(first: int, last: int) -> Pixels:
        y = (north - (np.arange(first, last) + 0.5) * pixel_size_m).astype(float)
        return pixels(world, x[None, :], y[:, None])

    write_geotiff(path, strip, MapGrid(f"EPSG:{site.epsg}", west, north, pixel_size_m, rows, cols), **options)


def _make_height_pixels(world: World, x: Floats, y: Floats) -> Pixels:
    return np.where(world.mapped(x, y), world.mapped_height_m(x, y), _HEIGHT_NODATA).astype(np.float32)[None]


def _make_ortho_pixels(world: World, x: Floats, y: Floats) -> Pixels:
    mapped = world.mapped(x, y)
    rgb = np.where(mapped[..., None], np.clip(np.round(world.ortho(x, y)), 0, 255), 0)
    return np.concatenate([np.moveaxis(rgb, -1, 0), np.where(mapped, 255, 0)[None]]).astype(np.uint8)


def _make_terrain_pixels(world: World, x: Floats, y: Floats) -> Pixels:
    return np.where(world.mapped(x, y), 10 * world.terrain_class(x, y), 0).astype(np.uint8)[None]


def _make_region(scenario: Scenario) -> dict[str, Any]:
    site = scenario.world.site
    corners = np.array(scenario.region_m) + np.array([site.west_m, site.south_m])
    lon, lat = site.lonlat_deg(corners[:, 0], corners[:, 1])
    ring = [[round(float(a), 9), round(float(b), 9)] for a, b in zip(lon, lat, strict=True)]
    geometry = {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
    feature = {"type": "Feature", "properties": {"name": "train and test"}, "geometry": geometry}
    return {"type": "FeatureCollection", "features": [feature]}
