"""``tcpipe reproduce``: the paper's experiment on a simulated site."""

from __future__ import annotations

import click

from tcpipe.cli.options import OUTPUT_DIRECTORY, RenamedOption, jobs_option, json_option, quiet_option


@click.command()
@click.argument("directory", default="tcpipe-reproduction", type=OUTPUT_DIRECTORY, metavar="[DIR]")
@click.option("--quick", is_flag=True, help="Minutes: a small site and a narrow network, to see it run.")
@click.option("--seeds", default=1, type=click.IntRange(1, 100), help="Trainings; claims compare their means.")
@jobs_option("Logs read")
@click.option(
    "--hidden-variance", "hidden", cls=RenamedOption, earlier="--hidden", default=1.0, type=click.FloatRange(0.0, 10.0), metavar="FACTOR",
    help="Variance of the resistance that nothing shows, over that of the frozen site.",
)  # fmt: skip
@click.option(
    "--baselines/--no-baselines", default=True,
    help="Train the height-only networks of Wei and Isler, which take most of the time.",
)  # fmt: skip
@json_option
@quiet_option
def reproduce(
    directory: str, *, quick: bool, seeds: int, jobs: int, hidden: float, baselines: bool, as_json: bool, quiet: bool
) -> None:
    """Simulate the paper's site, drive it, build the dataset, train, evaluate, and say which of the paper's claims hold.

    Takes up to an hour and a half on two cores, and goes on from where it was stopped. The data are simulated: what is compared with the
    paper is the pattern, not the figures. Writes reproduction.html, reproduction.json and everything behind them to DIR.
    """
    from tcpipe.cli.output import say_result, show_progress
    from tcpipe.experiment.reproduction import reproduce as run

    with show_progress("reproduce", quiet=quiet):
        result = run(directory, quick=quick, seeds=seeds, jobs=jobs, hidden=hidden, baselines=baselines)
    say_result(result, as_json=as_json)
