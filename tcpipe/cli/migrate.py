"""``tcpipe migrate``: what an earlier data model wrote, brought to this one."""

from __future__ import annotations

from pathlib import Path

import click

from tcpipe.cli.options import INPUT_DIRECTORY, json_option


@click.command(short_help="Bring a store, map or dataset to this data model")
@click.argument("path", type=INPUT_DIRECTORY, metavar="PATH")
@json_option
def migrate(path: str, *, as_json: bool) -> int:
    """Bring the store, map or dataset at PATH from an earlier data model to this one.

    What is of this data model is left alone. A call that was killed is gone on with by calling it again.
    """
    from tcpipe.cli.output import say_result
    from tcpipe.pipeline.migrate import migrate as run

    found = run(Path(path))
    say_result(found, as_json=as_json)
    return found.exit_code
