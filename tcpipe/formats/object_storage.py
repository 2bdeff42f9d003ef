"""Logs in object storage (``s3://``, ``gs://``, ``az://``, ``http(s)://``, ``file://``): copied to this machine, then read as any other.

The home of obstore. Credentials, region and endpoint come from the environment, as the store's own tools take them (``AWS_…``).
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from tcpipe.errors import LogError, TcpipeError
from tcpipe.formats.logs.log_part import no_room

if TYPE_CHECKING:
    from obstore.store import ObjectStore

_URL = re.compile(r"[a-z][a-z0-9+.-]*://", re.IGNORECASE)
_ENDPOINT = re.compile(r"https?://([\w.-]+|\[[0-9a-f:]+\])(:\d{1,5})?(/[\w./-]*)?", re.IGNORECASE)
_PIECE_BYTES = 1 << 24
_PERCENT_ENCODED = ("file", "http", "https")
"""Schemes whose names are written with percent signs; object stores' own tools write them as they are."""
_RETRIES: dict[str, Any] = {
    "max_retries": 6,
    "retry_timeout": timedelta(seconds=30),
    "backoff": {"init_backoff": timedelta(milliseconds=100), "max_backoff": timedelta(seconds=1), "base": 2},
}
"""A store that does not answer is told after less than 5 s."""
_DENIED = ("169.254.169.254", "Account must be specified", "401 Unauthorized", "403 Forbidden")
"""What is said where credentials are not set (a cloud machine's own are asked for, in vain), or wrong."""
_CODE = re.compile(r"<Code>(\w+)</Code>")
_CREDENTIALS = {
    "s3": "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true for what is public; AWS_REGION; AWS_ENDPOINT_URL",
    "gs": "GOOGLE_APPLICATION_CREDENTIALS, or GOOGLE_SKIP_SIGNATURE=true for what is public",
    "az": "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY, or AZURE_SKIP_SIGNATURE=true for what is public",
}


@dataclass(frozen=True, slots=True)
class RemoteFile:
    """An object: its name in the store, size [byte] and modification time [ns]."""

    name: str
    size_bytes: int
    modified_ns: int


def is_url(text: str | Path) -> bool:
    """Return whether a text names something in object storage rather than a path."""
    return _URL.match(str(text)) is not None


@contextmanager
def copied(url: str, *, wanted: Callable[[str], bool]) -> Iterator[Path]:
    """Copy an object, or what is wanted below a prefix, to a temporary directory, and yield where it lies until the block ends.

    Parameters
    ----------
    url
        An object (``s3://bucket/drives/run.mcap``), or a prefix (``s3://bucket/drives/bag_directory``).
    wanted
        Whether an object of this name is copied where a prefix was given.

    Raises
    ------
    LogError
        There is no such object, or it cannot be read. What goes wrong inside the block is told with the URL instead of the copy's path.
    """
    import obstore  # noqa: PLC0415  most runs stay on this machine

    def copy(store: ObjectStore, file: RemoteFile, to: Path) -> None:
        with to.open("wb") as target:
            for piece in obstore.get(store, file.name).stream(min_chunk_size=_PIECE_BYTES):
                target.write(piece)

    with tempfile.TemporaryDirectory(prefix="tcpipe-") as directory:
        place = _laid_out(url, Path(directory), wanted, copy)
        try:
            yield place
        except LogError as error:
            raise type(error)(*(problem.replace(str(place), url.rstrip("/")) for problem in error.problems)) from None


def stand_ins(url: str, directory: Path, *, wanted: Callable[[str], bool]) -> Path:
    """Lay out what `copied` would copy as files of the right names, sizes and times that hold nothing and take no room.

    Raises
    ------
    LogError
        There is no such object, or the store cannot be read.
    """

    def hole(_: ObjectStore, file: RemoteFile, to: Path) -> None:
        with to.open("wb") as target:
            target.truncate(file.size_bytes)

    return _laid_out(url, directory, wanted, hole)


def _laid_out(
    url: str, directory: Path, wanted: Callable[[str], bool], lay: Callable[[ObjectStore, RemoteFile, Path], None]
) -> Path:
    with told(url):
        store, name = connected(url)
        found = list(_found(store, name, wanted))
        if not found:
            raise LogError(f"{url}: there is no such object, and no log below it")
        for file in found:
            to = _place(file, directory)
            lay(store, file, to)
            os.utime(to, ns=(file.modified_ns, file.modified_ns))
    return directory / name if name else directory


@contextmanager
def told(url: str, error: type[TcpipeError] = LogError, *, what: str = "read") -> Iterator[None]:
    """Turn what goes wrong while an object is ``read`` or ``written`` into one line; that it is not there passes as `FileNotFoundError`."""
    from obstore.exceptions import BaseError  # noqa: PLC0415

    try:
        yield
    except (BaseError, OSError, ValueError) as found:
        code = _CODE.search(str(found))
        if isinstance(found, FileNotFoundError) and error is not LogError and not (code and code[1] == "NoSuchBucket"):
            raise
        raise error(f"{url}: it cannot be {what} ({_reason(url, found, code and code[1], what)})") from None


def _reason(url: str, error: Exception, code: str | None, what: str) -> str:
    """Return in words what a store, or the operating system, answered."""
    from obstore.exceptions import PermissionDeniedError, UnauthenticatedError  # noqa: PLC0415

    reason = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
    reason = reason.partition(": <?xml")[0]
    scheme = url.partition("://")[0].lower()
    denied = isinstance(error, PermissionDeniedError | UnauthenticatedError) or any(of in reason for of in _DENIED)
    if code == "NoSuchBucket":
        return "there is no such bucket"
    if denied and code == "AccessDenied" and what == "written":
        return "the credentials that are set do not allow it"
    if denied and scheme in _CREDENTIALS:
        return f"the store wants credentials; set {_CREDENTIALS[scheme]}"
    return no_room(error) or reason


def _refuse_endpoints_that_are_none(scheme: str) -> None:
    """Refuse an endpoint that is no address: obstore would end the process."""
    for name in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT"):
        value = os.environ.get(name) or os.environ.get(name.lower())
        if scheme == "s3" and value and not _ENDPOINT.fullmatch(value):
            raise ValueError(f"{name} is {value!r}, wanted http://host or https://host, with :port where it has one")


def connected(url: str) -> tuple[ObjectStore, str]:
    """Return the store, and the name of the object or prefix in it."""
    import obstore  # noqa: PLC0415

    scheme, _, rest = url.partition("://")
    scheme, rest = scheme.lower(), rest.rstrip("/")
    _refuse_endpoints_that_are_none(scheme)
    if scheme == "file":
        container, _, name = rest.rpartition("/")
        container = container or "/"
    elif scheme in ("http", "https"):
        container, _, name = rest.rpartition("/") if "/" in rest else (rest, "", "")
    else:
        container, _, name = rest.partition("/")
    name = unquote(name) if scheme in _PERCENT_ENCODED else name
    options: dict[str, Any] = {} if scheme == "file" else {"retry_config": _RETRIES}
    if scheme != "file":  # who names an endpoint without TLS means it
        options["client_options"] = {"allow_http": True, "connect_timeout": timedelta(seconds=3)}
    return obstore.store.from_url(f"{scheme}://{container}", **options), name


def _found(store: ObjectStore, name: str, wanted: Callable[[str], bool]) -> Iterator[RemoteFile]:
    """Yield the object of a name; where there is none, what is wanted below it."""
    import obstore  # noqa: PLC0415

    if name:
        try:
            yield _remote_file(obstore.head(store, name))
        except (FileNotFoundError, IsADirectoryError):
            pass
        else:
            return
    for listed in obstore.list(store, prefix=name or None):
        yield from (_remote_file(meta) for meta in listed if wanted(PurePosixPath(meta["path"]).name))


def _remote_file(meta: Any) -> RemoteFile:
    return RemoteFile(str(meta["path"]), int(meta["size"]), round(meta["last_modified"].timestamp() * 1e6) * 1000)


def _place(file: RemoteFile, directory: Path) -> Path:
    name = PurePosixPath(file.name)
    if name.is_absolute() or ".." in name.parts:
        raise LogError(f"{file.name}: an object of this name is not copied")
    place = directory / name
    place.parent.mkdir(parents=True, exist_ok=True)
    return place
