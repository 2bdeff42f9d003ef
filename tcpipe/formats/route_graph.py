"""Graphs of Nav2's route server: GeoJSON with nodes as points and edges as lines, in metres of a frame, whatever its ``crs`` says.

Nav2 drives straight from node to node and takes the geometry of an edge for display. Its loader gives metadata the type that their JSON
has, and its scorers ask for floats: all numbers that tcpipe writes have a decimal point.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import PathError
from tcpipe.formats.geojson import shorten_problems, shorten_value

_EDGES = ("LineString", "MultiLineString")


@dataclass(frozen=True, slots=True)
class RouteGraph:
    """A graph.

    Attributes
    ----------
    document : all of the file but its edges.
    node_ids, xy_m : of the nodes, and where they are [m], shape (N, 2).
    edges : features, as they stand in the file.
    """

    document: Mapping[str, Any]
    node_ids: tuple[int, ...]
    xy_m: NDArray[np.float64]
    edges: tuple[Mapping[str, Any], ...]

    def find_ends(self) -> NDArray[np.float64]:
        """Return the start and the end of each edge [m], shape (M, 2, 2)."""
        row = {node_id: number for number, node_id in enumerate(self.node_ids)}
        ends = [[row[edge["properties"][name]] for name in ("startid", "endid")] for edge in self.edges]
        return self.xy_m[np.array(ends, np.int64).reshape(-1, 2)]

    def list_missing_reverses(self) -> list[Mapping[str, Any]]:
        """Return an edge back for each that has none, with new ids."""
        ways = [(edge["properties"]["startid"], edge["properties"]["endid"]) for edge in self.edges]
        back = [(b, a) for a, b in dict.fromkeys(ways) if (b, a) not in set(ways)]
        first = 1 + max([*self.node_ids, *(edge["properties"]["id"] for edge in self.edges)], default=-1)
        xy_m = dict(zip(self.node_ids, self.xy_m.tolist(), strict=True))
        return [make_edge(first + number, a, b, [xy_m[a], xy_m[b]]) for number, (a, b) in enumerate(back)]

    def make_document(self, edges: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Return the file with other edges."""
        return {**self.document, "features": [*self.document["features"], *edges]}


def make_edge(edge_id: int, start: int, end: int, xy_m: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Return the feature of an edge between two nodes."""
    properties = {"id": edge_id, "startid": start, "endid": end}
    return {"type": "Feature", "properties": properties, "geometry": {"type": "LineString", "coordinates": xy_m}}


def make_route_graph(xy_m: NDArray[np.float64], pairs: Sequence[tuple[int, int]]) -> RouteGraph:
    """Return a graph of nodes at these places, shape (N, 2), and of an edge in both directions for each pair of them."""
    points = [[round(x, 3), round(y, 3)] for x, y in xy_m.tolist()]
    nodes = [
        {"type": "Feature", "properties": {"id": number}, "geometry": {"type": "Point", "coordinates": point}}
        for number, point in enumerate(points)
    ]
    ways = [way for a, b in pairs for way in ((a, b), (b, a))]
    edges = tuple(make_edge(len(points) + number, a, b, [points[a], points[b]]) for number, (a, b) in enumerate(ways))
    document = {"type": "FeatureCollection", "name": "tcpipe", "features": nodes}
    return RouteGraph(document, tuple(range(len(points))), np.array(points, np.float64).reshape(-1, 2), edges)


def read_route_graph(path: Path) -> RouteGraph:
    """Read a graph; all that Nav2's loader would reject is a `PathError`, and nodes in several frames, which tcpipe cannot place."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise PathError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise PathError(f"{path}: not GeoJSON: not JSON ({error})") from None
    document = document if isinstance(document, dict) else {}
    features = document.get("features")
    if not isinstance(features, list):
        raise PathError(f"{path}: not a route graph: expected a FeatureCollection of points and lines")
    kinds = [_get(feature, "geometry").get("type") for feature in features]
    is_edge = [kind in _EDGES for kind in kinds]
    edges = [feature for feature, is_one in zip(features, is_edge, strict=True) if is_one]
    others = [feature for feature, is_one in zip(features, is_edge, strict=True) if not is_one]
    points = [feature for feature, kind in zip(features, kinds, strict=True) if kind == "Point"]
    problems = [f"{path}: node {problem}" for node in points for problem in _find_node_problems(node)]
    nodes = {} if problems else {node["properties"]["id"]: node["geometry"]["coordinates"][:2] for node in points}
    frames = sorted({str(_get(node, "properties").get("frame", "map")) for node in points})
    problems += [
        f"{path}: edge {problem}"
        for edge in edges
        for problem in _find_edge_problems(edge, None if problems else nodes)
    ]
    problems += [f"{path}: nodes are in the frames {', '.join(frames)}; expected one"] if len(frames) > 1 else []
    problems += [f"{path}: several nodes have the same id"] if not problems and len(nodes) < len(points) else []
    if not problems and not (nodes and edges):
        problems.append(f"{path}: has {len(nodes)} nodes and {len(edges)} edges; expected both")
    if problems:
        raise PathError(*shorten_problems(problems))
    return RouteGraph(
        {**document, "features": others}, tuple(nodes), np.array(list(nodes.values()), np.float64), tuple(edges)
    )


def _find_node_problems(node: Mapping[str, Any]) -> Iterator[str]:
    node_id, place = _get(node, "properties").get("id"), node["geometry"].get("coordinates")
    if not _is_id(node_id):
        yield f"{shorten_value(node_id)}: its id is not a whole number from 0"
    if not (isinstance(place, list) and len(place) > 1 and all(map(_is_finite, place[:2]))):
        yield f"{shorten_value(node_id)}: coordinates are {shorten_value(place)}, expected x and y in metres"


def _find_edge_problems(edge: Mapping[str, Any], nodes: Mapping[int, object] | None) -> Iterator[str]:
    properties = _get(edge, "properties")
    for name in ("id", "startid", "endid"):
        value = properties.get(name)
        if not _is_id(value):
            yield f"{shorten_value(properties.get('id'))}: {name} is {shorten_value(value)}, expected a whole number from 0"
        elif name != "id" and nodes is not None and value not in nodes:
            yield f"{properties.get('id')!r}: there is no node {value}"


def _get(feature: object, name: str) -> Mapping[str, Any]:
    value = feature.get(name) if isinstance(feature, dict) else None
    return value if isinstance(value, dict) else {}


def _is_id(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**32


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
