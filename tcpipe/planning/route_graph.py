"""Time, energy and their σ on the edges of a graph of Nav2's route server."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tcpipe.errors import PathError, UsageError, clean_lines
from tcpipe.formats.atomic import check_file_name
from tcpipe.formats.finding_lines import format_findings
from tcpipe.formats.json_files import Json, write_json
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.formats.maps.nav2 import RouteEdge, read_route_graph
from tcpipe.learning.models import Model
from tcpipe.planning.cost_model import check_model
from tcpipe.planning.frames import make_frame
from tcpipe.planning.path_cost import PathCost, compute_path_cost
from tcpipe.tables.findings import Subject, make_finding

_SHORTEST_M = 0.01


@dataclass(frozen=True, slots=True)
class RouteGraphResult:
    """Result of a graph; the command prints its ``str``."""

    graph: Path
    out: Path
    nodes: int
    edges: int
    """With costs, each for its own direction."""
    edges_without_cost: tuple[int, ...]
    """Ids, not in the file: Nav2's scorers take an edge without a number for free."""
    unreliable_edges: int
    """Edges that are partly on ground outside the training range."""
    one_way_edges: int
    """Edges without one back."""
    gaining_edges: int
    """Downhill edges that gain energy."""

    @property
    def exit_code(self) -> int:
        """Return 3 if some edges have no cost, else 0."""
        return 3 if self.edges_without_cost else 0

    def __str__(self) -> str:
        """Return the written files, and findings, as plain lines."""
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
    graph: Path,
    origin_deg: tuple[float, float] | None = None,
    two_way: bool = False,
) -> RouteGraphResult:
    """Write a graph with the costs of its edges to ``out``.

    Parameters
    ----------
    model, source : the model and the map.
    graph : the graph's file.
    origin_deg : longitude and latitude of the origin of the graph's frame, true east and north; default: the map's CRS.
    two_way : whether an edge is added for each that has none back.

    Raises `PathError`, `ModelError` or `MapError` if the graph, the model or the map cannot be used; `UsageError` or
    `StoreError` if ``out`` is the graph, has a wrong name or cannot be written.
    """
    check_file_name(out, ".geojson", ".json")
    if out.resolve() == graph.resolve():
        raise UsageError(f"{out}: is the graph itself; give the output another name")
    check_model(model, source)
    frame = make_frame(source, origin_deg)
    found, where = read_route_graph(graph), str(graph)
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
