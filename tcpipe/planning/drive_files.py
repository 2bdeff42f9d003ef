"""``tcpipe evaluate --drive``: drives measured against predicted, as ``drives.json`` and a page with figures of each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tcpipe import __version__
from tcpipe.dataset import Dataset
from tcpipe.errors import UsageError, clean_lines
from tcpipe.formats.atomic import clear, write_text
from tcpipe.formats.bucket_directories import require_card
from tcpipe.formats.finding_lines import format_findings, format_verdict
from tcpipe.formats.json_files import write_json
from tcpipe.formats.object_storage import is_url
from tcpipe.pipeline.generations import write_generation
from tcpipe.planning.cost_model import CostModel
from tcpipe.planning.drives import DriveCost, IntervalComparison, compute_drive_cost, find_drive, format_drive
from tcpipe.report.colours import DROPPED, SPLIT_COLOURS
from tcpipe.report.page import Number, Section, render_page
from tcpipe.report.plots import Plot, make_plot
from tcpipe.report.verdict import show_verdict
from tcpipe.store import open_store
from tcpipe.tables.catalogue import read_threshold
from tcpipe.tables.findings import PREDICTED, Finding, Subject, Verdict, judge, make_finding
from tcpipe.terrain.tiles import MapReader

JSON, PAGE = "drives.json", "drives.html"


@dataclass(frozen=True, slots=True, kw_only=True)
class Drives:
    """All of drives.json; ``duration_s`` and ``energy_joule`` are over all drives that were held back."""

    kind: str = "tcpipe drives"
    tcpipe_version: str = __version__
    model: str
    model_checksum: str
    drives: tuple[DriveCost, ...]
    duration_s: IntervalComparison
    energy_joule: IntervalComparison
    findings: tuple[Finding, ...]
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class DrivesResult:
    """What was found and where it lies; ``str`` of it is what the command prints."""

    path: Path | str
    values: Drives

    def __str__(self) -> str:
        """Return each drive and their sum, as plain lines."""
        lines = [line for drive in self.values.drives for line in format_drive(drive)]
        held = [drive for drive in self.values.drives if drive.held_back]
        if len(held) > 1:
            of_both = {"time": self.values.duration_s, "energy": self.values.energy_joule}
            hits = [sum(getattr(drive, name).held is True for drive in held) for name in ("duration_s", "energy_joule")]
            sums = ", ".join(f"{called} {of.off_percent:+.1f} %" for called, of in of_both.items())
            lines.append(
                f"all {len(held)} drives held back: {sums}; intervals hold {hits[0]} of the times and {hits[1]} of the energies"
            )
        lines += [f"verdict: {format_verdict(self.values.verdict, PREDICTED)}", *format_findings(self.values.findings)]
        return clean_lines((*lines, f"open {self.path}/{PAGE}"))


def evaluate_drives(
    model: CostModel, data: Dataset, source: MapReader, logs: Sequence[str], *, store: str | Path, out: str | Path
) -> DrivesResult:
    """Compare drives with what a model says of them and write ``drives.json`` and ``drives.html`` into the directory ``out``, or to a URL.

    Raises
    ------
    ModelError, MapError, UsageError : as `drives.drive_cost`; ``out`` is a file.
    """
    if is_url(out):
        with write_generation(str(out), JSON) as made:
            result = evaluate_drives(model, data, source, logs, store=store, out=made)
        return replace(result, path=require_card(str(out), [JSON]).place.where())
    place, opened = Path(out), open_store(store)
    runs = [find_drive(opened, log) for log in logs]
    clear(place)
    if place.exists() and not place.is_dir():
        raise UsageError(f"{place}: is a file, wanted a directory to write {JSON} and {PAGE} into")
    found = tuple(compute_drive_cost(model, source, run, data, log=log) for run, log in zip(runs, logs, strict=True))
    held, findings = (
        [drive for drive in found if drive.held_back],
        tuple(_find_doubts(found, Subject("model", model.name))),
    )
    values = Drives(
        model=model.name, model_checksum=model.checksum, drives=found,
        duration_s=_sum([drive.duration_s for drive in held]), energy_joule=_sum([drive.energy_joule for drive in held]),
        findings=findings, verdict=judge(findings),
    )  # fmt: skip
    place.mkdir(parents=True, exist_ok=True)
    write_json(place / JSON, values)
    write_text(place / PAGE, _render_page(values))
    return DrivesResult(place, values)


def _sum(parts: Sequence[IntervalComparison]) -> IntervalComparison:
    """Return sums over drives; how errors of drives go together is not known, so there is no interval."""
    return IntervalComparison(sum(of.measured for of in parts), sum(of.predicted for of in parts), None, None)


def _render_page(values: Drives) -> str:
    return render_page(
        title="Drives, measured and predicted",
        lead=f"Model {Path(values.model).name}: sums along each drive over the metres that can be compared, with 90 % intervals.",
        numbers=[
            Number(f"{of.off_percent:+.1f} %", f"{called} of all drives held back, predicted less measured")
            for called, of in (("time", values.duration_s), ("energy", values.energy_joule))
            if of.measured
        ],
        verdict=show_verdict(values.verdict, values.findings, PREDICTED),
        sections=[
            Section(
                drive.run_id,
                " ".join(f"{line}." for line in format_drive(drive)),
                plots=list(_draw_sums(number, drive)),
            )
            for number, drive in enumerate(values.drives)
        ],
    )


def _find_doubts(drives: Sequence[DriveCost], model: Subject) -> Iterator[Finding]:
    """Yield what drives show of a model's sums and intervals, and which drives show nothing."""
    for drive in drives:
        if not drive.held_back:
            yield make_finding(
                "drive-in-training", Subject("run", drive.run_id), trained_count=drive.samples_in_training
            )
    compared = [drive for drive in drives if drive.held_back and drive.compared_m]
    if not compared:
        yield make_finding("no-drive-compared", model)
    for name, quantity in (("time", "duration_s"), ("energy", "energy_joule")):
        sums: dict[str, IntervalComparison] = {drive.run_id: getattr(drive, quantity) for drive in compared}
        for run_id, of in sums.items():
            error = abs(of.off_percent) / 100.0
            if error >= read_threshold(f"{name}-far-off", "max_error_fraction"):
                yield make_finding(f"{name}-far-off", Subject("run", run_id), error_fraction=error)
        held = [of.held for of in sums.values() if of.held is not None]
        if held and sum(held) < read_threshold(f"{name}-overconfident", "min_drive_coverage_fraction") * len(held):
            yield make_finding(f"{name}-overconfident", model, coverage_fraction=sum(held) / len(held))
    if 0 < len(compared) < read_threshold("few-drives", "min_drive_count"):
        yield make_finding("few-drives", model, drive_count=len(compared))


def _draw_sums(number: int, drive: DriveCost) -> Iterator[Plot]:
    """Yield what a drive took so far over the distance driven, measured and predicted, with its interval."""
    distance_m, first = np.array(drive.along.distance_m), None
    for label, sums in (("time T [s]", drive.along.duration_s), ("energy E [J]", drive.along.energy_joule)):
        if not len(distance_m):
            return
        plot = make_plot(
            f"{label} {number}",
            alt=f"{label} of {drive.run_id} so far over the distance driven, measured and predicted, with its 90 % interval.",
            axes=("distance driven in segments [m]", label),
            legend={"measured": DROPPED, "predicted, with its interval": SPLIT_COLOURS["train"]},
            beside=first,
            tooltips=[
                ("at", "@metres{0.0} m"),
                ("measured", "@measured{0.0}"),
                ("predicted", "@predicted{0.0}"),
                ("90 %", "@low{0.0} to @high{0.0}"),
            ],
        )
        columns = dict(zip(("measured", "predicted", "low", "high"), _collect_columns(sums), strict=True))
        source = {"metres": distance_m, **columns}
        plot.figure.varea("metres", "low", "high", source=source, color=SPLIT_COLOURS["train"], alpha=0.2)
        plot.figure.hover.renderers = [
            plot.figure.line("metres", name, source=source, color=colour, line_width=2)
            for name, colour in (("measured", DROPPED), ("predicted", SPLIT_COLOURS["train"]))
        ]
        plot.figure.hover.mode = "vline"
        plot.figure.yaxis.formatter.use_scientific = False
        first = plot
        yield plot


def _collect_columns(sums: Sequence[IntervalComparison]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return measured, predicted, low, high, shape (4, N)."""
    return np.array(
        [[np.nan if v is None else v for v in (of.measured, of.predicted, of.low, of.high)] for of in sums]
    ).T
