"""What the page of a store is made of: what its log says, and what lies where that says."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from tcpipe.formats.commits import Dataset, State
from tcpipe.formats.dataset_files import REPORT
from tcpipe.formats.finding_lines import group_findings
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.stored_runs import Ingestions, RunDirectory
from tcpipe.pipeline.plan import list_transient_failures
from tcpipe.pipeline.problems import find_problems, is_acknowledged, make_failure
from tcpipe.pipeline.prune import is_replaced
from tcpipe.pipeline.store_verdict import find_changes, judge_runs
from tcpipe.report.store_report import FailedLog, StoredDataset, StoreFacts, find_recipe_key
from tcpipe.store import Store


def store_facts(store: Store, found: Ingestions, *, will_be: Sequence[RunDirectory] = ()) -> StoreFacts:
    """Return what is known of all of a store; of the runs ``will_be`` the pages are about to be written."""
    here = (entry.name.split("/") for entry in store.runs_place.entries("", but="streams"))
    pages = {(parts[0], parts[1]) for parts in here if len(parts) == 3 and parts[2] == REPORT}
    state = found.state
    known = {run.run_id for run in found.finished if is_acknowledged(find_problems(run.facts), state)}
    key = find_recipe_key(found)
    current = [run.facts for run in found.finished if run.facts.ingest_key == key]
    changes = find_changes(current)
    return StoreFacts(
        where=str(store.root),
        found=found,
        acknowledged=frozenset(known),
        pages=frozenset(pages | {(run.run_id, run.recipe_id) for run in will_be}),
        datasets=tuple(_describe_dataset(store, made) for made in state.datasets.values()),
        verdict=judge_runs(current, changes),
        changes=changes,
        groups=tuple(group_findings((run.run_id, run.findings) for run in current)),
        failed=tuple(_iterate_failed(state)),
    )


def _describe_dataset(store: Store, made: Dataset) -> StoredDataset:
    """Return a dataset; its page can be led to where both lie on this machine."""
    there, page = not is_replaced(made), Path(made.out) / REPORT
    near = there and not is_url(made.out) and not is_url(store.root) and page.is_file()
    return StoredDataset(
        made.out, made.runs, there, os.path.relpath(page, Path(store.root).absolute()) if near else None
    )


def _iterate_failed(state: State) -> Iterator[FailedLog]:
    """Yield the logs that gave no run, each once: those whose content has given one since are none."""
    made = [row.log.source for row in state.runs.values() if row.log is not None]
    contents, names = {of.sha256 for of in made}, {" + ".join(of.paths) for of in made}
    last = {of.content: of for of in sorted(state.failed.values(), key=lambda of: of.version)}
    for of in sorted(last.values(), key=lambda of: of.log):
        if of.content not in contents:
            names.add(name := " + ".join(of.log))
            acknowledged = is_acknowledged([make_failure(of.content, of.log)], state)
            yield FailedLog(
                name, "".join(of.problems[:1]), "acknowledged" if acknowledged else "failed for what it holds"
            )
    for name, why in list_transient_failures(state.calls).items():
        if name not in names:
            yield FailedLog(name, why, "failed for now")
