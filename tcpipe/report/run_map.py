"""The map of a run's page: the ground under the track, if a map of the store has it, and room for what the page's script draws."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyproj import Transformer

from tcpipe.errors import TcpipeError, clean_line
from tcpipe.formats.maps.map_files import MapFile, open_map
from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.report.colours import CURSOR
from tcpipe.report.pictures import Bounds, draw_classes, draw_ortho, draw_relief, make_picture_uri
from tcpipe.report.plots import Plot, lay_picture, make_plot
from tcpipe.store import Store
from tcpipe.tables.columns import read_lonlat_deg, to_floats

Floats = NDArray[np.float64]

_MOSTLY = 0.5


@dataclass(frozen=True, slots=True)
class RunMap:
    """The plot, the plane it is drawn in, names of the pictures on it, and in words why maps are not there."""

    plot: Plot
    track_xy_m: Floats
    """Shape (N, 2)."""
    ends_xy_m: tuple[Floats, Floats]
    """Start and end of each segment, shape (M, 2) each."""
    ground: tuple[str, ...]
    missing: tuple[str, ...]


Pictures = MutableMapping[str, str]
"""Pictures of a map by name, as data URIs."""


def run_map(
    store: Store,
    run: RunDirectory,
    track: pa.Table,
    segments: pa.Table,
    *,
    located: bool,
    of_maps: MutableMapping[str, Pictures],
) -> RunMap:
    """Return the map; ``located`` is whether the track has a place on Earth, ``of_maps`` are the pictures of maps drawn so far, by name."""
    lonlat = np.column_stack([to_floats(track, "lon_deg"), to_floats(track, "lat_deg")])
    found, missing = _map_under(store, run, lonlat, of_maps) if located else (None, [])
    if found is None:
        ends = tuple(
            np.column_stack([to_floats(segments, f"{end}_{axis}_m") for axis in "xy"]) for end in ("start", "end")
        )
        xy_m = np.column_stack([to_floats(track, "x_m"), to_floats(track, "y_m")])
        plot = _make_empty_plot("map", ("east [m]", "north [m]"), xy_m)
        return RunMap(
            plot, xy_m, (ends[0], ends[1]), (), (*missing, *_find_absent(store, located=located, lost=bool(missing)))
        )
    to_map, bounds_m, pictures = found
    xy_m = to_map(lonlat)
    plot = _make_empty_plot("map", ("easting [m]", "northing [m]"), xy_m)
    for number, (name, uri) in enumerate(pictures.items()):
        lay_picture(plot, name, uri, bounds_m, visible=number == 0)
    ends_xy_m = to_map(read_lonlat_deg(segments, "start")), to_map(read_lonlat_deg(segments, "end"))
    return RunMap(plot, xy_m, ends_xy_m, tuple(pictures), tuple(missing))


def _find_absent(store: Store, *, located: bool, lost: bool) -> Sequence[str]:
    if not located:
        return ["No fix of a GNSS: the track lies in a plane of its own, and no map can be laid under it."]
    if lost:
        return []
    return ["No map of the store lies under the track." if store.maps() else "The store has no map ('tcpipe add-map')."]


_Under = tuple[Callable[[Floats], Floats], Bounds, Pictures]
"""The way into a map's plane, its bounds there, its pictures."""


def _map_under(
    store: Store, run: RunDirectory, lonlat: Floats, of_maps: MutableMapping[str, Pictures]
) -> tuple[_Under | None, list[str]]:
    """Return the first map that holds most of the track, and which maps cannot be read."""
    lost: list[str] = []
    for name in store.maps():
        try:
            source = open_map(*store.map_files(name))
            turned = Transformer.from_crs(run.manifest.recipe.read.gnss_crs, source.grid.crs, always_xy=True)

            def to_map(places_deg: Floats, turned: Transformer = turned) -> Floats:
                return np.column_stack(turned.transform(*places_deg.T)).reshape(-1, 2)

            if source.grid.contains(to_map(lonlat)).mean() > _MOSTLY:
                if name not in of_maps:
                    of_maps[name] = _read_pictures(source)
                return (to_map, source.grid.bounds_m, of_maps[name]), lost
        except (TcpipeError, OSError) as error:
            lost.append(f"Map {name} cannot be shown: {clean_line(str(error))}.")
    return None, lost


def _make_empty_plot(name: str, axes: tuple[str, str], xy_m: Floats) -> Plot:
    low, high = xy_m.min(axis=0), xy_m.max(axis=0)
    wide, tall = np.maximum(high - low, 0.1 * np.max(high - low, initial=10.0))
    plot = make_plot(
        name,
        alt="Map of the track: segments, and where and why the rest is not used; the waterfall below holds the metres.",
        axes=axes,
        height_px=int(np.clip(110 + 900 * tall / wide, 330, 600)),
        tools="pan,wheel_zoom,box_zoom,reset,save",
        drag="pan",
        true_to_scale=True,
    )
    figure = plot.figure
    corners = {"xs": [[low[0], high[0]]], "ys": [[low[1], high[1]]], "colour": ["#00000000"]}
    track = figure.multi_line("xs", "ys", color="colour", line_width=3, source=corners, name="track")
    ends = {end: list[float]() for end in ("x0", "y0", "x1", "y1", "colour")}
    figure.segment("x0", "y0", "x1", "y1", color="colour", line_width=6, line_cap="butt", source=ends, name="segments")
    figure.scatter(
        "x", "y", size=15, fill_alpha=0.0, line_color=CURSOR, line_width=3, source={"x": [], "y": []}, name="here"
    )
    figure.x_range.renderers = figure.y_range.renderers = [track]
    figure.xgrid.visible = figure.ygrid.visible = False
    figure.axis.formatter.use_scientific = False
    figure.axis.ticker.desired_num_ticks = 4
    return plot


def _read_pictures(source: MapFile) -> Pictures:
    """Return a map's pictures, the one to be seen first."""
    layers = source.layers
    looks = [("orthophoto", draw_ortho)] if any(name.startswith("ortho") for name in layers) else []
    looks += [("hillshade", draw_relief), *([("classes", draw_classes)] if "terrain" in layers else [])]
    return {name: make_picture_uri(look(source), exact=name == "classes") for name, look in looks}
