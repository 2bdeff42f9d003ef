"""``tcpipe evaluate``: a model measured on a dataset."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from tcpipe.cli.options import (
    PUBLISHED,
    SEALED,
    SEED,
    json_option,
    map_option,
    model_argument,
    quiet_option,
    store_option,
)

if TYPE_CHECKING:
    from tcpipe.learning.evaluation_files import EvaluationResult
    from tcpipe.planning.drive_files import DrivesResult


@click.command(short_help="Measure a model, beside the paper's tables")
@model_argument
@click.argument("dataset", type=SEALED, metavar="DATASET")
@click.argument("out", default="evaluation", type=PUBLISHED, metavar="[OUT]")
@click.option("--draws", default=5, type=click.IntRange(1, 1000), help="Draws of noise for each ablated input set.")
@click.option(
    "--baselines/--no-baselines", default=True,
    help="Train the height-only networks of Wei and Isler: one of grass, one a class.",
)  # fmt: skip
@click.option("--retrain", is_flag=True, help="Train a network for each input set of the ablation, too (six more).")
@click.option("--seed", default=0, type=SEED, help="Of the noise.")
@click.option(
    "--drive", "drives", multiple=True, metavar="LOG",
    help="Measure MODEL on a whole drive instead: an ingested log, by its path or its run's name; may be repeated.",
)  # fmt: skip
@map_option
@store_option
@json_option
@quiet_option
def evaluate(
    model: str,
    dataset: str,
    out: str,
    *,
    draws: int,
    baselines: bool,
    retrain: bool,
    seed: int,
    drives: tuple[str, ...],
    map_name: str | None,
    store: str,
    as_json: bool,
    quiet: bool,
) -> None:
    """Measure MODEL on DATASET's test samples and unseen area, and write evaluation.json, .csv and .html to OUT.

    RMSE and MAPE of power, velocity, time and energy by terrain class; the ablation of the input layers; the baselines of Wei and
    Isler and the expected time; what the labels' own noise allows; each beside the paper's own figures. Networks that it trains are
    kept in OUT and used again; predictions.parquet holds every prediction. OUT may be a URL in a bucket, where nothing is replaced.

    With --drive: time and energy of whole drives, measured against predicted on the store's map, with intervals and figures, in
    drives.json and drives.html of OUT; DATASET, that MODEL was trained on, tells whether a drive was held back.
    """
    from tcpipe.api import evaluate as run
    from tcpipe.cli.output import print_json, progress, say_lines

    with progress("evaluate", quiet=quiet):
        result: EvaluationResult | DrivesResult = (
            run(model, dataset, out, drives=drives, map_name=map_name, store=store)
            if drives
            else run(model, dataset, out, draws=draws, baselines=baselines, retrain=retrain, seed=seed)
        )
    if as_json:
        print_json(result.values)
    else:
        say_lines(result)
