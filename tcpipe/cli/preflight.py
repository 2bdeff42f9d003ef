"""``tcpipe preflight``: what a minute of recording promises."""

from __future__ import annotations

from pathlib import Path

import click

from tcpipe.cli.options import LOG, json_option, msgdef_option, quiet_option, recipe_option, robot_option


@click.command()
@click.argument("log", type=LOG, metavar="LOG")
@robot_option()
@recipe_option
@msgdef_option
@json_option
@quiet_option
def preflight(
    log: str, *, robot: str | None, recipe: str | None, msgdef: str | None, as_json: bool, quiet: bool
) -> int:
    """Predict from LOG, a minute or more as it will be driven, what a day of such recording gives, and what to correct before.

    Segments an hour, where the metres go, the deviations of labels, the verdict, findings with their remedies, and the command that
    records what is needed. Nothing is written.

    Exit codes: 0 ready; 3 there are warnings, errors or no segments; 1 ingesting it would fail.
    """
    from tcpipe.cli.output import resolve_recipe_with_source, say_result, show_progress
    from tcpipe.pipeline.preflight import preflight as run

    with show_progress("preflight", quiet=quiet):
        found = run(
            log,
            recipe=resolve_recipe_with_source(recipe)[0],
            robot=robot,
            message_definitions=Path(msgdef) if msgdef else None,
        )
    say_result(found, as_json=as_json)
    return found.exit_code
