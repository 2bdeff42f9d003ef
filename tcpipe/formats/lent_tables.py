"""Tables of L1 that stay in the store and are read when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath

import pyarrow as pa

from tcpipe.formats.integrity import Checksum
from tcpipe.formats.parquet import read_table
from tcpipe.formats.place import DirectoryPlace, Place
from tcpipe.tables.levels import Streams

_LENT = ("imu", "wheel_odometry", "visual_odometry")


class _LentTables(Mapping[str, pa.Table]):
    """Tables by role: some held, the others read from their files each time they are asked for."""

    def __init__(self, held: Mapping[str, pa.Table], files: Mapping[str, Path]) -> None:
        self._held, self._files = held, files

    def __getitem__(self, role: str) -> pa.Table:
        """Return a role's table."""
        if role in self._held:
            return self._held[role]
        return read_table(self._files[role]).replace_schema_metadata(None)

    def __contains__(self, role: object) -> bool:
        """Tell whether there is such a role; nothing is read for that."""
        return role in self._held or role in self._files

    def __iter__(self) -> Iterator[str]:
        """Yield the roles."""
        return iter([*self._held, *self._files])

    def __len__(self) -> int:
        """Return how many roles there are."""
        return len(self._held) + len(self._files)


def lend_streams(place: Place, streams: Streams, stored: Mapping[str, Checksum]) -> Streams:
    """Return L1 with the tables that a long log fills read whenever they are asked for: nobody holds them in between.

    In a bucket they are held: each time they would be fetched.

    Parameters
    ----------
    place : of the run.
    stored : the files of L1 in it.
    """
    if not isinstance(place, DirectoryPlace):
        return streams
    files = {PurePosixPath(name).stem: place.local(name, of) for name, of in stored.items()}
    held = {role: table for role, table in streams.tables.items() if role not in _LENT}
    return replace(streams, tables=_LentTables(held, {role: path for role, path in files.items() if role in _LENT}))
