"""``tcpipe benchmark``: the paper's table for all kinds of models and datasets, with intervals over runs, trainings.

::

    benchmark.json, benchmark.html          the tables
    DATASET/KIND-SEED/model, evaluation     each training, and its evaluation; complete ones are not repeated
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from scipy.special import stdtrit

from tcpipe import __version__
from tcpipe.arrays import Floats, Texts
from tcpipe.dataset import open_dataset
from tcpipe.errors import UsageError, align_columns, clean_lines
from tcpipe.formats.atomic import Location, write_text
from tcpipe.formats.json_files import read_json, write_json
from tcpipe.formats.parquet import read_table
from tcpipe.learning.baselines import SPLITS
from tcpipe.learning.evaluation import EvaluateConfig, Evaluation
from tcpipe.learning.evaluation_files import SAMPLES, run_evaluation
from tcpipe.learning.fitting import FitConfig, ModelKind
from tcpipe.learning.metrics import ALL, LEAST, QUANTITIES, UNITS, Ratio, mean_known
from tcpipe.learning.predictions import compute_cost_errors, make_column_name
from tcpipe.learning.predictor import find_kind
from tcpipe.learning.training import train
from tcpipe.progress import logger
from tcpipe.report.page import PageSection, render_page
from tcpipe.tables.columns import to_floats, to_texts

JSON, PAGE = "benchmark.json", "benchmark.html"

KINDS: tuple[ModelKind, ...] = ("linear", "physics", "boosting", "resnet18")

_FEWEST_RUNS = 5  # runs below which an error has no interval [1]
_UPPER = 0.975  # quantile of Student's t at the upper end of a 95 % interval [1]


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchmarkRow:
    """Errors of one kind on one dataset, split, quantity and class."""

    dataset: str
    split: str
    kind: str
    quantity: str
    terrain: str
    """Name of a class, or ``all``."""
    rmse: Ratio
    """Mean over trainings in the quantity's unit, with 95 % interval over runs and trainings; None below five runs."""
    mape_percent: float | None
    coverage_percent: float | None = None
    """Coverage of 90 % intervals. This and the next two are known for all classes together only."""
    crps: float | None = None
    largest_r2: float | None = None
    """Share of the labels' variance that their own noise lets a perfect model explain."""
    seeds: int
    training_s: float
    """Mean time of a training."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Benchmark:
    """All of benchmark.json."""

    kind: str = "tcpipe benchmark"
    tcpipe_version: str = __version__
    rows: tuple[BenchmarkRow, ...]


@dataclass(frozen=True, slots=True)
class BenchmarkResult:
    """Result of a benchmark; the command prints it by ``str``."""

    path: Path
    values: Benchmark
    evaluations: Mapping[tuple[str, str], Sequence[Evaluation]]
    """Evaluations of all trainings, by name of the dataset and kind."""

    def __str__(self) -> str:
        """Return the tables as plain lines."""
        lines = list[str]()
        for title, header, rows in list_tables(self.values.rows):
            lines += [title, *align_columns([header, *rows]), ""]
        return clean_lines((*lines, f"open {self.path / PAGE}"))


def run_benchmark(
    datasets: Sequence[Location],
    out: Location,
    *,
    kinds: Sequence[ModelKind] = KINDS,
    seeds: int = 5,
    predictor: str | None = None,
    config: FitConfig | None = None,
    evaluating: EvaluateConfig | None = None,
) -> BenchmarkResult:
    """Train and evaluate every kind on every dataset below ``out``.

    Parameters
    ----------
    datasets, kinds : every kind is trained on every dataset; names of datasets differ.
    seeds : number of trainings of a network or own model; other kinds do not depend on the seed and are trained once.
    predictor : code of an own model, which is compared with the kinds.
    config, evaluating : settings of all trainings and evaluations.
    """
    place, names = Path(out), [Path(dataset).name for dataset in datasets]
    if len(set(names)) < len(names):
        raise UsageError(f"datasets {', '.join(names)}: expected different names of their folders")
    own_kind: tuple[ModelKind, ...] = () if predictor is None else ("own",)
    evaluations, rows = dict[tuple[str, str], Sequence[Evaluation]](), list[BenchmarkRow]()
    for dataset, name in zip(datasets, names, strict=True):
        data = open_dataset(dataset)
        columns = ((data[split].column(key).tolist() for key in ("sample_id", "run_id")) for split in SPLITS)
        run_of = {sample: run for ids, run_ids in columns for sample, run in zip(ids, run_ids, strict=True)}
        for kind in (*kinds, *own_kind):
            own = predictor if kind == "own" else None
            is_random = kind == "own" or find_kind(kind).stops_by_fold
            count, repeated, tables, times_s = seeds if is_random else 1, list[Evaluation](), list[pa.Table](), []
            for seed in range(count):
                folder = place / name / f"{kind}-{seed}"
                logger.info("%s: %s, training %d of %d", name, kind, seed + 1, count)
                fit_config = replace(config or FitConfig(), model=kind, seed=seed)
                times_s.append(_train(dataset, folder, fit_config, own))
                evaluate_config = replace(evaluating or EvaluateConfig(noise_draws=1), seed=seed)
                evaluation = run_evaluation(
                    folder / "model", dataset, folder / "evaluation", config=evaluate_config, predictor=own
                )
                repeated.append(evaluation.values)
                tables.append(read_table(folder / "evaluation" / SAMPLES))
            evaluations[name, kind] = repeated
            runs = np.array([run_of[sample] for sample in to_texts(tables[0].column("sample_id"))], np.str_)
            rows += _summarize(name, kind, repeated, tables, runs, float(np.mean(times_s)))
    values = Benchmark(rows=tuple(rows))
    write_json(place / JSON, values)
    sections = [PageSection(title, header=header, rows=table) for title, header, table in list_tables(values.rows)]
    lead = "Errors of every kind of model; intervals are of 95 %, over runs and trainings."
    write_text(place / PAGE, render_page(title="Benchmark", lead=lead, numbers=[], sections=sections))
    return BenchmarkResult(place, values, evaluations)


def _train(dataset: Location, here: Path, config: FitConfig, predictor: str | None) -> float:
    """Train a model, or find that it is there; return how long the training took [s]."""
    result, where = train(dataset, here / "model", config=config, predictor=predictor), here / "training.json"
    if result.status == "done" or not where.is_file():
        write_json(where, {"training_s": result.training_times_s.total_s, "device": result.device})
    return float(str(read_json(where)["training_s"]))


def _summarize(  # noqa: PLR0917
    name: str, kind: str, made: Sequence[Evaluation], tables: Sequence[pa.Table], runs: Texts, training_s: float
) -> Iterator[BenchmarkRow]:
    splits, classes = (to_texts(tables[0].column(column)) for column in ("split", "terrain_name"))
    for split, part in made[0].splits.items():
        for quantity in (quantity for quantity in QUANTITIES if quantity in part.errors):
            label = to_floats(tables[0], make_column_name(quantity))
            off = np.stack([compute_cost_errors(table, quantity) for table in tables])
            for terrain in (*part.class_order, ALL):
                rows = (splits == split) & ((classes == terrain) | (terrain == ALL))
                found = [each.splits[split].errors[quantity][terrain] for each in made]
                large, is_all = rows & (label >= LEAST[quantity]), terrain == ALL
                floor, spread = part.label_floor[quantity][ALL].rmse or 0.0, float(label[rows].std())
                yield BenchmarkRow(
                    dataset=name, split=split, kind=kind, quantity=quantity, terrain=terrain,
                    rmse=estimate_rmse(off[:, rows], runs[rows]),
                    mape_percent=100.0 * float(np.mean(np.abs(off[:, large]) / label[large])) if large.any() else None,
                    coverage_percent=mean_known(each.coverage_percent for each in found) if is_all else None,
                    crps=mean_known(each.crps for each in found) if is_all else None,
                    largest_r2=max(1.0 - (floor / spread) ** 2, 0.0) if is_all and spread else None,
                    seeds=len(made), training_s=training_s,
                )  # fmt: skip


def estimate_rmse(errors: Floats, runs: Texts) -> Ratio:
    """Return the root mean square of errors, shape (trainings, N), with its 95 % interval.

    The variance of the mean square is that between runs, whose samples correlate, and that between trainings over their
    number.
    """
    if not errors.size:
        return Ratio(None, None, None)
    squares, count = np.square(errors), errors.shape[1]
    value = float(np.sqrt(squares.mean()))
    _, at = np.unique(runs, return_inverse=True)
    groups = int(at.max()) + 1
    if groups < _FEWEST_RUNS or not value:
        return Ratio(value, None, None)
    sums = np.bincount(at, squares.mean(axis=0) - squares.mean())
    variance = groups / (groups - 1.0) * float(np.square(sums).sum()) / count**2
    if len(errors) > 1:
        variance += float(squares.mean(axis=1).var(ddof=1)) / len(errors)
    half = float(stdtrit(groups - 1, _UPPER) * np.sqrt(variance)) / (2.0 * value)
    return Ratio(value, max(value - half, 0.0), value + half)


def list_tables(rows: Sequence[BenchmarkRow]) -> Iterator[tuple[str, Sequence[str], list[Sequence[str]]]]:
    """Yield a title, a header and the lines of a table for each dataset and split."""
    for name, split in dict.fromkeys((row.dataset, row.split) for row in rows):
        selected = [row for row in rows if (row.dataset, row.split) == (name, split)]
        classes = [terrain for terrain in dict.fromkeys(row.terrain for row in selected) if terrain != ALL]
        found = {(row.quantity, row.kind, row.terrain): row for row in selected}
        lines: list[Sequence[str]] = []
        for quantity, kind in dict.fromkeys((row.quantity, row.kind) for row in selected):
            whole = found[quantity, kind, ALL]
            cells = [_format_cell(found.get((quantity, kind, terrain))) for terrain in (*classes, ALL)]
            more = (
                _format(whole.coverage_percent, ".0f"), _format(whole.crps, ".3g"), _format(whole.largest_r2, ".2f"),
                f"{whole.training_s:.0f} s", str(whole.seeds),
            )  # fmt: skip
            lines.append((f"{quantity} [{UNITS[quantity]}]", kind, *cells, *more))
        lines.sort(key=lambda line: QUANTITIES.index(str(line[0])[0]))
        header = ("", "kind", *(f"{terrain}: RMSE, MAPE %" for terrain in (*classes, ALL)))
        yield f"{name}, {split}", (*header, "coverage %", "CRPS", "largest R²", "training", "seeds"), lines


def _format_cell(row: BenchmarkRow | None) -> str:
    if row is None or row.rmse.value is None:
        return "–"
    low, high = row.rmse.low, row.rmse.high
    interval = "" if low is None or high is None else f" ({low:.3g} to {high:.3g})"
    return f"{row.rmse.value:.3g}{interval}, {_format(row.mape_percent, '.1f')}"


def _format(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)
