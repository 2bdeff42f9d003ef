"""``tcpipe cost-map``: what a metre costs along 16 courses, everywhere."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import click

from tcpipe.cli.options import add_options, json_option, quiet_option
from tcpipe.planning.path_options import CostMapOptions

if TYPE_CHECKING:
    from tcpipe.formats.maps.map_files import MapFile
    from tcpipe.planning.cost_model import CostModel


@click.command("cost-map")
@add_options(CostMapOptions)
@json_option
@quiet_option
def cost_map(options: CostMapOptions, *, as_json: bool, quiet: bool) -> None:
    """Predict power, velocity, time and energy a metre along 16 courses in every cell of a map.

    Writes to OUT (default: cost-map) Cloud-Optimised GeoTIFFs with a band a course, the reasons where MODEL has no business, and
    maps for Nav2. An interrupted call goes on where it was; OUT may be a URL in a bucket, where each map is a generation.
    """
    from tcpipe.cli.output import say_result, show_progress
    from tcpipe.planning.cost_map import Cluster, make_cost_map

    cluster = options.cluster
    if cluster is not None:  # its workers have another working directory
        from tcpipe.formats.object_storage import make_absolute

        options = replace(options, model=make_absolute(options.model), store=make_absolute(options.store))
    with show_progress("cost-map", quiet=quiet) as shown:
        result = make_cost_map(
            *_load_inputs(options),
            options.out,
            step_m=options.step_m,
            origin_deg=options.origin_deg,
            step=shown.count,
            cluster=None if cluster is None else Cluster(cluster, partial(_load_inputs, options)),
        )
    say_result(result, as_json=as_json)


def _load_inputs(options: CostMapOptions) -> tuple[CostModel, MapFile]:
    """Return the model and the map, wherever this is called."""
    from tcpipe.learning.models import choose_model
    from tcpipe.planning.path_files import choose_map

    source = choose_map(options.store, options.map_name)
    return choose_model(options.model, speed_mps=options.speed_mps), source
