"""Where a model has no business: ground without data, ground nobody can drive, ground unlike any that it was trained on.

A prediction beyond what was seen in training is a guess, however sure it looks. So every metre carries its reasons, and nothing is left
out silently. The ranges are the smallest and largest of training, not quantiles: between them there is at least one sample on each side.
"""

from __future__ import annotations

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from tcpipe.planning.cost_model import CostModel
from tcpipe.planning.ground_kernel import find_class_facts
from tcpipe.tables.bits import flag_name
from tcpipe.terrain.classes import NODATA_ID
from tcpipe.terrain.relief import compute_relief_m
from tcpipe.terrain.sampling import Patches
from tcpipe.terrain.tiles import MapReader

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
    """The class under most of the chord cannot be driven over; no cost."""
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
    """More than 5 % of the strip that the robot drives over (0.7 m wide) cannot be driven over, though the middle can."""
    CURVED = 1 << 9
    """The path bends more within the metre than any segment that is trained on (its recipe's `max_arc_to_chord`)."""


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
        low, high = model.seen[name]
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
    seen, known = np.zeros(256, np.bool_), np.zeros(256, np.uint8)
    seen[[class_id for class_id, count in model.class_counts.items() if count > 0]] = True
    known[list(model.pixel_classes)] = 1
    if model.classes != source.classes:
        seen[:], known[:] = True, 1
    px = terrain.shape[1]
    lane = np.flatnonzero(np.abs((np.arange(px) + 0.5) / px - 0.5) * model.patch_m <= LANE_M / 2.0)
    unknown, shut = np.empty(len(terrain), np.bool_), np.empty(len(terrain))
    blocked = (~traversable).astype(np.uint8)
    find_class_facts(terrain, known, blocked, int(lane[0]), int(lane[-1]) + 1, unknown, shut)
    bits[~seen[patches.terrain_class] | unknown] |= np.uint16(Reason.CLASS_OUTSIDE_TRAINING)
    bits[shut > _STRAY] |= np.uint16(Reason.OBSTACLE)
    return bits
