"""``tcpipe report``: the HTML page of a run, a dataset or a store."""

from __future__ import annotations

import click

from tcpipe.cli.options import SEALED


@click.command()
@click.argument("path", type=SEALED, metavar="PATH")
@click.option(
    "--no-runs", is_flag=True, help="Of a store: its own page alone, which leads to those of the runs that are there."
)
@click.option(
    "--patches",
    is_flag=True,
    help="Of a dataset: pictures of all its patches in a folder beside the page, which shows them.",
)
def report(path: str, *, no_runs: bool, patches: bool) -> None:
    """Write report.html for PATH: a run directory, a dataset, or a store and each of its runs; and print the physics of each robot.

    The page needs no network.
    """
    from tcpipe.cli.output import print_line
    from tcpipe.pipeline.report import report as run

    written = run(path, runs=not no_runs, patches=patches)
    for page in written:
        print_line(page.path)
        for line in page.physics:
            print_line(f"  {line}")
    if not any(page.changed for page in written):
        print_line("nothing to do: the pages are there as they would be written")
