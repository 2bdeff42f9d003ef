"""A store of the paper's size without logs: its simulated map, and runs whose segments meander over it."""

import shutil
import sys
from pathlib import Path

import numpy as np
from pyproj import Geod, Transformer

from tcpipe.formats.maps.map_files import open_map
from tcpipe.formats.runs import LogOrigin
from tcpipe.pipeline.maps import add_map
from tcpipe.simulation.scenarios import find_scenario
from tcpipe.simulation.site_files import write_rasters
from tcpipe.store import Store, choose_maps, open_store
from tcpipe.tables.columns import make_lines, to_floats
from tcpipe.tables.levels import LABELLED_SEGMENTS

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from synthetic_store import add_run

RUN_ROWS = 3_300
SMALL = 500
"""Up to so many samples lie on a small site, whose map takes seconds."""
MARGIN_M = 12.0


def store_of(directory: Path, samples: int) -> Store:
    """Return a store with so many segments, about all of which lie on the map.

    The map is made once in a directory: in 2 minutes, up to `SMALL` in seconds.
    """
    maps = directory / ("maps" if samples > SMALL else "small-maps")
    if not maps.exists():
        spec = find_scenario("paper" if samples > SMALL else "tiny")
        (directory / "rasters").mkdir(parents=True, exist_ok=True)
        add_map("site", store=maps, **write_rasters(directory / "rasters", spec.world, spec.rasters))
    store = Store(directory / f"store-{samples}")
    if not Path(store.root).exists():
        open_store(store.root, create=True)
        with store.new_map("site") as (path, put):
            shutil.copytree(find_site(Store(maps)), path)
            put(store.scan())
        for number in range(-(-samples // RUN_ROWS)):
            _add_run(store, number, min(RUN_ROWS, samples - number * RUN_ROWS))
    return store


def find_site(store: Store) -> Path:
    """Return where the map of the site is."""
    (site,) = choose_maps(store, store.scan(), ["site"])
    return store.map_at(site)[0]


def meander(bounds_m: tuple[float, float, float, float], count: int, *, seed: int) -> np.ndarray:
    """Return points 1 m apart along a wandering path that turns back at the edges, shape (count + 1, 2)."""
    rng = np.random.default_rng(seed)
    low, high = np.array(bounds_m[:2]) + MARGIN_M, np.array(bounds_m[2:]) - MARGIN_M
    points = np.empty((count + 1, 2))
    points[0], course = rng.uniform(low, high), rng.uniform(-np.pi, np.pi)
    turns, swerves = rng.normal(0.0, 0.08, count), rng.normal(0.0, 0.8, count)
    for n in range(count):
        course += turns[n]
        ahead = points[n] + (np.cos(course), np.sin(course))
        if (ahead < low).any() or (ahead > high).any():
            to_middle = (low + high) / 2.0 - points[n]
            course = np.arctan2(to_middle[1], to_middle[0]) + swerves[n]
            ahead = points[n] + (np.cos(course), np.sin(course))
        points[n + 1] = ahead
    return points


def _add_run(store: Store, number: int, rows: int) -> None:
    grid = open_map(find_site(store)).grid
    points = meander(grid.bounds_m, rows, seed=number)
    lon, lat = Transformer.from_crs(grid.crs, 4326, always_xy=True).transform(*points.T)
    azimuth_deg, _, chord_m = Geod(ellps="WGS84").inv(lon[:-1], lat[:-1], lon[1:], lat[1:])
    rng = np.random.default_rng(number)
    run_id = f"husky_{number:05d}-{number:08x}"
    start_ns = 1_700_000_000_000_000_000 + number * 10**13 + np.arange(rows) * 1_200_000_000
    power = rng.normal(155.0, 15.0, rows)
    given = {
        "segment_id": [f"{run_id}-{stamp}" for stamp in start_ns],
        "run_id": [run_id] * rows,
        "robot": ["husky"] * rows,
        "start_ns": start_ns,
        "end_ns": start_ns + 1_200_000_000,
        "start_lon_deg": lon[:-1],
        "start_lat_deg": lat[:-1],
        "end_lon_deg": lon[1:],
        "end_lat_deg": lat[1:],
        "chord_m": chord_m,
        "arc_length_m": np.ones(rows),
        "course_rad": np.radians(90.0 - azimuth_deg),
        "duration_s": np.full(rows, 1.2),
        "velocity_mps": rng.normal(0.85, 0.04, rows),
        "power_watt": power,
        "energy_joule": power * 1.2,
    }
    rest = {
        column.name: rng.uniform(0.0, 0.01, rows).astype(column.dtype.to_pandas_dtype())
        for column in LABELLED_SEGMENTS.columns
        if column.name not in {*given, "geometry"}
    }
    rest["geometry"] = make_lines(np.stack([lon, lat], 1)[:-1], np.stack([lon, lat], 1)[1:])
    table = LABELLED_SEGMENTS.table(**given, **rest)
    origin = LogOrigin((f"{run_id}.mcap",), f"{number:08x}".ljust(64, "0"), 1)
    add_run(
        store, run_id, table, log=origin, distance_by_reason_m={"kept": float(to_floats(table, "arc_length_m").sum())}
    )
