"""What an evaluation found, ``evaluation.json``: errors by split, quantity and class, beside what the labels' own noise allows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeAlias

from tcpipe.cost.coverage import Coverage
from tcpipe.dataset.energies import EnergyName
from tcpipe.learning.fitting import Seed
from tcpipe.learning.metrics import Errors, Ratio
from tcpipe.learning.model_card import Training
from tcpipe.tables.bounds import Bounds
from tcpipe.tables.facts import ABSENT, Floor
from tcpipe.tables.findings import PREDICTED, Affected, Finding, Verdict

KIND = "tcpipe evaluation"

SPLITS = ("test", "unseen")

ErrorsByClass: TypeAlias = Mapping[str, Mapping[str, Errors]]
"""By quantity, then by the name of a class, or `tcpipe.learning.metrics.ALL`."""


@dataclass(frozen=True, slots=True)
class EvaluateConfig:
    """How much is evaluated."""

    noise_draws: Annotated[int, Bounds(ge=1, le=1000)] = 5
    """Draws of noise that each ablated input set is the mean of."""
    baselines: bool = True
    """Train networks of each class alone, and those of Wei & Isler."""
    seed: Seed = 0
    """Of the noise."""


@dataclass(frozen=True, slots=True)
class EvaluatedModel:
    """Which model was evaluated."""

    name: str
    checksum: str
    training: Training
    label_energy: EnergyName = "total"
    """Which power and energy it predicts, and was measured by."""


@dataclass(frozen=True, slots=True)
class EvaluatedDataset:
    """On which dataset."""

    name: str
    sha256: str
    """Over the checksums of its files."""
    samples: Mapping[str, int]
    """By split."""


@dataclass(frozen=True, slots=True)
class Leakage:
    """What of a split stands beside training, of the dataset that the evaluation is on."""

    holdout: str
    """How test was drawn: by sample, as in the paper, block, run or tag."""
    within_m: float
    near_percent: float
    """Samples whose middle is within that of one of train."""
    sharing_percent: float | None
    """Samples whose footprint shares ground with one of train, by the dataset's own audit."""


@dataclass(frozen=True, slots=True)
class SplitErrors:
    """Tables I and II of one split, and what its labels' deviations, or the simulator, allow."""

    samples: int
    classes: Mapping[str, int]
    """Samples by the name of their class."""
    class_order: tuple[str, ...]
    errors: ErrorsByClass
    coverage: Mapping[str, Coverage]
    """By quantity, of all classes; empty where the model states no intervals."""
    uncentred: Mapping[str, Errors]
    """Of all classes, by quantity, of predictions as the model gives them; all other errors are of predictions centred by class."""
    label_floor: ErrorsByClass
    simulation_floor: ErrorsByClass | None = field(default=None, metadata=ABSENT)
    """Of what can be predicted at best where the samples were simulated."""
    leakage: Leakage | None = field(default=None, metadata=ABSENT)
    """How much of it was met in training; None where nothing trains, or places are not known."""

    @property
    def floors(self) -> dict[str, ErrorsByClass]:
        """Return what an error can hardly be less than, by its key."""
        simulated = {} if self.simulation_floor is None else {"simulation_floor": self.simulation_floor}
        return {"label_floor": self.label_floor, **simulated}


@dataclass(frozen=True, slots=True)
class AblationRow:
    """A row of table III: layers that are left, the others being noise, and the errors on each split by quantity."""

    layers: tuple[str, ...]
    test: Mapping[str, Errors] | None = field(default=None, metadata=ABSENT)
    unseen: Mapping[str, Errors] | None = field(default=None, metadata=ABSENT)

    def on(self, split: str) -> Mapping[str, Errors]:
        """Return the errors on a split that was evaluated."""
        return (self.test if split == "test" else self.unseen) or {}


@dataclass(frozen=True, slots=True, kw_only=True)
class BaselineResult:
    """A baseline beside the model, on the same samples: its errors, and the ratios of the model's to them."""

    baseline: str
    split: str
    quantity: str
    errors: Errors
    rmse_ratio: Ratio
    """Of the model over the baseline: below 1 the model is better."""
    uncentred: Errors
    """Of its predictions as it gives them, not centred by class; the same of the ratio."""
    uncentred_rmse_ratio: Ratio
    groups: int
    """That the intervals were drawn from."""
    drawn_by: Literal["runs", "blocks"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """All of evaluation.json."""

    kind: str = KIND
    schema_version: int = 3
    tcpipe_version: str
    key: str
    """Hash of model, dataset and options: the same key, the same evaluation."""
    model: EvaluatedModel
    dataset: EvaluatedDataset
    config: EvaluateConfig
    splits: Mapping[str, SplitErrors]
    ablation: tuple[AblationRow, ...]
    energy: Mapping[str, Mapping[str, Errors]]
    """Table IV: errors of E by predictor and split, of the same samples."""
    networks: tuple[BaselineResult, ...] = ()
    """Those of networks of each class and of Wei and Isler, with the ratios of the model's to them."""
    time: Mapping[str, Mapping[str, Errors]]
    """Table V: errors of T by predictor and split."""
    blocks: ErrorsByClass | None = field(default=None, metadata=ABSENT)
    """Of the model on blocks of ground that it was not fitted on, which it keeps as its held-out samples."""
    baselines: tuple[BaselineResult, ...] = ()
    """Of all classes together, by split, baseline and quantity."""
    repeatability: Mapping[str, Floor | None]
    """How well each label repeats itself where ground was driven twice; None where none was."""
    findings: tuple[Finding, ...] = ()
    verdict: Verdict = field(default_factory=Verdict)

    @property
    def costs(self) -> tuple[Literal["E", "T"], ...]:
        """Return which of energy and time were evaluated."""
        known = {quantity for part in self.splits.values() for quantity in part.errors}
        both: tuple[Literal["E", "T"], ...] = ("E", "T")
        return tuple(quantity for quantity in both if quantity in known)

    @property
    def judged(self) -> tuple[Affected, ...]:
        """Return what the verdict is about."""
        return PREDICTED if "E" in self.costs else ("time",)

    @property
    def ordered_splits(self) -> list[str]:
        """Return the splits that were evaluated, in the paper's order."""
        return [split for split in SPLITS if split in self.splits]
