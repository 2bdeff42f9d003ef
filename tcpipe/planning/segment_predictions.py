"""What a model says of metres of ground: sampled, judged, predicted, batch by batch; the next batch is sampled while the model answers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.cost.prediction_errors import BiasCorrection, fit_bias_correction
from tcpipe.planning.cost_model import CostModel, predict_patches
from tcpipe.planning.no_cost_reasons import NO_COST, Bits, Reason, find_reasons
from tcpipe.terrain.layers import HEIGHT_STEP_M
from tcpipe.terrain.patches import PatchFrames, compute_footprints, count_corners_on
from tcpipe.terrain.sampling import Patches, sample_patches
from tcpipe.terrain.tiles import MapReader, TilePool, level_for

Floats = NDArray[np.float64]

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


def predict_segments(
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
    centring, tiles = fit_bias_correction(model.residuals), TilePool(level_for(source, model.patch_m / model.patch_px))

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


def join_predictions(parts: Iterable[SegmentPredictions]) -> SegmentPredictions:
    """Return the verdicts of all batches as one."""
    found = list(parts)
    columns: dict[str, Any] = {
        entry.name: np.concatenate([getattr(part, entry.name) for part in found])
        for entry in fields(SegmentPredictions)
    }
    return SegmentPredictions(**columns)


def iterate_batches(frames: PatchFrames) -> Iterator[PatchFrames]:
    """Yield frames in batches of `BATCH`, in order."""
    for first in range(0, len(frames.centre_xy_m), BATCH):
        yield frames.rows(np.arange(first, min(first + BATCH, len(frames.centre_xy_m))))
