"""Compilation of numeric kernels by numba, with a cache on disk.

The first compilation takes seconds, so a listener reports it through the logger ``tcpipe``: the program does not hang.
If an installation is read-only and has no home directory, the cache is a temporary directory. Numba compares only the
kernel's own file with its cache; tcpipe also compares what this file imports.
"""

import hashlib
import logging
import os
import shutil
import stat
import tempfile
from collections.abc import Callable
from functools import partial
from numbers import Number
from typing import Any, TypeVar

import numba
from numba.core import event
from numba.core.dispatcher import Dispatcher
from numba.extending import overload
from numba.np import arrayobj

logger = logging.getLogger("tcpipe")
_Key = TypeVar("_Key")
_Shape = tuple[int, ...]


class _Announce(event.Listener):  # type: ignore[misc]
    """Listener that reports the first compilation of a kernel."""

    def __init__(self) -> None:
        self.said = False

    def on_start(self, event: Any) -> None:
        name = getattr(event.data.get("dispatcher"), "__module__", "")
        if not self.said and str(name).startswith("tcpipe"):
            self.said = True
            logger.info("compiling numeric kernels: some seconds, once; they are cached for later runs")

    def on_end(self, event: Any) -> None:
        """Ignore the end of a compilation."""


event.register("numba:compile", _Announce())


def _raise_shape_error(source: _Shape, target: _Shape) -> None:  # noqa: ARG001  numba calls it with both shapes
    """Raise the error of numba for an array that does not fit into a slice, without its text of both shapes.

    To format this text, numba compiles text functions into each kernel that assigns an array: a fifth of the time that
    the filter takes to compile.
    """
    raise ValueError("cannot assign an array to a slice of another shape")


@overload(_raise_shape_error)
def _overload_shape_error(source: _Shape, target: _Shape) -> Callable[[_Shape, _Shape], None]:  # noqa: ARG001
    return _raise_shape_error


arrayobj.raise_with_shape_context = _raise_shape_error


def compile_kernel(function: Callable[..., Any]) -> Any:
    """Compile ``function`` with numba on first call: no Python objects, no GIL, IEEE arithmetic, cached on disk."""
    options = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    try:
        compiled = numba.njit(**options)(function)
    except RuntimeError:  # numba finds no place to write its cache
        numba.config.CACHE_DIR = _cache_directory(numba.config.CACHE_DIR)
        compiled = numba.njit(**options)(function)
    if isinstance(compiled, Dispatcher):  # it is none where NUMBA_DISABLE_JIT is set
        index = _index_of(compiled)
        index._source_stamp = _stamp(index._source_stamp, function)  # noqa: SLF001  numba has no public way for this
        index._load_index = partial(_load_overloads, index._load_index)  # noqa: SLF001
    return compiled


def _load_overloads(load: Callable[[], dict[_Key, str]]) -> dict[_Key, str]:
    """Return the cached overloads of a kernel; none if an old cache names a class that no longer exists."""
    try:
        return load()
    except (AttributeError, ImportError):
        return {}


def _stamp(source: bytes, function: Callable[..., Any]) -> str:
    """Return the checksum of a kernel's inputs: its file, and the imported values that numba compiles into it.

    These values are numbers and text, other kernels (by their own stamps) and the fields of named tuples. Values that
    the module defines are in its file.
    """
    made_of = [repr(source)]
    for name, value in sorted(function.__globals__.items()):
        if isinstance(value, Dispatcher):
            made_of.append(f"{name} {_index_of(value)._source_stamp}")  # noqa: SLF001
        elif not name.startswith("__") and _is_plain(value):
            made_of.append(f"{name} {value!r}")
        else:
            made_of.extend(f"{name} {field}" for field in getattr(value, "_fields", ()))
    return hashlib.sha256("\n".join(made_of).encode()).hexdigest()


def _index_of(compiled: Any) -> Any:
    """Return numba's index of the cached overloads of a kernel."""
    return compiled._cache._cache_file  # noqa: SLF001


def _is_plain(value: object) -> bool:
    """Return whether numba compiles a value as a constant that ``repr`` shows: a number, a text or a tuple of these."""
    return all(map(_is_plain, value)) if isinstance(value, tuple) else isinstance(value, Number | str)


def _cache_directory(compiled: str = "") -> str:
    """Return a temporary directory that only this user can write to, because numba executes its files.

    It begins with a copy of ``compiled``, a cache that cannot be written to, because numba does not read such a cache.
    """
    directory = f"{tempfile.gettempdir()}/tcpipe-kernels-{os.getuid()}"
    if not os.path.lexists(directory):
        new = tempfile.mkdtemp(prefix="tcpipe-kernels-")
        if os.path.isdir(compiled):  # noqa: PTH112
            shutil.copytree(compiled, new, dirs_exist_ok=True, copy_function=shutil.copyfile)
        os.chmod(new, 0o700)  # noqa: PTH101
        try:
            os.rename(new, directory)  # noqa: PTH104
        except OSError:  # another process was first
            shutil.rmtree(new)
    found = os.lstat(directory)
    ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    return directory if ours else tempfile.mkdtemp(prefix="tcpipe-kernels-")
