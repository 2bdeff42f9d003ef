"""`tcpipe predict-path`: a path from a file to its cost, and the table of its pieces to another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tcpipe.cost.prediction_errors import COVERAGE
from tcpipe.errors import StoreError, UsageError, clean_lines
from tcpipe.formats.atomic import clear_beside
from tcpipe.formats.finding_lines import format_findings
from tcpipe.formats.geojson import read_line
from tcpipe.formats.integrity import compute_checksum, read_sealed_as, write_sealed
from tcpipe.formats.json_files import convert_record, digest
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.planning.cost_model import CostModel
from tcpipe.planning.path_cost import PathTotals, check_ending, compute_path_cost, write_pieces
from tcpipe.tables.findings import Finding, Subject, make_finding

VERSION = "1.2"


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedTotals(PathTotals):
    """What a path costs in all, by which model, on which map, for which robot."""

    model: str
    map: str
    robot: str
    label_energy: str = "total"
    """``total`` or ``above_standing``: which energy it is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TableTotals(NamedTotals):
    """All of ``<table>.summary.json`` but its seal: what a table of pieces is made from, and what the path costs in all."""

    key: str
    """Hash of the path, the model and the map."""
    sha256: str
    """Of the table."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PathResult(NamedTotals):
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
        above = ", above standing" if self.label_energy == "above_standing" else ""
        findings = format_findings(find_doubts(self, Subject("file", self.path.name)))
        return clean_lines((f"{self.path}: {format_cost(self)}{above}", *findings, *self._out_lines()))

    def _out_lines(self) -> tuple[str, ...]:
        if self.out is None:
            return ()
        same = "; nothing to do: it is made from the same path, model and map"
        return (f"{self.out}: {self.pieces} pieces{same if self.status == 'unchanged' else ''}",)


def format_cost(of: PathTotals) -> str:
    """Return length, time and energy with their intervals, as one line."""
    duration = _format_quantity(of.duration_s, of.duration_interval_s, "s")
    energy = _format_quantity(of.energy_joule, of.energy_interval_joule, "J")
    part = "" if of.complete else f", without {of.pieces_without_cost} of {of.pieces} pieces"
    turns = (
        ""
        if of.turn_energy_joule is None
        else f" ({of.turn_energy_joule:.0f} J of them for {of.turn_rad:.1f} rad of turns)"
    )
    return f"{of.length_m:.1f} m, {duration}, {energy}{turns}{part}"


def _format_quantity(value: float, interval: tuple[float, float] | None, unit: str) -> str:
    digits = 1 if unit == "s" else 0
    if interval is None:
        return f"{value:.{digits}f} {unit}"
    low, high = interval
    return f"{value:.{digits}f} {unit} ({COVERAGE:.0%}: {low:.{digits}f} to {high:.{digits}f})"


def find_doubts(of: PathTotals, path: Subject) -> Iterator[Finding]:
    """Yield where the model has no support on a path, and how little its intervals rest on."""
    for reason, count in of.reasons.items():
        names, total = {"reason": reason.replace("_", " ")}, of.pieces
        yield make_finding("path-not-supported", path, names=names, segment_count=count, total_count=total)
    if of.duration_interval_s is None:
        yield make_finding("no-intervals", path)
    of_both = {"time": (of.duration_s, of.duration_interval_s), "energy": (of.energy_joule, of.energy_interval_joule)}
    for quantity, (value, ends) in of_both.items():
        if ends is not None and ends[1] - ends[0] > abs(value):
            yield make_finding("interval-wide", path, names={"quantity": quantity})
    if of.held_out_runs == 1 and of.duration_interval_s is not None:
        yield make_finding("one-held-out-run", path, sample_count=of.held_out_samples)


def predict_path(model: CostModel, source: MapFile, path: Path, out: Path | None) -> PathResult:
    """Return what the line in a GeoJSON file costs; write its pieces to ``out`` and the totals beside it.

    Raises
    ------
    PathError, ModelError, MapError : the path, the model or the map cannot be used.
    UsageError, StoreError : ``out`` ends in no known format, or cannot be written.
    """
    if out is not None:
        check_ending(out)
        clear_beside(out)
        if out.resolve() == path.resolve():
            raise UsageError(f"{out}: is the path itself; give the table another name")
    lonlat_deg = read_line(path)
    line = {"lonlat_deg": lonlat_deg.tolist(), "version": VERSION}
    key = digest({**line, "model": model.checksum, "map": source.summary()})
    if out is not None and (known := _compute_totals(out, key)) is not None:
        return convert_record(known, PathResult, path=path, out=out, status="unchanged")
    cost = compute_path_cost(model, source, lonlat_deg, where=str(path))
    totals = convert_record(
        cost.totals, NamedTotals, model=model.name, map=source.name, robot=model.robot, label_energy=model.label_energy
    )
    if out is not None:
        write_pieces(out, cost.pieces)
        write_sealed(
            make_summary_path(out), convert_record(totals, TableTotals, key=key, sha256=compute_checksum(out).sha256)
        )
    return convert_record(totals, PathResult, path=path, out=out, status="done")


def make_summary_path(out: Path) -> Path:
    """Return where the totals of a table of pieces stand."""
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
