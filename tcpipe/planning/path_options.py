"""Options of ``tcpipe predict-path``, ``plan-path``, ``cost-map`` and ``route-graph``, and of their functions."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING

from tcpipe.formats.atomic import Location
from tcpipe.tables.options import MAP, MODEL, PREDICTOR, SPEED, STORE, Option, Range, option, required

if TYPE_CHECKING:
    from tcpipe.planning.plan import Objective


_ORIGIN = Option(
    "Origin of the map frame of Nav2, whose axes are true east and north (default: the plane of the map's CRS).",
    (),
    "lonlat",
)


_CELL_SIZE = Option("Side of a cell; plans on a cost map have its cells.", (), Range(0.05, 1000.0), "METRES")


@dataclass(frozen=True, slots=True)
class PredictPathOptions:
    """Model, map and path of a prediction."""

    model: Location = required(MODEL)
    path: Location = required(Option("GeoJSON LineString (WGS84, lon before lat).", (), "input_file", "FILE"))
    _: KW_ONLY
    map: str | None = option(None, MAP)
    out: Location | None = option(
        None, "Write the table of path segments: .csv or .geojson.", (), "output_file", "FILE"
    )
    speed: float | None = option(None, SPEED)
    predictor: str | None = option(None, PREDICTOR)
    adapt: Location | None = option(
        None,
        "Adapt MODEL to the labelled segments of a run, of this or another robot: "
        "an ingested log, by its path or its run's name.",
        metavar="RUN",
    )
    store: Location = option("tcpipe-store", STORE)


@dataclass(frozen=True, slots=True)
class PlanPathOptions:
    """End points, model and objective of a plan."""

    model: Location = required(MODEL)
    start: tuple[float, float] = required(
        Option("Start of the path (WGS84, degrees).", ("--from", "--start"), "lonlat")
    )
    goal: tuple[float, float] = required(Option("End of the path.", ("--to", "--goal"), "lonlat"))
    _: KW_ONLY
    objective: Objective = option("energy", "Quantity to minimise.", (), ("energy", "time", "distance"))
    map: str | None = option(None, MAP)
    out: Location = option("plan.geojson", "Write the path as GeoJSON.", (), "output_file", "FILE")
    cost_map: Location | None = option(
        None,
        "Cost map of this model and map; without one, the cells of all short paths are predicted.",
        (),
        "sealed",
        "DIR",
    )
    cell_size: float = option(1.0, _CELL_SIZE)
    allow_extrapolation: bool = option(False, "Also cross ground outside the training range of the model.")
    risk: float | None = option(
        None,
        "Minimise the cost that the path stays below with this probability (default with --budget: 0.95).",
        (),
        Range(0.5, 0.999),
        "PROBABILITY",
    )
    budget: float | None = option(
        None, "Print the probability that this energy suffices: 300Wh, 500kJ.", (), "energy", "ENERGY"
    )
    origin: tuple[float, float] | None = option(None, _ORIGIN)
    speed: float | None = option(None, SPEED)
    predictor: str | None = option(None, PREDICTOR)
    store: Location = option("tcpipe-store", STORE)


@dataclass(frozen=True, slots=True)
class CostMapOptions:
    """Options of a cost map: map, model and resolution."""

    model: str = required(MODEL)
    out: str = option("cost-map", kind="published", metavar="[OUT]", is_argument=True)
    _: KW_ONLY
    map: str | None = option(None, MAP)
    cell_size: float = option(1.0, _CELL_SIZE)
    origin: tuple[float, float] | None = option(None, _ORIGIN)
    speed: float | None = option(None, SPEED)
    predictor: str | None = option(None, PREDICTOR)
    store: str = option("tcpipe-store", STORE)


@dataclass(frozen=True, slots=True)
class RouteGraphOptions:
    """Graph of Nav2's route server, model and map of the costs of its edges."""

    model: str = required(MODEL)
    graph: str = required(Option("Graph (GeoJSON, metres).", (), "input_file", "FILE"))
    _: KW_ONLY
    out: str = option("route-graph.geojson", "Write the graph.", (), "output_file", "FILE")
    origin: tuple[float, float] | None = option(None, _ORIGIN)
    two_way: bool = option(False, "Add the reverse edge of each edge that has none.")
    map: str | None = option(None, MAP)
    speed: float | None = option(None, SPEED)
    predictor: str | None = option(None, PREDICTOR)
    store: str = option("tcpipe-store", STORE)
