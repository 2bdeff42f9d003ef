"""Writing datasets, models, cost maps and evaluations to a URL: each build is a generation of its own (ADR-36)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from tcpipe.errors import UsageError
from tcpipe.formats.atomic import make_scratch_directory
from tcpipe.formats.bucket_directories import GENERATIONS, is_left_over, name_generation
from tcpipe.formats.commit_log import LOG, Stamp, put_commit, read_state
from tcpipe.formats.commits import Entries, Generation, Process, State
from tcpipe.formats.place import Place, open_place

_NOBODY = Process("", "", "", "", 0, "")
"""Who commits: the log at a URL names no machine."""


@contextmanager
def write_generation(url: str, card: str) -> Iterator[Path]:
    """Yield a directory; what it contains at the end, a card among it, becomes the newest generation at a URL.

    The files come first, in a folder of their own, then the commit that names it. Of two calls at once the second becomes the next
    generation; calls that put the same card complete one generation. What no commit can name any more is removed.

    Raises `UsageError`: something else is at the URL; `StoreError`: the place cannot be read or written.
    """
    place = open_place(url)
    read_generations(place, card)
    with make_scratch_directory() as scratch:
        directory = scratch / (url.rstrip("/").rpartition("/")[2])
        directory.mkdir()
        yield directory
        state = _put_generation(place, directory, card)
        names = [entry.name for entry in place.entries(GENERATIONS)]
        place.map(place.delete, [name for name in names if is_left_over(name, state)])


def read_generations(place: Place, card: str) -> State:
    """Return what the log at a place says; `UsageError` where something lies there that has no card of this name."""
    state = read_state(place)
    if state.generations:
        name = state.generations[-1].card
    else:
        there = {*place.folders(), *place.files()} - {GENERATIONS, LOG}
        name = card if card in there else min(there, default=card)
    if name != card:
        raise UsageError(f"{place.where()}: contains {name} and no {card}; it is not changed; give another place")
    return state


def _put_generation(place: Place, directory: Path, card: str) -> State:
    """Put the files of a directory to a place and commit them; return what the log says then."""
    document = (directory / card).read_bytes()
    while True:
        state = read_generations(place, card)
        number = state.number + 1
        folder = name_generation(number, document)
        if _has_newest(place, state, folder, directory):
            return state
        place.put_files(folder, directory)
        stamp = Stamp(_NOBODY, datetime.now(UTC).isoformat(timespec="milliseconds"))
        state = put_commit(place, state, stamp, "built", _commit_as(number, Generation(folder, card, stamp.at)))
        if state.generations and state.generations[-1].folder == folder:
            return state


def _has_newest(place: Place, state: State, folder: str, directory: Path) -> bool:
    """Return whether another call has built the same: the newest generation has the card of a folder, and each file of a directory."""
    newest = state.generations[-1].folder if state.generations else ""
    if newest.rpartition("-")[2] != folder.rpartition("-")[2]:
        return False
    sizes = {entry.name: entry.size_bytes for entry in place.below(newest).entries()}
    files = (path for path in directory.rglob("*") if path.is_file())
    return all(sizes.get(path.relative_to(directory).as_posix()) == path.stat().st_size for path in files)


def _commit_as(number: int, generation: Generation) -> Callable[[State], Entries]:
    """Return what adds a generation under one number alone: the folder of another has another name."""
    return lambda state: Entries(generations=(generation,)) if state.number + 1 == number else Entries()
