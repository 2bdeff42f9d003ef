"""The files of an evaluation: ``evaluation.json`` and ``.html``, ``predictions.parquet``, and the networks that it trained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from tcpipe import __version__
from tcpipe.cost.adaptation import AdaptedErrors, Run, compare_adaptations, format_adaptations
from tcpipe.dataset import open_dataset
from tcpipe.dataset.energies import ENERGIES
from tcpipe.errors import DatasetError, ModelError, StoreError, UsageError, clean_lines
from tcpipe.formats.atomic import clear, write_text
from tcpipe.formats.dataset_files import is_shard, read_card
from tcpipe.formats.finding_lines import format_findings, list_verdict
from tcpipe.formats.integrity import seal_document
from tcpipe.formats.json_files import digest, parse_json, parse_typed, read_as, read_json, write_json
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.parquet import read_table, write_table
from tcpipe.formats.published_outputs import (
    fetch_directory,
    fetch_directory_by_range,
    find_newest,
    require_card,
    write_output,
)
from tcpipe.learning.baselines import describe_ratios
from tcpipe.learning.evaluation import NETWORKS, PlantCosts, evaluate
from tcpipe.learning.evaluation_facts import EvaluateConfig, Evaluation
from tcpipe.learning.evaluation_figures import EvaluatedSamples, select_evaluated_samples
from tcpipe.learning.evaluation_page import format_leakage, render_evaluation_page
from tcpipe.learning.metrics import ALL, QUANTITIES
from tcpipe.learning.models import load_model, read_model_card
from tcpipe.learning.own_models import load_own_kind
from tcpipe.learning.predictions import check_fit, collect_runs
from tcpipe.learning.training import compute_dataset_checksum

SIMULATED = "The data are simulated: compare the pattern with the paper, not the numbers."

JSON, PAGE, SAMPLES = "evaluation.json", "evaluation.html", "predictions.parquet"


@dataclass(frozen=True, slots=True)
class EvaluationResult:
    """Result and its path; the command prints its ``str``."""

    path: Path | str
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
            lines.append(f"{split}: {part.samples} samples, MAPE (of so many labels) {', '.join(figures)}")
            lines += [
                f"{split}: 90 % intervals of {name} cover {coverage}"
                for name, coverage in part.coverage.items()
                if name in "TE"
            ]
            lines.append(f"{split}: {format_leakage(part.leakage)}")
        lines += describe_ratios(self.values.baselines)
        lines += [f"verdict: {line}" for line in list_verdict(self.values.verdict, self.values.judged)]
        lines += format_findings(self.values.findings)
        return clean_lines((*lines, f"open {self.path}/{PAGE}"))


def run_evaluation(
    model: str | Path,
    dataset: str | Path,
    out: str | Path = "evaluation",
    *,
    config: EvaluateConfig | None = None,
    plant: PlantCosts | None = None,
    predictor: str | None = None,
) -> EvaluationResult:
    """Evaluate a model on a dataset into the directory ``out``: new, empty, or an earlier evaluation, whose networks are used again.

    It may be a URL in a bucket, where it becomes the newest build. Where the same evaluation is already, only its page
    is written again; at a URL nothing is.
    """
    rules = config or EvaluateConfig()
    own = [] if predictor is None else [load_own_kind(predictor).digest]
    key = _make_key(model, dataset, rules, own, simulated=plant is not None)
    if is_url(out):
        if (known := _read_at_url(str(out), key)) is not None:
            return known
        with write_output(str(out), JSON) as made:
            result = run_evaluation(model, dataset, made, config=config, plant=plant, predictor=predictor)
        return replace(result, path=require_card(str(out), [JSON]).place.where())
    place = Path(out)
    clear(place)
    ours = {JSON, PAGE, SAMPLES, NETWORKS, ADAPTATION, "drives.json"}
    if place.exists() and (
        not place.is_dir() or {entry.name for entry in place.iterdir() if entry.name[0] != "."} - ours
    ):
        raise UsageError(f"{place}: exists and is no evaluation; it is not changed; give another OUT")
    if not ((place / JSON).is_file() and (place / SAMPLES).is_file()) or read_json(place / JSON).get("key") != key:
        found, table = evaluate(model, dataset, place, rules, key=key, plant=plant, predictor=predictor)
        if _make_key(model, dataset, rules, own, simulated=plant is not None) != key:
            raise StoreError(
                f"{dataset} or {model}: another call has replaced it in the meantime; run the command again"
            )
        write_table(table, place / SAMPLES)
        write_json(place / JSON, found)  # last: with it the evaluation is whole
    values = read_as(place / JSON, Evaluation)  # in the order of the file, as the next call will read it
    name = values.dataset.name
    note = "" if values.model.label_energy == "total" else f" (w and E {ENERGIES[values.model.label_energy].words})"
    costs = "time T and energy E" if "E" in values.costs else "time T"
    lead = f"Model {Path(model).name} on dataset {name}: errors of {costs}{note}."
    samples = read_evaluated_samples(place, dataset)
    write_text(
        place / PAGE,
        render_evaluation_page(
            values, samples, title=f"Evaluation on {name}", lead=lead, warnings=[SIMULATED] if plant is not None else []
        ),
    )
    return EvaluationResult(place, values)


def read_evaluated_samples(place: Path, dataset: str | Path) -> EvaluatedSamples:
    """Return what the page of the evaluation in ``place`` shows of the samples of its dataset."""
    return select_evaluated_samples(read_table(place / SAMPLES), open_dataset(dataset))


def _read_at_url(url: str, key: str) -> EvaluationResult | None:
    """Return the newest evaluation at a URL if it has this key; None otherwise."""
    found = find_newest(url, [JSON])
    if found is None:
        return None
    where = found.place.where(JSON)
    values = parse_json(found.data, where)
    return (
        EvaluationResult(found.place.where(), parse_typed(values, Evaluation, where))
        if values.get("key") == key
        else None
    )


def _make_key(
    model: str | Path, dataset: str | Path, config: EvaluateConfig, own: list[str], *, simulated: bool
) -> str:
    """Return the text that identifies an evaluation."""
    lines = [
        seal_document(read_model_card(fetch_directory(model))),
        compute_dataset_checksum(read_card(fetch_directory_by_range(dataset, by_range=is_shard)[0])),
        asdict(config),
        simulated,
        __version__,
        *own,
    ]
    return digest(lines)


ADAPTATION = "adaptation.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptationFacts:
    """All of adaptation.json: errors on the rest of runs, after the first metres of each are known."""

    kind: str = "tcpipe adaptation"
    tcpipe_version: str = __version__
    model: str
    dataset: str
    robots: tuple[str, ...]
    """Robots of the model, then of the dataset."""
    known_m: tuple[float, ...]
    errors: tuple[AdaptedErrors, ...]


@dataclass(frozen=True, slots=True)
class AdaptationResult:
    """Result and its path; the command prints its ``str``."""

    path: Path
    values: AdaptationFacts

    def __str__(self) -> str:
        """Return the errors by known metres, as plain lines."""
        return clean_lines((*format_adaptations(self.values.errors), f"wrote {self.path / ADAPTATION}"))


def evaluate_adaptation(
    model: str | Path,
    dataset: str | Path,
    out: str | Path,
    known_m: Sequence[float],
    *,
    runs: Sequence[Run] | None = None,
    predictor: str | None = None,
) -> AdaptationResult:
    """Predict the rest of each run after its first metres are known, and write adaptation.json into the directory ``out``.

    ``runs`` are whole drives; without them those of the dataset whose samples did not train the model.
    """
    if not known_m or not all(0.0 <= metres < np.inf for metres in known_m):
        raise UsageError(f"adapt: {known_m} are no metres of a run; expected some, as 0, 10, 50")
    ours = load_model(model, predictor)
    data = open_dataset(dataset, label=ours.card.label_energy)
    errors = ours.errors
    if errors is None:
        raise ModelError(
            f"{model}: has too few held-out samples to state errors, which an adaptation weighs; train on more"
        )
    if ours.card.inputs.is_time_alone:
        raise ModelError(f"{model}: predicts time alone; an adaptation needs a model of energy, too")
    if runs is None:
        check_fit(ours.card, data, str(model), any_robot=True)
        runs = collect_runs(ours, data)
    stated = {quantity: errors[quantity] for quantity in ("energy", "duration")}
    found = tuple(compare_adaptations(stated, runs, sorted(set(known_m))))
    if not found:
        longest_m = max((float(run.metres["energy"].length_m.sum()) for run in runs), default=0.0)
        raise DatasetError(
            f"{dataset}: no run has {max(known_m):g} m of labelled samples and more to predict, the longest has {longest_m:.0f} m; "
            "give smaller values to --adapt"
        )
    place, robots = Path(out), (ours.card.robot, ", ".join(data.card.robots))
    place.mkdir(parents=True, exist_ok=True)
    values = AdaptationFacts(
        model=ours.name, dataset=data.card.name, robots=robots, known_m=tuple(sorted(set(known_m))), errors=found
    )
    write_json(place / ADAPTATION, values)
    return AdaptationResult(place, values)
