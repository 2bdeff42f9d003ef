"""Columns of numbers inside a page, small: quantised where that changes no digit that is shown, deflated, in base64.

=========  ======================================================================================
kind       what a reader gets
=========  ======================================================================================
``u8``     whole numbers to 255; ``u16`` to 65 535; ``u32`` to 4 294 967 295
``f32``    a float32
``half``   the upper 16 bits of a float32, rounded: to 0.4 %, for slopes and deviations
``text``   texts, as JSON
``steps``  ``low + step * number`` over the column's range in 65 534 steps, for coordinates and labels
=========  ======================================================================================

NaN stays NaN; among ``steps`` it is 65 535. ``page.js`` reads it.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import clean_line
from tcpipe.formats.json_files import Json

Kind = Literal["u8", "u16", "u32", "f32", "half", "steps", "text"]
Column = tuple[Kind, NDArray[np.generic]]

_WHOLE = {"u8": "<u1", "u16": "<u2", "u32": "<u4"}


def pack_columns(columns: Mapping[str, Column]) -> Json:
    """Return columns by name, each of shape (N,), as JSON."""
    described: list[Json] = []
    blob = bytearray()
    for name, (kind, values) in columns.items():
        low, step = _scale(values) if kind == "steps" else (0.0, 1.0)
        data = _to_bytes(kind, values, low, step)
        described.append({"name": name, "kind": kind, "at": len(blob), "bytes": len(data), "low": low, "step": step})
        blob += data
    return {"columns": described, "data": base64.b64encode(zlib.compress(bytes(blob), 6)).decode("ascii")}


def make_shown_column(digits: int, values: NDArray[np.float64]) -> Column:
    """Return a column that is shown with so many decimals: in steps where these are finer than half of the last one."""
    return ("steps" if _scale(values)[1] < 0.5 * 10.0**-digits else "f32"), values


def _scale(values: NDArray[np.generic]) -> tuple[float, float]:
    numbers = values.astype(np.float64)
    known = numbers[np.isfinite(numbers)]
    return (float(known.min()), (float(known.max()) - float(known.min())) / 65534 or 1.0) if len(known) else (0.0, 1.0)


def _to_bytes(kind: Kind, values: NDArray[np.generic], low: float, step: float) -> bytes:
    if kind == "text":
        return json.dumps([clean_line(str(value)) for value in values.tolist()]).encode()
    if kind in _WHOLE:
        return values.astype(_WHOLE[kind]).tobytes()
    if kind == "steps":
        steps = np.round((values.astype(np.float64) - low) / step)
        return np.where(np.isfinite(steps), steps, 65535).astype("<u2").tobytes()
    bits = values.astype("<f4").view("<u4")
    if kind == "half":
        upper = np.where(np.isnan(values.astype(np.float64)), 0x7FC0, (bits.astype(np.uint64) + 0x8000) >> 16)
        return upper.astype("<u2").tobytes()
    return (bits >> 16).astype("<u2").tobytes() + (bits & 0xFFFF).astype("<u2").tobytes()
