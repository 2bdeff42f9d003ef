"""Segments of all runs to patches in one file a layer: batch by batch, each batch a patch of ground, side by side."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, overload

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import DatasetError, TcpipeError
from tcpipe.execution import run_all
from tcpipe.formats.dataset_files import LayerPixels
from tcpipe.formats.maps.map_files import MapFile, open_map
from tcpipe.recipe import SampleConfig
from tcpipe.stages.sample import Sampled
from tcpipe.stages.sample_maps import check_alike, sample_on_maps
from tcpipe.tables.columns import floats
from tcpipe.tables.levels import PLACED_SEGMENTS
from tcpipe.terrain.layers import Layer, in_order, joint
from tcpipe.terrain.sampling import Patches
from tcpipe.terrain.sampling_kernel import morton
from tcpipe.terrain.tiles import TilePool, level_for

_BATCH_ROWS = 8_192
"""Segments sampled together: 50 MB of patches."""

_BUCKET_ROWS = 16_384
"""Segments in a bucket of the spool: 0.1 GB of patches, read together."""

_CELL_DEG = 1e-4
"""Batches follow a space-filling curve over cells of this size, so that a map tile is decoded for few of them."""

_PLACING = ("map_index", "footprint_xy_m", "footprint_lonlat_deg")

_HELD_MAPS = 2
"""Maps that a process keeps open, with their tiles, from batch to batch: 0.3 GB."""


@dataclass(frozen=True, slots=True)
class Spool:
    """Pixels on disk while they wait for their place in the dataset: one file a layer, one slot a segment.

    Slots are buckets of segments whose ranks are near, in the order of the ranks; what is sampled together lies side by side in a bucket.
    So pixels are written in stretches as they come, and read in the dataset's order one bucket after another: shuffled on disk, never
    held in memory.
    """

    directory: Path
    layers: Mapping[str, Layer]
    slots: int
    patch_px: int

    def create(self) -> None:
        """Make the files; a slot that is never written takes no room."""
        for layer in self.layers:
            with self._path(layer).open("wb") as file:
                file.truncate(self.slots * self._slot_bytes(layer))

    def write(self, layer: str, slots: NDArray[np.int64], pixels: LayerPixels) -> None:
        """Write patches, shape (n, px, px), to their slots, (n,)."""
        order = np.argsort(slots)
        stretches = np.split(order, np.flatnonzero(np.diff(slots[order]) != 1) + 1)
        with self._path(layer).open("r+b", buffering=0) as file:
            for stretch in stretches:
                if len(stretch):
                    file.seek(int(slots[stretch[0]]) * self._slot_bytes(layer))
                    file.write(np.ascontiguousarray(pixels[stretch]).data)

    def read(self, layer: str, slots: NDArray[np.int64]) -> LayerPixels:
        """Return the patches in ``slots``, shape (n, px, px); the file is mapped only while they are copied."""
        shape = (self.slots, self.patch_px, self.patch_px)
        return np.asarray(np.memmap(self._path(layer), self.layers[layer].stored, "r", shape=shape)[slots])

    def _path(self, layer: str) -> Path:
        return self.directory / layer

    def _slot_bytes(self, layer: str) -> int:
        return self.patch_px**2 * self.layers[layer].stored.itemsize


@dataclass(frozen=True, slots=True)
class _Batch:
    rows: NDArray[np.int64]
    slots: NDArray[np.int64]
    segments: pa.Table
    map_paths: tuple[Path, ...]
    config: SampleConfig
    gnss_crs: str
    spool: Spool


@dataclass(frozen=True, slots=True)
class _HeldMap:
    source: MapFile
    tiles: TilePool


_held: OrderedDict[Path, _HeldMap] = OrderedDict()
"""Of this process, while it samples."""


@dataclass(frozen=True, slots=True)
class _Batches(Sequence[_Batch]):
    """The batches, each made when it is asked for, so that one copy of its segments exists at a time."""

    rows: Sequence[NDArray[np.int64]]
    slot_of: NDArray[np.int64]
    segments: pa.Table
    map_paths: tuple[Path, ...]
    config: SampleConfig
    gnss_crs: str
    spool: Spool

    def __len__(self) -> int:
        """Return the number of batches."""
        return len(self.rows)

    @overload
    def __getitem__(self, index: int) -> _Batch: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[_Batch]: ...
    def __getitem__(self, index: int | slice) -> _Batch | Sequence[_Batch]:
        """Return one batch, or some."""
        if isinstance(index, slice):
            return replace(self, rows=self.rows[index])
        rows = self.rows[index]
        segments = self.segments.take(pa.array(rows))
        return _Batch(rows, self.slot_of[rows], segments, self.map_paths, self.config, self.gnss_crs, self.spool)


def sample_all_segments(
    segments: pa.Table,
    ranks: NDArray[np.uint64],
    map_paths: tuple[Path, ...],
    config: SampleConfig,
    *,
    gnss_crs: str,
    directory: Path,
    jobs: int,
) -> tuple[Sampled, NDArray[np.int64], Spool]:
    """Sample every segment from the first map that has data for it; pixels go to files in ``directory``, the rest is returned.

    Beside it, in the order of its ``kept``, which rises: the slots of the spool.

    Parameters
    ----------
    segments
        M segments, of any runs.
    ranks
        Their ranks in the dataset's order, uniform over 64 bits, shape (M,).
    map_paths, config, gnss_crs
        What is sampled, in order of priority, how, and the CRS of the segments' positions.
    directory
        Where the pixels wait.
    jobs
        Processes side by side.

    Raises
    ------
    TcpipeError
        The map or the segments cannot be used.

    """
    sources = [open_map(path) for path in map_paths]
    check_alike(sources)
    rows = list(_batch_rows(segments))
    spool = Spool(directory, in_order(joint([source.layers for source in sources])), segments.num_rows, config.patch_px)
    spool.create()
    placed = segments.select(PLACED_SEGMENTS.names())
    batches = _Batches(rows, _slots(rows, ranks), placed, map_paths, config, gnss_crs, spool)
    lost_by = np.zeros(segments.num_rows, np.uint32)
    columns: dict[str, NDArray[Any]] = {}
    warnings: dict[int, tuple[str, ...]] = {}
    try:
        with closing(run_all(_sample_batch, batches, jobs=jobs)) as outcomes:
            for outcome in outcomes:
                part = _sound(outcome.result)
                lost_by[rows[outcome.index]] = part.lost_by
                warnings[outcome.index] = part.warnings
                for name, values in _columns(part).items():
                    whole = columns.setdefault(name, np.zeros((len(lost_by), *values.shape[1:]), values.dtype))
                    whole[rows[outcome.index][part.kept]] = values
    finally:
        _held.clear()
    kept = np.flatnonzero(lost_by == 0)
    for name in columns:
        columns[name] = columns[name][kept]
    said = dict.fromkeys(warning for index in sorted(warnings) for warning in warnings[index])
    placing = {name: columns.pop(name) for name in _PLACING}
    sampled = Sampled(kept=kept, patches=Patches({}, **columns), lost_by=lost_by, warnings=tuple(said), **placing)
    return sampled, batches.slot_of[kept], spool


def _columns(sampled: Sampled) -> dict[str, NDArray[Any]]:
    """Return what is said of the patches, an array each."""
    return {**sampled.patches.columns(), **{name: getattr(sampled, name) for name in _PLACING}}


def _sound(part: Sampled | TcpipeError | None) -> Sampled:
    """Return what a batch gave; raise what was wrong with it."""
    if part is None:
        raise DatasetError("a worker process died while sampling (killed, or out of memory); try fewer --jobs")
    if isinstance(part, TcpipeError):
        raise part
    return part


def _batch_rows(segments: pa.Table) -> Iterator[NDArray[np.int64]]:
    """Yield the rows of each batch, rising."""
    places = [np.floor((floats(segments, f"start_{axis}_deg") + 360.0) / _CELL_DEG) for axis in ("lon", "lat")]
    order = np.argsort(morton(*(place.astype(np.int64) for place in places)), kind="stable")
    for first in range(0, len(order), _BATCH_ROWS):
        yield np.sort(order[first : first + _BATCH_ROWS])


def _slots(batches: Sequence[NDArray[np.int64]], ranks: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Return the slot of every segment, (M,): by bucket of near ranks, then by batch."""
    sequence = np.concatenate(batches)
    buckets = np.uint64(-(-len(ranks) // _BUCKET_ROWS))
    bucket = (ranks[sequence] >> np.uint64(32)) * buckets >> np.uint64(32)
    slots = np.empty(len(ranks), np.int64)
    slots[sequence[np.argsort(bucket, kind="stable")]] = np.arange(len(ranks))
    return slots


def _sample_batch(batch: _Batch) -> Sampled | TcpipeError:
    """Sample one batch; its pixels go to its slots of the spool."""
    try:
        held = [_held_map(path, batch.config) for path in batch.map_paths]
        sources, pools = [each.source for each in held], [each.tiles for each in held]
        sampled = sample_on_maps(batch.segments, sources, batch.config, gnss_crs=batch.gnss_crs, pools=pools)
    except TcpipeError as error:
        return error
    for layer in batch.spool.layers:
        batch.spool.write(layer, batch.slots[sampled.kept], sampled.patches.pixels[layer])
    return replace(sampled, patches=replace(sampled.patches, pixels={}))


def _held_map(path: Path, config: SampleConfig) -> _HeldMap:
    """Return a map as this process's last batch left it: the next one lies beside it and wants the same tiles."""
    held = _held.pop(path, None)
    if held is None:
        source = open_map(path)
        held = _HeldMap(source, TilePool(level_for(source, config.patch_m / config.patch_px)))
    _held[path] = held
    if len(_held) > _HELD_MAPS:
        _held.popitem(last=False)
    return held
