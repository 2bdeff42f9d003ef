"""``tcpipe demo``: everything, on a simulated site."""

from __future__ import annotations

from pathlib import Path

import click

from tcpipe.cli.options import OUTPUT_DIRECTORY, quiet_option, seed_option


@click.command()
@click.argument("directory", default="tcpipe-demo", type=OUTPUT_DIRECTORY, metavar="[DIR]")
@seed_option
@quiet_option
def demo(directory: str, *, seed: int, quiet: bool) -> None:
    """Simulate a small site and two drives, run the whole pipeline on them, and say what to open.

    Writes to DIR (default: tcpipe-demo): real .mcap and .bag logs, real GeoTIFFs, a store, a dataset and its report.
    """
    from tcpipe.cli.output import say_lines, show_progress
    from tcpipe.pipeline.demo import run_demo

    with show_progress("demo", quiet=quiet) as shown:
        result = run_demo(Path(directory), seed=seed, say=shown.line)
    say_lines(result)
