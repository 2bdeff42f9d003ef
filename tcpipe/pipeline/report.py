"""Write the HTML page of whatever a path is: a run, a dataset, or a store."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tcpipe.errors import StoreError, UsageError
from tcpipe.formats.bucket import open_place
from tcpipe.formats.bucket_directories import fetch_directory_by_range
from tcpipe.formats.dataset_files import CARD, read_current_card
from tcpipe.formats.integrity import seal_page
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.place import Place
from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.pipeline.store_facts import store_facts
from tcpipe.report.dataset_patches import find_picture_folder, iterate_pictures
from tcpipe.report.dataset_report import render_dataset_report
from tcpipe.report.dataset_samples import MOST_SAMPLES
from tcpipe.report.label_sections import describe_physics
from tcpipe.report.maps import Pictures
from tcpipe.report.run_report import run_report
from tcpipe.report.store_report import store_report
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

    Parameters
    ----------
    path : what the page is of.
    runs : of a store: write the page of every run too.
    patches : of a dataset: write pictures of all patches into a folder beside the page, which shows them.

    Raises
    ------
    UsageError : when the path is none of these.
    StoreError : something cannot be read; of a store all other pages are written.
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
    facts = store_facts(store, found, will_be=found.finished if runs else ())
    page, pages, problems = _write(store.place, store_report(facts), ()), list[Page](), list[str]()
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
    card = read_current_card(directory)
    folder, count = find_picture_folder(card)
    if patches and card.samples > MOST_SAMPLES:
        raise UsageError(
            f"{path}: of more than {MOST_SAMPLES} samples the page shows means, which have no patch; leave --patches out"
        )
    for name, data in iterate_pictures(directory, card) if patches else ():
        place.put(f"{folder}/{name}", data, lasting=False)
    shown = folder if card.samples and len(place.files(folder)) == count else ""
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
    return Page(place.where(_PAGE), changed, physics)
