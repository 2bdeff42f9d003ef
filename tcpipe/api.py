"""`read_log`, and the commands `train`, `evaluate`, `predict-path` and `plan-path` as functions with keywords.

A function imports its dependencies when it is called, so a model of physics loads no plots, and a path no evaluation.
"""

from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING

from tcpipe.formats.atomic import Location
from tcpipe.learning.model_options import EvaluateOptions, TrainOptions
from tcpipe.planning.path_options import PlanPathOptions, PredictPathOptions
from tcpipe.tables.options import as_function

if TYPE_CHECKING:
    from tcpipe.formats.logs.log_file import Log
    from tcpipe.formats.logs.message_tables import TableLog
    from tcpipe.learning.evaluation_files import EvaluationResult
    from tcpipe.learning.training import TrainResult
    from tcpipe.planning.drives import DrivesResult
    from tcpipe.planning.path_files import PathResult, PlanResult


def read_log(path: Location, *, msgdef: Location | None = None) -> Log | TableLog:
    """Open a log: ``topics``, ``table(topic)``, ``tables(topics)``, ``damage``; of a damaged log, the intact part.

    Raises `LogError`: the path is no log. ``msgdef`` is a directory of type definitions that the log lacks.
    """
    from tcpipe.formats.logs.log_joining import open_single_log

    return open_single_log(path, message_definitions=None if msgdef is None else Path(msgdef))


def run_train(options: TrainOptions) -> TrainResult:
    """Train a model on a dataset and write the model folder ``out``, whole or not at all.

    ``str`` of the result is what the command prints. Raises `UsageError` if an option is out of its range, or ``out``
    contains something else; `DatasetError` or `ModelError` if the dataset cannot be trained on, or the state of an
    interrupted training is damaged.
    """
    from tcpipe.errors import UsageError
    from tcpipe.formats.recipe_toml import resolve_recipe
    from tcpipe.learning.fitting import FitConfig
    from tcpipe.learning.training import train as run
    from tcpipe.recipe.checking import from_values

    names = [entry.name for entry in fields(FitConfig) if entry.name != "predictor"]
    given = {name: value for name in names if (value := getattr(options, name, None)) is not None}
    is_network = bool(given.keys() - {"model", "loss", "label", "extra_features", "layers"})
    if isinstance(layers := given.get("layers"), str):
        given["layers"] = [name.strip() for name in layers.split(",")]
    if options.predictor is not None and options.model is not None:
        raise UsageError(f"--model {options.model}: --predictor gives the model; remove one of them")
    if options.predictor is None:
        given["model"] = options.model or ("resnet18" if is_network else "auto")
    config = from_values(FitConfig, {**asdict(resolve_recipe(options.recipe).train), **given}, where="train")
    return run(options.dataset, options.out, config=config, no_resume=options.no_resume, predictor=options.predictor)


train = as_function(TrainOptions, run_train)


def run_evaluate(options: EvaluateOptions) -> EvaluationResult | DrivesResult:
    """Measure a model on a dataset's test samples and unseen area, or on whole drives; write the evaluation to ``out``.

    ``values`` of the result are those of the written JSON; ``str`` of it is what the command prints. Raises
    `UsageError` if an option is out of its range, ``out`` contains something else, or a drive is not in the store;
    `ModelError`, `DatasetError`, `MapError` or `StoreError` if an input cannot be used.
    """
    model, dataset, out, store = options.model, options.dataset, options.out, options.store
    if options.drive:
        from tcpipe.dataset import open_dataset
        from tcpipe.learning.models import load_model
        from tcpipe.planning.drives import evaluate_drives
        from tcpipe.planning.path_files import choose_map

        loaded, source = load_model(model, options.predictor), choose_map(store, options.map)
        logs = [*map(str, options.drive)]
        return evaluate_drives(loaded, open_dataset(dataset), source, logs, store=store, out=out)
    from tcpipe.learning.evaluation import EvaluateConfig
    from tcpipe.learning.evaluation_files import run_evaluation
    from tcpipe.recipe.checking import from_values

    asked = {name: getattr(options, name) for name in ("noise_draws", "seed")}
    return run_evaluation(
        model, dataset, out, config=from_values(EvaluateConfig, asked, where="evaluate"), predictor=options.predictor
    )


evaluate = as_function(EvaluateOptions, run_evaluate)


def run_predict_path(options: PredictPathOptions) -> PathResult:
    """Predict the time and energy of a path, with intervals.

    The result has length [m], time [s], energy [J], their intervals, and the path segments without a cost; ``str`` of
    it is what the command prints. Raises `PathError`, `ModelError`, `MapError`, `StoreError` or `UsageError` if an
    input cannot be used.
    """
    from tcpipe.planning.path_files import load_inputs
    from tcpipe.planning.path_files import predict_path as run

    (asked, source), known = load_inputs(options), None
    if options.adapt is not None:
        from tcpipe.planning.drives import collect_runs
        from tcpipe.store import open_store

        (known,) = collect_runs(asked, source, open_store(options.store), [str(options.adapt)])
    return run(asked, source, Path(options.path), None if options.out is None else Path(options.out), adapted_by=known)


predict_path = as_function(PredictPathOptions, run_predict_path)


def run_plan_path(options: PlanPathOptions) -> PlanResult:
    """Write the path of least energy, time or distance between two points as GeoJSON and as messages for Nav2.

    The result has the totals, and ``lonlat_deg``, the points of the path; ``str`` of it is what the command prints.
    Raises `PathError`, `ModelError`, `MapError`, `StoreError` or `UsageError` if an input cannot be used, or there is
    no path.
    """
    from tcpipe.planning.path_files import load_inputs, plan

    return plan(*load_inputs(options), options)


plan_path = as_function(PlanPathOptions, run_plan_path)
