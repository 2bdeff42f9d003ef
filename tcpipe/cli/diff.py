"""``tcpipe diff``: what changed between two datasets, and why."""

from __future__ import annotations

import click

from tcpipe.cli.options import SEALED, json_option


@click.command()
@click.argument("a", type=SEALED, metavar="A")
@click.argument("b", type=SEALED, metavar="B")
@json_option
def diff(a: str, b: str, *, as_json: bool) -> int:
    """Name what changed from A to B and why (log, recipe key, map, region, code), with the labels' shift; exit code 1 if they differ."""
    from tcpipe.cli.output import say_result
    from tcpipe.pipeline.diff import diff as run

    found = run(a, b)
    say_result(found, as_json=as_json)
    return 0 if found.same else 1
