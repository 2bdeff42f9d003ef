"""Where files lie, a directory or a bucket, behind the same few verbs: what a store, its index and its readers are made of (ADR-28).

A name is relative, with ``/`` between its parts. What may be there already under a name is of three kinds, and there is a verb for each:

- a file that is named after its content (`Place.put_files`): writing it twice is writing it once;
- a document that exactly one writer may make (`Place.put_new`): the first wins, and is told so;
- a file that can be made again at will, and is nobody's truth (`Place.put`): the last writer's stays.

Nothing appears before it is whole, and on disk before it is synced.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import NamedTuple, Protocol

from tcpipe.errors import MissingFileError, StoreError
from tcpipe.formats.atomic import TEMPORARY_PREFIX, clear, make_working_directory, put_directory, put_file
from tcpipe.formats.integrity import Checksum, compute_checksum


class Entry(NamedTuple):
    """A file at a place: its name there, its size [byte], and when it was written [ns] by the clock of where it lies."""

    name: str
    size_bytes: int
    modified_ns: int


class Place(Protocol):
    """A directory or a prefix of a bucket; every method raises `StoreError`, in one line, where it cannot be read or written."""

    def __hash__(self) -> int:
        """Return a hash: places of one name are one."""

    def where(self, name: str = "") -> str:
        """Return how a user would name a file here: a path or a URL."""

    def below(self, prefix: str) -> Place:
        """Return the place whose names begin with ``prefix/`` here."""

    def check(self) -> None:
        """Raise `StoreError` unless names can be listed here: missing bucket, wrong credentials."""

    def read(self, name: str) -> bytes | None:
        """Return a whole file; None where there is none."""

    def read_range(self, name: str, start: int, size: int) -> bytes:
        """Return ``size`` bytes from ``start`` on; fewer at the end of the file."""

    def size(self, name: str) -> int | None:
        """Return how large a file is [byte]; None where there is none."""

    def version(self, name: str) -> str | None:
        """Return what changes whenever a file's content does, and names the file; None where nothing is known to."""

    def entries(self, prefix: str = "", *, but: str = "") -> list[Entry]:
        """Return the files below ``prefix/``, however deep, by name (from here on); temporaries are none.

        What lies in folders called ``but`` may be missing: on disk they are not looked into.
        """

    def folders(self, prefix: str = "") -> list[str]:
        """Return the first parts of all names of more parts below ``prefix/``, sorted: the folders that lie there."""

    def files(self, prefix: str = "") -> list[str]:
        """Return the names of one part below ``prefix/``, sorted: the files that lie there, not those in its folders."""

    def files_after(self, prefix: str, after: str) -> list[str]:
        """Return the names of the files in ``prefix`` that sort after a name; a bucket lists no others."""

    def put(self, name: str, data: bytes, *, lasting: bool = True) -> None:
        """Write a file, in the place of what is there; without ``lasting`` it is not synced, and may be half there after a kill."""

    def put_new(self, name: str, data: bytes) -> bool:
        """Write a file where there is none; of several writers the first wins. Return whether this call did."""

    def workshop(self) -> AbstractContextManager[Path]:
        """Return a context: an empty directory of this machine, for what is to be put here by `put_files`; it goes in the end."""

    def put_files(self, prefix: str, directory: Path) -> None:
        """Put the files of a directory in a `workshop` below ``prefix/``, which is named after their content; the directory is used up."""

    def checksum(self, name: str) -> Checksum | None:
        """Return size and sha256 of a file, every byte read where it lies; None where there is none."""

    def delete(self, name: str) -> None:
        """Remove a file; where there is none nothing happens."""

    def local(self, name: str, checksum: Checksum) -> Path:
        """Return a file of this machine with the content of ``name``: itself, or a copy in the cache by content."""


@dataclass(frozen=True, slots=True)
class DirectoryPlace:
    """A directory."""

    root: Path
    staging: Path | None = None
    """Where temporaries lie, at the top of the same file system; None: in ``root``."""

    def where(self, name: str = "") -> str:
        """Return a path."""
        return str(self._path(name))

    def below(self, prefix: str) -> DirectoryPlace:
        """Return the directory ``prefix`` in this one."""
        return DirectoryPlace(self._path(prefix), self.staging or self.root)

    def check(self) -> None:
        """Raise `StoreError` where this is no directory, or cannot be listed."""
        with _convert_os_errors(self.where(), "read"):
            os.scandir(self.root).close()

    def read(self, name: str) -> bytes | None:
        """Return a whole file; None where there is none."""
        with _convert_os_errors(self.where(name), "read"), suppress(FileNotFoundError, NotADirectoryError):
            return self._path(name).read_bytes()
        return None

    def read_range(self, name: str, start: int, size: int) -> bytes:
        """Return ``size`` bytes from ``start`` on."""
        with _convert_os_errors(self.where(name), "read"), self._path(name).open("rb") as stream:
            return os.pread(stream.fileno(), size, start)

    def size(self, name: str) -> int | None:
        """Return how large a file is [byte]."""
        path = self._path(name)
        with _convert_os_errors(self.where(name), "read"), suppress(FileNotFoundError, NotADirectoryError):
            return path.stat().st_size if path.is_file() else None
        return None

    def version(self, name: str) -> str | None:
        """Return the inode of a file and when it was changed."""
        with _convert_os_errors(self.where(name), "read"):
            seen = self._path(name).stat()
        return f"{seen.st_dev} {seen.st_ino} {seen.st_size} {seen.st_mtime_ns} {seen.st_ctime_ns}"

    def entries(self, prefix: str = "", *, but: str = "") -> list[Entry]:
        """Return the files below ``prefix/``, by name, without those in folders called ``but``."""
        with _convert_os_errors(self.where(prefix), "read"):
            return sorted(_walk_files(self._path(prefix), prefix, but))

    def folders(self, prefix: str = "") -> list[str]:
        """Return the names of the directories in ``prefix``."""
        return [entry.name for entry in self._in(prefix) if entry.is_dir()]

    def files(self, prefix: str = "") -> list[str]:
        """Return the names of the files in ``prefix``."""
        return [entry.name for entry in self._in(prefix) if not entry.is_dir()]

    def files_after(self, prefix: str, after: str) -> list[str]:
        """Return the names of the files in ``prefix`` that sort after a name."""
        return [name for name in self.files(prefix) if name > after]

    def _in(self, prefix: str) -> list[os.DirEntry[str]]:
        with _convert_os_errors(self.where(prefix), "read"), suppress(FileNotFoundError, NotADirectoryError):
            found = sorted(os.scandir(self._path(prefix)), key=lambda entry: entry.name)
            return [entry for entry in found if not entry.name.startswith(TEMPORARY_PREFIX)]
        return []

    def put(self, name: str, data: bytes, *, lasting: bool = True) -> None:
        """Write a file by a rename; without ``lasting`` as it is."""
        if not lasting:
            with _convert_os_errors(self.where(name), "written"):
                self._path(name).parent.mkdir(parents=True, exist_ok=True)
                self._path(name).write_bytes(data)
            return
        put_file(self._path(name), data, staging=self._staging(), over=True)

    def put_new(self, name: str, data: bytes) -> bool:
        """Write a file by a link."""
        return put_file(self._path(name), data, staging=self._staging())

    def workshop(self) -> AbstractContextManager[Path]:
        """Return a context: an empty directory among the temporaries."""
        return make_working_directory(self._staging())

    def put_files(self, prefix: str, directory: Path) -> None:
        """Put the directory there by one rename."""
        put_directory(directory, self._path(prefix))

    def checksum(self, name: str) -> Checksum | None:
        """Return size and sha256 of a file."""
        path = self._path(name)
        with _convert_os_errors(self.where(name), "read"):
            return compute_checksum(path) if path.is_file() else None

    def delete(self, name: str) -> None:
        """Remove a file, and the directories above it that it leaves empty."""
        path = self._path(name)
        with _convert_os_errors(self.where(name), "written"), suppress(FileNotFoundError, NotADirectoryError):
            path.unlink()
        with suppress(OSError):
            for parent in path.parents:
                if parent == (self.staging or self.root):
                    break
                parent.rmdir()

    def local(self, name: str, checksum: Checksum) -> Path:
        """Return the file itself."""
        del checksum
        return self._path(name)

    def clear(self) -> None:
        """Remove what killed writers left as temporaries."""
        clear(self.staging or self.root)

    def _path(self, name: str) -> Path:
        if (".." in name and ".." in PurePosixPath(name).parts) or name.startswith("/"):
            raise StoreError(f"{self.root}: {name!r} is no name of a file in it")
        return self.root / name

    def _staging(self) -> Path:
        staging = self.staging or self.root
        staging.mkdir(parents=True, exist_ok=True)
        return staging


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
                try:
                    seen = entry.stat()
                except FileNotFoundError:
                    continue
                found.append(Entry(above + entry.name, seen.st_size, seen.st_mtime_ns))
    return found


@contextmanager
def _convert_os_errors(where: str, what: str) -> Iterator[None]:
    """Turn what the operating system says into one line."""
    try:
        yield
    except (FileNotFoundError, NotADirectoryError):
        raise MissingFileError(where) from None
    except OSError as error:
        raise StoreError(f"{where}: cannot be {what} ({error.strerror or error})") from error
