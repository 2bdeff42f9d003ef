"""``tcpipe verify``: is everything still as it was written."""

from __future__ import annotations

import click

from tcpipe.cli.options import SEALED, json_option


@click.command()
@click.argument("path", type=SEALED, metavar="PATH")
@json_option
def verify(path: str, *, as_json: bool) -> int:
    """Re-read the dataset, run, store, map, model or cost map at PATH: compare counts, checksums, contracts.

    Exit code 1: something is not as it was written.
    """
    from tcpipe.cli.output import say_result
    from tcpipe.pipeline.verify import verify as run

    found = run(path)
    say_result(found, as_json=as_json)
    return 1 if found.problems else 0
