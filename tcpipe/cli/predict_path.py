"""``tcpipe predict-path``: what a path costs."""

from __future__ import annotations

import click

from tcpipe.cli.options import add_options, json_option, quiet_option
from tcpipe.planning.path_options import PredictPathOptions


@click.command("predict-path")
@add_options(PredictPathOptions)
@json_option
@quiet_option
def predict_path(options: PredictPathOptions, *, as_json: bool, quiet: bool) -> int:
    """Cut a path into pieces of a metre and predict the time and energy of each and of all, with intervals.

    Pieces on ground where MODEL has no business (a class, slope or relief not seen in training, off the map, no data, not
    traversable) are marked and counted. Exit code 3: some pieces have no cost.
    """
    from tcpipe.api import run_predict_path
    from tcpipe.cli.output import say_result, show_progress

    with show_progress("predict-path", quiet=quiet):
        result = run_predict_path(options)
    say_result(result, as_json=as_json)
    return result.exit_code
