"""``tcpipe simulate``: a site, drives and their truth as real files."""

from __future__ import annotations

from pathlib import Path

import click

from tcpipe.cli.options import OUTPUT_DIRECTORY, complete_scenarios, json_option, quiet_option, seed_option


@click.command()
@click.argument("out", type=OUTPUT_DIRECTORY, metavar="OUT")
@click.option(
    "--scenario",
    default="demo",
    metavar="NAME",
    shell_complete=complete_scenarios,
    help="demo, hills12, paper, paper_quick, manoeuvres, tiny; see docs/reference/simulation.md.",
)
@seed_option
@json_option
@quiet_option
def simulate(out: str, *, scenario: str, seed: int, as_json: bool, quiet: bool) -> None:
    """Write a simulated site to OUT: real .mcap and .bag logs, real GeoTIFFs, and the truth behind them."""
    from tcpipe.cli.output import print_json, print_line, show_progress
    from tcpipe.simulation import simulate as run

    with show_progress("simulate", quiet=quiet):
        site = run(Path(out), scenario=scenario, seed=seed)
    if as_json:
        print_json(site)
    else:
        for path in (*site.logs, *site.rasters.values(), site.region, *site.truths):
            print_line(str(path))
        if site.unchanged:
            print_line(f"nothing to do: the site is in {out} already")
