"""Files of many arrays with names, the weights of a network: NumPy's ``.npz``, the same arrays as the same bytes."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import ModelError
from tcpipe.formats.atomic import atomic_file


def write_arrays(path: Path, arrays: Mapping[str, NDArray[np.generic]]) -> None:
    """Write the arrays, whole or not at all."""
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **dict(arrays))


def read_arrays(path: Path) -> dict[str, NDArray[np.generic]]:
    """Return what `write_arrays` wrote. `ModelError`: the file is cut short, damaged, or none of its kind."""
    if path.is_file() and not zipfile.is_zipfile(path):
        raise ModelError(f"{path}: cut short or damaged (no end of an archive in it)")
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as found:
            return {name: found[name] for name in found.files}
    except FileNotFoundError:
        raise ModelError(f"{path}: there is no such file") from None
    except (
        OSError,
        ValueError,
        TypeError,
        EOFError,
        KeyError,
        AttributeError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise ModelError(f"{path}: cut short or damaged ({error})") from None
