"""``tcpipe predict-path``: what a path costs."""

from __future__ import annotations

import click

from tcpipe.cli.options import (
    INPUT_FILE,
    OUTPUT_FILE,
    json_option,
    map_option,
    model_argument,
    physics_option,
    quiet_option,
    speed_option,
    store_option,
)


@click.command("predict-path", short_help="Time and energy of a path")
@model_argument
@click.option(
    "--path",
    "path_file",
    required=True,
    type=INPUT_FILE,
    metavar="FILE",
    help="GeoJSON LineString (WGS84, lon before lat).",
)
@map_option
@click.option("--out", type=OUTPUT_FILE, metavar="FILE", help="Write the table of pieces: .csv, .parquet or .json.")
@physics_option
@speed_option
@store_option
@json_option
@quiet_option
def predict_path(
    model: str,
    *,
    path_file: str,
    map_name: str | None,
    out: str | None,
    physics: str | None,
    speed_mps: float | None,
    store: str,
    as_json: bool,
    quiet: bool,
) -> int:
    """Cut a path into pieces of a metre and predict the time and energy of each and of all, with intervals.

    Pieces on ground where MODEL has no business (a class, slope or relief not seen in training, off the map, no data, not
    traversable) are marked and counted. Exit code 3: some pieces have no cost.
    """
    from tcpipe.api import predict_path as run
    from tcpipe.cli.output import progress, say_result

    with progress("predict-path", quiet=quiet):
        result = run(model, path_file, map_name=map_name, out=out, physics=physics, speed_mps=speed_mps, store=store)
    say_result(result, as_json=as_json)
    return result.exit_code
