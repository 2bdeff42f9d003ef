"""``tcpipe inspect``: content of a log, a map, a dataset, a run or a store."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import click

from tcpipe.cli.options import add_path_or_run, json_option, msgdef_option, recipe_option, robot_option
from tcpipe.cli.output import NEXT_STEP, print_json, print_line, print_lines
from tcpipe.errors import align_columns

if TYPE_CHECKING:
    from tcpipe.formats.dataset_card import InspectedDataset
    from tcpipe.formats.maps.map_facts import InspectedMap
    from tcpipe.pipeline.inspect import InspectedLogs, InspectedRun, InspectedStore
    from tcpipe.pipeline.log_inspection import InspectedLog, InspectedTopic
    from tcpipe.tables.findings import Finding


@click.command()
@add_path_or_run("path", "[PATH|RUN]", required=False)
@click.option("--full", is_flag=True, help="Read the whole file to find damage and gaps, not only the index.")
@robot_option()
@recipe_option
@msgdef_option
@json_option
def inspect(path: str, *, as_json: bool, **how: Any) -> int:
    """List a log's topics, types, rates and roles, with reasons; a map; a dataset; without PATH, the store.

    RUN, or RUN/RECIPE, is a run of the store.
    """
    from tcpipe.pipeline.inspect import inspect as run

    found = run(path, **how)
    if as_json:
        print_json(found)
    else:
        _PRINTERS[found.kind](found)
    click.get_current_context().meta[NEXT_STEP] = _NEXT_STEPS[found.kind]
    return _exit_code((found,)) if found.kind == "log" else _exit_code(found.logs) if found.kind == "logs" else 0


def _exit_code(logs: Sequence[InspectedLog]) -> int:
    failed = [log.topics is None for log in logs]
    if all(failed):
        return 1
    return 3 if any(failed) or any(log.damage for log in logs) else 0


def _print_logs(found: InspectedLogs) -> None:
    for log in found.logs:
        _print_log(log)
        print_line("")


def _print_log(log: InspectedLog) -> None:
    if log.topics is None:
        for problem in log.problems:
            print_line(problem)
        return
    duration = "" if log.duration_s is None else f", {log.duration_s:.1f} s"
    print_line(f"{log.path}: {log.container}, {(log.size_bytes or 0) / 1e6:.1f} MB{duration}")
    print_line("")
    full = any(topic.stamps for topic in log.topics)
    header = ["topic", "type", "messages", "Hz", "role", "why", *(_READ_HEADER if full else [])]
    rows = [
        [
            topic.name,
            topic.type,
            _format_answer(topic.messages),
            _format_answer(topic.rate_hz),
            topic.role or "",
            topic.why or "",
            *(_read_cells(topic) if full else []),
        ]
        for topic in log.topics
    ]
    _print_table(header, rows)
    if full:
        _print_clocks(log)
    if log.problems:
        print_line("you must decide:")
    for line in log.problems:
        print_line(f"  {line}")
    _print_findings(log.findings or ())
    _print_damage("damage", log.damage or ())
    _print_damage("note", log.notes or ())
    print_line("")
    print_lines((log.recipe or "").rstrip())


def _print_findings(findings: Iterable[Finding]) -> None:
    from tcpipe.formats.finding_lines import list_findings

    for line in list_findings(findings):
        print_line(line)


def _print_damage(kind: str, findings: Iterable[Finding]) -> None:
    from tcpipe.formats.finding_lines import describe_finding

    for finding in findings:
        print_line(f"{kind}: {describe_finding(finding)} [{finding.code}]")


_READ_HEADER = ["read", "gaps", "longest gap [s]", "time", "offset [s]", "stamps"]


def _read_cells(topic: InspectedTopic) -> list[str]:
    """Return the cells of a topic that was read completely, in the order of `_READ_HEADER`."""
    if (stamps := topic.stamps) is None:
        return [""] * len(_READ_HEADER)
    non_numbers = {
        "zero": stamps.zero_stamps,
        "backward": stamps.backward_stamps,
        "wrong": topic.wrong_stamps,
        "repeated": stamps.repeated_stamps,
        "duplicates": stamps.duplicates,
    }
    values = [stamps.messages_read, stamps.gaps, stamps.longest_gap_s, topic.time, topic.header_minus_log_s]
    return [*map(_format_answer, values), ", ".join(f"{count} {kind}" for kind, count in non_numbers.items() if count)]


def _print_clocks(log: InspectedLog) -> None:
    for step in log.clock_steps or ():
        print_line(f"clock step: {step.step_s:+.3f} s at log time {step.log_time_ns} ns on {', '.join(step.topics)}")
    for topic in log.topics or ():
        if topic.simulated_time:
            print_line(f"simulated time: the header stamps of {topic.name} are not wall-clock time")
        for moved_s in topic.moved_s or ():
            print_line(
                f"another clock: the stamps of {topic.name} differ by {-moved_s:+.3f} s from those of most topics"
            )
        if topic.time == "log":
            print_line(f"log time is used for {topic.name}: {topic.time_why}")


def _print_map(found: InspectedMap) -> None:
    size = " x ".join(f"{pixels * found.pixel_size_m:.1f} m" for pixels in (found.cols, found.rows))
    print_line(f"{found.path}: {size} at {found.pixel_size_m:g} m a pixel in {found.crs}")
    print_line("")
    rows = [[layer, found.sources[layer], f"{found.covered[layer]:.1%}"] for layer in found.layers]
    _print_table(["layer", "made from", "covered"], rows)
    print_line("")
    print_line(f"height: {found.height_min_m:.1f} m to {found.height_max_m:.1f} m")
    share = found.class_share
    classes = [
        [str(entry.id), entry.name, "yes" if entry.traversable else "no", f"{share.get(entry.name, 0.0):.1%}"]
        for entry in found.class_table
    ]
    if "terrain" in found.layers:
        print_line("")
        _print_table(["id", "class", "traversable", "share"], classes)
    _print_findings(found.findings)


def _print_dataset(found: InspectedDataset) -> None:
    from tcpipe.formats.dataset_card import group_dataset_findings
    from tcpipe.formats.finding_lines import list_groups, list_verdict

    print_line(
        f"{found.path}: dataset {found.name}, {found.samples} samples of {', '.join(found.robots)}, "
        f"format {found.format}, data model {found.data_model_version}"
    )
    print_line("")
    names = [entry.name for entry in found.classes if any(entry.name in counts for counts in found.terrain.values())]
    rows = [
        [split, str(found.splits[split]), *(str(found.terrain.get(split, {}).get(name, 0)) for name in names)]
        for split in ("train", "test", "unseen", "buffer")
    ]
    _print_table(["split", "samples", *names], rows)
    print_line("")
    labels = [name for name in found.labels if name not in found.absent_labels]
    print_line(f"layers: {', '.join(found.layers) or 'none'}; labels: {', '.join(labels)}")
    print_line(
        f"runs: {', '.join(run.run_id for run in found.runs)}; map: "
        f"{', '.join(entry.name for entry in found.maps) or 'not stated'}"
    )
    for line in list_verdict(found.verdict):
        print_line(f"verdict: {line}")
    for line in list_groups(group_dataset_findings(found.findings, found.findings_by_run, found.findings_by_map)):
        print_line(line)


def _print_store(found: InspectedStore) -> None:
    runs = len({run.run_id for run in found.runs})
    print_line(f"{found.path}: {runs} run{'' if runs == 1 else 's'}, maps: {', '.join(found.maps) or 'none'}")
    print_line("")
    rows = [
        [
            *(run.run_id, run.recipe_id, run.robot, str(run.segments), f"{run.driven_m:.1f}"),
            *(run.position, run.time, run.energy, str(run.findings), str(run.damage)),
        ]
        for run in found.runs
    ]
    header = ["run", "recipe", "robot", "segments", "metres", "position", "time", "energy", "findings", "damage"]
    _print_table(header, rows)
    for name, version in found.outdated.items():
        print_line(f"{name} has data model {version}; ingest its log again")
    for name in found.incomplete:
        print_line(f"{name}: its tables are missing; ingest its log again")
    for document in found.damaged:
        print_line(f"damaged: {document}")
    for run_id, by in found.superseded.items():
        print_line(f"superseded by {by}: {run_id}; its log was completed or repaired")


def _print_run(found: InspectedRun) -> None:
    from tcpipe.formats.finding_lines import describe_power, list_verdict

    print_line(f"{found.run_id}: from {' + '.join(found.log.paths)}")
    if found.tags:
        print_line("tags: " + ", ".join(f"{key}={value}" for key, value in sorted(found.tags.items())))
    _print_damage("note", found.notes)
    for run in found.recipes:
        ledger = run.distance_by_reason_m
        print_line("")
        print_line(f"recipe {run.recipe_id}: {run.counts.segments} segments of robot {run.robot}")
        ordered = sorted(((metres, name) for name, metres in ledger.items() if metres >= 0.05), reverse=True)
        losses = ", ".join(f"{metres:.1f} m {name.replace('_', ' ')}" for metres, name in ordered)
        print_line(f"{run.driven_m:.1f} m driven: {losses}" if losses else "not driven")
        for line in [f"verdict: {line}" for line in list_verdict(run.verdict)] + describe_power(run.verdict):
            print_line(line)
        _print_findings(run.findings)
        _print_damage("damage", run.damage)


def _format_answer(value: object) -> str:
    return "" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)


def _print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    for line in align_columns([header, *rows]):
        print_line(line)


_NEXT_STEPS = {
    "log": "tcpipe ingest {path}",
    "logs": "tcpipe ingest {path}",
    "tables": "tcpipe init --from {path}",
    "map": "tcpipe build-dataset",
    "dataset": "tcpipe report {path}",
    "run": "tcpipe report {path}{store}",
    "store": "tcpipe build-dataset --store {path}",
}
_PRINTERS: dict[str, Callable[..., None]] = {
    "log": _print_log,
    "logs": _print_logs,
    "tables": lambda found: print_lines(found.recipe.rstrip()),
    "map": _print_map,
    "dataset": _print_dataset,
    "run": _print_run,
    "store": _print_store,
}
