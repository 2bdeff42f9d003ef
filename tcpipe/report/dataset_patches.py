"""Some hundred patches inside a dataset's page: as many of every split, class and range of slope as there are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import PatchFiles, open_patches, rows_in_files
from tcpipe.formats.json_files import Json
from tcpipe.report.pictures import ACROSS, class_picture, picture_uri, relief_picture, sheet
from tcpipe.tables.columns import floats

MOST_PATCHES = 500
_PX = 48
"""Side of a patch in the page; larger ones are thinned."""

_PIECES = 24
"""Pieces of the files that are read: patches lie in random order, so a few hold all kinds."""


def patches_shown(directory: Path, card: DatasetCard, samples: pa.Table, row_of: NDArray[np.int64]) -> Json:
    """Return sheets of patches by layer and the rows of the page that they belong to (``row_of`` each sample, (T,)).

    `DatasetError` if they cannot be read.
    """
    if not samples.num_rows:
        return None
    files = open_patches(directory, card)
    splits = samples.column("split").to_numpy(zero_copy_only=False)
    place = np.empty(samples.num_rows, dtype=np.int64)  # where each row of samples lies in the files
    for name, rows in rows_in_files(card, splits).items():
        place[splits == name] = rows
    piece = np.searchsorted(files.starts, place, side="right") - 1
    near = np.flatnonzero(np.isin(piece, _some(np.unique(piece))))
    chosen = near[_stratified(samples.take(near))]
    return sheets(row_of[chosen].tolist(), _read(files, place[chosen], piece[chosen], thinned_by(card.patch_px)), files)


def thinned_by(patch_px: int) -> int:
    """Return the step in which pixels of a patch are shown."""
    return -(-patch_px // _PX)


def sheets(rows: Sequence[int], pixels: Mapping[str, NDArray[Any]], files: PatchFiles) -> Json:
    """Return thinned patches, (N, px, px) by layer, as a sheet for each layer, and the rows of the page that they belong to."""
    return {
        "rows": rows,
        "px": next(iter(pixels.values())).shape[1],
        "across": ACROSS,
        "layers": [{"name": name, "uri": _layer_uri(name, stack, files)} for name, stack in pixels.items()],
    }


def _some(pieces: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.asarray(pieces[np.unique(np.linspace(0, len(pieces) - 1, _PIECES).astype(int))])


def _stratified(samples: pa.Table) -> NDArray[np.int64]:
    """Return rows, rising, taken in turn from each split, class and 5° of slope: the same dataset shows the same ones."""
    slope = np.floor(np.degrees(floats(samples, "slope_rad")) / 5.0).tolist()
    keys = list(
        zip(samples.column("split").to_pylist(), samples.column("terrain_name").to_pylist(), slope, strict=True)
    )
    turn: dict[object, int] = {}
    order = []
    for row, key in enumerate(keys):
        turn[key] = turn.get(key, 0) + 1
        order.append((turn[key], row))
    return np.sort(np.array([row for _, row in sorted(order)[:MOST_PATCHES]], np.int64))


def _read(
    files: PatchFiles, place: NDArray[np.int64], piece: NDArray[np.int64], step: int
) -> dict[str, NDArray[np.generic]]:
    layers = list(files.layers)
    stacks: dict[str, list[NDArray[np.generic]]] = {layer: [] for layer in layers}
    order = np.argsort(piece, kind="stable")
    for number in np.unique(piece).tolist():
        pixels = files.read(number, layers)
        here = place[order][piece[order] == number] - files.starts[number]
        for layer in layers:
            stacks[layer].append(pixels[layer][here][:, ::step, ::step])
    back = np.argsort(order, kind="stable")
    return {layer: np.concatenate(parts)[back] for layer, parts in stacks.items()}


def _layer_uri(name: str, stack: NDArray[np.generic], files: PatchFiles) -> str:
    layer = files.layers[name]
    if layer.kind == "categorical":
        return picture_uri(sheet(class_picture(stack.astype(np.int64))), exact=True)
    values = stack.astype(np.float64)
    if name.startswith("ortho"):
        low, high = np.percentile(values, (1, 99))
        grey = np.clip((values - low) / max(high - low, 1.0) * 255, 0, 255).astype(np.uint8)
        return picture_uri(sheet(grey))
    values[stack == layer.nodata] = np.nan
    return picture_uri(sheet(relief_picture(values)))
