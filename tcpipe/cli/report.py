"""``tcpipe report``: one HTML page for a run, a dataset or a store."""

from __future__ import annotations

import click

from tcpipe.cli.options import SEALED


@click.command(short_help="HTML page of a run, dataset or store")
@click.argument("path", type=SEALED, metavar="PATH")
def report(path: str) -> None:
    """Write report.html for PATH: a run directory, a dataset, or a store (one page a run), and print the physics of each robot.

    The page needs no network.
    """
    from tcpipe.cli.output import say
    from tcpipe.pipeline.report import report as run

    written = run(path)
    for page in written:
        say(page.path)
        for line in page.physics:
            say(f"  {line}")
    if not any(page.changed for page in written):
        say("nothing to do: the pages are there as they would be written")
