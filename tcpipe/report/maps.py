"""Maps of pages: the samples of a dataset with the plot beside it, and the track of a run over a map of the store."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyproj import Transformer

from tcpipe.arrays import Box, Bytes, Floats
from tcpipe.errors import StoreError, TcpipeError, clean_line
from tcpipe.formats.dataset_card import LOCAL, DatasetCard
from tcpipe.formats.dataset_files import CLASSES, OVERVIEW, RELIEF
from tcpipe.formats.maps.map_files import MapFile, open_map
from tcpipe.formats.runs import StoredMap
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.report.colours import CLASS_COLOURS, CURSOR, FAINT, SPLIT_COLOURS, choose_class_colours
from tcpipe.report.pictures import (
    compute_joint_bounds_m,
    draw_classes,
    draw_ortho,
    draw_relief,
    make_picture_uri,
    read_picture,
)
from tcpipe.report.plots import Plot, lay_picture, make_map_plot, make_plot
from tcpipe.store import Store
from tcpipe.tables.columns import read_ends_deg, read_ends_m, stack_floats
from tcpipe.terrain.layers import TerrainClass
from tcpipe.terrain.tiles import find_map_projection

Pictures = Mapping[str, str]
"""Pictures of a map by name, as data URIs; the first is visible."""

_MOST_POINTS = 2_000  # points of a track on the map of a store
_LEAST_SHARE = 0.5  # smallest share of the track on a map that becomes its background


def draw_dataset_map(directory: Path, card: DatasetCard, xy_m: Floats) -> tuple[list[Plot], list[str]]:
    """Return the map of the samples at ``xy_m``, (N, 2), the plot beside it, and the missing parts of the map."""
    if card.maps:
        bounds = compute_joint_bounds_m([(grid.crs, grid.bounds_m) for grid in card.maps])
    elif len(xy_m):
        bounds = (*xy_m.min(axis=0).tolist(), *xy_m.max(axis=0).tolist())
    else:
        bounds = (0.0, 0.0, 1.0, 1.0)
    tools = "box_select,lasso_select"
    plot = make_map_plot(
        alt=f"Map of {len(xy_m)} points, coloured by the quantity chosen above; the tables below list the counts.",
        axes=("x [m]", "y [m]") if card.plane_crs == LOCAL else ("easting [m]", "northing [m]"),
        height_px=110 + 330 * (bounds[3] - bounds[1]) / max(bounds[2] - bounds[0], 1e-9),
        legend=make_legend(card.classes if CLASSES in card.checksums else ()),
        tools=f"pan,wheel_zoom,{tools},reset,save",
    )
    lost = _lay_dataset_pictures(plot, directory, card, bounds)
    figure = plot.figure
    ends = {end: np.empty(0) for end in ("x0", "y0", "x1", "y1")}
    leaks = figure.segment(source=ends, color=CURSOR, line_width=1.5, name="leaks", visible=False)
    leaks.level = "overlay"  # above the points that they join
    rings = _project_rings(card)
    xs, ys = ([ring[:, axis] for ring in rings] for axis in (0, 1))
    figure.multi_line(xs, ys, color="#b3202a", line_width=2, line_dash="dashed")
    corners = {
        "x": [*bounds[::2]],
        "y": [*bounds[1::2]],
        "fill": ["#ffffff"] * 2,
        "across": [0.0, 1.0],
        "up": [0.0, 1.0],
    }
    points = figure.scatter(
        "x",
        "y",
        size=7,
        fill_color="fill",
        line_color="#ffffff",
        line_width=0.4,
        nonselection_fill_alpha=0.3,
        nonselection_line_alpha=0.0,
        selection_line_color="#000000",
        selection_line_width=1.2,
        source=corners,  # until the page's script has unpacked the samples
        name="samples",
    )
    brush = make_plot(
        "brush",
        alt="Points of the map, plotted by the quantity chosen above; a box drawn here selects them on the map.",
        axes=("slope along travel [°]", "power w [W]"),
        height_px=figure.height,
        tools=f"{tools},pan,wheel_zoom,reset,save",
        drag="box_select",
    )
    brush.figure.scatter(
        "across",
        "up",
        size=5,
        fill_color="fill",
        line_color=None,
        fill_alpha=0.8,
        nonselection_fill_alpha=0.08,
        source=points.data_source,
    )
    columns = {name: list[float]() for name in ("x", "y", "across", "up")}
    ring = {"size": 16, "fill_alpha": 0.0, "line_color": CURSOR, "line_width": 3}
    marks = figure.scatter("x", "y", source=columns, name="here", **ring)
    brush.figure.scatter("across", "up", source=marks.data_source, **ring)
    return [plot, brush, _draw_histogram()], lost


def make_legend(classes: Sequence[TerrainClass]) -> dict[str, str]:
    """Return the colours of terrain classes by name."""
    colours = choose_class_colours(classes)
    return {entry.name: colours[entry.id] for entry in classes}


def _draw_histogram() -> Plot:
    """Return the histogram of all and of the selected samples, which the page's script fills."""
    plot = make_plot(
        "histogram",
        alt="Histogram of the quantity chosen below, of all and of the selected samples; a drag selects a range of it.",
        axes=("power w [W]", "samples"),
        legend={"all samples": FAINT, "selected": SPLIT_COLOURS["train"]},
        height_px=240,
        tools="xbox_select,save",
        drag="xbox_select",
    )
    bars = {name: [0.0] for name in ("left", "right", "all", "chosen")}
    all_bars = plot.figure.quad("left", "right", "all", 0, color=FAINT, source=bars, name="bars")
    plot.figure.quad("left", "right", "chosen", 0, color=SPLIT_COLOURS["train"], source=all_bars.data_source)
    plot.figure.toolbar.tools[0].renderers = []
    plot.figure.y_range.start = 0
    return plot


def _lay_dataset_pictures(plot: Plot, directory: Path, card: DatasetCard, bounds: Box) -> list[str]:
    has_ortho = any("ortho" in grid.layers for grid in card.maps)
    files = {"orthophoto" if has_ortho else "hillshade": OVERVIEW, "hillshade ": RELIEF, "classes": CLASSES}
    lost = []
    for number, (name, file) in enumerate(files.items()):
        if file not in card.checksums:
            continue
        pixels = read_picture(directory / file)
        if pixels is None:
            lost.append(f"{file} is missing or damaged: the map has no {name.strip()}")
            continue
        lay_picture(plot, name.strip(), make_picture_uri(pixels, exact=file == CLASSES), bounds, visible=number == 0)
    return lost


def _project_rings(card: DatasetCard) -> list[Floats]:
    """Return every ring of every polygon of the region in the map's plane [m], each of shape (M, 2)."""
    if card.split.region is None:
        return []
    to_map, rings = Transformer.from_crs("EPSG:4326", card.plane_crs, always_xy=True), []
    for geometry in card.split.region.values():
        polygons = (geometry.coordinates,) if geometry.type == "Polygon" else geometry.coordinates
        rings += [np.array(ring, dtype=float)[:, :2] for polygon in polygons for ring in polygon]
    return [np.column_stack(to_map.transform(ring[:, 0], ring[:, 1])) for ring in rings]


@dataclass(frozen=True, slots=True)
class RunMap:
    """The map of a run, which the page's script fills, and the places in its plane."""

    plot: Plot
    track_xy_m: Floats
    """Shape (N, 2)."""
    ends_xy_m: tuple[Floats, Floats]
    """Start and end of each segment, shape (M, 2) each."""
    ground: tuple[str, ...]
    """Names of the pictures below the track."""
    missing: tuple[str, ...]
    """Reasons why pictures are missing."""
    is_complete: bool
    """Whether no map of the store is damaged."""


@dataclass(frozen=True, slots=True)
class StoredMaps:
    """The maps of a store, as backgrounds of the pages of its runs."""

    store: Store
    records: Mapping[str, StoredMap]
    """By name."""
    pictures: dict[str, Pictures] = field(default_factory=dict)
    """Pictures by name of the map, drawn once for all runs."""


def draw_run_map(run: StoredRun, track: pa.Table, segments: pa.Table, maps: StoredMaps, *, has_datum: bool) -> RunMap:
    """Return the map; ``has_datum`` is whether the track has a place on Earth."""
    lonlat = stack_floats(track, "lon_deg", "lat_deg")
    ground, missing = _find_ground(run, lonlat, maps) if has_datum else (None, [])
    is_complete = not missing
    if ground is None:
        xy_m = stack_floats(track, "x_m", "y_m")
        plot = _draw_track(("east [m]", "north [m]"), xy_m, {})
        if not has_datum:
            missing = ["No GNSS fix: the track has only local coordinates and cannot be placed on a map."]
        elif not missing:
            missing = [
                "No map of the store covers the track." if maps.records else "The store has no map ('tcpipe add-map')."
            ]
        return RunMap(plot, xy_m, read_ends_m(segments), (), tuple(missing), is_complete)
    to_map, source, pictures = ground
    xy_m = to_map(lonlat)
    classes = source.layers["terrain"].classes if "terrain" in source.layers else None
    plot = _draw_track(("easting [m]", "northing [m]"), xy_m, make_legend(classes.classes if classes else ()))
    for number, (name, uri) in enumerate(pictures.items()):
        lay_picture(plot, name, uri, source.grid.bounds_m, visible=number == 0)
    start_m, end_m = map(to_map, read_ends_deg(segments))
    return RunMap(plot, xy_m, (start_m, end_m), tuple(pictures), tuple(missing), is_complete)


def draw_tracks(runs: Sequence[StoredRun], maps: StoredMaps) -> Plot | None:
    """Return the tracks of runs on the first map that has most of them, else in one plane; None without places."""
    places_deg = dict[str, Floats]()
    for run in runs:
        with suppress(StoreError):
            lonlat = stack_floats(run.table("track", ["lon_deg", "lat_deg"]), "lon_deg", "lat_deg")
            if len(known := lonlat[np.isfinite(lonlat).all(axis=1)]):
                places_deg[run.run_id] = known[:: max(1, len(known) // _MOST_POINTS)]
    if not places_deg:
        return None
    all_deg = np.concatenate([*places_deg.values()])
    ground, _ = _find_ground(runs[0], all_deg, maps)
    origin_m = 111_320.0 * np.array([np.cos(np.radians(all_deg[0, 1])), 1.0])  # of a degree
    to_map = ground[0] if ground else lambda lonlat: (lonlat - all_deg[0]) * origin_m
    colours = {run_id: CLASS_COLOURS[n % len(CLASS_COLOURS)] for n, run_id in enumerate(places_deg)}
    axes = ("easting [m]", "northing [m]") if ground else ("east [m]", "north [m]")
    plot = make_map_plot(alt="Map of the tracks of all runs.", axes=axes, height_px=420, legend=colours)
    lines = [
        plot.figure.line(*to_map(lonlat).T, color=colours[run_id], line_width=3, name=run_id)
        for run_id, lonlat in places_deg.items()
    ]
    plot.figure.x_range.renderers = plot.figure.y_range.renderers = lines
    if ground:
        name, uri = next(iter(ground[2].items()))
        lay_picture(plot, name, uri, ground[1].grid.bounds_m, visible=True)
    return plot


def _find_ground(
    run: StoredRun, lonlat: Floats, maps: StoredMaps
) -> tuple[tuple[Callable[[Floats], Floats], MapFile, Pictures] | None, list[str]]:
    """Return projection, map and pictures of the first map that has most of the track, and unreadable maps."""
    lost: list[str] = []
    for name, record in maps.records.items():
        try:
            source = open_map(*maps.store.map_at(record))
            to_map = find_map_projection(source, run.manifest.recipe.read.gnss_crs).forward
            if source.grid.contains(to_map(lonlat)).mean() > _LEAST_SHARE:
                if name not in maps.pictures:
                    maps.pictures[name] = _draw_pictures(source)
                return (to_map, source, maps.pictures[name]), lost
        except (TcpipeError, OSError) as error:
            lost.append(f"Map {name} cannot be shown: {clean_line(str(error))}.")
    return None, lost


def _draw_track(axes: tuple[str, str], xy_m: Floats, legend: Mapping[str, str]) -> Plot:
    low, high = xy_m.min(axis=0), xy_m.max(axis=0)
    width, height = np.maximum(high - low, 0.1 * np.max(high - low, initial=10.0))
    plot = make_map_plot(
        alt="Map of the track: segments, and where and why the rest is not used; the chart below shows the distances.",
        axes=axes,
        height_px=110 + 900 * height / width,
        legend=legend,
    )
    figure = plot.figure
    corners = {"xs": [[low[0], high[0]]], "ys": [[low[1], high[1]]], "colour": ["#00000000"]}
    none = {"xs": list[list[float]](), "ys": list[list[float]](), "colour": list[str]()}
    figure.multi_line("xs", "ys", color="colour", line_width=14, line_alpha=0.5, source=none, name="findings")
    track = figure.multi_line("xs", "ys", color="colour", line_width=3, source=corners, name="track")
    ends = {end: list[float]() for end in ("x0", "y0", "x1", "y1", "colour")}
    figure.segment("x0", "y0", "x1", "y1", color="colour", line_width=6, line_cap="butt", source=ends, name="segments")
    cursor = {"x": list[float](), "y": list[float]()}
    figure.scatter("x", "y", size=15, fill_alpha=0.0, line_color=CURSOR, line_width=3, source=cursor, name="here")
    figure.x_range.renderers = figure.y_range.renderers = [track]
    return plot


def _draw_pictures(source: MapFile) -> Pictures:
    layers = source.layers
    draw: dict[str, Callable[[MapFile], Bytes]] = {}
    if "ortho" in layers:
        draw["orthophoto"] = draw_ortho
    draw["hillshade"] = draw_relief
    if "terrain" in layers:
        draw["classes"] = draw_classes
    return {name: make_picture_uri(look(source), exact=name == "classes") for name, look in draw.items()}
