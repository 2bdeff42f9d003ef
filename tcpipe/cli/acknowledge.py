"""``tcpipe acknowledge``: known problems that a person has looked at."""

from __future__ import annotations

import click

from tcpipe.cli.options import complete_runs, json_option, store_option


@click.command()
@click.argument("names", nargs=-1, required=True, metavar="RUN|LOG|CALL...", shell_complete=complete_runs)
@store_option
@json_option
def acknowledge(names: tuple[str, ...], *, store: str, as_json: bool) -> int:
    """Acknowledge problems that somebody has looked at: damaged logs, runs without segments, failed logs. ingest reports them no more.

    Acknowledge a call that was killed by the name that status prints, a log that waits and a damaged commit by its path.

    A run of which files are missing is given up: the store no longer expects it.

    This holds for this problem of this content: another problem, or other content, is reported.
    """
    from tcpipe.cli.output import print_json, print_line
    from tcpipe.formats.finding_lines import describe_title
    from tcpipe.pipeline.problems import acknowledge as run

    found = run(names, store=store)
    if as_json:
        print_json(found)
        return 0
    for word, problems in (("acknowledged", found.acknowledged), ("acknowledged before", found.before)):
        for problem in problems:
            print_line(f"{word}: {problem.name}: {describe_title(problem.finding)} [{problem.finding.code}]")
    if not found.acknowledged:
        print_line("nothing to do: these problems are already acknowledged")
    return 0
