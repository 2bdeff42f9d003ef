"""Predictions for 1 m segments of ground, and the reasons against each: no data, not traversable, outside training.

A prediction outside the training range is a guess, so every segment has its reasons. The ranges are the smallest and
largest values of training, not quantiles. Segments are processed in batches; a thread samples the next batch while the
model predicts.
"""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntFlag
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Bytes, Floats, Mask
from tcpipe.cost.prediction_errors import fit_bias_correction, propagate_stated
from tcpipe.dataset.extra_features import ExtraFeatures
from tcpipe.errors import ModelError
from tcpipe.learning.models import Model
from tcpipe.learning.predictor import Prediction
from tcpipe.tables.bits import flag_name
from tcpipe.terrain.layers import COLOURS, HEIGHT_STEP_M, LAYERS, NODATA_ID, PAPER_LAYERS
from tcpipe.terrain.sampling import (
    Patches,
    PatchFrames,
    compute_footprints,
    compute_relief_m,
    count_corners_on,
    sample_patches,
)
from tcpipe.terrain.tiles import MapReader, TilePool, choose_level


def check_model(model: Model, source: MapReader, *, needs_energy: bool = True) -> None:
    """Raise `ModelError` with all inputs of the model that the map lacks, and if the model lacks energy."""
    problems = []
    if needs_energy and model.card.inputs.is_time_alone:
        problems.append(
            f"{model.name}: predicts time alone, because its dataset has no label energy; expected a model of energy "
            "(evaluate and predict-path take this one, without --drive and --adapt)"
        )
    needed = model.card.layout.layers
    there = source.layers
    if missing := [layer for layer in needed if layer not in there]:
        option = f"--{missing[0]}" if missing[0] in LAYERS else f"--layer {missing[0]}=FILE"
        option = "--ortho-bands rgb" if missing[0] in COLOURS else option
        problems.append(
            f"map {source.name}: has no {', '.join(missing)}, which model {model.name} needs; add the map with {option}"
        )
    for name in set(needed) & there.keys() - PAPER_LAYERS.keys():
        its, wanted = there[name], model.card.layout.known[name]
        if its.signature != wanted.signature:
            text = f"is {its.signature}, but {wanted.signature} in training"
            problems.append(f"map {source.name}: {name} {text}; add the raster that the model was trained with")
        elif its.classes != wanted.classes:
            problems.append(f"map {source.name}: {name} has other classes than in training; add it with those")
    if "terrain" in needed and "terrain" in source.layers and model.card.class_table != source.classes:
        different = "; ".join(source.classes.differences(model.card.class_table))
        problems.append(
            f"map {source.name}: its classes are not those that model {model.name} was trained with: {different}; "
            "train on a dataset of this class table, or add the map with the model's"
        )
    if problems:
        raise ModelError(*problems)


LANE_M = 0.7
"""Width of the strip that a robot needs, about the paper's Husky (0.67 m) [m]."""

_ROUNDED = 1.0 + 1e-6  # factor up to which a distance equals that of training [1], for rounding

_STRAY = 0.05  # largest share of a lane's pixels with a wrong class [1]


class Reason(IntFlag):
    """Reasons for no cost, or an unreliable one, of a metre; 0: inside the training range."""

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
    LAYER_OUTSIDE_TRAINING = 1 << 10
    """Mean of a band of a user's layer, or share of a class, farther from the training mean than any sample."""


NO_COST = Reason.OUTSIDE_MAP | Reason.NODATA | Reason.NOT_TRAVERSABLE | Reason.NO_MOTION
"""Reasons without a prediction."""

Bits = NDArray[np.uint16]


def count_reasons(bits: Bits) -> dict[str, int]:
    """Return the number of occurrences of each reason that occurs."""
    counts = {flag_name(reason): int(np.count_nonzero(bits & reason)) for reason in Reason}
    return {name: count for name, count in counts.items() if count}


def find_reasons(patches: Patches, on_map: Mask, model: Model, source: MapReader) -> Bits:
    """Return the reasons of each patch of a map, shape (N,); ``on_map``: whether it is wholly on it, shape (N,)."""
    bits = np.zeros(on_map.size, np.uint16)
    bits[patches.valid_fraction < 1.0] |= np.uint16(Reason.NODATA)
    ranges = {
        Reason.SLOPE_OUTSIDE_TRAINING: (patches.slope_rad, "slope_rad"),
        Reason.CROSS_SLOPE_OUTSIDE_TRAINING: (patches.cross_slope_rad, "cross_slope_rad"),
        Reason.RELIEF_OUTSIDE_TRAINING: (compute_relief_m(patches.pixels["height"]), "relief_m"),
    }
    for reason, (values, name) in ranges.items():
        low, high = model.card.training_range.ranges[name]
        bits[~((values >= low) & (values <= high))] |= np.uint16(reason)
    for name, known in model.card.training_range.layers.items():
        values = model.card.layout.known[name].compute_means(patches.pixels[name])
        bits[known.compute_distance(values) > known.largest * _ROUNDED] |= np.uint16(Reason.LAYER_OUTSIDE_TRAINING)
    if "terrain" in patches.pixels:
        bits |= _find_class_reasons(patches, patches.pixels["terrain"], model, source)
    bits[~on_map] = Reason.OUTSIDE_MAP
    bits[bits & Reason.NODATA != 0] = Reason.NODATA
    return bits


def _find_class_reasons(patches: Patches, terrain: Bytes, model: Model, source: MapReader) -> Bits:
    """Return the reasons by class: not traversable, or not in training; ignored with another class table."""
    traversable = source.classes.traversable()
    bits = np.zeros(len(terrain), np.uint16)
    bits[~traversable[patches.terrain_class]] |= np.uint16(Reason.NOT_TRAVERSABLE)
    bits[patches.terrain_class == NODATA_ID] |= np.uint16(Reason.NODATA)
    seen, known = np.zeros(256, bool), np.zeros(256, bool)
    seen[[class_id for class_id, count in model.card.training_range.class_counts.items() if count > 0]] = True
    known[list(model.card.training_range.pixel_classes)] = True
    if model.card.class_table != source.classes:
        seen[:], known[:] = True, True
    px = terrain.shape[1]
    lane = np.flatnonzero(np.abs((np.arange(px) + 0.5) / px - 0.5) * model.card.inputs.patch_m <= LANE_M / 2.0)
    of_pixels = (~known + 2 * ~traversable).astype(np.uint8).take(terrain)  # 1: unknown, 2: blocked, in one pass
    unknown = (of_pixels & 1).any(axis=(1, 2))
    blocked = np.count_nonzero(of_pixels[:, lane[0] : lane[-1] + 1] & 2, axis=(1, 2)) / (lane.size * px)
    bits[~seen[patches.terrain_class] | unknown] |= np.uint16(Reason.CLASS_OUTSIDE_TRAINING)
    bits[blocked > _STRAY] |= np.uint16(Reason.OBSTACLE)
    return bits


BATCH = 4_096
"""Metres in a batch: 26 MB of patches."""


@dataclass(frozen=True, slots=True)
class SegmentPredictions:
    """Predictions for N metres, shape (N,): `Reason` bits, costs (NaN without a prediction), and the ground.

    Predictions are centred (`tcpipe.cost.prediction_errors`); ``duration_std_s`` and ``energy_std_joule`` are the
    model's own standard deviations for a metre, 0 without one. ``velocity_mps`` is horizontal, whichever velocity the
    model predicts. ``height_m`` is that of the metre's middle, NaN if the map has none.
    """

    reasons: Bits
    power_watt: Floats
    velocity_mps: Floats
    duration_std_s: Floats
    energy_std_joule: Floats
    terrain_class: Bytes
    slope_rad: Floats
    cross_slope_rad: Floats
    height_m: Floats


def iterate_predictions(
    model: Model, source: MapReader, batches: Iterable[PatchFrames], *, turn_radpm: Floats | None = None
) -> Iterator[SegmentPredictions]:
    """Yield the predictions of each batch of frames, in order; tiles of the map are kept from batch to batch.

    ``turn_radpm`` is the turn of a metre of each frame, of all batches one after another; without it all turn as usual.
    """
    source, side, px = (
        source.select({*PAPER_LAYERS, *model.card.layout.layers}),
        model.card.inputs.patch_m,
        model.card.inputs.patch_px,
    )
    correction, tiles = fit_bias_correction(model.residuals), TilePool(choose_level(source, side / px))

    def sample(frames: PatchFrames) -> tuple[Patches, Mask]:
        chord_m = np.full(len(frames.centre_xy_m), model.card.chord_m)
        on_map = count_corners_on(source.grid, compute_footprints(frames, side)) == 4
        return sample_patches(source, frames, chord_m, patch_m=side, patch_px=px, pool=tiles), on_map

    def judge(patches: Patches, on_map: Mask, first: int) -> SegmentPredictions:
        bits = find_reasons(patches, on_map, model, source)
        is_predicted = bits & NO_COST == 0
        turns = np.full(on_map.size, np.nan) if turn_radpm is None else turn_radpm[first : first + on_map.size]
        prediction = predict_patches(model, patches, is_predicted, turns)
        power_watt, velocity_mps = correction.apply(prediction.mean[:, 0], prediction.mean[:, 1], patches.terrain_class)
        stated = propagate_stated(prediction.mean, prediction.covariance)
        bits[is_predicted & np.isnan(velocity_mps)] |= np.uint16(Reason.NO_MOTION)
        known = bits & (Reason.OUTSIDE_MAP | Reason.NODATA) == 0
        horizontal = np.cos(patches.slope_rad) if model.card.label_velocity == "fused" else 1.0
        middle = patches.pixels["height"][:, px // 2, px // 2] * HEIGHT_STEP_M
        return SegmentPredictions(
            reasons=bits,
            power_watt=power_watt,
            velocity_mps=velocity_mps * horizontal,
            duration_std_s=stated["duration"] / horizontal,
            energy_std_joule=stated["energy"] / horizontal,
            terrain_class=patches.terrain_class,
            slope_rad=np.where(known, patches.slope_rad, np.nan),
            cross_slope_rad=np.where(known, patches.cross_slope_rad, np.nan),
            height_m=np.where(known, patches.height_min_m + middle, np.nan),
        )

    rest, first = iter(batches), 0
    with ThreadPoolExecutor(max_workers=1) as ahead:
        waiting = [ahead.submit(sample, frames) for frames in islice(rest, 1)]
        while waiting:
            patches, on_map = waiting.pop().result()
            waiting = [ahead.submit(sample, frames) for frames in islice(rest, 1)]
            yield judge(patches, on_map, first)
            first += on_map.size


def predict_patches(model: Model, patches: Patches, is_predicted: Mask, turn_radpm: Floats) -> Prediction:
    """Return power [W] and velocity [m/s] of N patches; NaN if not asked, or if no motion is predicted.

    ``asked`` and ``turn_radpm``, the turn of a metre (NaN: as usual), have shape (N,). The commanded speed is the usual
    one. Raises `ModelError` if the model returns something else than power and velocity.
    """
    form = model.card.layout
    pixels = {layer: patches.pixels[layer] for layer in form.layers}
    out, unknown = (
        Prediction.without_covariance(np.full((is_predicted.size, 2), np.nan)),
        np.full(is_predicted.size, np.nan),
    )
    extra_features = ExtraFeatures(patches.terrain_class.astype(np.int64), patches.slope_rad, turn_radpm, unknown)
    chosen = np.flatnonzero(is_predicted)
    for rows in (chosen[first : first + form.batch_rows] for first in range(0, chosen.size, form.batch_rows)):
        prediction = model.ask(form.form(pixels, rows), extra_features.take(rows))
        if prediction.mean.shape[1] != 2:
            raise ModelError(
                f"{model.name}: gives {prediction.mean.shape[1]} numbers per patch, expected two: power and velocity; "
                "train it on both labels"
            )
        out.mean[rows], out.covariance[rows] = prediction.mean, prediction.covariance
    needed = out.mean[:, 1:] if model.card.inputs.is_time_alone else out.mean
    out.mean[~(np.isfinite(needed).all(axis=1) & (out.mean[:, 1] > 0.0))] = np.nan
    return out


def predict_segments(
    model: Model, source: MapReader, frames: PatchFrames, turn_radpm: Floats | None = None
) -> SegmentPredictions:
    """Return the predictions of all frames, in batches of `BATCH`; ``turn_radpm`` is the turn of a metre of each."""
    count = len(frames.centre_xy_m)
    starts = range(0, max(count, 1), BATCH)
    batches = (frames.rows(np.arange(first, min(first + BATCH, count))) for first in starts)
    found = list(iterate_predictions(model, source, batches, turn_radpm=turn_radpm))
    return SegmentPredictions(
        *(
            np.concatenate([getattr(predictions, name) for predictions in found])
            for name in SegmentPredictions.__slots__
        )
    )
