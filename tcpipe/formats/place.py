"""Files of a store or of an output, in a directory or below the URL of a bucket (ADR-36).

A name is relative, with ``/`` between its parts. A file appears whole (on disk: synced) or not at all; a folder appears
whole on disk, and file by file in a bucket: readers look into a folder only after a document that names it. Nothing
here needs locks, clocks or put-if-absent. On disk each method has its own code: obstore's store for local directories
syncs nothing and does not list temporaries of killed writers.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, TypeVar

from tcpipe.errors import MissingFileError, StoreError
from tcpipe.formats import atomic
from tcpipe.formats.atomic import Location
from tcpipe.formats.cache import fetch_cached
from tcpipe.formats.integrity import ALL_CHANGES, Checksum, FileChecksums, compute_checksum, find_wrong_checksum
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
_List: TypeAlias = list  # the type: `Place` has a method of that name

_MAX_BYTES = 256 << 20  # largest file that is read as a whole [byte]


REPORT = "report.html"
"""Page of a run, a dataset or a store, beside its files."""
_DESKTOP_FILES = (".DS_Store", ".directory", "Thumbs.db", "desktop.ini")
_STATISTICS = ".aux.xml"


def is_desktop_file(name: str) -> bool:
    """Return whether a file is one that file managers leave in folders, or GDAL and QGIS beside rasters."""
    return name.rpartition("/")[2] in _DESKTOP_FILES or name.endswith(_STATISTICS)


class FileEntry(NamedTuple):
    """A file at a place: its name, its size [byte], and its modification time [ns] by the disk's or bucket's clock."""

    name: str
    size_bytes: int
    modified_ns: int


@dataclass(frozen=True, slots=True)
class Place:
    """A directory, or a prefix of a bucket; every method raises a one-line `StoreError` if it cannot read or write."""

    root: Location
    staging: Path | None = None
    """Folder for temporary files on the same file system as ``root``; None means ``root`` itself."""

    @property
    def path(self) -> Path | None:
        """The directory; None of a bucket."""
        return self.root if isinstance(self.root, Path) else None

    @property
    def _top(self) -> Path:
        """Folder of temporaries, of a directory."""
        return Path(self.staging or self.root)

    def where(self, name: str = "") -> str:
        """Return how a user would name a file here: a path or a URL."""
        return str(self._at(name)) if self.path is not None else f"{self.root}/{name}".rstrip("/")

    def below(self, prefix: str) -> Place:
        """Return the place whose names begin with ``prefix/`` here."""
        return Place(self.where(prefix)) if self.path is None else Place(self._at(prefix), self._top)

    def check(self) -> None:
        """Raise `StoreError` unless names can be listed here: missing bucket, wrong credentials."""
        self._do("", lambda path: os.scandir(path).close(), lambda s, key: next(iter(s.list(key or None)), None))

    def map(self, function: Callable[[T], U], items: Sequence[T]) -> _List[U]:
        """Return the results of a function for each item, one after another; requests to a bucket run side by side."""
        return run_side_by_side(function, items) if self.path is None else list(map(function, items))

    def read(self, name: str) -> bytes | None:
        """Return a whole file; None if it does not exist. `StoreError` if a file on disk is too large for tcpipe."""

        def read(path: Path) -> bytes:
            if path.stat().st_size <= _MAX_BYTES:
                return path.read_bytes()
            raise StoreError(f"{path}: is larger than {_MAX_BYTES >> 20} MB, the most that tcpipe writes; remove it")

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
        """Return the size of a file [byte]; None if it does not exist."""
        with suppress(MissingFileError):
            return self._do(
                name,
                lambda path: path.stat().st_size if path.is_file() else None,
                lambda store, key: store.head(key)["size"],
            )
        return None

    def version(self, name: str) -> str | None:
        """Return a text that names the file and changes with its content; None if the bucket has no such text."""

        def look(path: Path) -> str:
            status = path.stat()
            return f"{status.st_dev} {status.st_ino} {status.st_size} {status.st_mtime_ns} {status.st_ctime_ns}"

        tag = self._do(name, look, lambda store, key: store.head(key)["e_tag"])
        return tag if tag is None or self.path else f"{self.where(name)} {tag}"

    def list(self, folder: str = "") -> _List[str]:
        """Return sorted names of files and folders in a folder, without temporaries (1000 per request to a bucket)."""

        def list_objects(store: ObjectStore, key: str) -> _List[str]:
            found = store.list_with_delimiter(key or None)
            return [*found["common_prefixes"], *(meta["path"] for meta in found["objects"])]

        with suppress(MissingFileError):
            names = (name.rstrip("/").rpartition("/")[2] for name in self._do(folder, os.listdir, list_objects))
            return sorted(name for name in names if not name.startswith(atomic.TEMPORARY_PREFIX))
        return []

    def entries(self, prefix: str = "") -> _List[FileEntry]:
        """Return all files below ``prefix/``, sorted by name, without temporaries; a bucket lists 1000 per request."""

        def list_objects(store: ObjectStore, key: str) -> _List[FileEntry]:
            cut = len(self._key("x")) - 1
            found = (meta for batch in store.list(key or None) for meta in batch)
            return sorted(FileEntry(meta["path"][cut:], meta["size"], read_modified_ns(meta)) for meta in found)

        above = f"{prefix}/" if prefix else ""
        return self._do(prefix, lambda path: sorted(_walk_files(str(path), above)), list_objects)

    def put(self, name: str, data: bytes) -> None:
        """Write a file, synced, in place of an earlier one."""
        self._do(
            name,
            lambda path: atomic.put_file(path, data, staging=self._top),
            lambda store, key: store.put(key, data, use_multipart=False),
            what="written",
        )

    def workshop(self) -> AbstractContextManager[Path]:
        """Return a context: an empty directory of this machine for `put_files`, removed at the end."""
        return atomic.make_scratch_directory() if self.path is None else atomic.make_working_directory(self._top)

    def put_files(self, prefix: str, directory: Path) -> None:
        """Move all files of a directory in a `workshop` below ``prefix/``, an unused name; the directory is used up."""
        if self.path is not None:
            atomic.put_directory(directory, self._at(prefix))
            return

        def upload(path: Path) -> None:
            name = f"{prefix}/{path.relative_to(directory).as_posix()}".lstrip("/")
            ask_store(self.where(name), lambda store: store.put(self._key(name), path), what="written")

        self.map(upload, sorted(path for path in directory.rglob("*") if path.is_file()))

    def fetch(self, name: str, checksum: Checksum, *, proved: bool = True) -> Path:
        """Return a file of this machine with the content of ``name``: itself, or a copy in the cache.

        A file that is ``proved`` is hashed now, and an altered copy is fetched again. `StoreError`: the file has
        another content.
        """

        def copy(to: Path) -> None:
            with to.open("wb") as target:
                for start, stop in split_into_pieces(checksum.size_bytes):
                    target.write(self.read_range(name, start, stop - start))
            if wrong := find_wrong_checksum(self.where(name), compute_checksum(to), checksum):
                raise StoreError(wrong)

        path = fetch_cached(checksum.sha256, copy) if self.path is None else self._at(name)
        found = compute_checksum(path) if proved and path.is_file() else None
        if not proved or found == checksum:
            return path
        if self.path is None:
            path.unlink(missing_ok=True)
            return fetch_cached(checksum.sha256, copy)
        raise StoreError(f"{find_wrong_checksum(self.where(name), found, checksum)}{ALL_CHANGES.format(self.where())}")

    def delete(self, name: str) -> None:
        """Remove a file, or a folder with all its files; do nothing if it does not exist."""

        def remove_objects(store: ObjectStore, key: str) -> None:
            below = [meta["path"] for batch in store.list(key or None) for meta in batch]
            store.delete(below or key)

        with suppress(MissingFileError):
            self._do(name, lambda path: atomic.remove(path, self._top), remove_objects, what="written")

    def clear(self) -> None:
        """Remove temporaries of killed writers."""
        atomic.clear_scratch() if self.path is None else atomic.clear(self._top)

    def _do(
        self, name: str, on_disk: Callable[[Path], T], in_bucket: Callable[[ObjectStore, str], T], *, what: str = "read"
    ) -> T:
        """Return the result of a function of a file or an object; `MissingFileError` if it does not exist."""
        try:
            if self.path is not None:
                return on_disk(self._at(name))
            return ask_store(self.where(name), lambda store: in_bucket(store, self._key(name)), what=what)
        except (FileNotFoundError, NotADirectoryError):
            raise MissingFileError(f"{self.where(name)}: is missing") from None
        except OSError as error:
            raise StoreError(f"{self.where(name)}: cannot be {what} ({error.strerror or error})") from error

    def _key(self, name: str) -> str:
        """Return the name in the bucket of a name at this place."""
        return "/".join(part for part in (split_bucket(str(self.root))[1], name) if part)

    def _at(self, name: str) -> Path:
        if (".." in name and ".." in PurePosixPath(name).parts) or name.startswith("/"):
            raise StoreError(f"{self.root}: {name!r} is no name of a file in it")
        return Path(self.root) / name


def open_place(path: Location) -> Place:
    """Return the place that a path or a URL names, without any request."""
    return Place(split_url(str(path))[0].rstrip("/") if is_url(path) else Path(path))


def _walk_files(directory: str, above: str) -> Iterator[FileEntry]:
    """Yield the files below a directory, with ``above`` as prefix of names; files that disappear are skipped."""
    with suppress(FileNotFoundError, NotADirectoryError), os.scandir(directory) as entries:
        for entry in entries:
            if entry.name.startswith(atomic.TEMPORARY_PREFIX):
                continue
            if entry.is_dir():
                yield from _walk_files(entry.path, f"{above}{entry.name}/")
                continue
            with suppress(FileNotFoundError):
                status = entry.stat()
                yield FileEntry(above + entry.name, status.st_size, status.st_mtime_ns)


_READS_AT_ONCE = 4  # files that are hashed at the same time: two cores hash 1 to 3 GB a second, more than a disk reads


def find_wrong_files(place: Place, checksums: Mapping[str, Checksum | None]) -> Iterator[str]:
    """Yield a line for every file that differs from its checksum (None: not on record); each is read at its place."""
    for name, wanted in checksums.items():
        try:
            line = _check_size(place, name, wanted)
            line = line or find_wrong_checksum(place.where(name), _compute_digest(place, name), wanted)
        except StoreError as error:
            line = error.problems[0]
        if line:
            yield line


def prove_files(directory: Path, checksums: FileChecksums, names: Iterable[str]) -> None:
    """Compare files of a directory with their checksums; `StoreError` names the first that differs."""
    lines = list(find_wrong_files(Place(directory), {name: checksums.get(name) for name in names}))
    if lines:
        more = f", and {len(lines) - 1} more" if len(lines) > 1 else ""
        raise StoreError(f"{lines[0]}{more}{ALL_CHANGES.format(directory)}")


def find_changed_files(place: Place, checksums: FileChecksums, names: Iterable[str]) -> list[str]:
    """Return a line for each named file that differs from its checksum; all sizes are compared before a file is read.

    The cache keeps the digest of a file under its `Place.version`: a file is hashed again only after it has changed.
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
    return find_wrong_checksum(place.where(name), _compute_digest(place, name), wanted)


def _read_remembered(place: Place, name: str, version: str) -> str | None:
    """Return the digest of a version of a file, computed if the cache has none; None if the cache cannot keep it."""

    def find(to: Path) -> None:
        checksum = _compute_digest(place, name)
        to.write_text("" if checksum is None else checksum.sha256)

    try:
        return fetch_cached(f"sha256 of {version}", find).read_text(errors="replace")
    except (OSError, StoreError):
        return None


def _compute_digest(place: Place, name: str) -> Checksum | None:
    """Return size and sha256 of a file, read in place, piece by piece; None if it does not exist."""
    size = place.size(name)
    if size is None:
        return None
    digest = hashlib.sha256()
    for start, stop in split_into_pieces(size):
        digest.update(place.read_range(name, start, stop - start))
    return Checksum(size, digest.hexdigest())
