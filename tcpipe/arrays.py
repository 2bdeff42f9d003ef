"""Types of arrays, by their elements, and of bounds."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

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
