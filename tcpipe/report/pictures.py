"""Pictures: of patches and maps as WebP inside a page, and quick looks of maps as files."""

import base64
import io
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from PIL import Image, ImageColor, UnidentifiedImageError
from pyproj import Transformer

from tcpipe.arrays import AnyArray, Box, Bytes, Floats, GenericArray, Ints, NamedArrays
from tcpipe.formats.atomic import write_atomic_file
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import find_places_in_files, open_patches
from tcpipe.formats.json_files import Json
from tcpipe.formats.maps.map_files import PICTURE_PX, MapFile
from tcpipe.report.colours import choose_class_colours
from tcpipe.tables.columns import to_floats
from tcpipe.terrain.layers import COLOURS, MAX_ID, ClassTable, Layer, Pixels

ACROSS = 25
"""Patches in one row of a sheet."""

_CIVIDIS = np.array([[0, 34, 78], [65, 77, 107], [124, 123, 120], [188, 175, 111], [254, 232, 56]], float)


def make_picture_uri(pixels: Bytes, *, exact: bool = False) -> str:
    """Return a picture, grey (R, C) or colour (R, C, 3), as a data URI; ``exact`` keeps every pixel unchanged."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, format="WEBP", quality=78, lossless=exact, method=4)
    return f"data:image/webp;base64,{base64.b64encode(stream.getvalue()).decode('ascii')}"


def read_picture(path: Path) -> Bytes | None:
    """Return a picture in colour, shape (R, C, 3); None if it cannot be read."""
    try:
        with Image.open(path) as picture:
            return np.asarray(picture.convert("RGB"), np.uint8)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError):
        return None


def make_sheet(patches: Bytes) -> Bytes:
    """Return patches (N, px, px) or (N, px, px, 3) side by side, `ACROSS` in a row, the rest black."""
    count, px = patches.shape[:2]
    rows = -(-count // ACROSS)
    room = np.zeros((rows * ACROSS, *patches.shape[1:]), np.uint8)
    room[:count] = patches
    whole = room.reshape(rows, ACROSS, *patches.shape[1:]).swapaxes(1, 2)
    return np.ascontiguousarray(whole.reshape(rows * px, ACROSS * px, *patches.shape[3:]))


def colour_classes(ids: GenericArray, classes: ClassTable | None) -> Bytes:
    """Return class ids of any shape as colours, one axis more; 0, no data, is white."""
    table = np.full((MAX_ID + 1, 3), 255, np.uint8)
    for number, colour in choose_class_colours(classes.classes if classes else ()).items():
        table[number] = ImageColor.getrgb(colour)
    picture: Bytes = table[ids.astype(np.int64)]
    return picture


def colour_heights(values: Floats) -> Bytes:
    """Return each patch (N, px, px) over its range from dark blue to yellow, (N, px, px, 3), no data white."""
    known = np.isfinite(values)
    low = np.where(known, values, np.inf).min(axis=(1, 2), keepdims=True)
    high = np.where(known, values, -np.inf).max(axis=(1, 2), keepdims=True)
    share = np.where(known, (values - low) / np.maximum(high - low, 1e-9), 0.0)
    places = np.linspace(0.0, 1.0, len(_CIVIDIS))
    colours = np.stack([np.interp(share, places, _CIVIDIS[:, channel]) for channel in range(3)], axis=-1)
    return np.where(known[..., None], colours, 255.0).astype(np.uint8)


def compute_joint_bounds_m(places: Sequence[tuple[str, Box]]) -> Box:
    """Return the bounds of all maps, each given with its CRS, in the CRS of the first."""
    first = places[0][0]
    projected = [
        bounds if crs == first else Transformer.from_crs(crs, first, always_xy=True).transform_bounds(*bounds)
        for crs, bounds in places
    ]
    low, high = np.min(projected, axis=0), np.max(projected, axis=0)
    return float(low[0]), float(low[1]), float(high[2]), float(high[3])


def draw_ortho(source: MapFile) -> Bytes:
    """Return the orthophoto, in colour (R, C, 3) or grey (R, C), no data in white; a shaded relief without one."""
    if (picture := source.read_picture()) is not None:
        return picture
    if "ortho" not in source.layers:
        return draw_relief(source)
    grey = _thin_layer(*_level(source), "ortho")
    return np.where(grey, grey, 255).astype(np.uint8)


def draw_relief(source: MapFile) -> Bytes:
    """Return a shaded relief, shape (R, C)."""
    level, step = _level(source)
    return shade_heights(_thin_layer(level, step, "height"), step * level.grid.pixel_size_m)


def draw_classes(source: MapFile) -> Bytes:
    """Return the terrain classes in their colours, shape (R, C, 3); white without a terrain layer."""
    level, step = _level(source)
    if "terrain" not in level.layers:
        return np.full((*draw_relief(source).shape, 3), 255, np.uint8)
    return colour_classes(_thin_layer(level, step, "terrain"), level.layers["terrain"].classes)


def draw_maps(sources: Sequence[MapFile], look: Callable[[MapFile], Bytes] = draw_ortho) -> Bytes:
    """Return one picture of all maps over their joint bounds, each by ``look``; the first counts in overlaps."""
    if len(sources) == 1:
        return look(sources[0])
    crs = sources[0].grid.crs
    x_min_m, y_min_m, x_max_m, y_max_m = compute_joint_bounds_m(
        [(source.grid.crs, source.grid.bounds_m) for source in sources]
    )
    step_m = max(x_max_m - x_min_m, y_max_m - y_min_m) / PICTURE_PX
    x_m, y_m = np.meshgrid(
        np.arange(x_min_m + step_m / 2, x_max_m, step_m), np.arange(y_max_m - step_m / 2, y_min_m, -step_m)
    )
    whole = np.full((*x_m.shape, 3), 255, np.uint8)
    for source in reversed(sources):
        picture, (left, bottom, right, top) = look(source), source.grid.bounds_m
        to_map = Transformer.from_crs(crs, source.grid.crs, always_xy=True)
        x, y = (x_m, y_m) if source.grid.crs == crs else to_map.transform(x_m, y_m)
        col = np.floor((x - left) / (right - left) * picture.shape[1]).astype(np.int64)
        row = np.floor((top - y) / (top - bottom) * picture.shape[0]).astype(np.int64)
        inside = (col >= 0) & (col < picture.shape[1]) & (row >= 0) & (row < picture.shape[0])
        pixels = picture[row[inside], col[inside]]
        whole[inside] = pixels if picture.ndim == 3 else pixels[:, None]
    return whole


def _level(source: MapFile) -> tuple[MapFile, int]:
    """Return the coarsest level that is still large enough, and which of its pixels to take."""
    longer = max(source.grid.rows, source.grid.cols)
    factor = max(factor for factor in source.factors if factor == 1 or longer // factor >= PICTURE_PX)
    return source.at(factor), max(1, -(-(longer // factor) // PICTURE_PX))


def _thin_layer(level: MapFile, step: int, layer: str) -> Pixels:
    """Return every ``step``-th pixel of a layer."""
    side = max(step, level.tile_px * 4 // step * step)
    rows, cols = level.grid.rows, level.grid.cols
    blocks = [
        [
            level.read(layer, i, min(i + side, rows), j, min(j + side, cols))[::step, ::step]
            for j in range(0, cols, side)
        ]
        for i in range(0, rows, side)
    ]
    return np.block(blocks)


def shade_heights(height_m: GenericArray, pixel_size_m: float) -> Bytes:
    """Return Lambert shading of a height field lit from the north-west, 45° above the horizon; no data is white."""
    down, right = np.gradient(height_m.astype(float), pixel_size_m)
    light = (1.0 + right / np.sqrt(2.0) + down / np.sqrt(2.0)) / np.sqrt(2.0 * (1.0 + right**2 + down**2))
    return np.where(np.isfinite(light), np.clip(light, 0.0, 1.0) * 255, 255).astype(np.uint8)


_PLAIN_PNG: dict[str, Any] = {"Software": None}


def write_overview(path: Path, picture: Bytes) -> None:
    """Write a picture, grey (R, C) or colour (R, C, 3), as PNG; the same picture gives the same bytes."""
    from matplotlib.image import imsave  # noqa: PLC0415  a page of a store needs no picture

    with write_atomic_file(path) as temporary:
        imsave(temporary, picture, format="png", cmap="gray", vmin=0, vmax=255, metadata=_PLAIN_PNG)


MOST_PATCHES = 500
_PX = 48  # side of a patch in the page; larger ones are thinned

_MOST_PIECES = 24
"""Pieces of the files that are read: the order of patches is random, so a few pieces contain all kinds."""


def make_patches_data(directory: Path, card: DatasetCard, samples: pa.Table, count: int) -> Json:
    """Return sheets of patches by layer and the samples that they belong to, all among the first ``count``.

    `DatasetError` if they cannot be read.
    """
    if not samples.num_rows:
        return None
    files, step = open_patches(directory, card), -(-card.patch_px // _PX)
    place = find_places_in_files(card, samples.column("split").to_numpy(zero_copy_only=False))
    piece = np.searchsorted(files.starts, place, side="right") - 1
    rows, stacks, layers = _select_rows(samples.slice(0, count), piece[:count]), dict[str, AnyArray](), list[Json]()
    for number in np.unique(piece[rows]).tolist():
        here = np.flatnonzero(piece[rows] == number)
        for layer, pixels in files.read(number, list(files.layers)).items():
            thin = pixels[place[rows[here]] - files.starts[number], ::step, ::step]
            stacks.setdefault(layer, np.empty((len(rows), *thin.shape[1:]), thin.dtype))[here] = thin
    for name, stack in _join_colours(stacks).items():
        sheet, exact = _make_sheet(stack, files.layers[name])
        layers.append({"name": name, "uri": make_picture_uri(sheet, exact=exact)})
    return {"rows": rows.tolist(), "px": next(iter(stacks.values())).shape[1], "across": ACROSS, "layers": layers}


def _select_rows(samples: pa.Table, piece: Ints) -> Ints:
    """Return up to `MOST_PATCHES` rows, rising, in turn from each split, class and 5° of slope: always the same.

    ``piece`` is that of each sample's patch, shape (N,).
    """
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


def _join_colours(pixels: NamedArrays) -> NamedArrays:
    """Return one orthophoto in colour, (N, px, px, 3), in the place of its grey and its three colours."""
    if not set(COLOURS) <= set(pixels):
        return pixels
    colour = np.stack([pixels[name] for name in COLOURS], axis=-1)
    return {name: colour if name == "ortho" else stack for name, stack in pixels.items() if name not in COLOURS}


def _make_sheet(stack: GenericArray, layer: Layer) -> tuple[Bytes, bool]:
    """Return patches of a layer as one sheet, and whether all pixels count; a photograph over 98 % of its values."""
    if layer.kind == "categorical":
        return make_sheet(colour_classes(stack, layer.classes)), True
    values = stack.astype(float)
    if layer.stack == "greys":
        low, high = np.percentile(values, (1, 99))
        return make_sheet(np.clip((values - low) / max(high - low, 1.0) * 255, 0, 255).astype(np.uint8)), False
    values[stack == layer.nodata] = np.nan
    return make_sheet(colour_heights(values)), False
