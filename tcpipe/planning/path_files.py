"""Files of `tcpipe predict-path` (path segments, totals) and `tcpipe plan-path` (GeoJSON, messages for Nav2)."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from tcpipe.arrays import Floats
from tcpipe.cost.adaptation import MeasuredRun
from tcpipe.cost.prediction_errors import COVERAGE
from tcpipe.errors import ModelError, StoreError, UsageError, clean_lines
from tcpipe.formats.atomic import Location, check_file_name, clear_beside
from tcpipe.formats.finding_lines import format_findings
from tcpipe.formats.geojson import LineFeature, check_lonlat, make_line_feature, read_line
from tcpipe.formats.integrity import describe_broken
from tcpipe.formats.json_files import convert_record, read_as, write_json
from tcpipe.formats.maps.map_files import MapFile, open_map
from tcpipe.formats.maps.nav2 import make_gps_waypoints, make_path_message
from tcpipe.formats.published_outputs import fetch_directory
from tcpipe.learning.models import Model, load_model, set_speed
from tcpipe.planning.cost_grid import CostGrid, make_survey
from tcpipe.planning.cost_map import CARD, make_cost_map_key, open_cost_map, read_cost_map_card
from tcpipe.planning.cost_model import Reason, check_model
from tcpipe.planning.frames import Frame, make_frame
from tcpipe.planning.path_cost import PathTotals, compute_path_cost, write_path_segments
from tcpipe.planning.path_options import CostMapOptions, PlanPathOptions, PredictPathOptions, RouteGraphOptions
from tcpipe.planning.plan import PlanTotals, plan_path
from tcpipe.store import choose_maps, open_store
from tcpipe.tables.bits import flag_name
from tcpipe.tables.findings import Finding, Severity, Subject, make_finding


def choose_map(store: Location, name: str | None) -> MapFile:
    """Return the named map of a store, or its only one; `UsageError` if there are several and none is named."""
    opened = open_store(store)
    (record,) = choose_maps(opened, opened.scan(), [] if name is None else [name])
    return open_map(*opened.map_at(record))


def load_inputs(
    options: PredictPathOptions | PlanPathOptions | CostMapOptions | RouteGraphOptions,
) -> tuple[Model, MapFile]:
    """Return the model, asked for the commanded speed if one is given, and the map of a call."""
    source, model = choose_map(options.store, options.map), load_model(options.model, options.predictor)
    return model if options.speed is None else set_speed(model, options.speed), source


@dataclass(frozen=True, slots=True, kw_only=True)
class PathResult(PathTotals):
    """Totals of a path; the command prints its ``str``."""

    path: Path
    out: Path | None

    @property
    def exit_code(self) -> int:
        """Return 3 if some path segment has no cost, else 0."""
        return 0 if self.complete else 3

    def __str__(self) -> str:
        """Return the totals, their intervals, and findings, as plain lines."""
        above = ", net" if self.label_energy == "net" else ""
        above += f", adapted by {self.adapted_by}" if self.adapted_by else ""
        findings = format_findings(find_path_findings(self, Subject("file", self.path.name)))
        table = [] if self.out is None else [f"{self.out}: {self.path_segments} path segments"]
        return clean_lines((f"{self.path}: {format_cost(self)}{above}", *findings, *table))


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


def find_path_findings(totals: PathTotals, path: Subject) -> Iterator[Finding]:
    """Yield findings on path segments that the model does not support, and on the basis of its intervals."""
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
    model: Model, source: MapFile, path: Path, out: Path | None, *, adapted_by: MeasuredRun | None = None
) -> PathResult:
    """Return the cost of the line in a GeoJSON file; write its path segments to ``out`` and the totals beside it.

    ``adapted_by`` is the run whose labels adapt the model.
    """
    if out is not None:
        check_file_name(out, ".csv", ".geojson")
        clear_beside(out)
        if out.resolve() == path.resolve():
            raise UsageError(f"{out}: is the file of the path; give the table another name")
    cost = compute_path_cost(model, source, read_line(path), where=str(path), known=adapted_by)
    if out is not None:
        write_path_segments(out, cost.path_segments)
        write_json(make_summary_path(out), cost.totals)
    return convert_record(cost.totals, PathResult, path=path, out=out)


def make_summary_path(out: Path) -> Path:
    """Return the file of the totals of a table of path segments."""
    return out.with_name(f"{out.name}.summary.json")


RISK = 0.95
"""Probability with which a budget must suffice, unless another is asked for [1]."""


@dataclass(frozen=True, slots=True)
class PlanFile:
    """The file of a plan: GeoJSON of one line with its totals."""

    features: tuple[LineFeature[PlanTotals]]
    type: Literal["FeatureCollection"] = "FeatureCollection"


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanResult(PlanTotals):
    """Totals of a plan; the command prints its ``str``."""

    out: Path
    nav2_path: Path
    """``nav_msgs/Path`` in the robot's map frame."""
    nav2_waypoints: Path
    """Goal of Nav2's FollowGPSWaypoints."""

    @property
    def lonlat_deg(self) -> Floats:
        """Read the points of the path from its file: longitude and latitude [deg], WGS 84, shape (P, 2)."""
        return np.array(read_as(self.out, PlanFile).features[0].geometry.coordinates)

    @property
    def exit_code(self) -> int:
        """Return 3 if a path segment has no cost, or the budget suffices with too low a probability; else 0."""
        return 0 if self.complete and not self._is_budget_too_small else 3

    @property
    def _is_budget_too_small(self) -> bool:
        return self.budget_probability is not None and self.budget_probability < (self.risk or RISK)

    def __str__(self) -> str:
        """Return the cost and the files, as plain lines."""
        risk = ""
        if self.risk is not None and self.objective != "distance":
            unit = "J" if self.objective == "energy" else "s"
            risk = f"; with probability {self.risk:.1%} at most {self.risk_cost:.0f} {unit}"
        lines = [f"least {self.objective}: {format_cost(self)}{risk}"]
        if self.budget_probability is not None:
            lines.append(
                f"budget of {self.budget_joule:.0f} J: suffices with probability {self.budget_probability:.1%}"
            )
        lines += format_findings(self._find_doubts())
        return clean_lines((*lines, f"{self.out}", f"{self.nav2_path}", f"{self.nav2_waypoints}"))

    def _find_doubts(self) -> Iterator[Finding]:
        """Yield findings on path segments that the cells do not show."""
        path = Subject("file", self.out.name)
        yield from find_path_findings(self, path)
        if not self.complete:
            yield make_finding("cells-too-large", path)
        if self.negative_steps:
            yield make_finding("steps-gain-energy", path, step_count=self.negative_steps)
        if self._is_budget_too_small:
            yield make_finding("budget-too-small", path)


def plan(model: Model, source: MapFile, options: PlanPathOptions) -> PlanResult:
    """Find the requested path; write it to ``out``, with messages for Nav2 in the same folder."""
    out = Path(options.out)
    _check_output(out)
    start, goal = (np.array(end, float) for end in (options.start, options.goal))
    for label, end in (("--from", start), ("--to", goal)):
        check_lonlat(label, end[None])
    check_model(model, source)
    frame = make_frame(source, options.origin)
    costs = None if options.cost_map is None else _read_costs(fetch_directory(options.cost_map), model, source)
    risk = RISK if options.risk is None and options.budget is not None else options.risk
    found = plan_path(
        make_survey(model, source, options.cell_size if costs is None else costs), start, goal, options.objective,
        allow_extrapolation=options.allow_extrapolation, risk=risk, budget_joule=options.budget,
    )  # fmt: skip
    local = Frame(source, (float(start[0]), float(start[1])))
    nav2_path, nav2_waypoints = (out.with_suffix(f".{name}.json") for name in ("path", "waypoints"))
    write_json(nav2_path, make_path_message(frame.from_plane(found.xy_m)))
    write_json(nav2_waypoints, make_gps_waypoints(found.lonlat_deg, local.from_lonlat(found.lonlat_deg)))
    write_json(out, PlanFile((make_line_feature(found.lonlat_deg, found.totals),)))
    return convert_record(found.totals, PlanResult, out=out, nav2_path=nav2_path, nav2_waypoints=nav2_waypoints)


def _check_output(out: Path) -> None:
    """Raise `UsageError` if the output is not named as GeoJSON, or is an existing file that is not a plan."""
    check_file_name(out, ".geojson", ".json")
    clear_beside(out)
    if out.exists():
        try:
            read_as(out, PlanFile)
        except StoreError:
            raise UsageError(f"{out}: exists and is no plan; it is not changed; give another --out") from None


def _read_costs(path: Path, model: Model, source: MapFile) -> CostGrid:
    """Return the costs of a cost map of this model and map; `ModelError` if it is not."""
    card = read_cost_map_card(path)
    if card is None:
        if not (path / CARD).is_file():
            raise UsageError(f"{path}: not a cost map; make one with tcpipe cost-map")
        raise ModelError(f"{describe_broken(path / CARD)}; make one with tcpipe cost-map")
    if card.key != make_cost_map_key(model, source, card.grid.pixel_size_m):
        raise ModelError(
            f"{path}: is made from another model or map than {model.name} and {source.name}; make it again with tcpipe "
            "cost-map"
        )
    return open_cost_map(path, card)
