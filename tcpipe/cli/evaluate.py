"""``tcpipe evaluate``: a model measured on a dataset."""

from __future__ import annotations

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
    if drives:
        _on_drives(model, dataset, out, drives, map_name=map_name, store=store, as_json=as_json, quiet=quiet)
        return
    from tcpipe.cli.output import print_json, progress, say_lines
    from tcpipe.learning.evaluation_facts import EvaluateConfig
    from tcpipe.learning.evaluation_files import run_evaluation

    config = EvaluateConfig(draws=draws, baselines=baselines, retrain=retrain, seed=seed)
    with progress("evaluate", quiet=quiet):
        result = run_evaluation(model, dataset, out, config=config)
    if as_json:
        print_json(result.values)
    else:
        say_lines(result)


def _on_drives(
    model: str,
    dataset: str,
    out: str,
    drives: tuple[str, ...],
    *,
    map_name: str | None,
    store: str,
    as_json: bool,
    quiet: bool,
) -> None:
    from tcpipe.cli.output import print_json, progress, say_lines
    from tcpipe.dataset import open_dataset
    from tcpipe.learning.models import load_model
    from tcpipe.learning.predictions import check_origin
    from tcpipe.planning.drive_files import evaluate_drives
    from tcpipe.planning.inputs import chosen_map

    with progress("evaluate", quiet=quiet):
        asked, data = load_model(model), open_dataset(dataset)
        check_origin(asked.card, data, model)
        result = evaluate_drives(asked, data, chosen_map(store, map_name), drives, store=store, out=out)
    if as_json:
        print_json(result.values)
    else:
        say_lines(result)
