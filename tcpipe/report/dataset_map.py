"""The map of a dataset's page and the plot beside it: what is chosen in one is chosen in the other."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import Transformer

from tcpipe.errors import TcpipeError
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import CLASSES, DRIVE_NEXT, OVERVIEW, RELIEF
from tcpipe.formats.geojson import PolygonGeometry, read_polygons
from tcpipe.report.dataset_samples import SamplesShown
from tcpipe.report.pictures import Bounds, compute_joint_bounds_m, make_picture_uri, read_picture
from tcpipe.report.plots import Plot, lay_picture, make_plot

_MOST_PLACES = 200
"""Places to drive next that are drawn, the most wanted first."""


def map_plots(directory: Path, card: DatasetCard, shown: SamplesShown) -> tuple[list[Plot], list[str]]:
    """Return the map and the plot to brush on, and what of the map is lost, in words."""
    bounds = compute_joint_bounds_m([(grid.crs, grid.bounds_m) for grid in card.maps])
    tools = "pan,wheel_zoom,box_select,lasso_select,tap,reset,save"
    height_px = int(np.clip(110 + 500 * (bounds[3] - bounds[1]) / max(bounds[2] - bounds[0], 1e-9), 330, 600))
    plot = make_plot(
        "map",
        alt=f"Map of {len(shown.xy_m)} points, coloured by what is chosen above; the tables below hold the counts.",
        axes=("easting [m]", "northing [m]"),
        height_px=height_px,
        tools=tools,
        drag="pan",
        true_to_scale=True,
    )
    lost = _draw_pictures(plot, directory, card, bounds)
    lost += _draw_places(plot, directory, card)
    figure = plot.figure
    ends = {end: np.empty(0) for end in ("x0", "y0", "x1", "y1")}
    lines = figure.segment(source=ends, color="#ff2d95", line_width=1.5, name="leaks", visible=False)
    lines.level = "overlay"  # above the points that they join
    rings = _project_rings(card.split.region, Transformer.from_crs("EPSG:4326", card.maps[0].crs, always_xy=True))
    figure.multi_line(
        [ring[:, 0] for ring in rings],
        [ring[:, 1] for ring in rings],
        color="#b3202a",
        line_width=2,
        line_dash="dashed",
    )
    corners = {
        "x": [bounds[0], bounds[2]],
        "y": [bounds[1], bounds[3]],
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
    figure.xgrid.visible = figure.ygrid.visible = False
    figure.axis.formatter.use_scientific = False
    figure.axis.ticker.desired_num_ticks = 4
    brush = make_plot(
        "brush",
        alt="Points of the map as a plot of what is chosen above it; a box drawn here chooses them on the map.",
        axes=("slope along travel [°]", "power w [W]"),
        height_px=height_px,
        tools="box_select,lasso_select,tap,pan,wheel_zoom,reset,save",
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
    return [plot, brush], lost


def _draw_pictures(plot: Plot, directory: Path, card: DatasetCard, bounds: Bounds) -> list[str]:
    photographed = any("ortho" in grid.layers for grid in card.maps)
    pictures = {"orthophoto" if photographed else "hillshade": OVERVIEW, "hillshade ": RELIEF, "classes": CLASSES}
    lost = []
    for number, (name, file) in enumerate(pictures.items()):
        if file != OVERVIEW and file not in card.checksums:
            continue
        pixels = read_picture(directory / file)
        if pixels is None:
            lost.append(f"{file} is lost or damaged: the map has no {name.strip()}")
            continue
        lay_picture(plot, name.strip(), make_picture_uri(pixels, exact=file == CLASSES), bounds, visible=number == 0)
    return lost


def _draw_places(plot: Plot, directory: Path, card: DatasetCard) -> list[str]:
    """Draw where to drive next, hidden at first; return in words why that cannot be."""
    if DRIVE_NEXT not in card.checksums:
        return []
    try:
        features, problems = read_polygons(directory / DRIVE_NEXT)
    except TcpipeError as error:
        return [f"where to drive next cannot be shown: {error.problems[0]}"]
    to_map = Transformer.from_crs("EPSG:4326", card.maps[0].crs, always_xy=True)
    rings, texts = [], []
    for feature in features[:_MOST_PLACES]:
        told = feature.properties
        for polygon in feature.polygons:
            rings.append(np.column_stack(to_map.transform(*shapely.get_coordinates(polygon.exterior).T)))
            texts.append(
                f"{told.get('rank')}: {told.get('class') or 'any ground'}, {told.get('slope')}, drive {told.get('drive_towards')}"
            )
    plot.figure.patches(
        "xs",
        "ys",
        source={"xs": [ring[:, 0] for ring in rings], "ys": [ring[:, 1] for ring in rings], "text": texts},
        fill_color="#00e5ff",
        fill_alpha=0.25,
        line_color="#00e5ff",
        line_width=2,
        name="drive next",
        visible=False,
    )
    return list(problems)


def _project_rings(region: Mapping[str, PolygonGeometry] | None, to_map: Transformer) -> list[NDArray[np.float64]]:
    """Return every ring of every polygon of the region in the map's plane [m], each of shape (M, 2)."""
    rings = []
    for geometry in (region or {}).values():
        polygons = (geometry.coordinates,) if geometry.type == "Polygon" else geometry.coordinates
        rings += [np.array(ring, dtype=float)[:, :2] for polygon in polygons for ring in polygon]
    return [np.column_stack(to_map.transform(ring[:, 0], ring[:, 1])) for ring in rings]
