"""The card of a dataset, ``dataset.json``: everything needed to use it, to cite it, and to check it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tcpipe import __version__
from tcpipe.cost.budget import pooled
from tcpipe.formats.dataset_files import KIND, FileFormat
from tcpipe.formats.layer_descriptions import described
from tcpipe.formats.maps.class_table import table_to_json
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.formats.recipe_toml import plain_recipe
from tcpipe.recipe import Recipe
from tcpipe.splits.assignment import SPLITS
from tcpipe.splits.audit import HeldOut
from tcpipe.tables.levels import DATA_MODEL_VERSION
from tcpipe.terrain.classes import ClassTable
from tcpipe.terrain.layers import LAYERS, Layer

VELOCITY_COLUMN = {"ground": "velocity_mps", "fused": "fused_velocity_mps"}
"""Column of samples.parquet that each choice of ``label.velocity`` trains on."""

_DESCRIBED = ("power_watt", "velocity_mps", "fused_velocity_mps", "duration_s", "energy_joule")

CARD_COLUMNS = ("run_id", "robot", "split", "fold", "terrain_name", *_DESCRIBED)
"""Columns of samples.parquet that the card is made from."""


@dataclass(frozen=True, slots=True)
class CardFacts:
    """What only the building of the dataset knows."""

    inputs: str
    """Hash of everything the dataset is made from; the same inputs make the same dataset."""
    file_format: FileFormat
    layers: Mapping[str, Layer]
    classes: ClassTable
    region: Mapping[str, Any] | None
    buffer_m: float
    audit: Sequence[HeldOut]
    kept: Mapping[str, int] | None
    runs: Sequence[Mapping[str, Any]]
    maps: Sequence[Mapping[str, Any]]
    ledger_m: Mapping[str, float]
    removal: Mapping[str, Any]
    balance: Mapping[str, Any]
    problems: Sequence[str]
    """What is wrong with the choice of runs."""
    warnings: Sequence[str]
    shards: Sequence[Mapping[str, Any]]
    checksums: Mapping[str, tuple[int, str]]


def dataset_card(samples: pa.Table, recipe: Recipe, facts: CardFacts) -> dict[str, Any]:
    """Return the card as JSON values; ``samples`` has the `CARD_COLUMNS` of every sample."""
    about, has_terrain = recipe.dataset, "terrain" in facts.layers
    return {
        "kind": KIND,
        "data_model_version": DATA_MODEL_VERSION,
        "tcpipe_version": __version__,
        "inputs": facts.inputs,
        "name": about.name,
        "description": about.description,
        "licence": about.licence,
        "creator": about.creator,
        **measured(samples, has_terrain=has_terrain),
        "recipe": plain_recipe(recipe),
        "format": facts.file_format,
        "patch_m": recipe.sample.patch_m,
        "patch_px": recipe.sample.patch_px,
        "layers": {name: described(layer) for name, layer in facts.layers.items()},
        "tensor": {
            "channels": [name for name in LAYERS if name in facts.layers],
            "ortho": "O / 255",
            "terrain": f"(C - 1) / ({facts.classes.count} - 1)",
            "height": "min((H - min H) / 1 m, 1)",
            **{name: _formula(layer) for name, layer in facts.layers.items() if name not in LAYERS},
        },
        "classes": table_to_json(facts.classes) if has_terrain else [],
        "label": {
            "columns": ["power_watt", VELOCITY_COLUMN[recipe.label.velocity]],
            "velocity": recipe.label.velocity,
        },
        "energy_budget": pooled(run["energy_budget"] for run in facts.runs),
        "split": {
            **asdict(recipe.split),
            "buffer_m": facts.buffer_m,
            "region": facts.region,
            "audit": [asdict(part) for part in facts.audit],
            "kept": facts.kept,
        },
        "ledger_m": dict(facts.ledger_m),
        "removal": dict(facts.removal),
        "balance": dict(facts.balance),
        "runs": [{**run, "samples": _count(samples, "run_id", run["run_id"])} for run in facts.runs],
        "maps": list(facts.maps),
        "problems": list(facts.problems),
        "warnings": list(facts.warnings),
        "shards": list(facts.shards),
        "checksums": {
            path: {"size_bytes": size_bytes, "sha256": sha256} for path, (size_bytes, sha256) in facts.checksums.items()
        },
    }


def _formula(layer: Layer) -> str:
    """Return what becomes of a layer that is not the paper's where it is asked for in the tensor."""
    if layer.kind == "categorical":
        return f"(C - 1) / ({layer.high:g} - 1)"
    return "O / 255" if layer.stack == "greys" else f"(X - {layer.low!r}) / ({layer.high!r} - {layer.low!r})"


def measured(samples: pa.Table, *, has_terrain: bool) -> dict[str, Any]:
    """Return what the card says of the samples by their `CARD_COLUMNS` alone: it can be measured again at any time."""
    return {
        "samples": samples.num_rows,
        "robots": sorted(pc.unique(samples.column("robot")).to_pylist()),
        "splits": split_counts(samples),
        "folds_of_train": _fold_counts(samples),
        "terrain": _terrain_counts(samples) if has_terrain else {},
        "label_statistics_of_train": _statistics(samples),
    }


def map_to_json(source: MapFile) -> dict[str, Any]:
    """Return what the card says of a map: where it lies, and what it was made from."""
    return {"name": source.name, "layers": list(source.layers), **asdict(source.grid), **source.facts}


def split_counts(samples: pa.Table) -> dict[str, int]:
    """Return the number of samples of every split, in the splits' order."""
    split = samples.column("split").to_numpy()
    return {name: int((split == name).sum()) for name in SPLITS}


def _fold_counts(samples: pa.Table) -> list[int]:
    """Return the number of train samples of every fold."""
    train = samples.filter(pc.equal(samples.column("split"), "train"))
    return [int(count) for count in np.bincount(train.column("fold").to_numpy().astype(np.int64))]


def _count(samples: pa.Table, column: str, value: str) -> int:
    return int(pc.sum(pc.equal(samples.column(column), value)).as_py() or 0)


def is_whole(directory: Path, card: Mapping[str, Any]) -> bool:
    """Return whether every file that the card lists is there with its size."""
    files = ((directory / name, entry["size_bytes"]) for name, entry in card["checksums"].items())
    return all(path.is_file() and path.stat().st_size == size_bytes for path, size_bytes in files)


def _terrain_counts(samples: pa.Table) -> dict[str, dict[str, int]]:
    """Return samples by split and terrain name."""
    groups = samples.group_by(["split", "terrain_name"]).aggregate([([], "count_all")]).to_pylist()
    counts: dict[str, dict[str, int]] = {name: {} for name in SPLITS}
    for group in groups:
        counts[group["split"]][group["terrain_name"]] = group["count_all"]
    return counts


def _statistics(samples: pa.Table) -> dict[str, dict[str, float | int | None]]:
    """Return count, mean, standard deviation, least and most of each label over train alone: what a normaliser may know."""
    train = samples.filter(pc.equal(samples.column("split"), "train"))
    found = {}
    for name in _DESCRIBED:
        values = train.column(name).to_numpy()
        some = len(values) > 0
        found[name] = {
            "count": len(values),
            "mean": float(values.mean()) if some else None,
            "std": float(values.std()) if some else None,
            "min": float(values.min()) if some else None,
            "max": float(values.max()) if some else None,
        }
    return found
