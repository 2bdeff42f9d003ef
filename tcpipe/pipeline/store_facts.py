"""What the page of a store is made of: its index, its records, and what lies where they say."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from tcpipe.formats.dataset_files import REPORT
from tcpipe.formats.finding_lines import group_findings
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.record_files import DatasetMade
from tcpipe.formats.stored_runs import Ingestions, RunDirectory
from tcpipe.pipeline.calls import latest_calls
from tcpipe.pipeline.known_trouble import Trouble, known_trouble
from tcpipe.pipeline.prune import is_replaced
from tcpipe.pipeline.status import failed_for_now
from tcpipe.pipeline.store_verdict import find_changes, judge_runs
from tcpipe.report.store_runs import FailedLog, StoredDataset, StoreFacts, ruling_key
from tcpipe.store import Store


def store_facts(store: Store, found: Ingestions, *, will_be: Sequence[RunDirectory] = ()) -> StoreFacts:
    """Return what is known of all of a store; of the runs ``will_be`` the pages are about to be written."""
    here = (entry.name.split("/") for entry in store.runs_place.entries("", but="streams"))
    pages = {(parts[0], parts[1]) for parts in here if len(parts) == 3 and parts[2] == REPORT}
    trouble = known_trouble(store, [run.facts for run in found.finished])
    accepted = {of.run_id for of in trouble if of.kind != "failed" and of.run_id and of.is_accepted(store)}
    key = ruling_key(found)
    current = [run.facts for run in found.finished if run.facts.ingest_key == key]
    return StoreFacts(
        where=str(store.root),
        found=found,
        accepted=frozenset(accepted),
        pages=frozenset(pages | {(run.run_id, run.recipe_id) for run in will_be}),
        datasets=tuple(_dataset(store, made) for made in store.records("datasets", DatasetMade)),
        verdict=judge_runs(current),
        changes=find_changes(current),
        groups=tuple(group_findings((run.run_id, run.findings) for run in current)),
        failed=tuple(_failed(store, found, trouble)),
    )


def _dataset(store: Store, made: DatasetMade) -> StoredDataset:
    """Return a dataset; its page can be led to where both lie on this machine."""
    there, page = not is_replaced(made), Path(made.out) / REPORT
    near = there and not is_url(made.out) and not is_url(store.root) and page.is_file()
    return StoredDataset(
        made.out, made.runs, there, os.path.relpath(page, Path(store.root).absolute()) if near else None
    )


def _failed(store: Store, found: Ingestions, trouble: Sequence[Trouble]) -> Iterator[FailedLog]:
    """Yield the logs that gave no run, each once: those whose content has given one since are none."""
    made = [row.log.source for row in found.rows.values() if row.log is not None]
    contents, names = {of.sha256 for of in made}, {" + ".join(of.paths) for of in made}
    last = {of.content: of for of in sorted(trouble, key=lambda of: of.version or "") if of.kind == "failed"}
    for of in sorted(last.values(), key=lambda of: of.called):
        if of.content not in contents:
            names.add(of.called)
            state = "accepted" if of.is_accepted(store) else "failed for what it holds"
            yield FailedLog(of.called, "".join(of.lines[:1]), state)
    for name, why in failed_for_now(latest_calls(store)).items():
        if name not in names:
            yield FailedLog(name, why, "failed for now")
