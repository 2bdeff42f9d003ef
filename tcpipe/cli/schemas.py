"""``tcpipe schemas``: the contracts as JSON Schema."""

from __future__ import annotations

from pathlib import Path

import click

from tcpipe.cli.options import OUTPUT_DIRECTORY


@click.command()
@click.argument("out", type=OUTPUT_DIRECTORY, metavar="OUT")
def schemas(out: str) -> None:
    """Write the contract of every table, document and --json answer, and of the recipe, as JSON Schema, one file each, to OUT."""
    from tcpipe.cli.json_output import collect_contracts
    from tcpipe.cli.output import print_line
    from tcpipe.formats.atomic import clear, write_text

    clear(Path(out))
    wanted = {Path(out) / name: text for name, text in collect_contracts().items()}
    missing = {path: text for path, text in wanted.items() if not path.is_file() or path.read_bytes() != text.encode()}
    for path, text in missing.items():
        write_text(path, text)
    print_line(
        f"wrote {len(missing)} schemas to {out}" if missing else f"nothing to do: {len(wanted)} schemas are in {out}"
    )
