"""Batches as an iterable torch dataset: imported only when a split is asked for it."""

from collections.abc import Iterator
from typing import Any

import torch
from torch.utils.data import IterableDataset, get_worker_info

from tcpipe.dataset.batches import Batches


class TorchBatches(IterableDataset[Any]):
    """Whole batches as tensors; the workers of a loader divide the split among them, and every pass is another epoch.

    It has no length: with several workers each worker's last batch may be smaller.
    """

    def __init__(self, batches: Batches) -> None:
        super().__init__()
        self._batches = batches
        self._passes = 0

    def __iter__(self) -> Iterator[Any]:
        """Iterate over this process's part of the next epoch."""
        worker, number = get_worker_info(), self._passes
        self._passes += 1
        if worker is None:
            return map(_to_tensors, self._batches.epoch(number))
        loader_seed = worker.seed - worker.id  # of this epoch, equal in all workers; set by a loader's generator
        return map(_to_tensors, self._batches.part(worker.id, worker.num_workers).epoch(loader_seed + number))


def _to_tensors(values: Any) -> Any:
    """Return arrays, and tuples of them, as tensors without copying."""
    return tuple(_to_tensors(value) for value in values) if isinstance(values, tuple) else torch.from_numpy(values)
