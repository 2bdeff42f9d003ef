"""Write the HTML page of whatever a path is: a run, a dataset, or a store."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tcpipe.errors import StoreError, UsageError
from tcpipe.formats.bucket_directories import fetch_directory_by_range
from tcpipe.formats.commits import Dataset, State
from tcpipe.formats.dataset_files import CARD, REPORT, read_intact_card
from tcpipe.formats.finding_lines import group_findings
from tcpipe.formats.integrity import seal_page
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.place import Place, open_place
from tcpipe.formats.stored_runs import Ingestions, RunDirectory, make_file_finder
from tcpipe.pipeline.plan import list_transient_failures
from tcpipe.pipeline.problems import find_problems, is_acknowledged, make_failure
from tcpipe.pipeline.prune import is_replaced
from tcpipe.pipeline.status import find_changes, judge_runs
from tcpipe.report.dataset_patches import find_picture_folder, iterate_pictures
from tcpipe.report.dataset_report import render_dataset_report
from tcpipe.report.label_sections import describe_physics
from tcpipe.report.maps import Pictures
from tcpipe.report.run_report import run_report
from tcpipe.report.store_report import FailedLog, StoredDataset, StoreFacts, find_recipe_key, store_report
from tcpipe.store import Store, find_store_above, is_store, run_at

_PAGE = "report.html"


@dataclass(frozen=True, slots=True)
class Page:
    """A page, and whether it had to be written."""

    path: str
    changed: bool
    physics: tuple[str, ...] = ()
    """What the page says of the robots' physics, a line a robot."""


def report(path: Path | str, *, runs: bool = True, patches: bool = False) -> list[Page]:
    """Write ``report.html`` into a run's recipe directory, a dataset or a store, here or at a URL; return the pages.

    One that would be the same is left alone.

    Raises `UsageError`: the path is none of these; `StoreError`: something cannot be read; of a store all other pages are written.

    ``runs``: of a store, write the page of every run too. ``patches``: of a dataset, write pictures of all patches beside the page.
    """
    inside = is_store(path) or find_store_above(path) is not None
    if not inside and (is_url(path) or (Path(path) / CARD).is_file()):
        return [_report_dataset(path, patches=patches)]
    if patches:
        raise UsageError(f"{path}: is no dataset; --patches is for one")
    if is_store(path):
        return _report_store(Store(path), runs=runs)
    found = run_at(path)
    if found is None:
        there = is_url(path) or Path(path).exists()
        what = "is no dataset, run or store" if there else "there is no such directory"
        raise UsageError(f"{path}: {what}; give a dataset, a run of a store, or a store")
    pictures_by_map: dict[str, Pictures] = {}
    return [_report_run(found[0], run, pictures_by_map) for run in found[1]]


def _report_store(store: Store, *, runs: bool) -> list[Page]:
    """Write the store's page, first, as those of the runs lead to it, and again without the runs that cannot be read."""
    found = store.ingestions()
    page = _write(store.place, store_report(store_facts(store, found, will_be=found.finished if runs else ())), ())
    pages, problems = list[Page](), list[str]()
    pictures_by_map: dict[str, Pictures] = {}
    for run in found.finished if runs else ():
        try:
            pages.append(_report_run(store, run, pictures_by_map))
        except StoreError as error:
            problems += error.problems
    if problems:
        _write(store.place, store_report(store_facts(store, found)), ())
        raise StoreError(*problems)
    return [page, *pages]


def _report_run(store: Store, run: RunDirectory, pictures_by_map: dict[str, Pictures]) -> Page:
    return _write(run.place, run_report(store, run, pictures_by_map), _describe_physics(run))


def _report_dataset(path: Path | str, *, patches: bool) -> Page:
    """Write a dataset's page, and, before it, pictures of all patches, which it shows from then on."""
    directory, fetched = fetch_directory_by_range(path, by_range=lambda _: False)
    place = open_place(path) if fetched is None else fetched.place
    card = read_intact_card(directory)
    folder, count = find_picture_folder(card)
    for name, data in iterate_pictures(directory, card) if patches else ():
        place.put(f"{folder}/{name}", data)
    shown = folder if card.samples and len(place.list(folder)) == count else ""
    html = render_dataset_report(directory, None if is_url(path) else directory.absolute().parent, folder=shown)
    return _write(place, html, tuple(describe_physics(robot, fit) for robot, fit in card.physics.items()))


def _describe_physics(run: RunDirectory) -> tuple[str, ...]:
    label = run.manifest.info.report.facts.label
    fit = label.physics.fit if label is not None and label.physics is not None else None
    return () if fit is None else (describe_physics(run.manifest.robot, fit),)


def _write(place: Place, html: str, physics: tuple[str, ...]) -> Page:
    data = seal_page(html).encode()
    changed = place.read(_PAGE) != data
    if changed:
        place.put(_PAGE, data)
    else:  # a killed call may have left a temporary
        place.clear()
    return Page(place.where(_PAGE), changed, physics)


def store_facts(store: Store, found: Ingestions, *, will_be: Sequence[RunDirectory] = ()) -> StoreFacts:
    """Return what is known of all of a store; of the runs ``will_be`` the pages are about to be written."""
    state, find = found.state, make_file_finder(store.runs_place, found.rows.values())
    pages = {key for key in found.rows if find(f"{key[0]}/{key[1]}/{REPORT}")}
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
    contents, names = {log.sha256 for log in made}, {" + ".join(log.paths) for log in made}
    last = {failure.content: failure for failure in sorted(state.failed.values(), key=lambda failure: failure.version)}
    for failure in sorted(last.values(), key=lambda failure: failure.log):
        if failure.content not in contents:
            names.add(name := " + ".join(failure.log))
            acknowledged = is_acknowledged([make_failure(failure.content, failure.log)], state)
            yield FailedLog(
                name, "".join(failure.problems[:1]), "acknowledged" if acknowledged else "failed for what it holds"
            )
    for name, why in list_transient_failures(state.calls).items():
        if name not in names:
            yield FailedLog(name, why, "failed for now")
