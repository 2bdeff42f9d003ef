"""Files of Nav2: maps and filter masks of map_server, parameters, path messages, GPS waypoints, route graphs.

A map is a grey picture (.pgm) and its description (.yaml). In mode ``scale`` grey falls from white (cost 0) in even
steps to almost black (98). Black alone is above ``occupied_thresh``: lethal to every reader, also to those that end the
scale at 99. A .pgm has no alpha, so that unknown cells are lethal. In mode ``raw`` a pixel is the value itself.
Messages are JSON, which is YAML too: ``ros2`` commands read both.
"""

import json
import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeGuard

import numpy as np

from tcpipe.arrays import Bytes, Floats, accumulate
from tcpipe.errors import PathError
from tcpipe.formats.atomic import write_atomic_file, write_text
from tcpipe.formats.geojson import shorten_problems, shorten_value
from tcpipe.formats.json_files import Json
from tcpipe.terrain.target_grid import MapGrid

LETHAL = 100
"""Cost of cells that are never crossed."""

HIGHEST = 98
"""Largest cost of cells that can be crossed: static layers read 99 as inscribed, which is an obstacle."""

_OCCUPIED = 0.995  # between the darkest grey of `HIGHEST` and black


def write_nav2_map(path: Path, cost: Bytes, grid: MapGrid, *, frame: str, meaning: str) -> None:
    """Write ``path`` (.yaml) and the picture of the same name beside it.

    ``cost`` is from 0 to `HIGHEST`, or `LETHAL`, shape (rows, cols), north first; ``grid`` places the cells in the
    frame; ``frame`` and ``meaning`` are comments: the axes x and y, and the meaning of a cost.
    """
    grey = np.where(cost == LETHAL, 0.0, np.rint(255.0 * (1.0 - _OCCUPIED * cost / 100.0))).astype(np.uint8)
    _write_grey(path, grey, grid, mode="scale", comments=(meaning, f"frame: {frame}"))


def write_nav2_mask(path: Path, values: Bytes, grid: MapGrid, *, frame: str, meaning: str) -> None:
    """Write a costmap filter's mask as `write_nav2_map` does, in mode ``raw``: a pixel is its value, 0 to 100."""
    _write_grey(path, values, grid, mode="raw", comments=(meaning, f"frame: {frame}"))


def _write_grey(path: Path, grey: Bytes, grid: MapGrid, *, mode: str, comments: Sequence[str]) -> None:
    picture = path.with_suffix(".pgm")
    with write_atomic_file(picture) as temporary:
        temporary.write_bytes(f"P5\n{grid.cols} {grid.rows}\n255\n".encode() + grey.tobytes())
    x_min, y_min, _, _ = grid.bounds_m
    lines = (
        *(f"# {comment}" for comment in comments),
        f"image: {picture.name}",
        f"mode: {mode}",
        f"resolution: {grid.pixel_size_m!r}",
        f"origin: [{x_min!r}, {y_min!r}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {_OCCUPIED}",
        "free_thresh: 0.0",
        "",
    )
    write_text(path, "\n".join(lines))


_PARAMETERS = """\
# Parameters of Nav2 for the maps in this folder; merge them into your own and give the paths of the .yaml files.
map_server: {{ros__parameters: {{yaml_filename: energy.yaml}}}}
global_costmap:
  global_costmap:
    ros__parameters:
      static_layer: {{plugin: nav2_costmap_2d::StaticLayer, trinary_costmap: false}}
      filters: [keepout_filter, speed_filter]
      keepout_filter: {{plugin: nav2_costmap_2d::KeepoutFilter, filter_info_topic: keepout_info}}
      speed_filter: {{plugin: nav2_costmap_2d::SpeedFilter, filter_info_topic: speed_info, speed_limit_topic: speed_limit}}
planner_server:
  ros__parameters:
    planner_plugins: [GridBased]
    # cost of a metre: 1 + multiplier * cost / 252, in proportion to {quantity} from {lowest:.6g} to {highest:.6g}
    # {unit}
    GridBased: {{plugin: nav2_smac_planner::SmacPlanner2D, cost_travel_multiplier: {multiplier:.4f}}}
keepout_mask_server: {{ros__parameters: {{yaml_filename: keepout.yaml, topic_name: keepout_mask}}}}
keepout_info_server:
  ros__parameters: {{type: 0, filter_info_topic: keepout_info, mask_topic: keepout_mask, base: 0.0, multiplier: 1.0}}
speed_mask_server: {{ros__parameters: {{yaml_filename: speed.yaml, topic_name: speed_mask}}}}
speed_info_server:  # type 2: a limit in m/s
  ros__parameters: {{type: 2, filter_info_topic: speed_info, mask_topic: speed_mask, base: 0.0, multiplier: {speed:.9f}}}
"""


def format_nav2_parameters(*, quantity: str, unit: str, lowest: float, highest: float, speed_step_mps: float) -> str:
    """Return parameters of Nav2's servers for a cost map, its masks and a planner whose cost is proportional to it.

    Parameters
    ----------
    quantity, unit, lowest, highest : quantity and unit of the cost, and its values at cost 0 and `HIGHEST`.
    speed_step_mps : speed of one step of the speed mask [m/s].
    """
    multiplier = max(highest / lowest - 1.0, 0.0) if lowest > 0.0 else 0.0
    return _PARAMETERS.format(
        quantity=quantity, unit=unit, lowest=lowest, highest=highest, multiplier=multiplier, speed=speed_step_mps
    )


_POSE_M = 0.25  # largest distance of neighbouring poses of a path message [m]: controllers expect dense paths


def make_path_message(xy_m: Floats) -> Json:
    """Return a ``nav_msgs/Path`` along points in the frame ``map`` [m], shape (P, 2), with the course as yaw."""
    away_m = accumulate(np.linalg.norm(np.diff(xy_m, axis=0), axis=1))
    between_m = np.linspace(0.0, away_m[-1], int(np.ceil(away_m[-1] / _POSE_M)) + 1)
    along_m = np.unique(np.r_[away_m, between_m])
    points = np.column_stack([np.interp(along_m, away_m, column) for column in xy_m.T])
    header: Json = {"frame_id": "map"}
    poses = [
        {"header": header, "pose": {"position": {"x": x, "y": y, "z": 0.0}, "orientation": orientation}}
        for (x, y), orientation in zip(points.tolist(), _make_orientations(points), strict=True)
    ]
    return {"header": header, "poses": poses}


def make_gps_waypoints(lonlat_deg: Floats, enu_m: Floats) -> Json:
    """Return the goal of ``nav2_msgs/action/FollowGPSWaypoints``: the points of a path after its start, shape (P, 2).

    ``enu_m`` are the same points in a true east-north frame [m]; a waypoint has the yaw with which the path arrives
    there.
    """
    poses = [
        {"position": {"latitude": lat, "longitude": lon, "altitude": 0.0}, "orientation": orientation}
        for (lon, lat), orientation in zip(lonlat_deg[1:].tolist(), _make_orientations(enu_m), strict=False)
    ]
    return {"number_of_loops": 0, "goal_index": 0, "gps_poses": poses}


def _make_orientations(xy_m: Floats) -> list[Json]:
    """Return the course from each point to the next as quaternions; the last point has that of the one before."""
    east, north = np.diff(xy_m, axis=0).T
    half = np.arctan2(north, east) / 2.0
    return [{"x": 0.0, "y": 0.0, "z": float(np.sin(a)), "w": float(np.cos(a))} for a in (*half, half[-1])]


_EDGES = ("LineString", "MultiLineString")
Document = Mapping[str, Json]


@dataclass(frozen=True, slots=True)
class RouteEdge:
    """A directed edge: its own id, the ids of the nodes at its start and end, and its feature in the file."""

    edge_id: int
    start: int
    end: int
    feature: Document

    def add_metadata(self, values: Document) -> Document:
        """Return the feature with more metadata."""
        properties = _get(self.feature, "properties")
        return {**self.feature, "properties": {**properties, "metadata": {**_get(properties, "metadata"), **values}}}


@dataclass(frozen=True, slots=True)
class RouteGraph:
    """A graph: the file without features, its features except edges, nodes (x, y [m] by id), and edges in order."""

    document: Document
    others: Sequence[Json]
    nodes: Mapping[int, tuple[float, float]]
    edges: tuple[RouteEdge, ...]

    def list_missing_reverses(self) -> list[RouteEdge]:
        """Return an edge back for each that has none, with new ids."""
        ways = dict.fromkeys((edge.start, edge.end) for edge in self.edges)
        back = [(b, a) for a, b in ways if (b, a) not in ways]
        first = 1 + max([*self.nodes, *(edge.edge_id for edge in self.edges)], default=-1)
        made = list[RouteEdge]()
        for edge_id, (start, end) in enumerate(back, first):
            geometry: Json = {"type": "LineString", "coordinates": [self.nodes[start], self.nodes[end]]}
            properties: Json = {"id": edge_id, "startid": start, "endid": end}
            document = {"type": "Feature", "properties": properties, "geometry": geometry}
            made.append(RouteEdge(edge_id, start, end, document))
        return made

    def make_document(self, edges: Sequence[Document]) -> dict[str, Json]:
        """Return the file with other edges."""
        return {**self.document, "features": [*self.others, *edges]}


def read_route_graph(path: Path) -> RouteGraph:
    """Read a graph; `PathError` for all that Nav2's loader rejects, and for nodes in several frames."""
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
    """Yield id and position of a node, or add its problem to ``problems``."""
    node, place = _get(feature, "properties").get("id"), _get(feature, "geometry").get("coordinates")
    numbers = [value for value in place[:2] if _is_finite(value)] if isinstance(place, list) else []
    if not _is_id(node):
        problems.append(f"node {shorten_value(node)}: its id is not a whole number from 0")
    elif len(numbers) < 2:
        problems.append(f"node {node}: coordinates are {shorten_value(place)}, expected x and y in metres")
    else:
        yield node, (numbers[0], numbers[1])


def _read_edge(feature: Document, nodes: Container[int], problems: list[str]) -> Iterator[RouteEdge]:
    """Yield an edge, or add its problem to ``problems``."""
    properties = _get(feature, "properties")
    ids = [value for name in ("id", "startid", "endid") if _is_id(value := properties.get(name))]
    if len(ids) < 3:
        shown = shorten_value({name: properties.get(name) for name in ("id", "startid", "endid")})
        problems.append(f"edge {shorten_value(properties.get('id'))}: has {shown}, expected whole numbers from 0")
        return
    problems += [f"edge {ids[0]}: there is no node {node}" for node in ids[1:] if node not in nodes]
    yield RouteEdge(ids[0], ids[1], ids[2], feature)


def _get(feature: Json, name: str) -> Document:
    value = feature.get(name) if isinstance(feature, dict) else None
    return value if isinstance(value, dict) else {}


def _is_id(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**32


def _is_finite(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
