"""Logs in object storage (``s3://``, ``gs://``, ``az://``, ``http(s)://``, ``file://``): copied to this machine, then read as any other.

The home of obstore. Credentials, region and endpoint come from the environment, as the store's own tools take them (``AWS_…``).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from tcpipe.errors import LogError

_URL = re.compile(r"[a-z][a-z0-9+.-]*://")
_PIECE_BYTES = 1 << 24


def is_url(text: str | Path) -> bool:
    """Return whether a text names something in object storage rather than a path."""
    return _URL.match(str(text)) is not None


def staged(url: str, directory: Path) -> Path:
    """Copy a log, or every object below a prefix, into ``directory``, and return where it lies there.

    Parameters
    ----------
    url
        An object (``s3://bucket/drives/run.mcap``), or a prefix (``s3://bucket/drives/bag_directory``).
    directory
        An existing local directory. Names and modification times are kept.

    Raises
    ------
    LogError
        There is no such object, or it cannot be read.
    """
    import obstore  # noqa: PLC0415  most runs stay on this machine
    from obstore.exceptions import BaseError  # noqa: PLC0415

    address, name = _parted(url)
    try:
        store = obstore.store.from_url(address)
        found = [obstore.head(store, name)] if _is_object(store, name) else list(_below(store, name))
        if not found:
            raise LogError(f"{url}: there is no such object, and none below it")
        for meta in found:
            _copy(store, meta, directory)
    except (BaseError, OSError, ValueError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise LogError(f"{url}: it cannot be read ({reason})") from None
    return directory / name if name else directory


def _parted(url: str) -> tuple[str, str]:
    """Return the address of the store, and the name of the object or prefix in it."""
    scheme, _, rest = url.partition("://")
    container, slash, name = rest.rstrip("/").rpartition("/")
    if not slash or (not container and scheme != "file"):
        return f"{scheme}://{rest.rstrip('/')}", ""
    return f"{scheme}://{container or '/'}", name


def _is_object(store: object, name: str) -> bool:
    import obstore  # noqa: PLC0415

    if not name:
        return False
    try:
        obstore.head(store, name)
    except (FileNotFoundError, IsADirectoryError):
        return False
    return True


def _below(store: object, prefix: str) -> Iterator[dict[str, object]]:
    import obstore  # noqa: PLC0415

    for listed in obstore.list(store, prefix=prefix or None):
        yield from listed


def _copy(store: object, meta: dict[str, object], directory: Path) -> None:
    import obstore  # noqa: PLC0415

    name = PurePosixPath(str(meta["path"]))
    if name.is_absolute() or ".." in name.parts:
        raise LogError(f"{name}: an object of this name is not copied")
    copy = directory / name
    copy.parent.mkdir(parents=True, exist_ok=True)
    with copy.open("wb") as file:
        for piece in obstore.get(store, str(meta["path"])).stream(min_chunk_size=_PIECE_BYTES):
            file.write(piece)
    modified = meta["last_modified"].timestamp()  # type: ignore[attr-defined]
    os.utime(copy, (modified, modified))
