"""Time, energy and their σ on the edges of a graph of Nav2's route server, and a graph proposed from what was driven."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import PathError, UsageError, clean_lines
from tcpipe.formats.finding_lines import format_findings
from tcpipe.formats.json_files import Json, write_json
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.formats.route_graph import RouteEdge, RouteGraph, make_route_graph, read_route_graph
from tcpipe.path import NEAR_M, connect_lines
from tcpipe.planning.cost_model import CostModel, check_model
from tcpipe.planning.path_cost import PathCost, compute_path_cost, find_origin_m, find_projection
from tcpipe.store import Store
from tcpipe.tables.columns import read_lonlat_deg, to_floats
from tcpipe.tables.findings import Subject, make_finding

Floats = NDArray[np.float64]

_SHORTEST_M = 0.01


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
    model: CostModel,
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
    origin_deg : longitude and latitude where the graph's frame has x = y = 0, its axes those of the map's CRS; the CRS's own without.
    two_way : whether an edge is added for each that has none back.

    Raises
    ------
    PathError, ModelError, MapError : the graph, the model or the map cannot be used.
    UsageError, StoreError : ``out`` is the graph itself, has a wrong name or cannot be written; the store has no runs on the map.
    """
    if out.suffix.lower() not in {".geojson", ".json"} or out.is_dir():
        raise UsageError(f"{out}: expected the name of a file that ends in .geojson or .json")
    if graph is not None and out.resolve() == graph.resolve():
        raise UsageError(f"{out}: is the graph itself; give the output another name")
    check_model(model, source)
    origin_m = np.array(find_origin_m(source, origin_deg))
    found = propose_graph(source, store, origin_m) if graph is None else read_route_graph(graph)
    where = str(graph or "the proposed graph")
    edges = (*found.edges, *(found.list_missing_reverses() if two_way else ()))
    done, without_cost = list[tuple[RouteEdge, Mapping[str, Json]]](), list[int]()
    unreliable = gaining = 0
    for edge in edges:
        ends_m = np.array([found.nodes[edge.start], found.nodes[edge.end]]) + origin_m
        lonlat, cost = find_projection(source).inverse(ends_m), None
        with suppress(PathError):  # off the map, or from a place to the same
            cost = compute_path_cost(
                model, source, lonlat, where=f"{where}: edge {edge.edge_id}", shortest_m=_SHORTEST_M
            )
        if cost is None or not cost.totals.complete:
            without_cost.append(edge.edge_id)
            continue
        unreliable += bool(cost.totals.reasons)
        gaining += cost.totals.energy_joule < 0.0
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


def propose_graph(source: MapFile, store: Store, origin_m: Floats) -> RouteGraph:
    """Return a graph of what the runs of a store drove on a map: nodes where ways meet, end or bend, edges in both directions."""
    x_min, y_min, x_max, y_max = source.grid.bounds_m
    lines = list[Floats]()
    for run in store.runs():
        segments = run.segments().sort_by("start_ns")
        start, end = (find_projection(source).forward(read_lonlat_deg(segments, name)) for name in ("start", "end"))
        is_on = (np.minimum(start, end) > (x_min, y_min)).all(axis=1) & (np.maximum(start, end) < (x_max, y_max)).all(
            axis=1
        )
        is_on &= to_floats(segments, "position_std_m") < NEAR_M
        apart = np.flatnonzero((np.linalg.norm(start[1:] - end[:-1], axis=1) > NEAR_M) | ~is_on[1:] | ~is_on[:-1]) + 1
        parts = np.split(np.arange(len(start)), apart)
        lines += [np.concatenate([start[rows], end[rows[-1:]]]) for rows in parts if rows.size and is_on[rows].all()]
    if not lines:
        raise UsageError(f"{store.root}: no run with segments on map {source.name}; give a graph with --graph")
    xy_m, pairs = connect_lines(lines)
    return make_route_graph(xy_m - origin_m, pairs)
