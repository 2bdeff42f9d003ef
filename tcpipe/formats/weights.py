"""Files of many arrays with names, the weights of a network: NumPy's ``.npz``, the same arrays as the same bytes."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import ModelError
from tcpipe.formats.atomic import write_atomic_file

ArrayForm = tuple[str, tuple[int | str, ...]]
"""Type and shape of an array; a name stands for any length, and for the same one wherever it stands."""


def write_arrays(path: Path, arrays: Mapping[str, NDArray[np.generic]]) -> None:
    """Write the arrays, whole or not at all."""
    with write_atomic_file(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **dict(arrays))


def read_arrays(
    path: Path, forms: Mapping[str, ArrayForm] | None = None, *, optional: Collection[str] = ()
) -> dict[str, NDArray[np.generic]]:
    """Return what `write_arrays` wrote. No array is read before every header agrees with the file's size, and with what is wanted.

    Parameters
    ----------
    path : the file.
    forms : by name, what must be there and nothing else; None: any arrays.
    optional : names of forms that may be missing.

    Raises
    ------
    ModelError : the file is cut short, damaged, none of its kind, or holds arrays of other names, types or shapes.
    """
    if path.is_file() and not zipfile.is_zipfile(path):
        raise ModelError(f"{path}: cut short or damaged (no end of an archive in it)")
    try:
        with path.open("rb") as stream:
            found = _read_headers(stream, path.stat().st_size)
            if forms is not None and (wrong := _find_wrong_form(found, forms, optional)):
                raise ModelError(f"{path}: contains the weights of another model: {wrong}; train the model again")
            with np.load(stream, allow_pickle=False) as held:
                return {name: held[name] for name in held.files}
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
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise ModelError(f"{path}: cut short or damaged ({error})") from None


def _read_headers(stream: BinaryIO, size: int) -> dict[str, ArrayForm]:
    """Return what an archive's arrays say that they are; `ValueError` where they claim more bytes than the file has."""
    found: dict[str, ArrayForm] = {}
    with zipfile.ZipFile(stream) as archive:
        members = archive.infolist()
        if any(of.compress_type != zipfile.ZIP_STORED for of in members) or sum(of.file_size for of in members) > size:
            raise ValueError("compressed, or larger than the file; expected plain arrays")
        for member in members:
            with archive.open(member) as array:
                read_header = _READERS.get(np.lib.format.read_magic(array))
                if read_header is None or not member.filename.endswith(".npy"):
                    raise ValueError(f"{member.filename[:80]!r} is no array")
                shape, _, dtype = read_header(array)
                if dtype.hasobject or min(shape, default=0) < 0:
                    raise ValueError(f"{member.filename[:80]!r} contains no numbers")
                if array.tell() + dtype.itemsize * math.prod(shape) != member.file_size:
                    raise ValueError(f"{member.filename[:80]!r} claims {shape} of {dtype}, which its bytes are not")
            found[member.filename.removesuffix(".npy")] = dtype.name, shape
    if len(found) != len(members):
        raise ValueError("two arrays of one name")
    stream.seek(0)
    return found


_READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def _find_wrong_form(
    found: Mapping[str, ArrayForm], forms: Mapping[str, ArrayForm], optional: Collection[str]
) -> str | None:
    """Return in words the first array that is not as it is wanted; None where all are."""
    if missing := forms.keys() - found.keys() - set(optional):
        return f"{min(missing)} is missing"
    lengths: dict[str, int] = {}
    for name, (dtype, shape) in found.items():
        if name not in forms:
            return f"{name[:80]!r} is not of it"
        wanted = forms[name]
        for of, length in zip(wanted[1], shape, strict=False):
            if isinstance(of, str) and isinstance(length, int):
                lengths.setdefault(of, length)
        bound = tuple(lengths.get(of, of) if isinstance(of, str) else of for of in wanted[1])
        if (dtype, shape) != (wanted[0], bound):
            return f"{name} is {shape} of {dtype}, expected {bound} of {wanted[0]}"
    return None
