"""The one way to compile a numeric kernel: numba, cached on disk, and said aloud when it really compiles.

Compilation takes seconds, once; the listener reports it through the logger ``tcpipe`` so that nobody thinks the program hangs.
A read-only installation without a home directory has no place for numba's cache: a temporary directory is used then.
"""

from __future__ import annotations

import logging
import os
import stat
import tempfile
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numba
from numba.core import event

logger = logging.getLogger("tcpipe")


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


def kernel(function: Callable[..., Any]) -> Any:
    """Compile ``function`` with numba on first call: no Python objects, no GIL, IEEE arithmetic, cached on disk."""
    options = {"cache": True, "nogil": True, "error_model": "numpy"}
    try:
        return numba.njit(**options)(function)
    except RuntimeError:  # numba finds no place to write its cache
        numba.config.CACHE_DIR = _cache_directory()
        return numba.njit(**options)(function)


def _cache_directory() -> str:
    """Return a temporary directory that nobody else can write to: numba executes what it finds there."""
    directory = f"{tempfile.gettempdir()}/tcpipe-kernels-{os.getuid()}"
    with suppress(FileExistsError):
        os.mkdir(directory, mode=0o700)  # noqa: PTH102  stages reach no pathlib
    found = os.lstat(directory)
    ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    return directory if ours else tempfile.mkdtemp(prefix="tcpipe-kernels-")
