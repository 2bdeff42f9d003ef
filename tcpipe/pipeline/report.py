"""Write the HTML page of a run, a dataset, or a store."""

import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tcpipe import __version__
from tcpipe.errors import DatasetError, StoreError, UsageError
from tcpipe.formats.atomic import Location
from tcpipe.formats.dataset_files import CARD, read_card, read_intact_card
from tcpipe.formats.documents import BLOBS, State
from tcpipe.formats.integrity import find_broken_seal, seal_page
from tcpipe.formats.json_files import digest
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.place import REPORT, Place, open_place
from tcpipe.formats.published_outputs import fetch_directory_by_range
from tcpipe.formats.recipe_toml import ingest_key, resolve_recipe
from tcpipe.formats.runs import Output, RunFacts, find_problems, make_failure
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.pipeline.plan import list_transient_failures
from tcpipe.pipeline.problems import is_acknowledged
from tcpipe.recipe import Recipe
from tcpipe.report.dataset_report import render_dataset_report
from tcpipe.report.label_sections import describe_physics
from tcpipe.report.maps import StoredMaps, draw_tracks
from tcpipe.report.page import is_made_from
from tcpipe.report.run_report import run_report
from tcpipe.report.store_report import RunKey, StoredDataset, StoreFacts, store_report
from tcpipe.store import Store, find_named_runs, is_path, is_store
from tcpipe.tables.findings import read_catalogue_version

_FEW_RUNS = 10  # the page of a store with fewer runs begins with their tracks and the table


@dataclass(frozen=True, slots=True)
class Page:
    """A page, and whether it had to be written."""

    path: str
    changed: bool
    physics: tuple[str, ...] = ()
    """The physics of the robots on the page, a line for each robot."""


def report(
    path: Location, *, store: Location = "tcpipe-store", recipe: Recipe | Location | None = None, runs: bool = True
) -> list[Page]:
    """Write ``report.html`` into a dataset or a store, local or at a URL, or for a run of the store; return the pages.

    A page is only written if its bytes change, and the page of a run is only rendered if its inputs change.

    Raises `UsageError`: the path is something else; `StoreError`: something cannot be read; all other pages of a store
    are written. The page of a store adds up the runs of the current ``recipe``. With ``runs``, the pages of all runs of a store are
    written, too.
    """
    is_there = is_path(path)
    is_one = is_there and is_store(path)
    if is_there and not is_one and (is_url(path) or (Path(path) / CARD).is_file()):
        return [_report_dataset(path)]
    if is_one:
        return _report_store(Store(path), resolve_recipe(recipe), runs=runs)
    if is_there:
        raise UsageError(f"{path}: is no dataset or store; give one of these, or a run of a store")
    opened = Store(store)
    return _report_runs(find_named_runs(path, store), StoredMaps(opened, opened.scan().maps))


def _report_store(store: Store, ruling: Recipe, *, runs: bool) -> list[Page]:
    """Write the store's page, first, since those of runs link to it; again if a run's page could not be written."""
    state = store.scan()
    counted = store.runs(state) if runs else []
    page = _write_store_page(store, state, ruling, will_be=counted)
    try:
        pages = _report_runs(counted, StoredMaps(store, state.maps))
    except StoreError:
        _write_store_page(store, state, ruling)
        raise
    return [page, *pages]


def _write_store_page(store: Store, state: State, ruling: Recipe, *, will_be: Iterable[StoredRun] = ()) -> Page:
    """Write the page of a store with links to the pages of runs that are there or ``will_be``."""
    pages = {(run.run_id, run.recipe_id): _name_page(run.facts) for run in will_be}
    others = [row for row in state.list_rows() if (row.run_id, row.recipe_id) not in pages and state.has_payload(row)]
    sizes = store.place.map(lambda row: store.place.size(_name_page(row)), others)
    found: dict[RunKey, str] = {
        (row.run_id, row.recipe_id): _name_page(row)
        for row, size in zip(others, sizes, strict=True)
        if size is not None
    }
    runs = store.runs(state)
    content = StoreFacts(
        store,
        state,
        ruling=ingest_key(ruling),
        acknowledged={run.run_id for run in runs if is_acknowledged(find_problems(run.facts), state)},
        pages=pages | found,
        datasets=[_describe_dataset(store, output) for output in state.outputs.values() if output.inputs],
        failed=[*_iterate_failed(state)],
    )
    tracks = draw_tracks(runs, StoredMaps(store, state.maps)) if len(runs) < _FEW_RUNS else None
    return _write(store.place, store_report(content, tracks), ())


def _name_page(row: RunFacts) -> str:
    return f"{BLOBS}/{row.blob}/{REPORT}"


def _report_runs(runs: list[StoredRun], maps: StoredMaps) -> list[Page]:
    """Write the pages of runs of a store; `StoreError` names all unreadable runs after the others were written."""
    if not runs:
        return []
    place, pages, problems = maps.store.place, list[Page](), list[str]()
    inputs = {name: record.blob for name, record in maps.records.items()}, place.size(REPORT) is not None
    keys = [digest([run.document, run.facts.tags, inputs, read_catalogue_version(), __version__]) for run in runs]
    fresh = place.map(lambda item: _find_unchanged_page(*item), list(zip(runs, keys, strict=True)))
    for run, key, page in zip(runs, keys, fresh, strict=True):
        try:
            pages.append(page or _write(run.folder, run_report(run, maps, made_from=key), _describe_physics(run)))
        except StoreError as error:
            problems += error.problems
    if problems:
        raise StoreError(*problems)
    return pages


def _find_unchanged_page(run: StoredRun, made_from: str) -> Page | None:
    """Return the page of a run if it was made from the same inputs and is intact."""
    with suppress(StoreError):
        data, where = run.folder.read(REPORT), run.folder.where(REPORT)
        if data is not None and is_made_from(data, made_from) and find_broken_seal(data, where) is None:
            return Page(where, changed=False, physics=_describe_physics(run))
    return None


def _report_dataset(path: Location) -> Page:
    directory, fetched = fetch_directory_by_range(path, by_range=lambda _: False)
    html = render_dataset_report(directory, None if is_url(path) else directory.absolute().parent)
    place = open_place(path) if fetched is None else fetched.place
    physics = read_intact_card(directory).physics
    return _write(place, html, tuple(describe_physics(robot, fit) for robot, fit in physics.items()))


def _describe_physics(run: StoredRun) -> tuple[str, ...]:
    label = run.manifest.info.report.facts.label
    fit = label.physics.fit if label is not None and label.physics is not None else None
    return () if fit is None else (describe_physics(run.facts.robot, fit),)


def _write(place: Place, html: str, physics: tuple[str, ...]) -> Page:
    data = seal_page(html).encode()
    changed = place.read(REPORT) != data
    if changed:
        place.put(REPORT, data)
    else:  # a killed call may have left a temporary
        place.clear()
    return Page(place.where(REPORT), changed, physics)


def _describe_dataset(store: Store, output: Output) -> StoredDataset:
    """Return a dataset; the page of the store links to its page if both are on this machine."""
    is_there, page = not _is_replaced(output), Path(output.where) / REPORT
    is_near = is_there and not is_url(output.where) and not is_url(store.root) and page.is_file()
    link = os.path.relpath(page, Path(store.root).absolute()) if is_near else None
    return StoredDataset(output.where, output.runs, is_there, link)


def _is_replaced(output: Output) -> bool:
    """Return whether another dataset is in this directory now."""
    out = Path(output.where)
    try:
        return (out / CARD).is_file() and read_card(out, proved=False).inputs != output.inputs
    except (DatasetError, StoreError):
        return False


def _iterate_failed(state: State) -> Iterator[tuple[str, str, str]]:
    """Yield name, state and reason of each log that failed and whose content has given no run since."""
    made = [row.log for row in state.runs.values()]
    contents, names = {log.sha256 for log in made}, {" + ".join(log.paths) for log in made}
    last = {failure.content: failure for failure in sorted(state.failed.values(), key=lambda failure: failure.version)}
    for failure in sorted(last.values(), key=lambda failure: failure.log):
        if failure.content not in contents:
            names.add(name := " + ".join(failure.log))
            is_known = is_acknowledged([make_failure(failure.content, failure.log)], state)
            yield name, "acknowledged" if is_known else "failed permanently", "".join(failure.problems[:1])
    for name, why in list_transient_failures([call for _, call in state.calls]).items():
        if name not in names:
            yield name, "failed temporarily", why
