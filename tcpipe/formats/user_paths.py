"""Paths that a user gives: what is read is there, what is written lies on this machine; else nothing begins (exit code 2)."""

from __future__ import annotations

import re
import stat
from pathlib import Path

from tcpipe.errors import UsageError

_LIKE_A_URL = re.compile(r"[a-z][a-z0-9+.-]+:/", re.IGNORECASE)
"""Begins a URL, also one that `pathlib.Path` has made ``s3:/bucket`` of."""


def check_local_output(path: str | Path) -> Path:
    """Return where something is written. `UsageError`: it is a URL, of which a local directory ``s3:`` would become."""
    found = _LIKE_A_URL.match(str(path))
    if found and "://" in str(path):
        raise UsageError(f"{path}: is a URL; this output is local: give a path, and copy the result")
    if found:
        raise UsageError(f"{path}: is no URL; expected {found[0]}/bucket/name, or a path of this machine")
    return Path(path)


def check_output_directory(path: str | Path) -> Path:
    """Return where a directory is written; `UsageError` if a file or a URL is in the way."""
    return _check_output(path, "file", "is a file, expected a directory; give another")


def check_output_file(path: str | Path) -> Path:
    """Return where a file is written; `UsageError` if a directory or a URL is in the way."""
    return _check_output(path, "directory", "is a directory, expected the name of a file")


def _check_output(path: str | Path, wrong: str, problem: str) -> Path:
    place = check_local_output(path)
    if _find_kind(place) == wrong:
        raise UsageError(f"{path}: {problem}")
    above = next((parent for parent in place.absolute().parents if _find_kind(parent)), None)
    if above is not None and _find_kind(above) == "file":
        raise UsageError(f"{place}: {above} is a file, expected a directory")
    return place


def check_input_path(path: str | Path) -> Path:
    """Return a file or directory that is there; `UsageError` else."""
    return _check_input(path, "file or directory")


def check_input_file(path: str | Path) -> Path:
    """Return a file that is there; `UsageError` else."""
    return _check_input(path, "file")


def check_input_directory(path: str | Path) -> Path:
    """Return a directory that is there; `UsageError` else."""
    return _check_input(path, "directory")


def _check_input(path: str | Path, wanted: str) -> Path:
    kind = _find_kind(Path(path))
    if kind is None:
        why = "; it is read from this machine only" if _LIKE_A_URL.match(str(path)) else ""
        raise UsageError(f"{path}: there is no such {wanted}{why}")
    if kind not in wanted:
        raise UsageError(f"{path}: is a {kind}, expected a {wanted}")
    return Path(path)


def _find_kind(path: Path) -> str | None:
    """Return what is at a path, None for nothing; `PermissionError` where that cannot be seen."""
    try:
        mode = path.stat().st_mode
    except PermissionError:
        raise
    except (OSError, ValueError):  # not there, too long for a name, a link in a circle
        return None
    return "directory" if stat.S_ISDIR(mode) else "file"
