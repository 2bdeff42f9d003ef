"""The stored layers of a split: from memory where they fit, else decoded piece by piece."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.dataset.tensor import TensorLayout
from tcpipe.formats.dataset_files import PatchFiles

Ints = NDArray[np.int64]
Pixels = dict[str, NDArray[np.uint8 | np.uint16 | np.float32]]

IN_MEMORY_BYTES = 2 << 30
"""A split whose stored layers are smaller is kept in memory; the paper's whole dataset takes 70 MB."""

CACHED_PIECES = 64
"""Pieces kept for reading at random from a split that is not in memory."""


class StoredPixels:
    """Layers of N samples; ``rows`` says where each lies in the order of the files, (N,)."""

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
        values = sum(self.files.layers[layer].stored.itemsize for layer in layers) * self.files.patch_px**2
        return len(self.rows) * values <= IN_MEMORY_BYTES

    def in_memory(self, layers: tuple[str, ...]) -> Pixels:
        """Return the layers of all samples, and others that were asked for before, read once and kept, each of shape (N, px, px)."""
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

    def pieces_of(self, at: Ints) -> Ints:
        """Return the piece that holds each of the samples ``at``, (M,)."""
        return np.asarray(np.searchsorted(self.files.starts, self.rows[at], side="right") - 1)

    def pools(
        self, at: Ints, layers: Sequence[str], *, pieces: int, spare: int, rng: np.random.Generator | None
    ) -> Iterator[tuple[Pixels, Ints, Ints]]:
        """Yield the samples ``at`` in pools of so many pieces, each piece decoded once.

        Parameters
        ----------
        at
            Samples, shape (M,).
        layers
            Which layers.
        pieces
            Pieces in a pool.
        spare
            Rows at the head of the pool's arrays that are left to the caller, from one pool to the next.
        rng
            Shuffles the pieces, and the samples within each pool; None keeps the order of the files.

        Yields
        ------
        Arrays of the pool, which the next one overwrites; rows in them, and which of ``at`` these are, both (B,).

        """
        files, rows, piece_of = self.files, self.rows[at], self.pieces_of(at)
        order = np.argsort(piece_of, kind="stable")
        parts = np.split(order, np.flatnonzero(np.diff(piece_of[order])) + 1) if len(order) else []
        if rng is not None:
            parts = [parts[number] for number in rng.permutation(len(parts))]
        shape = (spare + min(pieces, len(parts)) * files.piece_rows, files.patch_px, files.patch_px)
        pool = {layer: np.empty(shape, files.layers[layer].stored) for layer in layers}
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
        """Read the pieces that hold ``rows`` (of the files), each once."""
        px = self.files.patch_px
        out: Pixels = {layer: np.empty((len(rows), px, px), self.files.layers[layer].stored) for layer in layers}
        piece_of = np.searchsorted(self.files.starts, rows, side="right") - 1
        pieces = np.unique(piece_of).tolist()
        for number, piece in enumerate(pieces):
            if number % CACHED_PIECES == 0:
                self.files.expect(pieces[number : number + CACHED_PIECES], layers)
            here = np.flatnonzero(piece_of == piece)
            pixels = self._piece(piece, tuple(layers))
            for layer in layers:
                out[layer][here] = pixels[layer][rows[here] - self.files.starts[piece]]
        return out

    def _piece(self, piece: int, layers: tuple[str, ...]) -> Pixels:
        key = (piece, layers)
        if key in self._pieces:
            self._pieces.move_to_end(key)
            return self._pieces[key]
        pixels = self.files.read(piece, layers)
        if not self.fit(layers):  # else every piece is read once and never again
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
