"""Types of arrays, by their elements, and of bounds; running sums and numbers."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = NDArray[np.float64]
Floats32: TypeAlias = NDArray[np.float32]
Ints: TypeAlias = NDArray[np.int64]
Mask: TypeAlias = NDArray[np.bool_]
Bytes: TypeAlias = NDArray[np.uint8]
AnyInts: TypeAlias = NDArray[np.integer]
Texts: TypeAlias = NDArray[np.str_]
GenericArray: TypeAlias = NDArray[np.generic]
AnyArray: TypeAlias = NDArray[Any]
NamedArrays: TypeAlias = Mapping[str, AnyArray]
Columns: TypeAlias = NamedArrays
"""Arrays of one length, by the names of a table's columns."""
Box: TypeAlias = tuple[float, float, float, float]
"""Least x and y, greatest x and y."""


def accumulate(steps: ArrayLike) -> Floats:
    """Return the sum of all steps before each, and of all, shape (N + 1,)."""
    return np.concatenate(([0.0], np.cumsum(steps)))


def count_before(mask: Mask) -> Ints:
    """Return how many entries are true before each, and in all, shape (N + 1,)."""
    return np.concatenate(([0], np.cumsum(mask)))


def number_within(counts: Ints) -> Ints:
    """Return the numbers 0, 1, … inside each of several groups that follow one another, shape (sum of counts,)."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


def gather_values(buffer: bytes | memoryview | Bytes, offsets: Ints, dtype: np.dtype[np.generic]) -> AnyArray:
    """Return the values of a type at bytes of a buffer, of any alignment; the caller has checked the bounds."""
    count = max(len(buffer) - dtype.itemsize + 1, 0)
    windows: AnyArray = np.ndarray((count,), f"V{dtype.itemsize}", buffer if count else b"", 0, (1,))
    return windows[offsets].view(dtype)
