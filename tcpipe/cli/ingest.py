"""``tcpipe ingest``: logs to labelled segments in the store."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from tcpipe.cli.options import dry_run_option, options_of, quiet_option
from tcpipe.cli.output import say
from tcpipe.pipeline.ingest_options import IngestOptions

if TYPE_CHECKING:
    from tcpipe.pipeline.ingest import IngestSummary
    from tcpipe.pipeline.ingest_task import IngestResult


@click.command(short_help="Logs to labelled 1 m segments")
@options_of(IngestOptions)
@dry_run_option
@click.option("--json", "as_json", is_flag=True, help="Print a JSON object for each log as it ends, and one of all.")
@quiet_option
def ingest(options: IngestOptions, *, dry_run: bool, as_json: bool, quiet: bool) -> int:
    """Read logs, fuse the sensors, gate, cut into 1 m segments, and label each with power, velocity, time and energy.

    A LOG is a .mcap, a .bag, a .db3, a ROS 2 bag directory, or a folder of such, searched downward, or the s3:// URL of
    one. What is in the store already (same content, same recipe) is left alone, and what failed for its content is not
    tried again. A line is printed as each log ends; of several logs, warnings follow by cause.

    Exit code 3: some logs failed, are damaged, or give no segment though the robot drove, and that is news: it was not
    told before, and not accepted (tcpipe accept).
    """
    from dataclasses import replace

    from tcpipe.cli.output import print_json_line, progress, ruling_recipe, say_result
    from tcpipe.formats.json_files import recast
    from tcpipe.pipeline.ingest import SummaryLine, run_ingest
    from tcpipe.pipeline.ingest_task import LogLine

    ruling, source = ruling_recipe(cast("str | None", options.recipe))
    options = replace(options, recipe=ruling)
    if not as_json:
        say(f"recipe: {source}")
    if dry_run:
        from tcpipe.pipeline.status import status

        planned = status(
            options.logs,
            store=options.store,
            recipe=ruling,
            robot=options.robot,
            as_one=options.as_one,
            shard=options.shard,
            min_age_s=options.min_age_s,
            message_definitions=Path(options.message_definitions) if options.message_definitions else None,
            force=options.force,
            retry_failed=options.retry_failed,
            jobs=options.jobs,
            create=True,
        )
        say_result(replace(planned, history=()), as_json=as_json)
        return 0
    with progress("ingest", quiet=quiet, as_json=as_json) as shown:
        several = False

        def on_found(sizes: Mapping[str, int]) -> None:
            nonlocal several
            several = len(sizes) > 1
            shown.expect(sizes)

        def on_result(result: IngestResult) -> None:
            shown.end(
                result.log,
                worked=result.status in ("done", "damaged", "empty") or not (result.known or result.transient),
            )
            if as_json:
                print_json_line(recast(result, LogLine))
            else:
                for line in _of_one(result, several=several):
                    shown.result(line)
            for problem in result.problems if result.is_news else ():
                shown.problem(problem)

        summary = run_ingest(replace(options, on_found=on_found, on_result=on_result))
    if as_json:
        made = str(summary.store) if isinstance(summary.store, str) or summary.store.is_dir() else None
        print_json_line(SummaryLine(source, made, summary.exit_code, summary.results))
    else:
        if several:
            _print_warnings(summary)
        _print_sum(summary)
    return summary.exit_code


def _of_one(result: IngestResult, *, several: bool) -> Iterator[str]:
    """Yield what became of a log: of one alone with its warnings, of several one line each, and what is broken."""
    from tcpipe.cost.budget import in_words

    aside = " (accepted)" if result.accepted else ""
    warnings = result.warnings if result.status != "unchanged" else ()
    budget = result.energy_budget if result.status != "unchanged" else None
    if result.status in ("failed", "waiting"):
        known = " (known, not tried again)" if result.known else ""
        yield f"{result.status:<10} {result.log}{aside or known}"
    else:
        wrong = "damaged" if result.damage else "empty" if result.why_empty else ""
        known = f" ({wrong}, known)" if wrong and not result.is_news else ""
        told = f", noise floor of E {100 * budget.total:.1f} %" if several and budget else ""
        told += f", {len(warnings)} warning{'s' * (len(warnings) > 1)}" if several and warnings else ""
        yield (
            f"{result.status:<10} {result.run_id}/{result.recipe_id}: {result.segments} segments "
            f"from {result.kept_m:.1f} of {result.distance_m:.1f} m, robot {result.robot}{told}{aside or known}"
        )
    if result.why_empty and (result.is_news or result.status != "unchanged"):
        yield f"  {result.why_empty}"
    if result.no_power and not several and result.status != "unchanged":
        yield f"  {result.no_power.why}"
        yield from (f"    {line}" for line in result.no_power.recipe.splitlines())
    if result.same_as:
        yield f"  {result.log} is the same recording as {result.same_as}: one run"
    if budget is not None and not several:
        yield f"  {in_words(budget)}"
    yield from (f"  {note}" for note in result.notes)
    yield from (f"  damage:  {line}" for line in result.damage if result.is_news or result.status == "damaged")
    said = result.no_power.why if result.no_power else ""
    yield from (f"  warning: {line}" for line in warnings if not several and line not in said)


def _print_warnings(summary: IngestSummary) -> None:
    """Print a line for each cause of warnings, that of most runs first."""
    from tcpipe.tables.findings import by_cause

    made = [result for result in summary.results if result.run_id and result.status != "unchanged"]
    for line in dict.fromkeys(line for of in made if of.no_power for line in (of.no_power.recipe,) if line):
        say("power that no topic plays or that is refused (below) is read by this recipe, where it is of the drives:")
        for part in line.splitlines():
            say(f"  {part}")
    causes = by_cause((str(result.run_id), result.warnings) for result in made)
    for told in sorted(causes, key=lambda of: -len(of)):
        run, line = next(iter(told.items()))
        say(f"warning: {f'{len(told)} runs' if len(told) > 1 else run}: {line}")


def _print_sum(summary: IngestSummary) -> None:
    number = len(summary.results)
    old = [result for result in summary.results if result.status == "failed" and not result.is_news]
    count = {
        status: sum(r.status == status for r in summary.results) - (len(old) if status == "failed" else 0)
        for status in ("done", "unchanged", "damaged", "empty", "failed", "waiting")
    }
    if not number:
        say("nothing to do: this shard holds none of the logs")
    elif count["unchanged"] + len(old) == number:
        say(f"nothing to do: {count['unchanged']} of {number} logs are in {summary.store} already")
    elif count["failed"] == number:
        say(f"no run came into {summary.store}: {number} of {number} logs failed")
    else:
        said = ", ".join(f"{of} {status}" for status, of in count.items() if of)
        say(f"{summary.store}: {said}")
    _print_known(summary)


def _print_known(summary: IngestSummary) -> None:
    """Count what is wrong and no news."""
    accepted = sum(result.accepted for result in summary.results)
    known = [result for result in summary.results if result.known and not result.accepted]
    failed = sum(result.status == "failed" for result in known)
    if failed:
        tried = "tries them" if failed > 1 else "tries it"
        say(f"{failed} known failure{'s' * (failed > 1)}, not tried again; --retry-failed {tried}")
    if len(known) > failed:
        say(f"{len(known) - failed} known to be damaged or empty; 'tcpipe accept RUN' when it has been looked at")
    if accepted:
        say(f"{accepted} with accepted trouble")
