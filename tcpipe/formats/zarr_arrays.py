"""Zarr v3 groups of arrays, for maps and datasets: the one home of zarr.

Arrays are cut into small *chunks* (the unit that is decoded) packed into large *shards* (the unit that is a file),
compressed by zstd; numbers wider than a byte are bit-shuffled first, which halves them. Every chunk carries a checksum
that is proved when it is read: damage is an error, never a number.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import google_crc32c
import numcodecs
import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import AnyArray
from tcpipe.errors import StoreError
from tcpipe.formats.json_files import read_json

if TYPE_CHECKING:
    import zarr

    from tcpipe.formats.published_outputs import FetchedShards

Shape = tuple[int, ...]
Compression = Literal["zstd", "lz4"]
"""zstd is smaller, lz4 two to three times as fast to read."""


def create_group(path: Path, attributes: Mapping[str, Any] | None = None) -> zarr.Group:
    """Create an empty group at ``path``: inside `atomic.atomic_directory`, so that it appears only when complete."""
    import zarr  # noqa: PLC0415  slow to import, and only needed to write

    try:
        return zarr.create_group(str(path), attributes=dict(attributes or {}), overwrite=True)
    except OSError as error:
        raise StoreError(f"{path}: cannot be written ({error.strerror or error})") from error


def add_array(
    group: zarr.Group,
    name: str,
    *,
    shape: Shape,
    dtype: np.dtype[Any] | type,
    chunks: Shape,
    shards: Shape | None = None,
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
    """Gather the descriptions of all arrays in the group's, so that xarray opens it in one read without a warning."""
    import zarr  # noqa: PLC0415  slow to import, and only needed to write

    with warnings.catch_warnings():
        # zarr's own reservation
        warnings.filterwarnings("ignore", message="Consolidated metadata", category=UserWarning)
        zarr.consolidate_metadata(group.store)


DESCRIPTION = "zarr.json"
"""Name of the file that describes an array or a group."""

_CRC_BYTES = 4
_ABSENT = 2**64 - 1  # offset of a chunk that is all fill value

_BLOSC_SHUFFLES = {"noshuffle": 0, "shuffle": 1, "bitshuffle": 2}


class _LocalShards:
    """Shards on this machine, as `FetchedShards` gives those in a bucket."""

    @staticmethod
    def size(path: Path) -> int:
        return path.stat().st_size

    @staticmethod
    def read(path: Path, offset: int, size: int) -> bytes:
        with path.open("rb", buffering=0) as file:
            return os.pread(file.fileno(), size, offset)


@dataclass(frozen=True, slots=True)
class ShardedArray:
    """An array on disk, by its chunks; ``chunk_shape`` divides ``shard_shape``."""

    path: Path
    shape: Shape
    chunk_shape: Shape
    shard_shape: Shape
    dtype: np.dtype[Any]
    fill: float
    sparse: bool
    """A shard without a file is all fill value, as in Zarr; otherwise it is damage."""
    codec: Any
    """Codec of a chunk without its checksum."""
    fetched: FetchedShards | None = None
    """Where the shards are; None: on this machine."""
    _indices: dict[Shape, NDArray[np.uint64]] = field(default_factory=dict)

    def chunk(self, index: Shape, out: AnyArray | None = None) -> AnyArray:
        """Return a whole chunk even at the array's end, shape ``chunk_shape``; in ``out`` (contiguous) if given."""
        shard, place = self._shard_and_place(index)
        out = np.empty(self.chunk_shape, self.dtype) if out is None else out
        path = self._shard_path(shard)
        try:
            offset, size = self._index(shard)[place].tolist()
            if offset == _ABSENT:
                out[...] = self.fill
            else:
                _decode(self.codec, self._read(path, offset, size), out)
        except FileNotFoundError:
            if not self.sparse:
                raise StoreError(f"{path}: is missing") from None
            out[...] = self.fill
        except (OSError, RuntimeError, ValueError) as error:
            raise StoreError(f"{path}: chunk {index} is damaged ({error})") from None
        return out

    def expect(self, indices: Iterable[Shape]) -> None:
        """Fetch remote chunks that will be read soon; one that cannot be fetched raises its error when it is read."""
        if self.fetched is None:
            return
        wanted = [self._shard_and_place(index) for index in indices]
        tables, pieces = list[tuple[Path, int, int]](), list[tuple[Path, int, int]]()
        paths = {shard: self._shard_path(shard) for shard, _ in wanted}
        for shard in paths.keys() - self._indices.keys():
            with suppress(FileNotFoundError):
                tables.append((paths[shard], *self._index_span(self.fetched.size(paths[shard]))))
        self.fetched.prefetch(tables)
        for shard, place in wanted:
            path = paths[shard]
            with suppress(FileNotFoundError, ValueError):
                offset, size = self._index(shard)[place].tolist()
                pieces += [(path, offset, size)] if offset != _ABSENT else []
        self.fetched.prefetch(pieces)

    def _shard_and_place(self, index: Sequence[int]) -> tuple[Shape, Shape]:
        per_shard = self.per_shard
        shard = tuple(i // n for i, n in zip(index, per_shard, strict=True))
        return shard, tuple(i % n for i, n in zip(index, per_shard, strict=True))

    def window(self, row0: int, row1: int, col0: int, col1: int) -> AnyArray:
        """Return rows ``row0:row1`` and columns ``col0:col1`` of the last two axes; `StoreError` as `chunk`."""
        high, wide = self.chunk_shape[-2:]
        row1, col1 = min(row1, self.shape[-2]), min(col1, self.shape[-1])
        out = np.empty((row1 - row0, col1 - col0), self.dtype)
        touched = list(product(range(row0 // high, -(-row1 // high)), range(col0 // wide, -(-col1 // wide))))
        self.expect(touched)
        for i, j in touched:
            top, left = max(i * high, row0), max(j * wide, col0)
            bottom, right = min((i + 1) * high, row1), min((j + 1) * wide, col1)
            tile = self.chunk((i, j)).reshape(high, wide)
            part = tile[top - i * high : bottom - i * high, left - j * wide : right - j * wide]
            out[top - row0 : bottom - row0, left - col0 : right - col0] = part
        return out

    def encoded_shard(self, values: AnyArray, *, threads: int = 1) -> bytes:
        """Return the file of a shard with ``values`` at its corner; the rest of its last chunks is fill value.

        ``threads`` encode chunks side by side; the bytes do not depend on their number.
        """
        values = np.asarray(values, self.dtype)
        places = list(product(*(range(-(-n // c)) for n, c in zip(values.shape, self.chunk_shape, strict=True))))
        index, pieces, end = np.full((*self.per_shard, 2), _ABSENT, np.uint64), list[bytes](), 0
        with ThreadPoolExecutor(threads) as pool:
            encoded = map if threads == 1 else pool.map
            for place, data in zip(places, encoded(lambda place: self._encoded(values, place), places), strict=True):
                index[place] = end, len(data) + _CRC_BYTES
                pieces += [data, _compute_crc(data)]
                end += len(data) + _CRC_BYTES
        table = index.astype("<u8").tobytes()
        return b"".join((*pieces, table, _compute_crc(table)))

    @staticmethod
    def shard_name(shard: Shape) -> str:
        """Return the name of a shard's file, below the array's directory, from its number along each axis."""
        return "/".join(("c", *map(str, shard)))

    def _encoded(self, values: AnyArray, place: Shape) -> bytes:
        cut = tuple(slice(i * c, (i + 1) * c) for i, c in zip(place, self.chunk_shape, strict=True))
        chunk = values[cut]
        if chunk.shape != self.chunk_shape:
            whole = np.full(self.chunk_shape, self.fill, self.dtype)
            whole[tuple(slice(n) for n in chunk.shape)] = chunk
            chunk = whole
        return bytes(self.codec.encode(np.ascontiguousarray(chunk)))

    @property
    def per_shard(self) -> Shape:
        """Chunks in a shard along each axis."""
        return tuple(s // c for s, c in zip(self.shard_shape, self.chunk_shape, strict=True))

    def _shard_path(self, shard: Shape) -> Path:
        return self.path / self.shard_name(shard)

    def _index(self, shard: Shape) -> NDArray[np.uint64]:
        """Return the shard's table of offsets and sizes, shape (*chunks per shard, 2)."""
        if shard not in self._indices:
            path = self._shard_path(shard)
            offset, size = self._index_span((self.fetched or _LocalShards).size(path))
            table = np.frombuffer(self._read(path, offset, size), "<u8").reshape(*self.per_shard, 2)
            start, length = table[..., 0], table[..., 1]
            lies_within = (start <= offset) & (length >= _CRC_BYTES) & (length <= offset - np.minimum(start, offset))
            if not (lies_within | (start == _ABSENT)).all():
                raise ValueError("its index points outside the file")
            self._indices[shard] = table
        return self._indices[shard]

    def _read(self, path: Path, offset: int, size: int) -> bytes:
        """Read bytes, the last of which are a checksum, and return the others; `ValueError` if it does not agree."""
        found = (self.fetched or _LocalShards).read(path, offset, size)
        content = found[:-_CRC_BYTES]
        if _compute_crc(content) != found[-_CRC_BYTES:]:
            raise ValueError("its checksum does not match")
        return content

    def _index_span(self, shard_bytes: int) -> tuple[int, int]:
        """Return offset and size of the table in a shard of a given size [byte]."""
        size = 16 * math.prod(self.per_shard) + _CRC_BYTES
        return max(shard_bytes - size, 0), size


def open_sharded(
    path: Path,
    *,
    shape: Shape,
    chunk_shape: Shape,
    shard_shape: Shape,
    dtype: np.dtype[Any],
    fill: float,
    sparse: bool = False,
    fetched: FetchedShards | None = None,
) -> ShardedArray:
    """Return the array in ``path``, with the numbers of a card; of ``zarr.json`` only the compression is used.

    `StoreError`: there is no description, or another compression than tcpipe writes.
    """
    where = path / DESCRIPTION
    if not where.exists():
        raise StoreError(f"{path}: is missing")
    described: Any = read_json(where)
    try:
        codec = _make_codec(**described["codecs"][0]["configuration"]["codecs"][1])
    except (LookupError, TypeError, ValueError, OverflowError):
        raise StoreError(f"{where}: its chunks are not in shards and compressed by zstd or blosc") from None
    return ShardedArray(path, shape, chunk_shape, shard_shape, dtype, fill, sparse, codec, fetched)


def _make_codec(name: str, configuration: Mapping[str, Any]) -> Any:
    """Return the codec of an array description, for all of its settings."""
    if name == "zstd":
        return numcodecs.Zstd(level=configuration["level"], checksum=configuration["checksum"])
    if name != "blosc":
        raise ValueError(name)
    cname, clevel, blocksize = (configuration[key] for key in ("cname", "clevel", "blocksize"))
    shuffle = _BLOSC_SHUFFLES[configuration["shuffle"]]
    return numcodecs.Blosc(cname=cname, clevel=clevel, shuffle=shuffle, blocksize=blocksize)


def _decode(codec: Any, data: bytes, out: AnyArray) -> None:
    """Decode into ``out``; `ValueError` if the size differs."""
    size = int.from_bytes(data[4:8], "little") if isinstance(codec, numcodecs.Blosc) else _read_zstd_size(data)
    if size != out.nbytes:
        raise ValueError(f"it contains {size} bytes, expected {out.nbytes}")
    codec.decode(data, out=out)


def _read_zstd_size(data: bytes) -> int:
    """Return the size of the content that a frame states (RFC 8878, 3.1.1) [byte]; 0 if it states none."""
    if len(data) < 5:
        raise ValueError("it is truncated")
    flag, is_single, has_dictionary = data[4] >> 6, data[4] >> 5 & 1, data[4] & 3
    start = 5 + (1 - is_single) + (0, 1, 2, 4)[has_dictionary]
    width = (is_single, 2, 4, 8)[flag]
    return int.from_bytes(data[start : start + width], "little") + (256 if width == 2 else 0)


def _compute_crc(data: bytes) -> bytes:
    checksum: int = google_crc32c.value(data)
    return checksum.to_bytes(_CRC_BYTES, "little")
