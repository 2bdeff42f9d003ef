"""The options of ``tcpipe predict-path``, ``tcpipe plan-path`` and ``tcpipe cost-map``, and of the functions of these names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tcpipe.tables.options import CLUSTER, MAP, MODEL, PHYSICS, SPEED, STORE, Option, Range, option, required

if TYPE_CHECKING:
    from tcpipe.planning.plan import Objective


@dataclass(frozen=True, slots=True)
class PredictPathOptions:
    """Which path is predicted with which model, on which map."""

    model: str | Path = required(MODEL)
    path: str | Path = required(Option("GeoJSON LineString (WGS84, lon before lat).", (), "input_file", "FILE"))
    _: KW_ONLY
    map_name: str | None = option(None, MAP)
    out: str | Path | None = option(
        None, Option("Write the table of pieces: .csv, .parquet or .json.", (), "output_file", "FILE")
    )
    physics_from: str | Path | None = option(None, PHYSICS)
    speed_mps: float | None = option(None, SPEED)
    store: str | Path = option("tcpipe-store", STORE)


@dataclass(frozen=True, slots=True)
class PlanPathOptions:
    """Between which points a path is planned, by which model, and what is to be least."""

    model: str | Path = required(MODEL)
    start: tuple[float, float] = required(Option("Where it begins (WGS84, degrees).", ("--from",), "lonlat"))
    goal: tuple[float, float] = required(Option("Where it ends.", ("--to",), "lonlat"))
    _: KW_ONLY
    objective: Objective = option("energy", Option("What is to be least.", (), ("energy", "time", "distance")))
    map_name: str | None = option(
        None, Option("Map to plan on (default: the only one in the store).", ("--map",), "map", "NAME")
    )
    out: str | Path = option("plan.geojson", Option("The path as GeoJSON.", (), "output_file", "FILE"))
    picture: str | Path | None = option(
        None, Option("Draw all three objectives side by side on the hill (.png).", (), "output_file", "FILE")
    )
    cost_map: str | Path | None = option(
        None,
        Option("A cost map of this model and map; without one only what is needed is predicted.", (), "sealed", "DIR"),
    )
    cell_size_m: float = option(
        1.0,
        Option(
            "Side of a cell; that of --cost-map rules.",
            ("--cell-size",),
            Range(0.05, 1000.0),
            "METRES",
            earlier="--step",
        ),
    )
    allow_extrapolation: bool = option(
        False,
        Option(
            "Also cross ground unlike any that the model was trained on.",
            ("--allow-extrapolation",), earlier="--allow-unseen",
        ),
    )  # fmt: skip
    physics_from: str | Path | None = option(None, PHYSICS)
    speed_mps: float | None = option(None, SPEED)
    store: str | Path = option("tcpipe-store", STORE)
    on_step: Callable[[int, int], None] | None = None
    """Called with how many blocks of how many are done, in each round of the search."""


@dataclass(frozen=True, slots=True)
class CostMapOptions:
    """Of which map the costs are predicted, with which model, and how finely."""

    model: str = required(MODEL)
    out: str = option("cost-map", Option(kind="published", metavar="[OUT]", is_argument=True))
    _: KW_ONLY
    map_name: str | None = option(None, MAP)
    cell_size_m: float = option(
        1.0, Option("Side of a cell.", ("--cell-size",), Range(0.05, 1000.0), "METRES", earlier="--step")
    )
    origin_deg: tuple[float, float] | None = option(
        None,
        Option(
            "Where the Nav2 maps' frame begins, as navsat_transform's datum (default: where the map's CRS does).",
            ("--origin",),
            "lonlat",
        ),
    )
    speed_mps: float | None = option(None, SPEED)
    store: str = option("tcpipe-store", STORE)
    cluster: str | None = option(
        None, replace(CLUSTER, about="Dask scheduler whose workers do it, tcp://host:port (or TCPIPE_CLUSTER).")
    )
