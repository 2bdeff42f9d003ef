"""``tcpipe export``: any topics of a log as Parquet; a dataset, store or run as a GeoPackage."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcpipe.cli.options import GEOPACKAGE, LOG, OUTPUT_EXPORT, json_option, msgdef_option
from tcpipe.errors import UsageError

if TYPE_CHECKING:
    from tcpipe.pipeline.export import Exported


@click.command()
@click.argument("log", type=LOG, metavar="LOG|DATASET|STORE|RUN")
@click.argument("names", nargs=-1, metavar="[TOPIC]...")
@click.argument("out", type=OUTPUT_EXPORT, metavar="OUT")
@click.option("--topics", multiple=True, metavar="NAME[,NAME]", help="Only these topics; repeatable (default: all).")
@msgdef_option
@json_option
def export(
    log: str, out: str, *, names: tuple[str, ...], topics: tuple[str, ...], msgdef: str | None, as_json: bool
) -> int:
    """Write topics of LOG to OUT as Parquet, one file a topic, one row a message, columns by dotted field name.

    Units of columns and the definition of the message stand in the files' metadata. What OUT holds already of the same
    log is left alone.

    Of a dataset, a store or a run OUT is a GeoPackage (a name that ends in .gpkg; needs the extra gis): samples, footprints,
    regions and where to drive next, or segments, with styles for QGIS.
    """
    import resource

    from tcpipe.cli.output import print_json, say_result

    if out.endswith(GEOPACKAGE):
        from tcpipe.pipeline.layers import export_layers

        if names or topics:
            raise UsageError(f"{out}: a GeoPackage holds no topics; give a directory for them")
        say_result(export_layers(log, Path(out)), as_json=as_json)
        return 0
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
    from tcpipe.cli.output import print_line
    from tcpipe.formats.finding_lines import describe_finding

    if exported.status == "unchanged":
        count = len(exported.topics)
        print_line(f"nothing to do: {count} of {count} topics of {log} are in {out} already")
    else:
        for of in exported.topics:
            print_line(f"{of.messages:>9} messages  {of.topic}  {of.path}")
        if not exported.topics:
            print_line(f"nothing to export: {log} holds no topic")
    for kind, findings in (("damage", exported.damage), ("remark", exported.remarks)):
        for finding in findings:
            print_line(f"{kind}: {describe_finding(finding)} [{finding.code}]", err=True)
