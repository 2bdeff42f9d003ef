"""A place in object storage: a prefix of a bucket, through obstore (S3, Google, Azure).

A bounded cache of this machine, by content: what was fetched from a bucket once is not fetched again.

A key names its content for good (a sha256; an object's version and a range of it), so that nothing in here can be outdated. It lies in
``TCPIPE_CACHE``, else the user's cache directory, and holds at most ``TCPIPE_CACHE_BYTES`` (8 GB): what was not used for longest goes.

The cache also keeps the digest of each checked file under its `Place.version`, so that a file is hashed again only after it has changed.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from tcpipe.errors import MissingFileError, StoreError, UsageError
from tcpipe.formats.atomic import make_scratch_directory
from tcpipe.formats.integrity import Checksum, find_wrong_checksum
from tcpipe.formats.object_storage import ask_store, is_url, run_side_by_side, split_bucket, split_url
from tcpipe.formats.place import DirectoryPlace, Entry, Place

if TYPE_CHECKING:
    from obstore import GetOptions, ListResult, ObjectMeta
    from obstore.store import ObjectStore

T = TypeVar("T")
U = TypeVar("U")

_PIECE_BYTES = 1 << 24


def open_place(path: str | Path) -> Place:
    """Return the place that a path or a URL names; nothing is asked of it yet."""
    return BucketPlace(split_url(str(path))[0].rstrip("/")) if is_url(path) else DirectoryPlace(Path(path))


def map_concurrently(path: str | Path, function: Callable[[T], U], items: Sequence[T]) -> list[U]:
    """Return what a function gives for each item, one after another; some at once where it asks a bucket, as each answer takes a while."""
    return run_side_by_side(function, items) if is_url(path) else list(map(function, items))


@dataclass(frozen=True, slots=True)
class BucketPlace:
    """What lies below a URL; it is connected to when it is first asked, in each process anew."""

    url: str

    def where(self, name: str = "") -> str:
        """Return a URL."""
        return f"{self.url}/{name}" if name else self.url

    def below(self, prefix: str) -> BucketPlace:
        """Return the place whose names begin with ``prefix/`` here."""
        return BucketPlace(f"{self.url}/{prefix}")

    def check(self) -> None:
        """Raise `StoreError` where nothing can be listed here."""
        self._ask("", lambda store, key: next(iter(store.list(prefix=key or None, chunk_size=1)), None))

    def read(self, name: str) -> bytes | None:
        """Return a whole object; None where there is none."""
        with suppress(FileNotFoundError):
            return self._ask(name, lambda store, key: bytes(store.get(key).bytes()))
        return None

    def read_range(self, name: str, start: int, size: int) -> bytes:
        """Return ``size`` bytes from ``start`` on."""
        with _convert_missing(self.where(name)):
            return (
                self._ask(name, lambda store, key: bytes(store.get_range(key, start=start, length=size)))
                if size
                else b""
            )

    def size(self, name: str) -> int | None:
        """Return how large an object is [byte]."""
        with suppress(FileNotFoundError):
            return self._ask(name, lambda store, key: int(store.head(key)["size"]))
        return None

    def version(self, name: str) -> str | None:
        """Return the URL of an object and its ETag; None where the bucket gives none."""
        with _convert_missing(self.where(name)):
            tag = self._ask(name, lambda store, key: store.head(key)["e_tag"])
        return None if tag is None else f"{self.where(name)} {tag}"

    def entries(self, prefix: str = "", *, but: str = "") -> list[Entry]:
        """Return the objects below ``prefix/``, by name; so many a request that a large store takes few."""
        del but
        cut = len(self._key("x")) - 1
        found = self._ask(
            prefix, lambda store, key: [meta for batch in store.list(prefix=key or None) for meta in batch]
        )
        entries = (
            Entry(meta["path"][cut:], meta["size"], round(meta["last_modified"].timestamp() * 1e6) * 1000)
            for meta in found
        )
        return sorted(entries, key=lambda entry: entry.name)

    def folders(self, prefix: str = "") -> list[str]:
        """Return the first parts of names of more parts below ``prefix/``."""
        return sorted(name.rpartition("/")[2] for name in self._in(prefix)["common_prefixes"])

    def files(self, prefix: str = "") -> list[str]:
        """Return the names of one part below ``prefix/``."""
        return sorted(meta["path"].rpartition("/")[2] for meta in self._in(prefix)["objects"])

    def files_after(self, prefix: str, after: str) -> list[str]:
        """Return the names of the objects in ``prefix`` that sort after a name: a request for every thousand."""
        cut = len(self._key(f"{prefix}/x" if prefix else "x")) - 1
        offset = self._key("/".join(part for part in (prefix, after) if part))
        batches = self._ask(prefix, lambda store, key: list(store.list(prefix=key or None, offset=offset)))
        names = (meta["path"][cut:] for batch in batches for meta in batch)
        return sorted(name for name in names if name > after and "/" not in name)

    def _in(self, prefix: str) -> ListResult[Sequence[ObjectMeta]]:
        return self._ask(prefix, lambda store, key: store.list_with_delimiter(prefix=key or None))

    def put(self, name: str, data: bytes, *, lasting: bool = True) -> None:
        """Write an object."""
        del lasting
        self._ask(name, lambda store, key: store.put(key, data, use_multipart=False), what="written")

    def put_new(self, name: str, data: bytes) -> bool:
        """Write an object by a conditional request."""
        from obstore.exceptions import AlreadyExistsError  # noqa: PLC0415  most runs stay on this machine

        with suppress(AlreadyExistsError):
            self._ask(name, lambda store, key: store.put(key, data, mode="create", use_multipart=False), what="written")
            return True
        return False

    def workshop(self) -> AbstractContextManager[Path]:
        """Return a context: a temporary directory of this machine."""
        return make_scratch_directory()

    def put_files(self, prefix: str, directory: Path) -> None:
        """Upload the files of a directory, several at once."""

        def upload(path: Path) -> None:
            name = "/".join(part for part in (prefix, path.relative_to(directory).as_posix()) if part)
            self._ask(name, lambda store, key: store.put(key, path), what="written")

        map_concurrently(self.url, upload, sorted(path for path in directory.rglob("*") if path.is_file()))

    def checksum(self, name: str) -> Checksum | None:
        """Return size and sha256 of an object."""
        size, digest = 0, hashlib.sha256()
        with suppress(MissingFileError):
            for piece in self.pieces(name):
                size += len(piece)
                digest.update(piece)
            return Checksum(size, digest.hexdigest())
        return None

    def delete(self, name: str) -> None:
        """Remove an object."""
        with suppress(FileNotFoundError):
            self._ask(name, lambda store, key: store.delete(key), what="written")

    def local(self, name: str, checksum: Checksum) -> Path:
        """Return the cached copy of an object with this content; `StoreError` where the object is gone or another."""

        def fetch(path: Path) -> None:
            digest = hashlib.sha256()
            with path.open("wb") as target:
                for piece in self.pieces(name):
                    digest.update(piece)
                    target.write(piece)
            if digest.hexdigest() != checksum.sha256:
                raise StoreError(
                    f"{self.where(name)}: its sha256 is {digest.hexdigest()[:12]}…, expected {checksum.sha256[:12]}…"
                )

        return fetch_cached(checksum.sha256, fetch)

    def pieces(self, name: str) -> Iterator[bytes]:
        """Yield an object piece by piece; `StoreError` where there is none, or another one takes its place meanwhile."""

        def get(store: ObjectStore, key: str) -> tuple[ObjectMeta, bytes]:
            found = store.get(key)
            return found.meta, bytes(found.bytes()) if found.meta["size"] <= _PIECE_BYTES else b""

        with _convert_missing(self.where(name)):
            meta, whole = self._ask(name, get)
            if whole:
                yield whole
                return
            options: GetOptions = {"if_match": meta["e_tag"]} if meta["e_tag"] else {}
            for start in range(0, meta["size"], _PIECE_BYTES):
                options["range"] = (start, min(start + _PIECE_BYTES, meta["size"]))
                yield self._ask(name, lambda store, key: bytes(store.get(key, options=options).bytes()))

    def _ask(self, name: str, request: Callable[[ObjectStore, str], T], what: str = "read") -> T:
        key = self._key(name)
        return ask_store(self.where(name), lambda store: request(store, key), what=what)

    def _key(self, name: str) -> str:
        """Return the name in the bucket of what is called ``name`` here."""
        return "/".join(part for part in (split_bucket(self.url)[1], name) if part)


@contextmanager
def _convert_missing(where: str) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise MissingFileError(where) from None


_MOST_BYTES = 8_000_000_000
_SHARE_UNSEEN = 64
"""The cache may be larger than its bound by one part in so many: looking at all of its files takes time."""
_unseen_bytes = [float("inf")]
"""What this process has put there since it last looked."""
_IN_USE_S = 60.0
"""What was used so lately stays: another process may be about to open it."""


def fetch_cached(key: str, fetch: Callable[[Path], object]) -> Path:
    """Return the file of a key; where there is none, ``fetch`` writes it. `StoreError`: the cache cannot be written."""
    path = _find_cache_path(key)
    if _is_there(path):
        return path
    temporary = path.with_name(f"{path.name}-{os.getpid()}-{threading.get_ident()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fetch(temporary)
        put = temporary.stat()
        # Nothing is synced, and what a killed process leaves goes in its turn: whoever reads it proves it.
        temporary.replace(path)
    except OSError as error:
        told = f"{path}: cannot be written ({error.strerror or error}); TCPIPE_CACHE names another place for what is fetched"
        raise StoreError(told) from error
    finally:
        with suppress(OSError):
            temporary.unlink()
    _unseen_bytes[0] += put.st_size
    if _unseen_bytes[0] * _SHARE_UNSEEN > (most := _read_cache_limit()):
        _make_room(path.parent.parent, most, now=put.st_mtime)
        _unseen_bytes[0] = 0
    return path


def is_cached(key: str) -> bool:
    """Tell whether there is a file of a key, which then stays for a while."""
    return _is_there(_find_cache_path(key))


def _is_there(path: Path) -> bool:
    with suppress(FileNotFoundError, NotADirectoryError):
        os.utime(path)
        return True
    return False


def _find_cache_path(key: str) -> Path:
    digest = hashlib.sha256(key.encode()).hexdigest()
    return _find_cache_directory() / digest[:2] / digest


def _find_cache_directory() -> Path:
    if given := os.environ.get("TCPIPE_CACHE"):
        return Path(given)
    base = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))  # noqa: PTH111  also without a home
    if base.is_absolute() and os.access(next(of for of in (base, *base.parents) if of.exists()), os.W_OK):
        return base / "tcpipe"
    return Path(tempfile.gettempdir()) / f"tcpipe-cache-{os.getuid()}"


def _read_cache_limit() -> int:
    given = os.environ.get("TCPIPE_CACHE_BYTES", str(_MOST_BYTES))
    if not given.isdecimal():
        raise UsageError(f"TCPIPE_CACHE_BYTES is {given!r}, expected a number of bytes")
    return int(given)


def _make_room(directory: Path, most: int, *, now: float) -> None:
    """Remove what was not used for longest until the bound holds."""
    files = []
    for path in directory.glob("??/*"):
        with suppress(OSError):
            seen = path.stat()
            files.append((seen.st_mtime, seen.st_size, path))
    total = sum(size for _, size, _ in files)
    for used, size, path in sorted(files):
        if total <= most or now - used < _IN_USE_S:
            return
        path.unlink(missing_ok=True)
        total -= size


_FETCHES_AT_ONCE = 4
"""Files that are read side by side: a disk gives no more, and two cores hash 1 to 3 GB a second."""


def find_wrong_files(place: Place, checksums: Mapping[str, Checksum], names: Iterable[str]) -> list[str]:
    """Return a line for each file at a place that is not what a card has of it; all sizes are compared before a file is read.

    Parameters
    ----------
    place : where the files lie.
    checksums : what the card has of them, by name.
    names : which of them.
    """
    names = list(names)
    sizes = [line for name in names if (line := _check_size(place, name, checksums.get(name)))]
    if sizes:
        return sizes
    with ThreadPoolExecutor(_FETCHES_AT_ONCE) as pool:
        return [line for line in pool.map(lambda name: _check_digest(place, name, checksums[name]), names) if line]


def _check_size(place: Place, name: str, wanted: Checksum | None) -> str | None:
    size, where = place.size(name), place.where(name)
    if size is None or wanted is None:
        return find_wrong_checksum(where, None if size is None else Checksum(size, ""), wanted)
    return None if size == wanted.size_bytes else f"{where}: {size} bytes, expected {wanted.size_bytes}"


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
