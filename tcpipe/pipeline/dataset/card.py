"""The card of a dataset, ``dataset.json``: everything needed to use it, to cite it, and to check it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TypedDict

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tcpipe import __version__
from tcpipe.cost.budget import pooled
from tcpipe.formats.dataset_card import (
    Balance,
    DatasetCard,
    Doubtful,
    LabelColumns,
    LabelStatistics,
    MapRegistration,
    MapSource,
    Shard,
    SplitResult,
    judge_dataset,
)
from tcpipe.formats.dataset_files import FileFormat
from tcpipe.formats.json_files import recast
from tcpipe.formats.layer_descriptions import described
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.pipeline.dataset.content import Content
from tcpipe.pipeline.dataset.findings import count_flagged, find_in_samples
from tcpipe.pipeline.dataset.inputs import Inputs
from tcpipe.pipeline.dataset.physics import physics_by_robot
from tcpipe.pipeline.dataset.splitting import regions_to_json
from tcpipe.recipe import Recipe
from tcpipe.splits.assignment import SPLITS
from tcpipe.splits.regions import Regions
from tcpipe.tables.levels import DATA_MODEL_VERSION
from tcpipe.terrain.layers import LAYERS, Layer

VELOCITY_COLUMN = {"ground": "velocity_mps", "fused": "fused_velocity_mps"}
"""Column of samples.parquet that each choice of ``label.velocity`` trains on."""

_DESCRIBED = ("power_watt", "velocity_mps", "fused_velocity_mps", "duration_s", "energy_joule")

CARD_COLUMNS = ("run_id", "robot", "split", "fold", "terrain_name", "quality", *_DESCRIBED)
"""Columns of samples.parquet that the card is made from."""


class SampleFigures(TypedDict):
    """What the card says of the samples by their `CARD_COLUMNS` alone."""

    samples: int
    robots: tuple[str, ...]
    splits: dict[str, int]
    folds_of_train: tuple[int, ...]
    terrain: dict[str, dict[str, int]]
    label_statistics_of_train: dict[str, LabelStatistics]
    doubtful: Doubtful


def dataset_card(
    samples: pa.Table,
    recipe: Recipe,
    inputs: Inputs,
    content: Content,
    *,
    file_format: FileFormat,
    regions: Regions | None,
    balance: Balance,
    shards: Sequence[Shard],
    tags: Mapping[str, str],
) -> DatasetCard:
    """Return the card without checksums; ``samples`` has the `CARD_COLUMNS` of every sample, and `physics.PHYSICS_COLUMNS`."""
    about, drawn, classes = recipe.dataset, content.drawn, content.sources[0].classes
    layers, has_terrain = content.spool.layers, "terrain" in content.spool.layers
    runs = tuple(replace(run, samples=_count(samples, "run_id", run.run_id)) for run in inputs.sources)
    card = DatasetCard(
        data_model_version=DATA_MODEL_VERSION,
        tcpipe_version=__version__,
        inputs=inputs.digest,
        name=about.name,
        description=about.description,
        licence=about.licence,
        creator=about.creator,
        **measured(samples, has_terrain=has_terrain),
        recipe=recipe,
        format=file_format,
        patch_m=recipe.sample.patch_m,
        patch_px=recipe.sample.patch_px,
        layers={name: described(layer) for name, layer in layers.items()},
        tensor={
            "channels": tuple(name for name in LAYERS if name in layers),
            "ortho": "O / 255",
            "terrain": f"(C - 1) / ({classes.count} - 1)",
            "height": "min((H - min H) / 1 m, 1)",
            **{name: _formula(layer) for name, layer in layers.items() if name not in LAYERS},
        },
        classes=classes.classes if has_terrain else (),
        label=_label(recipe, inputs),
        energy_budget=pooled(run.energy_budget for run in inputs.sources),
        split=SplitResult(
            drawn.buffer_m, None if regions is None else regions_to_json(regions), drawn.audit, drawn.kept
        ),
        ledger_m=content.ledger_m,
        removal=content.removal,
        balance=balance,
        runs=runs,
        run_tags=tags,
        maps=tuple(map(_map_source, content.sources, inputs.map_sha256, content.registrations)),
        physics=physics_by_robot(samples),
        covariates=content.covariates,
        added_columns={field.name: field.metadata[b"doc"].decode() for field in content.samples.added.schema},
        shards=tuple(shards),
        checksums={},
    )
    findings = tuple(dict.fromkeys((*content.findings, *find_in_samples(card))))
    return replace(card, findings=findings, verdict=judge_dataset(findings, card.runs, card.maps))


def _label(recipe: Recipe, inputs: Inputs) -> LabelColumns:
    told = (run.manifest.info.report.facts.power for run in inputs.runs)
    includes = tuple(sorted({what for power in told if power is not None for what in power.includes}))
    velocity = recipe.label.velocity
    return LabelColumns(("power_watt", VELOCITY_COLUMN[velocity]), velocity, includes)


def _formula(layer: Layer) -> str:
    """Return what becomes of a layer that is not the paper's where it is asked for in the tensor."""
    if layer.kind == "categorical":
        return f"(C - 1) / ({layer.high:g} - 1)"
    return "O / 255" if layer.stack == "greys" else f"(X - {layer.low!r}) / ({layer.high!r} - {layer.low!r})"


def _map_source(source: MapFile, sha256: str, registration: tuple[MapRegistration, ...]) -> MapSource:
    told = {"name": source.name, "layers": tuple(source.layers), "sha256": sha256, "registration": registration}
    return recast(source.facts, MapSource, **told, **asdict(source.grid))


def measured(samples: pa.Table, *, has_terrain: bool) -> SampleFigures:
    """Return what the card says of the samples by their `CARD_COLUMNS` alone: it can be measured again at any time."""
    return {
        "samples": samples.num_rows,
        "robots": tuple(sorted(pc.unique(samples.column("robot")).to_pylist())),
        "splits": split_counts(samples),
        "folds_of_train": _fold_counts(samples),
        "terrain": _terrain_counts(samples) if has_terrain else {},
        "label_statistics_of_train": _statistics(samples),
        "doubtful": count_flagged(samples.column("quality")),
    }


def split_counts(samples: pa.Table) -> dict[str, int]:
    """Return the number of samples of every split, in the splits' order."""
    split = samples.column("split").to_numpy()
    return {name: int((split == name).sum()) for name in SPLITS}


def _fold_counts(samples: pa.Table) -> tuple[int, ...]:
    """Return the number of train samples of every fold."""
    train = samples.filter(pc.equal(samples.column("split"), "train"))
    return tuple(np.bincount(train.column("fold").to_numpy().astype(np.int64)).tolist())


def _count(samples: pa.Table, column: str, value: str) -> int:
    return int(pc.sum(pc.equal(samples.column(column), value)).as_py() or 0)


def is_whole(directory: Path, card: DatasetCard) -> bool:
    """Return whether every file that the card lists is there with its size."""
    files = ((directory / name, entry.size_bytes) for name, entry in card.checksums.items())
    return all(path.is_file() and path.stat().st_size == size_bytes for path, size_bytes in files)


def _terrain_counts(samples: pa.Table) -> dict[str, dict[str, int]]:
    """Return samples by split and terrain name."""
    groups = samples.group_by(["split", "terrain_name"]).aggregate([([], "count_all")]).to_pylist()
    counts: dict[str, dict[str, int]] = {name: {} for name in SPLITS}
    for group in groups:
        counts[group["split"]][group["terrain_name"]] = group["count_all"]
    return counts


def _statistics(samples: pa.Table) -> dict[str, LabelStatistics]:
    """Return count, mean, standard deviation, least and most of each label over train alone."""
    train = samples.filter(pc.equal(samples.column("split"), "train"))
    found = {}
    for name in _DESCRIBED:
        values = train.column(name).to_numpy()
        figures = (
            [float(of()) for of in (values.mean, values.std, values.min, values.max)] if len(values) else [None] * 4
        )
        found[name] = LabelStatistics(len(values), *figures)
    return found
