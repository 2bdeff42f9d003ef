"""``tcpipe init``: a commented recipe."""

from __future__ import annotations

from pathlib import Path

import click

from tcpipe.cli.options import OUTPUT_DIRECTORY


@click.command()
@click.argument("directory", default=".", type=OUTPUT_DIRECTORY, metavar="[DIR]")
def init(directory: str) -> None:
    """Write tcpipe.toml, the recipe: every key with its default and its meaning, commented out."""
    from tcpipe.cli.output import print_line
    from tcpipe.errors import UsageError
    from tcpipe.formats.atomic import clear_beside, write_text
    from tcpipe.formats.recipe_toml import FILE_NAME, format_commented_toml

    path = Path(directory) / FILE_NAME
    clear_beside(path)
    if not path.exists():
        write_text(path, format_commented_toml())
        print_line(f"wrote {path}")
    elif path.is_file() and path.read_bytes() == format_commented_toml().encode():
        print_line(f"nothing to do: {path} is there already")
    else:
        raise UsageError(f"{path}: is there already and holds something else; it is never overwritten")
