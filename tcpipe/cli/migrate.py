"""``tcpipe migrate``: what an earlier data model wrote, brought to this one."""

from __future__ import annotations

import click

from tcpipe.cli.options import PUBLISHED, SEALED, json_option


@click.command()
@click.argument("path", type=SEALED, metavar="PATH")
@click.argument("to", type=PUBLISHED, required=False, metavar="[TO]")
@json_option
def migrate(path: str, to: str | None, *, as_json: bool) -> int:
    """Bring the store, map or dataset at PATH from an earlier data model to this one, or a store to another place.

    With TO, a directory or URL, the store at PATH stays as it is, and TO is one of this data model with the same content.

    What is of this data model is left alone. A call that was killed is gone on with by calling it again.
    """
    from tcpipe.cli.output import say_result
    from tcpipe.pipeline.migrate import migrate as run

    found = run(path, to)
    say_result(found, as_json=as_json)
    return found.exit_code
