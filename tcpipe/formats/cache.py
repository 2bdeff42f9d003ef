"""A cache of limited size on this machine: tcpipe fetches an object from a bucket only once.

A key determines the content (a sha256; an object's version and a range of it), so no file here is ever outdated. The
cache is the directory ``TCPIPE_CACHE``, else one in the user's cache directory. Above ``TCPIPE_CACHE_BYTES`` (8 GB) it
removes the least recently used files.
"""

import hashlib
import os
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from tcpipe.errors import StoreError, UsageError

_MOST_BYTES = 8_000_000_000
# Fraction of the limit that a process may exceed before it scans the whole cache again, which takes time [1].
_SHARE_UNSEEN = 64
# Bytes that this process has added since it last listed the cache; infinite before the first list.
_unseen_bytes = [float("inf")]
_IN_USE_S = 60.0  # A file that was used within this time stays: another process may be about to open it


def fetch_cached(key: str, fetch: Callable[[Path], object]) -> Path:
    """Return the file of a key; ``fetch`` writes it if it does not exist. `StoreError`: the cache cannot be written."""
    path = _find_cache_path(key)
    if _is_there(path):
        return path
    temporary = path.with_name(f"{path.name}-{os.getpid()}-{threading.get_ident()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fetch(temporary)
        put = temporary.stat()
        # Not synced: readers compare checksums. Files of killed processes are removed as least recently used files.
        temporary.replace(path)
    except OSError as error:
        message = f"{path}: cannot be written ({error.strerror or error}); set TCPIPE_CACHE to use another directory for downloads"
        raise StoreError(message) from error
    finally:
        with suppress(OSError):
            temporary.unlink()
    _unseen_bytes[0] += put.st_size
    if _unseen_bytes[0] * _SHARE_UNSEEN > (most := _read_cache_limit()):
        _make_room(path.parent.parent, most, now=put.st_mtime)
        _unseen_bytes[0] = 0
    return path


def is_cached(key: str) -> bool:
    """Return whether there is a file of a key; it counts as used now."""
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
    if base.is_absolute() and os.access(
        next(directory for directory in (base, *base.parents) if directory.exists()), os.W_OK
    ):
        return base / "tcpipe"
    return Path(tempfile.gettempdir()) / f"tcpipe-cache-{os.getuid()}"


def _read_cache_limit() -> int:
    given = os.environ.get("TCPIPE_CACHE_BYTES", str(_MOST_BYTES))
    if not given.isdecimal():
        raise UsageError(f"TCPIPE_CACHE_BYTES is {given!r}, expected a number of bytes")
    return int(given)


def _make_room(directory: Path, most: int, *, now: float) -> None:
    """Remove the least recently used files until the size is below the limit."""
    files = []
    for path in directory.glob("??/*"):
        with suppress(OSError):
            status = path.stat()
            files.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in files)
    for used, size, path in sorted(files):
        if total <= most or now - used < _IN_USE_S:
            return
        path.unlink(missing_ok=True)
        total -= size
