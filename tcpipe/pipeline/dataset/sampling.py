"""Sampling of segments of all runs: near segments in parallel batches, pixels in a spool until they are written."""

import itertools
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.arrays import AnyArray, Ints
from tcpipe.errors import TcpipeError
from tcpipe.execution import run_all, unwrap_result
from tcpipe.formats.maps.map_files import MapFile, open_map
from tcpipe.formats.parquet import make_mapped_array, move_rows_to_file, move_to_file, take_rows
from tcpipe.formats.published_outputs import FetchedShards
from tcpipe.progress import Meter
from tcpipe.recipe import SampleConfig
from tcpipe.stages.sample import Sampled, Shifts, check_same_layers, sample_on_maps
from tcpipe.tables.columns import to_floats
from tcpipe.tables.findings import Findings
from tcpipe.tables.levels import PLACED_SEGMENTS
from tcpipe.terrain.layers import LayerPixels, Layers, join_layers, sort_layers
from tcpipe.terrain.sampling import Patches
from tcpipe.terrain.sampling_kernel import compute_morton
from tcpipe.terrain.tiles import TilePool, choose_level

_BATCH_ROWS, _BATCH_BYTES = 8_192, 200_000_000
"""Segments sampled together: 50 MB of patches."""

_ROW_BITS = 32
_ROW_MASK = (1 << _ROW_BITS) - 1

_CELL_DEG = 1e-4  # batches follow a space-filling curve over cells of this size, so that few batches decode a map tile

_PLACING = ("map_index", "position_std_m", "footprint_xy_m", "footprint_lonlat_deg")

_HELD_MAPS = 2  # maps that a process keeps open, with their tiles, from batch to batch: 0.3 GB

MapPlaces = Callable[[], Iterable[tuple[Path, FetchedShards | None]]]
"""Returns arguments of `open_map` on any machine, in order of priority; picklable."""


@dataclass(frozen=True, slots=True)
class Spool:
    """Pixels of sampled batches: one file a batch, one layer after another, in the order of the dataset.

    A span of the dataset is then one span of every file: shuffled on disk, never in memory. A slot is the
    number of a batch (upper 32 bits) and a row of its file.

    """

    directory: Path
    layers: Layers
    patch_px: int
    counts: tuple[int, ...] = ()
    """Patches by batch."""

    def write(self, batch: int, order: NDArray[np.intp], sampled: Sampled) -> Sampled:
        """Write the patches of a batch in an order of its rows, (n,); return the results without pixels."""
        pixels = sampled.patches.pixels
        waiting = [np.ascontiguousarray(pixels[layer][order]).data for layer in self.layers]
        (self.directory / f"{batch}").write_bytes(b"".join(waiting))
        return replace(sampled, patches=replace(sampled.patches, pixels={}))

    def read(self, layer: str, slots: Ints) -> LayerPixels:
        """Return the patches in ``slots``, shape (n, *patch); one span is read of each batch."""
        kind, each = self.layers[layer], self._patch_bytes(layer)
        dtype, shape = kind.stored, (self.patch_px, self.patch_px)
        patches = np.empty((len(slots), *shape), dtype)
        before = sum(self._patch_bytes(name) for name in itertools.takewhile(lambda name: name != layer, self.layers))
        order = np.argsort(slots, kind="stable")
        batches, rows = slots[order] >> _ROW_BITS, slots[order] & _ROW_MASK
        for span in np.split(np.arange(len(slots)), np.flatnonzero(np.diff(batches)) + 1) if len(slots) else []:
            batch, first, last = int(batches[span[0]]), int(rows[span[0]]), int(rows[span[-1]])
            start = self.counts[batch] * before + first * each
            with (self.directory / f"{batch}").open("rb") as stream:
                stream.seek(start)
                data = stream.read((last - first + 1) * each)
            patches[order[span]] = np.frombuffer(data, dtype).reshape(-1, *shape)[rows[span] - first]
        return patches

    @property
    def sample_bytes(self) -> int:
        """Bytes of the patches of a sample."""
        return sum(map(self._patch_bytes, self.layers))

    def _patch_bytes(self, layer: str) -> int:
        return self.patch_px**2 * self.layers[layer].stored.itemsize


_Batch = tuple[int, NDArray[np.uint64], pa.Table]  # its number, and the ranks and rows of its segments

_held = dict[Path, tuple[MapFile, TilePool]]()  # maps of this process, while it samples, the last used one last


def sample_all_segments(
    segments: pa.Table,
    ranks: NDArray[np.uint64],
    maps: MapPlaces,
    config: SampleConfig,
    *,
    gnss_crs: str,
    shifts: Sequence[Shifts],
    jobs: int,
    directory: Path,
) -> tuple[Sampled, Ints, Spool]:
    """Sample M segments, each from the first map with data for it; return results, slots in ``kept`` order, spool.

    ``ranks`` give the dataset's order, uniform over 64 bits, shape (M,); ``gnss_crs`` is the CRS of the segments'
    positions, ``shifts`` say for each map by how much runs are moved on it. The results are arrays in files in
    ``directory``, pixels in files below it. `TcpipeError` if the map or the segments cannot be used.
    """
    sources = [open_map(*arguments) for arguments in maps()]
    check_same_layers(sources)
    layers = sort_layers(join_layers([source.layers for source in sources]))
    (directory / "pixels").mkdir()
    spool = Spool(directory / "pixels", layers, config.patch_px)
    size = max(min(_BATCH_ROWS, _BATCH_BYTES // spool.sample_bytes), 1)
    places = [np.floor((to_floats(segments, f"start_{axis}_deg") + 360.0) / _CELL_DEG) for axis in ("lon", "lat")]
    nearest = np.argsort(compute_morton(*(place.astype(np.int64) for place in places)), kind="stable")
    rows = [np.sort(nearest[first : first + size]) for first in range(0, len(nearest), size)]
    placed = segments.select(PLACED_SEGMENTS.names())
    batches = ((index, ranks[at], take_rows(placed, at)) for index, at in enumerate(rows))
    # A batch is made when a worker can have it: one copy of its segments exists at a time.
    sample = partial(_sample_batch, maps=maps, config=config, gnss_crs=gnss_crs, shifts=shifts, spool=spool)
    lost_by, slots = (make_mapped_array(directory, (segments.num_rows,), kind) for kind in (np.uint32, np.int64))
    counts, columns = [0] * len(rows), dict[str, AnyArray]()
    findings: dict[int, Findings] = {}
    meter = Meter("sampling", segments.num_rows)
    try:
        with closing(run_all(sample, batches, jobs=jobs)) as outcomes:
            for outcome in outcomes:
                part, batch = unwrap_result(outcome), outcome.index
                meter.add(len(rows[batch]))
                kept = rows[batch][part.kept]
                lost_by[rows[batch]] = part.lost_by
                slots[kept[np.argsort(ranks[kept], kind="stable")]] = (batch << _ROW_BITS) + np.arange(len(kept))
                counts[batch], findings[batch] = len(kept), part.findings
                placing = {name: getattr(part, name) for name in _PLACING}
                for name, values in (part.patches.columns() | placing).items():
                    if name not in columns:
                        columns[name] = make_mapped_array(directory, (len(lost_by), *values.shape[1:]), values.dtype)
                    columns[name][kept] = values
    finally:
        _held.clear()
    kept = move_to_file(np.flatnonzero(lost_by == 0), directory)
    columns = {name: move_rows_to_file(values, kept, directory) for name, values in columns.items()}
    every = dict.fromkeys(finding for index in sorted(findings) for finding in findings[index])
    placing = {name: columns.pop(name) for name in _PLACING}
    sampled = Sampled(kept=kept, patches=Patches({}, **columns), lost_by=lost_by, findings=tuple(every), **placing)
    return sampled, move_rows_to_file(slots, kept, directory), replace(spool, counts=tuple(counts))


def _sample_batch(
    batch: _Batch, *, maps: MapPlaces, config: SampleConfig, gnss_crs: str, shifts: Sequence[Shifts], spool: Spool
) -> Sampled | TcpipeError:
    """Sample one batch; write its pixels to the spool."""
    number, ranks, segments = batch
    try:
        sources, pools = zip(*(_reuse_map(*arguments, config) for arguments in maps()), strict=True)
        sampled = sample_on_maps(segments, sources, config, gnss_crs=gnss_crs, pools=pools, shifts=shifts)
        return spool.write(number, np.argsort(ranks[sampled.kept], kind="stable"), sampled)  # order of the dataset
    except TcpipeError as error:
        return error


def _reuse_map(path: Path, fetched: FetchedShards | None, config: SampleConfig) -> tuple[MapFile, TilePool]:
    """Return a map with the tiles of this process's last batch: the next batch is near and needs the same ones."""
    if (held := _held.pop(path, None)) is None:
        source = open_map(path, fetched)
        held = source, TilePool(choose_level(source, config.patch_m / config.patch_px))
    _held[path] = held
    if len(_held) > _HELD_MAPS:
        del _held[next(iter(_held))]
    return held
