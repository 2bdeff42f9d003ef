"""Samples on a dataset's page: each as a point, or means over small cells where there are too many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyproj import Transformer
from scipy.spatial import cKDTree

from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.json_files import Json
from tcpipe.report.column_packing import Column, make_shown_column, pack_columns
from tcpipe.report.label_sections import LABELS
from tcpipe.splits.assignment import SPLITS
from tcpipe.tables.arrays import to_texts
from tcpipe.tables.columns import read_lonlat_deg, to_floats

MOST_SAMPLES = 100_000
"""Samples that can each be clicked; more are means over cells."""

COLUMNS = (
    *("sample_id", "split", "run_id", "start_ns", "start_lon_deg", "start_lat_deg", "end_lon_deg", "end_lat_deg"),
    *("terrain_class", "terrain_name", "slope_rad", "turn_rad", "physics_power_watt", "quality"),
    *(column for *columns, _ in LABELS.values() for column in columns),
)
"""Of samples.parquet that the page needs."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class SamplesShown:
    """Rows of the page: a sample each, or a cell each.

    ``xy_m`` are middles in the first map's plane, (N, 2); ``row_of`` is where each sample of the table went, ``apart_m`` how far its
    nearest train sample lies, NaN of those that are not held out, (T,) each.
    """

    xy_m: Floats
    row_of: Ints
    apart_m: Floats
    cell_m: float | None
    json: Json


def find_nearest_train_m(xy_m: Floats, split: NDArray[np.str_]) -> tuple[Floats, Ints]:
    """Return distance [m] and row of the nearest training sample, by middles, of each held-out sample, shape (N,); NaN elsewhere."""
    apart, nearest = np.full(len(xy_m), np.nan), np.zeros(len(xy_m), np.int64)
    held, train = np.flatnonzero(np.isin(split, ("test", "unseen"))), np.flatnonzero(split == "train")
    if len(held) and len(train):
        apart[held], found = cKDTree(xy_m[train]).query(xy_m[held])
        nearest[held] = train[found]
    return apart, nearest


def select_samples(card: DatasetCard, table: pa.Table) -> SamplesShown:
    """Return the samples of the page."""
    to_map = Transformer.from_crs(card.recipe.read.gnss_crs, card.maps[0].crs, always_xy=True)
    middle_deg = 0.5 * (read_lonlat_deg(table, "start") + read_lonlat_deg(table, "end"))
    xy_m = np.column_stack(to_map.transform(*middle_deg.T)).reshape(-1, 2)
    split = to_texts(table.column("split"))
    apart_m, nearest = find_nearest_train_m(xy_m, split)
    values = _read_values(card, table, apart_m) | {"x": xy_m[:, 0], "y": xy_m[:, 1], "count": np.ones(len(xy_m))}
    cell_m, row_of = None, np.arange(table.num_rows)
    run_ids = [run.run_id for run in card.runs]
    keys = {
        "split": _find_indices(table, "split", SPLITS),
        "class": np.nan_to_num(to_floats(table, "terrain_class")).astype(np.int64),
    }
    keys |= {
        "quality": table.column("quality").to_numpy().astype(np.int64),
        "run": _find_indices(table, "run_id", run_ids),
    }
    if table.num_rows > MOST_SAMPLES:
        values, keys, row_of, cell_m = _average_in_cells(values, keys)
        xy_m = np.column_stack([values["x"], values["y"]])
    columns: dict[str, Column] = {"x": ("steps", values["x"]), "y": ("steps", values["y"])}
    columns |= {name: make_shown_column(digits, values[name]) for name, (*_, digits) in LABELS.items()}
    columns |= {name: ("half", part) for name, part in values.items() if name not in {*columns, "count"}}
    columns |= {"split": ("u8", keys["split"]), "class": ("u8", keys["class"]), "quality": ("u16", keys["quality"])}
    columns |= {"run": ("u16", keys["run"]), "count": ("u32", values["count"])}
    if cell_m is None:
        after = table.column("start_ns").to_numpy() - np.array(find_first_starts_ns(card, table), np.int64)[keys["run"]]
        columns |= {"after_s": ("u32", after // 10**9), "after_ns": ("u32", after % 10**9)}
        near = apart_m < np.sqrt(2.0) * card.patch_m
        columns["nearest"] = ("u32", np.where(near, nearest, np.arange(len(near))))
    json: dict[str, Json] = {"packed": pack_columns(columns), "cell_m": cell_m, "ids": _find_odd_ids(table)}
    return SamplesShown(xy_m, row_of, apart_m, cell_m, json)


def _read_values(card: DatasetCard, table: pa.Table, apart_m: Floats) -> dict[str, Floats]:
    values = {name: to_floats(table, column) for name, (column, *_) in LABELS.items()}
    values |= {f"{name}_std": to_floats(table, column) for name, (_, column, _) in LABELS.items()}
    values |= {name: np.degrees(to_floats(table, f"{name}_rad")) for name in ("slope", "turn")}
    if card.physics:
        values["residual"] = values["power"] - to_floats(table, "physics_power_watt")
    return values | {"apart": apart_m}


def _find_indices(table: pa.Table, column: str, names: Sequence[str]) -> Ints:
    """Return the place of each row's name among ``names``, shape (N,); 0 of an unknown one."""
    indices = pc.index_in(table.column(column).combine_chunks(), value_set=pa.array(names, pa.string()))
    return np.asarray(indices.fill_null(0).to_numpy(), np.int64)


def find_first_starts_ns(card: DatasetCard, table: pa.Table) -> list[int]:
    """Return when each run's first sample begins [ns]; 0 where it has none."""
    runs = _find_indices(table, "run_id", [run.run_id for run in card.runs])
    first, last = np.full(len(card.runs), np.iinfo(np.int64).max), np.iinfo(np.int64).max
    np.minimum.at(first, runs, table.column("start_ns").to_numpy())
    return [int(stamp) if stamp != last else 0 for stamp in first]


def _find_odd_ids(table: pa.Table) -> Sequence[str] | None:
    """Return the ids where they are not the run's and the start's, which the page puts together itself; None for too many."""
    if table.num_rows > MOST_SAMPLES:
        return None
    ids = table.column("sample_id").to_pylist()
    made = zip(table.column("run_id").to_pylist(), table.column("start_ns").to_pylist(), strict=True)
    return None if ids == [f"{run}-{start}" for run, start in made] else ids


def _average_in_cells(
    values: Mapping[str, Floats], keys: Mapping[str, Ints]
) -> tuple[dict[str, Floats], dict[str, Ints], Ints, float]:
    """Return means over square cells, one row for each split and class in a cell, each sample's row, and the cells' side [m]."""
    x, y = values["x"] - values["x"].min(), values["y"] - values["y"].min()
    cell_m = 1.0
    while True:
        place = (np.floor(x / cell_m) * 4e6 + np.floor(y / cell_m)).astype(np.int64)
        _, group = np.unique((place * 4 + keys["split"]) * 256 + keys["class"], return_inverse=True)
        if group.max(initial=0) < MOST_SAMPLES:
            break
        cell_m *= np.sqrt(2.0)
    size = int(group.max(initial=-1)) + 1
    count = np.bincount(group, minlength=size).astype(float)
    means = {}
    for name, part in values.items():
        known = np.isfinite(part)
        with np.errstate(invalid="ignore"):
            means[name] = np.bincount(group[known], part[known], size) / np.bincount(group[known], minlength=size)
    whole = {name: np.zeros(size, np.int64) for name in keys}
    for name, numbers in keys.items():
        if name == "quality":
            np.bitwise_or.at(whole[name], group, numbers)
        else:
            whole[name][group] = numbers
    return means | {"count": count}, whole, group.astype(np.int64), float(cell_m)
