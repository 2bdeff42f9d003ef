"""``tcpipe export``: any topics of a log as Parquet."""

from __future__ import annotations

from pathlib import Path

import click

from tcpipe.cli.options import msgdef_option


@click.command(short_help="Topics of a log as Parquet")
@click.argument("log", metavar="LOG")
@click.argument("out", metavar="OUT")
@click.option("--topics", multiple=True, metavar="NAME", help="Only these topics; repeatable (default: all).")
@msgdef_option
def export(log: str, out: str, *, topics: tuple[str, ...], msgdef: str | None) -> int:
    """Write topics of LOG to OUT as Parquet, one file a topic, one row a message, columns by dotted field name."""
    from tcpipe.pipeline.export import export as run

    exported = run(log, Path(out), topics=topics, message_definitions=Path(msgdef) if msgdef else None)
    for name, path, rows in exported.files:
        click.echo(f"{rows:>9} messages  {name}  {path}")
    for damage in exported.damage:
        click.echo(f"damage: {damage}", err=True)
    for remark in exported.remarks:
        click.echo(f"remark: {remark}", err=True)
    return 3 if exported.damage else 0
