"""Patches on a dataset's page: some hundred of every split, class and slope inside it, and all of them in a folder beside it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import PatchFiles, find_places_in_files, open_patches, read_samples
from tcpipe.formats.json_files import Json
from tcpipe.formats.published_outputs import REPORT_PATCHES
from tcpipe.report.pictures import ACROSS, colour_classes, colour_heights, encode_picture, make_picture_uri, make_sheet
from tcpipe.tables.columns import to_floats
from tcpipe.terrain.layers import COLOURS

MOST_PATCHES = 500
_PX = 48
"""Side of a patch in the page; larger ones are thinned."""

_MOST_PIECES = 24
"""Pieces of the files that are read: the order of patches is random, so a few pieces contain all kinds."""

PER_SHEET = 10 * ACROSS
"""Patches in a picture of that folder."""


@dataclass(frozen=True, slots=True)
class _Patches:
    """Patches of a dataset; for each sample its place in the files and the piece of it, (T,); ``step`` thins the pixels."""

    files: PatchFiles
    place: NDArray[np.int64]
    piece: NDArray[np.int64]
    step: int

    def read(self, rows: NDArray[np.int64]) -> Mapping[str, NDArray[Any]]:
        """Return thinned patches of these rows by layer, (N, px, px), or (N, px, px, 3) of an orthophoto in colour."""
        place, piece = self.place[rows], self.piece[rows]
        layers = [name for name, layer in self.files.layers.items() if not layer.bands]  # no picture of an embedding
        stacks: dict[str, list[NDArray[np.generic]]] = {layer: [] for layer in layers}
        order = np.argsort(piece, kind="stable")
        for number in np.unique(piece).tolist():
            pixels = self.files.read(number, layers)
            indices = place[order][piece[order] == number] - self.files.starts[number]
            for layer in layers:
                stacks[layer].append(pixels[layer][indices][:, :: self.step, :: self.step])
        back = np.argsort(order, kind="stable")
        return _join_colours({layer: np.concatenate(parts)[back] for layer, parts in stacks.items()})

    def select(self, samples: pa.Table) -> NDArray[np.int64]:
        """Return up to `MOST_PATCHES` rows, rising, taken in turn from each split, class and 5° of slope: always the same ones.

        ``samples`` are the first ones of the dataset.
        """
        piece = self.piece[: samples.num_rows]
        pieces = np.unique(piece)
        pieces = pieces[np.unique(np.linspace(0, len(pieces) - 1, _MOST_PIECES).astype(int))]
        rows = np.flatnonzero(np.isin(piece, pieces))
        near = samples.take(rows)
        slope = np.floor(np.degrees(to_floats(near, "slope_rad")) / 5.0).tolist()
        names = (near.column(name).to_pylist() for name in ("split", "terrain_name"))
        turns = Counter[object]()
        order = []
        for row, key in zip(rows.tolist(), zip(*names, slope, strict=True), strict=True):
            turns[key] += 1
            order.append((turns[key], row))
        return np.sort(np.array([row for _, row in sorted(order)[:MOST_PATCHES]], np.int64))


def _open_patches(directory: Path, card: DatasetCard, samples: pa.Table) -> _Patches:
    files = open_patches(directory, card)
    splits = samples.column("split").to_numpy(zero_copy_only=False)
    place = find_places_in_files(card, splits)
    piece = np.searchsorted(files.starts, place, side="right") - 1
    return _Patches(files, place, piece, choose_thinning(card.patch_px))


def make_patches_data(directory: Path, card: DatasetCard, samples: pa.Table, count: int) -> Json:
    """Return sheets of patches by layer and the samples that they belong to, all among the first ``count``.

    `DatasetError` if they cannot be read.
    """
    if not samples.num_rows:
        return None
    patches = _open_patches(directory, card, samples)
    rows = patches.select(samples.slice(0, count))
    return make_sheets(rows.tolist(), patches.read(rows), patches.files)


def choose_thinning(patch_px: int) -> int:
    """Return the step in which pixels of a patch are shown."""
    return -(-patch_px // _PX)


def make_sheets(rows: Sequence[int], pixels: Mapping[str, NDArray[Any]], files: PatchFiles) -> Json:
    """Return thinned patches, (N, px, px) by layer, as a sheet for each layer, and the rows of the page that they belong to."""
    layers: list[Json] = []
    for name, stack in _join_colours(pixels).items():
        sheet, exact = _make_sheet(name, stack, files, _find_range(stack))
        layers.append({"name": name, "uri": make_picture_uri(sheet, exact=exact)})
    return {"rows": rows, "px": next(iter(pixels.values())).shape[1], "across": ACROSS, "layers": layers}


def _join_colours(pixels: Mapping[str, NDArray[Any]]) -> Mapping[str, NDArray[Any]]:
    """Return one orthophoto in colour, (N, px, px, 3), in the place of its grey and its three colours."""
    if not set(COLOURS) <= set(pixels):
        return pixels
    colour = np.stack([pixels[name] for name in COLOURS], axis=-1)
    return {name: colour if name == "ortho" else stack for name, stack in pixels.items() if name not in COLOURS}


def find_picture_folder(card: DatasetCard) -> tuple[str, int]:
    """Return the folder of the pictures of all patches, relative to the page, and their number."""
    shown = sum("bands" not in layer for layer in card.layers.values())
    layers = shown - (len(COLOURS) if set(COLOURS) <= set(card.layers) else 0)
    return f"{REPORT_PATCHES}/{card.inputs[:16]}", layers * -(-card.samples // PER_SHEET)


def iterate_pictures(directory: Path, card: DatasetCard) -> Iterator[tuple[str, bytes]]:
    """Yield file name and content of the pictures of all patches, in the order of the samples.

    Raises `DatasetError`: they cannot be read.
    """
    samples = read_samples(directory, ("split", "terrain_name", "slope_rad"))
    patches = _open_patches(directory, card, samples)
    selected = patches.read(patches.select(samples)) if samples.num_rows else {}
    ranges = {name: _find_range(stack) for name, stack in selected.items()}
    for number, first in enumerate(range(0, samples.num_rows, PER_SHEET)):
        stacks = patches.read(np.arange(first, min(first + PER_SHEET, samples.num_rows)))
        for layer, (name, stack) in enumerate(stacks.items()):
            pixels, exact = _make_sheet(name, stack, patches.files, ranges[name])
            yield f"{layer}-{number}.webp", encode_picture(pixels, exact=exact)


def _find_range(stack: NDArray[np.generic]) -> tuple[float, float]:
    """Return the range that contains most pixels."""
    low, high = np.percentile(stack.astype(np.float64), (1, 99))
    return float(low), float(high)


def _make_sheet(
    name: str, stack: NDArray[np.generic], files: PatchFiles, shown: tuple[float, float]
) -> tuple[NDArray[np.uint8], bool]:
    """Return patches of a layer as one sheet, and whether every pixel counts; a photograph is shown over a range of its values."""
    layer = files.layers[name]
    if layer.kind == "categorical":
        return make_sheet(colour_classes(stack.astype(np.int64))), True
    values = stack.astype(np.float64)
    if name.startswith("ortho"):
        low, high = shown
        return make_sheet(np.clip((values - low) / max(high - low, 1.0) * 255, 0, 255).astype(np.uint8)), False
    values[stack == layer.nodata] = np.nan
    return make_sheet(colour_heights(values)), False
