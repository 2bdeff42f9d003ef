"""Time, energy and their σ on the edges of a graph of Nav2's route server, and a graph proposed from what was driven."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shapely import LineString

from tcpipe.errors import PathError, UsageError, clean_lines
from tcpipe.formats.finding_lines import format_findings
from tcpipe.formats.json_files import Json, write_json
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.formats.maps.nav2 import RouteEdge, RouteGraph, make_route_graph, read_route_graph
from tcpipe.learning.models import Model
from tcpipe.planning.cost_model import check_model
from tcpipe.planning.frames import Frame, find_projection, make_frame
from tcpipe.planning.path_cost import PathCost, compute_path_cost
from tcpipe.store import Store
from tcpipe.tables.columns import read_lonlat_deg, to_floats
from tcpipe.tables.findings import Subject, make_finding

Floats = NDArray[np.float64]

_SHORTEST_M = 0.01

_NEAR_M = 3.0
"""Driven points nearer than this to a node belong to it."""

_OFF_M = 0.5
"""How far a driven line may be from the straight edges that replace it."""


@dataclass(frozen=True, slots=True)
class RouteGraphResult:
    """What became of a graph; ``str`` of it is what the command prints."""

    graph: Path | None
    """None: it is proposed from the runs of the store."""
    out: Path
    nodes: int
    edges: int
    """With costs, each for its own direction."""
    edges_without_cost: tuple[int, ...]
    """Ids, left out of the file: without a number Nav2's scorers take an edge for free."""
    unreliable_edges: int
    """Of ``edges``: partly on ground outside the training range."""
    one_way_edges: int
    """Of ``edges``: there is none back."""
    gaining_edges: int
    """Of ``edges``: downhill ones that give energy back."""

    @property
    def exit_code(self) -> int:
        """Return 3 if some edges have no cost, else 0."""
        return 3 if self.edges_without_cost else 0

    def __str__(self) -> str:
        """Return what was written, and findings, as plain lines."""
        counts = {
            "on ground outside the training range": self.unreliable_edges,
            "one-way": self.one_way_edges,
            "giving energy back": self.gaining_edges,
        }
        parts = "".join(f"; {count} of them {name}" for name, count in counts.items() if count)
        lines = [f"{self.out}: {self.nodes} nodes, {self.edges} edges with time, energy and their σ{parts}"]
        if self.edges_without_cost:
            shown = ", ".join(map(str, self.edges_without_cost[:5])) + (
                " …" if len(self.edges_without_cost) > 5 else ""
            )
            count, path = len(self.edges_without_cost), Subject("file", self.out.name)
            lines += format_findings(
                [make_finding("edges-without-cost", path, names={"edges": shown}, edge_count=count)]
            )
        return clean_lines(lines)


def write_route_graph(
    model: Model,
    source: MapFile,
    out: Path,
    *,
    graph: Path | None,
    store: Store,
    origin_deg: tuple[float, float] | None = None,
    two_way: bool = False,
) -> RouteGraphResult:
    """Write a graph with the costs of its edges to ``out``.

    Parameters
    ----------
    model, source : who predicts, and the map.
    graph, store : the graph's file, or without one the store whose runs propose one.
    origin_deg : longitude and latitude of the origin of the graph's frame, true east and north; without one that of the map's CRS.
    two_way : whether an edge is added for each that has none back.

    Raises `PathError`, `ModelError` or `MapError` where the graph, the model or the map cannot be used; `UsageError` or `StoreError` where
    ``out`` is the graph itself, has a wrong name or cannot be written, or the store has no runs on the map.
    """
    if out.suffix.lower() not in {".geojson", ".json"} or out.is_dir():
        raise UsageError(f"{out}: expected the name of a file that ends in .geojson or .json")
    if graph is not None and out.resolve() == graph.resolve():
        raise UsageError(f"{out}: is the graph itself; give the output another name")
    check_model(model, source)
    frame = make_frame(source, origin_deg)
    found = propose_graph(source, store, frame) if graph is None else read_route_graph(graph)
    where = str(graph or "the proposed graph")
    edges = (*found.edges, *(found.list_missing_reverses() if two_way else ()))
    done, without_cost = list[tuple[RouteEdge, Mapping[str, Json]]](), list[int]()
    unreliable = gaining = 0
    for edge in edges:
        lonlat, cost = frame.to_lonlat(np.array([found.nodes[edge.start], found.nodes[edge.end]])), None
        with suppress(PathError):  # off the map, or from a place to the same
            cost = compute_path_cost(
                model, source, lonlat, where=f"{where}: edge {edge.edge_id}", shortest_m=_SHORTEST_M
            )
        if cost is None or not cost.totals.complete:
            without_cost.append(edge.edge_id)
            continue
        unreliable += bool(cost.totals.reasons)
        gaining += cost.totals.known_energy_joule < 0.0
        done.append((edge, edge.add_metadata(_list_numbers(cost))))
    if not done:
        raise PathError(f"{where}: no edge has a cost on map {source.name}; check the frame of the graph and --origin")
    write_json(out, found.make_document([feature for _, feature in done]))
    ways = {(edge.start, edge.end) for edge, _ in done}
    one_way = sum((end, start) not in ways for start, end in ways)
    return RouteGraphResult(graph, out, len(found.nodes), len(done), tuple(without_cost), unreliable, one_way, gaining)


def _list_numbers(cost: PathCost) -> dict[str, Json]:
    """Return the metadata of an edge: the time under the name that Nav2's TimeScorer reads."""
    numbers: dict[str, Json] = {
        "abs_time_taken": cost.totals.duration_s,
        "energy_joule": cost.totals.energy_joule,
        "length_m": cost.totals.length_m,
    }
    if cost.errors is not None:
        numbers["time_std_s"] = cost.errors["duration"].std
        numbers["energy_std_joule"] = cost.errors["energy"].std
    if cost.totals.reasons:
        numbers["unreliable"] = " ".join(cost.totals.reasons)
    return numbers


def propose_graph(source: MapFile, store: Store, frame: Frame) -> RouteGraph:
    """Return a graph of what the runs of a store drove on a map: nodes where ways meet, end or bend, edges in both directions."""
    x_min, y_min, x_max, y_max = source.grid.bounds_m
    lines = list[Floats]()
    for run in store.runs():
        segments = run.segments().sort_by("start_ns")
        start, end = (find_projection(source).forward(read_lonlat_deg(segments, name)) for name in ("start", "end"))
        is_on = (np.minimum(start, end) > (x_min, y_min)).all(axis=1) & (np.maximum(start, end) < (x_max, y_max)).all(
            axis=1
        )
        is_on &= to_floats(segments, "position_std_m") < _NEAR_M
        apart = np.flatnonzero((np.linalg.norm(start[1:] - end[:-1], axis=1) > _NEAR_M) | ~is_on[1:] | ~is_on[:-1]) + 1
        parts = np.split(np.arange(len(start)), apart)
        lines += [np.concatenate([start[rows], end[rows[-1:]]]) for rows in parts if rows.size and is_on[rows].all()]
    if not lines:
        raise UsageError(f"{store.root}: no run with segments on map {source.name}; give a graph with --graph")
    xy_m, pairs = connect_lines(lines)
    return make_route_graph(frame.from_plane(xy_m), pairs)


def connect_lines(lines: Sequence[Floats]) -> tuple[Floats, list[tuple[int, int]]]:
    """Return nodes [m], shape (N, 2), and the pairs of them that lines, (P, 2) each, connect.

    A point nearer than 3 m to a node belongs to it; between nodes where ways meet or end, only those remain where the way bends.
    """
    nodes, near = list[Floats](), defaultdict[tuple[int, int], list[int]](list)
    neighbours = defaultdict[int, set[int]](set)
    for line in lines:
        last = -1
        for point in line:
            column, row = np.floor(point / _NEAR_M).astype(int).tolist()
            found = [at for i in (-1, 0, 1) for j in (-1, 0, 1) for at in near[column + i, row + j]]
            away = [float(np.linalg.norm(nodes[at] - point)) for at in found]
            if away and min(away) < _NEAR_M:
                at = found[int(np.argmin(away))]
            else:
                at = len(nodes)
                nodes.append(point)
                near[column, row].append(at)
            if last not in {-1, at}:
                neighbours[at].add(last)
                neighbours[last].add(at)
            last = at
    pairs = {(min(pair), max(pair)) for chain in _list_chains(neighbours) for pair in _simplify(chain, nodes)}
    used = sorted({at for pair in pairs for at in pair})
    number = {at: new for new, at in enumerate(used)}
    return np.array([nodes[at] for at in used]).reshape(-1, 2), sorted((number[a], number[b]) for a, b in pairs)


def _list_chains(neighbours: Mapping[int, set[int]]) -> Iterator[list[int]]:
    """Yield the nodes of each way between nodes that have not two neighbours; of a ring, from any node to itself."""
    visited = set[tuple[int, int]]()
    starts = sorted(neighbours, key=lambda at: (len(neighbours[at]) == 2, at))
    for start in starts:
        for following in sorted(neighbours[start]):
            if (start, following) in visited or (len(neighbours[start]) == 2 and (following, start) in visited):
                continue
            chain = [start, following]
            while len(neighbours[chain[-1]]) == 2 and chain[-1] != start:
                chain.append(next(iter(neighbours[chain[-1]] - {chain[-2]})))
            visited |= {pair for a, b in pairwise(chain) for pair in ((a, b), (b, a))}
            yield chain


def _simplify(chain: list[int], nodes: Sequence[Floats]) -> Iterator[tuple[int, int]]:
    """Yield the pairs that remain of a chain: of a ring at least three."""
    parts = [chain] if chain[0] != chain[-1] else [chain[: len(chain) // 2 + 1], chain[len(chain) // 2 :]]
    for part in parts:
        places = {tuple(nodes[at].tolist()): at for at in part}
        yield from pairwise(places[point] for point in LineString([nodes[at] for at in part]).simplify(_OFF_M).coords)
