"""What a store no longer needs: replaced recipes, superseded runs, what killed calls left; never what a dataset refers to."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tcpipe import __version__
from tcpipe.errors import DatasetError, StoreError, UsageError, plain_lines
from tcpipe.formats.atomic import TEMPORARY_PREFIX, clear, is_abandoned, remove_directory
from tcpipe.formats.dataset_files import CARD, read_card
from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.recipe_toml import find_recipe, ingest_key, load_recipe
from tcpipe.formats.record_files import DatasetMade
from tcpipe.pipeline.calls import in_bytes
from tcpipe.pipeline.verify_store import strangers_in
from tcpipe.recipe import Recipe
from tcpipe.store import Ingestions, Store, open_store


@dataclass(frozen=True, slots=True)
class Leftover:
    """Something that could go: what it is, where it lies, its size; and why it stays, if it does."""

    what: str
    path: Path
    size_bytes: int
    stays: str | None = None

    def __str__(self) -> str:
        """Return it as one line."""
        line = f"{self.what} {self.path}: {in_bytes(self.size_bytes)}"
        return line if self.stays is None else f"{line}; stays: {self.stays}"


@dataclass(frozen=True, slots=True)
class Pruned:
    """What went, or would go, and what stays."""

    store: Path
    dry_run: bool
    removed: tuple[Leftover, ...]
    kept: tuple[Leftover, ...]
    size_bytes: int
    """Of what went."""

    def __str__(self) -> str:
        """Return the lines as one text."""
        verb = "would be removed" if self.dry_run else "removed"
        head = f"{self.store}: {len(self.removed)} {verb}, {in_bytes(self.size_bytes)}"
        if not self.removed:
            head = f"{self.store}: nothing to do: there is nothing to remove"
        return plain_lines([head, *(str(each) for each in (*self.removed, *self.kept))])


def prune(
    *,
    store: str | Path = "tcpipe-store",
    recipe: Recipe | str | Path | None = None,
    keep: Sequence[str] = (),
    min_age_s: float = 86_400.0,
    dry_run: bool = False,
) -> Pruned:
    """Remove what a store no longer needs, each thing whole or not at all.

    Parameters
    ----------
    recipe
        The recipe that rules: of a run that was ingested with it, what earlier calls made with others is old.
    keep
        Runs and recipes, by id, of which nothing goes.
    min_age_s
        What killed calls left is removed when it is so old.
    dry_run
        Say what would go, and remove nothing.

    Raises
    ------
    StoreError, UsageError, RecipeError
        There is no store, or something cannot be removed; what went before is gone.

    """
    ruling = (
        recipe if isinstance(recipe, Recipe) else load_recipe(find_recipe(Path(recipe) if recipe else None, Path.cwd()))
    )
    opened = open_store(store)
    found = opened.ingestions()
    unknown = set(keep) - {name for key in found.rows for name in key}
    if unknown:
        raise UsageError(f"{opened.root}: no run or recipe is called {min(unknown)}; nothing is removed")
    referred = _referred(opened)
    removed, kept = list[Leftover](), list[Leftover]()
    for what, path, parts in (*_old_recipes(opened, found, ingest_key(ruling)), *_superseded(opened, found)):
        why = _why_it_stays(path, parts, referred, keep)
        (removed if why is None else kept).append(Leftover(what, path, _size(path), why))
        if why is None and not dry_run:
            remove_directory(path)
    for path in _temporaries(opened, min_age_s):
        removed.append(Leftover("left by a killed call", path, _size(path)))
        if not dry_run:
            clear(path.parent)
    if removed and not dry_run:
        opened.keep_index(opened.ingestions())
    return Pruned(opened.root, dry_run, tuple(removed), tuple(kept), sum(each.size_bytes for each in removed))


Parts = Sequence[tuple[str, str]]
"""Ingestions: runs and their recipes."""


def _old_recipes(store: Store, found: Ingestions, key: str) -> Iterator[tuple[str, Path, Parts]]:
    """Yield the ingestions that are older than one of the same run under the ruling recipe."""
    by_run: dict[str, list[RunFacts]] = {}
    for row in found.rows.values():
        by_run.setdefault(row.run_id, []).append(row)
    for run_id, rows in by_run.items():
        ruling = [row for row in rows if row.ingest_key == key and row.tcpipe_version == __version__]
        for row in rows if ruling and run_id not in found.superseded else ():
            if row.ingest_key != key and _written_ns(row) < max(map(_written_ns, ruling)):
                yield "old recipe", store.runs_path / run_id / row.recipe_id, [(run_id, row.recipe_id)]


def _superseded(store: Store, found: Ingestions) -> Iterator[tuple[str, Path, Parts]]:
    """Yield the runs whose place another has taken that is there."""
    there = {run.run_id for run in found.finished}
    for run_id, by in found.superseded.items():
        if by in there and (store.runs_path / run_id).is_dir():
            yield "superseded run", store.runs_path / run_id, [key for key in found.rows if key[0] == run_id]


def _why_it_stays(path: Path, parts: Parts, referred: Mapping[tuple[str, str], str], keep: Sequence[str]) -> str | None:
    if any(name in keep for part in parts for name in part):
        return "--keep names it"
    out = next((referred[part] for part in parts if part in referred), None)
    if out is not None:
        return f"dataset {out} refers to it"
    strange = next(strangers_in(path), None)
    return None if strange is None else f"{strange} is no file of this store"


def _referred(store: Store) -> dict[tuple[str, str], str]:
    """Return the ingestions that datasets are made of, and of which; one that lies where it was no more may lie elsewhere."""
    found: dict[tuple[str, str], str] = {}
    for made in store.records("datasets", DatasetMade):
        if not _is_replaced(made):
            found.update(dict.fromkeys(made.runs, made.out))
    return found


def _is_replaced(made: DatasetMade) -> bool:
    """Tell whether another dataset lies where this one was."""
    out = Path(made.out)
    try:
        return (out / CARD).is_file() and read_card(out, proved=False).inputs != made.inputs
    except (DatasetError, StoreError):
        return False


def _temporaries(store: Store, min_age_s: float) -> Iterator[Path]:
    """Yield what killed calls left, if it is old enough."""
    places = (store.root, store.root / "maps", store.runs_path, store.records_path, store.index_path)
    for place in (*places, *(store.runs_path / run_id for run_id in store.run_ids())):
        for path in sorted(place.glob(f"{TEMPORARY_PREFIX}*")):
            if time.time() - path.stat().st_mtime >= min_age_s and is_abandoned(path):
                yield path


def _written_ns(row: RunFacts) -> int:
    """Return when an ingestion's manifest was written [ns since 1970]."""
    return int(row.state.split("-")[1]) if row.state else 0


def _size(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
