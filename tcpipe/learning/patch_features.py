"""Numbers that a table model sees of a patch: what its ground, its classes and its picture are like, from the tensor alone.

======== =====================================================================================================================
channel  features
======== =====================================================================================================================
height   slope along travel and steepness across it [rad], curvature along and across [1/m] of the paraboloid that fits best, the
         deviation of the ground from that (roughness) and its highest above its lowest pixel (relief) [m]
terrain  share of the patch that each class has
others   mean, deviation (contrast), mean difference of neighbours along travel (texture)
======== =====================================================================================================================

None changes when a patch is mirrored across its travel. A pixel without data counts as the tensor has it, as 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tcpipe.terrain.layers import HEIGHT_RANGE_M

Floats = NDArray[np.float64]
Patches = NDArray[np.float32]

_OF_GROUND, _OF_OTHERS = 6, 3
"""Features of a channel."""


def patch_features(patches: Patches, *, channels: Sequence[str], class_count: int, patch_m: float) -> Floats:
    """Return the features of tensors of shape (N, px, px, channels), shape (N, features).

    Parameters
    ----------
    patches : values in [0, 1]; travel is along the columns.
    channels : what the last axis holds.
    class_count : largest class id of the table that the terrain channel is scaled by.
    patch_m : side of a patch [m].
    """
    parts: list[NDArray[np.floating]] = []
    for at, channel in enumerate(channels):
        values = np.ascontiguousarray(patches[..., at])
        if channel == "height":
            parts.append(_compute_ground_features(values * np.float32(HEIGHT_RANGE_M), patch_m))
        elif channel == "terrain":
            parts.append(_compute_class_shares(values, class_count))
        else:
            texture = np.abs(np.diff(values, axis=2)).mean(axis=(1, 2))
            parts.append(np.column_stack([values.mean(axis=(1, 2)), values.std(axis=(1, 2)), texture]))
    return np.column_stack(parts).astype(np.float64)


def find_slope_and_class(
    features: Floats, channels: Sequence[str], class_count: int
) -> tuple[Floats, NDArray[np.int64]]:
    """Return slope [rad] and most frequent class of patches by their features, shape (N,) each; 0 without heights, or classes."""
    slope, class_id, at = np.zeros(len(features)), np.zeros(len(features), np.int64), 0
    for channel in channels:
        if channel == "height":
            slope = features[:, at]
        elif channel == "terrain":
            class_id = features[:, at : at + class_count].argmax(axis=1) + 1
        at += {"height": _OF_GROUND, "terrain": class_count}.get(channel, _OF_OTHERS)
    return slope, class_id


def _compute_ground_features(height_m: Patches, patch_m: float) -> NDArray[np.float32]:
    px = height_m.shape[1]
    along = np.tile((np.arange(px) + 0.5) / px * patch_m - patch_m / 2.0, (px, 1))
    across = along.T
    form = np.stack([np.ones_like(along), along, across, along**2, across**2, along * across]).reshape(6, -1)
    flat = height_m.reshape(len(height_m), px * px)
    fitted = flat @ np.linalg.pinv(form).astype(np.float32)
    roughness = (flat - fitted @ form.astype(np.float32)).std(axis=1)
    slope, steepness = np.arctan(fitted[:, 1]), np.abs(np.arctan(fitted[:, 2]))
    return np.column_stack([slope, steepness, 2.0 * fitted[:, 3:5], roughness, np.ptp(flat, axis=1)])


def _compute_class_shares(values: Patches, class_count: int) -> Floats:
    ids = np.rint(values * np.float32(class_count - 1)).astype(np.int64)
    ids += np.arange(len(values))[:, None, None] * class_count
    counts = np.bincount(ids.ravel(), minlength=len(values) * class_count)
    return np.asarray(counts.reshape(len(values), class_count) / (values.shape[1] * values.shape[2]))
