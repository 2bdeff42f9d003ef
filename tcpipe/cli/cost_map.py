"""``tcpipe cost-map``: what a metre costs along 16 courses, everywhere."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcpipe.cli.options import (
    PUBLISHED,
    FloatRange,
    LonLat,
    cluster_option,
    json_option,
    map_option,
    model_argument,
    quiet_option,
    speed_option,
    store_option,
)

if TYPE_CHECKING:
    from tcpipe.formats.maps.map_files import MapFile
    from tcpipe.planning.cost_model import CostModel


@click.command("cost-map")
@model_argument
@click.argument("out", default="cost-map", type=PUBLISHED, metavar="[OUT]")
@map_option
@click.option("--step", "step_m", default=1.0, type=FloatRange(0.05, 1000.0), metavar="METRES", help="Side of a cell.")
@click.option(
    "--origin",
    "origin_deg",
    type=LonLat(),
    help="Where the Nav2 maps' frame begins, as navsat_transform's datum (default: where the map's CRS does).",
)
@speed_option
@store_option
@cluster_option
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
    cluster: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Predict power, velocity, time and energy a metre along 16 courses in every cell of a map.

    Writes to OUT (default: cost-map) Cloud-Optimised GeoTIFFs with a band a course, the reasons where MODEL has no business, and
    maps for Nav2. An interrupted call goes on where it was; OUT may be a URL in a bucket, where nothing is replaced.
    """
    from tcpipe.cli.output import progress, say_result
    from tcpipe.planning.cost_map import Cluster, make_cost_map

    with progress("cost-map", quiet=quiet) as shown:
        paths = (model, store) if cluster is None else (_anywhere(model), _anywhere(store))
        inputs = partial(_inputs, *paths, map_name, speed_mps)
        elsewhere = None if cluster is None else Cluster(cluster, inputs)
        found, source = inputs()
        result = make_cost_map(
            found, source, out, step_m=step_m, origin_deg=origin_deg, step=shown.count, cluster=elsewhere
        )
    say_result(result, as_json=as_json)


def _anywhere(path: str) -> str:
    from tcpipe.formats.object_storage import is_url

    return path if is_url(path) else str(Path(path).absolute())


def _inputs(model: str, store: str, map_name: str | None, speed_mps: float | None) -> tuple[CostModel, MapFile]:
    """Return the model and the map, wherever this is called."""
    from tcpipe.learning.models import chosen_model
    from tcpipe.planning.inputs import chosen_map

    source = chosen_map(store, map_name)
    return chosen_model(model, speed_mps=speed_mps), source
