"""Write outputs atomically: under a temporary name in the same directory, synced, then renamed.

A temporary is in a *holder* beside its place, ``.tmp-<name of the place>-<8 hex>``, which its writer locks. An unlocked
holder is that of a killed process. Each writer into a directory first clears it (`clear`): an output that was moved
aside returns, all other temporaries are removed.

This module also checks paths of users: inputs must exist, outputs must be on this machine (else exit code 2).
"""

import atexit
import ctypes
import errno
import fcntl
import os
import re
import shutil
import stat
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeAlias

from tcpipe.errors import StoreError, UsageError

Location: TypeAlias = str | Path
"""A path of this machine, or the URL of an object or a prefix."""

TEMPORARY_PREFIX = ".tmp-"
"""Prefix of the names of temporaries; readers skip them."""

_HOLDER = re.compile(re.escape(TEMPORARY_PREFIX) + r"(.+)-[0-9a-f]{8}", re.DOTALL)
_LONGEST_NAME = 200  # bytes of a place's name in that of its holder

# Name in a holder of the earlier directory, if the system cannot exchange two directories in one step.
_BEFORE = ".before"

# Errors that only writing can cause, for any file name.
_UNWRITABLE = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG}

_LAST_WRITE_S = 0.05  # after a signal, a thread of zarr may need this long to finish its current file [s]

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2


def make_unique_name() -> str:
    """Return 16 random hexadecimal digits, for the name of a new folder."""
    return uuid.uuid4().hex[:16]


@contextmanager
def write_atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path; on success it is synced and renamed to ``path``, on failure removed."""
    with _convert_os_errors(path), _make_parents(path) as place, _make_locked_holder(place) as holder:
        temporary = holder / place.name
        temporary.touch()
        yield temporary
        _sync(temporary)
        temporary.replace(place)
        _sync(place.parent)


@contextmanager
def write_atomic_directory(path: Path) -> Iterator[Path]:
    """Yield a temporary directory; it replaces ``path`` on success (the old one is removed), else it is removed."""
    with _convert_os_errors(path), _make_parents(path) as place, _make_locked_holder(place) as holder:
        temporary = holder / place.name
        temporary.mkdir()
        yield temporary
        _sync_files(temporary)
        with lock_directory(place.parent):
            _take_place(temporary, place)
        _sync(place.parent)


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    with write_atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def put_file(path: Path, data: bytes, *, staging: Path) -> None:
    """Write a synced file in place of an earlier one; until then it is in `make_working_directory` of ``staging``."""
    with _convert_os_errors(path), _make_parents(path) as place, make_working_directory(staging) as directory:
        temporary = directory / "new"
        with temporary.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(place)
        _sync(place.parent)


@contextmanager
def make_working_directory(staging: Path) -> Iterator[Path]:
    """Yield an empty directory in ``staging``; it is removed at the end, or by the next call after a kill."""
    staging.mkdir(parents=True, exist_ok=True)
    with _make_locked_holder(Path(os.path.realpath(staging), "new")) as holder:
        directory = holder / "new"
        directory.mkdir()
        yield directory


@contextmanager
def make_scratch_directory() -> Iterator[Path]:
    """Yield an empty directory of this user below ``TMPDIR``; those of killed processes are removed first."""
    clear_scratch()
    holder, lock = _make_locked_directory(Path(tempfile.gettempdir()), _make_scratch_prefix(), mode=0o700)
    try:
        directory = holder / "new"  # which others lock in their turn
        directory.mkdir()
        yield directory
    finally:
        shutil.rmtree(holder, ignore_errors=True)
        os.close(lock)


def clear_scratch() -> None:
    """Remove scratch directories of killed processes."""
    for leftover in Path(tempfile.gettempdir()).glob(f"{_make_scratch_prefix()}*"):
        _remove_if_abandoned(leftover, lambda leftover=leftover: shutil.rmtree(leftover))  # type: ignore[misc]


def _make_scratch_prefix() -> str:
    return f"tcpipe-{os.getuid()}-"


def make_lasting_scratch() -> Path:
    """Return a `make_scratch_directory` that is removed when this process ends."""
    context = make_scratch_directory()
    directory = context.__enter__()
    atexit.register(context.__exit__, None, None, None)
    return directory


def put_directory(directory: Path, path: Path) -> None:
    """Rename a synced directory from `make_working_directory` to a new path of the same file system."""
    with _convert_os_errors(path), _make_parents(path) as place:
        _sync_files(directory)
        directory.rename(place)
        _sync(place.parent)


def remove(path: Path, staging: Path) -> None:
    """Remove a file, or a directory after a rename into a `make_working_directory`: a kill leaves no part of it."""
    if not path.is_dir() or path.is_symlink():
        path.unlink()
        return
    with make_working_directory(staging) as directory:
        path.rename(directory / "removed")


def _sync_files(directory: Path) -> None:
    """Sync a directory and all files and directories below it."""
    for above, _, files in os.walk(directory):
        for path in (Path(above, name) for name in (*files, "")):
            if not path.is_symlink():
                _sync(path)


@contextmanager
def lock_directory(directory: Path) -> Iterator[None]:
    """Admit one process at a time by a lock on ``directory``; all, if the file system has no locks."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def _convert_os_errors(path: Path) -> Iterator[None]:
    """Convert errors of the operating system while ``path`` is written into one line about ``path``.

    Errors that name another file stay unchanged: that file is read for ``path``. Errors that name no file come from
    writing, since readers convert their own errors.
    """
    try:
        yield
    except (OSError, StoreError) as error:
        cause = error.__cause__ if isinstance(error, StoreError) else error
        if not isinstance(cause, OSError):
            raise
        if _is_of_writing(cause, Path(os.path.realpath(path))):
            reason = os.strerror(cause.errno) if cause.errno else str(cause)
            raise StoreError(f"{path}: cannot be written ({reason})") from cause
        raise


def _is_of_writing(error: OSError, place: Path) -> bool:
    if error.filename is None:
        return not isinstance(error, ConnectionError)  # the reader of the output has ended
    named = Path(os.path.realpath(os.fsdecode(error.filename)))
    return error.errno in _UNWRITABLE or TEMPORARY_PREFIX in str(named) or named in (place, *place.parents)


@contextmanager
def _make_parents(path: Path) -> Iterator[Path]:
    """Make the parent directories of ``path``, and yield its real path; new directories are removed on failure."""
    place = Path(os.path.realpath(check_local_output(path)))
    missing = [parent for parent in place.parents if not parent.exists()]
    in_the_way = next((parent for parent in place.parents if parent.exists() and not parent.is_dir()), None)
    if in_the_way is not None:
        raise StoreError(f"{path}: cannot be written ({in_the_way} is a file, expected a directory)")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        yield place
    except BaseException:
        with suppress(OSError):
            for parent in missing:
                parent.rmdir()
        raise


@contextmanager
def _make_locked_holder(place: Path) -> Iterator[Path]:
    """Yield a new locked directory beside ``place`` and remove it at the end; abandoned ones are removed first."""
    clear(place.parent)
    holder, lock = _make_locked_directory(place.parent, _make_prefix(place.name))
    try:
        yield holder
    except BaseException:
        shutil.rmtree(holder, ignore_errors=True)
        time.sleep(_LAST_WRITE_S)
        raise
    finally:
        try:
            shutil.rmtree(holder, ignore_errors=True)
        finally:  # also after a signal
            shutil.rmtree(holder, ignore_errors=True)
            os.close(lock)


def _make_locked_directory(parent: Path, prefix: str, mode: int = 0o777) -> tuple[Path, int]:
    while True:
        holder = parent / f"{prefix}{make_unique_name()[:8]}"
        try:
            holder.mkdir(mode)
            with suppress(FileNotFoundError):  # another process took it for abandoned before it was locked
                lock = os.open(holder, os.O_RDONLY)
                with suppress(OSError):  # a file system without locks
                    fcntl.flock(lock, fcntl.LOCK_EX)
                if holder.exists():
                    return holder, lock
                os.close(lock)
        except BaseException:  # also for signals
            shutil.rmtree(holder, ignore_errors=True)
            raise


def _make_prefix(name: str) -> str:
    return f"{TEMPORARY_PREFIX}{os.fsdecode(os.fsencode(name)[:_LONGEST_NAME])}-"


def clear(directory: Path) -> None:
    """Clean a directory after killed writers: restore files that they moved, and remove their temporaries."""
    for holder in _list_holders(check_local_output(directory)):
        _remove_if_abandoned(holder, lambda holder=holder: _clear_holder(holder))  # type: ignore[misc]


def clear_beside(path: Path) -> None:
    """Clear the directory of ``path``, which need not exist."""
    clear(Path(os.path.realpath(check_local_output(path))).parent)


def find_leftovers(path: Path) -> list[Path]:
    """Return temporaries of killed writers of ``path`` in its directory."""
    place = Path(os.path.realpath(path))
    mine = (holder for holder in _list_holders(place.parent) if holder.name.startswith(_make_prefix(place.name)))
    return [holder for holder in mine if is_abandoned(holder)]


def is_abandoned(holder: Path) -> bool:
    """Return whether the writer of a temporary has ended, so that it may be removed."""
    return _remove_if_abandoned(holder, lambda: None)


def _list_holders(directory: Path) -> list[Path]:
    try:
        names = [entry.name for entry in os.scandir(directory) if entry.name.startswith(TEMPORARY_PREFIX)]
    except OSError:  # nothing to clear, or no permission
        return []
    return [directory / name for name in sorted(names) if _HOLDER.fullmatch(name)]


def _clear_holder(holder: Path) -> None:
    before = holder / _BEFORE
    if before.exists():
        for written in holder.iterdir():  # next to the earlier directory: the new one, under its final name
            if written != before and not os.path.lexists(holder.parent / written.name):
                before.rename(holder.parent / written.name)
    shutil.rmtree(holder)


def _remove_if_abandoned(holder: Path, act: Callable[[], object]) -> bool:
    """Do something while a temporary is locked, unless its writer lives; return whether it was done."""
    with suppress(OSError):
        lock = os.open(holder, os.O_RDONLY)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            act()
        finally:
            os.close(lock)
        return True
    return False


def _take_place(temporary: Path, place: Path) -> None:
    """Rename ``temporary`` to ``place``; an existing directory there is exchanged, if possible in one step."""
    if not place.exists():
        try:
            temporary.rename(place)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):  # another process was faster
                raise
        else:
            return
    if _exchange_directories(temporary, place):
        return
    old = temporary.with_name(_BEFORE)
    place.rename(old)
    try:
        temporary.rename(place)
    except OSError:
        old.rename(place)
        raise


def _exchange_directories(one: Path, other: Path) -> bool:
    renameat2 = getattr(ctypes.CDLL(None), "renameat2", None)
    if renameat2 is None:
        return False
    paths = os.fsencode(one), os.fsencode(other)
    return bool(renameat2(_AT_FDCWD, paths[0], _AT_FDCWD, paths[1], _RENAME_EXCHANGE) == 0)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def describe_full_disk(error: Exception) -> str:
    """Return the message that the disk is too full for a copy of a log; "" for other errors."""
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    return "no room for a copy here; TMPDIR names a place that has some" if full else ""


# Begins a URL, also one that `pathlib.Path` has made ``s3:/bucket`` of.
_LIKE_A_URL = re.compile(r"[a-z][a-z0-9+.-]+:/", re.IGNORECASE)


def check_local_output(path: Location) -> Path:
    """Return the path of a local output; `UsageError` for a URL, which would become a local directory ``s3:``."""
    found = _LIKE_A_URL.match(str(path))
    if found and "://" in str(path):
        raise UsageError(f"{path}: is a URL; tcpipe writes this on this machine: give a path, and copy the result")
    if found:
        raise UsageError(f"{path}: is no URL; expected {found[0]}/bucket/name, or a path of this machine")
    return Path(path)


def check_output(path: Location, wanted: str = "directory") -> Path:
    """Return the output path of a directory or file; `UsageError` if another kind of file, or a URL, is there."""
    place = check_local_output(path)
    if _find_kind(place) not in (None, wanted):
        problem = (
            "file, expected a directory; give another"
            if wanted == "directory"
            else "directory, expected the name of a file"
        )
        raise UsageError(f"{path}: is a {problem}")
    above = next((parent for parent in place.absolute().parents if _find_kind(parent)), None)
    if above is not None and _find_kind(above) == "file":
        raise UsageError(f"{place}: {above} is a file, expected a directory")
    return place


def check_file_name(path: Path, *endings: str) -> None:
    """Raise `UsageError` unless a path is a file, existing or not, with one of these endings."""
    if path.suffix.lower() not in endings or path.is_dir():
        raise UsageError(f"{path}: expected the name of a file that ends in {' or '.join(endings)}")


def check_new(path: Path, kind: str, *marks: str) -> None:
    """Raise `UsageError` unless a directory is new, empty, or one of a ``kind``, by one of the files ``marks`` in it."""
    is_ours = path.is_dir() and (not any(path.iterdir()) or any((path / mark).exists() for mark in marks))
    if path.exists() and not is_ours:
        raise UsageError(f"{path}: exists and is no {kind}; it is not changed; give another directory")


def check_input(path: Location, wanted: str = "file or directory") -> Path:
    """Return the path of an existing file or directory; `UsageError` if it is missing or of another kind."""
    kind = _find_kind(Path(path))
    if kind is None:
        why = "; it is read from this machine only" if _LIKE_A_URL.match(str(path)) else ""
        raise UsageError(f"{path}: there is no such {wanted}{why}")
    if kind not in wanted:
        raise UsageError(f"{path}: is a {kind}, expected a {wanted}")
    return Path(path)


def _find_kind(path: Path) -> str | None:
    """Return the kind of file at a path, None if it is missing; `PermissionError` if access is denied."""
    try:
        mode = path.stat().st_mode
    except PermissionError:
        raise
    except (OSError, ValueError):  # not there, too long for a name, a link in a circle
        return None
    return "directory" if stat.S_ISDIR(mode) else "file"
