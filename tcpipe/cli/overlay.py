"""``tcpipe overlay``: a run as a log to lie beside the recording in a viewer."""

from __future__ import annotations

from pathlib import Path

import click

from tcpipe.cli.options import OUTPUT_FILE, SEALED, json_option


@click.command()
@click.argument("run", type=SEALED, metavar="RUN")
@click.argument("out", type=OUTPUT_FILE, metavar="OUT.mcap")
@json_option
def overlay(run: str, out: str, *, as_json: bool) -> None:
    """Write OUT.mcap from RUN (STORE/runs/ID), on the clock of its log: open both together in Foxglove, or OUT in Rerun or PlotJuggler.

    It holds the fused track, segments with labels, what was dropped and why, and the measurements that were refused.
    """
    from tcpipe.cli.output import say_result
    from tcpipe.pipeline.overlay import write_overlay as write

    say_result(write(run, Path(out)), as_json=as_json)
