"""The runs of a dataset: intact runs of one robot and recipe, and findings on excluded ones."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tcpipe.errors import DatasetError, list_first
from tcpipe.formats.commits import State
from tcpipe.formats.dataset_card import RunSource
from tcpipe.formats.index_files import KnownSensor, RunFacts
from tcpipe.formats.recipe_toml import ingest_key
from tcpipe.formats.run_documents import LogOrigin
from tcpipe.formats.stored_runs import Ingestions, RunDirectory
from tcpipe.recipe import Recipe
from tcpipe.robots import GENERIC
from tcpipe.store import Store
from tcpipe.tables.findings import Finding, Remedy, Subject, make_finding
from tcpipe.tables.levels import DATA_MODEL_VERSION, Sensor

logger = logging.getLogger("tcpipe")

CHOICE_CODES = frozenset({"run-damaged", "run-gone", "run-ingested-otherwise"})
"""Findings on runs that are excluded though they belong in a dataset."""


@dataclass(frozen=True, slots=True)
class SelectedRuns:
    """Runs of one robot and recipe, and findings on excluded ones."""

    runs: tuple[RunDirectory, ...]
    logs: Mapping[str, LogOrigin]
    """By run, its log in run.json."""
    missing: tuple[Finding, ...]
    """On each matching run without a usable ingestion."""
    damaged: tuple[Finding, ...]
    """On each run whose files were changed or lost."""
    findings: tuple[Finding, ...]
    """On superseded runs."""


def choose_runs(
    store: Store, recipe: Recipe, *, state: State | None = None, robot: str | None, tags: Mapping[str, str]
) -> SelectedRuns:
    """Return the runs with all of the tags, each verified; two robots are pooled only on request."""
    found, key = store.ingestions(state=state), ingest_key(recipe)
    mine = [run for run in found.finished if run.facts.ingest_key == key]
    if not mine:
        raise DatasetError(*_describe_no_runs(store, found))
    for problem in found.state.problems:
        if problem.key not in found.state.acknowledged:
            logger.warning("%s: is missing or damaged, so that runs may be; see 'tcpipe status'", problem.log[0])
    candidates = _select_one_robot(store, _select_tagged(store, mine, tags), robot)
    damaged = store.prove(candidates)
    logs = {run.run_id: run.facts.log.source for run in candidates if run.facts.log and run.run_id not in damaged}
    runs = [run for run in candidates if run.run_id in logs]
    known = {run.run_id for run in mine}
    for (run_id, recipe_id), line in found.damaged.items():
        if run_id not in known and _is_selected(found.rows[run_id, recipe_id], robot, tags):
            damaged.setdefault(run_id, line)
    if not runs:
        raise DatasetError(
            *(f"run {run_id}: excluded: {line}; ingest its log again with --force" for run_id, line in damaged.items())
        )
    if robot is None:
        _refuse_unlike(store, [run for run in runs if run.facts.robot == GENERIC])
    otherwise = {
        run.run_id: {"what": "recipe", "has": run.recipe_id}
        for run in found.finished
        if _is_selected(run.facts, robot, tags)
    }
    otherwise |= {
        run_id: {"what": "data_model", "has": str(outdated.data_model_version)}
        for run_id, outdated in found.outdated.items()
        if _is_selected(outdated, robot, tags)
    }
    otherwise = {run_id: names for run_id, names in otherwise.items() if run_id not in {*known, *damaged}}
    nothing: dict[str, str] = {}
    missing = tuple(_find_left_out(found, "run-ingested-otherwise", otherwise))
    broken = tuple(_find_left_out(found, "run-damaged", dict.fromkeys(damaged, nothing), force=True))
    superseded = tuple(
        make_finding("run-superseded", Subject("run", run_id), names={"by": by})
        for run_id, by in found.superseded.items()
    )
    return SelectedRuns(tuple(runs), logs, missing, broken, superseded)


def _find_left_out(
    found: Ingestions, code: str, names: Mapping[str, Mapping[str, str]], *, force: bool = False
) -> Iterator[Finding]:
    """Yield a finding on each run of ``names``, with the command that ingests their logs again."""
    command = f"tcpipe ingest {_suggest_logs(found, names)}{' --force' if force else ''}" if names else ""
    for run_id in sorted(names):
        subject, remedy = Subject("run", run_id), Remedy("ingest", command=command)
        yield make_finding(code, subject, names=names[run_id], remedies=[remedy])


def _select_one_robot(store: Store, runs: list[RunDirectory], robot: str | None) -> list[RunDirectory]:
    robots = sorted({run.facts.robot for run in runs})
    wanted = [run for run in runs if robot is None or run.facts.robot == robot]
    if not wanted:
        raise DatasetError(f"{store.root}: no run of robot {robot!r}; there are runs of {', '.join(robots)}")
    if robot is None and len(robots) > 1:
        raise DatasetError(f"{store.root}: runs of {len(robots)} robots ({', '.join(robots)}); name one with --robot")
    return wanted


def _refuse_unlike(store: Store, runs: Iterable[RunDirectory]) -> None:
    """Raise an error if runs of the generic robot have different sensors."""
    groups = group_similar_runs({run.run_id: run.facts.log.sensors if run.facts.log else {} for run in runs})
    if len(groups) > 1:
        raise DatasetError(
            f"{store.root}: the runs of robot {GENERIC} are not all of one robot: their sensors differ; expected one: tag each "
            "(tcpipe ingest LOG --tag robot=NAME) and choose it with --tag robot=NAME, or pool them with --robot generic",
            *(f"{list_first(sorted(names), 3)}: {format_robot(sensors)}" for names, sensors in groups),
        )


def _select_tagged(store: Store, runs: list[RunDirectory], tags: Mapping[str, str]) -> list[RunDirectory]:
    """Return the runs with all of the tags; `DatasetError` lists all tags if no run has them."""
    chosen = [run for run in runs if tags.items() <= run.facts.tags.items()]
    if not chosen:
        wanted = " ".join(f"{key}={value}" for key, value in tags.items())
        there = sorted({f"{key}={value}" for run in runs for key, value in run.facts.tags.items()})
        raise DatasetError(f"{store.root}: no run is tagged {wanted}; tags there are: {', '.join(there) or 'none'}")
    return chosen


def _describe_no_runs(store: Store, found: Ingestions) -> list[str]:
    """Return why no run of the store can be used."""
    if not (found.finished or found.outdated or found.damaged):
        return [f"{store.root}: no runs in the store; ingest one: tcpipe ingest LOG"]
    head = ""
    if found.finished:
        head = (
            f"{len({run.run_id for run in found.finished})} runs in the store, none ingested with this recipe; ingest them with it "
            "(tcpipe ingest LOG --recipe FILE), or give the recipe they were ingested with (--recipe FILE)"
        )
    elif found.outdated:
        versions = ", ".join(sorted({str(head.data_model_version) for head in found.outdated.values()}))
        head = (
            f"{len(found.outdated)} runs in the store, all of data model {versions}, expected {DATA_MODEL_VERSION}; "
            "ingest their logs again"
        )
    return [*([f"{store.root}: {head}"] if head else []), *dict.fromkeys(found.damaged.values())]


def _is_selected(known: RunFacts | RunSource, robot: str | None, tags: Mapping[str, str]) -> bool:
    """Return whether a run has the requested robot and tags, as far as they are known."""
    its_robot = robot is None or known.robot == robot
    return its_robot and (known.tags is None or tags.items() <= known.tags.items())


def _suggest_logs(found: Ingestions, run_ids: Iterable[str]) -> str:
    """Return an argument of `tcpipe ingest` for the logs of runs: their common folder, or LOG..."""
    names = set(run_ids)
    logs = [row.log.source for row in found.rows.values() if row.log and row.run_id in names]
    paths = [path for log in logs for path in log.paths]
    with suppress(ValueError):  # no path, or some relative and some not
        folder = Path(os.path.commonpath(paths))
        if folder.is_absolute() and folder != Path(folder.anchor):
            return str(folder)
    return "LOG..."


def find_gone_runs(
    before: Sequence[RunSource], chosen: SelectedRuns, *, robot: str | None, tags: Mapping[str, str]
) -> tuple[Finding, ...]:
    """Return a finding on each matching run of the replaced dataset that the store no longer has."""
    excluded = (*chosen.missing, *chosen.damaged, *chosen.findings)
    here = {*(run.run_id for run in chosen.runs), *(finding.subject.name for finding in excluded)}
    gone = [run.run_id for run in before if run.run_id not in here and _is_selected(run, robot, tags)]
    return tuple(make_finding("run-gone", Subject("run", run_id)) for run_id in sorted(gone))


SensorsByRole = dict[str, tuple[str, str, str]]
"""By role: topic, type and frame of a sensor."""


def group_similar_runs(
    sensors: Mapping[str, Mapping[str, Sensor | KnownSensor]],
) -> list[tuple[list[str], SensorsByRole]]:
    """Return groups of runs whose sensors, by run and role, agree in type, frame and namespace, and the sensors of each group.

    A run belongs to the first group with which it shares a role and differs in none: a sensor may be off for a drive.
    """
    groups: list[tuple[list[str], SensorsByRole]] = []
    sensors_by_run = {
        run_id: {role: (sensor.topic, sensor.type_name, sensor.frame_id.strip("/")) for role, sensor in own.items()}
        for run_id, own in sensors.items()
    }
    for run_id, own_sensors in sorted(sensors_by_run.items(), key=lambda item: (-len(item[1]), item[0])):
        for runs, group_sensors in groups:
            shared = own_sensors.keys() & group_sensors.keys()
            if all(_is_similar(own_sensors[role], group_sensors[role]) for role in shared) and (
                shared or not (own_sensors or group_sensors)
            ):
                runs.append(run_id)
                group_sensors.update(
                    {role: sensor for role, sensor in own_sensors.items() if role not in group_sensors}
                )
                break
        else:
            groups.append(([run_id], own_sensors))
    return groups


def format_robot(sensors: SensorsByRole) -> str:
    """Return the sensors of a robot as one line."""
    parts = (
        f"{role} {topic} ({kind}, frame {frame or 'none'})" for role, (topic, kind, frame) in sorted(sensors.items())
    )
    return ", ".join(parts) or "no sensor is known"


def _is_similar(one: tuple[str, str, str], other: tuple[str, str, str]) -> bool:
    return one[1:] == other[1:] and not _is_in_two_namespaces(one[0], other[0])


def _is_in_two_namespaces(one: str, other: str) -> bool:
    """Return whether two topics differ only in their namespace, as /imu, /rover1/imu and /rover2/imu."""
    a, b = one.strip("/").split("/"), other.strip("/").split("/")
    return a != b and (a[1:] == b or a == b[1:] or (a[1:] == b[1:] and len(a) > 1))
