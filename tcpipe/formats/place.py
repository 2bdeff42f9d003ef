"""Where files lie, a directory or a prefix of a bucket: what a store, its index and its readers are made of (ADR-28).

A name is relative, with ``/`` between its parts. What may be there already under a name is of three kinds, and there is a verb for each:

- a file that is named after its content (`Place.put_files`): writing it twice is writing it once;
- a document that exactly one writer may make (`Place.put_new`): the first wins, and is told so;
- a file that can be made again at will, and is nobody's truth (`Place.put`): the last writer's stays.

No file appears before it is whole and, on disk, synced. Each method has its own code for a path and for an object: obstore's store for
local directories syncs nothing, and lists nothing of what a killed writer leaves, which `Place.clear` removes.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, BinaryIO, NamedTuple, TypeVar

from tcpipe.errors import MissingFileError, StoreError
from tcpipe.formats.atomic import (
    TEMPORARY_PREFIX,
    clear,
    clear_scratch,
    make_scratch_directory,
    make_working_directory,
    put_directory,
    put_file,
)
from tcpipe.formats.cache import fetch_cached
from tcpipe.formats.integrity import ALL_CHANGES, Checksum, compute_checksum, find_wrong_checksum
from tcpipe.formats.object_storage import (
    ask_store,
    is_url,
    read_modified_ns,
    run_side_by_side,
    split_bucket,
    split_into_pieces,
    split_url,
)

if TYPE_CHECKING:
    from obstore.store import ObjectStore

T = TypeVar("T")
U = TypeVar("U")

_MOST_BYTES = 256 << 20
"""A file that is read as a whole is at most so large [byte]."""
_READS_AT_ONCE = 4
"""Files that are read side by side: a disk gives no more, and two cores hash 1 to 3 GB a second."""


class Entry(NamedTuple):
    """A file at a place: its name there, its size [byte], and when it was written [ns] by the clock of where it lies."""

    name: str
    size_bytes: int
    modified_ns: int


@dataclass(frozen=True, slots=True)
class Place:
    """A directory, or what lies below a URL; every method raises `StoreError`, in one line, where it cannot be read or written."""

    root: Path | str
    staging: Path | None = None
    """Of a directory: where temporaries lie, at the top of the same file system; None: in ``root``."""

    @property
    def path(self) -> Path | None:
        """The directory; None of a bucket."""
        return self.root if isinstance(self.root, Path) else None

    def where(self, name: str = "") -> str:
        """Return how a user would name a file here: a path or a URL."""
        return str(self._at(name)) if self.path is not None else f"{self.root}/{name}".rstrip("/")

    def below(self, prefix: str) -> Place:
        """Return the place whose names begin with ``prefix/`` here."""
        return Place(self.where(prefix)) if self.path is None else Place(self._at(prefix), self.staging or self.path)

    def check(self) -> None:
        """Raise `StoreError` unless names can be listed here: missing bucket, wrong credentials."""
        self._do("", lambda path: os.scandir(path).close(), lambda s, key: next(iter(s.list(key or None)), None))

    def read(self, name: str) -> bytes | None:
        """Return a whole file; None where there is none. On disk it is a `StoreError` if it is larger than any document or page."""

        def read(path: Path) -> bytes:
            if path.stat().st_size > _MOST_BYTES:
                raise StoreError(
                    f"{path}: is larger than {_MOST_BYTES >> 20} MB, which no document or page is; remove it"
                )
            return path.read_bytes()

        with suppress(MissingFileError):
            return self._do(name, read, lambda store, key: bytes(store.get(key).bytes()))
        return None

    def read_range(self, name: str, start: int, size: int) -> bytes:
        """Return ``size`` bytes from ``start`` on; fewer at the end of the file."""

        def read(path: Path) -> bytes:
            with path.open("rb") as stream:
                return os.pread(stream.fileno(), size, start)

        return self._do(name, read, lambda s, key: bytes(s.get_range(key, start=start, length=size)) if size else b"")

    def size(self, name: str) -> int | None:
        """Return how large a file is [byte]; None where there is none."""
        with suppress(MissingFileError):
            return self._do(
                name, lambda path: path.stat().st_size if path.is_file() else None, lambda s, key: s.head(key)["size"]
            )
        return None

    def version(self, name: str) -> str | None:
        """Return what changes whenever a file's content does, and names the file; None where nothing is known to."""

        def look(path: Path) -> str:
            seen = path.stat()
            return f"{seen.st_dev} {seen.st_ino} {seen.st_size} {seen.st_mtime_ns} {seen.st_ctime_ns}"

        tag = self._do(name, look, lambda store, key: store.head(key)["e_tag"])
        return tag if tag is None or self.path else f"{self.where(name)} {tag}"

    def entries(self, prefix: str = "", *, but: str = "") -> list[Entry]:
        """Return the files below ``prefix/``, however deep, by name (from here on); temporaries are none.

        What lies in folders called ``but`` may be missing: on disk they are not looked into. A bucket gives a thousand a request.
        """

        def list_objects(store: ObjectStore, key: str) -> list[Entry]:
            cut = len(self._key("x")) - 1
            found = (meta for batch in store.list(key or None) for meta in batch)
            return [Entry(meta["path"][cut:], meta["size"], read_modified_ns(meta)) for meta in found]

        return sorted(self._do(prefix, lambda path: _walk_files(path, prefix, but), list_objects))

    def list(self, folder: str = "") -> "Sequence[str]":
        """Return the names directly in a folder."""
        folders, files = self._list(folder)
        return sorted([*folders, *files])

    def folders(self, prefix: str = "") -> list[str]:
        """Return the first parts of all names of more parts below ``prefix/``, sorted: the folders that lie there."""
        return self._list(prefix)[0]

    def files(self, prefix: str = "", *, after: str = "") -> list[str]:
        """Return the names of one part below ``prefix/``, sorted, that sort after a name; a bucket lists no others."""
        return [name for name in self._list(prefix, after)[1] if name > after]

    def _list(self, prefix: str, after: str = "") -> tuple[list[str], list[str]]:
        def list_objects(store: ObjectStore, key: str) -> tuple[Iterable[str], Iterable[str]]:
            if after:
                cut, offset = len(key) + 1 if key else 0, self._key(f"{prefix}/{after}".lstrip("/"))
                names = (meta["path"][cut:] for batch in store.list(key or None, offset=offset) for meta in batch)
                return [], [name for name in names if "/" not in name]
            found = store.list_with_delimiter(key or None)
            return found["common_prefixes"], [meta["path"] for meta in found["objects"]]

        with suppress(MissingFileError):
            folders, files = self._do(prefix, _list_directory, list_objects)
            return _sort_names(folders), _sort_names(files)
        return [], []

    def put(self, name: str, data: bytes, *, lasting: bool = True) -> None:
        """Write a file, in the place of what is there; without ``lasting`` it is not synced, and may be half there after a kill."""

        def write(path: Path) -> None:
            if lasting:
                put_file(path, data, staging=self._staging(), over=True)
            else:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)

        self._do(name, write, lambda store, key: store.put(key, data, use_multipart=False), what="written")

    def put_new(self, name: str, data: bytes) -> bool:
        """Write a file where there is none; of several writers the first wins. Return whether this call did."""

        def put(store: ObjectStore, key: str) -> bool:
            from obstore.exceptions import AlreadyExistsError  # noqa: PLC0415  most runs stay on this machine

            try:
                store.put(key, data, mode="create", use_multipart=False)
            except AlreadyExistsError:
                return False
            return True

        return self._do(name, lambda path: put_file(path, data, staging=self._staging()), put, what="written")

    def workshop(self) -> AbstractContextManager[Path]:
        """Return a context: an empty directory of this machine, for what is to be put here by `put_files`; it goes in the end."""
        return make_scratch_directory() if self.path is None else make_working_directory(self._staging())

    def put_files(self, prefix: str, directory: Path) -> None:
        """Put the files of a directory in a `workshop` below ``prefix/``, which is named after their content; the directory is used up."""
        if self.path is not None:
            put_directory(directory, self._at(prefix))
            return

        def upload(path: Path) -> None:
            name = f"{prefix}/{path.relative_to(directory).as_posix()}".lstrip("/")
            ask_store(self.where(name), lambda store: store.put(self._key(name), path), what="written")

        self.map(upload, sorted(path for path in directory.rglob("*") if path.is_file()))

    def checksum(self, name: str) -> Checksum | None:
        """Return size and sha256 of a file, every byte read where it lies; None where there is none."""
        size = self.size(name)
        return None if size is None else self._hash_pieces(name, size)

    def copy(self, name: str, to: Path) -> Checksum | None:
        """Copy a file to this machine, and return its `checksum`: every byte is read once."""
        size = self.size(name)
        if size is None:
            return None
        with to.open("wb") as target:
            return self._hash_pieces(name, size, target)

    def delete(self, name: str) -> None:
        """Remove a file; where there is none nothing happens. Directories above it that it leaves empty go, too."""

        def remove(path: Path) -> None:
            path.unlink(missing_ok=True)
            with suppress(OSError):
                for parent in path.parents:
                    if parent == (self.staging or self.path):
                        break
                    parent.rmdir()

        with suppress(MissingFileError):
            self._do(name, remove, lambda store, key: store.delete(key), what="written")

    def local(self, name: str, checksum: Checksum) -> Path:
        """Return a file of this machine with the content of ``name``: itself, or a copy in the cache by content."""
        if self.path is not None:
            return self._at(name)

        def fetch(path: Path) -> None:
            with path.open("wb") as target:
                found = self._hash_pieces(name, checksum.size_bytes, target)
            if wrong := find_wrong_checksum(self.where(name), found, checksum):
                raise StoreError(wrong)

        return fetch_cached(checksum.sha256, fetch)

    def proved(self, name: str, checksum: Checksum) -> Path:
        """Return `local`, read again; a copy that is not as it was is fetched anew. `StoreError` if the file is not as it was written."""
        path = self.local(name, checksum)
        wrong = find_wrong_checksum(self.where(name), compute_checksum(path) if path.is_file() else None, checksum)
        if wrong and self.path is None:
            path.unlink(missing_ok=True)
            return self.local(name, checksum)
        if wrong:
            raise StoreError(f"{wrong}{ALL_CHANGES.format(self.where())}")
        return path

    def map(self, function: Callable[[T], U], items: Sequence[T]) -> list[U]:
        """Return what a function gives for each item, one after another; where it asks a bucket some at once."""
        return run_side_by_side(function, items) if self.path is None else [*map(function, items)]

    def clear(self) -> None:
        """Remove what killed writers left as temporaries."""
        if self.path is None:
            clear_scratch()
        else:
            clear(self.staging or self.path)

    def _do(
        self, name: str, on_disk: Callable[[Path], T], in_bucket: Callable[[ObjectStore, str], T], *, what: str = "read"
    ) -> T:
        """Do something with the file or object of a name; `MissingFileError` where there is none."""
        try:
            if self.path is not None:
                return on_disk(self._at(name))
            return ask_store(self.where(name), lambda store: in_bucket(store, self._key(name)), what=what)
        except (FileNotFoundError, NotADirectoryError):
            raise MissingFileError(self.where(name)) from None
        except OSError as error:
            raise StoreError(f"{self.where(name)}: cannot be {what} ({error.strerror or error})") from error

    def _hash_pieces(self, name: str, size: int, target: BinaryIO | None = None) -> Checksum:
        """Return the checksum of the first ``size`` bytes of a file, which are written to ``target`` as they are read."""
        digest = hashlib.sha256()
        for start, stop in split_into_pieces(size):
            piece = self.read_range(name, start, stop - start)
            digest.update(piece)
            if target is not None:
                target.write(piece)
        return Checksum(size, digest.hexdigest())

    def _key(self, name: str) -> str:
        """Return the name in the bucket of what is called ``name`` here."""
        return "/".join(part for part in (split_bucket(str(self.root))[1], name) if part)

    def _at(self, name: str) -> Path:
        if (".." in name and ".." in PurePosixPath(name).parts) or name.startswith("/"):
            raise StoreError(f"{self.root}: {name!r} is no name of a file in it")
        return Path(self.root) / name

    def _staging(self) -> Path:
        staging = Path(self.staging or self.root)
        staging.mkdir(parents=True, exist_ok=True)
        return staging


def open_place(path: str | Path) -> Place:
    """Return the place that a path or a URL names; nothing is asked of it yet."""
    return Place(split_url(str(path))[0].rstrip("/") if is_url(path) else Path(path))


def _sort_names(names: Iterable[str]) -> list[str]:
    return sorted(name.rpartition("/")[2] for name in names)


def _list_directory(directory: Path) -> tuple[list[str], list[str]]:
    """Return the names of the directories and of the files in a directory."""
    found = [entry for entry in os.scandir(directory) if not entry.name.startswith(TEMPORARY_PREFIX)]
    return [entry.name for entry in found if entry.is_dir()], [entry.name for entry in found if not entry.is_dir()]


def _walk_files(directory: Path, prefix: str, but: str) -> list[Entry]:
    """Return the files below a directory, ``prefix/`` before their names; a file that goes meanwhile is none."""
    found, todo = list[Entry](), [(str(directory), f"{prefix}/" if prefix else "")]
    while todo:
        path, above = todo.pop()
        with suppress(FileNotFoundError, NotADirectoryError), os.scandir(path) as there:
            for entry in there:
                if entry.name.startswith(TEMPORARY_PREFIX):
                    continue
                if entry.is_dir():
                    todo += [(entry.path, f"{above}{entry.name}/")] if entry.name != but else []
                    continue
                with suppress(FileNotFoundError):
                    seen = entry.stat()
                    found.append(Entry(above + entry.name, seen.st_size, seen.st_mtime_ns))
    return found


def find_wrong_files(place: Place, checksums: Mapping[str, Checksum | None]) -> Iterator[str]:
    """Yield a line for every file at a place that is not what ``checksums`` has of it (None: nothing), each read where it lies."""
    for name, wanted in checksums.items():
        try:
            line = _check_size(place, name, wanted)
            line = line or find_wrong_checksum(place.where(name), place.checksum(name), wanted)
        except StoreError as error:
            line = error.problems[0]
        if line:
            yield line


def prove_files(directory: Path, checksums: Mapping[str, Checksum], names: Iterable[str]) -> None:
    """Compare files of a directory with what a sealed document has of them; `StoreError` names the first that differs."""
    lines = list(find_wrong_files(Place(directory), {name: checksums.get(name) for name in names}))
    if lines:
        more = f", and {len(lines) - 1} more" if len(lines) > 1 else ""
        raise StoreError(f"{lines[0]}{more}{ALL_CHANGES.format(directory)}")


def find_changed_files(place: Place, checksums: Mapping[str, Checksum], names: Iterable[str]) -> list[str]:
    """Return a line for each of some files that is not what a card has of it; all sizes are compared before a file is read.

    The digest of a file is kept in the cache under its `Place.version`: it is hashed again only after it has changed.
    """
    names = list(names)
    sizes = [line for name in names if (line := _check_size(place, name, checksums.get(name)))]
    if sizes:
        return sizes
    with ThreadPoolExecutor(_READS_AT_ONCE) as pool:
        return [line for line in pool.map(lambda name: _check_digest(place, name, checksums[name]), names) if line]


def _check_size(place: Place, name: str, wanted: Checksum | None) -> str | None:
    size, where = place.size(name), place.where(name)
    if size is None or wanted is None:
        return find_wrong_checksum(where, None if size is None else Checksum(size, ""), wanted)
    return None if size == wanted.size_bytes else f"{where}: has {size} bytes, expected {wanted.size_bytes}"


def _check_digest(place: Place, name: str, wanted: Checksum) -> str | None:
    version = place.version(name)
    if version is not None and _read_remembered(place, name, version) == wanted.sha256:
        return None
    return find_wrong_checksum(place.where(name), place.checksum(name), wanted)


def _read_remembered(place: Place, name: str, version: str) -> str | None:
    """Return the digest of a version of a file, found now where it is not remembered; None where it cannot be kept."""

    def find(to: Path) -> None:
        checksum = place.checksum(name)
        to.write_text("" if checksum is None else checksum.sha256)

    try:
        return fetch_cached(f"sha256 of {version}", find).read_text(errors="replace")
    except (OSError, StoreError):
        return None
