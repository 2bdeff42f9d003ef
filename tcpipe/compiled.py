"""The one way to compile a numeric kernel: numba, cached on disk, and said aloud when it really compiles.

Compilation takes seconds, once; the listener reports it through the logger ``tcpipe`` so that nobody thinks the program hangs.
A read-only installation without a home directory has no place for numba's cache: a temporary directory is used then.
Numba takes a cached kernel for fresh as long as the kernel's own file is the same, whatever has changed in other modules that it calls:
here it is fresh only if what the file imports is the same, too.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from numbers import Number
from typing import Any, TypeVar

import numba
from numba.core import event
from numba.core.cpu import CPUContext
from numba.core.dispatcher import Dispatcher

logger = logging.getLogger("tcpipe")
_Key = TypeVar("_Key")


class _Announce(event.Listener):  # type: ignore[misc]
    """Says once that kernels are being compiled, when the first one is."""

    def __init__(self) -> None:
        self.said = False

    def on_start(self, event: Any) -> None:
        name = getattr(event.data.get("dispatcher"), "__module__", "")
        if not self.said and str(name).startswith("tcpipe"):
            self.said = True
            logger.info("compiling numeric kernels: some seconds, once; they are cached for later runs")

    def on_end(self, event: Any) -> None:
        """Nothing to say at the end."""


event.register("numba:compile", _Announce())


_BLAS = "scipy.linalg.cython_blas"
_load = CPUContext.load_additional_registries


def _load_without_blas(context: CPUContext) -> None:
    """Load what numba needs, in a process of our own without scipy's linear algebra: it only looks whether that is there, for 0.2 s.

    A kernel that multiplies matrices would be refused. Who uses tcpipe as a library may have such.
    """
    if "tcpipe.cli" not in sys.modules or _BLAS in sys.modules:
        _load(context)
        return
    sys.modules[_BLAS] = None  # type: ignore[assignment]
    try:
        _load(context)
    finally:
        del sys.modules[_BLAS]


CPUContext.load_additional_registries = _load_without_blas


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
        index._source_stamp = _stamp(index._source_stamp, function)  # noqa: SLF001  numba has no public way to say what else there is
        index._load_index = partial(_load_overloads, index._load_index)  # noqa: SLF001
    return compiled


def _load_overloads(load: Callable[[], dict[_Key, str]]) -> dict[_Key, str]:
    """Return the cached overloads of a kernel; none if the cache of an earlier version names a class that no longer exists."""
    try:
        return load()
    except (AttributeError, ImportError):
        return {}


def _stamp(source: bytes, function: Callable[..., Any]) -> str:
    """Return what a cached kernel must have been made of to be used: its file, and all that its module imports and numba compiles in.

    That are numbers and text, kernels (whose own stamp holds what they are made of) and the fields of named tuples. What the module
    defines itself is in its file; so it need not be told apart here.
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
    """Return the index of what numba has cached of a kernel."""
    return compiled._cache._cache_file  # noqa: SLF001


def _is_plain(value: object) -> bool:
    """Whether a value is a number, a text or a tuple of such: what numba compiles in as it is, and what ``repr`` tells wholly."""
    return all(map(_is_plain, value)) if isinstance(value, tuple) else isinstance(value, Number | str)


def _cache_directory(compiled: str = "") -> str:
    """Return a temporary directory that nobody else can write to: numba executes what it finds there.

    It begins with what was ``compiled`` before, in a directory that cannot be written to: numba reads none of such.
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
