"""Write the HTML page of a run, a dataset, or a store."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tcpipe import __version__
from tcpipe.errors import StoreError, UsageError
from tcpipe.formats.bucket_directories import fetch_directory_by_range
from tcpipe.formats.dataset_files import CARD, REPORT, read_intact_card
from tcpipe.formats.documents import BLOBS, State
from tcpipe.formats.integrity import find_broken_seal, seal_page
from tcpipe.formats.json_files import digest
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.place import Place, open_place
from tcpipe.formats.recipe_toml import resolve_recipe
from tcpipe.formats.runs import RunFacts
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.pipeline.named_runs import find_named_runs, is_path
from tcpipe.pipeline.store_facts import make_store_facts
from tcpipe.recipe import Recipe
from tcpipe.report.dataset_patches import find_picture_folder, iterate_pictures
from tcpipe.report.dataset_report import render_dataset_report
from tcpipe.report.label_sections import describe_physics
from tcpipe.report.maps import StoredMaps
from tcpipe.report.page import is_made_from
from tcpipe.report.run_report import run_report
from tcpipe.report.store_report import RunKey, store_report
from tcpipe.store import Store, is_store
from tcpipe.tables.findings import read_catalogue_version


@dataclass(frozen=True, slots=True)
class Page:
    """A page, and whether it had to be written."""

    path: str
    changed: bool
    physics: tuple[str, ...] = ()
    """The physics of the robots on the page, a line for each robot."""


def report(
    path: Path | str,
    *,
    store: Path | str = "tcpipe-store",
    recipe: Recipe | Path | str | None = None,
    runs: bool = True,
    patches: bool = False,
) -> list[Page]:
    """Write ``report.html`` into a dataset or a store, here or at a URL, or beside the tables of a run of the store; return the pages.

    A page whose bytes would be the same is not written, and that of a run whose inputs are the same is not rendered.

    Raises `UsageError`: the path is none of these; `StoreError`: something cannot be read; all other pages of a store are written.

    ``recipe`` is the current one: the page of a store sums over its runs. ``runs``: of a store, write the page of every run too.
    ``patches``: of a dataset, write pictures of all patches beside the page.
    """
    is_there = is_path(path)
    is_one = is_there and is_store(path)
    if is_there and not is_one and (is_url(path) or (Path(path) / CARD).is_file()):
        return [_report_dataset(path, patches=patches)]
    if patches:
        raise UsageError(f"{path}: is no dataset; --patches is for one")
    if is_one:
        return _report_store(Store(path), resolve_recipe(recipe), runs=runs)
    if is_there:
        raise UsageError(f"{path}: is no dataset or store; give one of these, or a run of a store")
    opened = Store(store)
    named = find_named_runs(path, store)
    return _report_runs(named, StoredMaps(opened, opened.scan().maps))


def _report_store(store: Store, ruling: Recipe, *, runs: bool) -> list[Page]:
    """Write the store's page, first, as those of the runs link to it, and again if pages of runs could not be written."""
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
    return _write(store.place, store_report(make_store_facts(store, state, ruling, pages | found)), ())


def _name_page(row: RunFacts) -> str:
    return f"{BLOBS}/{row.blob}/{REPORT}"


def _report_runs(runs: list[StoredRun], maps: StoredMaps) -> list[Page]:
    """Write the pages of runs of one store; `StoreError` names all that cannot be read, after the others were written."""
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


def _report_dataset(path: Path | str, *, patches: bool) -> Page:
    """Write a dataset's page, and, before it, pictures of all patches, which it shows from then on."""
    directory, fetched = fetch_directory_by_range(path, by_range=lambda _: False)
    place = open_place(path) if fetched is None else fetched.place
    card = read_intact_card(directory)
    if patches and not card.layers:
        raise UsageError(f"{path}: has no patches to draw; remove --patches")
    folder, count = find_picture_folder(card)
    for name, data in iterate_pictures(directory, card) if patches else ():
        place.put(f"{folder}/{name}", data)
    shown = folder if card.samples and len(place.list(folder)) == count else ""
    html = render_dataset_report(directory, None if is_url(path) else directory.absolute().parent, folder=shown)
    return _write(place, html, tuple(describe_physics(robot, fit) for robot, fit in card.physics.items()))


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
