"""Predictions of a model for a split, also with layers replaced by noise, and their table ``predictions.parquet``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Floats, Ints
from tcpipe.cost.prediction_errors import COVERAGE, Residuals, fit_bias_correction, propagate_stated
from tcpipe.dataset import Dataset, Split
from tcpipe.dataset.extra_features import read_extra_features
from tcpipe.errors import ModelError
from tcpipe.learning.metrics import LEAST_VELOCITY_MPS, QUANTITIES, UNITS, Spread, compute_costs
from tcpipe.learning.model_card import ModelCard
from tcpipe.learning.models import Model
from tcpipe.learning.predictor import Prediction
from tcpipe.learning.training import read_class_table
from tcpipe.splits.audit import PLACES, compute_middles
from tcpipe.tables.columns import Column, to_floats, to_texts
from tcpipe.terrain.layers import ClassTable

CALLED = {"w": "power", "v": "velocity", "T": "duration", "E": "energy"}
"""Names of the quantities in columns of tables."""

_UNKNOWN = (0, "unknown")


@dataclass(frozen=True, slots=True)
class Measured:
    """The labelled samples of a split: w, v, T, E, their deviations, and terrain classes."""

    split: Split
    costs: Mapping[str, Floats]
    deviations: Mapping[str, Floats]
    own_deviations: Mapping[str, Floats]
    """Standard deviations without the error that all labels of a run share, which a model learns."""
    class_ids: Ints
    names: Mapping[int, str]
    """Names of the classes that occur, by id."""


def collect_measured(split: Split, names: Mapping[int, str]) -> Measured:
    """Return the measured labels, with the names of classes by id; samples without a label are left out."""
    energy, *power_column, velocity_column = split.energy, *split.label_columns
    columns = {"v": (velocity_column, "velocity_std_mps"), "T": ("duration_s", "duration_std_s")}
    if power_column:
        columns = {"w": (energy.power, energy.power_std), **columns, "E": (energy.energy, energy.energy_std)}
    has_costs = [np.isfinite(split.column(name).astype(float)) for name, _ in columns.values()]
    chosen = split.take(np.isfinite(split.labels).all(axis=1) & np.all(has_costs, axis=0))
    deviations = {cost: chosen.column(std).astype(float) for cost, (_, std) in columns.items()}
    own_deviations = {cost: chosen.own_std(std) for cost, (_, std) in columns.items()}
    labels = dict(zip(split.label_columns, chosen.labels.T.astype(float), strict=True))
    class_ids = np.nan_to_num(chosen.column("terrain_class").astype(float), nan=_UNKNOWN[0]).astype(np.int64)
    known = dict([_UNKNOWN, *names.items()])
    return Measured(
        chosen,
        {cost: labels.get(name, chosen.column(name).astype(float)) for cost, (name, _) in columns.items()},
        deviations,
        own_deviations,
        class_ids,
        {class_id: known.get(class_id, str(class_id)) for class_id in np.unique(class_ids).tolist()},
    )


@dataclass(frozen=True, slots=True)
class Predicted:
    """Costs of a split's samples by one predictor, centred by class: quantity to values of shape (N,)."""

    costs: Mapping[str, Floats]
    stated: Mapping[str, Floats]
    """Standard deviations by the predictor; 0 if it states none."""

    @classmethod
    def centre(cls, residuals: Residuals, prediction: Prediction, class_ids: Ints, chord_m: float) -> Predicted:
        """Return costs of predictions of power and velocity, by the predictor's own held-out samples."""
        names = ("v", "T") if "velocity_mps" in residuals and "power_watt" not in residuals else QUANTITIES
        power, velocity = prediction.mean[:, 0], np.maximum(prediction.mean[:, 1], LEAST_VELOCITY_MPS)
        centred_power, centred_velocity = fit_bias_correction(residuals).apply(power, velocity, class_ids)
        costs = compute_costs(centred_power, np.maximum(centred_velocity, LEAST_VELOCITY_MPS), chord_m)
        of_metre = propagate_stated(np.column_stack([power, velocity]), prediction.covariance)
        stated = {name: of_metre[CALLED[name]] * (chord_m if name in "TE" else 1.0) for name in names}
        return cls({name: costs[name] for name in names}, stated)


def predict_costs(model: Model, split: Split, *, noise: Sequence[str] = (), seed: Sequence[int] = (0,)) -> Predicted:
    """Return the predicted w, v, T, E of every sample; v and T of a model of time alone.

    It is centred by class, or in total for a model without classes. Channels in ``noise`` are replaced by noise of this
    seed, uniform in [0, 1], independent by pixel (section V-C).
    """
    rng, layout = np.random.default_rng(list(seed)), model.card.layout
    replaced = [place for place, plane in enumerate(layout.planes) if plane.partition("[")[0] in noise]
    chosen, features = split.with_layout(layout), read_extra_features(split)
    parts = [Prediction.without_covariance(np.empty((0, 2)))]
    for first in range(0, len(chosen), layout.batch_rows):
        rows = np.arange(first, min(first + layout.batch_rows, len(chosen)))
        patches = chosen.batch(rows)[0].copy()
        for channel in replaced:
            patches[..., channel] = rng.random(patches.shape[:3], np.float32)
        parts.append(model.ask(patches, features.take(rows)))
    is_class_shown = "terrain" in model.card.inputs.channels and "terrain" not in noise
    class_ids = features.class_id if is_class_shown else np.zeros(len(split), np.int64)
    return Predicted.centre(model.residuals, Prediction.concatenate(parts), class_ids, model.card.chord_m)


def predict_spreads(model: Model, predicted: Predicted, found: Measured) -> dict[str, Spread]:
    """Return the error models of a model's costs, by quantity; none if it has too few held-out samples."""
    if model.errors is None:
        return {}
    is_near = None
    if found.split.has_coordinates:
        is_near = model.find_near(compute_middles([found.split.column(name) for name in PLACES]))
    spreads = {}
    for quantity, costs in predicted.costs.items():
        errors, d = model.errors[CALLED[quantity]], model.card.chord_m if quantity in "TE" else 1.0
        ground = costs / d, found.class_ids, predicted.stated[quantity] / d, is_near  # errors are of a metre
        low, high = errors.compute_intervals(*ground)
        spreads[quantity] = Spread(d * errors.compute_std(*ground), d * low, d * high)
    return spreads


def check_fit(card: ModelCard, data: Dataset, name: str) -> None:
    """Raise an error with every reason for which a model cannot be asked about a dataset."""
    dataset_card = data.card
    problems = [
        f"classes: in the model {clause}"
        for clause in ClassTable(card.classes).differences(read_class_table(dataset_card))
    ]
    same = (
        ("patch_px", card.inputs.patch_px, dataset_card.patch_px),
        ("patch_m", card.inputs.patch_m, dataset_card.patch_m),
        ("segment.chord_m", card.chord_m, dataset_card.recipe.segment.chord_m),
        ("label.velocity", card.label_velocity, dataset_card.label.velocity),
        ("robot", card.robot, ", ".join(dataset_card.robots)),
    )
    problems += [
        f"{key} is {mine!r} in the model, {theirs!r} in the dataset" for key, mine, theirs in same if mine != theirs
    ]
    expected = dataset_card.label.columns if data["train"].has_energy else dataset_card.label.columns[1:]
    if len(card.inputs.outputs) != len(expected) or card.inputs.is_time_alone != (len(expected) == 1):
        problems.append(f"it predicts only {', '.join(card.inputs.outputs)}, expected {' and '.join(expected)}")
    absent = [name for name in card.layout.layers if name not in dataset_card.layers]
    problems += [f"the dataset has no layer {', '.join(absent)}, which the model takes"] if absent else []
    if problems:
        raise ModelError(*(f"{name} does not fit {data.path}: {problem}" for problem in problems))


_SUFFIX = {"w": "watt", "v": "mps", "T": "s", "E": "joule"}
_PARTS = {
    "": "measured",
    "std": "standard deviation of what was measured",
    "predicted": "predicted, centred",
    "predicted_std": "stated standard deviation of the prediction's error",
    "predicted_low": f"beginning of the prediction's {COVERAGE:.0%} interval",
    "predicted_high": f"end of the prediction's {COVERAGE:.0%} interval",
}

_KEYS = (
    Column("sample_id", pa.string(), "", "of samples.parquet"),
    Column("split", pa.string(), "", "test or unseen"),
    Column("terrain_class", pa.uint8(), "", "terrain class; 0 where it is not known"),
    Column("terrain_name", pa.string(), "", "its name"),
    Column("slope_rad", pa.float64(), "rad", "slope along travel, uphill positive", nullable=True),
)


def make_column_name(quantity: str, part: str = "") -> str:
    """Return the column name of a predicted value of w, v, T or E, such as ``energy_predicted_low_joule``."""
    return "_".join(name for name in (CALLED[quantity], part, _SUFFIX[quantity]) if name)


def make_predictions_table(
    sets: Mapping[str, Measured], said: Mapping[str, Mapping[str, Floats]], spreads: Mapping[str, Mapping[str, Spread]]
) -> pa.Table:
    """Return one row a labelled sample: label, prediction and stated errors; null without a prediction."""
    fields = [column.field() for column in _KEYS]
    fields += [
        Column(make_column_name(q, part), pa.float64(), UNITS[q], doc, nullable=True).field()
        for q in QUANTITIES
        for part, doc in _PARTS.items()
    ]
    schema = pa.schema(fields)
    parts = [schema.empty_table()]
    for name, found in sets.items():
        keys = {
            "sample_id": found.split.column("sample_id").tolist(),
            "split": [name] * len(found.split),
            "terrain_class": found.class_ids.astype(np.uint8),
            "terrain_name": [found.names[number] for number in found.class_ids.tolist()],
            "slope_rad": found.split.column("slope_rad").astype(float),
        }
        values = {
            make_column_name(q, part): columns
            for q in found.costs
            for part, columns in zip(_PARTS, _iterate_parts(found, said[name], spreads[name], q), strict=True)
        }
        nothing = pa.nulls(len(found.split))
        arrays = [pa.array((keys | values).get(field.name, nothing), field.type, from_pandas=True) for field in schema]
        parts.append(pa.Table.from_arrays(arrays, schema=schema))
    return pa.concat_tables(parts)


def _iterate_parts(
    found: Measured, said: Mapping[str, Floats], spreads: Mapping[str, Spread], quantity: str
) -> Iterator[Floats | None]:
    nothing = np.full(len(found.split), np.nan)
    yield from (found.costs[quantity], found.deviations[quantity], said.get(quantity, nothing))
    spread = spreads.get(quantity, Spread(nothing, nothing, nothing))
    yield from (spread.std, spread.low, spread.high)


def find_main_cost(table: pa.Table) -> Literal["E", "T"]:
    """Return the cost that a page is about: E, or T if no energy was predicted."""
    return "E" if np.isfinite(to_floats(table, make_column_name("E", "predicted"))).any() else "T"


def compute_cost_errors(table: pa.Table, quantity: str) -> Floats:
    """Return predicted less measured values of a quantity, shape (N,)."""
    return to_floats(table, make_column_name(quantity, "predicted")) - to_floats(table, make_column_name(quantity))


def find_worst_rows(table: pa.Table, count: int) -> Ints:
    """Return the ``count`` rows of each split with the largest errors of the main cost, largest first, by split."""
    off, split = np.abs(compute_cost_errors(table, find_main_cost(table))), to_texts(table.column("split"))
    found = [np.empty(0, np.int64)]
    for name in dict.fromkeys(split.tolist()):
        rows = np.flatnonzero((split == name) & np.isfinite(off))
        found.append(rows[np.argsort(-off[rows], kind="stable")][:count])
    return np.concatenate(found)
