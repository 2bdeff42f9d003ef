"""The paper's network (section III-D) and its training step in plain torch: ResNet-18 with two outputs, and Adam.

Import it only where a network is created. He et al., Deep Residual Learning for Image Recognition, 2016, table 1: a 7 ×
7 convolution and a pooling, both with stride 2, then two basic blocks each of 64, 128, 256 and 512 filters. The paper
used Keras: strides of two are padded as TensorFlow's "same" does, with the last of an odd number of padding pixels
after the image; initial weights and the constants of batch normalisation are those of Keras.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from tcpipe.arrays import Floats32, NamedArrays
from tcpipe.errors import ModelError
from tcpipe.formats.weights import check_arrays
from tcpipe.learning.fitting import mean_loss

_TOGETHER = 256  # patches in one forward pass

# Standard deviation of a standard normal variable that is truncated at ±2; Keras's ``he_normal`` divides by it.
_TRUNCATED_STD = 0.87962566103423978


class Normed(nn.Module):
    """A convolution and its batch normalisation."""

    def __init__(self, depth: int, filters: int, size: int, stride: int) -> None:
        super().__init__()
        around = size // 2 if stride == 1 else 0
        self.convolution = nn.Conv2d(depth, filters, size, stride, around, bias=False)
        # Here, momentum is the weight of the new value; in Keras it is that of the old value, 0.9.
        self.norm = nn.BatchNorm2d(filters, eps=1e-5, momentum=0.1)

    def forward(self, images: Any) -> Any:
        """Return (N, filters, rows, columns)."""
        size, stride = self.convolution.kernel_size[0], self.convolution.stride[0]
        return self.norm(self.convolution(images if stride == 1 else _pad_images(images, size, stride)))


class BasicBlock(nn.Module):
    """Two convolutions, added to the input, which is convolved 1 × 1 if its shape changes."""

    def __init__(self, depth: int, filters: int, stride: int) -> None:
        super().__init__()
        self.first = Normed(depth, filters, 3, stride)
        self.second = Normed(filters, filters, 3, 1)
        self.shortcut = Normed(depth, filters, 1, stride) if stride != 1 or depth != filters else nn.Identity()

    def forward(self, images: Any) -> Any:
        """Return (N, filters, rows, columns)."""
        return functional.relu(self.second(functional.relu(self.first(images))) + self.shortcut(images))


class ResNet18(nn.Module):
    """Patches, float32 (N, depth, px, px), to outputs, (N, outputs); ``width``: filters of the first stage (64)."""

    def __init__(self, depth: int, outputs: int, width: int) -> None:
        super().__init__()
        self.stem = Normed(depth, width, 7, 2)
        depth = width
        for stage in range(4):
            for block in range(2):
                filters, stride = width << stage, 2 if stage and not block else 1
                self.add_module(f"stage{stage + 1}_block{block + 1}", BasicBlock(depth, filters, stride))
                depth = filters
        self.head = nn.Linear(depth, outputs)

    def forward(self, images: Any) -> Any:
        """Return the outputs."""
        values = functional.relu(self.stem(images))
        values = functional.max_pool2d(_pad_images(values, 3, 2), 3, 2)  # zeros: the least value after a ReLU
        for name, block in self.named_children():
            values = block(values) if name.startswith("stage") else values
        return self.head(values.mean((2, 3)))

    def predict(self, patches: Floats32) -> Floats32:
        """Return outputs of patches of shape (N, px, px, depth), some at a time, shape (N, outputs)."""
        self.eval()
        out = np.empty((len(patches), self.head.out_features), np.float32)
        with torch.inference_mode():
            for first in range(0, len(patches), _TOGETHER):
                part = slice(first, first + _TOGETHER)
                out[part] = self(move_to_device(patches[part])).numpy(force=True)
        return out

    def arrays(self) -> dict[str, Floats32]:
        """Return a copy of every weight by torch's name."""
        return {name: value.numpy(force=True).copy(order="C") for name, value in self._list_weights().items()}

    @classmethod
    def from_arrays(cls, depth: int, outputs: int, width: int, *, arrays: NamedArrays) -> ResNet18:
        """Return a network with its weights; `ModelError` for weights of other sizes, before memory is allocated."""
        with torch.device("meta"):
            network = cls(depth, outputs, width)
        network.load(arrays)
        return network

    def load(self, arrays: NamedArrays) -> None:
        """Set the weights and move to the device; `ModelError` if they are another network's."""
        forms = {name: ("float32", tuple(value.shape)) for name, value in self._list_weights().items()}
        check_arrays(arrays, forms)
        self.to_empty(device=find_device())
        self.to(memory_format=torch.channels_last)
        for name, value in self._list_weights().items():
            value.copy_(torch.from_numpy(np.ascontiguousarray(arrays[name])))

    def _list_weights(self) -> dict[str, Any]:
        """Return every weight without the count of batches, which a fixed momentum does not need."""
        return {name: weight for name, weight in self.state_dict().items() if not name.endswith("num_batches_tracked")}


def make_resnet18(depth: int, outputs: int, width: int, *, seed: int, start: Sequence[float]) -> ResNet18:
    """Return the untrained network on the available device; ``start``: mean predictions, as biases of the head."""
    network, drawn = ResNet18(depth, outputs, width), torch.Generator().manual_seed(seed)
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d):
            deviation = math.sqrt(2.0 / layer.weight[0].numel()) / _TRUNCATED_STD
            nn.init.trunc_normal_(layer.weight, 0.0, deviation, -2.0 * deviation, 2.0 * deviation, generator=drawn)
    nn.init.normal_(network.head.weight, 0.0, 0.01, generator=drawn)
    network.head.bias.data[:] = torch.tensor(list(start))
    made: ResNet18 = network.to(find_device(), memory_format=torch.channels_last)
    return made


def find_device() -> Any:
    """Return the device of networks."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def find_device_name() -> str:
    """Return the name of the GPU that networks run on, else ``cpu``."""
    return str(torch.cuda.get_device_name()) if torch.cuda.is_available() else "cpu"


def move_to_device(patches: Floats32) -> Any:
    """Return patches (N, px, px, depth) as images (N, depth, px, px), with the memory layout of the patches."""
    return torch.from_numpy(np.ascontiguousarray(patches, np.float32)).to(find_device()).permute(0, 3, 1, 2)


def _pad_images(images: Any, size: int, stride: int) -> Any:
    """Put zeros around images so that a window in steps gives ceil(pixels / stride), as TensorFlow's "same" does."""
    sizes = map(int, images.shape[:1:-1])  # numbers: a graph that torch traced with sizes as tensors gave wrong outputs
    missing = [max((-(-pixels // stride) - 1) * stride + size - pixels, 0) for pixels in sizes]
    return functional.pad(images, [part for pixels in missing for part in (pixels // 2, pixels - pixels // 2)])


_DIGEST_BYTES = 32  # size of the SHA-256 before a packed state [byte]

_EPSILON = 1e-7  # epsilon of Adam [1]: that of Keras; torch's default is 1e-8


class Trainer:
    """A network and the optimiser that trains it: arrays in, arrays out."""

    def __init__(self, network: ResNet18, factors: Floats32) -> None:
        self.network = network
        self._factors = torch.from_numpy(factors).to(find_device())
        self.optimizer = torch.optim.Adam(network.parameters(), eps=_EPSILON)

    def pack_state(self, parts: Mapping[str, Any]) -> bytes:
        """Return weights, the optimiser's memory and other parts of a training as bytes."""
        state = {"network": self.network.state_dict(), "optimizer": self.optimizer.state_dict(), **parts}
        torch.save(state, memory := io.BytesIO())
        packed = memory.getvalue()
        return sha256(packed).digest() + packed

    def read_state(self, path: Path) -> dict[str, Any]:
        """Continue from a file of `pack_state`, and return the other parts; `ModelError` if it is damaged."""
        try:
            data = path.read_bytes()
            packed = data[_DIGEST_BYTES:] if sha256(data[_DIGEST_BYTES:]).digest() == data[:_DIGEST_BYTES] else b""
            state: dict[str, Any] = torch.load(io.BytesIO(packed), weights_only=True, map_location="cpu")
            self.network.load_state_dict(state.pop("network"))
            self.optimizer.load_state_dict(state.pop("optimizer"))
        except Exception as error:  # noqa: BLE001  those of torch, pickle and zipfile have no common base
            reason = str(error).partition("\n")[0]
            raise ModelError(
                f"{path}: truncated or damaged ({reason}); remove it, or start again with --no-resume"
            ) from None
        return state

    def copy_weights(self) -> dict[str, Any]:
        """Return a copy of every weight by torch's name."""
        return {name: value.clone() for name, value in self.network.state_dict().items()}

    def step(self, patches: Floats32, labels: Floats32, learning_rate: float) -> float:
        """Train on a batch, patches (N, px, px, depth) and labels (N, outputs); return its mean loss."""
        if len(patches) == 1:  # batch normalisation needs two values; a repeated sample has the same mean and gradient
            patches, labels = (np.repeat(values, 2, axis=0) for values in (patches, labels))
        self.optimizer.param_groups[0]["lr"] = learning_rate
        self.network.train()
        wanted = torch.from_numpy(labels).to(find_device())
        loss = mean_loss(self.network(move_to_device(patches)), wanted, self._factors)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return float(loss.detach())
