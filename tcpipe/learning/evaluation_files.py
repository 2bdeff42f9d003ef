"""The files of an evaluation: ``evaluation.json``, ``evaluation.csv``, ``evaluation.html``, and the networks that it trained."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcpipe.errors import UsageError
from tcpipe.formats.atomic import write_text
from tcpipe.formats.json_files import write_json
from tcpipe.learning.evaluation import NETWORKS, EvaluateConfig, Evaluation, evaluate
from tcpipe.learning.evaluation_page import COLUMNS, evaluation_page, evaluation_rows
from tcpipe.learning.metrics import ALL, QUANTITIES
from tcpipe.report.page import Section

JSON, CSV, PAGE = "evaluation.json", "evaluation.csv", "evaluation.html"


@dataclass(frozen=True, slots=True)
class EvaluationResult:
    """What was found and where it lies; ``str`` of it is what the command prints."""

    path: Path
    values: dict[str, Any]

    def __str__(self) -> str:
        """Return the errors of all classes together, as plain lines."""
        lines = [f"warning: {text}" for text in self.values["warnings"]]
        for split, part in self.values["splits"].items():
            figures = (
                f"{quantity} {part['errors'][quantity][ALL]['mape_percent'] or float('nan'):.2f} %"
                for quantity in QUANTITIES
            )
            lines.append(f"{split}: {part['samples']} samples, MAPE {', '.join(figures)}")
        return "\n".join((*lines, f"open {self.path / PAGE}"))


def run_evaluation(
    model: str | Path, dataset: str | Path, out: str | Path = "evaluation", *, config: EvaluateConfig | None = None
) -> EvaluationResult:
    """Evaluate a model on a dataset into the directory ``out``: new, empty, or an earlier evaluation, whose networks are used again.

    Raises
    ------
    UsageError
        ``out`` holds something else.
    ModelError, DatasetError
        As `evaluate`.

    """
    place = Path(out)
    ours = {JSON, CSV, PAGE, NETWORKS}
    if place.exists() and (
        not place.is_dir() or {entry.name for entry in place.iterdir() if entry.name[0] != "."} - ours
    ):
        raise UsageError(f"{place}: exists and is no evaluation; it is left alone; give another OUT")
    found = evaluate(model, dataset, place, config or EvaluateConfig())
    name = found.values["dataset"]["name"]
    lead = f"Model {Path(model).name} on dataset {name}: errors of power w, velocity v, time T and energy E, beside the paper's."
    write_evaluation(place, found, title=f"Evaluation on {name}", lead=lead)
    return EvaluationResult(place, found.values)


def write_evaluation(
    place: Path,
    found: Evaluation,
    *,
    title: str,
    lead: str,
    before: Sequence[Section] = (),
    warnings: Sequence[str] = (),
) -> None:
    """Write the three files."""
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(evaluation_rows(found.values))
    write_json(place / JSON, found.values)
    write_text(place / CSV, table.getvalue())
    write_text(place / PAGE, evaluation_page(found, title=title, lead=lead, before=before, warnings=warnings))
