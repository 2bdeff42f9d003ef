"""Batches of a split, epoch by epoch: numpy arrays for Keras, JAX, torch or any loop."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.dataset.pixels import Pixels, SampleView

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
Batch = tuple[Floats | tuple[Floats, Floats], ...]

_FLIPPED = ("cross_slope_rad",)
"""Columns whose sign changes when a sample is mirrored across its direction of travel."""

_POOL_PIECES = 16
"""Pieces whose samples are shuffled among each other: 4096 samples of a Zarr dataset, 26 MB."""


@dataclass(frozen=True, slots=True)
class BatchContent:
    """What batches are made of, sample by sample: pixels, labels, shape (N, 2), weights (N, 2) and named columns (N,) if wanted."""

    view: SampleView
    labels: Floats
    weights: Floats | None
    features: tuple[tuple[str, NDArray[np.generic]], ...]


@dataclass(frozen=True, slots=True)
class BatchRules:
    """How batches are made: what `Split.batches` was given."""

    size: int
    shuffle: bool
    seed: int
    mirror: bool
    drop_last: bool
    from_disk: bool
    shard: tuple[int, int] = (0, 1)
    """Number of this part of the split and of all its parts."""


class Batches:
    """Batches of one split; iterating again is the next epoch, with its own shuffle.

    Each batch is ``(patches, labels)``, or ``(patches, labels, weights)`` with ``weights``, a weight for each label; with ``features``,
    patches are replaced by ``(patches, features)``.
    """

    def __init__(self, content: BatchContent, rules: BatchRules) -> None:
        self._content = content
        self._rules = rules
        self._next = 0
        number, count = rules.shard
        self._samples: Ints = np.arange(len(content.view.at))
        if count > 1 and rules.from_disk:
            piece_of = content.view.stored.pieces_of(content.view.at)
            self._samples = np.flatnonzero(np.isin(piece_of, np.unique(piece_of)[number::count]))
        elif count > 1:
            self._samples = self._samples[number::count]

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        n, size = len(self._samples), self._rules.size
        return n // size if self._rules.drop_last else -(-n // size)

    def __iter__(self) -> Iterator[Batch]:
        """Iterate over the next epoch."""
        self._next += 1
        return self.epoch(self._next - 1)

    def part(self, number: int, count: int) -> Batches:
        """Return the batches of one of ``count`` parts of the split, for processes that divide it among them."""
        return Batches(self._content, replace(self._rules, shard=(number, count)))

    def forever(self) -> Iterator[Batch]:
        """Iterate over epoch after epoch without an end; Keras wants ``steps_per_epoch=len(batches)`` with it."""
        for number in itertools.count():  # a generator: Keras takes no other iterator
            yield from self.epoch(number)

    def epoch(self, number: int) -> Iterator[Batch]:
        """Iterate over one epoch; the same number gives the same batches."""
        rules = self._rules
        mirrors = np.random.default_rng([rules.seed, number, 1])
        for pixels, rows, samples in self._full(np.random.default_rng([rules.seed, number])):
            for first in range(0, len(rows), rules.size):
                cut = slice(first, first + rules.size)
                yield self._batch(pixels, rows[cut], samples[cut], mirrors)

    def _full(self, rng: np.random.Generator) -> Iterator[tuple[Pixels, Ints, Ints]]:
        """Yield pixels, rows in them and the samples that these are: whole batches, but for the last ones of the epoch."""
        rules, view, mine = self._rules, self._content.view, self._samples
        layers = view.form.layers
        if not rules.from_disk:
            order = mine[rng.permutation(len(mine))] if rules.shuffle else mine
            samples = order[: len(self) * rules.size]
            yield view.stored.in_memory(layers), view.at[samples], samples
            return
        pool: Pixels = {}
        left = np.empty(0, np.int64)  # samples that wait at the head of the pool for their batch to fill
        shuffler = rng if rules.shuffle else None
        for pool, found, which in view.stored.pools(
            view.at[mine], layers, pieces=_POOL_PIECES, spare=rules.size, rng=shuffler
        ):
            rows, samples = np.append(np.arange(len(left)), found), np.append(left, mine[which])
            full = len(rows) // rules.size * rules.size
            yield pool, rows[:full], samples[:full]
            left = samples[full:]
            for pixels in pool.values():
                pixels[: len(left)] = pixels[rows[full:]]
        if len(left) and not rules.drop_last:
            yield pool, np.arange(len(left)), left

    def _batch(self, pixels: Pixels, rows: Ints, samples: Ints, mirrors: np.random.Generator) -> Batch:
        content = self._content
        mirrored = mirrors.random(len(rows)) < 0.5 if self._rules.mirror else np.zeros(len(rows), np.bool_)
        patches = content.view.form.form(pixels, rows, mirrored)
        given = (patches, _compute_features(content.features, samples, mirrored)) if content.features else patches
        batch = (given, content.labels[samples])
        return batch if content.weights is None else (*batch, content.weights[samples])


def _compute_features(
    named: Sequence[tuple[str, NDArray[np.generic]]], samples: Ints, mirrored: NDArray[np.bool_]
) -> NDArray[np.float32]:
    columns = [np.where(mirrored & (name in _FLIPPED), -1.0, 1.0) * column[samples] for name, column in named]
    return np.column_stack(columns).astype(np.float32)
