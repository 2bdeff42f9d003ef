"""``tcpipe evaluate --drive``: drives measured against predicted, as ``drives.json`` and a page with a picture of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tcpipe import __version__
from tcpipe.dataset import Dataset
from tcpipe.errors import UsageError, plain_lines
from tcpipe.formats.atomic import clear, write_text
from tcpipe.formats.json_files import write_json
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.published import published
from tcpipe.planning.cost_model import CostModel
from tcpipe.planning.drives import Against, DriveCost, drive_cost, drive_in, in_words
from tcpipe.report.page import Number, Section, render_page
from tcpipe.report.prediction_figures import sums_along
from tcpipe.store import open_store
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
    duration_s: Against
    energy_joule: Against


@dataclass(frozen=True, slots=True)
class DrivesResult:
    """What was found and where it lies; ``str`` of it is what the command prints."""

    path: Path | str
    values: Drives

    def __str__(self) -> str:
        """Return each drive and their sum, as plain lines."""
        lines = [line for drive in self.values.drives for line in in_words(drive)]
        held = [drive for drive in self.values.drives if drive.held_back]
        if len(held) > 1:
            of_both = {"time": self.values.duration_s, "energy": self.values.energy_joule}
            hits = [sum(getattr(drive, name).held is True for drive in held) for name in ("duration_s", "energy_joule")]
            sums = ", ".join(f"{called} {of.off_percent:+.1f} %" for called, of in of_both.items())
            lines.append(
                f"all {len(held)} drives held back: {sums}; intervals hold {hits[0]} of the times and {hits[1]} of the energies"
            )
        return plain_lines((*lines, f"open {self.path}/{PAGE}"))


def evaluate_drives(
    model: CostModel, data: Dataset, source: MapReader, logs: Sequence[str], *, store: str | Path, out: str | Path
) -> DrivesResult:
    """Compare drives with what a model says of them and write ``drives.json`` and ``drives.html`` into the directory ``out``, or to a URL.

    Raises
    ------
    ModelError, MapError, UsageError
        As `drives.drive_cost`; ``out`` is a file.

    """
    if is_url(out):
        with published(str(out), JSON) as made:
            result = evaluate_drives(model, data, source, logs, store=store, out=made)
        return replace(result, path=str(out))
    place, opened = Path(out), open_store(store)
    runs = [drive_in(opened, log) for log in logs]
    clear(place)
    if place.exists() and not place.is_dir():
        raise UsageError(f"{place}: is a file, wanted a directory to write {JSON} and {PAGE} into")
    found = tuple(drive_cost(model, source, run, data, log=log) for run, log in zip(runs, logs, strict=True))
    held = [drive for drive in found if drive.held_back]
    values = Drives(
        model=model.name, model_checksum=model.checksum, drives=found,
        duration_s=_sum([drive.duration_s for drive in held]), energy_joule=_sum([drive.energy_joule for drive in held]),
    )  # fmt: skip
    place.mkdir(parents=True, exist_ok=True)
    write_json(place / JSON, values)
    write_text(place / PAGE, _page(values))
    return DrivesResult(place, values)


def _sum(parts: Sequence[Against]) -> Against:
    """Return sums over drives; how errors of drives go together is not known, so there is no interval."""
    return Against(sum(of.measured for of in parts), sum(of.predicted for of in parts), None, None)


def _page(values: Drives) -> str:
    sections = []
    for drive in values.drives:
        svg = ""
        if drive.along.distance_m:
            panels = {"time T [s]": drive.along.duration_s, "energy E [J]": drive.along.energy_joule}
            svg = sums_along(np.array(drive.along.distance_m), {name: _columns(of) for name, of in panels.items()})
        sections.append(Section(drive.run_id, " ".join(f"{line}." for line in in_words(drive)), svg=svg))
    return render_page(
        title="Drives, measured and predicted",
        lead=f"Model {Path(values.model).name}: sums along each drive over the metres that can be compared, with 90 % intervals.",
        numbers=[
            Number(f"{of.off_percent:+.1f} %", f"{called} of all drives held back, predicted less measured")
            for called, of in (("time", values.duration_s), ("energy", values.energy_joule))
            if of.measured
        ],
        warnings=[line for drive in values.drives for line in in_words(drive) if line.startswith("warning: ")],
        sections=sections,
    )


def _columns(sums: Sequence[Against]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return measured, predicted, low, high, shape (4, N)."""
    return np.array(
        [[np.nan if v is None else v for v in (of.measured, of.predicted, of.low, of.high)] for of in sums]
    ).T
