"""``tcpipe status``: where every log stands."""

from __future__ import annotations

from pathlib import Path

import click

from tcpipe.cli.options import ONE_OF_SEVERAL, json_option, min_age_option, recipe_option, robot_option, store_option
from tcpipe.cli.output import print_line


@click.command()
@click.argument("paths", nargs=-1, type=ONE_OF_SEVERAL, metavar="[STORE] [LOG...]")
@store_option
@recipe_option
@robot_option("Robot profile that ingest is given.")
@min_age_option("10m", "A log that was written to since (90, 90s, 10m, 2h, 1d) is growing.")
@json_option
def status(
    paths: tuple[str, ...], *, store: str, recipe: str | None, robot: str | None, min_age_s: float, as_json: bool
) -> int:
    """Say of every log whether it is in the store, is still to be ingested, failed or grows, and why; and what the latest calls did.

    Without LOG: of the logs and folders that the latest calls of ingest were given. Nothing of a log is read.

    Exit code 3: a log failed, is damaged or gave no segment, a call was killed, a log waits for more than two nights, files of a run or
    a commit are missing, and nobody acknowledged that (tcpipe acknowledge).
    """
    from tcpipe.cli.output import print_json, resolve_recipe_with_source, say_lines
    from tcpipe.errors import UsageError
    from tcpipe.formats.finding_lines import format_finding
    from tcpipe.formats.object_storage import is_url
    from tcpipe.pipeline.status import find_status as run
    from tcpipe.store import is_store

    if paths and is_store(paths[0]):
        store, paths = paths[0], paths[1:]
    elif paths and not is_url(store) and not Path(store).exists():
        raise UsageError(f"{paths[0]}: there is no store here, nor one at {store}; name it with --store")
    found = run(paths, store=store, recipe=resolve_recipe_with_source(recipe)[0], robot=robot, min_age_s=min_age_s)
    if as_json:
        print_json(found)
        return found.exit_code
    say_lines(found)
    for finding in found.problems:
        print_line(f"tcpipe: {format_finding(finding)}", err=True)
    return found.exit_code
