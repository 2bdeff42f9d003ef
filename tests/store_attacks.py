"""Calls on one store that are killed, or interrupted by another call, before any of their requests."""

import shutil
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path

import obstore
import pytest
from obstore.store import MemoryStore
from wheel_drives import START_NS, drive_at

from tcpipe.errors import UsageError
from tcpipe.formats import documents, place
from tcpipe.formats.atomic import make_scratch_directory
from tcpipe.formats.documents import BLOBS, State, make_key, parse_name, read_record
from tcpipe.formats.place import Place
from tcpipe.formats.recipe_toml import ingest_key
from tcpipe.formats.runs import Output, Process, Run, RunFacts, StoredMap
from tcpipe.formats.stored_runs import STREAMS
from tcpipe.pipeline import calls, ingest_run, prune
from tcpipe.pipeline.calls import ADD_MAP, BUILD, list_open_calls, record_call
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.plan import IngestTask, make_result
from tcpipe.pipeline.problems import acknowledge
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import LabelConfig, Recipe
from tcpipe.store import Store, open_store

OLD = replace(Recipe(), label=LabelConfig(velocity="fused"))
"""A recipe whose runs have the streams of those under the ruling one, and other labels."""
RULING = Recipe()
_PIDS = count(1)


class Killed(BaseException):
    """Ends a call as SIGKILL does: no handler of errors sees it."""


class Actor:
    """A call in a thread of its own that stops before each of its requests."""

    def __init__(self, world: "World", act: Callable[[], object], pid: int) -> None:
        self.go, self.pid, self.done, self.error = threading.Semaphore(0), pid, False, None
        self.world, self.act = world, act
        threading.Thread(target=self.run, daemon=True).start()

    def run(self) -> None:
        self.go.acquire()
        try:
            self.act()
        except BaseException as error:  # noqa: BLE001  for the test
            self.error = error
        self.done = True
        self.world.alive.discard(self.pid)
        self.world.baton.release()


class World:
    """A place for a store, logs, and the calls of people on it."""

    def __init__(self, root: Path | str, logs: Path) -> None:
        self.root, self.logs = root, logs
        self.memory = MemoryStore()
        self.alive, self.pid = set[int](), next(_PIDS)
        self.left: int | None = None
        """Requests until the call is killed."""
        self.actor: Actor | None = None
        self.baton = threading.Semaphore(0)
        self.requests, self.writes, self.namings = 0, list[int](), list[int]()
        """Requests of the call: their number, those that wrote, and those that wrote a document that names payload."""

    # ---- requests

    def step(self, where: str, *, is_write: bool) -> None:
        """Stop before a request."""
        self.writes += [self.requests] if is_write else []
        self.namings += [self.requests] if is_write and {"runs", "maps"} & {*where.split("/")[:-1]} else []
        self.requests += 1
        if self.actor is not None:
            actor = self.actor
            self.baton.release()
            actor.go.acquire()
        if self.left is not None:
            if self.left == 0:
                self.alive.discard(self.pid)
                raise Killed
            self.left -= 1

    def patch(self, monkeypatch: pytest.MonkeyPatch, *, is_light: bool = True) -> None:
        """Begin each request to the store, on disk or in a bucket in memory, with a `step`."""
        do, put_files = Place._do, Place.put_files

        def do_stepwise(self_: Place, name: str, *args: object, **how: object) -> object:
            if self_.path is not None:
                self.step(name, is_write=how.get("what") == "written")
            return do(self_, name, *args, **how)

        def put_stepwise(self_: Place, prefix: str, directory: Path) -> None:
            if self_.path is not None:
                self.step(prefix, is_write=True)
            put_files(self_, prefix, directory)

        def ask(url: str, request: Callable[[MemoryStore], object], *_: object, **how: object) -> object:
            self.step(url, is_write=how.get("what") == "written")
            return request(self.memory)

        monkeypatch.setattr(Place, "_do", do_stepwise)
        monkeypatch.setattr(Place, "put_files", put_stepwise)
        monkeypatch.setattr(Place, "map", lambda _, function, items: [function(item) for item in items])
        monkeypatch.setattr(place, "ask_store", ask)
        monkeypatch.setattr(calls, "identify_process", self.identify)
        for module in (calls, prune):
            monkeypatch.setattr(module, "is_alive", lambda process: process.pid in self.alive)
        if is_light:
            monkeypatch.setattr(ingest_run, "_ingest", _ingest_lightly)

    def identify(self) -> Process:
        """Return the process of the call that runs."""
        return Process("here", "m", "b", "n", self.actor.pid if self.actor else self.pid, "1")

    def run(self, act: Callable[[], object], *, kill_at: int | None = None) -> bool:
        """Run a call as a process of its own; return whether it was killed, before its request ``kill_at``."""
        documents._DECODED.clear()  # as another process: the number of requests depends on it
        self.pid = next(_PIDS)
        self.alive, self.left = {self.pid}, kill_at
        self.requests, self.writes, self.namings = 0, [], []
        try:
            act()
        except Killed:
            return True
        finally:
            self.alive, self.left = set(), None
        return False

    def interleave(self, acts: list[Callable[[], object]], turns: list[tuple[int, int]]) -> list[BaseException | None]:
        """Run calls side by side: by ``turns`` (call, requests), then each to its end. Return their errors."""
        documents._DECODED.clear()
        actors = [Actor(self, act, next(_PIDS)) for act in acts]
        self.alive = {actor.pid for actor in actors}
        self.requests, self.writes, self.namings = 0, [], []
        for number, most in [*turns, *((number, 10**9) for number in range(len(acts)))]:
            actor = actors[number]
            while most >= 0 and not actor.done:  # it stops before the next one
                self.actor, most = actor, most - 1  # noqa: PLW2901
                actor.go.release()
                assert self.baton.acquire(timeout=120), "calls wait for each other"
        self.actor = None
        return [actor.error for actor in actors]

    # ---- calls

    def ingest(self, *names: str, recipe: Recipe = RULING, **how: object) -> None:
        ingest([self.logs / name for name in names], store=self.root, recipe=recipe, **how)

    def acknowledge(self) -> None:
        acknowledge([str(self.logs / "junk.mcap")], store=self.root)

    def prune(self, *runs: str) -> prune.Pruned:
        return prune.prune(runs, store=self.root, recipe=RULING)

    def add_map(self, text: str) -> None:
        """Put a folder that stands for a map into the store."""
        opened = open_store(self.root, create=True)
        with record_call(opened, ADD_MAP, ["site"], {"content": text}) as call:
            call.begin()
            with opened.new_map("site") as (path, put):
                (path / "height").mkdir(parents=True)
                (path / "zarr.json").write_text(text)
                (path / "height" / "zarr.json").write_text(text)
                put(call.state)

    def build(self, where: str = "/out") -> None:
        """Read all runs that count, and record an output that is made of them."""
        opened = open_store(self.root)
        with record_call(opened, BUILD, [where]) as call:
            runs = opened.runs(call.state)
            for run in runs:
                run.file("segments.parquet")
            names = tuple((run.run_id, run.recipe_id) for run in runs)
            output = Output(where=where, inputs=make_key(names), runs=names)
            if call.state.outputs.get(where) != output:
                opened.put(call.state, "outputs", make_key(where), output)

    # ---- contents

    def name_run(self, stem: str) -> str:
        """Return the name of the run of a log."""
        return next(row.run_id for row in self.scan().list_rows() if row.run_id.startswith(stem))

    def scan(self) -> State:
        documents._DECODED.clear()
        return Store(self.root).scan()

    def save(self) -> dict[str, bytes]:
        """Return all files of the store by name."""
        if isinstance(self.root, Path):
            files = (path for path in self.root.rglob("*") if path.is_file())
            return {path.relative_to(self.root).as_posix(): path.read_bytes() for path in files}
        names = (meta["path"] for batch in self.memory.list() for meta in batch)
        return {name: bytes(obstore.get(self.memory, name).bytes()) for name in names}

    def restore(self, files: dict[str, bytes]) -> None:
        """Replace all files of the store by these."""
        if isinstance(self.root, Path):
            shutil.rmtree(self.root, ignore_errors=True)
            for name, data in files.items():
                (self.root / name).parent.mkdir(parents=True, exist_ok=True)
                (self.root / name).write_bytes(data)
            return
        self.memory = MemoryStore()
        for name, data in files.items():
            self.memory.put(name, data)

    def see(self) -> set[tuple[object, ...]]:
        """Return what a reader sees, after a check that each document there, also a replaced one, has its whole payload."""
        state, opened = self.scan(), Store(self.root)
        assert not state.damaged
        files = {entry.name: entry.size_bytes for entry in opened.place.entries(BLOBS)}
        for kind, cls in (("runs", RunFacts), ("maps", StoredMap)):
            for name in filter(None, (parse_name(kind, file) for file in opened.place.list(kind))):
                record = read_record(opened.place, str(name), cls)
                listed = [(record.blob, record.tables), (record.streams_blob, record.streams)] if kind == "runs" else []
                for blob, checksums in listed or [(record.blob, record.files)]:
                    for file, checksum in checksums.items():
                        assert files.get(f"{BLOBS}/{blob}/{file}") == checksum.size_bytes, f"{name} {file}"
        for run in opened.runs(state):
            for file in run.facts.tables:
                run.file(file)
            run.stream_files()
        for output in state.outputs.values():
            for run_id, recipe_id in output.runs:
                (row,) = [row for row in state.list_rows(run_id) if row.recipe_id == recipe_id]
                assert row.blob, "an output refers to a run that was given up"
        seen = {
            ("run", row.run_id, row.recipe_id) for row in state.runs.values() if row.blob and state.has_payload(row)
        }
        seen |= {("failed", failure.content) for failure in state.failed.values()}
        seen |= {("acknowledged", key) for key in state.acknowledged}
        seen |= {("tag", each.log, *tag) for each in state.facts["tags"].values() for tag in each.tags.items()}
        seen |= {("map", each.name) for each in state.maps.values()}
        return seen | {("output", where) for where in state.outputs}

    def check_end(self, before: dict[str, bytes]) -> None:
        """Check that no call is open but those that were killed ``before``, and that prune leaves what counts and its payload alone."""
        assert all(any(f"calls/{call.key}" in name for name in before) for call in list_open_calls(self.scan()))
        for _ in range(2):
            self.run(self.prune)
        state, seen = self.scan(), self.see()
        named = {row.blob for row in state.runs.values()} | {row.streams_blob for row in state.runs.values()}
        named |= {each.blob for each in state.maps.values()}
        assert state.blobs == named - {""}
        assert all(name.startswith("calls/") for name in state.replaced), "replaced documents stay"
        assert not verify(self.root).problems
        assert self.see() == seen


_MADE: dict[tuple[object, ...], tuple[Run, dict[str, bytes]]] = {}


def _ingest_lightly(task: IngestTask, *, hashed: list[str]) -> object:
    """Do what ingestion does to a store, with files that the first ingestion of the log under the recipe has made."""
    key = task.source.origins, ingest_key(task.recipe)
    if key not in _MADE:
        with pytest.MonkeyPatch.context() as patch, make_scratch_directory() as scratch:
            patch.setattr(Place, "_do", _REAL_DO)
            patch.setattr(Place, "put_files", _REAL_PUT_FILES)
            _REAL_INGEST(replace(task, store=scratch, force=False), hashed=hashed)
            (run,) = Store(scratch).runs()
            files = {path.relative_to(run.folder.path).as_posix(): path for path in run.folder.path.rglob("*.parquet")}
            _MADE[key] = run.manifest, {name: path.read_bytes() for name, path in files.items()}
        hashed.clear()
    run, files = _MADE[key]
    store, sha256 = Store(task.store), run.log.sha256
    state = store.scan()
    hashed.append(sha256)
    known = [row for row in state.runs.values() if row.log.sha256 == sha256]
    made = None if task.force else next((row for row in known if task.is_made_by(row)), None)
    if made is not None and (not made.blob or state.has_payload(made)):
        ingest_run.tag_log(store, state, sha256, task.tags)
        return make_result(task.source, "unchanged", made, sha256, same_as=None)
    twin = next((row for row in known if row.read_key == run.read_key and row.streams_blob in state.blobs), None)
    stored = None if task.force else twin
    with store.place.workshop() as directory:
        for name, data in files.items():
            if stored is None or not name.startswith(f"{STREAMS}/"):
                (directory / name).parent.mkdir(exist_ok=True)
                (directory / name).write_bytes(data)
        run = ingest_run.put_run(store, state, run, directory, stored)
    ingest_run.tag_log(store, state, sha256, task.tags)
    row = next(row for row in state.runs.values() if row.blob == run.blob)
    return make_result(task.source, "done", row, sha256, same_as=None)


_REAL_INGEST, _REAL_DO, _REAL_PUT_FILES = ingest_run._ingest, Place._do, Place.put_files


def write_logs(folder: Path) -> Path:
    """Write the beginning of a recording, the whole of it, another one, and a file of junk."""
    drive_at(folder / "short.mcap", rows=700)
    drive_at(folder / "long.mcap", rows=900)
    drive_at(folder / "other.mcap", seed=1, start_ns=START_NS + 10**13, rows=700)
    (folder / "junk.mcap").write_bytes(b"no log at all" * 99)
    return folder


def expect(errors: list[BaseException | None]) -> None:
    """Check that calls failed only because there was no store yet, or nothing to do in it."""
    for error in errors:
        with suppress(UsageError):
            if error is not None:
                raise error
