"""``tcpipe add-map``: rasters of a site on one common grid, into the store."""

from __future__ import annotations

import click

from tcpipe.cli.options import json_option, quiet_option, store_option


@click.command("add-map", short_help="Rasters of a site into the store")
@click.argument("name")
@click.option("--height", required=True, metavar="FILE", help="Height raster (GeoTIFF), metres.")
@click.option("--ortho", metavar="FILE", help="Orthophoto, grey or RGB.")
@click.option(
    "--terrain", metavar="FILE", help="Terrain classes: one integer band, or GeoJSON polygons with a property 'class'."
)
@click.option("--classes", metavar="FILE", help="What the terrain values mean: CSV value,id,name,traversable, or TOML.")
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
    height: str,
    ortho: str | None,
    terrain: str | None,
    classes: str | None,
    crs: str | None,
    force: bool,
    store: str,
    as_json: bool,
    quiet: bool,
) -> None:
    """Put rasters that need not share grid, resolution or CRS on one common grid, and add them to the store as NAME."""
    from tcpipe.cli.output import print_json, progress
    from tcpipe.pipeline.maps import add_map as run

    with progress(f"map {name}", 1, quiet=quiet):
        added = run(
            name, height=height, ortho=ortho, terrain=terrain, classes=classes, crs=crs, store=store, force=force
        )
    if as_json:
        print_json(added)
    else:
        click.echo(str(added))
