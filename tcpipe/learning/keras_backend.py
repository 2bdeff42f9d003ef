"""The one home of Keras and its backend: torch, unless ``KERAS_BACKEND`` says otherwise; nothing is imported before it is asked for."""

from __future__ import annotations

import os
from importlib.util import find_spec
from typing import Any

from tcpipe.errors import ModelError

BACKEND_VARIABLE = "KERAS_BACKEND"


def load_keras() -> Any:
    """Return the module ``keras`` on its backend.

    Raises
    ------
    ModelError
        Keras or the backend is not installed.

    """
    backend = os.environ.setdefault(BACKEND_VARIABLE, "torch")
    missing = [name for name in ("keras", backend) if find_spec(name) is None]
    if missing:
        raise ModelError(
            f"{' and '.join(missing)} not installed, wanted to train or use a network: pip install 'tcpipe[train]'"
        )
    import keras  # noqa: PLC0415  torch takes seconds and half a gigabyte

    return keras


def device_name() -> str:
    """Return what networks run on: the name of the GPU that Keras takes when there is one, else ``cpu``."""
    keras = load_keras()
    if keras.config.backend() != "torch":
        return str(keras.config.backend())
    import torch  # noqa: PLC0415

    return str(torch.cuda.get_device_name()) if torch.cuda.is_available() else "cpu"
