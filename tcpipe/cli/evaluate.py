"""``tcpipe evaluate``: a model measured on a dataset."""

from __future__ import annotations

import click

from tcpipe.cli.options import OUTPUT_DIRECTORY, SEALED, SEED, json_option, quiet_option


@click.command(short_help="Measure a model, beside the paper's tables")
@click.argument("model", type=SEALED, metavar="MODEL")
@click.argument("dataset", type=SEALED, metavar="DATASET")
@click.argument("out", default="evaluation", type=OUTPUT_DIRECTORY, metavar="[OUT]")
@click.option(
    "--draws",
    default=5,
    show_default=True,
    type=click.IntRange(1, 1000),
    help="Draws of noise for each ablated input set.",
)
@click.option(
    "--baselines/--no-baselines", default=True, show_default=True,
    help="Train the height-only networks of Wei and Isler: one of grass, one a class.",
)  # fmt: skip
@click.option("--retrain", is_flag=True, help="Train a network for each input set of the ablation, too (six more).")
@click.option("--seed", default=0, show_default=True, type=SEED, help="Of the noise.")
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
    as_json: bool,
    quiet: bool,
) -> None:
    """Measure MODEL on DATASET's test samples and unseen area, and write evaluation.json, .csv and .html to OUT.

    RMSE and MAPE of power, velocity, time and energy by terrain class; the ablation of the input layers; the baselines of Wei and
    Isler and the expected time; what the labels' own noise allows; each beside the paper's own figures. Networks that it trains are
    kept in OUT and used again.
    """
    from tcpipe.cli.output import print_json, progress, say_lines
    from tcpipe.learning.evaluation_facts import EvaluateConfig
    from tcpipe.learning.evaluation_files import run_evaluation

    config = EvaluateConfig(draws=draws, baselines=baselines, retrain=retrain, seed=seed)
    with progress("evaluate", 1, quiet=quiet):
        result = run_evaluation(model, dataset, out, config=config)
    if as_json:
        print_json(result.values)
    else:
        say_lines(result)
