"""``tcpipe accept``: known trouble that a person has looked at is no news."""

from __future__ import annotations

import click

from tcpipe.cli.options import complete_runs, json_option, store_option


@click.command(short_help="Known trouble is no news")
@click.argument("names", nargs=-1, required=True, metavar="RUN|LOG|CALL...", shell_complete=complete_runs)
@store_option
@json_option
def accept(names: tuple[str, ...], *, store: str, as_json: bool) -> int:
    """Accept the damage or emptiness of runs and the failures of logs that have been looked at: ingest counts them no more as trouble.

    Accept a call that was killed by the name that status says, and a log that waits by its path.

    It holds for this content and this trouble: another one is news again.
    """
    from tcpipe.cli.output import print_json, say
    from tcpipe.pipeline.known_trouble import accept as run

    found = run(names, store=store)
    if as_json:
        print_json(found)
        return 0
    for word, troubles in (("accepted", found.accepted), ("accepted before", found.before)):
        for trouble in troubles:
            say(f"{word}: {trouble.called} ({trouble.kind})")
            for line in trouble.lines:
                say(f"  {line}")
    if not found.accepted:
        say("nothing to do: all of it was accepted before")
    return 0
