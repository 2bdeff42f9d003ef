"""Geometry as columns of well-known binary (OGC 06-103r4), little-endian, two dimensions: what GeoParquet holds."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

_POINT, _LINE_STRING = 1, 2
_LITTLE_ENDIAN = 1


def make_lines(start_deg: NDArray[np.float64], end_deg: NDArray[np.float64]) -> pa.Array:
    """Return the straight lines between points x, y, shape (N, 2) each, as LineStrings; null where an end is not known (NaN)."""
    ends = np.unwrap(np.stack([start_deg, end_deg], axis=1), axis=1, period=360.0)  # short on the date line too
    rows = np.zeros(len(ends), [("order", "u1"), ("kind", "<u4"), ("points", "<u4"), ("xy", "<f8", (2, 2))])
    rows["order"], rows["kind"], rows["points"], rows["xy"] = _LITTLE_ENDIAN, _LINE_STRING, 2, ends
    return _make_column(rows)


def make_points(xy_deg: NDArray[np.float64]) -> pa.Array:
    """Return points x, y, shape (N, 2), as Points; null where one is not known (NaN)."""
    rows = np.zeros(len(xy_deg), [("order", "u1"), ("kind", "<u4"), ("xy", "<f8", (2,))])
    rows["order"], rows["kind"], rows["xy"] = _LITTLE_ENDIAN, _POINT, xy_deg
    return _make_column(rows)


def _make_column(rows: NDArray[np.void]) -> pa.Array:
    """Return records of one size as a binary column."""
    known = np.isfinite(rows["xy"]).all(axis=tuple(range(1, rows["xy"].ndim)))
    ends = np.concatenate([[0], np.cumsum(known * rows.itemsize)]).astype(np.int32)
    valid = pa.py_buffer(np.packbits(known, bitorder="little"))
    return pa.Array.from_buffers(
        pa.binary(), len(rows), [valid, pa.py_buffer(ends), pa.py_buffer(rows[known].tobytes())]
    )
