"""``tcpipe plan-path``: the least-cost path between two points."""

from __future__ import annotations

from typing import Literal

import click

from tcpipe.cli.options import (
    OUTPUT_FILE,
    SEALED,
    FloatRange,
    LonLat,
    complete_maps,
    json_option,
    model_argument,
    physics_option,
    quiet_option,
    speed_option,
    store_option,
)


@click.command("plan-path", short_help="The path of least energy, time or distance")
@model_argument
@click.option("--from", "start", required=True, type=LonLat(), help="Where it begins (WGS84, degrees).")
@click.option("--to", "goal", required=True, type=LonLat(), help="Where it ends.")
@click.option(
    "--objective", default="energy", type=click.Choice(["energy", "time", "distance"]), help="What is to be least."
)
@click.option(
    "--map",
    "map_name",
    metavar="NAME",
    shell_complete=complete_maps,
    help="Map to plan on (default: the only one in the store).",
)
@click.option("--out", default="plan.geojson", type=OUTPUT_FILE, metavar="FILE", help="The path as GeoJSON.")
@click.option(
    "--picture", type=OUTPUT_FILE, metavar="FILE", help="Draw all three objectives side by side on the hill (.png)."
)
@click.option(
    "--cost-map",
    type=SEALED,
    metavar="DIR",
    help="A cost map of this model and map; without one only what is needed is predicted.",
)
@click.option(
    "--step",
    "step_m",
    default=1.0,
    type=FloatRange(0.05, 1000.0),
    metavar="METRES",
    help="Side of a cell; that of --cost-map rules.",
)
@click.option("--allow-unseen", is_flag=True, help="Also cross ground unlike any that the model was trained on.")
@physics_option
@speed_option
@store_option
@json_option
@quiet_option
def plan_path(
    model: str,
    *,
    start: tuple[float, float],
    goal: tuple[float, float],
    objective: Literal["energy", "time", "distance"],
    map_name: str | None,
    out: str,
    picture: str | None,
    cost_map: str | None,
    step_m: float,
    allow_unseen: bool,
    physics: str | None,
    speed_mps: float | None,
    store: str,
    as_json: bool,
    quiet: bool,
) -> int:
    """Find the path of least energy, time or distance between two points, over costs that depend on the direction of travel.

    Exit code 3: some of the path has no cost, because --step is large.
    """
    from tcpipe.api import plan_path as run
    from tcpipe.cli.output import progress, say_result

    with progress("plan-path", quiet=quiet) as shown:
        result = run(
            model,
            start,
            goal,
            objective=objective,
            map_name=map_name,
            out=out,
            picture=picture,
            cost_map=cost_map,
            step_m=step_m,
            allow_unseen=allow_unseen,
            physics=physics,
            speed_mps=speed_mps,
            store=store,
            on_step=shown.count,
        )
    say_result(result, as_json=as_json)
    return result.exit_code
