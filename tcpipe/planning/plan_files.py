"""`tcpipe plan-path`: the least-cost path between two points as GeoJSON, and a picture of all three objectives on the hill."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import ModelError, StoreError, UsageError, clean_lines
from tcpipe.formats.atomic import clear_beside
from tcpipe.formats.finding_lines import format_findings
from tcpipe.formats.geojson import LineFeature, check_lonlat, make_line_feature
from tcpipe.formats.integrity import compute_checksum, find_broken_seal
from tcpipe.formats.json_files import convert_record, digest, read_as, write_json
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.planning.cost_grid import LazyCostGrid, make_survey, read_survey
from tcpipe.planning.cost_map import CARD, CostMapCard, make_cost_map_key, open_cost_map, read_cost_map_card
from tcpipe.planning.cost_model import CostModel, check_model
from tcpipe.planning.path_files import find_doubts, format_cost
from tcpipe.planning.plan import OBJECTIVES, Objective, PlanTotals, plan_path
from tcpipe.tables.bounds import Bounds
from tcpipe.tables.catalogue import read_threshold
from tcpipe.tables.findings import LEFT_OUT, Finding, Subject, make_finding

VERSION = "1.1"

_TAKEN = {"energy": "energy_joule", "time": "duration_s", "distance": "length_m"}


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """What is asked: ends as lon, lat [deg], what is to be least, side of a cell [m], and whether unseen ground may be crossed."""

    start_deg: tuple[float, float]
    goal_deg: tuple[float, float]
    objective: Objective = "energy"
    step_m: Annotated[float, Bounds(ge=0.05, le=1000)] = 1.0
    allow_unseen: bool = False
    cost_map: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedPath(PlanTotals):
    """Properties of the path in a plan's file."""

    model: str
    map: str
    robot: str
    allow_unseen: bool
    label_energy: str = "total"
    """``total`` or ``above_standing``: which energy it is."""


@dataclass(frozen=True, slots=True)
class PlanOrigin:
    """What a plan's file is made from, and what was found with it."""

    key: str
    """Hash of the model, the map and what was asked."""
    plans: Mapping[Objective, PlanTotals]
    order: tuple[Objective, ...]
    """Of ``plans``: the one that was asked for first."""
    picture_sha256: str | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True, slots=True)
class PlanFile:
    """The file of a plan: GeoJSON of one line, and as a foreign member what it is made from (RFC 7946, section 6.1)."""

    features: tuple[LineFeature[PlannedPath], ...]
    tcpipe: PlanOrigin
    type: Literal["FeatureCollection"] = "FeatureCollection"


@dataclass(frozen=True, slots=True)
class PlanResult:
    """What was found; ``str`` of it is what the command prints."""

    objective: Objective
    out: Path
    picture: Path | None
    status: Literal["done", "unchanged"]
    plans: Mapping[Objective, PlanTotals]
    """By objective, the one that was asked for first."""

    @property
    def lonlat_deg(self) -> NDArray[np.float64]:
        """Read the points of the path from its file: longitude and latitude [deg], WGS 84, shape (P, 2)."""
        return np.array(read_as(self.out, PlanFile).features[0].geometry.coordinates)

    @property
    def exit_code(self) -> int:
        """Return 3 if some of the path that was asked for has no cost, else 0."""
        return 0 if self.plans[self.objective].complete else 3

    def __str__(self) -> str:
        """Return what each path costs and where it is, as plain lines."""
        lines = [f"least {name}: {format_cost(plan)}" for name, plan in self.plans.items()]
        lines += format_findings(self._find_doubts())
        same = ": nothing to do: it is made from the same model, map and points" if self.status == "unchanged" else ""
        return clean_lines((*lines, f"{self.out}{same}", *([str(self.picture)] if self.picture else [])))

    def _find_doubts(self) -> Iterator[Finding]:
        """Yield what the path segments of the plan show that its cells did not, and that another plan takes less."""
        (objective, asked), path = next(iter(self.plans.items())), Subject("file", self.out.name)
        yield from find_doubts(asked, path)
        if not asked.complete:
            yield make_finding("cells-too-large", path)
        if asked.negative_steps:
            yield make_finding("steps-gain-energy", path, step_count=asked.negative_steps)
        taken = {other: getattr(found, _TAKEN[objective]) for other, found in self.plans.items() if found.complete}
        least = min(taken, key=taken.__getitem__, default=objective)
        if asked.complete and taken[least] < read_threshold("objective-missed", "max_cost_ratio") * taken[objective]:
            yield make_finding("objective-missed", path, names={"other": least, "objective": objective})


def plan(
    model: CostModel,
    source: MapFile,
    request: PlanRequest,
    *,
    out: Path,
    picture: Path | None,
    step: Callable[[int, int], None] = lambda _, __: None,
) -> PlanResult:
    """Find the path that is asked for and write it to ``out``; with ``picture`` all three, side by side.

    Raises
    ------
    PathError, ModelError, MapError : an end, the model, the map or the cost map cannot be used, or there is no way.
    UsageError, StoreError : an output has a wrong name, or cannot be written.
    """
    _check_names(out, picture)
    clear_beside(out)
    start, goal = (np.array(end, np.float64) for end in (request.start_deg, request.goal_deg))
    for label, end in (("--from", start), ("--to", goal)):
        check_lonlat(label, end[None])
    check_model(model, source)
    drawn = picture is not None
    card = None if request.cost_map is None else _read_card(request.cost_map, model, source)
    rules = replace(request, cost_map=None, step_m=card.grid.pitch_m if card else request.step_m)
    made_from = {"model": model.checksum, "map": source.summary(), "request": rules, "drawn": drawn}
    key = digest({**made_from, "cost_map": card is not None, "version": VERSION})
    if (found := _read_plans(out, picture, key)) is not None:
        return PlanResult(request.objective, out, picture, "unchanged", found)
    survey = _open_survey(model, source, request, card)
    wanted = (request.objective, *(name for name in OBJECTIVES if drawn and name != request.objective))
    plans = {
        name: plan_path(survey, start, goal, name, allow_unseen=request.allow_unseen, step=step) for name in wanted
    }
    origin = PlanOrigin(key, {name: found.totals for name, found in plans.items()}, wanted)
    if picture is not None:
        from tcpipe.planning.picture import draw_plans  # noqa: PLC0415  matplotlib loads only to draw

        draw_plans(picture, source, [plans[name] for name in OBJECTIVES])
        origin = replace(origin, picture_sha256=compute_checksum(picture).sha256)
    asked = plans[request.objective]
    who = {"model": model.name, "map": source.name, "robot": model.robot, "allow_unseen": request.allow_unseen}
    who["label_energy"] = model.label_energy
    path = make_line_feature(asked.lonlat_deg, convert_record(asked.totals, PlannedPath, **who))
    write_json(out, PlanFile((path,), origin))
    return PlanResult(request.objective, out, picture, "done", origin.plans)


def _check_names(out: Path, picture: Path | None) -> None:
    if out.suffix.lower() not in {".geojson", ".json"} or out.is_dir():
        raise UsageError(f"{out}: wanted the name of a file that ends in .geojson or .json")
    if picture is not None and (picture.suffix.lower() != ".png" or picture.is_dir()):
        raise UsageError(f"{picture}: wanted the name of a file that ends in .png")


def _read_card(path: Path, model: CostModel, source: MapFile) -> CostMapCard:
    """Return the card of a cost map of this model and map; `ModelError` if it is none."""
    card = read_cost_map_card(path)
    if card is None:
        if not (path / CARD).is_file():
            raise UsageError(f"{path}: not a cost map; make one with tcpipe cost-map")
        raise ModelError(f"{find_broken_seal(path / CARD)}; make one with tcpipe cost-map")
    if card.key != make_cost_map_key(model, source, card.grid.pitch_m):
        raise ModelError(
            f"{path}: is made from another model or map than {model.name} and {source.name}; make it again with tcpipe cost-map"
        )
    return card


def _open_survey(model: CostModel, source: MapFile, request: PlanRequest, card: CostMapCard | None) -> LazyCostGrid:
    """Return what a cost map knows, or nothing yet."""
    if request.cost_map is None or card is None:
        return make_survey(model, source, request.step_m)
    return read_survey(model, source, open_cost_map(request.cost_map, card))


def _read_plans(out: Path, picture: Path | None, key: str) -> dict[Objective, PlanTotals] | None:
    """Return what was found before, if it is made from the same, and whole; else None. `UsageError` for a file that is no plan."""
    if not out.exists():
        return None
    try:
        about = read_as(out, PlanFile).tcpipe
    except StoreError:
        raise UsageError(f"{out}: exists and is no plan; it is left alone; give another --out") from None
    if about.key != key:
        return None
    if picture is not None and not (picture.is_file() and compute_checksum(picture).sha256 == about.picture_sha256):
        return None
    return {name: about.plans[name] for name in about.order}
