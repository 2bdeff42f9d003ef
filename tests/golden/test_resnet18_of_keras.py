"""The network gives what Keras gives with the same weights: predictions, and losses before and after a step of Adam.

``tests/data/keras_resnet18.json`` was written by tcpipe's network in Keras before that was removed. Weights and patches were drawn by
NumPy and are drawn here again, in the order of their names; the file contains names, shapes, predictions and losses. A loss is of
labels and weights of labels that were drawn last, the second one after a step of Adam of 1e-3.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from tcpipe.errors import ModelError
from tcpipe.learning.fitting import compute_loss_factors

pytest.importorskip("torch")

CASES = json.loads((Path(__file__).parents[1] / "data/keras_resnet18.json").read_text())["cases"]


def _drawn(rng, name, shape):
    uniform = rng.random(shape)
    match name.rpartition("/")[2]:
        case "kernel":
            value = (2.0 * uniform - 1.0) * np.sqrt(6.0 / np.prod(shape[:-1]))
        case "gamma" | "moving_variance":
            value = uniform + 0.5
        case _:
            value = uniform - 0.5
    return value.astype(np.float32)


_OF_NORM = {"gamma": "weight", "beta": "bias", "moving_mean": "running_mean", "moving_variance": "running_var"}


def _to_torch(name, value, names):
    """Return torch's name and layout of a weight of Keras."""
    layer, _, kind = name.rpartition("/")
    ours = _OF_NORM.get(kind) or {"kernel": "weight", "bias": "bias"}[kind]
    (known,) = [of for of in names if of.replace(".", "_") == f"{layer}_{ours}"]
    return known, value.transpose(3, 2, 0, 1) if value.ndim == 4 else value.T


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case['patch_px']}px")
def test_it_is_the_network_of_keras(case, monkeypatch):
    from tcpipe.learning import network as module
    from tcpipe.learning.network import Trainer, make_resnet18

    px, depth, outputs = case["patch_px"], case["depth"], case["outputs"]
    rng, predicted = np.random.default_rng(px), np.array(case["predicted"])
    weights = {name: _drawn(rng, name, shape) for name, shape in case["shapes"].items()}
    patches, labels, weigh = (
        rng.random(shape, np.float32) for shape in ((8, px, px, depth), (8, outputs), (8, outputs))
    )
    network = make_resnet18(depth, outputs, 16, seed=0, start=[0.0] * outputs)
    weights = dict(_to_torch(name, value, network.arrays()) for name, value in weights.items())
    network.load(weights)
    assert network.predict(patches) == pytest.approx(predicted, rel=1e-5, abs=1e-5)
    assert all(np.array_equal(array, weights[name]) for name, array in network.arrays().items())
    trainer = Trainer(network, compute_loss_factors("nrmse", [1.0] * outputs))
    weighed = module.torch.from_numpy(weigh).to(module.find_device())
    monkeypatch.setattr(
        module, "mean_loss", lambda said, true, _: (((said - true) ** 2 * weighed).sum(1) ** 0.5).mean()
    )
    first, second = (trainer.step(patches, labels, 1e-3) for _ in range(2))
    assert first == pytest.approx(case["losses"][0], rel=1e-5)
    assert second == pytest.approx(case["losses"][1], rel=1e-3)
    del weights["head.bias"]
    with pytest.raises(ModelError, match="contains the weights of another model"):
        network.load(weights)
