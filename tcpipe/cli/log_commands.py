"""Commands on logs and runs."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from tcpipe.cli.options import (
    LOG,
    ONE_OF_SEVERAL,
    OUTPUT_FILE,
    add_options,
    add_output,
    add_path_or_run,
    complete_runs,
    dry_run_option,
    json_option,
    msgdef_option,
    parse_duration,
    quiet_option,
    recipe_option,
    robot_option,
    store_option,
)
from tcpipe.cli.output import (
    find_recipe_with_source,
    print_json,
    print_json_line,
    print_line,
    print_lines,
    print_result,
    show_progress,
)
from tcpipe.errors import UsageError
from tcpipe.formats.atomic import Location
from tcpipe.pipeline.options import IngestOptions

if TYPE_CHECKING:
    from tcpipe.pipeline.audit import Audit
    from tcpipe.pipeline.ingest import IngestSummary
    from tcpipe.pipeline.overlay import Overlay
    from tcpipe.pipeline.plan import IngestResult
    from tcpipe.pipeline.preflight import Preflight
    from tcpipe.pipeline.problems import Acknowledged
    from tcpipe.pipeline.prune import Pruned


@click.command()
@add_options(IngestOptions)
@dry_run_option
@click.option("--json", "as_json", is_flag=True, help="Print a JSON object when each log ends, and one summary.")
@quiet_option
def ingest(options: IngestOptions, *, dry_run: bool, as_json: bool, quiet: bool) -> int:
    """Read logs, fuse sensors, mask unsteady driving, cut 1 m segments, label their power, velocity, time and energy.

    A LOG is a .mcap, a .bag, a .db3, a ROS 2 bag directory, a folder of these, or an s3:// URL. tcpipe skips logs that
    are in the store (same content, same recipe) and logs that failed before with the same content. It prints a line
    when each log ends (--quiet: not for a log that is unchanged); for several logs, findings follow by code.

    Exit code 3: some logs failed, are damaged, or give no segments although the robot drove, and the problem is new:
    not reported before and not acknowledged (tcpipe acknowledge).
    """
    from tcpipe.formats.json_files import convert_record
    from tcpipe.pipeline.ingest import SummaryLine, run_ingest
    from tcpipe.pipeline.plan import LogLine

    path, source = find_recipe_with_source(cast("str | None", options.recipe))
    options = replace(options, recipe=path)
    if not as_json:
        print_line(f"recipe: {source}")
    if dry_run:
        from tcpipe.pipeline.status import find_log_states

        planned = find_log_states(options, create=True)
        print_result(replace(planned, history=()), as_json=as_json)
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
                for line in _list_outcome(result, options.store, several=several, quiet=quiet):
                    shown.result(line)
            for problem in result.problems if result.is_new_problem else ():
                shown.problem(problem)

        note = partial(shown.note, as_json=as_json)
        summary = run_ingest(replace(options, on_found=on_found, on_result=on_result, on_note=note))
    if as_json:
        made = str(summary.store) if isinstance(summary.store, str) or summary.store.is_dir() else None
        print_json_line(SummaryLine(source, made, summary.exit_code, summary.is_transient, summary.results))
    else:
        if several:
            _print_findings(summary)
        _print_sum(summary)
    return summary.exit_code


def _list_outcome(result: IngestResult, store: Location, *, several: bool, quiet: bool) -> Iterator[str]:
    """Yield the lines on the result of a log: with its findings if it is the only log, else one line and its damage.

    With ``quiet`` an unchanged log without a new problem has no line.
    """
    from tcpipe.formats.finding_lines import (
        describe_finding,
        describe_power,
        format_budget,
        format_findings,
        format_verdict,
        list_verdict,
    )
    from tcpipe.tables.findings import select_problems

    aside = " (acknowledged)" if result.acknowledged else ""
    is_new, run = result.status != "unchanged", result.run
    if quiet and not (is_new or result.is_new_problem):
        return
    budget = run.energy_budget if run and is_new else None
    problems = select_problems(result.findings)
    if run is None:
        known = " (failed before, skipped)" if result.known else ""
        yield f"{result.status:<10} {result.log}{aside or known}"
    else:
        known = f" ({run.defect}, known)" if run.defect and not result.is_new_problem else ""
        more = f", noise floor of E {100 * budget.total:.1f} %" if several and budget else ""
        more += f"; {format_verdict(result.verdict)}" if several and is_new and result.verdict else ""
        yield (
            f"{result.status:<10} {run.run_id}/{run.recipe_id}: {run.segments} segments "
            f"from {run.kept_m:.1f} of {run.driven_m:.1f} m, robot {run.robot}{more}{aside or known}"
        )
    if result.same_as:
        yield f"  {result.log} is a duplicate of {result.same_as}: one run"
    if budget is not None and not several:
        yield f"  {format_budget(budget)}"
    yield from (f"  {note}" for note in result.notes)
    if result.status == "failed" and result.is_new_problem:
        yield from (
            f"  {line}"
            for line in format_findings(finding for finding in result.causes if finding.code != "log-failed")
        )
    if run is None or result.verdict is None:
        return
    if result.is_new_problem or result.status == "damaged":
        yield from (f"  damage:  {describe_finding(finding)} [{finding.code}]" for finding in run.damage)
    if is_new and not several:
        yield from (f"  verdict: {line}" for line in list_verdict(result.verdict))
        yield from (f"  {line}" for line in describe_power(result.verdict))
        where = shlex.join(("tcpipe", "inspect", run.run_id, "--store", str(store)))
        yield from (f"  {line}" for line in format_findings(result.findings, more=where))
    elif is_new or result.is_new_problem:
        yield from (
            f"  {describe_finding(finding)} [{finding.code}]" for finding in problems if finding.code != "log-damaged"
        )


def _print_findings(summary: IngestSummary) -> None:
    """Print the findings of several runs by code."""
    from tcpipe.formats.finding_lines import format_groups, group_findings

    made = [result.run for result in summary.results if result.run and result.status != "unchanged"]
    groups = group_findings(((run.run_id, run.findings) for run in made), len(made))
    for line in format_groups(groups, more=f"tcpipe report {summary.store}"):
        print_line(line)


def _print_sum(summary: IngestSummary) -> None:
    number = len(summary.results)
    old = [result for result in summary.results if result.status == "failed" and not result.is_new_problem]
    count = {
        status: sum(r.status == status for r in summary.results) - (len(old) if status == "failed" else 0)
        for status in ("done", "unchanged", "damaged", "empty", "failed", "waiting")
    }
    if not number:
        print_line("nothing to do: this task of the array has no log")
    elif count["unchanged"] + len(old) == number:
        print_line(f"nothing to do: {count['unchanged']} of {number} logs are in {summary.store} already")
    elif count["failed"] == number:
        print_line(f"{'all ' if number > 1 else ''}{_count_logs(number)} failed; no run was added to {summary.store}")
    else:
        counts_text = ", ".join(
            f"{number_of_logs} {status}" for status, number_of_logs in count.items() if number_of_logs
        )
        print_line(f"{summary.store}: {counts_text}")
    _print_known(summary)


def _count_logs(number: int) -> str:
    return f"{number} log{'s' * (number != 1)}"


def _print_known(summary: IngestSummary) -> None:
    """Print how many problems are known."""
    acknowledged = sum(result.acknowledged for result in summary.results)
    known = [result for result in summary.results if result.known and not result.acknowledged]
    failed = sum(result.status == "failed" for result in known)
    if failed:
        were, them = ("were", "them") if failed > 1 else ("was", "it")
        print_line(f"{_count_logs(failed)} failed before and {were} skipped; --retry-failed tries {them} again")
    if rest := len(known) - failed:
        them = "them" if rest > 1 else "it"
        print_line(
            f"{_count_logs(rest)} known as damaged or empty; 'tcpipe acknowledge RUN' after you have checked {them}"
        )
    if acknowledged:
        print_line(f"{acknowledged} with acknowledged problems")


@click.command()
@click.argument("paths", nargs=-1, type=ONE_OF_SEVERAL, metavar="[LOG...]")
@store_option
@recipe_option
@robot_option("Robot profile, as for ingest.")
@click.option(
    "--min-age", "min_age_s", default="10m", metavar="T", callback=parse_duration,
    help="A log that was changed more recently than this (90, 90s, 10m, 2h, 1d) counts as growing.",
)  # fmt: skip
@json_option
def status(
    paths: tuple[str, ...], *, store: str, recipe: str | None, robot: str | None, min_age_s: float, as_json: bool
) -> int:
    """List whether each log is in the store, waits for ingest, failed or is growing, and why; and the latest calls.

    Without LOG: the logs and folders that the latest calls of ingest were given. The command does not read logs.

    Exit code 3: a log failed, is damaged or gave no segments, a call was killed, files of a run
    are missing, or a dataset is out of date or its last call failed, and it is not acknowledged (tcpipe acknowledge).
    """
    from tcpipe.formats.finding_lines import format_finding
    from tcpipe.formats.object_storage import is_url
    from tcpipe.pipeline.status import find_log_states as run
    from tcpipe.store import is_store

    if paths and is_store(paths[0]):
        store, paths = paths[0], paths[1:]
    elif paths and not is_url(store) and not Path(store).exists():
        raise UsageError(f"{paths[0]}: no store here and none at {store}; name one with --store")
    found = run(IngestOptions(paths, store=store, recipe=recipe, robot=robot, min_age=min_age_s))
    if as_json:
        print_json(found)
        return found.exit_code
    print_lines(found)
    for finding in found.problems:
        print_line(f"tcpipe: {format_finding(finding)}", err=True)
    return found.exit_code


@click.command()
@click.argument("log", type=LOG, metavar="LOG")
@robot_option()
@recipe_option
@msgdef_option
@add_output("preflight")
def preflight(log: str, *, robot: str | None, recipe: str | None, message_definitions: Path | None) -> Preflight:
    """Predict the data of a day from LOG, a typical minute or more, and list what to correct before recording.

    Prints segments per hour, the distance breakdown, the uncertainty of labels, the verdict, and findings with
    remedies. Writes no files.

    Exit codes: 0 ready; 3 warnings, errors or no segments; 1 ingest would fail.
    """
    from tcpipe.pipeline.preflight import preflight as run

    return run(log, recipe=recipe, robot=robot, message_definitions=message_definitions)


@click.command()
@add_path_or_run("run", "LOG|RUN", required=True)
@robot_option()
@recipe_option
@msgdef_option
@add_output("audit")
def audit(run: str, *, store: str, robot: str | None, recipe: str | None, message_definitions: Path | None) -> Audit:
    """Judge the uncertainty of LOG, or of RUN or RUN/RECIPE of the store, by measurements that its track does not use.

    tcpipe fuses the run without its fixes in windows of 10, 30 and 60 s and prints the error of the predicted antenna,
    its σ, and the share of errors inside 1σ and 2σ. Without fixes: length of the track over that of each odometry.
    """
    from tcpipe.pipeline.audit import audit as judge

    return judge(run, recipe=recipe, robot=robot, message_definitions=message_definitions, store=store)


@click.command()
@click.argument("names", nargs=-1, required=True, metavar="RUN|LOG|CALL|DATASET...", shell_complete=complete_runs)
@store_option
@add_output()
def acknowledge(names: tuple[str, ...], *, store: str) -> Acknowledged:
    """Acknowledge checked problems (damaged or failed logs, runs without segments): tcpipe stops reporting them.

    Name a killed call as status prints it; name a waiting log, a damaged document or a dataset by its path.

    If files of a run are missing, this gives up the run: the store no longer expects it.

    This applies to one problem of one content: tcpipe reports other problems, and other content.
    """
    from tcpipe.pipeline.problems import acknowledge as run

    return run(names, store=store)


@click.command()
@click.argument("runs", nargs=-1, metavar="[RUN]...", shell_complete=complete_runs)
@store_option
@recipe_option
@click.option(
    "--forget", multiple=True, metavar="OUT", help="Remove the files that only this deleted dataset needs; repeatable."
)
@click.option("--dry-run", is_flag=True, help="Print what would be removed; change nothing.")
@add_output()
def prune(*, runs: tuple[str, ...], store: str, recipe: str | None, forget: tuple[str, ...], dry_run: bool) -> Pruned:
    """Remove superseded runs, and those of earlier recipes that the current one replaces; or each RUN or RUN/RECIPE.

    tcpipe also removes files of killed calls. It keeps runs that a dataset needs and folders that contain files of
    others. It removes nothing while another call works on the store.
    """
    from tcpipe.pipeline.prune import prune as run

    return run(runs, store=store, recipe=recipe, forget=forget, dry_run=dry_run)


@click.command()
@click.argument("run", metavar="RUN", shell_complete=complete_runs)
@click.argument("out", type=OUTPUT_FILE, metavar="OUT.mcap")
@store_option
@add_output()
def overlay(run: str, out: str, *, store: str) -> Overlay:
    """Write OUT.mcap from RUN or RUN/RECIPE of the store, on the clock of its log.

    OUT contains the fused track, segments with labels, masked sections with reasons, and rejected measurements. Open
    both in Foxglove, or OUT in Rerun or PlotJuggler.
    """
    from tcpipe.pipeline.overlay import write_overlay as write

    return write(run, Path(out), store=store)
