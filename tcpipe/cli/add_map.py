"""``tcpipe add-map``: rasters of a site on one common grid, into the store."""

from __future__ import annotations

import click

from tcpipe.cli.options import add_options, json_option, quiet_option
from tcpipe.errors import UsageError
from tcpipe.pipeline.add_map_options import AddMapOptions


@click.command("add-map")
@add_options(AddMapOptions)
@click.argument("strays", nargs=-1, metavar="")
@json_option
@quiet_option
def add_map(options: AddMapOptions, *, strays: tuple[str, ...], as_json: bool, quiet: bool) -> None:
    """Put rasters that need not share grid, resolution or CRS on one common grid, and add them to the store as NAME.

    A raster is a GeoTIFF, JPEG 2000 or ERDAS Imagine file. One in many tiles is given as a pattern in quotes, --height 'dem/*.tif', or by
    repeating the option; where tiles overlap, the last lies on top.
    """
    from tcpipe.cli.output import say_result, show_progress
    from tcpipe.pipeline.maps import run_add_map

    if strays:
        raise UsageError(f"{strays[0]}: belongs to no option; is a pattern without quotes? wanted --height 'dem/*.tif'")
    with show_progress(f"map {options.name}", quiet=quiet):
        added = run_add_map(options)
    say_result(added, as_json=as_json)
