"""The files of `tcpipe predict-path` (a table of path segments and its totals) and `tcpipe plan-path` (GeoJSON and a picture)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.cost.adaptation import Run
from tcpipe.cost.prediction_errors import COVERAGE
from tcpipe.errors import MapError, ModelError, StoreError, UsageError, clean_lines
from tcpipe.formats.atomic import clear_beside
from tcpipe.formats.finding_lines import format_findings
from tcpipe.formats.geojson import LineFeature, check_lonlat, make_line_feature, read_line
from tcpipe.formats.integrity import compute_checksum, describe_broken, read_sealed_as, write_sealed
from tcpipe.formats.json_files import convert_record, digest, read_as, write_json
from tcpipe.formats.maps.map_files import MapFile, open_map
from tcpipe.formats.published_outputs import fetch_directory
from tcpipe.geometry.rotation import wrap_to_pi
from tcpipe.learning.models import Model
from tcpipe.planning.cost_grid import make_survey
from tcpipe.planning.cost_map import CARD, CostMapCard, make_cost_map_key, open_cost_map, read_cost_map_card
from tcpipe.planning.cost_model import Reason, check_model
from tcpipe.planning.path_cost import (
    PathTotals,
    check_ending,
    compute_path_cost,
    find_added_turning,
    write_path_segments,
)
from tcpipe.planning.path_options import PlanPathOptions
from tcpipe.planning.plan import OBJECTIVES, Objective, Plan, PlanTotals, plan_paths
from tcpipe.store import open_store
from tcpipe.tables.bits import flag_name
from tcpipe.tables.columns import to_integers
from tcpipe.tables.findings import LEFT_OUT, Finding, Severity, Subject, make_finding


def choose_map(store: str | Path, name: str | None) -> MapFile:
    """Return the named map of a store, or its only one; `UsageError` if there are several and none is named."""
    opened = open_store(store)
    state = opened.scan()
    maps = state.maps
    if not maps:
        raise MapError(f"{opened.root}: no map in the store; add one: tcpipe add-map NAME --height FILE")
    if name is None and len(maps) > 1:
        raise UsageError(f"{opened.root}: {len(maps)} maps in the store ({', '.join(maps)}); name one with --map")
    if name is not None and name not in maps:
        raise MapError(f"{opened.root}: no map {name!r} in the store; there are {', '.join(maps)}")
    return open_map(*opened.map_at(opened.find_map(name or next(iter(maps)), state)))


_PATH_VERSION = "1.2"


@dataclass(frozen=True, slots=True, kw_only=True)
class TableTotals(PathTotals):
    """All of ``<table>.summary.json`` but its seal: what a table of path segments is made from, and what the path costs in all."""

    key: str
    """Hash of the path, the model and the map."""
    sha256: str
    """Of the table."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PathResult(PathTotals):
    """What a path costs; ``str`` of it is what the command prints."""

    path: Path
    out: Path | None
    status: Literal["done", "unchanged"]

    @property
    def exit_code(self) -> int:
        """Return 3 if some of the path has no cost, else 0."""
        return 0 if self.complete else 3

    def __str__(self) -> str:
        """Return the totals, their intervals, and findings, as plain lines."""
        above = ", net" if self.label_energy == "net" else ""
        above += f", adapted by {self.adapted_by}" if self.adapted_by else ""
        findings = format_findings(find_doubts(self, Subject("file", self.path.name)))
        lines = [f"{self.path}: {format_cost(self)}{above}", *findings]
        if self.out is not None:
            same = "; nothing to do: it is made from the same path, model and map"
            lines.append(f"{self.out}: {self.path_segments} path segments{same if self.status == 'unchanged' else ''}")
        return clean_lines(lines)


def format_cost(totals: PathTotals) -> str:
    """Return length, time and energy with their intervals, as one line."""
    duration = _format_quantity(totals.duration_s, totals.duration_interval_s, "s")
    energy = "no energy"
    if totals.energy_joule is not None:
        energy = _format_quantity(totals.energy_joule, totals.energy_interval_joule, "J")
    part = (
        ""
        if totals.complete
        else f", without {totals.path_segments_without_cost} of {totals.path_segments} path segments"
    )
    turns = (
        ""
        if totals.turn_energy_joule is None
        else f" ({totals.turn_energy_joule:.0f} J of them for {totals.turn_rad:.1f} rad of turns)"
    )
    return f"{totals.length_m:.1f} m, {duration}, {energy}{turns}{part}"


def _format_quantity(value: float, interval: tuple[float, float] | None, unit: str) -> str:
    digits = 1 if unit == "s" else 0
    if interval is None:
        return f"{value:.{digits}f} {unit}"
    low, high = interval
    return f"{value:.{digits}f} {unit} ({COVERAGE:.0%}: {low:.{digits}f} to {high:.{digits}f})"


def find_doubts(totals: PathTotals, path: Subject) -> Iterator[Finding]:
    """Yield where the model has no support on a path, and how little its intervals rest on."""
    for reason, count in totals.reasons.items():
        names, total = {"reason": reason.replace("_", " ")}, totals.path_segments
        # turns have costs of their own
        grade: Severity | None = "note" if reason == flag_name(Reason.CURVED) else None
        yield make_finding(
            "path-not-supported", path, severity=grade, names=names, segment_count=count, total_count=total
        )
    if totals.duration_interval_s is None:
        yield make_finding("no-intervals", path)
    of_both = {
        "time": (totals.duration_s, totals.duration_interval_s),
        "energy": (totals.energy_joule, totals.energy_interval_joule),
    }
    for quantity, (value, ends) in of_both.items():
        if ends is not None and value is not None and ends[1] - ends[0] > abs(value):
            yield make_finding("interval-wide", path, names={"quantity": quantity})
    if totals.held_out_runs == 1 and totals.duration_interval_s is not None:
        yield make_finding("one-held-out-run", path, sample_count=totals.held_out_samples)


def predict_path(
    model: Model, source: MapFile, path: Path, out: Path | None, *, adapted_by: Run | None = None
) -> PathResult:
    """Return what the line in a GeoJSON file costs; write its path segments to ``out`` and the totals beside it.

    ``adapted_by`` is a run by whose metres the model is adapted.
    """
    if out is not None:
        check_ending(out)
        clear_beside(out)
        if out.resolve() == path.resolve():
            raise UsageError(f"{out}: is the file of the path; give the table another name")
    lonlat_deg = read_line(path)
    line = {"lonlat_deg": lonlat_deg.tolist(), "version": _PATH_VERSION}
    adapted = {} if adapted_by is None else {"adapted_by": adapted_by.checksum()}
    key = digest({**line, "model": model.checksum, "map": source.summary(), **adapted})
    if out is not None and (known := _compute_totals(out, key)) is not None:
        return convert_record(known, PathResult, path=path, out=out, status="unchanged")
    cost = compute_path_cost(model, source, lonlat_deg, where=str(path), known=adapted_by)
    if out is not None:
        write_path_segments(out, cost.path_segments)
        made = convert_record(cost.totals, TableTotals, key=key, sha256=compute_checksum(out).sha256)
        write_sealed(make_summary_path(out), made)
    return convert_record(cost.totals, PathResult, path=path, out=out, status="done")


def make_summary_path(out: Path) -> Path:
    """Return where the totals of a table of path segments stand."""
    return out.with_name(f"{out.name}.summary.json")


def _compute_totals(out: Path, key: str) -> TableTotals | None:
    """Return the totals beside a table that is made from the same, and whole; else None."""
    if not (out.is_file() and make_summary_path(out).is_file()):
        return None
    try:
        found = read_sealed_as(make_summary_path(out), TableTotals)
    except StoreError:
        return None
    return found if found.key == key and found.sha256 == compute_checksum(out).sha256 else None


_PLAN_VERSION = "1.2"

RISK = 0.95
"""Probability with which a budget shall suffice, where none is asked for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanSum:
    """What the path and the way back take together, and whether a budget suffices."""

    back: PlanTotals | None
    """Of the way back; None without one."""
    energy_joule: float
    energy_interval_joule: tuple[float, float] | None
    budget_joule: float | None
    budget_probability: float | None
    """That the budget suffices; None without a budget, or where some path segment has no cost."""


@dataclass(frozen=True, slots=True)
class PlanOrigin:
    """What a plan's file is made from, and what was found with it."""

    key: str
    """Hash of the model, the map and what was asked."""
    plans: Mapping[Objective, PlanTotals]
    order: tuple[Objective, ...]
    """Of ``plans``: the one that was asked for first."""
    picture_sha256: str | None = field(default=None, metadata=LEFT_OUT)
    together: PlanSum | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True, slots=True)
class PlanFile:
    """The file of a plan: GeoJSON of one line and, with a way back, another; as a foreign member what it is made from (RFC 7946, 6.1)."""

    features: tuple[LineFeature[PlanTotals], ...]
    tcpipe: PlanOrigin
    type: Literal["FeatureCollection"] = "FeatureCollection"


@dataclass(frozen=True, slots=True)
class PlanResult:
    """Result of a plan; the command prints it by ``str``."""

    objective: Objective
    out: Path
    picture: Path | None
    status: Literal["done", "unchanged"]
    plans: Mapping[Objective, PlanTotals]
    """By objective, the one that was asked for first."""
    together: PlanSum | None = None
    """With a way back or a budget."""

    @property
    def lonlat_deg(self) -> NDArray[np.float64]:
        """Read the points of the path from its file: longitude and latitude [deg], WGS 84, shape (P, 2)."""
        return np.array(read_as(self.out, PlanFile).features[0].geometry.coordinates)

    @property
    def exit_code(self) -> int:
        """Return 3 if some path segment has no cost, or the budget suffices with less than the probability asked for; else 0."""
        return 3 if self._is_budget_too_small or not all(way.complete for way in self._ways) else 0

    @property
    def _ways(self) -> list[PlanTotals]:
        """Return what was asked for: the path, and the way back if there is one."""
        back = None if self.together is None else self.together.back
        return [self.plans[self.objective], *([] if back is None else [back])]

    @property
    def _is_budget_too_small(self) -> bool:
        probability = None if self.together is None else self.together.budget_probability
        risk = self.plans[self.objective].risk
        return probability is not None and risk is not None and probability < risk

    def __str__(self) -> str:
        """Return what each path costs and where it is, as plain lines."""
        lines = [f"least {name}: {format_cost(plan)}{_format_risk(plan)}" for name, plan in self.plans.items()]
        if self.together is not None:
            back, budget = self.together.back, self.together.budget_joule
            lines += [] if back is None else [f"way back: {format_cost(back)}{_format_risk(back)}"]
            energy = _format_quantity(self.together.energy_joule, self.together.energy_interval_joule, "J")
            lines += [] if back is None else [f"there and back: {energy}"]
            if budget is not None and self.together.budget_probability is not None:
                lines.append(
                    f"budget of {budget:.0f} J: suffices with probability {self.together.budget_probability:.1%}"
                )
        lines += format_findings(self._find_doubts())
        same = ": nothing to do: it is made from the same model, map and points" if self.status == "unchanged" else ""
        return clean_lines((*lines, f"{self.out}{same}", *([str(self.picture)] if self.picture else [])))

    def _find_doubts(self) -> Iterator[Finding]:
        """Yield what the path segments of the plan show that its cells did not."""
        path = Subject("file", self.out.name)
        for asked in self._ways:
            yield from find_doubts(asked, path)
            if not asked.complete:
                yield make_finding("cells-too-large", path)
            if asked.negative_steps:
                yield make_finding("steps-gain-energy", path, step_count=asked.negative_steps)
        if self._is_budget_too_small:
            yield make_finding("budget-too-small", path)


def _format_risk(plan: PlanTotals) -> str:
    if plan.risk is None or plan.risk_cost is None or plan.objective == "distance":
        return ""
    return (
        f"; with probability {plan.risk:.1%} at most {plan.risk_cost:.0f} {'J' if plan.objective == 'energy' else 's'}"
    )


_RULES = ("start", "goal", "objective", "cell_size_m", "allow_extrapolation", "risk", "budget_joule", "round_trip")
"""Options that determine a plan."""


def plan(model: Model, source: MapFile, options: PlanPathOptions) -> PlanResult:
    """Find the path that is asked for and write it to ``out``; with ``picture`` all three, side by side."""
    out, picture = Path(options.out), None if options.picture is None else Path(options.picture)
    _check_names(out, picture)
    clear_beside(out)
    start, goal = (np.array(end, np.float64) for end in (options.start, options.goal))
    for label, end in (("--from", start), ("--to", goal)):
        check_lonlat(label, end[None])
    check_model(model, source)
    costs = None if options.cost_map is None else fetch_directory(options.cost_map)
    card = None if costs is None else _read_card(costs, model, source)
    rules = {name: getattr(options, name) for name in _RULES}
    if card is not None:
        rules["cell_size_m"] = card.grid.pixel_size_m
    made_from = {"model": model.checksum, "map": source.summary(), "request": rules, "drawn": picture is not None}
    key = digest({**made_from, "cost_map": card is not None, "version": _PLAN_VERSION})
    objective = options.objective
    if (found := _read_plans(out, picture, key)) is not None:
        return PlanResult(objective, out, picture, "unchanged", *found)
    known = None if costs is None or card is None else open_cost_map(costs, card)
    survey = make_survey(model, source, options.cell_size_m if known is None else known)
    wanted = (objective, *(name for name in OBJECTIVES if picture is not None and name != objective))
    risk = RISK if options.risk is None and options.budget_joule is not None else options.risk
    step = options.on_step or (lambda _, __: None)
    search = partial(plan_paths, survey, allow_extrapolation=options.allow_extrapolation, risk=risk, step=step)
    plans = search(start, goal, wanted)
    asked = plans[objective]
    back = search(goal, start, (objective,))[objective] if options.round_trip else None
    together = None
    if back is not None or options.budget_joule is not None:
        together = _add_up(model, asked, back, options.budget_joule)
    origin = PlanOrigin(key, {name: plan.totals for name, plan in plans.items()}, wanted, together=together)
    if picture is not None:
        from tcpipe.planning.picture import draw_plans  # noqa: PLC0415  matplotlib loads only to draw

        draw_plans(picture, source, [plans[name] for name in OBJECTIVES])
        origin = replace(origin, picture_sha256=compute_checksum(picture).sha256)
    paths = tuple(make_line_feature(way.lonlat_deg, way.totals) for way in (asked, *([] if back is None else [back])))
    write_json(out, PlanFile(paths, origin))
    return PlanResult(objective, out, picture, "done", origin.plans, together)


def _add_up(model: Model, there: Plan, back: Plan | None, budget_joule: float | None) -> PlanSum:
    """Return what a path and the way back take, with the turn between them, and the probability that a budget suffices."""
    energy, complete = there.totals.known_energy_joule, there.totals.complete
    errors = None if there.cost.errors is None else there.cost.errors["energy"]
    if back is not None:
        turning = find_added_turning(model)
        last, first = (np.diff(way.xy_m, axis=0) for way in (there, back))
        turn_rad = wrap_to_pi(np.arctan2(*first[0, ::-1]) - np.arctan2(*last[-1, ::-1]))
        class_id = to_integers(there.cost.path_segments, "terrain_class")[-1:].astype(np.uint8)
        turn = 0.0 if turning is None else float(turning.energy_joule(np.array([turn_rad]), np.zeros(1), class_id)[0])
        energy, complete = energy + turn + back.totals.known_energy_joule, complete and back.totals.complete
        if errors is not None and back.cost.errors is not None:
            errors = replace(errors, middle=errors.middle + turn) + back.cost.errors["energy"]
    has_answer = errors is not None and budget_joule is not None and complete
    return PlanSum(
        back=None if back is None else back.totals,
        energy_joule=energy,
        energy_interval_joule=None if errors is None else errors.interval,
        budget_joule=budget_joule,
        budget_probability=errors.compute_probability(budget_joule) if has_answer else None,  # type: ignore[union-attr, arg-type]
    )


def _check_names(out: Path, picture: Path | None) -> None:
    if out.suffix.lower() not in {".geojson", ".json"} or out.is_dir():
        raise UsageError(f"{out}: expected the name of a file that ends in .geojson or .json")
    if picture is not None and (picture.suffix.lower() != ".png" or picture.is_dir()):
        raise UsageError(f"{picture}: expected the name of a file that ends in .png")


def _read_card(path: Path, model: Model, source: MapFile) -> CostMapCard:
    """Return the card of a cost map of this model and map; `ModelError` if it is none."""
    card = read_cost_map_card(path)
    if card is None:
        if not (path / CARD).is_file():
            raise UsageError(f"{path}: not a cost map; make one with tcpipe cost-map")
        raise ModelError(f"{describe_broken(path / CARD)}; make one with tcpipe cost-map")
    if card.key != make_cost_map_key(model, source, card.grid.pixel_size_m):
        raise ModelError(
            f"{path}: is made from another model or map than {model.name} and {source.name}; make it again with tcpipe cost-map"
        )
    return card


def _read_plans(out: Path, picture: Path | None, key: str) -> tuple[dict[Objective, PlanTotals], PlanSum | None] | None:
    """Return what was found before, if it is made from the same, and whole; else None. `UsageError` for a file that is no plan."""
    if not out.exists():
        return None
    try:
        about = read_as(out, PlanFile).tcpipe
    except StoreError:
        raise UsageError(f"{out}: exists and is no plan; it is not changed; give another --out") from None
    if about.key != key:
        return None
    if picture is not None and not (picture.is_file() and compute_checksum(picture).sha256 == about.picture_sha256):
        return None
    return {name: about.plans[name] for name in about.order}, about.together
