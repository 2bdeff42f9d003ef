"""tcpipe under Dagster: ``dagster dev -f pipelines/dagster/definitions.py``.

Every log is a partition, found by a sensor; the assets are ``run`` (of one log), ``dataset`` and ``model``. What tcpipe says of them is
their metadata, what it finds wrong is an asset check. The commands do the work: a run of a partition looks at no other log. Where things
lie is told by the environment:

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
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import dagster as dg

from tcpipe import __version__
from tcpipe.formats.commits import State
from tcpipe.formats.finding_lines import format_finding, list_findings
from tcpipe.formats.json_files import digest, parse_typed
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.recipe_toml import ingest_key, resolve_recipe
from tcpipe.pipeline.log_sources import find_sources
from tcpipe.pipeline.plan import IngestTask, Step, plan
from tcpipe.store import is_store, open_store
from tcpipe.tables.findings import AFFECTED, Finding, Verdict, is_problem, select_findings

Answer = Mapping[str, Any]

LOGS = dg.DynamicPartitionsDefinition(name="logs")

_DONE = {0, 3}
"""Exit codes with a result: done; done, and something in it wants to be looked at."""
_USAGE = 2
"""Exit code of a call that fails again however often it is tried."""
_YOUNG_S = 600.0
"""A log that was written to since is not asked for yet: it may still be written, or on its way."""
_A_TICK = 100
"""Most logs that one tick of the sensor asks for."""
_RETRIES = dg.RetryPolicy(max_retries=3, delay=600, backoff=dg.Backoff.EXPONENTIAL, jitter=dg.Jitter.PLUS_MINUS)
"""Of what may pass: a full disk, a network."""
_OF_ALL_ASSETS: dict[str, Any] = {"retry_policy": _RETRIES, "code_version": __version__, "group_name": "tcpipe"}


def _read_setting(name: str, default: str) -> str:
    return os.environ.get(name, default)


def _run_command(command: str, *arguments: str, codes: Collection[int] = _DONE) -> list[Answer]:
    """Run a command; return what it prints as JSON, or fail with its own words."""
    line = [sys.executable, "-m", "tcpipe", command, *arguments, "--json"]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode not in codes or not done.stdout.strip():
        said = done.stderr.strip() or done.stdout.strip()
        told = {"exit code": done.returncode, "command": " ".join(line[2:])}
        raise dg.Failure(said, metadata=told, allow_retries=done.returncode != _USAGE)
    text, found, decoder = done.stdout.strip(), [], json.JSONDecoder()
    while text:
        value, end = decoder.raw_decode(text)
        found.append(value)
        text = text[end:].lstrip()
    return found


def _plan() -> dict[str, Step]:
    """Return what every log needs as recipe and store are now, by partition: where it lies in the folder."""
    recipe, store = resolve_recipe(None), _read_setting("TCPIPE_STORE", "tcpipe-store")
    with tempfile.TemporaryDirectory() as staging:
        logs = [_read_setting("TCPIPE_LOGS", "recordings")]
        found = find_sources(logs, as_one=False, staging=Path(staging), tables=recipe.tables).sources
    state = open_store(store).state() if is_store(store) else State()
    tasks = [IngestTask(source, store, recipe, recipe.robot, {}, force=False, min_age_s=_YOUNG_S) for source in found]
    return {step.task.source.place: step for step in plan(tasks, state)}


def _make_run_key(step: Step) -> str:
    """Return what changes when a log is to be ingested again: its name, size and time, the recipe, the version."""
    source, recipe = step.task.source, step.task.recipe
    return f"{source.place}:{digest([source.files_digest, ingest_key(recipe), recipe.robot, __version__])[:16]}"


def _format_list(lines: list[str]) -> dg.MetadataValue:
    return dg.MetadataValue.md("\n".join(f"- {line}" for line in lines) or "none")


def _format_distances(distance_by_reason_m: Mapping[str, float]) -> dg.MetadataValue:
    """Return where every metre went, as a table."""
    rows = sorted(distance_by_reason_m.items(), key=lambda row: -row[1])
    return dg.MetadataValue.md(
        "| metres | |\n|---:|---|\n"
        + "\n".join(f"| {metres:.1f} | {name.replace('_', ' ')} |" for name, metres in rows if metres)
    )


def _read_picture(path: Path) -> dict[str, dg.MetadataValue]:
    """Return a PNG as something that the page shows, nothing where there is none."""
    if not path.is_file():
        return {}
    data = base64.b64encode(path.read_bytes()).decode()
    return {"map": dg.MetadataValue.md(f"![map](data:image/png;base64,{data})")}


def _make_check(name: str, problems: list[str], *, warn: bool = False, **more: int | str) -> dg.AssetCheckResult:
    severity = dg.AssetCheckSeverity.WARN if warn else dg.AssetCheckSeverity.ERROR
    metadata = {"problems": _format_list(problems), **more}
    return dg.AssetCheckResult(check_name=name, passed=not problems, severity=severity, metadata=metadata)


def _check_usable(result: Answer) -> dg.AssetCheckResult:
    """Return whether position, time and energy of a run are usable; the reasons are the problems, the worst first."""
    verdict = parse_typed(result["verdict"], Verdict, "tcpipe ingest --json")
    damage = parse_typed(result["run"]["damage"], tuple[Finding, ...], "tcpipe ingest --json")
    lines = [*map(format_finding, verdict.reasons), *map(format_finding, damage)]
    grades = {name: getattr(verdict, name) for name in AFFECTED}
    return _make_check("usable", lines, warn=verdict.worst != "not usable", **grades)


def _check_as_written(path: str) -> dg.AssetCheckResult:
    """Return whether what was made reads again as it was written."""
    (found,) = _run_command("verify", path, codes={0, 1})
    return _make_check("as_written", found["problems"], **found["read"])


def _make_as_written_spec(asset: str) -> dg.AssetCheckSpec:
    """Return the check of `_check_as_written`; what depends on the asset is not made where it fails."""
    description = "Every byte is as it was written (tcpipe verify)."
    return dg.AssetCheckSpec("as_written", asset=asset, blocking=True, description=description)


@dg.asset(
    partitions_def=LOGS,
    pool="tcpipe_ingest",
    **_OF_ALL_ASSETS,
    kinds={"parquet"},
    check_specs=[
        _make_as_written_spec("run"),
        dg.AssetCheckSpec("usable", asset="run", description="Position, time and energy are usable without care."),
    ],
)
def run(context: dg.AssetExecutionContext) -> dg.MaterializeResult:
    """Labelled segments of one log, in the store."""
    log = f"{_read_setting('TCPIPE_LOGS', 'recordings').rstrip('/')}/{context.partition_key}"
    if not is_url(log) and not Path(log).exists():
        raise dg.Failure(f"{log}: this log is gone", allow_retries=False)
    result = _run_command("ingest", log, codes={0, 1, 3})[-1]["results"][0]
    if result["status"] in ("failed", "waiting"):
        said = "\n".join([*result["problems"], *result["notes"]]) or result["status"]
        raise dg.Failure(said, allow_retries=result["transient"] or result["status"] == "waiting")
    made = result["run"]
    budget = made["energy_budget"]
    return dg.MaterializeResult(
        data_version=dg.DataVersion(digest([made["run_id"], made["recipe_id"], made["segments_sha256"]])),
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
            _check_as_written(f"{_read_setting('TCPIPE_STORE', 'tcpipe-store')}/runs/{made['run_id']}"),
            _check_usable(result),
        ],
    )


@dg.asset(
    deps=[run],
    pool="tcpipe_build",
    **_OF_ALL_ASSETS,
    kinds={"zarr", "parquet"},
    check_specs=[
        _make_as_written_spec("dataset"),  # no model is trained where it fails
        dg.AssetCheckSpec("as_asked_for", asset="dataset", description="No run is left out, no split is empty."),
        dg.AssetCheckSpec(
            "held_out", asset="dataset", description="No patch of test or unseen shares ground with one of train."
        ),
    ],
)
def dataset() -> dg.MaterializeResult:
    """Patches and labels of all runs, split by region."""
    out = _read_setting("TCPIPE_DATASET", "dataset")
    region = os.environ.get("TCPIPE_SPLIT")
    (made,) = _run_command("build-dataset", out, *(["--split", region] if region else []))
    card, findings = made["card"], parse_typed(made["findings"], tuple[Finding, ...], "tcpipe build-dataset --json")
    problems = [format_finding(finding) for finding in findings if is_problem(finding)]
    shared = [format_finding(finding) for finding in select_findings(findings, "split-leakage")]
    return dg.MaterializeResult(
        data_version=dg.DataVersion(card["inputs"]),
        metadata={
            "status": made["status"],
            "samples": card["samples"],
            **{f"{name}_samples": count for name, count in card["splits"].items()},
            **({"flagged_share": card["flagged_samples"]["share"]} if card["flagged_samples"] else {}),
            "where_every_metre_went": _format_distances(card["distance_by_reason_m"]),
            "findings": _format_list(list_findings(findings)),
            "page": dg.MetadataValue.path(str(Path(out).absolute() / "report.html")),
            **_read_picture(Path(out) / "overview.png"),
        },
        check_results=[
            _check_as_written(out),
            _make_check("as_asked_for", problems, warn=True),
            _make_check("held_out", shared, warn=True),
        ],
    )


@dg.asset(
    deps=[dataset],
    pool="tcpipe_build",
    **_OF_ALL_ASSETS,
    kinds={"lightgbm"},
)
def model() -> dg.MaterializeResult:
    """Trees on features of the dataset's patches."""
    data, out = _read_setting("TCPIPE_DATASET", "dataset"), _read_setting("TCPIPE_MODEL", "model")
    (trained,) = _run_command("train", data, out, "--model", "boosting")
    return dg.MaterializeResult(metadata={"model": dg.MetadataValue.json(dict(trained))})


nightly = dg.define_asset_job(
    "nightly", dg.AssetSelection.assets(dataset, model), description="Dataset and model of all runs."
)
one_log = dg.define_asset_job("one_log", dg.AssetSelection.assets(run), description="One log to labelled segments.")


@dg.sensor(job=one_log, minimum_interval_seconds=300, default_status=dg.DefaultSensorStatus.RUNNING)
def new_logs(context: dg.SensorEvaluationContext) -> dg.SensorResult:
    """Ask for a run of every log that is new or is to be ingested again, once it rests; a tick goes on behind the last one."""
    steps, known, last = _plan(), set(context.instance.get_dynamic_partitions("logs")), context.cursor or ""
    wanted = [at for at, step in steps.items() if step.is_todo or (at not in known and step.state != "growing")]
    places = sorted(wanted, key=lambda place: (place <= last, place))[:_A_TICK]
    new = sorted(set(places) - known)
    return dg.SensorResult(
        run_requests=[dg.RunRequest(partition_key=place, run_key=_make_run_key(steps[place])) for place in places],
        dynamic_partitions_requests=[LOGS.build_add_request(new)] if new else [],
        cursor=places[-1] if places else last,
    )


defs = dg.Definitions(
    assets=[run, dataset, model],
    jobs=[nightly, one_log],
    sensors=[new_logs],
    schedules=[dg.ScheduleDefinition(name="every_night", job=nightly, cron_schedule="0 4 * * *")],
)
