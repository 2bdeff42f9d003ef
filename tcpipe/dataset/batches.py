"""Stored layers of a split, in memory or piece by piece, and its batches for Keras, JAX, torch or any loop."""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tcpipe.arrays import Floats32, GenericArray, Ints, Mask
from tcpipe.dataset.tensor import TensorLayout
from tcpipe.formats.dataset_files import PatchFiles
from tcpipe.terrain.layers import LayerPixels

Batch = tuple[Floats32 | tuple[Floats32, Floats32], ...]
Pixels = dict[str, LayerPixels]

IN_MEMORY_BYTES = 2 << 30
"""Largest size of the stored layers of a split in memory [byte]; the paper's whole dataset takes 70 MB."""

CACHED_PIECES = 64
"""Pieces kept for reading at random from a split that is not in memory."""

_FLIPPED = ("cross_slope_rad",)  # columns whose sign changes when a sample is mirrored across its direction of travel

_POOL_PIECES = 16  # number of pieces that are shuffled together: 4096 samples of a Zarr dataset, 26 MB


class StoredPixels:
    """Layers of N samples; ``rows`` are their places in the order of the files, (N,)."""

    def __init__(self, files: PatchFiles, rows: Ints) -> None:
        self.files = files
        self.rows = rows
        self._memory: Pixels = {}
        self._pieces: OrderedDict[tuple[int, tuple[str, ...]], Pixels] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        """Leave pixels behind when a loader's worker process receives them."""
        return {**self.__dict__, "_memory": {}, "_pieces": OrderedDict()}

    def fit(self, layers: tuple[str, ...]) -> bool:
        """Return whether the layers are kept in memory."""
        return len(self.rows) * sum(self.files.make_room(layer, 1).nbytes for layer in layers) <= IN_MEMORY_BYTES

    def in_memory(self, layers: tuple[str, ...]) -> Pixels:
        """Return the layers of all samples, shape (N, px, px) each, read once and kept with those of earlier calls."""
        absent = [layer for layer in layers if layer not in self._memory]
        if absent:
            self._memory.update(self._read(self.rows, absent))
        return self._memory

    def gather(self, at: Ints, layers: tuple[str, ...]) -> Pixels:
        """Return the layers of the samples ``at``, each of shape (B, px, px)."""
        if self.fit(layers):
            memory = self.in_memory(layers)
            return {layer: memory[layer][at] for layer in layers}
        return self._read(self.rows[at], layers)

    def find_pieces(self, at: Ints) -> Ints:
        """Return the piece that contains each of the samples ``at``, (M,)."""
        return np.searchsorted(self.files.starts, self.rows[at], side="right") - 1

    def pools(
        self, at: Ints, layers: Sequence[str], *, pieces: int, spare: int, rng: np.random.Generator | None
    ) -> Iterator[tuple[Pixels, Ints, Ints]]:
        """Yield the samples ``at``, shape (M,), in pools of ``pieces`` pieces, each piece decoded once.

        Yields the pool's arrays, which the next pool overwrites; rows in them, and their numbers in ``at``, both (B,).
        The first ``spare`` rows are the caller's. ``rng`` shuffles the pieces and the samples within each pool; None
        keeps the order of the files.
        """
        files, rows, piece_of = self.files, self.rows[at], self.find_pieces(at)
        order = np.argsort(piece_of, kind="stable")
        parts = np.split(order, np.flatnonzero(np.diff(piece_of[order])) + 1) if len(order) else []
        if rng is not None:
            parts = [parts[number] for number in rng.permutation(len(parts))]
        room = spare + min(pieces, len(parts)) * files.piece_rows
        pool = {layer: files.make_room(layer, room) for layer in layers}
        for first in range(0, len(parts), pieces):
            here, places = parts[first : first + pieces], []
            files.expect([int(piece_of[part[0]]) for part in here], layers)
            for number, part in enumerate(here):
                piece, head = int(piece_of[part[0]]), spare + number * files.piece_rows
                files.read(piece, layers, out={layer: pixels[head:] for layer, pixels in pool.items()})
                places.append(rows[part] - files.starts[piece] + head)
            found, which = np.concatenate(places), np.concatenate(here)
            shuffled = np.arange(len(found)) if rng is None else rng.permutation(len(found))
            yield pool, found[shuffled], which[shuffled]

    def _read(self, rows: Ints, layers: Sequence[str]) -> Pixels:
        """Read the pieces that contain ``rows`` (of the files), each once."""
        out: Pixels = {layer: self.files.make_room(layer, len(rows)) for layer in layers}
        piece_of = np.searchsorted(self.files.starts, rows, side="right") - 1
        pieces = np.unique(piece_of).tolist()
        for number, piece in enumerate(pieces):
            if number % CACHED_PIECES == 0:
                self.files.expect(pieces[number : number + CACHED_PIECES], layers)
            here = np.flatnonzero(piece_of == piece)
            pixels = self._read_piece(piece, tuple(layers))
            for layer in layers:
                out[layer][here] = pixels[layer][rows[here] - self.files.starts[piece]]
        return out

    def _read_piece(self, piece: int, layers: tuple[str, ...]) -> Pixels:
        key = (piece, layers)
        if key in self._pieces:
            self._pieces.move_to_end(key)
            return self._pieces[key]
        pixels = self.files.read(piece, layers)
        if not self.fit(layers):  # else every piece is read only once
            self._pieces[key] = pixels
            if len(self._pieces) > CACHED_PIECES:
                self._pieces.popitem(last=False)
        return pixels


@dataclass(frozen=True, slots=True)
class SampleView:
    """Which of the stored samples a split has, ``at``, (N,), and how their tensors are formed."""

    stored: StoredPixels
    at: Ints
    form: TensorLayout


@dataclass(eq=False, repr=False, kw_only=True)
class Batches:
    """Batches of one split; iterating again is the next epoch, with its own shuffle.

    Each batch is ``(patches, labels)``, or ``(patches, labels, weights)`` with ``weights``, a weight for each label;
    with ``features``, patches are replaced by ``(patches, features)``.
    """

    view: SampleView
    labels: Floats32
    """Shape (N, 2)."""
    weights: Floats32 | None
    """Shape (N, 2)."""
    features: Sequence[tuple[str, GenericArray]]
    """Names and values of columns, shape (N,)."""
    size: int
    shuffle: bool
    seed: int
    mirror: bool
    drop_last: bool
    from_disk: bool
    shard: tuple[int, int] = (0, 1)
    """Number of this part of the split and of all its parts."""
    _next: int = field(default=0, init=False)
    _samples: Ints = field(init=False)

    def __post_init__(self) -> None:
        """Find the samples of this part."""
        number, count = self.shard
        self._samples = np.arange(len(self.view.at))
        if count > 1 and self.from_disk:
            piece_of = self.view.stored.find_pieces(self.view.at)
            self._samples = np.flatnonzero(np.isin(piece_of, np.unique(piece_of)[number::count]))
        elif count > 1:
            self._samples = self._samples[number::count]

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        n = len(self._samples)
        return n // self.size if self.drop_last else -(-n // self.size)

    def __iter__(self) -> Iterator[Batch]:
        """Iterate over the next epoch."""
        self._next += 1
        return self.epoch(self._next - 1)

    def part(self, number: int, count: int) -> Batches:
        """Return the batches of one of ``count`` parts of the split, for processes that divide it among them."""
        return replace(self, shard=(number, count))

    def forever(self) -> Iterator[Batch]:
        """Iterate over epoch after epoch without an end; Keras wants ``steps_per_epoch=len(batches)`` with it."""
        for number in itertools.count():  # a generator: Keras takes no other iterator
            yield from self.epoch(number)

    def epoch(self, number: int) -> Iterator[Batch]:
        """Iterate over one epoch; the same number gives the same batches."""
        mirrors = np.random.default_rng([self.seed, number, 1])
        for pixels, rows, samples in self._iterate_full(np.random.default_rng([self.seed, number])):
            for first in range(0, len(rows), self.size):
                cut = slice(first, first + self.size)
                yield self._batch(pixels, rows[cut], samples[cut], mirrors)

    def _iterate_full(self, rng: np.random.Generator) -> Iterator[tuple[Pixels, Ints, Ints]]:
        """Yield pixels, rows in them and their samples, in whole batches except for the last ones of the epoch."""
        view, mine = self.view, self._samples
        layers = view.form.layers
        if not self.from_disk:
            order = mine[rng.permutation(len(mine))] if self.shuffle else mine
            samples = order[: len(self) * self.size]
            yield view.stored.in_memory(layers), view.at[samples], samples
            return
        pool: Pixels = {}
        left = np.empty(0, np.int64)  # samples that wait at the head of the pool for their batch to fill
        shuffler = rng if self.shuffle else None
        for pool, found, which in view.stored.pools(
            view.at[mine], layers, pieces=_POOL_PIECES, spare=self.size, rng=shuffler
        ):
            rows, samples = np.append(np.arange(len(left)), found), np.append(left, mine[which])
            full = len(rows) // self.size * self.size
            yield pool, rows[:full], samples[:full]
            left = samples[full:]
            for pixels in pool.values():
                pixels[: len(left)] = pixels[rows[full:]]
        if len(left) and not self.drop_last:
            yield pool, np.arange(len(left)), left

    def _batch(self, pixels: Pixels, rows: Ints, samples: Ints, mirrors: np.random.Generator) -> Batch:
        mirrored = mirrors.random(len(rows)) < 0.5 if self.mirror else np.zeros(len(rows), bool)
        patches = self.view.form.form(pixels, rows, mirrored)
        inputs = (patches, _compute_features(self.features, samples, mirrored)) if self.features else patches
        batch = (inputs, self.labels[samples])
        return batch if self.weights is None else (*batch, self.weights[samples])


def _compute_features(named: Sequence[tuple[str, GenericArray]], samples: Ints, mirrored: Mask) -> Floats32:
    columns = [np.where(mirrored & (name in _FLIPPED), -1.0, 1.0) * column[samples] for name, column in named]
    return np.column_stack(columns).astype(np.float32)
