"""A bounded cache of this machine, by content: what was fetched from a bucket once is not fetched again.

A key names its content for good (a sha256; an object's version and a range of it), so that nothing in here can be outdated. It lies in
``TCPIPE_CACHE``, else the user's cache directory, and holds at most ``TCPIPE_CACHE_BYTES`` (8 GB): what was not used for longest goes.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from tcpipe.errors import StoreError, UsageError

_MOST_BYTES = 8_000_000_000
_SHARE_UNSEEN = 64
"""The cache may be larger than its bound by one part in so many: looking at all of its files takes time."""
_unseen_bytes = [float("inf")]
"""What this process has put there since it last looked."""
_IN_USE_S = 60.0
"""What was used so lately stays: another process may be about to open it."""


def fetch_cached(key: str, fetch: Callable[[Path], object]) -> Path:
    """Return the file of a key; where there is none, ``fetch`` writes it. `StoreError`: the cache cannot be written."""
    path = _find_cache_path(key)
    if _is_there(path):
        return path
    temporary = path.with_name(f"{path.name}-{os.getpid()}-{threading.get_ident()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fetch(temporary)
        put = temporary.stat()
        # Nothing is synced, and what a killed process leaves goes in its turn: whoever reads it proves it.
        temporary.replace(path)
    except OSError as error:
        told = f"{path}: cannot be written ({error.strerror or error}); TCPIPE_CACHE names another place for what is fetched"
        raise StoreError(told) from error
    finally:
        with suppress(OSError):
            temporary.unlink()
    _unseen_bytes[0] += put.st_size
    if _unseen_bytes[0] * _SHARE_UNSEEN > (most := _read_cache_limit()):
        _make_room(path.parent.parent, most, now=put.st_mtime)
        _unseen_bytes[0] = 0
    return path


def is_cached(key: str) -> bool:
    """Tell whether there is a file of a key, which then stays for a while."""
    return _is_there(_find_cache_path(key))


def _is_there(path: Path) -> bool:
    with suppress(FileNotFoundError, NotADirectoryError):
        os.utime(path)
        return True
    return False


def _find_cache_path(key: str) -> Path:
    digest = hashlib.sha256(key.encode()).hexdigest()
    return _find_cache_directory() / digest[:2] / digest


def _find_cache_directory() -> Path:
    if given := os.environ.get("TCPIPE_CACHE"):
        return Path(given)
    base = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))  # noqa: PTH111  also without a home
    if base.is_absolute() and os.access(next(of for of in (base, *base.parents) if of.exists()), os.W_OK):
        return base / "tcpipe"
    return Path(tempfile.gettempdir()) / f"tcpipe-cache-{os.getuid()}"


def _read_cache_limit() -> int:
    given = os.environ.get("TCPIPE_CACHE_BYTES", str(_MOST_BYTES))
    if not given.isdecimal():
        raise UsageError(f"TCPIPE_CACHE_BYTES is {given!r}, expected a number of bytes")
    return int(given)


def _make_room(directory: Path, most: int, *, now: float) -> None:
    """Remove what was not used for longest until the bound holds."""
    files = []
    for path in directory.glob("??/*"):
        with suppress(OSError):
            seen = path.stat()
            files.append((seen.st_mtime, seen.st_size, path))
    total = sum(size for _, size, _ in files)
    for used, size, path in sorted(files):
        if total <= most or now - used < _IN_USE_S:
            return
        path.unlink(missing_ok=True)
        total -= size
