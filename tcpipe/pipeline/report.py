"""Write the HTML page of whatever a path is: a run, a dataset, or a store."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from tcpipe.errors import UsageError
from tcpipe.formats.bucket import open_place
from tcpipe.formats.dataset_files import read_current_card
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.place import DirectoryPlace, Place
from tcpipe.formats.published import here
from tcpipe.formats.seals import sealed_page
from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.report.dataset_report import dataset_report
from tcpipe.report.physics import physics_in_words
from tcpipe.report.run_report import run_report
from tcpipe.store import Store, inside_store, is_store, run_at

_PAGE = "report.html"


@dataclass(frozen=True, slots=True)
class Page:
    """A page, and whether it had to be written."""

    path: str
    changed: bool
    physics: tuple[str, ...] = ()
    """What the page says of the robots' physics, a line a robot."""


def report(path: Path | str) -> list[Page]:
    """Write ``report.html`` into a run's recipe directory or a dataset (also at a URL), or into every run of a store; return the pages.

    One that would be the same is left alone.

    Raises
    ------
    UsageError
        When the path is none of these.

    """
    stored = is_store(path) or inside_store(path) is not None
    if is_url(path) and not stored:
        (page,) = _of_dataset(here(path), None)
        if page.changed:
            open_place(path).put(_PAGE, Path(page.path).read_bytes())
        return [replace(page, path=f"{str(path).rstrip('/')}/{_PAGE}")]
    if not is_url(path) and (Path(path) / "dataset.json").is_file():
        return _of_dataset(Path(path), Path(path).absolute().parent)
    store = Store(path)
    found = (store, store.runs()) if is_store(path) else run_at(path)
    if found is None or not found[1]:
        there = is_url(path) or Path(path).exists()
        what = "is no dataset, run or store with runs" if there else "there is no such directory"
        raise UsageError(f"{path}: {what}; give a dataset, a run of a store, or a store")
    return [_write(run.place, run_report(found[0], run), _physics_of(run)) for run in found[1]]


def _of_dataset(path: Path, beside: Path | None) -> list[Page]:
    fits = read_current_card(path).physics
    said = tuple(physics_in_words(robot, fit) for robot, fit in fits.items())
    return [_write(DirectoryPlace(path), dataset_report(path, beside), said)]


def _physics_of(run: RunDirectory) -> tuple[str, ...]:
    label = run.manifest.info.findings.facts.label
    fit = label.physics.fit if label is not None and label.physics is not None else None
    return () if fit is None else (physics_in_words(run.manifest.robot, fit),)


def _write(place: Place, html: str, physics: tuple[str, ...]) -> Page:
    data = sealed_page(html).encode()
    changed = place.read(_PAGE) != data
    if changed:
        place.put(_PAGE, data)
    return Page(place.where(_PAGE), changed, physics)
