"""Pictures inside a page: WebP as data URIs, sheets of many small ones, and grey values made colours."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from tcpipe.report.colours import CLASS_COLOURS

Bytes = NDArray[np.uint8]

ACROSS = 25
"""Patches in one row of a sheet."""

_CIVIDIS = np.array([[0, 34, 78], [65, 77, 107], [124, 123, 120], [188, 175, 111], [254, 232, 56]], np.float64)


def picture_uri(pixels: Bytes, *, exact: bool = False) -> str:
    """Return a picture as a data URI; arguments as of `picture_bytes`."""
    return f"data:image/webp;base64,{base64.b64encode(picture_bytes(pixels, exact=exact)).decode('ascii')}"


def picture_bytes(pixels: Bytes, *, exact: bool = False) -> bytes:
    """Return a picture, grey (R, C) or colour (R, C, 3), as WebP; ``exact`` keeps every pixel as it is."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, format="WEBP", quality=78, lossless=exact, method=4)
    return stream.getvalue()


def read_picture(path: Path) -> Bytes | None:
    """Return a picture in colour, shape (R, C, 3); None where there is none that can be read."""
    try:
        with Image.open(path) as picture:
            return np.asarray(picture.convert("RGB"), np.uint8)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError):
        return None


def sheet(patches: NDArray[np.uint8]) -> Bytes:
    """Return patches (N, px, px) or (N, px, px, 3) side by side, `ACROSS` in a row, the rest black."""
    count, px = patches.shape[:2]
    rows = -(-count // ACROSS)
    room = np.zeros((rows * ACROSS, *patches.shape[1:]), np.uint8)
    room[:count] = patches
    whole = room.reshape(rows, ACROSS, *patches.shape[1:]).swapaxes(1, 2)
    return np.ascontiguousarray(whole.reshape(rows * px, ACROSS * px, *patches.shape[3:]))


def class_picture(ids: NDArray[np.integer]) -> Bytes:
    """Return class ids of any shape as colours, one axis more; 0, no data, is white."""
    table = np.array([_rgb("#ffffff"), *map(_rgb, CLASS_COLOURS)], np.uint8)
    index = np.where(ids > 0, (ids.astype(np.int64) - 1) % len(CLASS_COLOURS) + 1, 0)
    picture: Bytes = table[index]
    return picture


def relief_picture(values: NDArray[np.float64]) -> Bytes:
    """Return each patch (N, px, px) over its own range from dark blue to yellow (cividis), shape (N, px, px, 3); no data is white."""
    known = np.isfinite(values)
    low = np.where(known, values, np.inf).min(axis=(1, 2), keepdims=True)
    high = np.where(known, values, -np.inf).max(axis=(1, 2), keepdims=True)
    share = np.where(known, (values - low) / np.maximum(high - low, 1e-9), 0.0)
    places = np.linspace(0.0, 1.0, len(_CIVIDIS))
    colours = np.stack([np.interp(share, places, _CIVIDIS[:, channel]) for channel in range(3)], axis=-1)
    return np.where(known[..., None], colours, 255.0).astype(np.uint8)


def _rgb(colour: str) -> Sequence[int]:
    return [int(colour[n : n + 2], 16) for n in (1, 3, 5)]
