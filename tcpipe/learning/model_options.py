"""The options of the commands ``train`` and ``evaluate`` and of the functions of the same names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, Literal

from tcpipe.formats.atomic import Location
from tcpipe.tables.options import MAP, MODEL, PREDICTOR, RECIPE, SEED, STORE, Option, Range, option, required

if TYPE_CHECKING:
    from tcpipe.dataset.energies import EnergyName
    from tcpipe.learning.fitting import Loss
    from tcpipe.recipe import Recipe


@dataclass(frozen=True, slots=True)
class TrainOptions:
    """Options of training; a network option that is None has the default of `tcpipe.learning.fitting.FitConfig`."""

    dataset: Location = required(Option(kind="sealed", metavar="DATASET", is_argument=True))
    out: Location = option("model", kind="published", metavar="[OUT]", is_argument=True)
    """The same dataset and options are not trained again."""
    _: KW_ONLY
    model: Literal["auto", "linear", "physics", "boosting", "resnet18"] | None = option(
        None,
        "Curves of class and slope, physics, boosted trees on the residuals of a curve, or the paper's network. "
        "auto: the simplest that predicts other runs as well as the best (default; "
        "with an option of the network, resnet18).",
        kind=("auto", "linear", "physics", "boosting", "resnet18"),
    )
    predictor: str | None = option(None, PREDICTOR)
    recipe: Recipe | Location | None = option(None, RECIPE)
    loss: Loss = option(
        "nrmse",
        "paper_eq4 is the paper's equation 4 as printed; nrmse makes both errors dimensionless.",
        kind=("nrmse", "paper_eq4"),
    )
    epochs: int | None = option(None, "Most epochs.", kind=Range(1, 100_000), shown=100)
    patience: int | None = option(
        None, "Epochs without a better held-out loss before training stops.", kind=Range(1, 100_000), shown=12
    )
    batch_size: int | None = option(None, "Samples in a batch.", (), Range(1, 65_536), shown=64)
    learning_rate: float | None = option(None, kind=Range(0.0, 1.0, is_open=True), shown=1e-4)
    fold: int | None = option(None, "Fold of train held out for early stopping.", kind=Range(0, 99), shown=0)
    mirror: bool | None = option(
        None, "Mirror every other patch across its direction of travel.", ("--mirror/--no-mirror",), shown=True
    )
    width: int | None = option(
        None, "Filters of the first stage, a multiple of 16; 64 is ResNet-18.", kind=Range(16, 512), shown=64
    )
    label: EnergyName = option(
        "total", "Energy to train on: total, or net (less the idle power).", kind=("total", "net")
    )
    extra_features: bool = option(
        False,
        "Give the model the turn and the commanded speed of each segment in addition to its patch; the paper does not.",
        ("--extra-features",),
    )
    layers: str | Sequence[str] | None = option(
        None,
        "Layers of the patch, separated by commas, your own by name; "
        "NAME_one_hot has a channel for each class "
        "(default: ortho, terrain and height, as far as the dataset has them).",
        metavar="NAME,NAME,…",
    )
    seed: int | None = option(None, "Seed of weights, shuffles and mirrors.", kind=SEED, shown=0)
    no_resume: bool = option(False, "Start again instead of resuming a stopped training.")


@dataclass(frozen=True, slots=True)
class EvaluateOptions:
    """Which model is measured on which dataset or drives, and how much of it."""

    model: Location = required(MODEL)
    dataset: Location = required(Option(kind="sealed", metavar="DATASET", is_argument=True))
    """With drives: the dataset that the model was trained on."""
    out: Location = option("evaluation", kind="published", metavar="[OUT]", is_argument=True)
    _: KW_ONLY
    noise_draws: int = option(5, "Draws of noise for each ablated input set.", (), Range(1, 1000))
    seed: int = option(0, "Seed of the noise.", kind=SEED)
    predictor: str | None = option(None, PREDICTOR)
    drive: Sequence[Location] = option(
        (),
        "Evaluate MODEL on a whole drive instead: an ingested log, by its path or the name of its run; repeatable.",
        ("--drive",),
        metavar="LOG",
        repeatable=True,
    )
    map: str | None = option(None, MAP)
    store: Location = option("tcpipe-store", STORE)
