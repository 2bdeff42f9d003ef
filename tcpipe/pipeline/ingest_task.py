"""What ingesting one log takes and what becomes of it; an error becomes a result, so that one log never costs the others."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

from tcpipe import __version__
from tcpipe.errors import TcpipeError, clean_line, hide_secrets
from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.json_files import digest
from tcpipe.formats.recipe_toml import ingest_key
from tcpipe.formats.run_documents import Manifest
from tcpipe.pipeline.log_sources import LogSource, find_failure, is_transient
from tcpipe.recipe import Recipe
from tcpipe.tables.findings import Finding, Verdict, select_problems

R = TypeVar("R")

logger = logging.getLogger("tcpipe")

Status = Literal["done", "unchanged", "damaged", "empty", "failed", "waiting"]


@dataclass(frozen=True, slots=True)
class IngestTask:
    """One run to make: the log and how."""

    source: LogSource
    store: Path | str
    recipe: Recipe
    robot: str | None
    tags: Mapping[str, str]
    force: bool
    message_definitions: Path | None = None
    """A directory of .msg files for types that the log does not define."""
    definitions: str = ""
    """Their `definitions_key`."""
    retry_failed: bool = False
    min_age_s: float = 0.0

    def is_made_by(self, made: RunFacts | Manifest) -> bool:
        """Tell whether an ingestion of this content is as it would be made now."""
        same_robot = made.robot_requested == self.robot or (self.robot is not None and made.robot == self.robot)
        same_version = made.tcpipe_version == __version__ and made.message_definitions == self.definitions
        return made.ingest_key == ingest_key(self.recipe) and same_version and same_robot

    @property
    def failure_key(self) -> str:
        """What identifies a failure because of the log's content: the same content, treated in the same way, fails again."""
        how = {"version": __version__, "ingest_key": ingest_key(self.recipe), "robot": self.robot}
        return digest(
            {**how, "content": self.source.sha256 or self.source.files_digest, "message_definitions": self.definitions}
        )[:32]


@dataclass(frozen=True, slots=True)
class IngestResult:
    """What became of one log."""

    log: str
    status: Status
    run: RunFacts | None = None
    """What the log of the store has of its run; None of a log that waits, or failed."""
    verdict: Verdict | None = None
    """Of the run."""
    causes: tuple[Finding, ...] = ()
    """Of a log that failed: what went wrong."""
    problems: tuple[str, ...] = ()
    """Why it failed, as lines."""
    same_as: str | None = None
    """The log from which the same recording was ingested before, under another path; it is one run."""
    sha256: str | None = None
    notes: tuple[str, ...] = ()
    """What else is to be said: why it waits, which runs it supersedes."""
    transient: bool = False
    """Whether it failed for what may pass: a full disk, a killed worker."""
    known: bool = False
    """Whether it failed before and was not tried again, or what is wrong with its run was told before."""
    acknowledged: bool = False
    """Whether a person has acknowledged what is wrong with it (`tcpipe acknowledge`)."""
    traceback: str | None = None
    """Where an internal error comes from."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """On the run, or on the log that failed."""
        return self.run.findings if self.run else self.causes

    @property
    def is_news(self) -> bool:
        """Whether something is wrong that nobody was told before, or acknowledged."""
        is_wrong = self.status == "failed" or bool(select_problems(self.findings))
        return is_wrong and not self.known and not self.acknowledged


@dataclass(frozen=True, slots=True, kw_only=True)
class LogLine(IngestResult):
    """What became of one log, as ``ingest --json`` says it when the log ends."""

    kind: Literal["log"] = "log"
    is_news: bool = False


def make_result(source: LogSource, status: Status, made: RunFacts, sha256: str, *, same_as: str | None) -> IngestResult:
    """Return what became of a log whose run is in the store."""
    if status == "done":
        status = made.defect or status
    return IngestResult(source.name, status, made, made.verdict, same_as=same_as, sha256=sha256)


def check_age(task: IngestTask, now_ns: int | None = None) -> IngestResult | None:
    """Return that a log has to wait, None where it has not."""
    age_s = ((time.time_ns() if now_ns is None else now_ns) - task.source.youngest_ns) / 1e9
    if not task.source.files or age_s >= task.min_age_s or not task.min_age_s:
        return None
    note = f"it was written {max(age_s, 0.0):.0f} s ago; it is ingested when it is {task.min_age_s:g} s old"
    return IngestResult(task.source.name, "waiting", notes=(note,))


def make_died_result(source: LogSource) -> IngestResult:
    """Return that the process which worked on a log is gone."""
    problem = f"{source.name}: its worker process died (killed, or out of memory); run it again"
    findings = find_failure(source.name, "WorkerDied")
    return IngestResult(source.name, "failed", causes=findings, problems=(problem,), transient=True)


def mark_reported(task: IngestTask, act: Callable[[IngestTask], R]) -> R | IngestResult:
    """Do something with a log; an error becomes its result."""
    try:
        return act(task)
    except Exception as error:  # noqa: BLE001  at last a bug that one log meets
        for line in "".join(traceback.format_exception(error)).splitlines():
            logger.debug("%s: %s", task.source.name, line)
        problems, trace = _format_error(error, task.source)
        causes = error.findings if isinstance(error, TcpipeError) else ()
        return IngestResult(
            task.source.name,
            "failed",
            causes=(*find_failure(task.source.name, type(error).__name__), *causes),
            problems=problems,
            transient=is_transient(error) or not task.source.files,
            traceback=trace,
        )


def _format_error(error: Exception, source: LogSource) -> tuple[tuple[str, ...], str | None]:
    """Return lines about what went wrong with a log, and where an internal error comes from."""
    if isinstance(error, TcpipeError):
        return _add_log_name(source, error.problems), None
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return _add_log_name(source, (clean_line(f"{where}{error.strerror or error}"),)), None
    if isinstance(error, MemoryError):
        return (f"{source.name}: not enough memory; fewer --jobs need less",), None
    what = f"internal error, {type(error).__name__}: {error}; please report it (tcpipe --debug shows where)"
    return (clean_line(f"{source.name}: {what}"),), hide_secrets("".join(traceback.format_exception(error)))


def _add_log_name(source: LogSource, problems: tuple[str, ...]) -> tuple[str, ...]:
    """Return the problems with the log's name in the first, unless a file of it is named there."""
    if any(clean_line(origin) in problems[0] for origin in source.origins):
        return problems
    return (f"{source.name}: {problems[0]}", *problems[1:])
