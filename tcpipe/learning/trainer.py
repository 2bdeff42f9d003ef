"""One step of training after another: a network and Adam, in plain torch; import it only where a network is trained."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tcpipe.errors import ModelError
from tcpipe.learning.losses import mean_loss
from tcpipe.learning.network import Arrays, Floats, ResNet18, find_device, move_to_device

_EPSILON = 1e-7
"""Of Adam, as Keras has it; torch's own is 1e-8."""


class Trainer:
    """A network and the optimiser that trains it: arrays in, arrays out."""

    def __init__(self, network: ResNet18, factors: Floats) -> None:
        self.network = network
        self._factors = torch.from_numpy(factors).to(find_device())
        self._optimizer = torch.optim.Adam(network.parameters(), eps=_EPSILON)
        for weight in network.parameters():  # as its first step makes it: a state has the same arrays before and after
            self._optimizer.state[weight] = {
                "step": torch.tensor(0.0),
                "exp_avg": torch.zeros_like(weight),
                "exp_avg_sq": torch.zeros_like(weight),
            }

    def step(self, patches: Floats, labels: Floats, weights: Floats, learning_rate: float) -> float:
        """Train on a batch, patches (N, px, px, depth), labels and weights (N, outputs); return its mean loss."""
        if (
            len(patches) == 1
        ):  # of a single pixel torch has no deviation; twice the same sample has the same mean and gradient
            patches, labels, weights = (np.repeat(values, 2, axis=0) for values in (patches, labels, weights))
        self._optimizer.param_groups[0]["lr"] = learning_rate
        self.network.train()
        wanted, weigh = (torch.from_numpy(values).to(find_device()) for values in (labels, weights))
        loss = mean_loss(self.network(move_to_device(patches)), wanted, self._factors, weigh)
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()
        return float(loss.detach())

    def memory(self) -> dict[str, NDArray[np.float32]]:
        """Return a copy of what the optimiser remembers: of every weight its step and two moments."""
        return {name: value.numpy(force=True).copy() for name, value in self._memory()}

    def remember(self, arrays: Arrays, where: str) -> None:
        """Put back what `memory` gave; `ModelError` if it is of another network."""
        there = dict(self._memory())
        if {name: value.shape for name, value in arrays.items()} != {name: tuple(v.shape) for name, v in there.items()}:
            raise ModelError(f"{where}: holds the weights of another network; remove it and train the model again")
        for name, value in there.items():
            value.copy_(torch.from_numpy(np.array(arrays[name])))

    def _memory(self) -> Iterator[tuple[str, Any]]:
        for name, weight in self.network.named_parameters():
            for part, value in self._optimizer.state[weight].items():
                yield f"{name}/{part}", value
