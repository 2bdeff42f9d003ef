"""The files of an evaluation (``tcpipe evaluate``).

::

    evaluation.json       errors by split, quantity and class, with the noise floor of the labels
    evaluation.html       the page
    predictions.parquet   labels and predictions of every sample
"""

from dataclasses import asdict, dataclass
from pathlib import Path

from tcpipe import __version__
from tcpipe.errors import UsageError, clean_lines
from tcpipe.formats.atomic import Location, clear, write_text
from tcpipe.formats.dataset_files import is_shard, read_card
from tcpipe.formats.finding_lines import format_findings, list_verdict
from tcpipe.formats.integrity import seal_document
from tcpipe.formats.json_files import digest, parse_json, parse_typed, write_json
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.parquet import write_table
from tcpipe.formats.published_outputs import (
    fetch_directory,
    fetch_directory_by_range,
    find_newest,
    open_output,
    require_card,
)
from tcpipe.formats.runs import format_html_table
from tcpipe.learning.baselines import describe_ratios
from tcpipe.learning.evaluation import UNKNOWN_DISTANCE, EvaluateConfig, Evaluation, evaluate
from tcpipe.learning.evaluation_page import render_evaluation_page
from tcpipe.learning.metrics import ALL, QUANTITIES
from tcpipe.learning.models import read_model_card
from tcpipe.learning.own_models import load_own_kind
from tcpipe.learning.training import compute_dataset_checksum

JSON, PAGE, SAMPLES = "evaluation.json", "evaluation.html", "predictions.parquet"


@dataclass(frozen=True, slots=True)
class EvaluationResult:
    """Result and its path; the command prints its ``str``."""

    path: str
    values: Evaluation

    def __str__(self) -> str:
        """Return the errors of all classes together, as plain lines."""
        lines = list[str]()
        for split, part in self.values.splits.items():
            figures = (
                f"{quantity} {error.mape_percent or float('nan'):.2f} % ({error.mape_count})"
                for quantity, error in (
                    (quantity, part.errors[quantity][ALL]) for quantity in QUANTITIES if quantity in part.errors
                )
            )
            lines.append(f"{split}: {part.samples} samples, MAPE (number of labels) {', '.join(figures)}")
            lines += [
                f"{split}: 90 % intervals of {name} cover {coverage}"
                for name, coverage in part.coverage.items()
                if name in "TE"
            ]
            lines.append(f"{split}: {part.leakage or UNKNOWN_DISTANCE}")
        lines += describe_ratios(self.values.baselines)
        lines += [f"verdict: {line}" for line in list_verdict(self.values.verdict, self.values.judged)]
        lines += format_findings(self.values.findings)
        return clean_lines((*lines, f"open {self.path}/{PAGE}"))

    def _repr_html_(self) -> str:
        """Return the errors of all classes together as a table for notebooks."""
        rows = [
            (
                split,
                quantity,
                error.count,
                f"{error.rmse or float('nan'):.3g}",
                f"{error.mape_percent or float('nan'):.1f} %",
            )
            for split, part in self.values.splits.items()
            for quantity, errors in part.errors.items()
            for error in (errors[ALL],)
        ]
        header = ("split", "quantity", "samples", "RMSE", "MAPE")
        verdict = [("verdict", line) for line in list_verdict(self.values.verdict, self.values.judged)]
        return format_html_table(f"Evaluation {self.path}", rows, header) + format_html_table("", verdict)


def run_evaluation(
    model: Location,
    dataset: Location,
    out: Location = "evaluation",
    *,
    config: EvaluateConfig | None = None,
    predictor: str | None = None,
) -> EvaluationResult:
    """Evaluate a model on a dataset into the directory ``out``: new, empty, or an earlier evaluation.

    It may be a URL in a bucket, where it becomes the newest build. An identical existing evaluation is kept.
    """
    rules = config or EvaluateConfig()
    own = [] if predictor is None else [load_own_kind(predictor).digest]
    lines = [
        seal_document(read_model_card(fetch_directory(model))),
        compute_dataset_checksum(read_card(fetch_directory_by_range(dataset, by_range=is_shard)[0])),
        asdict(rules),
        __version__,
        *own,
    ]
    key = digest(lines)
    if not is_url(out):
        _check_directory(Path(out))
    if (known := _read_known(out, key)) is not None:
        return known
    with open_output(out, JSON) as place:
        found, table = evaluate(model, dataset, rules, key=key, predictor=predictor)
        write_table(table, place / SAMPLES)
        write_text(place / PAGE, render_evaluation_page(found, table))
        write_json(place / JSON, found)  # last: it makes the evaluation complete
    return EvaluationResult(require_card(str(out), [JSON]).place.where(), found)


def _check_directory(place: Path) -> None:
    """Raise `UsageError` for something else than an earlier evaluation."""
    clear(place)
    own_files = {JSON, PAGE, SAMPLES, "drives.json"}
    if place.exists() and (
        not place.is_dir() or {entry.name for entry in place.iterdir() if entry.name[0] != "."} - own_files
    ):
        raise UsageError(f"{place}: exists and is no evaluation; it is not changed; give another OUT")


def _read_known(out: Location, key: str) -> EvaluationResult | None:
    """Return the evaluation in a directory, or the newest one at a URL, if it has this key and all of its files."""
    found = find_newest(str(out), [JSON])
    if found is None or {JSON, PAGE, SAMPLES} - set(found.place.list()):
        return None
    values, where = parse_json(found.data, Path(JSON)), Path(found.place.where(JSON))
    if values.get("key") != key:
        return None
    return EvaluationResult(found.place.where(), parse_typed(values, Evaluation, where))
