"""The card of a dataset (``dataset.json``), and findings on its samples."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tcpipe import __version__
from tcpipe.arrays import Floats
from tcpipe.cost.labels import pool_budgets
from tcpipe.cost.physics import fit_and_validate_physics
from tcpipe.cost.repeatability import compute_slope_residuals, estimate_repeatability, find_repeated_pairs
from tcpipe.formats.dataset_card import (
    DatasetCard,
    FlaggedSamples,
    LabelColumns,
    LabelStatistics,
    MapRegistration,
    MapSource,
    Shard,
    judge_dataset,
)
from tcpipe.formats.json_files import convert_record
from tcpipe.formats.maps.map_facts import describe_layer
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.pipeline.dataset.content import Content
from tcpipe.pipeline.dataset.inputs import ChosenInputs
from tcpipe.pipeline.dataset.options import BuildOptions
from tcpipe.power.witnesses import compare_batteries
from tcpipe.recipe.suggestions import suggest
from tcpipe.splits.assignment import SPLITS
from tcpipe.stages.label import make_fit_samples
from tcpipe.tables.bits import Quality, flag_name
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.facts import Floor, HeldOut, PhysicsFit
from tcpipe.tables.findings import Finding, Remedy, Severity, Subject, Verdict, make_finding, read_threshold
from tcpipe.tables.levels import DATA_MODEL_VERSION, LABELS
from tcpipe.terrain.layers import LAYERS, PAPER_CLASSES, ClassTable, Layer, Layers

VELOCITY_COLUMN = {"ground": "velocity_mps", "fused": "fused_velocity_mps"}
"""Column of samples.parquet that each choice of ``label.velocity`` trains on."""

_DESCRIBED = (
    *("power_watt", "velocity_mps", "fused_velocity_mps", "duration_s", "energy_joule", "slip_fraction"),
    "vibration_mps2",
)

CARD_COLUMNS = ("run_id", "robot", "split", "fold", "terrain_name", "quality", *_DESCRIBED)
"""Columns of samples.parquet that the card is made from."""


def measure_repeatability(
    samples: pa.Table, xy_m: Floats, *, velocity_column: str, chord_m: float
) -> dict[str, Floor | None]:
    """Return the repeatability of each label; ``samples``: `REPEATABILITY_COLUMNS`, ``xy_m``: centres [m], (N, 2)."""
    slope_rad = np.nan_to_num(to_floats(samples, "slope_rad"))  # unknown without patches
    terrain = samples.column("terrain_class").fill_null(0).to_numpy()
    repeated = find_repeated_pairs(xy_m, to_floats(samples, "course_rad"), terrain, chord_m=chord_m)
    found = dict[str, Floor | None]()
    for name in ("power_watt", velocity_column, "duration_s", "energy_joule"):  # one after another: each takes memory
        values = to_floats(samples, name)
        if not np.isfinite(values).all():
            found[name] = None
            continue
        residual = compute_slope_residuals(values, terrain, slope_rad)
        found[name] = estimate_repeatability(values, residual, repeated, xy_m, chord_m=chord_m)
    return found


REPEATABILITY_COLUMNS = (
    *("course_rad", "terrain_class", "slope_rad", "power_watt", "velocity_mps", "fused_velocity_mps", "duration_s"),
    "energy_joule",
)


def make_dataset_card(
    samples: pa.Table,
    options: BuildOptions,
    inputs: ChosenInputs,
    content: Content,
    *,
    repeatability: Mapping[str, Floor | None],
    shards: Sequence[Shard],
) -> DatasetCard:
    """Return the card without checksums; ``samples`` has `CARD_COLUMNS` and `PHYSICS_COLUMNS`."""
    recipe, about = options.recipe, options.recipe.dataset
    classes = content.sources[0].classes if content.sources else PAPER_CLASSES
    layers, has_terrain = content.spool.layers, "terrain" in content.spool.layers
    runs = tuple(replace(run, samples=_count(samples, "run_id", run.run_id)) for run in inputs.sources)
    folds = samples.column("fold").filter(pc.equal(samples.column("split"), "train"))
    powers = (run.manifest.info.report.facts.power for run in inputs.runs)
    includes = tuple(sorted({load for power in powers if power is not None for load in power.includes}))
    card = DatasetCard(
        data_model_version=DATA_MODEL_VERSION,
        tcpipe_version=__version__,
        inputs=inputs.digest,
        made_from=inputs.made_from,
        name=about.name,
        description=about.description,
        licence=about.licence,
        creator=about.creator,
        samples=samples.num_rows,
        robots=tuple(sorted(pc.unique(samples.column("robot")).to_pylist())),
        splits={name: _count(samples, "split", name) for name in SPLITS},
        folds_of_train=tuple(np.bincount(folds.to_numpy().astype(np.int64)).tolist()),
        terrain=_count_terrain(samples) if has_terrain else {},
        label_statistics_of_train=_compute_statistics(samples),
        flagged_samples=count_flagged(samples.column("quality")),
        patch_m=recipe.sample.patch_m,
        patch_px=recipe.sample.patch_px,
        layers={name: describe_layer(layer) for name, layer in layers.items()},
        tensor=_describe_tensor(layers, classes) if layers else {},
        classes=classes.classes if has_terrain else (),
        label=LabelColumns(("power_watt", VELOCITY_COLUMN[recipe.label.velocity]), recipe.label.velocity, includes),
        labels={name: int(np.isfinite(to_floats(samples, column)).sum()) for name, column in LABELS.items()},
        plane="" if content.sources else content.plane,
        energy_budget=pool_budgets(run.energy_budget for run in inputs.sources),
        split=content.split,
        distance_by_reason_m=content.distance_by_reason_m,
        repeatability=repeatability,
        runs=runs,
        maps=tuple(map(_map_source, content.sources, inputs.made_from.maps.values(), content.registrations)),
        physics=fit_physics_by_robot(samples.filter(pc.equal(samples.column("split"), "train"))),
        covariates=content.covariates,
        added_columns={field.name: field.metadata[b"doc"].decode() for field in content.samples.added.schema},
        shards=tuple(shards),
        checksums={},
        verdict=Verdict(),
    )
    findings = tuple(dict.fromkeys((*content.findings, *find_in_samples(card))))
    return replace(card, findings=findings, verdict=judge_dataset(findings, card.runs, card.maps))


def _describe_tensor(layers: Layers, classes: ClassTable) -> dict[str, str | tuple[str, ...]]:
    """Return the channels of the tensor, and the formula of each layer."""
    return {
        "channels": tuple(name for name in LAYERS if name in layers),
        "ortho": "O / 255",
        "terrain": f"(C - 1) / ({classes.count} - 1)",
        "height": "min((H - min H) / 1 m, 1)",
        **{name: _describe_formula(layer) for name, layer in layers.items() if name not in LAYERS},
    }


def _describe_formula(layer: Layer) -> str:
    """Return the formula of a layer other than the paper's in the tensor."""
    if layer.kind == "categorical":
        return f"(C - 1) / ({layer.high:g} - 1)"
    return "O / 255" if layer.stack == "greys" else f"(X - {layer.low!r}) / ({layer.high!r} - {layer.low!r})"


def _map_source(source: MapFile, sha256: str, registration: tuple[MapRegistration, ...]) -> MapSource:
    named = {"name": source.name, "layers": tuple(source.layers), "sha256": sha256, "registration": registration}
    return convert_record(source.facts, MapSource, **named, **asdict(source.grid))


def _count(samples: pa.Table, column: str, value: str) -> int:
    return int(pc.sum(pc.equal(samples.column(column), value)).as_py() or 0)


def _count_terrain(samples: pa.Table) -> dict[str, dict[str, int]]:
    """Return samples by split and terrain name."""
    groups = samples.group_by(["split", "terrain_name"]).aggregate([([], "count_all")]).to_pylist()
    counts: dict[str, dict[str, int]] = {name: {} for name in SPLITS}
    for group in groups:
        counts[group["split"]][group["terrain_name"]] = group["count_all"]
    return counts


def _compute_statistics(samples: pa.Table) -> dict[str, LabelStatistics]:
    """Return count, mean, standard deviation, least and most of each label over train alone."""
    train = pc.equal(samples.column("split"), "train")
    found = {}
    for name in _DESCRIBED:
        values = to_floats(samples.filter(train), name)
        values = values[np.isfinite(values)]
        figures = (
            [float(compute()) for compute in (values.mean, values.std, values.min, values.max)]
            if len(values)
            else [None] * 4
        )
        found[name] = LabelStatistics(len(values), *figures)
    return found


PHYSICS_COLUMNS = ("start_ns", "start_z_m", "end_z_m", "chord_m", "mean_abs_yaw_rate_radps", "idle_power_watt")
"""Columns of samples.parquet that the fit reads, beside those of the labels."""

_FITTED = (*PHYSICS_COLUMNS, "power_watt", "velocity_mps", "terrain_name")
_MOST_FITTED = 200_000
"""Most segments of a robot that are fitted, evenly taken of more: they determine the power to a per mille."""


def fit_physics_by_robot(samples: pa.Table) -> dict[str, PhysicsFit]:
    """Return the fit of each robot's samples, in the order of driving, for robots that can be fitted."""
    found, start_ns = {}, to_integers(samples, "start_ns")
    for robot in sorted(pc.unique(samples.column("robot")).to_pylist()):
        rows = np.flatnonzero(pc.equal(samples.column("robot"), robot).to_numpy())
        rows = rows[np.argsort(start_ns[rows], kind="stable")]
        robot_samples = samples.select(_FITTED).take(rows[:: -(-rows.size // _MOST_FITTED)])
        fit = fit_and_validate_physics(
            make_fit_samples(robot_samples), idle_watt=compute_mean_idle_power(robot_samples)
        )
        if fit is not None:
            found[robot] = fit
    return found


def compute_mean_idle_power(samples: pa.Table) -> float | None:
    """Return the idle power [W], the mean over the samples; None if no run was stationary."""
    watt = to_floats(samples, "idle_power_watt")
    return float(np.nanmean(watt)) if np.isfinite(watt).any() else None


def count_flagged(quality: pa.ChunkedArray) -> FlaggedSamples:
    """Return the number of samples with a quality bit that some samples lack, and the number of samples by bit."""
    bits = quality.to_numpy().astype(np.int64)
    counts = {flag_name(bit): int(np.count_nonzero(bits & int(bit))) for bit in Quality}
    common = int(np.bitwise_and.reduce(bits)) if len(bits) > 1 else 0
    count = int(np.count_nonzero(bits & ~common))
    return FlaggedSamples(count, count / max(len(bits), 1), {name: count for name, count in counts.items() if count})


def find_in_samples(card: DatasetCard) -> Iterator[Finding]:
    """Yield findings on samples: too few, flagged ones, empty splits, leakage, no repetitions."""
    dataset = Subject("dataset", card.name)
    if card.absent_labels:
        yield make_finding("labels-absent", dataset, names={"labels": ", ".join(card.absent_labels)})
    if card.samples < read_threshold("few-samples", "min_sample_count"):
        yield make_finding("few-samples", dataset, sample_count=card.samples)
    yield from _find_flagged(card, dataset)
    yield from _find_empty_splits(card)
    yield from (_find_leakage(part, card) for part in card.split.audit if part.overlapping_samples)
    yield from compare_batteries((run.run_id, run.robot, run.findings) for run in card.runs if run.samples)
    if not any(card.repeatability.values()):
        yield make_finding("no-repeated-places", dataset)


def _find_flagged(card: DatasetCard, dataset: Subject) -> Iterator[Finding]:
    flagged = card.flagged_samples
    if not flagged.samples:
        return
    by_bit = {name: count for name, count in flagged.by_bit.items() if count < card.samples} or flagged.by_bit
    most = max(by_bit, key=lambda name: by_bit[name])
    severity: Severity = (
        "warning" if flagged.share > read_threshold("samples-flagged", "max_flagged_fraction") else "note"
    )
    yield make_finding(
        "samples-flagged", dataset, severity=severity, names={"flag": most}, flagged_fraction=flagged.share
    )


def _find_empty_splits(card: DatasetCard) -> Iterator[Finding]:
    """Yield a finding for each requested split without samples."""
    rules = card.recipe.split
    if not card.splits["train"]:
        yield make_finding(
            "split-empty", Subject("split", "train"), severity="error", names={"reason": "region_too_small"}
        )
    if not card.splits["test"] and rules.test_fraction > 0:
        reasons = {"run": "one_run", "block": "one_block", "tag": "one_value_of_tag"}
        remedies = (
            *(suggest("sample", {"split": {"holdout": "sample"}}) if card.splits["train"] > 1 else ()),
            *suggest("none", {"split": {"test_fraction": 0.0}}),
        )
        names = {"reason": reasons.get(rules.holdout, "too_few_samples")}
        yield make_finding("split-empty", Subject("split", "test"), names=names, remedies=remedies)
    if not card.splits["unseen"] and card.split.region is not None:
        yield make_finding("split-empty", Subject("split", "unseen"), names={"reason": "all_inside_region"})


def _find_leakage(part: HeldOut, card: DatasetCard) -> Finding:
    """Return the finding that samples of a held-out split share ground with train."""
    remedies: tuple[Remedy, ...] = ()
    holdout = card.recipe.split.holdout if part.split == "test" else ""
    if holdout == "sample":
        remedies = suggest("block", {"split": {"holdout": "block"}})
    elif holdout == "block":
        remedies = (
            *suggest("larger_blocks", {"split": {"block_m": 2 * card.recipe.split.block_m}}),
            *suggest("run", {"split": {"holdout": "run"}}),
        )
    return make_finding(
        "split-leakage",
        Subject("split", part.split),
        remedies=remedies,
        overlapping_count=part.overlapping_samples,
        sample_count=part.samples,
    )
