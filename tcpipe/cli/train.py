"""``tcpipe train``: a dataset to a model."""

from __future__ import annotations

import click

from tcpipe.cli.options import add_options, json_option, quiet_option
from tcpipe.learning.model_options import TrainOptions


@click.command()
@add_options(TrainOptions)
@json_option
@quiet_option
def train(options: TrainOptions, *, as_json: bool, quiet: bool) -> None:
    """Train ResNet-18, stopped early by a fold of train, or a table on DATASET's patches and labels, and write the model folder OUT.

    Needs an extra: pip install 'tcpipe[train]', or 'tcpipe[tables]' for a table. A network runs on a GPU when there is one; its training
    goes on where it was stopped.
    """
    from tcpipe.api import run_train
    from tcpipe.cli.output import say_result, show_progress

    with show_progress("train", quiet=quiet):
        result = run_train(options)
    say_result(result, as_json=as_json)
