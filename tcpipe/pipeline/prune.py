"""What a store no longer needs: replaced recipes and generations, superseded runs, what killed calls left; nothing of a dataset."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tcpipe import __version__
from tcpipe.errors import DatasetError, StoreError, UsageError, clean_lines
from tcpipe.formats.atomic import TEMPORARY_PREFIX, clear, clear_scratch, is_abandoned
from tcpipe.formats.commits import Dataset, Entries, State
from tcpipe.formats.dataset_files import CARD, REPORT, read_card
from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.place import Entry, Place
from tcpipe.formats.recipe_toml import ingest_key, resolve_recipe
from tcpipe.formats.run_documents import find_highest_numbers, read_sealed_at, split_number
from tcpipe.formats.stored_runs import Ingestions
from tcpipe.pipeline.calls import LogWriter, format_bytes
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store
from tcpipe.tables.levels import STREAMS

_CONTENT = re.compile(r"(?:^|/)[0-9a-f]{16}/")
"""In the name of a file: a directory that is named after its content."""


@dataclass(frozen=True, slots=True)
class Leftover:
    """Something that could go: what it is, where it lies, its size; and why it stays, if it does."""

    what: str
    path: str
    size_bytes: int
    stays: str | None = None

    def __str__(self) -> str:
        """Return it as one line."""
        line = f"{self.what} {self.path}: {format_bytes(self.size_bytes)}"
        return line if self.stays is None else f"{line}; stays: {self.stays}"


@dataclass(frozen=True, slots=True)
class Pruned:
    """What went, or would go, and what stays."""

    store: str
    dry_run: bool
    removed: tuple[Leftover, ...]
    kept: tuple[Leftover, ...]
    size_bytes: int
    """Of what went."""

    def __str__(self) -> str:
        """Return the lines as one text."""
        verb = "would be removed" if self.dry_run else "removed"
        head = f"{self.store}: {len(self.removed)} {verb}, {format_bytes(self.size_bytes)}"
        if not self.removed:
            head = f"{self.store}: nothing to do: there is nothing to remove"
        return clean_lines([head, *(str(each) for each in (*self.removed, *self.kept))])


def prune(
    *,
    store: str | Path = "tcpipe-store",
    recipe: Recipe | str | Path | None = None,
    keep: Sequence[str] = (),
    forget: Sequence[str] = (),
    min_age_s: float = 86_400.0,
    dry_run: bool = False,
) -> Pruned:
    """Remove what a store no longer needs, each thing whole or not at all.

    Raises `StoreError`, `UsageError`, `RecipeError`: there is no store, or something cannot be removed; what went before is gone.

    Of a run that was ingested with the ``recipe`` that rules, what earlier calls made with others is old. Of what ``keep`` names, runs
    and recipes, nothing goes. Datasets that lay at the paths ``forget`` are gone: what they refer to may go. What killed calls left goes
    when it is ``min_age_s`` old; what waits for a dataset, when nothing was put there for so long. With ``dry_run`` nothing is removed.
    """
    ruling = resolve_recipe(recipe)
    opened = open_store(store)
    log = LogWriter(opened, opened.state())
    _forget(log, forget, dry_run=dry_run)
    found = opened.ingestions(state=log.state)
    unknown = set(keep) - {name for key in found.rows for name in key}
    if unknown:
        raise UsageError(f"{opened.root}: no run or recipe is called {min(unknown)}; nothing is removed")
    referred, unread = _find_references(log.state)
    removed, kept, decided = list[Leftover](), list[Leftover](), set[str]()
    for what, place, run_id, parts in _iterate_ingestions(opened, log.state, found, ingest_key(ruling), min_age_s):
        why, size_bytes = unread or _find_reason_to_stay(place, parts, referred, keep), _measure_size(place)
        if why is None and not dry_run and not _remove(log, found, place, run_id, parts):
            why = "another call has changed its run meanwhile"
        (removed if why is None else kept).append(Leftover(what, place.where(), size_bytes, why))
        if why is None or what == BEGUN:
            decided.add(place.where())
    left = [
        Leftover("left by a killed call", str(path), _measure_size(Place(path)))
        for path in _iterate_temporaries(opened, min_age_s)
    ]
    removed += left
    if left and not dry_run:
        clear(Path(opened.root))
    for what, place, entries, why in (*_iterate_replaced(opened, log.state, min_age_s, unread, decided),):
        (removed if why is None else kept).extend(
            Leftover(what, place.where(entry.name), entry.size_bytes, why) for entry in entries
        )
        for entry in entries if why is None and not dry_run else ():
            place.delete(entry.name)
    if not dry_run:
        clear_scratch()
        _remove_empty(opened, min_age_s)
    if removed and not dry_run:
        opened.write_index(log.state)
    return Pruned(str(opened.root), dry_run, tuple(removed), tuple(kept), sum(each.size_bytes for each in removed))


BEGUN = "left by a killed prune"

_Target = tuple[str, str, str]
"""What something is, its run, and its recipe: "" where all of the run is to go."""


def _iterate_ingestions(
    store: Store, state: State, found: Ingestions, key: str, min_age_s: float
) -> Iterator[tuple[str, Place, str, list[tuple[str, str]]]]:
    """Yield what may go of runs that the log knows: what it is, where it lies, its run, and the ingestions in it."""
    superseded = list(_iterate_superseded(store, found))
    begun = _iterate_begun(store, state, min_age_s, except_runs={run_id for _, run_id, _ in superseded})
    for what, run_id, recipe_id in (*begun, *_iterate_old_recipes(found, key), *superseded):
        if recipe_id:
            yield what, store.runs_place.below(f"{run_id}/{recipe_id}"), run_id, [(run_id, recipe_id)]
        else:
            parts = [part for part in {**found.rows, **state.pruned} if part[0] == run_id]
            yield what, store.runs_place.below(run_id), run_id, parts


def _remove(log: LogWriter, found: Ingestions, place: Place, run_id: str, parts: Sequence[tuple[str, str]]) -> bool:
    """Remove ingestions, unless another call changed their run, or built a dataset of them, since they were ``found``.

    The commit comes first, so that nobody looks for what is about to go; the next prune completes one that is killed after it.
    """
    is_as_found = True

    def make(state: State) -> Entries:
        nonlocal is_as_found
        is_used = any(part in made.runs for made in state.datasets.values() for part in parts)
        is_changed = any(found.rows.get((run_id, row.recipe_id)) != row for row in state.find_rows(run_id))
        is_as_found = not (is_used or is_changed)
        return Entries(removed=tuple(parts) if is_as_found else ())

    log.commit("pruned", make)
    for entry in sorted(place.entries() if is_as_found else (), key=_find_turn):
        place.delete(entry.name)
    return is_as_found


def _find_turn(entry: Entry) -> tuple[bool, bool]:
    """Return when a file goes: pages first, then documents, so that no reader looks for the rest."""
    return entry.name.endswith(".parquet"), split_number(entry.name) is not None


def _iterate_begun(store: Store, state: State, min_age_s: float, *, except_runs: Collection[str]) -> Iterator[_Target]:
    """Yield the ingestions that a prune took from the log and was killed before it had removed their files, if these are old enough.

    Those of ``except_runs`` go with their runs.
    """
    before_ns, modified_ns = time.time_ns() - int(min_age_s * 1e9), dict[tuple[str, str], int]()
    for entry in store.runs_place.entries() if state.pruned else ():
        run_id, recipe_id, *_ = (*entry.name.split("/", 2), "")
        modified_ns[run_id, recipe_id] = max(entry.modified_ns, modified_ns.get((run_id, recipe_id), 0))
    for key in sorted(state.pruned.keys() & modified_ns.keys()):
        if modified_ns[key] < before_ns and key[0] not in except_runs:
            yield BEGUN, *key


def _iterate_old_recipes(found: Ingestions, key: str) -> Iterator[_Target]:
    """Yield the ingestions that are older than one of the same run under the ruling recipe."""
    by_run: dict[str, list[RunFacts]] = {}
    for row in found.rows.values():
        by_run.setdefault(row.run_id, []).append(row)
    for run_id, rows in by_run.items():
        ruling = [row for row in rows if row.ingest_key == key and row.tcpipe_version == __version__]
        if not ruling or run_id in found.superseded:
            continue
        latest = max(row.commit for row in ruling)
        for row in rows:
            if row.ingest_key != key and row.commit < latest:
                yield "old recipe", run_id, row.recipe_id


def _iterate_superseded(store: Store, found: Ingestions) -> Iterator[_Target]:
    """Yield the runs whose place another has taken that is there."""
    there = {run.run_id for run in found.finished}
    for run_id, by in found.superseded.items():
        if by in there and store.runs_place.folders(run_id):
            yield "superseded run", run_id, ""


def _find_reason_to_stay(
    place: Place, parts: Sequence[tuple[str, str]], referred: Mapping[tuple[str, str], str], keep: Sequence[str]
) -> str | None:
    if any(name in keep for part in parts for name in part):
        return "--keep names it"
    if why := next((referred[part] for part in parts if part in referred), None):
        return why
    strange = next(_find_strangers(place), None)
    return None if strange is None else f"{strange} is no file of this store"


def _find_strangers(place: Place) -> Iterator[str]:
    """Yield what no call of tcpipe has written into the directory of a run, or of one of its ingestions."""
    known = (
        {f"{role}.parquet" for role in STREAMS}
        | {f"{name}.parquet" for name in ("track", "segments", "rejections")}
        | {REPORT}
    )
    names = ((entry.name, entry.name.rpartition("/")[2]) for entry in place.entries())
    yield from (place.where(name) for name, last in names if last not in known and not split_number(last))


def _forget(log: LogWriter, names: Sequence[str], *, dry_run: bool) -> None:
    """Commit that datasets are gone; `UsageError` where none lay at a path."""
    paths = {name: {name.rstrip("/"), str(Path(name).absolute())} for name in names}
    gone = {name: [dataset for dataset in log.state.datasets.values() if dataset.out in paths[name]] for name in names}
    if unknown := [name for name in names if not gone[name]]:
        raise UsageError(*(f"{name}: not a dataset of this store; nothing is removed" for name in unknown))
    if not dry_run:
        log.commit("pruned", Entries(forgotten=tuple(dataset for each in gone.values() for dataset in each)))


def _find_references(state: State) -> tuple[dict[tuple[str, str], str], str | None]:
    """Return the ingestions that datasets are made of, and why each stays; and why everything does, where a commit cannot be read."""
    if state.problems:
        return {}, f"{state.problems[0].log[0]} is missing or damaged: it may name what a dataset refers to"
    found = dict[tuple[str, str], str]()
    for made in sorted(state.datasets.values(), key=is_replaced, reverse=True):
        reason = f"dataset {made.out} refers to it"
        if is_replaced(made):
            reason = f"a dataset, formerly at {made.out}, refers to it; if it no longer exists: 'tcpipe prune --forget {made.out}'"
        found.update(dict.fromkeys(made.runs, reason))
    return found, None


def is_replaced(made: Dataset) -> bool:
    """Tell whether another dataset lies where this one was."""
    out = Path(made.out)
    try:
        return (out / CARD).is_file() and read_card(out, proved=False).inputs != made.inputs
    except (DatasetError, StoreError):
        return False


def _iterate_temporaries(store: Store, min_age_s: float) -> Iterator[Path]:
    """Yield what killed calls left on disk, if it is old enough."""
    place = store.place
    for path in sorted(place.path.glob(f"{TEMPORARY_PREFIX}*")) if place.path else ():
        if time.time() - path.stat().st_mtime >= min_age_s and is_abandoned(path):
            yield path


_Unnamed = tuple[str, Place, list[Entry], str | None]
"""Files that no document names: what they are, where they lie, and why they stay, if they do."""


def _iterate_replaced(
    store: Store, state: State, min_age_s: float, unread: str | None, decided: Collection[str]
) -> Iterator[_Unnamed]:
    """Yield, by run and for the maps, documents and files that nothing names any more, if they are old enough.

    Files of one directory go together: its content is put there together. Where a document cannot be read they stay; so do ingestions
    that are whole and that no commit names, since ingesting the log again finds them. What is ``decided`` already is not looked at.
    """
    before_ns = time.time_ns() - int(min_age_s * 1e9)
    by_run: dict[str, list[RunFacts]] = {}
    for row in state.runs.values():
        by_run.setdefault(row.run_id, []).append(row)
    found: dict[str | None, list[Entry]] = {None: store.place.below("maps").entries()}
    for entry in store.runs_place.entries():  # of all runs at once: in a bucket each listing is a request
        run, _, name = entry.name.partition("/")
        folders = run, f"{run}/{name.partition('/')[0]}"
        if not any(store.runs_place.where(folder) in decided for folder in folders):
            found.setdefault(run, []).append(entry._replace(name=name))
    for run_id, entries in found.items():
        place = store.place.below("maps") if run_id is None else store.runs_place.below(run_id)
        rows = by_run.get(run_id or "", [])
        try:
            named = set(_iterate_named(place, {entry.name: entry.size_bytes for entry in entries}, rows))
            why = unread
        except StoreError as error:
            named, why = set(), error.problems[0]
        stems = (
            [stem.partition("/") for stem in find_highest_numbers(entry.name for entry in entries)] if run_id else []
        )
        for recipe_id in {recipe for recipe, _, kind in stems if kind == "manifest"} - {row.recipe_id for row in rows}:
            left = [entry for entry in entries if entry.name.startswith(f"{recipe_id}/")]
            yield "no commit names it", place, left, "ingest its log again, or remove it"
        young = {_find_folder(entry.name) for entry in entries if entry.modified_ns >= before_ns}
        content = [entry for entry in entries if split_number(entry.name) or _CONTENT.search(entry.name)]
        over = [entry for entry in content if entry.name not in named and _find_folder(entry.name) not in young]
        yield "no document names it", place, over, why


def _iterate_named(place: Place, sizes: Mapping[str, int], rows: Sequence[RunFacts]) -> Iterator[str]:
    """Yield the files that the log names, those that their documents name, and the same of what no commit names but the last document."""
    last, committed = find_highest_numbers(sizes), {name: size for row in rows for name, size in row.files.items()}
    recipes = {row.recipe_id for row in rows}
    for name, size in sizes.items():
        document = split_number(name)
        if document is None:
            continue
        stem, number = document
        is_last = number == last[stem]
        if committed.get(name) == size and stem.endswith("/manifest"):  # the log names its tables too
            yield name
        elif name in committed or (is_last and (not rows or name.partition("/")[0] not in recipes)):
            yield from (name, *_iterate_named_by(place, name))
    yield from committed


def _iterate_named_by(place: Place, name: str) -> Iterator[str]:
    """Yield the files that a document names; `StoreError` where it is not as it was written."""
    found, folder = read_sealed_at(place, name), name.rpartition("/")[0]
    for key in ("checksums", "streams"):
        listed = found.get(key)
        yield from (f"{folder}/{file}" if folder else file for file in (listed if isinstance(listed, Mapping) else ()))


def _find_folder(name: str) -> str:
    """Return the directory of content in which a file lies; a document is one for itself."""
    found = _CONTENT.search(name)
    return name[: found.end()] if found else name


def _remove_empty(store: Store, min_age_s: float) -> None:
    """Remove the directories, on disk, that a prune left empty which was killed between the last file and its directory."""
    runs = store.runs_place.path
    for above, _, files in os.walk(runs, topdown=False) if runs else ():
        with suppress(OSError):  # it is not empty, or gone
            if not files and Path(above) != runs and time.time() - Path(above).stat().st_mtime >= min_age_s:
                Path(above).rmdir()


def _measure_size(place: Place) -> int:
    return sum(entry.size_bytes for entry in place.entries())
