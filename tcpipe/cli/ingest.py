"""``tcpipe ingest``: logs to labelled segments in the store."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from tcpipe.cli.options import add_options, dry_run_option, quiet_option
from tcpipe.cli.output import print_line
from tcpipe.pipeline.ingest_options import IngestOptions

if TYPE_CHECKING:
    from tcpipe.pipeline.ingest import IngestSummary
    from tcpipe.pipeline.ingest_task import IngestResult


@click.command()
@add_options(IngestOptions)
@dry_run_option
@click.option("--json", "as_json", is_flag=True, help="Print a JSON object for each log as it ends, and one of all.")
@quiet_option
def ingest(options: IngestOptions, *, dry_run: bool, as_json: bool, quiet: bool) -> int:
    """Read logs, fuse the sensors, gate, cut into 1 m segments, and label each with power, velocity, time and energy.

    A LOG is a .mcap, a .bag, a .db3, a ROS 2 bag directory, or a folder of such, searched downward, or the s3:// URL of
    one. What is in the store already (same content, same recipe) is left alone, and what failed for its content is not
    tried again. A line is printed as each log ends; of several logs, findings follow by code.

    Exit code 3: some logs failed, are damaged, or give no segment though the robot drove, and that is news: it was not
    told before, and not acknowledged (tcpipe acknowledge).
    """
    from dataclasses import replace

    from tcpipe.cli.output import print_json_line, resolve_recipe_with_source, say_result, show_progress
    from tcpipe.formats.json_files import convert_record
    from tcpipe.pipeline.ingest import SummaryLine, run_ingest
    from tcpipe.pipeline.ingest_task import LogLine

    ruling, source = resolve_recipe_with_source(cast("str | None", options.recipe))
    options = replace(options, recipe=ruling)
    if not as_json:
        print_line(f"recipe: {source}")
    if dry_run:
        from tcpipe.pipeline.status import find_status

        planned = find_status(
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
    with show_progress("ingest", quiet=quiet, as_json=as_json) as shown:
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
                print_json_line(convert_record(result, LogLine))
            else:
                for line in _list_outcome(result, options.store, several=several):
                    shown.result(line)
            for problem in result.problems if result.is_news else ():
                shown.problem(problem)

        summary = run_ingest(replace(options, on_found=on_found, on_result=on_result))
    if as_json:
        made = str(summary.store) if isinstance(summary.store, str) or summary.store.is_dir() else None
        print_json_line(SummaryLine(source, made, summary.exit_code, summary.results))
    else:
        if several:
            _print_findings(summary)
        _print_sum(summary)
    return summary.exit_code


def _list_outcome(result: IngestResult, store: Path | str, *, several: bool) -> Iterator[str]:
    """Yield what became of a log: of one alone with its findings, of several one line each, and what is broken."""
    from tcpipe.cost.budget import format_budget
    from tcpipe.formats.finding_lines import describe_finding, format_findings, format_verdict
    from tcpipe.tables.findings import select_problems

    aside = " (acknowledged)" if result.acknowledged else ""
    is_new, run = result.status != "unchanged", result.run
    budget = run.energy_budget if run and is_new else None
    problems = select_problems(result.findings)
    if run is None:
        known = " (known, not tried again)" if result.known else ""
        yield f"{result.status:<10} {result.log}{aside or known}"
    else:
        known = f" ({run.defect}, known)" if run.defect and not result.is_news else ""
        more = f", noise floor of E {100 * budget.total:.1f} %" if several and budget else ""
        more += f"; {format_verdict(result.verdict)}" if several and is_new and result.verdict else ""
        yield (
            f"{result.status:<10} {run.run_id}/{run.recipe_id}: {run.segments} segments "
            f"from {run.kept_m:.1f} of {run.driven_m:.1f} m, robot {run.robot}{more}{aside or known}"
        )
    if result.same_as:
        yield f"  {result.log} is the same recording as {result.same_as}: one run"
    if budget is not None and not several:
        yield f"  {format_budget(budget)}"
    yield from (f"  {note}" for note in result.notes)
    if result.status == "failed" and result.is_news:
        yield from (f"  {line}" for line in format_findings(of for of in result.causes if of.code != "log-failed"))
    if run is None or result.verdict is None:
        return
    if result.is_news or result.status == "damaged":
        yield from (f"  damage:  {describe_finding(of)} [{of.code}]" for of in run.damage)
    if is_new and not several:
        yield f"  verdict: {format_verdict(result.verdict)}"
        where = f"tcpipe inspect {store}/runs/{run.run_id}"
        yield from (f"  {line}" for line in format_findings(result.findings, more=where))
    elif is_new or result.is_news:
        yield from (f"  {describe_finding(of)} [{of.code}]" for of in problems if of.code != "log-damaged")


def _print_findings(summary: IngestSummary) -> None:
    """Print the findings of several runs by code."""
    from tcpipe.formats.finding_lines import format_groups, group_findings

    made = [result.run for result in summary.results if result.run and result.status != "unchanged"]
    groups = group_findings((run.run_id, run.findings) for run in made)
    for line in format_groups(groups, len(made), more=f"tcpipe report {summary.store}"):
        print_line(line)


def _print_sum(summary: IngestSummary) -> None:
    number = len(summary.results)
    old = [result for result in summary.results if result.status == "failed" and not result.is_news]
    count = {
        status: sum(r.status == status for r in summary.results) - (len(old) if status == "failed" else 0)
        for status in ("done", "unchanged", "damaged", "empty", "failed", "waiting")
    }
    if not number:
        print_line("nothing to do: this shard holds none of the logs")
    elif count["unchanged"] + len(old) == number:
        print_line(f"nothing to do: {count['unchanged']} of {number} logs are in {summary.store} already")
    elif count["failed"] == number:
        print_line(f"no run came into {summary.store}: {number} of {number} logs failed")
    else:
        said = ", ".join(f"{of} {status}" for status, of in count.items() if of)
        print_line(f"{summary.store}: {said}")
    _print_known(summary)


def _print_known(summary: IngestSummary) -> None:
    """Count what is wrong and no news."""
    acknowledged = sum(result.acknowledged for result in summary.results)
    known = [result for result in summary.results if result.known and not result.acknowledged]
    failed = sum(result.status == "failed" for result in known)
    if failed:
        tried = "tries them" if failed > 1 else "tries it"
        print_line(f"{failed} known failure{'s' * (failed > 1)}, not tried again; --retry-failed {tried}")
    if len(known) > failed:
        print_line(
            f"{len(known) - failed} known to be damaged or empty; 'tcpipe acknowledge RUN' when it has been looked at"
        )
    if acknowledged:
        print_line(f"{acknowledged} with acknowledged problems")
