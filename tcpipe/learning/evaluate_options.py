"""The options of ``tcpipe evaluate`` and `tcpipe.evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path

from tcpipe.tables.options import MAP, MODEL, SEED, STORE, Option, Range, option, required


@dataclass(frozen=True, slots=True)
class EvaluateOptions:
    """Which model is measured on which dataset or drives, and how much of it."""

    model: str | Path = required(MODEL)
    dataset: str | Path = required(Option(kind="sealed", metavar="DATASET", is_argument=True))
    """Of drives the one that the model was trained on."""
    out: str | Path = option("evaluation", Option(kind="published", metavar="[OUT]", is_argument=True))
    _: KW_ONLY
    draws: int = option(
        5, Option("Draws of noise for each ablated input set.", ("--noise-draws",), Range(1, 1000), earlier="--draws")
    )
    baselines: bool = option(
        True,
        Option(
            "Train the height-only networks of Wei and Isler: one of grass, one a class.",
            ("--baselines/--no-baselines",),
        ),
    )
    retrain: bool = option(
        False,
        Option(
            "Train a network for each input set of the ablation, too (six more).",
            ("--retrain-ablation",), earlier="--retrain",
        ),
    )  # fmt: skip
    seed: int = option(0, Option("Of the noise.", kind=SEED))
    drives: Sequence[str | Path] = option(
        (),
        Option(
            "Measure MODEL on a whole drive instead: an ingested log, by its path or its run's name; may be repeated.",
            ("--drive",), metavar="LOG", repeatable=True,
        ),
    )  # fmt: skip
    map_name: str | None = option(None, MAP)
    store: str | Path = option("tcpipe-store", STORE)
