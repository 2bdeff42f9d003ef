"""``tcpipe evaluate``: a model measured on a dataset."""

from __future__ import annotations

import click

from tcpipe.cli.options import add_options, json_option, quiet_option
from tcpipe.learning.model_options import EvaluateOptions


@click.command()
@add_options(EvaluateOptions)
@json_option
@quiet_option
def evaluate(options: EvaluateOptions, *, as_json: bool, quiet: bool) -> None:
    """Measure MODEL on DATASET's test samples and unseen area, and write evaluation.json, .csv and .html to OUT.

    RMSE and MAPE of power, velocity, time and energy by terrain class; the ablation of the input layers; the baselines of Wei and
    Isler and the expected time; what the labels' own noise allows; each beside the paper's own figures. Networks that it trains are
    kept in OUT and used again; predictions.parquet holds every prediction. OUT may be a URL in a bucket, where each evaluation is a
    generation.

    With --drive: time and energy of whole drives, measured against predicted on the store's map, with intervals and figures, in
    drives.json and drives.html of OUT; DATASET, that MODEL was trained on, tells whether a drive was held back.
    """
    from tcpipe.api import run_evaluate
    from tcpipe.cli.output import print_json, say_lines, show_progress

    with show_progress("evaluate", quiet=quiet):
        result = run_evaluate(options)
    if as_json:
        print_json(result.values)
    else:
        say_lines(result)
