"""The files of a dataset: its patches (Zarr or Parquet shards), its samples, its card, their checksums.

::

    dataset.json  croissant.json  samples.parquet  report.html
    overview.png  relief.png  classes.png                    the map, small, as the report shows it
    patches.zarr/{ortho,terrain,height,sample_id}            --format zarr
    data/<split>-00000-of-00001.parquet                      --format parquet: the same layers, a row a sample
"""

from __future__ import annotations

import csv
import math
import os
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.arrays import AnyArray, Ints, NamedArrays, Texts
from tcpipe.errors import DatasetError, RecipeError, StoreError, UsageError
from tcpipe.formats.atomic import Location
from tcpipe.formats.dataset_card import KIND, DatasetCard, Shard
from tcpipe.formats.integrity import verify_document
from tcpipe.formats.json_files import parse_typed, read_document
from tcpipe.formats.maps.map_facts import make_cf_attributes, read_layers
from tcpipe.formats.parquet import read_schema, read_table, write_parquet_bytes
from tcpipe.formats.place import REPORT, Place, find_changed_files, prove_files
from tcpipe.formats.published_outputs import FetchedShards
from tcpipe.formats.zarr_arrays import (
    DESCRIPTION,
    Compression,
    ShardedArray,
    add_array,
    consolidate_metadata,
    create_group,
    open_sharded,
)
from tcpipe.splits.assignment import SPLITS
from tcpipe.tables.levels import DATA_MODEL_VERSION, describe_other_data_model
from tcpipe.terrain.layers import Layer, LayerPixels, Layers, find_no_data_value, sort_layers

FileFormat = Literal["zarr", "parquet"]
CARD = "dataset.json"
CROISSANT = "croissant.json"
SAMPLES = "samples.parquet"
PATCHES = "patches.zarr"
SHARDS = "data"
OVERVIEW = "overview.png"
RELIEF = "relief.png"
CLASSES = "classes.png"

CHUNK_ROWS = 256
"""Patches that are decoded together."""

SHARD_ROWS = 16_384
"""Patches in one file."""

# Beyond these a patch takes twice the time for less than a tenth of the room.
_LEVELS: dict[Compression, int] = {"zstd": 3, "lz4": 5}

GROUP_ROWS = 1024
"""Patches in one row group of a Parquet shard: 6.5 MB, the memory of a streaming reader."""


MOST_SAMPLES = 10_000_000
"""Samples in a dataset: ten thousand kilometres of driving."""

MOST_PX = 1024
"""Side of a patch in pixels."""


@contextmanager
def _convert_errors(remedy: str = "") -> Iterator[None]:
    """Raise a `StoreError`, or the `RecipeError` of a card's recipe, as `DatasetError` with ``remedy`` added."""
    try:
        yield
    except (StoreError, RecipeError) as error:
        raise DatasetError(*(f"{problem}{remedy}" for problem in error.problems)) from None


_AGAIN = "; build the dataset again"


@dataclass(frozen=True, slots=True)
class Pixels:
    """Patches to write: row i of the dataset is what ``read(layer, slots[i : i + 1])`` returns, shape (1, px, px)."""

    layers: Layers
    patch_px: int
    slots: Ints
    read: Callable[[str, Ints], LayerPixels]

    def of(self, rows: slice | Ints) -> Pixels:
        """Return the patches of some rows."""
        return replace(self, slots=self.slots[rows])


@dataclass(frozen=True, slots=True)
class ZarrShardWriter:
    """A shard of every layer."""

    out: Place
    pixels: Pixels
    arrays: Mapping[str, ShardedArray]
    number: int
    threads: int

    def write(self) -> None:
        """Write it."""
        for layer, array in self.arrays.items():
            name = f"{PATCHES}/{layer}/{array.shard_name((self.number, *(0 for _ in array.shape[1:])))}"
            patches = self.pixels.read(layer, self.pixels.slots)
            self.out.put(name, array.encoded_shard(patches, threads=self.threads))


@dataclass(frozen=True, slots=True)
class ParquetShardWriter:
    """A Parquet shard of some rows; ``samples`` gives rows of the samples table."""

    out: Place
    pixels: Pixels
    samples: Callable[[Ints], pa.Table]
    rows: Ints
    shard: Shard

    def write(self) -> None:
        """Write it."""
        table = self.samples(self.rows)
        for layer in self.pixels.layers.values():
            table = table.append_column(*_list_column(layer, self.pixels.read(layer.name, self.pixels.slots)))
        self.out.put(self.shard.path, write_parquet_bytes(table, rows_per_group=GROUP_ROWS))


Drawer = ZarrShardWriter | ParquetShardWriter


def make_zarr_writers(
    directory: Path, pixels: Pixels, sample_ids: pa.ChunkedArray, *, compression: Compression, threads: int
) -> list[Drawer]:
    """Write ``patches.zarr`` into the dataset's directory, all but the layers' shards; return these, to be written.

    ``threads`` does not change the bytes.
    """
    n, px = len(pixels.slots), pixels.patch_px
    shard = _choose_shard_rows(n)
    attributes = {"Conventions": "CF-1.11", "title": "patches of a tcpipe dataset, in the order of samples.parquet"}
    group = create_group(directory / PATCHES, attributes)
    for layer in pixels.layers.values():
        add_array(
            group,
            layer.name,
            shape=(n, px, px),
            dtype=layer.stored,
            chunks=(CHUNK_ROWS, px, px),
            shards=(shard, px, px),
            dimensions=("sample", "row", "column"),
            fill_value=find_no_data_value(layer.stored),
            attributes={**make_cf_attributes(layer), "coordinates": "sample_id"},
            compression=compression,
            level=_LEVELS[compression],
        )
    ids = add_array(
        group,
        "sample_id",
        shape=(n,),
        dtype=str,
        chunks=(SHARD_ROWS,),
        dimensions=("sample",),
        fill_value="",
        attributes={"long_name": "joins patches and samples"},
    )
    for first in range(0, n, SHARD_ROWS):
        few = sample_ids.slice(first, SHARD_ROWS)
        ids[first : first + len(few)] = np.array(few.to_pylist(), dtype=object)
    consolidate_metadata(group)
    arrays = {name: _open_layer_array(directory, layer, n, px) for name, layer in pixels.layers.items()}
    rows = (slice(first, first + shard) for first in range(0, n, shard))
    return [
        ZarrShardWriter(Place(directory), pixels.of(part), arrays, number, threads) for number, part in enumerate(rows)
    ]


def _choose_shard_rows(samples: int) -> int:
    """Return the number of patches in a shard of a Zarr dataset with ``count`` patches."""
    return min(SHARD_ROWS, max(-(-samples // CHUNK_ROWS), 1) * CHUNK_ROWS)


def _open_layer_array(
    directory: Path, layer: Layer, samples: int, px: int, fetched: FetchedShards | None = None
) -> ShardedArray:
    """Return the array of a layer; `StoreError` if its shape differs from the expected number of patches and pixels."""
    return open_sharded(
        directory / PATCHES / layer.name,
        shape=(samples, px, px),
        chunk_shape=(CHUNK_ROWS, px, px),
        shard_shape=(_choose_shard_rows(samples), px, px),
        dtype=np.dtype(layer.stored),
        fill=find_no_data_value(layer.stored),
        fetched=fetched,
    )


def make_parquet_writers(out: Place, pixels: Pixels, samples: Callable[[Ints], pa.Table], split: Texts) -> list[Drawer]:
    """Write ``data/<split>-*.parquet`` to ``out``: the columns of the samples, and each layer as a fixed-size list.

    ``samples`` gives rows of the samples table.
    """
    drawers = list[Drawer]()
    for name in SPLITS:
        here = np.flatnonzero(split == name)
        count = -(-len(here) // SHARD_ROWS)
        for number in range(count):
            part = here[number * SHARD_ROWS : (number + 1) * SHARD_ROWS]
            shard = Shard(f"{SHARDS}/{name}-{number:05d}-of-{count:05d}.parquet", name, len(part))
            drawers.append(ParquetShardWriter(out, pixels.of(part), samples, part, shard))
    return drawers


def _list_column(layer: Layer, patches: LayerPixels) -> tuple[pa.Field, pa.Array]:
    """Return a layer as a column: rows of the patch one after another."""
    values = pa.array(np.ascontiguousarray(patches, layer.stored).reshape(-1))
    metadata = {
        "shape": str(list(patches.shape[1:])),
        **{key: str(value) for key, value in make_cf_attributes(layer).items()},
    }
    size = math.prod(patches.shape[1:])
    dtype = pa.list_(values.type, size)  # plain: a tensor extension type makes other readers fail
    column = pa.FixedSizeListArray.from_arrays(values, size)
    return pa.field(layer.name, dtype, nullable=False, metadata=metadata), column


def read_card(directory: Path, *, proved: bool = True) -> DatasetCard:
    """Return the card of the dataset in ``directory``, ``proved`` against its seal."""
    if not directory.exists():
        raise UsageError(f"{directory}: there is no such directory; run 'tcpipe build-dataset' first")
    if not directory.is_dir():
        raise UsageError(f"{directory}: is a file, expected the directory of a dataset")
    if not (directory / CARD).is_file():
        raise UsageError(f"{directory}: not a dataset: it has no {CARD}")
    with _convert_errors():
        data = read_document(directory / CARD)
    return parse_card(data, directory / CARD, proved=proved)


def parse_card(data: bytes, where: Location, *, proved: bool = True) -> DatasetCard:
    """Return the card in the bytes of a file; as `read_card`."""

    def is_current(card: Mapping[str, object]) -> bool:
        return card.get("kind") == KIND and card.get("data_model_version") == DATA_MODEL_VERSION

    with _convert_errors():
        found = verify_document(data, where, ours=lambda found: proved and is_current(found))
        if is_current(found):
            return parse_typed(found, DatasetCard, where)
    if found.get("kind") != KIND:
        raise DatasetError(f"{where}: not the card of a tcpipe dataset (kind is {found.get('kind')!r})")
    raise DatasetError(
        describe_other_data_model(str(where).removesuffix(f"/{CARD}"), str(found.get("data_model_version")))
    )


def read_intact_card(directory: Path) -> DatasetCard:
    """Return the card of a dataset whose samples and descriptions of patches are as they were written.

    Patches carry checksums of their own, which are proved when they are read.
    """
    card = read_card(directory)
    described = [name for name in card.checksums if Path(name).name == DESCRIPTION]
    with _convert_errors():
        prove_files(directory, card.checksums, [SAMPLES, *described])
    return card


def find_foreign_files(directory: Path, checksums: Collection[str]) -> list[str]:
    """Return the files in a dataset's directory that tcpipe did not write; ``checksums`` are the names in its card."""
    files = (path for path in directory.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted({path.relative_to(directory).as_posix() for path in files} - {*checksums, CARD, REPORT})


def keep_foreign_files(names: Iterable[str], before: Path, directory: Path) -> None:
    """Link or copy a user's files from a dataset into the one that replaces it; `DatasetError` if one exists there."""
    for name in names:
        target = directory / name
        if target.exists():
            raise DatasetError(f"{before / name}: has the name of a file of the new dataset; rename it")
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(before / name, target, follow_symlinks=False)
        except OSError:  # a file system without links
            shutil.copy2(before / name, target, follow_symlinks=False)


def read_samples(directory: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Return the samples table of a dataset, or some of its columns; `DatasetError` if it cannot be read."""
    with _convert_errors():
        return read_table(directory / SAMPLES, None if columns is None else list(columns))


def sample_columns(directory: Path) -> list[str]:
    """Return the names of the columns of a dataset's samples table; `DatasetError` if it cannot be read."""
    with _convert_errors():
        return list(read_schema(directory / SAMPLES).names)


@dataclass(frozen=True, slots=True)
class PatchFiles:
    """Locations of a dataset's patches by piece; a piece is decoded as a whole.

    ``starts`` are the first rows of the pieces and, last, the number of rows, shape (P + 1,), in the order of the
    files.
    """

    directory: Path
    layers: Layers
    patch_px: int
    starts: Ints
    arrays: Mapping[str, ShardedArray] = field(default_factory=dict)
    """Zarr: the array of each layer; a piece is a chunk."""
    groups: tuple[tuple[str, int], ...] = ()
    """Parquet: file and row group of each piece."""
    fetched: FetchedShards | None = None
    """Where the files are; None: on this machine."""

    def make_room(self, layer: str, rows: int) -> LayerPixels:
        """Return an empty array for a number of stored patches of a layer."""
        return np.empty((rows, self.patch_px, self.patch_px), self.layers[layer].stored)

    @property
    def piece_rows(self) -> int:
        """Size of a decoded piece [byte]; the last one may contain fewer rows."""
        return CHUNK_ROWS if self.arrays else GROUP_ROWS

    def expect(self, pieces: Iterable[int], layers: Iterable[str]) -> None:
        """Fetch pieces that are read soon, if they are in a bucket."""
        if self.fetched is not None and self.arrays:
            with _convert_errors(_AGAIN):
                for layer in layers:
                    array = self.arrays[layer]
                    array.expect((piece, *(0 for _ in array.shape[1:])) for piece in pieces)

    def read(self, piece: int, layers: Iterable[str], out: NamedArrays | None = None) -> dict[str, AnyArray]:
        """Return layers of one piece, each of shape (rows, *patch); `DatasetError` if it cannot be read.

        ``out`` has `piece_rows` or more rows a layer; None makes new arrays.
        """
        rows = int(self.starts[piece + 1] - self.starts[piece])
        into = {layer: self.make_room(layer, self.piece_rows) for layer in layers} if out is None else out
        try:
            with _convert_errors(_AGAIN):
                if self.arrays:
                    for layer in layers:
                        array = self.arrays[layer]
                        array.chunk((piece, *(0 for _ in array.shape[1:])), out=into[layer][: self.piece_rows])
                else:
                    name, group = self.groups[piece]
                    path = self.directory / name
                    path = path if self.fetched is None else self.fetched.fetch_file(path)
                    table = read_table(path, list(layers), group=group)
                    for layer in layers:
                        flat = table.column(layer).combine_chunks().flatten().to_numpy()
                        into[layer][:rows] = flat.reshape(rows, *into[layer].shape[1:])
        except (KeyError, ValueError):
            raise DatasetError(
                f"{self.directory}: piece {piece} of its patches contradicts the card; build it again"
            ) from None
        return {layer: into[layer][:rows] for layer in layers}


def is_shard(name: str) -> bool:
    """Return whether a file of a dataset contains patches, which are read in parts."""
    return name.startswith(f"{SHARDS}/") or (name.startswith(f"{PATCHES}/") and "/c/" in name)


def open_patches(directory: Path, card: DatasetCard, fetched: FetchedShards | None = None) -> PatchFiles:
    """Return the locations of a dataset's patches, here or ``fetched``.

    Shards are compared with the card: on this machine at once, in a bucket each before it is first read.
    A digest is computed once and remembered. A dataset without patches has no layers.
    """
    px, samples = card.patch_px, card.samples
    layers = sort_layers(read_layers(card.layers, card.classes, directory / CARD))
    if not (layers or card.maps):
        return PatchFiles(directory, {}, px, np.array([0, samples]))
    known = card.format in get_args(FileFormat)
    if not (layers and known and 0 < px <= MOST_PX and 0 <= samples <= MOST_SAMPLES):
        raise DatasetError(
            f"{directory / CARD}: {samples} patches of {px} px in {len(layers)} layers, {card.format}: expected up to "
            f"{MOST_SAMPLES} of up to {MOST_PX} px, zarr or parquet"
        )
    if "terrain" in layers and not card.classes:
        raise DatasetError(f"{directory / CARD}: a layer terrain, but no classes; build the dataset again")
    fetched = fetched and replace(fetched, proves=True)
    if fetched is None:
        shards = [name for name in card.checksums if is_shard(name)]
        if wrong := find_changed_files(Place(directory), card.checksums, shards):
            more = f", and {len(wrong) - 1} more shards" if len(wrong) > 1 else ""
            raise DatasetError(
                f"{wrong[0]}{more}: not of the build of {directory / CARD}; copy the whole dataset again, or build it again"
            )
    if card.format == "parquet":
        return replace(_open_sharded_patches(directory, layers, px, card), fetched=fetched)
    with _convert_errors(_AGAIN):
        arrays = {name: _open_layer_array(directory, layer, samples, px, fetched) for name, layer in layers.items()}
    starts = np.append(np.arange(0, samples, CHUNK_ROWS), samples)
    return PatchFiles(directory, layers, px, starts, arrays, fetched=fetched)


def _open_sharded_patches(directory: Path, layers: Layers, px: int, card: DatasetCard) -> PatchFiles:
    rows = [shard.rows for shard in card.shards]
    if min(rows, default=0) < 0 or sum(rows) != card.samples:
        raise DatasetError(f"{directory / CARD}: its shards hold {sum(rows)} rows, expected {card.samples}")
    groups = [
        (shard.path, group, min(GROUP_ROWS, shard.rows - group * GROUP_ROWS))
        for shard in card.shards
        for group in range(-(-shard.rows // GROUP_ROWS))
    ]
    starts = np.concatenate([[0], np.cumsum([rows for *_, rows in groups])]).astype(np.int64)
    return PatchFiles(directory, layers, px, starts, groups=tuple((path, group) for path, group, _ in groups))


def find_places_in_files(card: DatasetCard, splits: NDArray[np.object_]) -> Ints:
    """Return the row of each sample in the order of the files, (N,); ``splits`` is the samples' column, (N,)."""
    places = np.arange(len(splits))
    if card.format == "parquet":  # one split after the other
        rows = np.concatenate([np.flatnonzero(splits == name) for name in SPLITS])
        places[rows] = np.arange(len(rows))
    return places


_ID_COLUMNS = ("sample_id", "segment_id")


def read_sample_ids(path: Path) -> list[str]:
    """Return unique ids of a list in order: the column sample_id or segment_id of a CSV file, or the lines of a text.

    `DatasetError` if it cannot be read, has other columns or no id.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        separator = next((mark for mark in ";\t" if lines and mark in lines[0]), ",")
        rows = list(csv.reader(lines, delimiter=separator))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"{path}: the list of sample ids cannot be read ({error})") from None
    header = [name.strip() for name in rows[0]] if rows else []
    column = next((header.index(name) for name in _ID_COLUMNS if name in header), None)
    if column is None and len(header) > 1:
        raise DatasetError(f"{path}: its columns are {', '.join(header)}; expected {' or '.join(_ID_COLUMNS)}")
    texts = lines if column is None else [row[column] for row in rows[1:] if len(row) > column]
    ids = list(dict.fromkeys(text.strip() for text in texts if text.strip()))
    if not ids:
        raise DatasetError(f"{path}: contains no sample id; expected a column sample_id, or one id per line")
    return ids
