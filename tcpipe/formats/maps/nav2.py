"""Maps that Nav2's map_server loads: a grey picture (.pgm) and what it means (.yaml), mode ``scale``.

In that mode grey falls from white (cost 0) in even steps to almost black (98). Black alone is above ``occupied_thresh``: lethal to every
reader, also to those that end the scale at 99. A .pgm has no alpha, so unknown would look like lethal: what is not known is lethal.

The style (QML) in which QGIS shows a band of a cost map.
"""

from __future__ import annotations

import json
import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import PathError
from tcpipe.formats.atomic import write_atomic_file, write_text
from tcpipe.formats.geojson import shorten_problems, shorten_value
from tcpipe.formats.json_files import Json
from tcpipe.terrain.target_grid import MapGrid

LETHAL = 100
"""Cost of what is never crossed."""

HIGHEST = 98
"""Largest cost of what can be crossed: current static layers take 99 for inscribed, which is an obstacle."""

_OCCUPIED = 0.995
"""Between the darkest grey of `HIGHEST` and black."""


def write_nav2_map(path: Path, cost: NDArray[np.uint8], grid: MapGrid, *, frame: str, meaning: str) -> None:
    """Write ``path`` (.yaml) and the picture of the same name beside it.

    ``cost`` is from 0 to `HIGHEST`, or `LETHAL`, shape (rows, cols), north first; ``grid`` places the cells in the frame; ``frame`` and
    ``meaning`` are lines that say what x and y, and what a cost is.
    """
    grey = np.where(cost == LETHAL, 0.0, np.rint(255.0 * (1.0 - _OCCUPIED * cost / 100.0))).astype(np.uint8)
    picture = path.with_suffix(".pgm")
    with write_atomic_file(picture) as temporary:
        temporary.write_bytes(f"P5\n{grid.cols} {grid.rows}\n255\n".encode() + grey.tobytes())
    x_min, y_min, _, _ = grid.bounds_m
    lines = (
        f"# {meaning}",
        f"# frame: {frame}",
        f"image: {picture.name}",
        "mode: scale",
        f"resolution: {grid.pixel_size_m!r}",
        f"origin: [{x_min!r}, {y_min!r}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {_OCCUPIED}",
        "free_thresh: 0.0",
        "",
    )
    write_text(path, "\n".join(lines))


_COLOURS = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")
"""Viridis: from the least to the greatest; its colours differ for any colour vision, and in grey."""
_HEAD = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n<qgis version=\"3.22.0\">\n"


def make_raster_style(band: int, low: float, high: float) -> str:
    """Return the style of a raster whose band, counted from 1, is coloured from the least value to the greatest."""
    step = (high - low) / (len(_COLOURS) - 1)
    stops = [(low + at * step, colour) for at, colour in enumerate(_COLOURS)]
    items = "".join(f'<item alpha="255" color="{colour}" value="{at!r}" label="{at:.4g}"/>' for at, colour in stops)
    shader = f'colorRampType="INTERPOLATED" classificationMode="1" minimumValue="{low!r}" maximumValue="{high!r}"'
    bounds = f'classificationMin="{low!r}" classificationMax="{high!r}"'
    return (
        f'{_HEAD}<pipe><rasterrenderer type="singlebandpseudocolor" band="{band}" opacity="1" {bounds}>'
        f"<rastershader><colorrampshader {shader}>{items}</colorrampshader></rastershader></rasterrenderer></pipe>\n</qgis>\n"
    )


_EDGES = ("LineString", "MultiLineString")


@dataclass(frozen=True, slots=True)
class RouteEdge:
    """A directed edge: its own id, the ids of the nodes at its start and end, and its feature in the file."""

    edge_id: int
    start: int
    end: int
    feature: Mapping[str, Json]

    def add_metadata(self, values: Mapping[str, Json]) -> Mapping[str, Json]:
        """Return the feature with more metadata."""
        properties = _get(self.feature, "properties")
        return {**self.feature, "properties": {**properties, "metadata": {**_get(properties, "metadata"), **values}}}


@dataclass(frozen=True, slots=True)
class RouteGraph:
    """A graph: the file without its features, its features but the edges, nodes (x and y [m] by id), and edges in the file's order."""

    document: Mapping[str, Json]
    others: Sequence[Json]
    nodes: Mapping[int, tuple[float, float]]
    edges: tuple[RouteEdge, ...]

    def list_missing_reverses(self) -> list[RouteEdge]:
        """Return an edge back for each that has none, with new ids."""
        ways = dict.fromkeys((edge.start, edge.end) for edge in self.edges)
        back = [(b, a) for a, b in ways if (b, a) not in ways]
        first = 1 + max([*self.nodes, *(edge.edge_id for edge in self.edges)], default=-1)
        return [_make_edge(first + number, a, b, self.nodes) for number, (a, b) in enumerate(back)]

    def make_document(self, edges: Sequence[Mapping[str, Json]]) -> dict[str, Json]:
        """Return the file with other edges."""
        return {**self.document, "features": [*self.others, *edges]}


def _make_edge(edge_id: int, start: int, end: int, nodes: Mapping[int, tuple[float, float]]) -> RouteEdge:
    geometry: Json = {"type": "LineString", "coordinates": [nodes[start], nodes[end]]}
    properties: Json = {"id": edge_id, "startid": start, "endid": end}
    return RouteEdge(edge_id, start, end, {"type": "Feature", "properties": properties, "geometry": geometry})


def make_route_graph(xy_m: NDArray[np.float64], pairs: Sequence[tuple[int, int]]) -> RouteGraph:
    """Return a graph of nodes at these places, shape (N, 2), and of an edge in both directions for each pair of them."""
    nodes = {number: (round(x, 3), round(y, 3)) for number, (x, y) in enumerate(xy_m.tolist())}
    points: list[Json] = [
        {"type": "Feature", "properties": {"id": node}, "geometry": {"type": "Point", "coordinates": place}}
        for node, place in nodes.items()
    ]
    ways = [way for a, b in pairs for way in ((a, b), (b, a))]
    edges = tuple(_make_edge(len(nodes) + number, a, b, nodes) for number, (a, b) in enumerate(ways))
    return RouteGraph({"type": "FeatureCollection", "name": "tcpipe"}, points, nodes, edges)


def read_route_graph(path: Path) -> RouteGraph:
    """Read a graph; all that Nav2's loader would reject is a `PathError`, and nodes in several frames, which tcpipe cannot place."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise PathError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise PathError(f"{path}: not GeoJSON: not JSON ({error})") from None
    features = document.get("features") if isinstance(document, dict) else None
    if not isinstance(features, list):
        raise PathError(f"{path}: not a route graph: expected a FeatureCollection of points and lines")
    lines = [feature for feature in features if _get(feature, "geometry").get("type") in _EDGES]
    others = [feature for feature in features if _get(feature, "geometry").get("type") not in _EDGES]
    points = [feature for feature in others if _get(feature, "geometry").get("type") == "Point"]
    problems = list[str]()
    nodes = {node: place for feature in points for node, place in _read_node(feature, problems)}
    edges = tuple(edge for feature in lines for edge in _read_edge(feature, nodes, problems))
    frames = sorted({str(_get(feature, "properties").get("frame", "map")) for feature in points})
    problems += [f"nodes are in the frames {', '.join(frames)}; expected one"] if len(frames) > 1 else []
    if not problems and len(nodes) < len(points):
        problems.append("several nodes have the same id")
    elif not problems and not (nodes and edges):
        problems.append(f"has {len(nodes)} nodes and {len(edges)} edges; expected both")
    if problems:
        raise PathError(*shorten_problems([f"{path}: {problem}" for problem in problems]))
    return RouteGraph(document, others, nodes, edges)


def _read_node(feature: Json, problems: list[str]) -> Iterator[tuple[int, tuple[float, float]]]:
    """Yield id and place of a node, or add what is wrong with it to ``problems``."""
    node, place = _get(feature, "properties").get("id"), _get(feature, "geometry").get("coordinates")
    numbers = [value for value in place[:2] if _is_finite(value)] if isinstance(place, list) else []
    if not _is_id(node):
        problems.append(f"node {shorten_value(node)}: its id is not a whole number from 0")
    elif len(numbers) < 2:
        problems.append(f"node {node}: coordinates are {shorten_value(place)}, expected x and y in metres")
    else:
        yield node, (numbers[0], numbers[1])


def _read_edge(feature: Mapping[str, Json], nodes: Container[int], problems: list[str]) -> Iterator[RouteEdge]:
    """Yield an edge, or add what is wrong with it to ``problems``."""
    properties = _get(feature, "properties")
    ids = [value for name in ("id", "startid", "endid") if _is_id(value := properties.get(name))]
    if len(ids) < 3:
        shown = shorten_value({name: properties.get(name) for name in ("id", "startid", "endid")})
        problems.append(f"edge {shorten_value(properties.get('id'))}: has {shown}, expected whole numbers from 0")
        return
    problems += [f"edge {ids[0]}: there is no node {node}" for node in ids[1:] if node not in nodes]
    yield RouteEdge(ids[0], ids[1], ids[2], feature)


def _get(feature: Json, name: str) -> Mapping[str, Json]:
    value = feature.get(name) if isinstance(feature, dict) else None
    return value if isinstance(value, dict) else {}


def _is_id(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**32


def _is_finite(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
