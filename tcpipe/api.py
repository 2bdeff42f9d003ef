"""The commands `train`, `evaluate`, `predict-path` and `plan-path` as functions; their options are keywords.

A function imports what it needs when it is called: a model of physics needs no plots, and a path no evaluation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, overload

if TYPE_CHECKING:
    from tcpipe.dataset.energies import EnergyName
    from tcpipe.learning.evaluation_files import EvaluationResult
    from tcpipe.learning.fitting import ModelKind
    from tcpipe.learning.losses import Loss
    from tcpipe.learning.training import TrainResult
    from tcpipe.planning.drive_files import DrivesResult
    from tcpipe.planning.path_files import PathResult
    from tcpipe.planning.plan import Objective
    from tcpipe.planning.plan_files import PlanResult


def train(
    dataset: str | Path,
    out: str | Path = "model",
    *,
    model: ModelKind | None = None,
    loss: Loss = "nrmse",
    epochs: int | None = None,
    patience: int | None = None,
    batch: int | None = None,
    learning_rate: float | None = None,
    fold: int | None = None,
    mirror: bool | None = None,
    weights: bool = False,
    width: int | None = None,
    label: EnergyName = "total",
    beside: bool = False,
    seed: int | None = None,
    fresh: bool = False,
) -> TrainResult:
    """Train a model on a dataset and write the model folder ``out``, whole or not at all.

    Parameters
    ----------
    dataset : a dataset, here or in a bucket.
    out : the model folder, or a URL in a bucket; the same dataset and options are not trained again.
    model : the kind. None: the network if one of its own options is given; else by the number of training samples.
    loss, weights, label, beside : as in `tcpipe.learning.fitting.FitConfig`, for every kind.
    epochs, patience, batch, learning_rate, fold, mirror, width, seed : of the network alone; None is the default of `FitConfig`.
    fresh : do not continue an interrupted training.

    Returns
    -------
    TrainResult : samples, epochs, held-out loss and times; ``str`` of it is what the command prints.

    Raises
    ------
    UsageError : an option is out of its range, or ``out`` holds something else.
    DatasetError, ModelError : the dataset cannot be trained on, or the interrupted training is another one.
    """
    from tcpipe.learning.fitting import FitConfig
    from tcpipe.learning.training import model_for
    from tcpipe.learning.training import train as run
    from tcpipe.recipe.checking import from_values

    network = {
        "epochs": epochs, "patience": patience, "batch": batch, "learning_rate": learning_rate, "fold": fold, "mirror": mirror,
        "width": width, "seed": seed,
    }  # fmt: skip
    options: dict[str, object] = {name: value for name, value in network.items() if value is not None}
    kind = model or ("resnet18" if options else model_for(dataset))
    options |= {"model": kind, "loss": loss, "weights": weights, "label": label, "beside": beside}
    return run(dataset, out, config=from_values(FitConfig, options, where="train"), fresh=fresh)


@overload
def evaluate(
    model: str | Path,
    dataset: str | Path,
    out: str | Path = "evaluation",
    *,
    draws: int = 5,
    baselines: bool = True,
    retrain: bool = False,
    seed: int = 0,
) -> EvaluationResult: ...
@overload
def evaluate(
    model: str | Path,
    dataset: str | Path,
    out: str | Path = "evaluation",
    *,
    drives: Sequence[str | Path],
    map_name: str | None = None,
    store: str | Path = "tcpipe-store",
) -> DrivesResult: ...
def evaluate(
    model: str | Path,
    dataset: str | Path,
    out: str | Path = "evaluation",
    *,
    draws: int = 5,
    baselines: bool = True,
    retrain: bool = False,
    seed: int = 0,
    drives: Sequence[str | Path] = (),
    map_name: str | None = None,
    store: str | Path = "tcpipe-store",
) -> EvaluationResult | DrivesResult:
    """Measure a model on a dataset's test samples and unseen area, or on whole drives, and write the evaluation to ``out``.

    Parameters
    ----------
    model, dataset : a model, and a dataset; of drives the one that the model was trained on. Here or in a bucket.
    out : a directory, or a URL in a bucket.
    draws, baselines, retrain, seed : as in `tcpipe.learning.evaluation_facts.EvaluateConfig`.
    drives : ingested logs, by path or run name, to measure the model on instead.
    map_name : the map of the drives. None: the only one in the store.
    store : where the drives and the map are.

    Returns
    -------
    EvaluationResult or, of drives, DrivesResult : ``values`` are those of the written JSON; ``str`` of it is what the command prints.

    Raises
    ------
    UsageError : an option is out of its range, ``out`` holds something else, or a drive is not in the store.
    ModelError, DatasetError, MapError, StoreError : a model, a dataset, a map or the store cannot be used.
    """
    if drives:
        from tcpipe.dataset import open_dataset
        from tcpipe.learning.models import load_model
        from tcpipe.learning.predictions import check_origin
        from tcpipe.planning.drive_files import evaluate_drives
        from tcpipe.planning.inputs import chosen_map

        loaded, data = load_model(model), open_dataset(dataset)
        check_origin(loaded.card, data, str(model))
        return evaluate_drives(loaded, data, chosen_map(store, map_name), [*map(str, drives)], store=store, out=out)
    from tcpipe.learning.evaluation_facts import EvaluateConfig
    from tcpipe.learning.evaluation_files import run_evaluation
    from tcpipe.recipe.checking import from_values

    options = {"draws": draws, "baselines": baselines, "retrain": retrain, "seed": seed}
    return run_evaluation(model, dataset, out, config=from_values(EvaluateConfig, options, where="evaluate"))


def predict_path(
    model: str | Path,
    path: str | Path,
    *,
    map_name: str | None = None,
    out: str | Path | None = None,
    physics: str | Path | None = None,
    speed_mps: float | None = None,
    store: str | Path = "tcpipe-store",
) -> PathResult:
    """Predict the time and energy of a path, with intervals.

    Parameters
    ----------
    model : a model, here or in a bucket.
    path : a GeoJSON file with one LineString (WGS 84, longitude first).
    map_name : the map. None: the only one in the store.
    out : also write the table of the path's pieces: ``.csv``, ``.parquet`` or ``.json``.
    physics : the dataset whose physics gives the energy of turns. None: that of the model.
    speed_mps : commanded speed [m/s], for a model trained with ``beside``. None: the mean of its training.
    store : where the map is.

    Returns
    -------
    PathResult : length [m], time [s], energy [J], their intervals, and the pieces without a cost; ``str`` of it is what the command
        prints.

    Raises
    ------
    PathError, ModelError, MapError, StoreError, UsageError : the path, the model, the map, the store or an option cannot be used.
    """
    from tcpipe.learning.models import chosen_model
    from tcpipe.planning.inputs import chosen_map
    from tcpipe.planning.path_files import predict_path as run

    source = chosen_map(store, map_name)
    asked = chosen_model(model, physics=physics, speed_mps=speed_mps)
    return run(asked, source, Path(path), None if out is None else Path(out))


def plan_path(
    model: str | Path,
    start: tuple[float, float],
    goal: tuple[float, float],
    *,
    objective: Objective = "energy",
    map_name: str | None = None,
    out: str | Path = "plan.geojson",
    picture: str | Path | None = None,
    cost_map: str | Path | None = None,
    step_m: float = 1.0,
    allow_unseen: bool = False,
    physics: str | Path | None = None,
    speed_mps: float | None = None,
    store: str | Path = "tcpipe-store",
    on_step: Callable[[int, int], None] | None = None,
) -> PlanResult:
    """Find the path of least energy, time or distance between two points and write it as GeoJSON.

    Parameters
    ----------
    model : a model, here or in a bucket.
    start, goal : longitude and latitude [deg], WGS 84.
    objective : what is to be least.
    map_name : the map. None: the only one in the store.
    out : the GeoJSON file.
    picture : also draw the paths of all three objectives (``.png``).
    cost_map : a cost map of this model and map. None: only what is needed is predicted.
    step_m : side of a cell [m]; that of ``cost_map`` has precedence.
    allow_unseen : also cross ground unlike any that the model was trained on.
    physics, speed_mps, store : as in `predict_path`.
    on_step : called with how many blocks of how many are done, in each round of the search.

    Returns
    -------
    PlanResult : the totals of each objective, and ``lonlat_deg``, the points of the path; ``str`` of it is what the command prints.

    Raises
    ------
    PathError, ModelError, MapError, StoreError, UsageError : an end, the model, the map, the store or an option cannot be used, or there
        is no path.
    """
    from tcpipe.formats.published import here
    from tcpipe.learning.models import chosen_model
    from tcpipe.planning.inputs import chosen_map
    from tcpipe.planning.plan_files import PlanRequest, plan
    from tcpipe.recipe.checking import from_values

    options = {
        "start_deg": start,
        "goal_deg": goal,
        "objective": objective,
        "step_m": step_m,
        "allow_unseen": allow_unseen,
    }
    request = from_values(PlanRequest, options, where="plan_path")
    if cost_map is not None:
        request = replace(request, cost_map=here(cost_map))
    source = chosen_map(store, map_name)
    return plan(
        chosen_model(model, physics=physics, speed_mps=speed_mps),
        source,
        request,
        out=Path(out),
        picture=None if picture is None else Path(picture),
        step=on_step or (lambda _, __: None),
    )
