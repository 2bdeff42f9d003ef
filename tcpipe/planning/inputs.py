"""What the commands plan on: one map of a store."""

from __future__ import annotations

from pathlib import Path

from tcpipe.errors import MapError, UsageError
from tcpipe.formats.maps.map_files import MapFile, open_map
from tcpipe.store import open_store


def choose_map(store: str | Path, name: str | None) -> MapFile:
    """Return the named map of a store, or its only one.

    Raises
    ------
    StoreError, MapError : there is no store, no such map, or it cannot be read.
    UsageError : there are several, and none is named.
    """
    opened = open_store(store)
    maps = opened.maps()
    if not maps:
        raise MapError(f"{opened.root}: no map in the store; add one: tcpipe add-map NAME --height FILE")
    if name is None and len(maps) > 1:
        raise UsageError(f"{opened.root}: {len(maps)} maps in the store ({', '.join(maps)}); name one with --map")
    if name is not None and name not in maps:
        raise MapError(f"{opened.root}: no map {name!r} in the store; there are {', '.join(maps)}")
    return open_map(*opened.map_files(name or maps[0]))
