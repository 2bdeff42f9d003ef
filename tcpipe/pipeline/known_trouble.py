"""Trouble with logs that is known: what failed or is damaged and was told before, and what a person has accepted (ADR 50)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from tcpipe import __version__
from tcpipe.errors import UsageError
from tcpipe.formats.atomic import scratch_directory
from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.json_files import digest
from tcpipe.formats.record_files import record_name
from tcpipe.pipeline.begun_calls import BegunCall, begun_calls
from tcpipe.pipeline.log_sources import LogSource, find_sources, lineage_of
from tcpipe.store import Store, open_store
from tcpipe.tables.findings import LEFT_OUT, Finding, select_problems

_MOST_CANDIDATES = 10


@dataclass(frozen=True, slots=True)
class Trouble:
    """What is wrong with a content, wherever that lies: codes of findings, lines of damage, or why it failed."""

    content: str
    """The sha256 of the log; where nothing could be read, a hash of where it lies, sizes and times."""
    lines: tuple[str, ...]
    log: tuple[str, ...]
    """Where it lay when it was told."""
    run_id: str | None = None
    kind: str = ""
    """``damaged``, ``empty``, ``failed``, ``waiting`` or ``killed``."""
    version: str | None = field(default=None, metadata=LEFT_OUT)
    """Of a failure: of the program that failed."""

    @property
    def called(self) -> str:
        """What a person calls it: the run, or the log that gave none."""
        return self.run_id or " + ".join(self.log)

    @property
    def _name(self) -> str:
        return record_name(digest([self.content, self.lines]))

    def is_accepted(self, store: Store) -> bool:
        """Tell whether a person has said that this is no news."""
        return store.recall(f"accepted/{self._name}", Trouble) is not None

    def accept(self, store: Store) -> bool:
        """Remember that a person has looked at it; return whether that is new."""
        return store.remember(f"accepted/{self._name}", self)

    def is_told(self, store: Store) -> bool:
        """Tell whether this trouble of a run was told before."""
        return store.recall(f"{self.kind}/{self._name}", Trouble) is not None

    def told(self, store: Store) -> None:
        """Remember that this trouble of a run was told."""
        store.remember(f"{self.kind}/{self._name}", self)


def trouble_of_run(
    run_id: str | None, findings: Iterable[Finding], damage: tuple[str, ...], *, content: str, log: tuple[str, ...]
) -> Trouble | None:
    """Return what is wrong with a run that is in the store, None where nothing is: codes of its problems, and lines of damage."""
    codes = dict.fromkeys(of.code for of in select_problems(findings) if of.code != "log-damaged")
    lines = (*codes, *damage)
    return Trouble(content, lines, log, run_id, "damaged" if damage else "empty") if lines else None


def failure_name(content: str, *, ingest_key: str, robot: str | None, definitions: str) -> str:
    """Return the name of the record of a failure: the same content, treated in the same way, fails again."""
    how = {"version": __version__, "ingest_key": ingest_key, "robot": robot, "message_definitions": definitions}
    return f"failed/{record_name(digest({'content': content, **how}))}"


def trouble_of_call(call: BegunCall) -> Trouble:
    """Return the trouble that a call was killed; its record names it."""
    return Trouble(call.name, (), (), call.name, "killed")


def trouble_of_waiting(source: LogSource) -> Trouble:
    """Return the trouble that a log has waited for too long, as it is now."""
    return Trouble(source.files_digest, (), source.origins, kind="waiting")


@dataclass(frozen=True, slots=True)
class Accepted:
    """What was accepted now, and what was before."""

    accepted: tuple[Trouble, ...]
    before: tuple[Trouble, ...]


def accept(names: Sequence[str], *, store: str | Path = "tcpipe-store") -> Accepted:
    """Accept the known trouble of runs, logs and killed calls: it is counted no more, until it is another.

    Parameters
    ----------
    names : runs by their id, logs by path, URL or, where that is enough, file name; killed calls by the name that `status` says.
    store : the store that knows of the trouble.

    Raises
    ------
    StoreError : there is no store.
    UsageError : a name is none of a run or log with known trouble, or of several logs; nothing was accepted then.
    """
    opened = open_store(store)
    known = known_trouble(opened, [run.facts for run in opened.runs()])
    known += [trouble_of_call(call) for call in begun_calls(opened) if call.state == "killed"]
    chosen: list[Trouble] = []
    problems: list[str] = []
    for name in dict.fromkeys(names):
        found = _named(name, known, opened) or _waiting(name, opened)
        if len({trouble.called for trouble in found}) == 1:
            chosen += found
        else:
            problems.append(_not_one(name, found, [of for of in known if not of.is_accepted(opened)], opened))
    if problems:
        raise UsageError(*problems)
    now = [trouble for trouble in chosen if trouble.accept(opened)]
    return Accepted(tuple(now), tuple(trouble for trouble in chosen if trouble not in now))


def known_trouble(store: Store, runs: Sequence[RunFacts]) -> list[Trouble]:
    """Return all trouble that was told, and that of ``runs`` that were made before it was remembered."""
    kinds = ("failed", "damaged", "empty")
    known = [replace(told, kind=kind) for kind in kinds for told in store.records(kind, Trouble)]
    for run in runs:
        of = run.log.source if run.log else None
        found = trouble_of_run(run.run_id, run.findings, run.damage, content=of.sha256, log=of.paths) if of else None
        known += [found] if found else []
    return list({(trouble.content, trouble.lines): trouble for trouble in reversed(known)}.values())


def _named(name: str, known: Sequence[Trouble], store: Store) -> list[Trouble]:
    paths = {name, str(Path(name).absolute()), str(Path(name).resolve())}
    contents = {sighting.sha256 for path in paths for sighting in store.sightings(lineage_of((path,)))}
    exact = [
        trouble
        for trouble in known
        if trouble.content in contents or paths & {trouble.run_id, " + ".join(trouble.log), *trouble.log}
    ]
    return exact or [trouble for trouble in known if name in {Path(origin).name for origin in trouble.log}]


def _waiting(name: str, store: Store) -> list[Trouble]:
    """Return the trouble of a log by its path or URL that the store does not hold: nobody wants to be told that it waits."""
    with scratch_directory() as staging:
        sources = find_sources([name], as_one=False, staging=staging).sources
    return [trouble_of_waiting(source) for source in sources if not store.sightings(source.lineage)]


def _not_one(name: str, found: Sequence[Trouble], candidates: Sequence[Trouble], store: Store) -> str:
    if found:
        return f"{name}: {len(found)} logs are called so; give the path of one: {_listed(found)}"
    if name in store.run_ids():
        return f"{name}: no trouble is known of this run; there is nothing to accept"
    listed = f"trouble is known of {_listed(candidates)}" if candidates else "no trouble is known here"
    return f"{name}: no run or log with known trouble is called so in {store.root}; {listed}"


def _listed(troubles: Sequence[Trouble]) -> str:
    names = sorted({trouble.called for trouble in troubles})
    more = f" and {len(names) - _MOST_CANDIDATES} more" if len(names) > _MOST_CANDIDATES else ""
    return ", ".join(names[:_MOST_CANDIDATES]) + more
