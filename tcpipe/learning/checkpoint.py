"""Where training stands, after every epoch: one file, so that a killed training goes on as if nothing had happened."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import ModelError
from tcpipe.formats.weights import read_arrays, write_arrays

Arrays = Mapping[str, NDArray[np.generic]]

_STATE = "state"


@dataclass(slots=True)
class TrainingProgress:
    """Losses so far; ``best_epoch`` counts from 1, as does ``epoch``."""

    key: str
    """Of dataset and options: a checkpoint of others is not gone on from."""
    epoch: int = 0
    best_epoch: int = 0
    best_loss: float = float("inf")
    history: list[tuple[int, float, float]] = field(default_factory=list)
    """Epoch, loss, loss of the held-out fold."""


def write_checkpoint(
    path: Path, progress: TrainingProgress, parts: Mapping[str, Mapping[str, NDArray[np.generic]]]
) -> None:
    """Write where training stands and its weights, whole or not at all."""
    state = np.frombuffer(json.dumps(asdict(progress)).encode(), np.uint8)  # keeps what is infinite or not a number
    arrays = {f"{part}/{name}": array for part, named in parts.items() for name, array in named.items()}
    write_arrays(path, {_STATE: state, **arrays})


def read_checkpoint(path: Path, key: str) -> tuple[TrainingProgress, dict[str, Arrays]]:
    """Return what `write_checkpoint` wrote. `ModelError`: it is cut short, or of another dataset or other options."""
    try:
        arrays = read_arrays(path)
        progress = _read_progress(json.loads(arrays.pop(_STATE).tobytes()))
    except (ModelError, KeyError, TypeError, ValueError) as error:
        reason = error.problems[0].removeprefix(f"{path}: ") if isinstance(error, ModelError) else "not a checkpoint"
        raise ModelError(f"{path}: {reason}; remove it, or start anew with --no-resume") from None
    if progress.key != key:
        raise ModelError(f"{path}: of another dataset or other options; remove it, or start anew with --no-resume")
    parts: dict[str, dict[str, NDArray[np.generic]]] = {}
    for name, array in arrays.items():
        part, _, rest = name.partition("/")
        parts.setdefault(part, {})[rest] = array
    return progress, dict(parts)


def _read_progress(found: Any) -> TrainingProgress:
    """Return what was saved of a `TrainingProgress`; ValueError, TypeError or KeyError where it is none."""
    history = [(int(epoch), float(loss), float(held)) for epoch, loss, held in found["history"]]
    made = TrainingProgress(**{**found, "best_loss": float(found["best_loss"]), "history": history})
    if [row[0] for row in history] != list(range(1, made.epoch + 1)) or made.best_epoch not in range(made.epoch + 1):
        raise ValueError(made)
    return made
