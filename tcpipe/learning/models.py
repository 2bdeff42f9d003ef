"""Trained models: folders that are complete or absent.

::

    model.json         inputs, outputs, training range and training; checksums of the other files
    weights.npz        the weights of a network by torch's names; curves and trees; coefficients of physics
    residuals.parquet  labels and predictions of the fold that stopped a network; else of all samples, by other folds
    ground.parquet     longitude and latitude of the training samples; empty without coordinates
    history.csv        losses of every epoch
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Floats, Floats32, Mask, NamedArrays
from tcpipe.cost.prediction_errors import QuantityErrors, estimate_correlation, fit_errors
from tcpipe.dataset.extra_features import ExtraFeatures, empty_extra_features, fill_unknown
from tcpipe.errors import ModelError, StoreError, UsageError
from tcpipe.formats.atomic import Location, write_text
from tcpipe.formats.integrity import compute_checksums, read_sealed, seal_document, write_sealed
from tcpipe.formats.json_files import digest, parse_typed
from tcpipe.formats.parquet import read_table, write_table
from tcpipe.formats.place import Place, find_wrong_files
from tcpipe.formats.published_outputs import fetch_directory, publish_directory
from tcpipe.formats.weights import read_arrays, write_arrays
from tcpipe.learning.metrics import LEAST_VELOCITY_MPS
from tcpipe.learning.model_card import KIND, SCHEMA_VERSION, ModelCard, is_current
from tcpipe.learning.own_models import OwnKind, load_own_kind, report_errors
from tcpipe.learning.predictor import Prediction, Predictor, ask_predictor, find_kind
from tcpipe.progress import logger
from tcpipe.splits.audit import CLOSE, are_near

FILES = CARD, WEIGHTS, RESIDUALS, GROUND, HISTORY = (
    "model.json",
    "weights.npz",
    "residuals.parquet",
    "ground.parquet",
    "history.csv",
)

GROUND_COLUMNS = "lon_deg", "lat_deg"

_SPEED_MARGIN_MPS = 0.01  # largest distance of a speed from those of training [m/s], for rounding


@dataclass(frozen=True)
class Model:
    """A trained model with its card; ``name`` is the folder as it was given."""

    name: str
    card: ModelCard
    place: Path
    checksum: str
    """Checksum of card and weights, which determine its predictions."""
    residuals: NamedArrays = field(default_factory=dict)
    """Columns of the held-out samples: run_id, start_ns, terrain_class, labels, predictions."""
    own: OwnKind | None = None
    """The user's code."""
    ground_deg: Floats = field(default_factory=lambda: np.empty((0, 2)))
    """Longitude and latitude of the training samples, shape (N, 2)."""

    @cached_property
    def predictor(self) -> Predictor:
        """Return the model of the card's kind from its arrays; torch is imported for a network."""
        path = self.place / WEIGHTS
        kind = find_kind(self.card.training.kind) if self.own is None else self.own.kind
        try:
            with report_errors(self.own):
                return kind.from_arrays(read_arrays(path), self.card.inputs)
        except ModelError as error:
            raise ModelError(
                *(text if text.startswith(f"{path}: ") else f"{path}: {text}" for text in error.problems)
            ) from None

    @property
    def takes_turns(self) -> bool:
        """Whether the turn of a metre is an input, so that predictions include its cost."""
        return any(feature.name == "turn_radpm" for feature in self.card.inputs.extra_features)

    @cached_property
    def errors(self) -> dict[str, QuantityErrors] | None:
        """Return the errors on held-out samples; None if they are too few."""
        return fit_errors(self.residuals)

    def find_near(self, lonlat_deg: Floats) -> Mask:
        """Return which points, shape (N, 2), are near ground of training samples."""
        return are_near(lonlat_deg, self.ground_deg, within_m=CLOSE * self.card.chord_m, in_degrees=True)

    @cached_property
    def _correlation(self) -> float:
        return estimate_correlation(self.residuals)

    def ask(self, patches: Floats32, features: ExtraFeatures | None = None) -> Prediction:
        """Return predictions of patches in [0, 1], shape (N, px, px, depth), and the predictor's own covariances.

        A model of time alone gives power and velocity, too: its power is NaN.
        ``features`` are those of the N segments (`tcpipe.dataset.extra_features.read_extra_features` of a split).
        Physics needs them; other models use the features that they were trained with, and defaults for missing ones.
        """
        inputs = self.card.inputs
        wanted = (inputs.patch_px, inputs.patch_px, len(inputs.planes))
        if patches.shape[1:] != wanted:
            raise ModelError(
                f"{self.name}: patches of shape {patches.shape[1:]}, expected {wanted}: {', '.join(inputs.channels)}"
            )
        known = fill_unknown(inputs.extra_features, features or empty_extra_features(len(patches)))
        with report_errors(self.own):
            prediction = ask_predictor(self.predictor, patches, known, inputs.outputs)
        names = [name.removeprefix("fused_") for name in inputs.outputs]
        if "velocity_mps" in names:
            column = names.index("velocity_mps")
            prediction.mean[:, column] = np.maximum(prediction.mean[:, column], LEAST_VELOCITY_MPS)
        return prediction.add_unknown_power() if inputs.is_time_alone else prediction

    def predict(self, patches: Floats32, features: ExtraFeatures | None = None) -> Prediction:
        """Return power [W] and velocity [m/s] of patches as `ask`, with the covariances of their errors on new ground.

        The covariances come from held-out predictions, which also scale those that the model states.
        """
        prediction, errors = self.ask(patches, features), self.errors
        if errors is None or prediction.mean.shape[1] != 2:
            return prediction
        class_id = np.zeros(len(patches), np.int64) if features is None else features.class_id
        stated = np.sqrt(np.diagonal(prediction.covariance, axis1=1, axis2=2)).T
        std = np.stack([
            errors[name].compute_std(value, class_id, stated_std) if name in errors else np.full(len(value), np.nan)
            for name, value, stated_std in zip(("power", "velocity"), prediction.mean.T, stated, strict=True)
        ])  # fmt: skip
        covariance = std.T[:, :, None] * std.T[:, None, :]
        covariance[:, [0, 1], [1, 0]] *= self._correlation
        return Prediction(prediction.mean, covariance)


def write_model(
    out: Location, *, card: ModelCard, weights: NamedArrays, residuals: pa.Table, ground: pa.Table, history: str
) -> None:
    """Write a model folder, or the newest build at a URL, complete or not at all."""
    with publish_directory(out, CARD) as directory:
        write_arrays(directory / WEIGHTS, weights)
        write_table(residuals, directory / RESIDUALS)
        write_table(ground, directory / GROUND)
        write_text(directory / HISTORY, history)
        write_sealed(directory / CARD, replace(card, checksums=compute_checksums(directory)))


def load_model(path: Location, predictor: str | None = None) -> Model:
    """Open a model that ``tcpipe train`` wrote; its network is made when it is first asked.

    Parameters
    ----------
    path : its folder, or the URL of one in a bucket.
    predictor : ``FILE.py[:NAME]``, the code of a model that was trained with one; it is run.

    Raises
    ------
    UsageError : there is no model, or the model needs its code and gets none, or the other way round.
    ModelError : a file is damaged or missing, it is of another schema, or the code fails.
    """
    place = fetch_directory(path)
    card = read_model_card(place)
    if problems := list(find_wrong_files(Place(place), card.checksums)):
        raise ModelError(*(f"{problem}; train the model again" for problem in problems))
    table = read_table(place / RESIDUALS)
    residuals = {name: table.column(name).to_numpy() for name in table.column_names}
    if "terrain_class" in residuals:  # of a map without classes: null
        residuals["terrain_class"] = np.nan_to_num(residuals["terrain_class"].astype(float)).astype(np.uint8)
    ground = read_table(place / GROUND)
    ground_deg = np.column_stack([ground.column(name).to_numpy() for name in GROUND_COLUMNS])
    checksum = digest(seal_document(card))  # which is of its files, too
    model = Model(str(path), card, place, checksum, residuals, ground_deg=ground_deg)
    needs_code = find_kind(card.training.kind) is Predictor
    return _add_code(model, predictor) if needs_code or predictor is not None else model


def _add_code(model: Model, predictor: str | None) -> Model:
    """Return the model with the user's code, without which it cannot predict."""
    training = model.card.training
    if find_kind(training.kind) is not Predictor:
        raise UsageError(f"{model.name}: a model of kind {training.kind} needs no code; remove --predictor")
    if predictor is None:
        raise UsageError(
            f"{model.name}: was trained with your own code, which its folder lacks; give it with --predictor FILE.py"
        )
    own = load_own_kind(predictor)
    if own.digest != training.config.predictor:
        logger.warning("%s: has changed since %s was trained with it", predictor, model.name)
    return replace(model, own=own, checksum=digest([model.checksum, own.digest]))


def set_speed(model: Model, speed_mps: float) -> Model:
    """Return the model for a commanded speed [m/s] instead of the usual one; `UsageError` for an untrained speed."""
    command = next((feature for feature in model.card.inputs.extra_features if feature.name == "command_mps"), None)
    if command is None:
        raise UsageError(
            f"{model.name}: has no input for the commanded speed; remove --speed, or train it with --extra-features"
        )
    low, high = command.training_range
    if not low - _SPEED_MARGIN_MPS <= speed_mps <= high + _SPEED_MARGIN_MPS:
        raise UsageError(
            f"--speed {speed_mps:g}: {model.name} was trained at commanded speeds of {low:.3g} to {high:.3g} m/s; "
            "give one of these"
        )
    extra_features = tuple(
        replace(feature, usual=speed_mps) if feature is command else feature
        for feature in model.card.inputs.extra_features
    )
    card = replace(model.card, inputs=replace(model.card.inputs, extra_features=extra_features))
    return replace(model, card=card, checksum=digest([model.checksum, speed_mps]))


def read_model_card(place: Path) -> ModelCard:
    """Return model.json of a folder; `UsageError` without one, `ModelError` if it is damaged or of another schema."""
    if not place.is_dir():
        raise UsageError(f"{place}: there is no such model; run 'tcpipe train' first")
    where = place / CARD
    if not where.is_file():
        raise UsageError(f"{place}: not a model: it has no {CARD}")
    try:
        found = read_sealed(where, ours=is_current)
        if found.get("kind") != KIND:
            raise ModelError(f"{where}: not the card of a tcpipe model (kind is {found.get('kind')!r})")
        if not is_current(found):
            version = found.get("schema_version")
            raise ModelError(
                f"{where}: written by model schema {version}, expected {SCHEMA_VERSION}; train the model again"
            )
        return parse_typed(found, ModelCard, where)
    except StoreError as error:
        raise ModelError(f"{error.problems[0]}; remove the folder and train the model again") from None
