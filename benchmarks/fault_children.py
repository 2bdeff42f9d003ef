"""One call in a forked child, broken at a chosen step or moment, and what it left on disk.

A step is a moment at which Python is about to change the disk: it opens a file to write (or a directory, to lock or
sync it), makes, renames or removes something. An audit hook counts them, so every state that a kill can leave between
two of them is met once. Of a call that writes to a bucket a step is the moment before, and the one after, each request
that changes something there; of one whose workers are killed, of each such request of theirs (`fault_workers`).
"""

import atexit
import errno
import hashlib
import mmap
import os
import pickle
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import IO, TypeVar

import fault_workers

from tcpipe.formats.dataset_files import REPORT
from tcpipe.formats.documents import BLOBS, scan
from tcpipe.formats.json_files import to_compact_json
from tcpipe.formats.place import Place, open_place
from tcpipe.formats.published_outputs import CARDS, find_newest
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.store import Store

T = TypeVar("T")

INPUTS = "in"
"""Directory of a workplace that no call changes."""

LONGEST_S, LATEST_S = 600.0, 5.0
"""A call that takes longer hangs; one that is asked to end ends as fast."""

STORES = ("tcpipe-store", "store")
"""Places that `see_store` reads as a user would: the outputs of calls, and a copy of the input store."""

WHOLE = (
    "dataset*", "site", "model", "costs", *(f"{store}/{kind}/*" for store in STORES for kind in ("runs", "maps"))
)  # fmt: skip
"""Units that appear and change as a whole: directories, and runs and maps of a store."""

UNFINISHED = (
    ".tmp-*",
    "*/.tmp-*",
    ".*.partial",
    "*.checkpoint",
    "tmp/tcpipe-*",
)
"""Files that a killed call may leave for the next one: temporary files, and the progress of a cost map or a training."""

_REQUEST = "fault.request"
_CHANGES = {"os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate"}


@dataclass(frozen=True)
class Fault:
    """Fault during a call: a signal, or a full disk (0), at a step (from 1) or after a time [s]; or limited disk space.

    A ``victim`` is not a call but a service that the call uses: see `fault_services`.
    """

    signal: int
    step: int = 0
    after_s: float = 0.0
    room_bytes: int = 0
    victim: str = ""

    def __str__(self) -> str:
        if self.victim:
            return f"{self.victim} after {self.after_s:.3f} s"
        if self.room_bytes:
            return f"room for {self.room_bytes} bytes"
        what = signal.Signals(self.signal).name if self.signal else "disk full"
        return f"{what} at step {self.step}" if self.step else f"{what} after {self.after_s:.3f} s"


@dataclass(frozen=True)
class Ended:
    """End of a call; ``code`` is the exit status of a shell (137 for SIGKILL), ``late_s`` the time from the fault to the end [s]."""

    code: int
    said: str
    steps: int
    seconds: float
    late_s: float
    left_running: bool


def call(
    run: Callable[[], object],
    work: Path,
    fault: Fault | None = None,
    *,
    steps_in: str = "disk",
    strike: Callable[[str], None] | None = None,
) -> Ended:
    """Run something in ``work`` in a forked child. Import what it needs before: children share it."""
    begun = start(run, work, fault, steps_in=steps_in)
    struck = None
    if fault and fault.after_s:
        time.sleep(fault.after_s)
        if strike and fault.victim:
            strike(fault.victim)
        else:
            os.kill(begun.child, fault.signal)
        struck = time.monotonic()
    return finish(begun, struck)


def calls_together(runs: Sequence[Callable[[], object]], work: Path) -> list[Ended]:
    """Run several things at once."""
    return [finish(each) for each in [start(run, work) for run in runs]]


def in_child(act: Callable[[], T]) -> T:
    """Return what a function gives in a child: this process loads nothing that has threads, which children would lack."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            with os.fdopen(write, "wb") as stream:
                pickle.dump(act(), stream)
            code = 0
        finally:
            os._exit(code)
    os.close(write)
    with os.fdopen(read, "rb") as stream:
        data = stream.read()
    assert os.waitpid(child, 0)[1] == 0
    return pickle.loads(data)  # noqa: S301  our own


@dataclass(frozen=True)
class Begun:
    """A call that runs in a child."""

    child: int
    counted: "memoryview[int]"
    at_s: float
    output: IO[bytes]


def start(run: Callable[[], object], work: Path, fault: Fault | None = None, *, steps_in: str = "disk") -> Begun:
    """Begin a call in a forked child, which `finish` waits for."""
    if steps_in == "workers":
        fault_workers.watch(fault.step if fault else 0)
    counted = memoryview(mmap.mmap(-1, 8)).cast("q")
    begun_s = time.monotonic()
    output = tempfile.TemporaryFile()  # noqa: SIM115  closed where the child has ended
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        _be_the_child(run, work, output.fileno(), counted, fault, steps_in=steps_in)
    return Begun(child, counted, begun_s, output)


def finish(begun: Begun, struck_s: float | None = None) -> Ended:
    """Return how a call ended."""
    code = _waited(begun.child, time.monotonic() + LONGEST_S)
    ended_s = time.monotonic()
    left_running = _outlived(begun.child)
    with begun.output as output:
        output.seek(0)
        said = output.read().decode(errors="replace")
    late_s = ended_s - (begun.at_s if struck_s is None else struck_s)
    return Ended(
        code, said, max(begun.counted[0], fault_workers.count_steps()), ended_s - begun.at_s, late_s, left_running
    )


def command(*arguments: str) -> Callable[[], object]:
    """Return the command line with these arguments, to be called."""

    def run() -> None:
        from tcpipe.cli import main

        sys.argv = ["tcpipe", *arguments]
        main()

    return run


def _be_the_child(
    run: Callable[[], object],
    work: Path,
    output: int,
    counted: "memoryview[int]",
    fault: Fault | None,
    *,
    steps_in: str,
) -> None:
    """Become the child: never returns."""
    code = 70
    try:
        os.setsid()
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it, nohup the next
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        os.chdir(work)
        os.dup2(output, 1)
        os.dup2(output, 2)
        tempfile.tempdir = os.environ["TMPDIR"] = str(work / "tmp")
        if steps_in == "bucket":
            fault_workers.call_around_requests(lambda: sys.audit(_REQUEST))  # the hook counts them
        if steps_in != "workers":
            sys.addaudithook(_hook(work, counted, fault, in_bucket=steps_in == "bucket"))
        run()
        code = 0
    except SystemExit as done:
        code = done.code if isinstance(done.code, int) else int(done.code is not None)
    except BaseException as error:  # noqa: BLE001  a traceback is a finding
        os.write(2, f"Traceback: {error!r}".encode())
    finally:
        threading._shutdown()  # noqa: SLF001  threads end before a process does, which os._exit does not wait for
        atexit._run_exitfuncs()  # noqa: SLF001
        with suppress(OSError):
            sys.stdout.flush()
        os._exit(code)


def _hook(work: Path, counted: "memoryview[int]", fault: Fault | None, *, in_bucket: bool):
    """Count steps, and let the fault come at its own."""
    inside = f"{work}{os.sep}"

    def hook(event: str, args: tuple[object, ...]) -> None:
        changes = event == _REQUEST if in_bucket else event in _CHANGES
        if changes or (event == "open" and not in_bucket and _is_change(args, inside)):
            counted[0] += 1
            if fault and fault.step and counted[0] >= fault.step:
                if fault.signal and counted[0] == fault.step:
                    os.kill(os.getpid(), fault.signal)
                elif not fault.signal and _takes_room(event, args):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), args[0])

    return hook


def _takes_room(event: str, args: tuple[object, ...]) -> bool:
    return (
        bool(args[2] & (os.O_WRONLY | os.O_RDWR)) if event == "open" else event in ("os.mkdir", "os.link", "os.symlink")
    )


def _is_change(args: tuple[object, ...], inside: str) -> bool:
    """Whether an opening is one to write into the workplace, or one of a directory in it."""
    path, mode, _ = args
    if not isinstance(path, str | bytes):
        return False
    writes = not isinstance(mode, str) or bool(set("wax+") & set(mode))
    return writes and os.path.join(inside, os.fsdecode(path)).startswith(inside)  # noqa: PTH118


def _waited(child: int, deadline: float) -> int:
    """Return the exit status of a child as a shell gives it; 124 if it was killed because it took too long."""
    late = False
    while True:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            code = os.waitstatus_to_exitcode(status)
            return 124 if late else code if code >= 0 else 128 - code
        if time.monotonic() > deadline and not late:
            late = True
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.002)


def _outlived(session: int) -> bool:
    """Whether processes of a session are there `LATEST_S` after its leader; they are killed then."""
    deadline = time.monotonic() + LATEST_S
    while members := _members(session):
        if time.monotonic() > deadline:
            for member in members:
                with suppress(ProcessLookupError):
                    os.kill(member, signal.SIGKILL)
            return True
        time.sleep(0.02)
    return False


def _members(session: int) -> list[int]:
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, _, of = entry.read_text().rpartition(")")[2].split()[:4]
            if int(of) == session and state != "Z":
                found.append(int(entry.parent.name))
    return found


# ---------------------------------------------------------------- what is on disk
Tree = dict[str, str]
"""Path below a directory → sha256 of the file, or what else it is."""


def tree(root: Path, besides: str = INPUTS) -> Tree:
    """Return everything below a directory but the inputs, and of stores what readers see in them."""
    found: Tree = {}
    for store in STORES:
        if (root / store).is_dir():
            found |= {f"{store}/{name}": what for name, what in in_child(lambda at=root / store: see_store(at)).items()}
    for directory, names, files in os.walk(root):
        here = Path(directory).relative_to(root)
        names[:] = [name for name in names if str(here / name) not in (besides, *STORES)]
        found |= {str(here / name): "directory" for name in names}
        found |= {str(here / name): hashlib.sha256((root / here / name).read_bytes()).hexdigest() for name in files}
    return found


def see_store(root: Path | str) -> Tree:
    """Return what a reader sees of a store, and temporaries; calls, names of payload and times are never twice the same."""
    state, store = scan(open_place(root)), Store(root)
    found = {path.name: "temporary" for path in Path(root).glob(".tmp-*")}
    for key, row in state.runs.items():
        run = StoredRun(store.place, row, state.names["runs", key])
        name = f"runs/{run.run_id}@{run.recipe_id}"
        found[f"{name}/manifest"] = _hash_record(replace(run.manifest, blob=str(bool(row.blob)), streams_blob=""))
        found |= {f"{name}/{file}": _hash_file(run.folder, file) for file in (*row.tables, REPORT) if row.blob}
        streams = store.place.below(f"{BLOBS}/{row.streams_blob}")
        found |= {f"{name}/{file}": _hash_file(streams, file) for file in row.streams}
    for each in state.maps.values():
        folder = store.place.below(f"{BLOBS}/{each.blob}")
        found |= {f"maps/{each.name}/{file}": _hash_file(folder, file) for file in each.files}
    others = {kind: state.facts[kind] for kind in ("failed", "tags", "seen", "acknowledged")}
    others["outputs"] = {key: replace(each, at="") for key, each in state.facts["outputs"].items()}
    found |= {f"{kind}/{key}": _hash_record(each) for kind, held in others.items() for key, each in held.items()}
    return {name: what for name, what in (found | {REPORT: _hash_file(store.place, REPORT)}).items() if what}


def see_output(url: str) -> Tree:
    """Return what a reader sees of a dataset at a URL."""
    card = find_newest(url, CARDS)
    return {} if card is None else {entry.name: _hash_file(card.place, entry.name) for entry in card.place.entries()}


def _hash_file(place: Place, name: str) -> str:
    """Return the hash of a file; "" if it does not exist."""
    data = place.read(name)
    return "" if data is None else hashlib.sha256(data).hexdigest()


def _hash_record(record: object) -> str:
    return hashlib.sha256(to_compact_json(record)).hexdigest()


def without_unfinished(found: Tree) -> Tree:
    """Leave out what waits for the next call."""
    return {path: what for path, what in found.items() if not _is_unfinished(path)}


def _is_unfinished(path: str) -> bool:
    return any(fnmatch(above, pattern) for above in _with_parents(path) for pattern in UNFINISHED)


def _with_parents(path: str) -> list[str]:
    """Return a path and all above it, from the top."""
    return [*(str(above) for above in reversed(Path(path).parents) if above != Path()), path]


def half_written(before: Tree, after: Tree, now: Tree) -> list[str]:
    """Name each final path that is neither as before nor as after: a directory of `WHOLE` as one, any other file by itself."""
    now = without_unfinished(now)
    states = [_by_unit(found) for found in (before, after, now)]
    bad = []
    for unit in sorted(set().union(*states)):
        old, new, found = (state.get(unit, {}) for state in states)
        if found not in (old, new) and not _only_a_directory(found):
            bad.append(f"{unit}: neither as before nor as after")
        if old and new and not found:
            bad.append(f"{unit}: gone")
    return bad


def _only_a_directory(found: Tree) -> bool:
    return set(found.values()) <= {"directory"} and len(found) <= 1


def _by_unit(found: Tree) -> dict[str, Tree]:
    units: dict[str, Tree] = {}
    for path, what in found.items():
        units.setdefault(_unit_of(path), {})[path] = what
    return units


def _unit_of(path: str) -> str:
    for above in _with_parents(path):
        if any(fnmatch(above, pattern) and above.count(os.sep) == pattern.count(os.sep) for pattern in WHOLE):
            return above
    return path


def different(one: Tree, other: Tree) -> list[str]:
    """Name the paths at which two trees differ."""
    return sorted(path for path in one.keys() | other.keys() if one.get(path) != other.get(path))
