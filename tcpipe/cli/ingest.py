"""``tcpipe ingest``: logs to labelled segments in the store."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcpipe.cli.options import json_option, msgdef_option, quiet_option, recipe_option, store_option, tag_values
from tcpipe.errors import plain_line

if TYPE_CHECKING:
    from tcpipe.pipeline.ingest import IngestResult, IngestSummary


@click.command(short_help="Logs to labelled 1 m segments")
@click.argument("logs", nargs=-1, required=True, metavar="LOG...")
@store_option
@recipe_option
@click.option(
    "--robot",
    metavar="NAME",
    help="Robot profile: husky, jackal, warthog, dingo, ridgeback, generic (found by message types and topic names otherwise).",
)
@click.option(
    "--tag", "tags", multiple=True, metavar="K=V", callback=tag_values, help="Free tag on the runs; repeatable."
)
@click.option("--jobs", "-j", default=1, show_default=True, type=click.IntRange(1, 1024), help="Logs side by side.")
@click.option("--as-one", is_flag=True, help="All logs are parts of one drive (splits; power logged apart).")
@msgdef_option
@click.option("--force", is_flag=True, help="Do again what is there already.")
@json_option
@quiet_option
def ingest(
    logs: tuple[str, ...],
    *,
    store: str,
    recipe: str | None,
    robot: str | None,
    tags: dict[str, str],
    jobs: int,
    as_one: bool,
    msgdef: str | None,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> int:
    """Read logs, fuse the sensors, gate, cut into 1 m segments, and label each with power, velocity, time and energy.

    A LOG is a .mcap, a .bag, a .db3, a ROS 2 bag directory, or a folder of such, searched downward, or the s3:// URL of
    one. What is in the store already (same content, same recipe) is left alone.
    """
    from tcpipe.cli.output import print_json, progress, ruling_recipe, say
    from tcpipe.pipeline.ingest import ingest as run

    ruling, source = ruling_recipe(recipe)
    if not as_json:
        say(f"recipe: {source}")
    with progress("ingest", 1, quiet=quiet) as shown:

        def on_result(result: IngestResult) -> None:
            shown.step()
            for problem in result.problems:
                shown.problem(problem)
            if result.traceback and click.get_current_context().find_root().params["debug"]:
                shown.problem(*result.traceback.splitlines())

        summary = run(
            logs,
            store=store,
            recipe=ruling,
            robot=robot,
            tags=tags,
            jobs=jobs,
            force=force,
            as_one=as_one,
            message_definitions=Path(msgdef) if msgdef else None,
            on_found=shown.expect,
            on_result=on_result,
        )
    if as_json:
        made = str(summary.store) if summary.store.is_dir() else None
        print_json({"recipe": source, "store": made, "exit_code": summary.exit_code, "results": summary.results})
    else:
        _print(summary)
    return summary.exit_code


def _print(summary: IngestSummary) -> None:
    from tcpipe.cost.budget import in_words

    for result in summary.results:
        if result.status == "failed":
            click.echo(f"failed     {result.log}")
            continue
        click.echo(
            f"{result.status:<10} {result.run_id}/{result.recipe_id}: {result.segments} segments "
            f"from {result.kept_m:.1f} of {result.distance_m:.1f} m, robot {result.robot}"
        )
        if result.same_as:
            click.echo(f"  {result.log} is the same recording as {plain_line(result.same_as)}: one run")
        if result.energy_budget is not None and result.status != "unchanged":
            click.echo(f"  {in_words(result.energy_budget)}")
        for damage in result.damage:
            click.echo(f"  damage:  {plain_line(damage)}")
        if result.status != "unchanged":
            for warning in result.warnings:
                click.echo(f"  warning: {plain_line(warning)}")
    count = {
        status: sum(r.status == status for r in summary.results)
        for status in ("done", "unchanged", "damaged", "failed")
    }
    number = len(summary.results)
    if count["unchanged"] == number:
        click.echo(f"nothing to do: {number} of {number} logs are in {summary.store} already")
        return
    if count["failed"] == number:
        click.echo(f"no run came into {summary.store}: {number} of {number} logs failed")
        return
    said = ", ".join(f"{of} {status}" for status, of in count.items() if of)
    click.echo(f"{summary.store}: {said}")
