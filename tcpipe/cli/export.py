"""``tcpipe export``: any topics of a log as Parquet."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcpipe.cli.options import LOG, OUTPUT_DIRECTORY, json_option, msgdef_option

if TYPE_CHECKING:
    from tcpipe.pipeline.export import Exported


@click.command(short_help="Topics of a log as Parquet")
@click.argument("log", type=LOG, metavar="LOG")
@click.argument("names", nargs=-1, metavar="[TOPIC]...")
@click.argument("out", type=OUTPUT_DIRECTORY, metavar="OUT")
@click.option("--topics", multiple=True, metavar="NAME[,NAME]", help="Only these topics; repeatable (default: all).")
@msgdef_option
@json_option
def export(
    log: str, out: str, *, names: tuple[str, ...], topics: tuple[str, ...], msgdef: str | None, as_json: bool
) -> int:
    """Write topics of LOG to OUT as Parquet, one file a topic, one row a message, columns by dotted field name.

    Units of columns and the definition of the message stand in the files' metadata. What OUT holds already of the same
    log is left alone.
    """
    import resource

    from tcpipe.cli.output import print_json
    from tcpipe.pipeline.export import export as run

    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))  # the file of every topic is open at once
    exported = run(log, Path(out), topics=(*topics, *names), message_definitions=Path(msgdef) if msgdef else None)
    if as_json:
        print_json(exported)
    else:
        _print(exported, log, out)
    return exported.exit_code


def _print(exported: Exported, log: str, out: str) -> None:
    from tcpipe.cli.output import say

    if exported.status == "unchanged":
        count = len(exported.topics)
        say(f"nothing to do: {count} of {count} topics of {log} are in {out} already")
    else:
        for of in exported.topics:
            say(f"{of.messages:>9} messages  {of.topic}  {of.path}")
        if not exported.topics:
            say(f"nothing to export: {log} holds no topic")
    for kind in ("damage", "remarks"):
        for line in getattr(exported, kind):
            say(f"{kind.rstrip('s')}: {line}", err=True)
