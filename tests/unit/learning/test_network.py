"""The network alone: which widths it has, and that a narrow one trains on odd batches and several threads."""

import os
import subprocess
import sys

import pytest

from tcpipe.errors import ModelError
from tcpipe.learning.network import Architecture, resnet18

pytest.importorskip("torch")
pytest.importorskip("keras")

STEPS = """
import numpy as np
from tcpipe.learning.keras_backend import load_keras
from tcpipe.learning.network import Architecture, resnet18
network = resnet18(Architecture(40, 1, 1, 16), seed=0, start=[0.5])
network.compile(load_keras().optimizers.Adam(1e-3), loss="mse")
rng = np.random.default_rng(0)
for count in (11, 11, 35, 3) * 2:
    network.train_on_batch(rng.random((count, 40, 40, 1), np.float32), rng.random((count, 1), np.float32))
"""


def test_odd_batches_of_a_narrow_network_on_two_threads():
    """With 8 filters this ends with "corrupted size vs. prev_size" (torch 2.13.0)."""
    subprocess.run([sys.executable, "-c", STEPS], env={**os.environ, "OMP_NUM_THREADS": "2"}, check=True)


@pytest.mark.parametrize("width", [4, 8, 24])
def test_widths_that_are_no_multiple_of_sixteen(width):
    with pytest.raises(ModelError, match=f"a network of width {width}: wanted a multiple of 16"):
        resnet18(Architecture(40, 3, 2, width), seed=0, start=[0.0, 0.0])
