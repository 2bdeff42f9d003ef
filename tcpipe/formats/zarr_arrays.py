"""Zarr v3 groups of arrays, for maps and datasets: the one home of zarr.

Arrays are cut into small *chunks* (the unit that is decoded) packed into large *shards* (the unit that is a file), compressed by
zstd; numbers wider than a byte are bit-shuffled first, which halves them. Every chunk carries a checksum that is proved when it is
read: damage is an error, never a number.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tcpipe.errors import StoreError

if TYPE_CHECKING:
    import zarr

Compression = Literal["zstd", "lz4"]
"""zstd is smaller, lz4 two to three times as fast to read."""


def create_group(path: Path, attributes: Mapping[str, Any] | None = None) -> zarr.Group:
    """Create an empty group at ``path``: inside an `atomic.atomic_directory`, so that it appears only when it is complete."""
    import zarr  # noqa: PLC0415  slow to import, and only needed to write

    try:
        return zarr.create_group(str(path), attributes=dict(attributes or {}), overwrite=True)
    except OSError as error:
        raise StoreError(f"{path}: cannot be written ({error.strerror or error})") from error


def add_array(
    group: zarr.Group,
    name: str,
    *,
    shape: tuple[int, ...],
    dtype: np.dtype[Any] | type,
    chunks: tuple[int, ...],
    shards: tuple[int, ...] | None = None,
    dimensions: tuple[str, ...],
    fill_value: float | str = 0,
    attributes: Mapping[str, Any] | None = None,
    compression: Compression = "zstd",
    level: int = 5,
) -> zarr.Array[Any]:
    """Add an empty array to a group.

    ``chunks`` and ``shards`` are elements per chunk and per shard (a multiple of the chunks; None: one file a chunk).
    """
    from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec  # noqa: PLC0415  slow to import, and only needed to write

    width = np.dtype(dtype).itemsize
    shuffle: Literal["bitshuffle", "noshuffle"] = "bitshuffle" if width > 1 else "noshuffle"
    codec = (
        ZstdCodec(level=level)
        if compression == "zstd" and width <= 1
        else BloscCodec(cname=compression, clevel=level, shuffle=shuffle, typesize=width)
    )
    return group.create_array(
        name,
        shape=shape,
        dtype=dtype,
        chunks=chunks,
        shards=shards,
        compressors=[codec, Crc32cCodec()],
        fill_value=fill_value,
        dimension_names=dimensions,
        attributes=dict(attributes or {}),
    )


def consolidate_metadata(group: zarr.Group) -> None:
    """Gather the descriptions of all arrays in the group's own, so that xarray opens it in one read and without a warning."""
    import zarr  # noqa: PLC0415  slow to import, and only needed to write

    with warnings.catch_warnings():
        # zarr's own reservation
        warnings.filterwarnings("ignore", message="Consolidated metadata", category=UserWarning)
        zarr.consolidate_metadata(group.store)
