"""``tcpipe train``: from a dataset to a model folder."""

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Floats, Ints
from tcpipe.cost.prediction_errors import FEWEST, NEAR, make_residuals
from tcpipe.dataset import Dataset, Split, open_dataset
from tcpipe.dataset.energies import name_common_std
from tcpipe.dataset.extra_features import ExtraFeature, available_features, read_extra_features
from tcpipe.dataset.tensor import ONE_HOT
from tcpipe.errors import DatasetError, ModelError, StoreError, UsageError
from tcpipe.formats.atomic import Location, clear_beside
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.json_files import convert_record, digest, read_json
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.published_outputs import find_newest
from tcpipe.learning.fitting import FitConfig, ModelKind, TrainingTimes
from tcpipe.learning.metrics import LEAST_VELOCITY_MPS, compute_costs
from tcpipe.learning.model_card import KIND, LayerRange, ModelCard, TrainedOn, Training, TrainingRange
from tcpipe.learning.models import CARD, FILES, GROUND_COLUMNS, load_model, write_model
from tcpipe.learning.own_models import load_own_kind, report_errors
from tcpipe.learning.physics_model import compute_idle_power
from tcpipe.learning.predictor import (
    AUTOMATIC,
    Fitted,
    Inputs,
    Job,
    Prediction,
    Predictor,
    Samples,
    compute_held_loss,
    cross_predict,
    find_held_out,
    find_kind,
)
from tcpipe.progress import logger
from tcpipe.splits.audit import CLOSE, PLACES, are_near, compute_middles
from tcpipe.terrain.layers import COLOURS, LAYERS, NODATA_ID, PAPER_CLASSES, PAPER_LAYERS, ClassTable
from tcpipe.terrain.sampling import compute_relief_m

_READ_TOGETHER = 1024

_CALLED = {"turn_radpm": "turn (mean_abs_yaw_rate_radps)", "command_mps": "commanded speed (commanded_velocity_mps)"}


@dataclass(frozen=True, slots=True)
class TrainResult:
    """Result of a training; the command prints its ``str``."""

    path: str
    status: str
    """``done`` or ``unchanged``."""
    model: ModelKind
    samples: Mapping[str, int]
    """Number of samples: fitted, and held out for early stopping."""
    epochs: int
    """Number of epochs, or of trees for each label; ``best_epoch`` of them give the model."""
    best_epoch: int
    held_out_loss: float
    device: str
    training_times_s: TrainingTimes

    def __str__(self) -> str:
        """Return samples, loss and time as plain lines."""
        if self.status == "unchanged":
            return f"{self.path}: nothing to do: trained on the same dataset with the same options"
        times = self.training_times_s
        best = f", best {self.best_epoch} of {self.epochs} epochs or trees" if self.epochs > 1 else ""
        return (
            f"{self.path}: {self.model} of {self.samples['fitted']} samples{best}\n"
            f"loss {self.held_out_loss:.4f} of {self.samples['held out']} held-out samples; "
            f"{times.total_s:.1f} s on {self.device}"
        )


# Number of parts of the runs, each predicted by the others; with fewer runs, folds are the clusters of errors.
_PARTS = 5


def choose_kind(data: Dataset, config: FitConfig, split: Split | None = None) -> ModelKind:
    """Return the simplest kind within one standard error of the best at predicting other runs.

    Each part of the runs is predicted by models of the rest; of a single run, each fold. The loss is the squared error
    of time and of energy, each over its variance. ``split``: labelled samples of train, by default all.
    """
    split = select_train(data, config) if split is None else split
    runs, folds = (np.unique(split.column(name), return_inverse=True)[1] for name in ("run_id", "fold"))
    part = runs % _PARTS if runs.any() else folds
    clusters = runs if runs.max() + 1 >= _PARTS else runs * (folds.max() + 1) + folds
    losses: dict[ModelKind, Floats] = {}
    for name in AUTOMATIC:
        kind = find_kind(name)
        try:
            samples = make_training_samples(data, config, kind, split)
            losses[name] = _compute_losses(samples, cross_predict(kind, samples, part).mean)
        except ModelError as error:
            logger.info("%s is not compared: %s", name, error.problems[0])
    best = min(losses, key=lambda name: float(losses[name].mean()))
    chosen = next(name for name, loss in losses.items() if is_within_error(loss - losses[best], clusters))
    figures = ", ".join(f"{name} {loss.mean() / 2.0:.3f}" for name, loss in losses.items())
    logger.info(
        "%s: chooses %s, the simplest within one standard error of the best (%s). "
        "Unexplained share of the variance of T and E, "
        "predicted by other runs: %s. To choose another: --model", data.path, chosen, best, figures,
    )  # fmt: skip
    return chosen


def _compute_losses(samples: Samples, predicted: Floats) -> Floats:
    """Return the squared errors of T and E over their variances, shape (N,)."""
    if len(samples.inputs.outputs) == 1:
        return np.asarray(np.square((predicted - samples.labels) / samples.labels.std())[:, 0])
    costs = compute_costs(predicted[:, 0], np.maximum(predicted[:, 1], LEAST_VELOCITY_MPS), 1.0)
    true = compute_costs(samples.labels[:, 0], samples.labels[:, 1], 1.0)
    losses = [
        np.square((costs[quantity] - true[quantity]) / max(float(true[quantity].std()), 1e-9))
        for quantity in ("T", "E")
    ]
    return np.asarray(np.sum(losses, axis=0))


def is_within_error(difference: Floats, clusters: Ints) -> bool:
    """Return whether the mean of differences is at most its standard error, computed over clusters."""
    sums = np.bincount(clusters, difference - difference.mean())
    count = int(np.unique(clusters).size)
    return bool(difference.mean() <= np.sqrt(np.square(sums).sum() * count / max(count - 1, 1)) / difference.size)


def train(
    dataset: Location,
    out: Location = "model",
    *,
    config: FitConfig | None = None,
    no_resume: bool = False,
    predictor: str | None = None,
) -> TrainResult:
    """Train a model on a dataset and write the model folder ``out``, complete or not at all.

    Parameters
    ----------
    dataset : output of ``tcpipe build-dataset``.
    out : a new folder, or one with only a model, which is replaced unless it is complete and of the same dataset and
        options; or a URL in a bucket, where it becomes the newest build. ``<out>.KEY.checkpoint`` beside the folder, or
        in this one for a URL, keeps the state, so that a training resumes; KEY depends on dataset and options.
    config : the options.
    no_resume : ignore an earlier state.
    predictor : code of the user, ``FILE.py[:NAME]``, that is fitted instead of a shipped kind.
    """
    rules = config or FitConfig()
    own = None if predictor is None else load_own_kind(predictor)
    rules = rules if own is None else replace(rules, model="own", predictor=own.digest)
    data = open_dataset(dataset, label=rules.label)
    if not data.card.layers:
        raise DatasetError(
            f"{data.path}: has no patches, which a model is trained on; "
            "build it with a map (tcpipe add-map) and without "
            "--without-patches, or train your own model on its samples.parquet"
        )
    key = digest({"dataset": compute_dataset_checksum(data.card), "config": asdict(rules)})
    place = Path(str(out).rstrip("/").rpartition("/")[2]) if is_url(out) else Path(out)
    clear_beside(place)
    named = place if place.name not in {"", ".."} else place.resolve()
    checkpoint = named.with_name(f"{named.name}.{key[:8]}.checkpoint")
    if no_resume:
        checkpoint.unlink(missing_ok=True)
    elif (known := _read_known_model(out, predictor)) is not None and known.training.key == key:
        checkpoint.unlink(missing_ok=True)  # of a training that was killed after it wrote its model
        return _make_result(out, "unchanged", known.training, TrainingTimes())
    name = choose_kind(data, rules) if rules.model == "auto" else rules.model
    kind = find_kind(name) if own is None else own.kind
    if kind.channels and rules.layers and rules.model != "auto":
        raise UsageError(
            f"--layers: a model of kind {name} uses the slope and class of a segment, not a patch; remove it"
        )
    if kind.channels:
        level = logging.WARNING if rules.layers else logging.INFO
        logger.log(level, "%s: a model of kind %s takes the slope and class of each metre, and no layer", dataset, name)
    else:
        _report_layers(data, rules.layers or data["train"].channels, is_chosen=bool(rules.layers))
    samples = make_training_samples(data, rules, kind)
    _reject_other_files(out)
    with report_errors(own):
        fitted = kind.fit_folds(samples, Job(str(out), checkpoint))
        near = _predict_near(kind, samples, CLOSE * data.card.recipe.segment.chord_m)
        weights = {name: np.asarray(array) for name, array in kind.to_arrays(fitted.predictor).items()}
    if own is not None and (missing := int((~find_held_out(fitted.held_out)).sum())):
        raise ModelError(f"--predictor {predictor}: no finite prediction of {missing} of {len(samples)} samples")
    card = _make_card(data, samples, fitted, key, name)
    history = "".join(f"{epoch},{loss!r},{held!r}\n" for epoch, loss, held in fitted.history)
    write_model(
        out, card=card, weights=weights, residuals=_make_residuals_table(samples, fitted, near),
        ground=pa.table(dict(zip(GROUND_COLUMNS, _find_middles(_select_used(samples, fitted)).T, strict=True))),
        history="epoch,loss,held_out_loss\n" + history,
    )  # fmt: skip
    checkpoint.unlink(missing_ok=True)
    return _make_result(out, "done", card.training, fitted.training_times_s)


def _report_layers(data: Dataset, channels: Sequence[str], *, is_chosen: bool) -> None:
    """Log which layers of a dataset a model uses, and warn of the user's layers that it uses only if asked to."""
    named = {channel.removesuffix(ONE_HOT) for channel in channels}
    taken = [
        *(name for name in LAYERS if name in named),
        *(name for name in data.card.layers if name in named - {*LAYERS}),
    ]
    shown = {*taken, *COLOURS}  # the grey ortho is of its colours
    unused = [name for name in data.card.layers if name not in shown]
    logger.info("%s: layers: %s; not used: %s", data.path, ", ".join(channels), ", ".join(unused) or "none")
    if own := [] if is_chosen else [name for name in unused if name not in PAPER_LAYERS]:
        message = "%s: the model does not use %s; to use it: --layers %s"
        logger.warning(message, data.path, ", ".join(own), ",".join([*taken, *own]))


def compute_dataset_checksum(card: DatasetCard) -> str:
    """Return one checksum of every file of a dataset."""
    return digest(card.checksums)


def select_train(data: Dataset, rules: FitConfig, kind: type[Predictor] = Predictor) -> Split:
    """Return the labelled samples of train that a kind of model is fitted to; `DatasetError` without any."""
    train = data["train"]
    wanted = np.isfinite(train.labels).all(axis=1)
    if unlabelled := len(train) - int(wanted.sum()):
        logger.info("%s: %d of %d samples of train have no label and are not used", data.path, unlabelled, len(train))
    train = train.take(wanted)
    if not len(train):
        raise DatasetError(
            f"{data.path}: no labelled samples in split train; check that its region (--split) contains runs"
        )
    channels = kind.channels or rules.layers
    return train.with_channels(*channels) if channels else train


def make_training_samples(
    data: Dataset, rules: FitConfig, kind: type[Predictor], train: Split | None = None
) -> Samples:
    """Return the samples of a kind of model: labelled ``train``, or those of `select_train`, which need folds."""
    needs_folds = train is None
    if train is None:
        train = select_train(data, rules, kind)
    elif kind.channels:
        train = train.with_channels(*kind.channels)
    outputs, folds = train.label_columns, train.column("fold")
    fitted = train.take(folds != rules.fold)
    is_lacking = len(fitted) in {0, len(train)} if kind.stops_by_fold else len(np.unique(folds)) < 2
    if needs_folds and is_lacking:
        cure = f"a block contains {data.card.recipe.split.block_m:g} m of ground: drive more of it"
        if data.card.recipe.split.holdout in ("run", "tag"):
            cure = "they are of whole runs: drive once more, or build it with --holdout block"
        raise DatasetError(
            f"{data.path}: fold {rules.fold} of train leaves {len(fitted)} samples to fit and "
            f"{len(train) - len(fitted)} held out; "
            f"expected both (there are folds {', '.join(map(str, np.unique(folds)))}; {cure})"
        )
    used = fitted if kind.stops_by_fold else train
    extra_features: tuple[ExtraFeature, ...] = ()
    if kind.features or (kind.features is None and rules.extra_features):
        extra_features = _find_extra_features(used, kind.features, data)
    inputs = Inputs(
        channels=train.channels, patch_px=data.card.patch_px, planes=train.view.form.planes, patch_m=data.card.patch_m,
        class_count=read_class_table(data.card).count, extra_features=extra_features, outputs=outputs, scale=(),
    )  # fmt: skip
    samples = Samples(train, inputs, rules, compute_idle_power(train))
    return replace(samples, inputs=replace(inputs, scale=tuple(map(float, samples.labels.max(axis=0)))))


def _find_extra_features(used: Split, wanted: Sequence[str] | None, data: Dataset) -> tuple[ExtraFeature, ...]:
    """Return the requested features that the samples have; `DatasetError` if --extra-features finds none."""
    names = _CALLED if wanted is None else wanted
    found = tuple(feature for feature in available_features(read_extra_features(used)) if feature.name in names)
    lacking = [_CALLED[name] for name in names if name not in {feature.name for feature in found}]
    if lacking and not found and wanted is None:
        raise DatasetError(
            f"{data.path}: its samples have no {' and no '.join(lacking)}; ingest the logs again and build the dataset "
            "again, "
            "or train without --extra-features"
        )
    if lacking:
        logger.warning("%s: its samples have no %s: the model does not use it", data.path, " and no ".join(lacking))
    return found


def find_training_range(split: Split) -> TrainingRange:
    """Return the classes and value ranges of a split."""
    pixel_classes: set[int] = set()
    reliefs_m: list[float] = []
    means: dict[str, list[Floats]] = {}
    for first in range(0, len(split), _READ_TOGETHER):
        layers = split.layers(np.arange(first, min(first + _READ_TOGETHER, len(split))))
        if "terrain" in layers:
            pixel_classes |= set(np.flatnonzero(np.bincount(layers["terrain"].ravel())).tolist()) - {NODATA_ID}
        if "height" in layers:
            found_m = compute_relief_m(np.asarray(layers["height"], np.uint16))
            reliefs_m += [float(found_m.min()), float(found_m.max())]
        for name in layers.keys() - PAPER_LAYERS.keys():
            means.setdefault(name, []).append(split.view.form.known[name].compute_means(layers[name]))
    slopes = {name: split.column(name) for name in ("slope_rad", "cross_slope_rad")}
    ranges = {name: (float(np.min(slope)), float(np.max(slope))) for name, slope in slopes.items()}
    if reliefs_m:
        ranges["relief_m"] = (min(reliefs_m), max(reliefs_m))
    class_ids = split.column("terrain_class").astype(float)
    ids, counts = np.unique(class_ids[np.isfinite(class_ids)].astype(int), return_counts=True)
    class_counts = dict(zip(ids.tolist(), counts.tolist(), strict=True))
    own = {name: LayerRange.estimate(np.concatenate(parts)) for name, parts in sorted(means.items())}
    return TrainingRange(class_counts, tuple(sorted(pixel_classes)), ranges, own)


def _read_known_model(out: Location, predictor: str | None) -> ModelCard | None:
    """Return the card of the model at ``out``; None without one, or if it is damaged or of another schema."""
    if is_url(out):
        return load_model(out, predictor).card if find_newest(str(out), [CARD]) else None
    place = Path(out)
    if not place.exists() or (place.is_dir() and not any(place.iterdir())):
        return None
    with suppress(StoreError):
        if (read_json(place / CARD) if (place / CARD).is_file() else {}).get("kind") != KIND:
            raise UsageError(f"{place}: exists and is no model; it is not changed; give another OUT")
    with suppress(ModelError):
        return load_model(place, predictor).card
    return None


def _reject_other_files(out: Location) -> None:
    """Raise `UsageError` if the folder contains files that are not part of a model."""
    place = Path(out)
    entries = {entry.name for entry in place.iterdir()} if place.is_dir() else set()
    strangers = sorted(name for name in entries - set(FILES) if not name.startswith("."))
    if strangers:
        raise UsageError(
            f"{place}: contains {', '.join(strangers)} in the directory of a model, which would be replaced; "
            "move it, or give another OUT"
        )


def _make_result(place: Location, status: str, training: Training, times: TrainingTimes) -> TrainResult:
    named = {"path": str(place), "status": status, "model": training.kind, "training_times_s": times}
    return convert_record(training, TrainResult, **named)


def _make_card(data: Dataset, samples: Samples, fitted: Fitted, key: str, kind: ModelKind) -> ModelCard:
    card, config, inputs = data.card, samples.config, samples.inputs
    is_held = find_held_out(fitted.held_out)
    used, held = _select_used(samples, fitted), samples.take(is_held)
    own = [name for name in samples.split.view.form.layers if name not in PAPER_LAYERS]
    return ModelCard(
        inputs=inputs,
        layers={name: card.layers[name] for name in own},
        chord_m=card.recipe.segment.chord_m,
        max_arc_to_chord=card.recipe.segment.max_arc_to_chord,
        label_velocity=card.label.velocity,
        label_energy=config.label,
        label_includes=card.label.includes,
        robot=", ".join(card.robots),
        classes=read_class_table(card).classes,
        training_range=find_training_range(
            used.with_channels(*(name for name in ("terrain", "height") if name in card.layers), *own)
        ),
        physics=card.physics.get(card.robots[0]) if len(card.robots) == 1 else None,
        dataset=TrainedOn(card.name, compute_dataset_checksum(card), card.data_model_version, card.splits),
        training=Training(
            key=key,
            config=config,
            kind=kind,
            samples={"fitted": len(used), "held out": len(held)},
            epochs=fitted.epochs,
            best_epoch=fitted.best_epoch,
            held_out_loss=compute_held_loss(held, fitted.held_out.mean[is_held]),
            device=fitted.device,
        ),
    )


def read_class_table(card: DatasetCard) -> ClassTable:
    """Return a dataset's class table; one without a terrain layer has the paper's."""
    return ClassTable(card.classes) if card.classes else PAPER_CLASSES


def _find_middles(split: Split) -> Floats:
    """Return longitude, latitude of each sample's middle [deg], shape (N, 2); none without coordinates."""
    return compute_middles([split.column(name) for name in PLACES]) if split.has_coordinates else np.empty((0, 2))


def _predict_near(kind: type[Predictor], samples: Samples, within_m: float) -> Prediction:
    """Predict samples near ground of other runs by models trained without their run; other samples are NaN.

    This shows the errors of a new drive over known ground. A network has no such predictions, and neither have few
    runs.
    """
    out = Prediction.without_covariance(np.full(samples.labels.shape, np.nan))
    runs, middles = np.unique(samples.split.column("run_id"), return_inverse=True)[1], _find_middles(samples.split)
    if kind.stops_by_fold or not len(middles) or runs.max() + 1 < _PARTS:
        return out
    for run in np.unique(runs):
        own = runs == run
        near = are_near(middles[own], middles[~own], within_m=within_m, in_degrees=True)
        out.mean[np.flatnonzero(own)[near]] = 0.0
    if (is_near := find_held_out(out)).sum() >= FEWEST:
        out.mean[is_near] = cross_predict(kind, samples, runs % _PARTS).mean[is_near]
    return out


def _select_used(samples: Samples, fitted: Fitted) -> Split:
    """Return the samples that a model is fitted to: of a network all but the fold that stopped it."""
    is_network = getattr(fitted.predictor, "stops_by_fold", False)
    return samples.split.take(samples.folds != samples.config.fold) if is_network else samples.split


def _make_residuals_table(samples: Samples, fitted: Fitted, near: Prediction) -> pa.Table:
    """Return labels and predictions of held-out samples, one row per sample."""
    held_out, is_held = fitted.held_out, find_held_out(fitted.held_out)

    held, predictions, labels = samples.split.take(is_held), held_out.take(is_held), samples.labels[is_held]
    # the common error of all labels is in no residual
    names = "sample_id", "run_id", "start_ns", "terrain_class", "fold", "duration_s", "duration_common_std_s"
    columns = {name: held.column(name) for name in names} | make_residuals(
        labels, predictions.mean, predictions.covariance
    )
    columns |= dict(zip(NEAR[-near.mean.shape[1] :], near.take(is_held).mean.T, strict=True))
    columns["energy_common_std_joule"] = held.column(name_common_std(held.energy.energy_std))
    return pa.table(columns)
