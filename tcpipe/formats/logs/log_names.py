"""Names of log files: tcpipe's own suffixes, and those of readers that other packages register (docs/how-to/tables.md)."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from tcpipe.errors import LogError
from tcpipe.formats.logs.rosbag2 import METADATA
from tcpipe.formats.logs.table_folders import is_table

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

AUTOPILOT_SUFFIXES = (".ulg", ".bin")
LOG_SUFFIXES = (".mcap", ".bag", ".bag.active", ".db3", ".mcap.zstd", ".db3.zstd", *AUTOPILOT_SUFFIXES)


def is_log_file(name: str) -> bool:
    """Return whether a file of this name is a log or part of one."""
    return name.lower().endswith(".db3-wal") or name == METADATA or bool(find_log_suffix(name))


def find_log_suffix(name: str) -> str:
    """Return the suffix that makes a file a log, also that of a reader of another package; "" for other files."""
    reader = find_reader(name)
    ends = [f".{reader.name}"] if reader else [suffix for suffix in LOG_SUFFIXES if name.lower().endswith(suffix)]
    return max(ends, key=len, default="")


def find_reader(name: str) -> EntryPoint | None:
    """Return another package's reader for a name with none of tcpipe's own suffixes; `LogError`: two packages have one."""
    if name.lower().endswith(LOG_SUFFIXES) or is_table(name):
        return None
    found = [entry for entry in _list_readers() if name.lower().endswith(f".{entry.name.lower()}")]
    if len(found) > 1:
        packages = ", ".join(sorted(entry.dist.name if entry.dist else "?" for entry in found))
        raise LogError(f"{name}: several packages read such a file: {packages}; uninstall all but one")
    return found[0] if found else None


@cache
def _list_readers() -> tuple[EntryPoint, ...]:
    """Return the readers that installed packages register: the name of an entry point is a suffix without its dot."""
    from importlib.metadata import entry_points  # noqa: PLC0415  it searches all packages: only for foreign suffixes

    return tuple(entry_points(group="tcpipe.logs"))
