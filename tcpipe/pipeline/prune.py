"""Removal of replaced documents, given-up runs and unnamed payload from a store; datasets are not changed.

Removal is safe while other calls start (ADR-36): it removes only documents that were replaced at a first scan, and only
payload that was listed before a second scan and that no document of that scan names. It removes nothing while another
call may be running.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field

from tcpipe.errors import StoreError, TcpipeError, UsageError, clean_lines
from tcpipe.formats.atomic import TEMPORARY_PREFIX, Location, is_abandoned
from tcpipe.formats.dataset_files import CARD, parse_card
from tcpipe.formats.documents import State, make_key, make_run_key, read_record
from tcpipe.formats.object_storage import make_absolute
from tcpipe.formats.place import FileEntry
from tcpipe.formats.published_outputs import find_newest
from tcpipe.formats.recipe_toml import ingest_key, resolve_recipe
from tcpipe.formats.runs import Run, RunFacts
from tcpipe.formats.stored_runs import find_unnamed, list_named_files, list_payload, read_records
from tcpipe.pipeline.calls import PRUNE, format_bytes, is_alive, list_open_calls, record_call
from tcpipe.pipeline.problems import forget_tables
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store

_MAX_CALLS = 50  # ended calls of each command that are kept


@dataclass(frozen=True, slots=True)
class Leftover:
    """A candidate for removal: kind, name and size; and the reason if it is kept."""

    what: str
    name: str
    size_bytes: int = 0
    stays: str | None = None

    def __str__(self) -> str:
        """Return it as one line."""
        line = f"{self.what} {self.name}: {format_bytes(self.size_bytes)}"
        return line if self.stays is None else f"{line}; stays: {self.stays}"


@dataclass(frozen=True, slots=True)
class Pruned:
    """Removed and kept items of a call, or of its dry run."""

    store: str
    dry_run: bool
    removed: tuple[Leftover, ...]
    kept: tuple[Leftover, ...]
    documents: int
    """Documents that went: replaced ones, and calls before the latest."""
    size_bytes: int
    """Size of the removed payload [byte]."""
    waits_for: str | None = None
    """A call that may still run, so that nothing was removed."""

    def __str__(self) -> str:
        """Return the lines as one text."""
        if self.waits_for is not None:
            return clean_lines([f"{self.store}: nothing is removed: {self.waits_for}"])
        verb = "would be removed" if self.dry_run else "removed"
        counts = [(len(self.removed), "item"), (self.documents, "replaced document")]
        what = " and ".join(f"{count} {name}{'s' * (count != 1)}" for count, name in counts if count)
        head = f"{self.store}: {what} {verb}, {format_bytes(self.size_bytes)}"
        if not (self.removed or self.documents):
            head = f"{self.store}: nothing to do: there is nothing to remove"
        return clean_lines([head, *map(str, (*self.removed, *self.kept))])


def prune(
    runs: Sequence[str] = (),
    *,
    store: Location = "tcpipe-store",
    recipe: Recipe | Location | None = None,
    forget: Sequence[str] = (),
    dry_run: bool = False,
) -> Pruned:
    """Remove the parts of a store that are no longer needed.

    Raises `StoreError`, `UsageError`, `RecipeError`: there is no store, it cannot be written to, or a name is unknown.

    Without ``runs`` (RUN or RUN/RECIPE), superseded runs are removed, and those under an old recipe whose log also has
    a run under the current ``recipe``. Runs of a dataset are kept, unless another dataset is at its place or ``forget``
    names it. With ``dry_run`` nothing changes.
    """
    ruling, opened = ingest_key(resolve_recipe(recipe)), open_store(store)
    forgotten, temporaries = [make_absolute(name) for name in forget], _find_temporaries(opened)
    with nullcontext() if dry_run else record_call(opened, PRUNE, runs, {"forget": forgotten}) as call:
        first, mine = (opened.scan(), "") if call is None else (call.state, call.key)
        if unknown := [name for name in forgotten if name not in first.outputs]:
            raise UsageError(*(f"{name}: is no output of this store; nothing is removed" for name in unknown))
        chosen = _choose_named(opened, first, runs) if runs else _choose_replaced(first, ruling)
        processes = {each.key: each.call.process for each in list_open_calls(first)}
        dead = {key for key, process in processes.items() if process is not None and is_alive(process) is False}
        removal = _Removal(opened, first, dry_run, forgotten)
        if (waits_for := _find_running(first, dead, mine)) is None:
            removal.give_up(chosen)
            payload = list_payload(opened.place)
            second = opened.scan()
            waits_for = _find_running(second, dead, mine)
            removal.take_back(second, is_all=waits_for is not None)
            if waits_for is None:
                removal.choose_documents(second)
                removal.choose_payload(second, payload)
                removal.removed += temporaries
                removal.execute()
        found = removal.describe(waits_for)
        if call is not None:
            call.result = {"counts": {"removed": len(found.removed), "documents": found.documents}}
    return found


def _find_running(state: State, dead: Collection[str], mine: str) -> str | None:
    """Return a line about the first call that may still run, other than this one."""
    for call in list_open_calls(state):
        if call.key not in dead and call.key != mine:
            if call.state == "running":
                return f"{call} is running; run 'tcpipe prune' again after its end"
            return f"{call} may still run; if it does not: 'tcpipe acknowledge {call.name}'"
    return None


_Chosen = dict[str, tuple[RunFacts, str]]  # by key: a run whose tables are removed, and the reason


def _choose_named(store: Store, state: State, names: Sequence[str]) -> _Chosen:
    """Return the runs called RUN or RUN/RECIPE; `UsageError` if one does not exist."""
    parts = {name: name.partition("/")[::2] for name in names}
    rows = {
        name: [row for row in state.list_rows(run_id) if recipe_id in ("", row.recipe_id)]
        for name, (run_id, recipe_id) in parts.items()
    }
    if unknown := [name for name in names if not rows[name]]:
        raise UsageError(*(f"{name}: no run of {store.root} has this name; nothing is removed" for name in unknown))
    return {_make_key(row): (row, "run") for each in rows.values() for row in each if row.blob}


def _choose_replaced(state: State, ruling: str) -> _Chosen:
    """Return the runs that another supersedes, and those under an old recipe; the other run has its tables."""
    rows_with_payload = [row for row in state.list_rows() if row.blob and state.has_payload(row)]
    names = {(row.run_id, row.ingest_key) for row in rows_with_payload}
    logs = {row.log.sha256 for row in rows_with_payload if row.ingest_key == ruling}
    chosen: _Chosen = {}
    for row in state.list_rows():
        if row.blob and (row.superseded_by, row.ingest_key) in names:
            chosen[_make_key(row)] = row, "superseded run"
        elif row.blob and row.ingest_key != ruling and row.log.sha256 in logs:
            chosen[_make_key(row)] = row, "old recipe"
    return chosen


def _make_key(row: RunFacts) -> str:
    return make_run_key(row.log.sha256, row.recipe_id)


def _find_references(state: State, forgotten: Collection[str]) -> dict[tuple[str, str], str]:
    """Return the runs and recipes from which outputs are made, each with the reason to keep it."""
    references = dict[tuple[str, str], str]()
    for output in state.outputs.values():
        inputs = None if output.where in forgotten or not output.runs else _read_inputs(output.where)
        if output.where not in forgotten and inputs in (None, output.inputs):
            hint = f"; if it no longer exists: 'tcpipe prune --forget {output.where}'" if inputs is None else ""
            references |= dict.fromkeys(output.runs, f"dataset {output.where} refers to it{hint}")
    return references


def _read_inputs(where: str) -> str | None:
    """Return the digest of the inputs of a dataset at a path or URL; None without a readable dataset."""
    try:
        found = find_newest(where, [CARD])
        return None if found is None else parse_card(found.data, found.place.where(CARD), proved=False).inputs
    except TcpipeError:
        return None


@dataclass(slots=True)
class _Removal:
    """Items that one call removes, decided step by step, then removed."""

    store: Store
    first: State
    dry_run: bool
    forgotten: list[str]
    chosen: _Chosen = field(default_factory=dict)
    """Runs that are given up."""
    earlier: dict[str, str] = field(default_factory=dict)
    """By key: the documents that named their tables."""
    documents: list[list[str]] = field(default_factory=list)
    """Groups in order of removal: after a kill between them no replaced document becomes valid again."""
    payload: list[str] = field(default_factory=list)
    """Folders, and files of folders in use."""
    removed: list[Leftover] = field(default_factory=list)
    kept: list[Leftover] = field(default_factory=list)

    def give_up(self, chosen: _Chosen) -> None:
        """Record that runs have no tables, except runs to which an output refers."""
        references = _find_references(self.first, self.forgotten) if chosen else {}
        for key, (row, what) in chosen.items():
            if reason := references.get((row.run_id, row.recipe_id)):
                self.kept.append(_describe(row, what, reason))
                continue
            document = self.first.names["runs", key]
            try:
                if not self.dry_run:
                    forget_tables(self.store, self.first, row)
            except StoreError as error:
                self.kept.append(_describe(row, what, error.problems[0]))
                continue
            self.chosen[key], self.earlier[key] = (row, what), document

    def take_back(self, second: State, *, is_all: bool) -> None:
        """Restore runs if a new output refers to them, or if nothing can be removed now."""
        self.forgotten = [name for name in self.forgotten if self.first.outputs[name] == second.outputs.get(name)]
        references = _find_references(second, self.forgotten) if self.chosen else {}
        for key, (row, what) in [*self.chosen.items()]:
            reason = references.get((row.run_id, row.recipe_id))
            if is_all or reason is not None:
                del self.chosen[key]
                self.kept += [_describe(row, what, reason)] if reason else []
                document = self.earlier.pop(key)
                if not self.dry_run:
                    self.store.put_run(second, read_record(self.store.place, document, Run))

    def choose_documents(self, second: State) -> None:
        """Choose the documents that did not count in the first scan, then old calls and forgotten outputs."""
        counting = {*second.names.values()} - ({*self.earlier.values()} if self.dry_run else set())
        replaced = dict.fromkeys([*self.first.replaced, *self.earlier.values()])
        self.documents.append([name for name in replaced if name not in counting])
        last = [self.first.names["calls", key] for key in _find_old_calls(self.first)]
        last += [self.first.names["outputs", make_key(where)] for where in self.forgotten]
        self.documents.append([name for name in last if name in counting])

    def choose_payload(self, second: State, payload: Mapping[str, Sequence[FileEntry]]) -> None:
        """Choose the payload that no document names, or only documents that will be removed."""
        going = {name for group in self.documents for name in group}
        records, damaged = read_records(self.store.place, second, going)
        labels = {row.blob: (what, f"{row.run_id}/{row.recipe_id}") for row, what in self.chosen.values()}
        sizes = dict.fromkeys(labels.values(), 0)
        for name, size_bytes, foreign in find_unnamed(payload, list_named_files(records)):
            is_folder = name.count("/") == 1
            if foreign and not is_folder:
                continue
            label = labels.get(name.split("/")[1], ("payload that no document names", self.store.place.where(name)))
            reason = f"it contains {foreign}, which tcpipe did not write" if foreign else None
            reason = f"{damaged[0]} is damaged and may name it; 'tcpipe verify' lists repairs" if damaged else reason
            if reason is None:
                self.payload.append(name)
                sizes[label] = sizes.get(label, 0) + size_bytes
            else:
                self.kept.append(Leftover("payload", self.store.place.where(name), size_bytes, reason))
        self.removed += [Leftover(*label, size_bytes) for label, size_bytes in sizes.items()]

    def execute(self) -> None:
        """Remove the chosen parts, and temporaries of killed calls."""
        if not self.dry_run:
            place = self.store.place
            for names in (*self.documents, self.payload):
                place.map(place.delete, names)
            place.clear()

    def describe(self, waits_for: str | None) -> Pruned:
        """Return the removed parts, or those that would be removed."""
        size_bytes, documents = sum(each.size_bytes for each in self.removed), sum(map(len, self.documents))
        items = tuple(self.removed), tuple(self.kept), documents, size_bytes
        return Pruned(str(self.store.root), self.dry_run, *items, waits_for)


def _find_temporaries(store: Store) -> list[Leftover]:
    """Return the temporaries of killed calls, which the next writing call removes."""
    paths = sorted(store.place.path.glob(f"{TEMPORARY_PREFIX}*")) if store.place.path else []
    sizes = {
        path: sum(each.stat().st_size for each in path.rglob("*") if each.is_file())
        for path in paths
        if is_abandoned(path)
    }
    return [Leftover("left by a killed call", str(path), size_bytes) for path, size_bytes in sizes.items()]


def _describe(row: RunFacts, what: str, why: str) -> Leftover:
    size_bytes = sum(checksum.size_bytes for checksum in row.tables.values())
    return Leftover(what, f"{row.run_id}/{row.recipe_id}", size_bytes, why)


def _find_old_calls(state: State) -> Iterator[str]:
    """Yield the keys of ended calls before the latest ones of each command."""
    count = Counter[str]()
    for key, call in state.calls:
        if call.exit_code is not None:
            count[call.command] += 1
            if count[call.command] > _MAX_CALLS:
                yield key
