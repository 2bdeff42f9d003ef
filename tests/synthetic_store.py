"""A small store for tests of datasets: an analytic map and runs whose segments are laid out on it, without any log."""

import atexit
import os
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pyarrow as pa
import pyproj
from map_worlds import World

from tcpipe import __version__
from tcpipe.formats.documents import make_run_key, read_record
from tcpipe.formats.maps.building import build_map
from tcpipe.formats.recipe_toml import ingest_key, make_recipe_id
from tcpipe.formats.runs import Counts, LogOrigin, Recording, Run
from tcpipe.formats.stored_runs import write_streams
from tcpipe.pipeline.ingest_run import describe_recording, put_run, tag_log, write_tables
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store
from tcpipe.tables.bits import DropReason
from tcpipe.tables.columns import make_lines
from tcpipe.tables.facts import FuseFacts, PowerSign, SectionFacts, StageFacts
from tcpipe.tables.findings import StageReport
from tcpipe.tables.levels import (
    DATA_MODEL_VERSION,
    LABELLED_SEGMENTS,
    MASKED_TRACK,
    REJECTIONS,
    RESULTS_VERSION,
    STREAMS,
    TRACK,
    Datum,
    LabelledSegments,
    MaskedTrack,
    Sensor,
    Streams,
    Track,
    TrackInfo,
)
from tcpipe.terrain.layers import PAPER_SCHEME

STANDING_WATT = 90.0
WORLD = World("EPSG:32633", 533_000.0, 5_213_000.0, side_m=40.0)


def lonlat(xy_m):
    """Points around the world's middle [m] as lon, lat [deg]."""
    xy = np.asarray(xy_m, dtype=float)
    lon, lat = pyproj.Transformer.from_crs(WORLD.crs, 4326, always_xy=True).transform(
        WORLD.x_m + xy[..., 0], WORLD.y_m + xy[..., 1]
    )
    return np.stack([lon, lat], axis=-1)


def lanes(y_m, x_from_m, x_to_m):
    """Start and end points of segments along eastward lanes [m], shape (N, 2) each."""
    x = np.arange(x_from_m, x_to_m - 0.5)
    start = np.array([(east, north) for north in np.atleast_1d(y_m) for east in x])
    return start, np.add(start, (1.0, 0.0))


GEOID_M = 46.3
"""Height of the geoid above the ellipsoid at the site."""


def track_at(xy_m, ground_xy_m, *, std_m=0.02, scale=1.0, seed=3):
    """Return a track at ``xy_m`` whose heights are those of the world's ground at ``ground_xy_m`` [m from its middle]."""
    count = len(xy_m)
    position = lonlat(xy_m)
    height = scale * WORLD.height(WORLD.x_m + ground_xy_m[:, 0], WORLD.y_m + ground_xy_m[:, 1]) + GEOID_M
    noise = np.random.default_rng(seed).normal(0.0, 0.01, count)
    given = {"lon_deg": position[:, 0], "lat_deg": position[:, 1], "alt_m": height + noise}
    given |= {"x_std_m": np.full(count, std_m), "y_std_m": np.full(count, std_m)}
    rest = {
        column.name: np.zeros(count, np.int64 if pa.types.is_integer(column.dtype) else np.float64)
        for column in MASKED_TRACK.columns
        if column.name not in given
    }
    return MASKED_TRACK.table(**given, **rest)


def winding(count=3000):
    """A drive of 170 m inside the site."""
    s = np.linspace(0.0, 4.0 * np.pi, count)
    return np.stack([14.0 * np.sin(s), 13.0 * np.cos(1.5 * s)], 1)


def segments(run_id, start_xy_m, end_xy_m, *, start_ns=0, powered=True, robot="husky"):
    """A labelled-segment table of one run; labels follow the place, so that they can be checked."""
    n = len(start_xy_m)
    start, end = lonlat(start_xy_m), lonlat(end_xy_m)
    geod = pyproj.Geod(ellps="WGS84")
    azimuth_deg, _, chord_m = geod.inv(*start.T, *end.T)
    stamps = start_ns + np.arange(n) * 1_200_000_000
    power = 150.0 + np.asarray(start_xy_m)[:, 0]
    given = {
        "segment_id": [f"{run_id}-{stamp}" for stamp in stamps],
        "run_id": [run_id] * n,
        "robot": [robot] * n,
        "start_ns": stamps,
        "end_ns": stamps + 1_200_000_000,
        "start_lon_deg": start[:, 0],
        "start_lat_deg": start[:, 1],
        "end_lon_deg": end[:, 0],
        "end_lat_deg": end[:, 1],
        "chord_m": chord_m,
        "arc_length_m": np.ones(n),
        "course_rad": np.radians(90.0 - azimuth_deg),
        "position_std_m": np.full(n, 0.02),
        "velocity_mps": 0.8 + 0.001 * np.arange(n),
        "fused_velocity_mps": 0.9 + 0.001 * np.arange(n),
        "duration_s": np.full(n, 1.2),
        "power_watt": power if powered else np.full(n, np.nan),
        "energy_joule": power * 1.2 if powered else np.full(n, np.nan),
        "power_std_watt": np.ones(n) if powered else np.full(n, np.nan),
        "energy_std_joule": np.ones(n) if powered else np.full(n, np.nan),
        "idle_power_watt": np.full(n, STANDING_WATT),
        "net_power_watt": power - STANDING_WATT if powered else np.full(n, np.nan),
        "net_power_std_watt": 1.0 + 0.1 * (np.arange(n) % 7) if powered else np.full(n, np.nan),
        "net_energy_joule": 1.2 * (power - STANDING_WATT) if powered else np.full(n, np.nan),
        "net_energy_std_joule": np.full(n, 1.2) if powered else np.full(n, np.nan),
    }
    rest = {}
    for column in LABELLED_SEGMENTS.columns:
        if column.name not in given:
            rest[column.name] = np.zeros(n, np.int64 if pa.types.is_integer(column.dtype) else np.float64)
    rest["geometry"] = make_lines(start, end)
    return LABELLED_SEGMENTS.table(**given, **rest)


def driven(table, *, powered=True):
    """A masked track of 20 Hz through all segments of a table, one after the other, after five seconds of standing."""
    starts, ends = (table.column(f"{end}_ns").to_numpy() for end in ("start", "end"))
    stamps = np.arange(starts[0] - 5_000_000_000, ends[-1], 50_000_000)
    corner_s = (np.append(starts, ends[-1]) - stamps[0]) * 1e-9
    at_s = (stamps - stamps[0]) * 1e-9
    given = {"stamp_ns": stamps, "dropped_by": np.where(stamps < starts[0], int(DropReason.STATIONARY), 0)}
    for axis in ("lon", "lat"):
        corners = np.append(table.column(f"start_{axis}_deg").to_numpy(), table.column(f"end_{axis}_deg")[-1].as_py())
        given[f"{axis}_deg"] = np.interp(at_s, corner_s, corners)
    given["forward_velocity_mps"] = np.where(stamps < starts[0], 0.0, 0.8)
    given["power_watt"] = (
        np.where(stamps < starts[0], STANDING_WATT, 200.0) if powered else np.full(len(stamps), np.nan)
    )
    for name in ("wheel_velocity_mps", "voltage_volt", "current_amp"):
        given[name] = np.full(len(stamps), np.nan)
    rest = {
        column.name: np.full(len(stamps), 0 if pa.types.is_integer(column.dtype) else 0.02)
        for column in MASKED_TRACK.columns
        if column.name not in given
    }
    return MASKED_TRACK.table(**given, **rest)


def add_run(
    store,
    run_id,
    table,
    *,
    recipe=None,
    sha256=None,
    distance_by_reason_m=None,
    sensors=None,
    track=None,
    findings=(),
    tags=None,
    includes=(),
    facts=None,
    streams=None,
    state=None,
    **values,
):
    """Put a run with these segments, and this masked track, into the store, as ingestion would; ``values`` of its record differ."""
    recipe = recipe or Recipe()
    robot = table.column("robot")[0].as_py() if table.num_rows else "husky"
    power = PowerSign("drawn_positive", averaged=False, includes=includes)
    found = StageReport(tuple(findings), facts or (StageFacts(power=power) if includes else StageFacts()))
    info = TrackInfo(run_id, robot, Datum(15.43, 47.07, 400.0), 20.0, "smoother", found)
    metres = float(np.sum(table.column("arc_length_m").to_numpy()))
    distance_by_reason_m = distance_by_reason_m or {"kept": metres, "stationary": 0.0, "accelerating": 2.5}
    stamps = [table.column(name).to_numpy() for name in ("start_ns", "end_ns")] if table.num_rows else None
    run = Run(
        run_id=run_id,
        recipe_id=make_recipe_id(recipe, robot),
        data_model_version=DATA_MODEL_VERSION,
        results_version=RESULTS_VERSION,
        tcpipe_version=__version__,
        ingest_key=ingest_key(recipe),
        read_key="k",
        robot=robot,
        log=LogOrigin((f"/logs/{run_id}.mcap",), sha256 or run_id, 1),
        recording=describe_recording(streams) if streams else None,
        sensors=sensors or (streams.sensors if streams else {}),
        segments=table.num_rows,
        start_ns=stamps and int(stamps[0][0]),
        end_ns=stamps and int(stamps[1][-1]),
        distance_by_reason_m=distance_by_reason_m,
        findings=tuple(findings),
        blob="",
        tables={},
        streams_blob="",
        streams={},
        recipe=recipe.ingest,
        counts=Counts(table.num_rows),
        info=info,
    )
    run, state = replace(run, **values), state or store.scan()
    with store.place.workshop() as directory:
        if streams:
            write_streams(directory, streams, key="k")
        masked = MaskedTrack(MASKED_TRACK.empty() if track is None else track, info)
        labelled = LabelledSegments(table, info, distance_by_reason_m)
        write_tables(directory, run, Track(TRACK.empty(), REJECTIONS.empty(), info), masked, labelled)
        put_run(store, state, run, directory, None)
    if tags:
        tag_run(store, run_id, tags)


def tag_run(store, run_id, tags):
    """Add tags to those of the log of a run."""
    state = store.scan()
    for row in state.list_rows(run_id):
        tag_log(store, state, row.log.sha256, tags)


def change_run(store, run_id, **values):
    """Write the manifests of a run again, with other values."""
    state = store.scan()
    for row in state.list_rows(run_id):
        document = state.names["runs", make_run_key(row.log.sha256, row.recipe_id)]
        store.put_run(state, replace(read_record(store.place, document, Run), **values))


def supersede(store, run_id, by):
    """Make the run ``by`` a longer recording that begins as another run does."""
    for number, name in enumerate((run_id, by), 1):
        change_run(store, name, recording=Recording(first_ns=0, last_ns=number, rows=number, beginning=by))


def make_fixes(stamp_ns, *, drive=0, late_ns=0, topic="/fix"):
    """Return streams of fixes at 5 Hz between two stamps: ``drive`` gives the values at each time, ``late_ns`` is a recorder's clock."""
    time_ns = np.arange(stamp_ns[0] - late_ns, stamp_ns[1] - late_ns, 200_000_000) // 200_000_000 * 200_000_000
    noise = np.array([np.random.default_rng([drive, at]).normal(size=3) for at in time_ns.tolist()])
    known = {
        "stamp_ns": time_ns + late_ns,
        "log_time_ns": time_ns + late_ns,
        "clock_epoch": np.zeros(len(time_ns), np.int16),
    }
    known |= dict(zip(("lon_deg", "lat_deg", "alt_m"), ([15.43, 47.07, 400.0] + 1e-7 * noise).T, strict=True))
    rest = {
        column.name: np.zeros(len(time_ns)) if pa.types.is_floating(column.dtype) else np.zeros(len(time_ns), np.int8)
        for column in STREAMS["gnss"].columns
        if column.name not in known
    }
    sensor = Sensor(topic, "sensor_msgs/msg/NavSatFix", "gps", "the only one", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    return Streams({"gnss": STREAMS["gnss"].table(**known, **rest)}, {"gnss": sensor}, "husky")


def make_fuse_facts():
    """Return facts of a run of two sections."""
    sections = (SectionFacts({}, {}, {}, end_ns=1), SectionFacts({}, {}, {}, end_ns=10**10))
    return StageFacts(fuse=FuseFacts(0, (), {}, {}, {}, {}, 0.0, sections))


_BUILT = Path(mkdtemp(prefix="tcpipe-test-"))


def _remove_built(maker):
    """Remove the maps that were built, but not in a forked child, which runs the exit functions of its parent, too."""
    if os.getpid() == maker:
        shutil.rmtree(_BUILT)


atexit.register(_remove_built, os.getpid())


@cache
def _build_world(name, layers):
    """Build the analytic map, once for all stores of a process."""
    here = _BUILT / "-".join((name, *layers))
    here.mkdir()
    rasters = WORLD.write(here, pixel_size_m=0.1)
    files = {layer: rasters[layer] for layer in ("height", *layers)}
    build_map(here / "map.zarr", name=name, agreed=PAPER_SCHEME, **files)
    return here / "map.zarr"


def add_world(store, *, name="site", layers=("ortho", "terrain")):
    """Put the analytic map into the store."""
    with store.new_map(name) as (path, put):
        shutil.copytree(_build_world(name, layers), path)
        put(store.scan())


def open_world(directory: Path, **how) -> Store:
    """Make a store that has the analytic map."""
    store = open_store(directory / "store", create=True)
    add_world(store, **how)
    return store


def put_map(store, name, **how):
    """Put a map into the store, over one that is there, without a quick look."""
    with store.new_map(name) as (path, put):
        build_map(path, name=name, **{"agreed": PAPER_SCHEME, **how})
        put(store.scan())


def small_store(directory: Path) -> Store:
    """Two runs of 8 lanes each, 448 segments, on the 40 m world."""
    store = open_world(directory)
    for run_id, first in (("north", 1.0), ("south", -15.5)):
        start, end = lanes(first + 2.0 * np.arange(8), -14.0, 14.0)
        add_run(store, run_id, segments(run_id, start, end, start_ns=int(1e18 + first * 1e12)))
    return store


def region_file(path: Path, *rings_xy_m, splits=()):
    """A GeoJSON file of rings around the world's middle [m]; ``splits`` gives features their property."""
    import json

    features = []
    for number, ring in enumerate(rings_xy_m):
        closed = [*ring, ring[0]]
        properties = {"split": splits[number]} if number < len(splits) and splits[number] else {}
        features.append(
            {
                "type": "Feature",
                "properties": properties,
                "geometry": {"type": "Polygon", "coordinates": [lonlat(closed).tolist()]},
            }
        )
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def box(x0, y0, x1, y1):
    """Corners of a rectangle, counter-clockwise."""
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
