"""tcpipe under Dagster: ``dagster dev -f pipelines/dagster/definitions.py``.

Each log is a partition that a sensor finds; the assets are ``run`` (of one log), ``dataset`` and ``model``. The
definitions call tcpipe's commands and read what they print with ``--json``: figures become metadata, findings become
asset checks. The environment states where everything is:

    TCPIPE_LOGS      folder or URL of the recordings (default: recordings)
    TCPIPE_STORE     store with the maps (tcpipe-store)
    TCPIPE_DATASET   (dataset)    TCPIPE_SPLIT   region.geojson, optional
    TCPIPE_MODEL     (model)      TCPIPE_RECIPE  optional
"""

import base64
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dagster as dg

import tcpipe

LOGS = dg.DynamicPartitionsDefinition(name="logs")

_COMMAND = [sys.executable, "-m", "tcpipe"]
_DONE = {0, 3}
"""Exit codes with a result; 3: part of it has a problem."""
_TO_DO = {"pending", "outdated", "failed_transient"}
"""States of logs that `tcpipe ingest` works on."""
_MOST_REQUESTS = 100
"""Most logs that one tick of the sensor requests."""
_UNFINISHED = [
    dg.DagsterRunStatus.NOT_STARTED,
    dg.DagsterRunStatus.QUEUED,
    dg.DagsterRunStatus.STARTING,
    dg.DagsterRunStatus.STARTED,
    dg.DagsterRunStatus.CANCELING,
]
_RETRIES = dg.RetryPolicy(max_retries=3, delay=600, backoff=dg.Backoff.EXPONENTIAL, jitter=dg.Jitter.PLUS_MINUS)
"""Retries of failures that may pass, such as a full disk or a network. Other failures end a run at once."""
_ASSET_SETTINGS: dict[str, Any] = {"retry_policy": _RETRIES, "code_version": tcpipe.__version__, "group_name": "tcpipe"}


@dataclass(frozen=True)
class Answer:
    """Output of a command."""

    result: Mapping[str, Any]
    """The last JSON object."""
    problems: list[str]
    """Lines about problems."""


def _read_setting(name: str, default: str) -> str:
    return os.environ.get(name, default)


def _run_command(log: dg.DagsterLogManager, command: str, *arguments: str, codes: Collection[int] = _DONE) -> Answer:
    """Run a command, log each line of its progress when it comes, and return its answer; fail with its own words."""
    call, problems = [*_COMMAND, command, *arguments, "--json"], list[str]()
    with (
        tempfile.TemporaryFile("w+") as printed,
        subprocess.Popen(call, stdout=printed, stderr=subprocess.PIPE, text=True) as running,
    ):
        try:
            for line in running.stderr or ():
                if line.startswith("tcpipe: "):
                    problems.append(line.removeprefix("tcpipe: ").rstrip())
                    log.warning(problems[-1])
                else:
                    log.info(line.rstrip())
        except BaseException:  # somebody ended the run: tcpipe removes its temporary files
            running.terminate()
            raise
        exit_code = running.wait()
        printed.seek(0)
        result = _read_last_object(printed.read())
    if result is None or result.get("kind") == "failure" or exit_code not in codes:
        metadata = {"exit code": exit_code, "command": " ".join(call[len(_COMMAND) :])}
        is_transient = result is None or bool(result.get("transient"))  # without an answer the process was killed
        raise dg.Failure("\n".join(problems) or f"exit code {exit_code}", metadata, is_transient)
    return Answer(result, problems)


def _read_last_object(text: str) -> Mapping[str, Any] | None:
    decoder, value, text = json.JSONDecoder(), None, text.strip()
    while text:
        value, end = decoder.raw_decode(text)
        text = text[end:].lstrip()
    return value


def _read_states(log: dg.DagsterLogManager) -> dict[str, str]:
    """Return the state of each log by its name in the folder."""
    logs = _read_setting("TCPIPE_LOGS", "recordings").rstrip("/")
    folder = logs if "://" in logs else str(Path(logs).absolute())
    groups = _run_command(log, "status", folder).result["groups"]
    return {name.removeprefix(f"{folder}/"): group["state"] for group in groups for name in group["logs"]}


def _describe_finding(finding: Mapping[str, Any]) -> str:
    """Return a finding as a line; docs/reference/findings.md has the meaning of its code."""
    subject = finding["subject"]
    numbers = [f"{name} {value:.3g}" for name, value in finding.get("numbers", {}).items()]
    facts = ", ".join([*(f"{name} {text}" for name, text in finding.get("names", {}).items()), *numbers])
    return f"{finding['severity']}: {subject.get('name') or subject['kind']}: {finding['code']} ({facts})"


def _format_list(lines: Iterable[str]) -> dg.MetadataValue:
    return dg.MetadataValue.md("\n".join(f"- {line}" for line in lines) or "none")


def _format_distances(distance_by_reason_m: Mapping[str, float]) -> dg.MetadataValue:
    """Return the distance breakdown as a table."""
    rows = sorted(distance_by_reason_m.items(), key=lambda row: -row[1])
    return dg.MetadataValue.md(
        "| metres | |\n|---:|---|\n"
        + "\n".join(f"| {metres:.1f} | {name.replace('_', ' ')} |" for name, metres in rows if metres)
    )


def _read_picture(path: Path) -> dict[str, dg.MetadataValue]:
    """Return a PNG as metadata for the page of the run; nothing if there is no picture."""
    if not path.is_file():
        return {}
    data = base64.b64encode(path.read_bytes()).decode()
    return {"map": dg.MetadataValue.md(f"![map](data:image/png;base64,{data})")}


def _make_check(name: str, problems: list[str], *, warn: bool = False, **more: int | str) -> dg.AssetCheckResult:
    severity = dg.AssetCheckSeverity.WARN if warn else dg.AssetCheckSeverity.ERROR
    metadata = {"problems": _format_list(problems), **more}
    return dg.AssetCheckResult(check_name=name, passed=not problems, severity=severity, metadata=metadata)


def _check_usable(verdict: Mapping[str, Any], damage: Iterable[Mapping[str, Any]]) -> dg.AssetCheckResult:
    """Return whether position, time and energy of a run are usable; the reasons are the problems, the worst first."""
    grades = {name: verdict[name] for name in ("position", "time", "energy")}
    lines = [*map(_describe_finding, verdict["reasons"]), *map(_describe_finding, damage)]
    return _make_check("usable", lines, warn="not usable" not in grades.values(), **grades)


def _check_as_written(log: dg.DagsterLogManager, name: str) -> dg.AssetCheckResult:
    """Return whether an output, or a run of the store, reads again as it was written."""
    verified = _run_command(log, "verify", name, codes={0, 1}).result
    return _make_check("as_written", verified["problems"], **verified["read"])


def _make_as_written_spec(asset: str) -> dg.AssetCheckSpec:
    """Return the check of `_check_as_written`; what depends on the asset is not made if it fails."""
    description = "Every byte is as it was written (tcpipe verify)."
    return dg.AssetCheckSpec("as_written", asset=asset, blocking=True, description=description)


@dg.asset(
    partitions_def=LOGS,
    pool="tcpipe_ingest",
    **_ASSET_SETTINGS,
    kinds={"parquet"},
    check_specs=[
        _make_as_written_spec("run"),
        dg.AssetCheckSpec("usable", asset="run", description="Position, time and energy are usable without care."),
    ],
)
def run(context: dg.AssetExecutionContext) -> dg.MaterializeResult:
    """Labelled segments of one log, in the store."""
    log = f"{_read_setting('TCPIPE_LOGS', 'recordings').rstrip('/')}/{context.partition_key}"
    if "://" not in log and not Path(log).exists():
        raise dg.Failure(f"{log}: this log is gone", allow_retries=False)
    (result,) = _run_command(context.log, "ingest", log, "--existing-store", codes={0, 1, 3}).result["results"]
    if result["status"] in ("failed", "waiting"):
        reason = "\n".join([*result["problems"], *result["notes"]]) or result["status"]
        raise dg.Failure(reason, allow_retries=result["transient"] or result["status"] == "waiting")
    made = result["run"]
    budget, segments = made["energy_budget"], made["tables"]["segments.parquet"]
    return dg.MaterializeResult(
        data_version=dg.DataVersion(f"{made['run_id']}-{made['recipe_id']}-{segments['sha256'][:16]}"),
        metadata={
            "run": made["run_id"],
            "recipe": made["recipe_id"],
            "status": result["status"],
            "robot": made["robot"],
            "segments": made["segments"],
            "driven_m": sum(made["distance_by_reason_m"].values()),
            "in_segments_m": made["distance_by_reason_m"].get("kept", 0.0),
            **({"energy_floor": budget["total"]} if budget else {}),
        },
        check_results=[
            _check_as_written(context.log, f"{made['run_id']}/{made['recipe_id']}"),
            _check_usable(result["verdict"], made["damage"]),
        ],
    )


@dg.asset(
    deps=[run],
    pool="tcpipe_build",
    **_ASSET_SETTINGS,
    kinds={"zarr", "parquet"},
    check_specs=[
        _make_as_written_spec("dataset"),  # no model is trained if it fails
        dg.AssetCheckSpec("as_requested", asset="dataset", description="No run is excluded, no split is empty."),
        dg.AssetCheckSpec(
            "held_out", asset="dataset", description="No patch of test or unseen shares ground with one of train."
        ),
    ],
)
def dataset(context: dg.AssetExecutionContext) -> dg.MaterializeResult:
    """Patches and labels of all runs, split by region."""
    out = _read_setting("TCPIPE_DATASET", "dataset")
    region = os.environ.get("TCPIPE_SPLIT")
    built = _run_command(context.log, "build-dataset", out, *(["--split", region] if region else []))
    card, findings = built.result["card"], built.result["findings"]
    shared = [_describe_finding(finding) for finding in findings if finding["code"] == "split-leakage"]
    return dg.MaterializeResult(
        data_version=dg.DataVersion(card["inputs"]),
        metadata={
            "status": built.result["status"],
            "samples": card["samples"],
            **{f"{name}_samples": count for name, count in card["splits"].items()},
            **({"flagged_share": card["flagged_samples"]["share"]} if card["flagged_samples"] else {}),
            "distance_breakdown": _format_distances(card["distance_by_reason_m"]),
            "findings": _format_list(map(_describe_finding, findings)),
            "page": dg.MetadataValue.path(str(Path(out).absolute() / "report.html")),
            **_read_picture(Path(out) / "overview.png"),
        },
        check_results=[
            _check_as_written(context.log, out),
            _make_check("as_requested", built.problems, warn=True),
            _make_check("held_out", shared, warn=True),
        ],
    )


@dg.asset(
    deps=[dataset],
    pool="tcpipe_build",
    **_ASSET_SETTINGS,
    kinds={"lightgbm"},
)
def model(context: dg.AssetExecutionContext) -> dg.MaterializeResult:
    """Trees on features of the dataset's patches."""
    data, out = _read_setting("TCPIPE_DATASET", "dataset"), _read_setting("TCPIPE_MODEL", "model")
    trained = _run_command(context.log, "train", data, out, "--model", "boosting").result
    return dg.MaterializeResult(metadata={"model": dg.MetadataValue.json(dict(trained))})


nightly = dg.define_asset_job(
    "nightly", dg.AssetSelection.assets(dataset, model), description="Dataset and model of all runs."
)
one_log = dg.define_asset_job("one_log", dg.AssetSelection.assets(run), description="One log to labelled segments.")


@dg.sensor(job=one_log, minimum_interval_seconds=300, default_status=dg.DefaultSensorStatus.RUNNING)
def new_logs(context: dg.SensorEvaluationContext) -> dg.SensorResult:
    """Request a run of each log that is new, changed or outdated and that no run works on; continue after the last tick's last log."""
    known, last = set(context.instance.get_dynamic_partitions("logs")), context.cursor or ""
    unfinished = context.instance.get_runs(dg.RunsFilter(job_name="one_log", statuses=_UNFINISHED))
    busy = {record.tags.get("dagster/partition") for record in unfinished}
    wanted = [
        name
        for name, state in _read_states(context.log).items()
        if name not in busy and (state in _TO_DO or (name not in known and state != "growing"))
    ]
    names = sorted(wanted, key=lambda name: (name <= last, name))[:_MOST_REQUESTS]
    new = sorted(set(names) - known)
    return dg.SensorResult(
        run_requests=[dg.RunRequest(partition_key=name) for name in names],
        dynamic_partitions_requests=[LOGS.build_add_request(new)] if new else [],
        cursor=names[-1] if names else last,
    )


defs = dg.Definitions(
    assets=[run, dataset, model],
    jobs=[nightly, one_log],
    sensors=[new_logs],
    schedules=[dg.ScheduleDefinition(name="every_night", job=nightly, cron_schedule="0 4 * * *")],
)
