"""A model folder without training: a narrow network with random weights, and residuals that were drawn; evaluations without figures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from tcpipe.learning.baselines import BaselineResult
from tcpipe.learning.evaluation import (
    EvaluateConfig,
    EvaluatedDataset,
    EvaluatedModel,
    Evaluation,
)
from tcpipe.learning.fitting import FitConfig
from tcpipe.learning.metrics import Errors, Ratio
from tcpipe.learning.model_card import ModelCard, TrainedOn, Training, TrainingRange
from tcpipe.learning.models import write_model
from tcpipe.learning.predictor import Inputs
from tcpipe.terrain.layers import PAPER_CLASSES

INPUTS = Inputs(
    channels=("ortho", "terrain", "height"), patch_px=40, planes=("ortho", "terrain", "height"), patch_m=1.0,
    class_count=PAPER_CLASSES.count, extra_features=(), outputs=("power_watt", "velocity_mps"), scale=(400.0, 1.0),
)  # fmt: skip

CARD = ModelCard(
    inputs=INPUTS,
    chord_m=1.0,
    max_arc_to_chord=1.02,
    label_velocity="ground",
    robot="husky",
    classes=PAPER_CLASSES.classes,
    training_range=TrainingRange(
        {4: 60, 6: 25, 7: 15},
        (4, 6, 7),
        {"slope_rad": (-0.3, 0.3), "cross_slope_rad": (-0.25, 0.25), "relief_m": (0.0, 0.5)},
    ),
    dataset=TrainedOn("made", "0" * 64, "1.0", {"train": 100}),
    training=Training("key", FitConfig(), "resnet18", {"fitted": 80, "held out": 20}, 3, 2, 0.1, "cpu"),
)


def made_model(directory: Path, *, seed: int = 0, rows: int = 60, width: int = 16, **changes) -> Path:
    """Write a model folder; ``changes`` replace fields of its card, or of its inputs."""
    from tcpipe.learning.network import make_resnet18  # needs torch

    of_inputs = {name: changes.pop(name) for name in list(changes) if hasattr(INPUTS, name)}
    card = replace(CARD, inputs=replace(INPUTS, **of_inputs), **changes)
    outputs = len(card.inputs.outputs)
    network = make_resnet18(card.inputs.depth, outputs, width, seed=seed, start=(0.4, 0.85)[:outputs])
    rng = np.random.default_rng(seed)
    power, velocity = rng.uniform(100.0, 250.0, rows), rng.uniform(0.7, 0.95, rows)
    residuals = pa.table(
        {
            "run_id": ["one"] * (rows // 2) + ["two"] * (rows - rows // 2),
            "start_ns": np.arange(rows) * 1_200_000_000,
            "terrain_class": rng.choice([4, 6, 7], rows).astype(np.uint8),
            "power_watt": power,
            "velocity_mps": velocity,
            "power_predicted_watt": power + rng.normal(0.0, 8.0, rows),
            "velocity_predicted_mps": velocity + rng.normal(0.0, 0.02, rows),
        }
    )
    ground = pa.table({"lon_deg": np.empty(0), "lat_deg": np.empty(0)})
    write_model(
        directory, card=card, weights=network.arrays(), residuals=residuals, ground=ground, history="epoch,loss\n",
    )  # fmt: skip
    return directory


def made_comparison(
    baseline: str, ratio: Ratio, *, quantity="E", split="unseen", rmse=5.0, groups=34
) -> BaselineResult:
    """A model beside a baseline, whose errors are ``ratio`` of the baseline's."""
    errors = Errors(50, rmse, 5.0, 50)
    return BaselineResult(
        baseline=baseline, split=split, quantity=quantity, errors=errors, rmse_ratio=ratio, groups=groups,
        drawn_by="runs",
    )  # fmt: skip


def made_evaluation(**changes) -> Evaluation:
    """An evaluation without any figure; ``changes`` replace its fields."""
    empty = Evaluation(
        tcpipe_version="", key="", model=EvaluatedModel("", "", CARD.training), dataset=EvaluatedDataset("", "", {}),
        config=EvaluateConfig(), splits={}, ablation=(), time={},
    )  # fmt: skip
    return replace(empty, **changes)
