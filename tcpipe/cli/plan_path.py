"""``tcpipe plan-path``: the least-cost path between two points."""

from __future__ import annotations

from dataclasses import replace

import click

from tcpipe.cli.options import add_options, json_option, quiet_option
from tcpipe.planning.path_options import PlanPathOptions


@click.command("plan-path")
@add_options(PlanPathOptions)
@json_option
@quiet_option
def plan_path(options: PlanPathOptions, *, as_json: bool, quiet: bool) -> int:
    """Find the path of least energy, time or distance between two points, over costs that depend on the direction of travel.

    Exit code 3: some of the path has no cost, because --cell-size is large.
    """
    from tcpipe.api import run_plan_path
    from tcpipe.cli.output import say_result, show_progress

    with show_progress("plan-path", quiet=quiet) as shown:
        result = run_plan_path(replace(options, on_step=shown.count))
    say_result(result, as_json=as_json)
    return result.exit_code
