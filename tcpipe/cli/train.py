"""``tcpipe train``: a dataset to a model."""

from __future__ import annotations

from typing import Any

import click
from click.core import ParameterSource

from tcpipe.cli.options import PUBLISHED, SEALED, SEED, FloatRange, json_option, quiet_option


@click.command(short_help="Train a model on a dataset")
@click.argument("dataset", type=SEALED, metavar="DATASET")
@click.argument("out", default="model", type=PUBLISHED, metavar="[OUT]")
@click.option(
    "--model", type=click.Choice(["resnet18", "table", "physics"]),
    help="The paper's network; boosted trees on features of patches; or physics. The last two take seconds and heed --loss, --weights, "
    "--label and --beside alone (default: a table of fewer than 20000 samples, else, and with the network's own options, the network).",
)  # fmt: skip
@click.option(
    "--loss", default="nrmse", type=click.Choice(["nrmse", "paper_eq4"]),
    help="paper_eq4 is the paper's equation 4 as printed; nrmse makes both errors dimensionless.",
)  # fmt: skip
@click.option("--epochs", default=100, type=click.IntRange(1, 100_000), help="At most.")
@click.option("--patience", default=12, type=click.IntRange(1, 100_000), help="Epochs without a better held-out loss.")
@click.option("--batch", default=64, type=click.IntRange(1, 65_536), help="Samples in a batch.")
@click.option("--learning-rate", default=1e-4, type=FloatRange(0.0, 1.0, min_open=True))
@click.option("--fold", default=0, type=click.IntRange(0, 99), help="Fold of train to stop early by.")
@click.option("--mirror/--no-mirror", default=True, help="Mirror every other patch across its travel.")
@click.option("--weights", is_flag=True, help="Weigh each label by its inverse variance.")
@click.option(
    "--width",
    default=64,
    type=click.IntRange(16, 512),
    help="Filters of the first stage, a multiple of 16; 64 is ResNet-18.",
)
@click.option(
    "--label", default="total", type=click.Choice(["total", "above_standing"]),
    help="Energy to train on: all that was measured, or less what the robot draws while it stands.",
)  # fmt: skip
@click.option(
    "--beside",
    is_flag=True,
    help="Tell it the turn and the commanded speed of each metre beside its patch; the paper does not.",
)
@click.option("--seed", default=0, type=SEED, help="Of weights, shuffles and mirrors.")
@click.option("--fresh", is_flag=True, help="Do not go on from where an earlier training was stopped.")
@json_option
@quiet_option
@click.pass_context
def train(
    context: click.Context, /, dataset: str, out: str, *, fresh: bool, as_json: bool, quiet: bool, **options: Any
) -> None:
    """Train ResNet-18, stopped early by a fold of train, or a table on DATASET's patches and labels, and write the model folder OUT.

    Needs an extra: pip install 'tcpipe[train]', or 'tcpipe[tables]' for a table. A network runs on a GPU when there is one; its training
    goes on where it was stopped.
    """
    from tcpipe.api import train as run
    from tcpipe.cli.output import progress, say_result

    given = {name for name in options if context.get_parameter_source(name) is not ParameterSource.DEFAULT}
    with progress("train", quiet=quiet):
        result = run(dataset, out, fresh=fresh, **{name: options[name] for name in given})
    say_result(result, as_json=as_json)
