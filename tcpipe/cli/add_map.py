"""``tcpipe add-map``: rasters of a site on one common grid, into the store."""

from __future__ import annotations

from typing import Literal

import click

from tcpipe.cli.options import INPUT_FILE, ONE_OF_SEVERAL, json_option, quiet_option, store_option
from tcpipe.errors import UsageError


@click.command("add-map")
@click.argument("name")
@click.argument("strays", nargs=-1, metavar="")
@click.option(
    "--height", required=True, multiple=True, type=ONE_OF_SEVERAL, metavar="FILE", help="Height raster, metres."
)
@click.option("--ortho", multiple=True, type=ONE_OF_SEVERAL, metavar="FILE", help="Orthophoto, grey or RGB.")
@click.option(
    "--terrain",
    multiple=True,
    type=ONE_OF_SEVERAL,
    metavar="FILE",
    help="Terrain classes: one integer band, or GeoJSON polygons with a property 'class'.",
)
@click.option(
    "--classes",
    type=INPUT_FILE,
    metavar="FILE",
    help="What the terrain values mean: CSV value,id,name,traversable, or TOML.",
)
@click.option(
    "--layer",
    "layers",
    multiple=True,
    type=ONE_OF_SEVERAL,
    metavar="NAME=FILE",
    help="Another raster of one band, as a layer NAME; repeat it for more layers.",
)
@click.option(
    "--categorical",
    multiple=True,
    type=ONE_OF_SEVERAL,
    metavar="NAME[=FILE]",
    help="Layer NAME holds classes: those of FILE, like --classes, or as the raster itself names its values.",
)
@click.option(
    "--ortho-bands",
    type=click.Choice(("grey", "rgb")),
    default="grey",
    help="rgb keeps red, green and blue as layers beside the grey.",
)
@click.option(
    "--crs", metavar="EPSG:n", help="Projected, metric CRS of the map (default: the height's, or its UTM zone)."
)
@click.option("--force", is_flag=True, help="Replace a map of that name made from something else.")
@store_option
@json_option
@quiet_option
def add_map(
    name: str,
    *,
    strays: tuple[str, ...],
    height: tuple[str, ...],
    ortho: tuple[str, ...],
    terrain: tuple[str, ...],
    layers: tuple[str, ...],
    categorical: tuple[str, ...],
    ortho_bands: Literal["grey", "rgb"],
    classes: str | None,
    crs: str | None,
    force: bool,
    store: str,
    as_json: bool,
    quiet: bool,
) -> None:
    """Put rasters that need not share grid, resolution or CRS on one common grid, and add them to the store as NAME.

    A raster is a GeoTIFF, JPEG 2000 or ERDAS Imagine file. One in many tiles is given as a pattern in quotes, --height 'dem/*.tif', or by
    repeating the option; where tiles overlap, the last lies on top.
    """
    from tcpipe.cli.output import progress, say_result
    from tcpipe.pipeline.maps import add_map as run

    if strays:
        raise UsageError(f"{strays[0]}: belongs to no option; is a pattern without quotes? wanted --height 'dem/*.tif'")
    files = _by_name("--layer", layers, "the tiles of one layer are a pattern: NAME='tiles/*.tif'")
    tables = _by_name("--categorical", categorical, "wanted one class table a layer")
    if bare := [layer for layer, file in files.items() if not (layer and file)]:
        raise UsageError(f"--layer {bare[0]}: wanted NAME=FILE")
    with progress(f"map {name}", quiet=quiet):
        added = run(
            name,
            height=height,
            ortho=ortho,
            terrain=terrain,
            layers=files,
            categorical={name: table or None for name, table in tables.items()},
            ortho_bands=ortho_bands,
            classes=classes,
            crs=crs,
            store=store,
            force=force,
        )
    say_result(added, as_json=as_json)


def _by_name(option: str, given: tuple[str, ...], hint: str) -> dict[str, str]:
    """Return what stands behind the equals sign by what stands before it, from NAME=FILE; empty where there is none."""
    found: dict[str, str] = {}
    for name, _, file in (text.partition("=") for text in given):
        if name in found:
            raise UsageError(f"{option} {name}: is given twice; {hint}")
        found[name] = file
    return found
