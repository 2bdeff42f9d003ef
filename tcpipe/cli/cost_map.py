"""``tcpipe cost-map``: what a metre costs along 16 courses, everywhere."""

from __future__ import annotations

import click

from tcpipe.cli.options import (
    PUBLISHED,
    SEALED,
    FloatRange,
    LonLat,
    json_option,
    map_option,
    quiet_option,
    speed_option,
    store_option,
)


@click.command("cost-map", short_help="Directional cost maps of a whole map")
@click.argument("model", type=SEALED, metavar="MODEL")
@click.argument("out", default="cost-map", type=PUBLISHED, metavar="[OUT]")
@map_option
@click.option(
    "--step",
    "step_m",
    default=1.0,
    show_default=True,
    type=FloatRange(0.05, 1000.0),
    metavar="METRES",
    help="Side of a cell.",
)
@click.option(
    "--origin",
    "origin_deg",
    type=LonLat(),
    help="Where the Nav2 maps' frame begins, as navsat_transform's datum (default: where the map's CRS does).",
)
@speed_option
@store_option
@json_option
@quiet_option
def cost_map(
    model: str,
    out: str,
    *,
    map_name: str | None,
    step_m: float,
    origin_deg: tuple[float, float] | None,
    speed_mps: float | None,
    store: str,
    as_json: bool,
    quiet: bool,
) -> None:
    """Predict power, velocity, time and energy a metre along 16 courses in every cell of a map.

    Writes to OUT (default: cost-map) Cloud-Optimised GeoTIFFs with a band a course, the reasons where MODEL has no business, and
    maps for Nav2. An interrupted call goes on where it was; OUT may be a URL in a bucket, where nothing is replaced.
    """
    from tcpipe.cli.output import progress, say_result
    from tcpipe.learning.models import chosen_model
    from tcpipe.planning.cost_map import make_cost_map
    from tcpipe.planning.inputs import chosen_map

    with progress("cost-map", 1, quiet=quiet) as shown:
        source = chosen_map(store, map_name)
        found = chosen_model(model, speed_mps=speed_mps)
        result = make_cost_map(found, source, out, step_m=step_m, origin_deg=origin_deg, step=shown.count)
    say_result(result, as_json=as_json)
