"""Which failures may pass by themselves: a disk that is full, a network that is down, too little memory; not what a log's content is."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator

from tcpipe.errors import StoreError

_PASSING_SQLITE = {
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_NOMEM,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_PERM,
}
_PRIMARY_CODE = 0xFF


def is_transient(error: BaseException) -> bool:
    """Tell whether an error, or what it was raised from, may be gone when the same is tried again."""
    return any(_is_transient(cause) for cause in _iterate_causes(error))


def _iterate_causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _is_transient(error: BaseException) -> bool:
    if isinstance(error, MemoryError | StoreError | ImportError):
        return True
    if isinstance(error, OSError):  # decompressors raise it, too, without a number
        return error.errno is not None
    if isinstance(error, sqlite3.Error):
        return getattr(error, "sqlite_errorcode", 0) & _PRIMARY_CODE in _PASSING_SQLITE
    # The network, credentials; its home loads it when it is needed.
    return type(error).__module__.partition(".")[0] == "obstore"
