"""What planning needs of a trained model; `tcpipe.learning.models.Model` satisfies the protocol, and planning imports no trainer.

Predictions of a model for 1 m segments of ground, and the reasons against each: no data, not traversable, outside the training range.

A prediction outside the training range is a guess, so every segment has its reasons. The ranges are the smallest and largest values of
training, not quantiles. Segments are processed in batches; a thread samples the next batch while the model predicts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntFlag
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tcpipe.cost.prediction_errors import BiasCorrection, fit_bias_correction
from tcpipe.dataset.extra_features import ExtraFeatures
from tcpipe.dataset.tensor import TensorLayout
from tcpipe.errors import ModelError
from tcpipe.tables.bits import flag_name
from tcpipe.tables.facts import PhysicsFit
from tcpipe.terrain.classes import NODATA_ID, ClassTable
from tcpipe.terrain.layers import COLOURS, HEIGHT_STEP_M, LAYERS, PAPER_LAYERS, Layer
from tcpipe.terrain.sampling import (
    Patches,
    PatchFrames,
    compute_footprints,
    compute_relief_m,
    count_corners_on,
    sample_patches,
)
from tcpipe.terrain.tiles import MapReader, TilePool, choose_level, list_layers

Floats = NDArray[np.float64]


class CostModel(Protocol):
    """A model of power [W] and velocity [m/s] of a patch; which velocity, ``label_velocity`` says."""

    @property
    def name(self) -> str:
        """What the user calls it, for messages."""

    @property
    def checksum(self) -> str:
        """Hex digest of all that rules its predictions."""

    @property
    def robot(self) -> str:
        """The robot that it was trained on."""

    @property
    def classes(self) -> ClassTable:
        """The class table that it was trained with."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels of the tensor, in order (`tcpipe.dataset.tensor`)."""

    @property
    def layers(self) -> Mapping[str, Layer]:
        """Layers by name, of which its channels are, with the ranges by which they were scaled in training."""

    @property
    def patch_m(self) -> float:
        """Side of a patch on the ground [m]."""

    @property
    def patch_px(self) -> int:
        """Side of a patch in pixels."""

    @property
    def chord_m(self) -> float:
        """Length of the segments that it was trained on [m]."""

    @property
    def max_arc_to_chord(self) -> float:
        """Arc over chord above which no segment was trained on."""

    @property
    def label_velocity(self) -> str:
        """``ground``: chord over duration; ``fused``: forward velocity along the surface (ADR-10)."""

    @property
    def label_energy(self) -> str:
        """``total``: all that the power source measured; ``net``: less what the robot draws while it stands."""

    @property
    def class_counts(self) -> Mapping[int, int]:
        """How many training samples each class had under its chord."""

    @property
    def pixel_classes(self) -> tuple[int, ...]:
        """Classes of which any pixel occurred in training."""

    @property
    def training_range(self) -> Mapping[str, tuple[float, float]]:
        """Smallest and largest ``slope_rad``, ``cross_slope_rad`` [rad] and ``relief_m`` [m] of the training patches."""

    @property
    def physics(self) -> PhysicsFit | None:
        """What turning costs the robot, beside all else; None where no physics could be fitted."""

    @property
    def residuals(self) -> Mapping[str, NDArray[np.generic]]:
        """Held-out samples, one row each.

        ``run_id``, ``start_ns``, ``terrain_class``, labels ``power_watt`` and ``velocity_mps``, and what the model said of them:
        ``power_predicted_watt``, ``velocity_predicted_mps``.
        """

    @property
    def takes_turns(self) -> bool:
        """Whether it is told how far a metre turns: its predictions hold what that costs."""

    def predict(self, patches: NDArray[np.float32], extra_features: ExtraFeatures) -> NDArray[np.float32]:
        """Return power [W] and velocity [m/s], shape (N, 2), of tensors of shape (N, px, px, channels), and what is known beside them."""


@dataclass(frozen=True, slots=True)
class Predicted:
    """Power [W] and velocity [m/s] of N patches, shape (N,); NaN where the model was not asked or answered no velocity."""

    power_watt: Floats
    velocity_mps: Floats


def _make_layout(model: CostModel) -> TensorLayout:
    return TensorLayout(model.channels, model.layers, model.patch_px)


def check_model(model: CostModel, source: MapReader) -> None:
    """Raise `ModelError` if a map cannot give the model what it was trained on; all differences at once."""
    problems = []
    needed = _make_layout(model).layers
    there = list_layers(source, model.patch_m, model.patch_px)
    if missing := [layer for layer in needed if layer not in there]:
        option = f"--{missing[0]}" if missing[0] in LAYERS else f"--layer {missing[0]}=FILE"
        option = "--ortho-bands rgb" if missing[0] in COLOURS else option
        problems.append(
            f"map {source.name}: has no {', '.join(missing)}, which model {model.name} needs; add the map with {option}"
        )
    for name in set(needed) & there.keys() - PAPER_LAYERS.keys():
        its, wanted = there[name], model.layers[name]
        if its.signature != wanted.signature:
            text = f"is {its.signature}, but {wanted.signature} in training"
            problems.append(f"map {source.name}: {name} {text}; add the raster that the model was trained with")
        elif its.classes != wanted.classes:
            problems.append(f"map {source.name}: {name} has other classes than in training; add it with those")
    if "terrain" in needed and "terrain" in source.layers and model.classes != source.classes:
        different = "; ".join(source.classes.differences(model.classes))
        problems.append(
            f"map {source.name}: its classes are not those that model {model.name} was trained with: {different}; "
            "train on a dataset of this class table, or add the map with the model's"
        )
    if problems:
        raise ModelError(*problems)


def predict_patches(
    model: CostModel, patches: Patches, asked: NDArray[np.bool_], turn_radpm: Floats | None = None
) -> Predicted:
    """Return what the model says of the patches that it is asked about, shape (N,); tensors are formed batch by batch.

    ``turn_radpm`` is how far a metre of each turns; NaN, or nothing, is as usual, and so is the speed that is commanded.

    Raises
    ------
    ModelError : it gives something else than power and velocity.
    """
    form = _make_layout(model)
    pixels = {layer: patches.pixels[layer] for layer in form.layers}
    out, unknown = np.full((asked.size, 2), np.nan), np.full(asked.size, np.nan)
    turns = unknown if turn_radpm is None else turn_radpm
    extra_features = ExtraFeatures(patches.terrain_class.astype(np.int64), patches.slope_rad, turns, unknown)
    chosen = np.flatnonzero(asked)
    for rows in (chosen[first : first + form.batch_rows] for first in range(0, chosen.size, form.batch_rows)):
        said = model.predict(form.form(pixels, rows), extra_features.take(rows))
        if said.shape != (rows.size, 2):
            raise ModelError(
                f"{model.name}: gives {said.shape[-1]} numbers a patch, expected two: power and velocity; train it on both labels"
            )
        out[rows] = said
    out[~(np.isfinite(out).all(axis=1) & (out[:, 1] > 0.0))] = np.nan
    return Predicted(out[:, 0].copy(), out[:, 1].copy())


LANE_M = 0.7
"""Width of the strip that a robot needs, about the paper's Husky (0.67 m) [m]."""

_STRAY = 0.05
"""Share of a lane's pixels that may be wrongly classed."""


class Reason(IntFlag):
    """Why a metre has no cost, or one that is not to be trusted; 0 means that the model knows such ground."""

    OUTSIDE_MAP = 1 << 0
    """The patch reaches beyond the map; no cost."""
    NODATA = 1 << 1
    """A pixel of the patch has no data in some layer; no cost."""
    NOT_TRAVERSABLE = 1 << 2
    """The class under most of the chord is not traversable; no cost."""
    NO_MOTION = 1 << 3
    """The model predicts no forward velocity; no cost."""
    CLASS_OUTSIDE_TRAINING = 1 << 4
    """The class under most of the chord, or that of some pixel, does not occur in training."""
    SLOPE_OUTSIDE_TRAINING = 1 << 5
    """Steeper along travel, up or down, than any training sample."""
    CROSS_SLOPE_OUTSIDE_TRAINING = 1 << 6
    """Steeper across travel than any training sample."""
    RELIEF_OUTSIDE_TRAINING = 1 << 7
    """The patch's largest height difference is outside the training samples'."""
    OBSTACLE = 1 << 8
    """More than 5 % of the strip that the robot drives over (0.7 m wide) is not traversable, though the middle is."""
    CURVED = 1 << 9
    """The path is more curved here than any training segment (its recipe's `max_arc_to_chord`)."""


NO_COST = Reason.OUTSIDE_MAP | Reason.NODATA | Reason.NOT_TRAVERSABLE | Reason.NO_MOTION
"""With any of these there is no prediction."""

Bits = NDArray[np.uint16]


def count_reasons(bits: Bits) -> dict[str, int]:
    """Return how often each reason occurs; those that never do are left out."""
    counts = {flag_name(reason): int(np.count_nonzero(bits & reason)) for reason in Reason}
    return {name: count for name, count in counts.items() if count}


def find_reasons(patches: Patches, on_map: NDArray[np.bool_], model: CostModel, source: MapReader) -> Bits:
    """Return the reasons of each patch, shape (N,).

    Parameters
    ----------
    patches : N sampled patches.
    on_map : whether each lies wholly on the map, shape (N,).
    model, source : who is to judge them, and the map that they are from.
    """
    bits = np.zeros(on_map.size, np.uint16)
    bits[patches.valid_fraction < 1.0] |= np.uint16(Reason.NODATA)
    ranges = {
        Reason.SLOPE_OUTSIDE_TRAINING: (patches.slope_rad, "slope_rad"),
        Reason.CROSS_SLOPE_OUTSIDE_TRAINING: (patches.cross_slope_rad, "cross_slope_rad"),
        Reason.RELIEF_OUTSIDE_TRAINING: (compute_relief_m(patches.pixels["height"]), "relief_m"),
    }
    for reason, (values, name) in ranges.items():
        low, high = model.training_range[name]
        bits[~((values >= low) & (values <= high))] |= np.uint16(reason)
    if "terrain" in patches.pixels:
        bits |= _find_class_reasons(patches, patches.pixels["terrain"], model, source)
    bits[~on_map] = Reason.OUTSIDE_MAP
    bits[bits & Reason.NODATA != 0] = Reason.NODATA
    return bits


def _find_class_reasons(patches: Patches, terrain: NDArray[np.uint8], model: CostModel, source: MapReader) -> Bits:
    """Return what the map's classes forbid, and which of them training has not met; a model of another table takes no terrain."""
    traversable = source.classes.traversable()
    bits = np.zeros(len(terrain), np.uint16)
    bits[~traversable[patches.terrain_class]] |= np.uint16(Reason.NOT_TRAVERSABLE)
    bits[patches.terrain_class == NODATA_ID] |= np.uint16(Reason.NODATA)
    seen, known = np.zeros(256, np.bool_), np.zeros(256, np.bool_)
    seen[[class_id for class_id, count in model.class_counts.items() if count > 0]] = True
    known[list(model.pixel_classes)] = True
    if model.classes != source.classes:
        seen[:], known[:] = True, True
    px = terrain.shape[1]
    lane = np.flatnonzero(np.abs((np.arange(px) + 0.5) / px - 0.5) * model.patch_m <= LANE_M / 2.0)
    of_pixels = (
        (~known + 2 * ~traversable).astype(np.uint8).take(terrain)
    )  # 1: unknown, 2: blocked; one pass over the pixels
    unknown = (of_pixels & 1).any(axis=(1, 2))
    blocked = np.count_nonzero(of_pixels[:, lane[0] : lane[-1] + 1] & 2, axis=(1, 2)) / (lane.size * px)
    bits[~seen[patches.terrain_class] | unknown] |= np.uint16(Reason.CLASS_OUTSIDE_TRAINING)
    bits[blocked > _STRAY] |= np.uint16(Reason.OBSTACLE)
    return bits


BATCH = 4_096
"""Metres judged together: 26 MB of patches."""


@dataclass(frozen=True, slots=True)
class SegmentPredictions:
    """What is said of N metres, shape (N,): `Reason` bits, predictions (NaN without a cost), and what the ground is.

    Predictions are centred (`tcpipe.cost.prediction_errors`). ``velocity_mps`` is horizontal, whichever velocity the model predicts: a
    metre of the map takes its inverse. ``height_m`` is that of the metre's middle, NaN where the map has none.
    """

    reasons: Bits
    power_watt: Floats
    velocity_mps: Floats
    terrain_class: NDArray[np.uint8]
    slope_rad: Floats
    cross_slope_rad: Floats
    height_m: Floats


def iterate_predictions(
    model: CostModel,
    source: MapReader,
    batches: Iterable[PatchFrames],
    *,
    ask: bool = True,
    turn_radpm: Floats | None = None,
) -> Iterator[SegmentPredictions]:
    """Yield what is said of each batch of frames, in order; tiles of the map are kept from batch to batch.

    Without ``ask`` the ground is judged alone: no predictions. ``turn_radpm`` is how far a metre of each frame turns, of all batches one
    after another; without it all turn as usual.
    """
    source = source.select({*PAPER_LAYERS, *_make_layout(model).layers})
    centring, tiles = (
        fit_bias_correction(model.residuals),
        TilePool(choose_level(source, model.patch_m / model.patch_px)),
    )

    def sampled(frames: PatchFrames, first: int) -> tuple[Patches, NDArray[np.bool_], Floats | None]:
        chord_m = np.full(len(frames.centre_xy_m), model.chord_m)
        on_map = count_corners_on(source.grid, compute_footprints(frames, model.patch_m)) == 4
        patch_m, patch_px = model.patch_m, model.patch_px
        found = sample_patches(source, frames, chord_m, patch_m=patch_m, patch_px=patch_px, pool=tiles)
        return found, on_map, None if turn_radpm is None else turn_radpm[first : first + len(chord_m)]

    with ThreadPoolExecutor(max_workers=1) as ahead:
        waiting, first = None, 0
        for frames in batches:
            following, first = ahead.submit(sampled, frames, first), first + len(frames.centre_xy_m)
            if waiting is not None:
                yield _predict_batch(model, source, *waiting.result(), centring=centring, ask=ask)
            waiting = following
        if waiting is not None:
            yield _predict_batch(model, source, *waiting.result(), centring=centring, ask=ask)


def _predict_batch(
    model: CostModel,
    source: MapReader,
    patches: Patches,
    on_map: NDArray[np.bool_],
    turn_radpm: Floats | None,
    *,
    centring: BiasCorrection,
    ask: bool,
) -> SegmentPredictions:
    bits = find_reasons(patches, on_map, model, source)
    asked = (bits & NO_COST == 0) & ask
    said = predict_patches(model, patches, asked, turn_radpm)
    power_watt, velocity_mps = centring.apply(said.power_watt, said.velocity_mps, patches.terrain_class)
    bits[asked & np.isnan(velocity_mps)] |= np.uint16(Reason.NO_MOTION)
    known = bits & (Reason.OUTSIDE_MAP | Reason.NODATA) == 0
    horizontal = np.cos(patches.slope_rad) if model.label_velocity == "fused" else 1.0
    middle = patches.pixels["height"][:, model.patch_px // 2, model.patch_px // 2] * HEIGHT_STEP_M
    return SegmentPredictions(
        reasons=bits,
        power_watt=power_watt,
        velocity_mps=velocity_mps * horizontal,
        terrain_class=patches.terrain_class,
        slope_rad=np.where(known, patches.slope_rad, np.nan),
        cross_slope_rad=np.where(known, patches.cross_slope_rad, np.nan),
        height_m=np.where(known, patches.height_min_m + middle, np.nan),
    )


def predict_segments(
    model: CostModel, source: MapReader, frames: PatchFrames, turn_radpm: Floats | None = None
) -> SegmentPredictions:
    """Return what is said of all frames, in batches of `BATCH`; ``turn_radpm`` is how far a metre of each turns."""
    count = len(frames.centre_xy_m)
    starts = range(0, max(count, 1), BATCH)
    batches = (frames.rows(np.arange(first, min(first + BATCH, count))) for first in starts)
    found = list(iterate_predictions(model, source, batches, turn_radpm=turn_radpm))
    return SegmentPredictions(
        *(np.concatenate([getattr(of, name) for of in found]) for name in SegmentPredictions.__slots__)
    )
