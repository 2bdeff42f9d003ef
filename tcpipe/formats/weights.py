"""Files of many arrays with names, the weights of a network: NumPy's ``.npz``, the same arrays as the same bytes."""

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tcpipe.arrays import GenericArray, NamedArrays
from tcpipe.errors import ModelError
from tcpipe.formats.atomic import write_atomic_file

ArrayForm = tuple[str, tuple[int | str, ...]]
"""Type and shape of an array; a name means any length, the same at all its occurrences."""


def write_arrays(path: Path, arrays: NamedArrays) -> None:
    """Write the arrays, whole or not at all."""
    with write_atomic_file(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **dict(arrays))


def read_arrays(path: Path) -> dict[str, GenericArray]:
    """Return the arrays of a file of `write_arrays`; `ModelError` if it is damaged or another kind of file."""
    try:
        _require_plain_arrays(path)
        with np.load(path, allow_pickle=False) as held:
            return {name: np.asarray(held[name]) for name in held.files}
    except FileNotFoundError:
        raise ModelError(f"{path}: there is no such file") from None
    except (
        OSError,
        ValueError,
        TypeError,
        EOFError,
        KeyError,
        AttributeError,
        RuntimeError,
        MemoryError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise ModelError(f"{path}: truncated or damaged ({error})") from None


def _require_plain_arrays(path: Path) -> None:
    """Raise `ValueError` where an archive unfolds to more bytes than it has."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
    is_plain = all(member.compress_type == zipfile.ZIP_STORED for member in members)
    if not is_plain or sum(member.file_size for member in members) > path.stat().st_size:
        raise ValueError("compressed, or larger than the file; expected plain arrays")


def check_arrays(arrays: NamedArrays, forms: Mapping[str, ArrayForm]) -> None:
    """Raise `ModelError` unless arrays have these names, types and shapes."""
    if wrong := _find_wrong_form({name: (array.dtype.name, array.shape) for name, array in arrays.items()}, forms):
        raise ModelError(f"contains the weights of another model: {wrong}; train the model again")


def _find_wrong_form(found: Mapping[str, ArrayForm], forms: Mapping[str, ArrayForm]) -> str | None:
    """Return a description of the first array that differs from the expected one; None if all agree."""
    if missing := forms.keys() - found.keys():
        return f"{min(missing)} is missing"
    lengths: dict[str, int] = {}
    for name, (dtype, shape) in found.items():
        if name not in forms:
            return f"{name[:80]!r} is not of it"
        wanted = forms[name]
        for axis, length in zip(wanted[1], shape, strict=False):
            if isinstance(axis, str) and isinstance(length, int):
                lengths.setdefault(axis, length)
        bound = tuple(lengths.get(axis, axis) if isinstance(axis, str) else axis for axis in wanted[1])
        if (dtype, shape) != (wanted[0], bound):
            return f"{name} is {shape} of {dtype}, expected {bound} of {wanted[0]}"
    return None
