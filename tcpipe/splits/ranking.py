"""Ranks that depend on a name and a seed alone: the same on every machine, and unmoved when other names are added."""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

Ranks = NDArray[np.uint64]


def hash_ranks(names: Sequence[str], *, seed: int, purpose: str) -> Ranks:
    """Return a number for each name, uniform over 64 bits.

    Parameters
    ----------
    names : what is ranked: sample ids, run ids or block keys.
    seed : the recipe's ``split.seed``.
    purpose : salt: ranks for two purposes are independent, so that the row order says nothing of the holdout.

    Returns
    -------
    Ranks, shape (N,): the first 8 bytes, big-endian, of blake2b over ``seed:name`` with ``purpose`` as person string.
    """
    person = purpose.encode()[:16]
    digests = b"".join(blake2b(f"{seed}:{name}".encode(), digest_size=8, person=person).digest() for name in names)
    return np.frombuffer(digests, dtype=">u8").astype(np.uint64)


def sort_by_rank(names: Sequence[str], *, seed: int, purpose: str) -> NDArray[np.int64]:
    """Return the indices that sort ``names`` by their rank, names themselves breaking a tie; shape (N,)."""
    ranks = hash_ranks(names, seed=seed, purpose=purpose)
    order = np.argsort(ranks, kind="stable")
    if (np.diff(ranks[order]) == 0).any():
        order = np.lexsort((np.asarray(names, dtype=np.str_), ranks))
    return order.astype(np.int64, copy=False)


def order_ranks(sample_ids: Sequence[str], *, seed: int) -> Ranks:
    """Return the rank of each sample in the seeded shuffle of the dataset's rows, shape (N,)."""
    return hash_ranks(sample_ids, seed=seed, purpose="order")
