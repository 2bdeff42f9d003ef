"""What was measured and predicted of every sample: ``predictions.parquet`` of an evaluation, which its page's figures are drawn from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.special import ndtri

from tcpipe.cost.prediction_errors import COVERAGE
from tcpipe.learning.metrics import QUANTITIES, UNITS, Array, Spread
from tcpipe.learning.predictions import CALLED, Measured
from tcpipe.tables.arrays import to_texts
from tcpipe.tables.columns import Column, to_floats

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

LEVELS = np.linspace(0.02, 0.98, 49)
"""Quantiles that predictions are held to."""


def make_column_name(quantity: str, part: str = "") -> str:
    """Return the name of the column that holds a part of w, v, T or E, as ``energy_predicted_low_joule``."""
    return "_".join(name for name in (CALLED[quantity], part, _SUFFIX[quantity]) if name)


def make_predictions_table(
    sets: Mapping[str, Measured], said: Mapping[str, Mapping[str, Array]], spreads: Mapping[str, Mapping[str, Spread]]
) -> pa.Table:
    """Return one row a labelled sample: what was measured, what a model said, and how sure it was; null where it did not say."""
    fields = [of.field() for of in _KEYS]
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
            "slope_rad": found.split.column("slope_rad").astype(np.float64),
        }
        values = {
            make_column_name(q, part): of
            for q in QUANTITIES
            for part, of in zip(_PARTS, _iterate_parts(found, said[name], spreads[name], q), strict=True)
        }
        arrays = [pa.array((keys | values)[of.name], of.type, from_pandas=True) for of in schema]
        parts.append(pa.Table.from_arrays(arrays, schema=schema))
    return pa.concat_tables(parts)


def _iterate_parts(
    found: Measured, said: Mapping[str, Array], spreads: Mapping[str, Spread], quantity: str
) -> Iterator[Array | None]:
    nothing = np.full(len(found.split), np.nan)
    yield from (found.costs[quantity], found.deviations[quantity], said.get(quantity, nothing))
    spread = spreads.get(quantity, Spread(nothing, nothing, nothing))
    yield from (spread.std, spread.low, spread.high)


def compute_errors_joule(table: pa.Table) -> Array:
    """Return predicted less measured E, shape (N,)."""
    return to_floats(table, make_column_name("E", "predicted")) - to_floats(table, make_column_name("E"))


def find_worst_rows(table: pa.Table, count: int) -> NDArray[np.int64]:
    """Return the rows of the ``count`` samples of each split whose E is furthest off, the furthest first, split by split."""
    off, split = np.abs(compute_errors_joule(table)), to_texts(table.column("split"))
    found = [np.empty(0, np.int64)]
    for name in dict.fromkeys(split.tolist()):
        rows = np.flatnonzero((split == name) & np.isfinite(off))
        found.append(rows[np.argsort(-off[rows], kind="stable")][:count])
    return np.concatenate(found)


def compute_calibration(table: pa.Table, quantity: str) -> Array | None:
    """Return what share of labels lies below each of `LEVELS` as a model states it, its errors taken as normal; None if it states none."""
    label, said, std = (
        to_floats(table, make_column_name(quantity, part)) for part in ("", "predicted", "predicted_std")
    )
    known = np.isfinite(label + said + std)
    if not known.any():
        return None
    below = label[known, None] <= said[known, None] + std[known, None] * ndtri(LEVELS)
    return np.asarray(below.mean(axis=0))
