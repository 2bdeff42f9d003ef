"""A cost model whose truth is known in closed form: it reads slope and class off the patch and answers by a formula."""

from dataclasses import dataclass, field, fields
from types import SimpleNamespace

import numpy as np

from tcpipe.cost.prediction_errors import fit_errors
from tcpipe.dataset.tensor import TensorLayout
from tcpipe.learning.model_card import TrainingRange
from tcpipe.learning.predictor import Prediction
from tcpipe.tables.facts import PhysicsFit
from tcpipe.terrain.layers import PAPER_CLASSES, PAPER_LAYERS, ClassTable, make_paper_layers

CLASSES_SEEN = (4, 5, 6, 7)


def velocity_mps(class_id, slope):
    """Slower on higher ids, and slower the steeper, up or down; ``slope`` is tan of the angle along travel."""
    return (1.0 - 0.08 * (np.asarray(class_id) - 4.0)) / (1.0 + 2.0 * np.abs(slope))


def power_watt(class_id, slope):
    """Rolling resistance by class and the whole of the grade, downhill given back: force times velocity, and 40 W that always go."""
    return 40.0 + velocity_mps(class_id, slope) * (
        60.0 + 20.0 * (np.asarray(class_id) - 4.0) + 300.0 * np.asarray(slope)
    )


def energy_joule(class_id, slope):
    """Energy a metre."""
    return power_watt(class_id, slope) / velocity_mps(class_id, slope)


def made_residuals(count=400, sigma=0.1, shared=0.0, seed=0, runs=8):
    """Held-out samples a metre apart: velocity right, power off by ``sigma``; the share ``shared`` of its variance is each run's own."""
    rng = np.random.default_rng(seed)
    run = np.arange(count) * runs // count
    error = sigma * (np.sqrt(shared) * rng.normal(size=runs)[run] + np.sqrt(1.0 - shared) * rng.normal(size=count))
    said = np.full(count, 150.0)
    return {
        "run_id": np.array([f"run{n}" for n in run]),
        "start_ns": (np.arange(count) * 1_250_000_000).astype(np.int64),
        "terrain_class": np.full(count, 4),
        "power_watt": said * (1.0 + error),
        "velocity_mps": np.full(count, 0.8),
        "power_predicted_watt": said,
        "velocity_predicted_mps": np.full(count, 0.8),
    }


@dataclass(frozen=True)
class PhysicsModel:
    """Has what planning takes of a `tcpipe.learning.models.Model`; its card is itself, with flat fields."""

    name: str = "physics"
    checksum: str = "0" * 64
    robot: str = "husky"
    classes: ClassTable = PAPER_CLASSES
    channels: tuple = ("ortho", "terrain", "height")
    patch_m: float = 1.0
    patch_px: int = 40
    chord_m: float = 1.0
    max_arc_to_chord: float = 1.02
    label_velocity: str = "ground"
    label_energy: str = "total"
    class_counts: dict = field(default_factory=lambda: dict.fromkeys(CLASSES_SEEN, 100))
    pixel_classes: tuple = CLASSES_SEEN
    training_range: dict = field(
        default_factory=lambda: {"slope_rad": (-0.5, 0.5), "cross_slope_rad": (-0.5, 0.5), "relief_m": (0.0, 1.0)}
    )
    residuals: dict = field(default_factory=made_residuals)
    physics: PhysicsFit | None = None
    takes_turns: bool = False
    is_time_alone: bool = False
    dataset: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(name="another", sha256="0" * 64))

    @property
    def card(self):
        layout = TensorLayout(self.channels, make_paper_layers(PAPER_LAYERS, self.classes), self.patch_px)
        seen = TrainingRange(self.class_counts, self.pixel_classes, self.training_range)
        own = {entry.name: getattr(self, entry.name) for entry in fields(PhysicsModel)}
        return SimpleNamespace(
            **own | {"inputs": self, "layout": layout, "class_table": self.classes, "training_range": seen}
        )

    @property
    def errors(self):
        return fit_errors(self.residuals)

    def find_near(self, lonlat_deg):
        return np.zeros(len(lonlat_deg), np.bool_)

    def ask(self, patches, features=None):
        return Prediction.without_covariance(self.predict(patches, features))

    def predict(self, patches, beside=None):  # noqa: ARG002  it is told nothing that it wants
        height = patches[..., self.channels.index("height")].astype(np.float64)
        px = height.shape[1]
        along = (np.arange(px) + 0.5) / px * self.patch_m
        along -= along.mean()
        slope = (height.mean(axis=1) * along).sum(axis=1) / (along**2).sum()
        class_id = np.full(len(patches), 4.0)
        if "terrain" in self.channels:
            middle = patches[:, px // 2, px // 2, self.channels.index("terrain")]
            class_id = np.rint(middle * (self.classes.count - 1) + 1)
        return np.stack([power_watt(class_id, slope), velocity_mps(class_id, slope)], axis=1).astype(np.float32)
