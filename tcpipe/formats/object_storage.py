"""Logs in object storage (``s3://``, ``gs://``, ``az://``, ``http(s)://``, ``file://``): read by range, or copied to this machine.

The home of obstore. Credentials, region and endpoint come from the environment, as the store's own tools take them (``AWS_…``).
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from tcpipe.errors import LogError, TcpipeError, UsageError, split_secrets
from tcpipe.formats.atomic import describe_full_disk, make_scratch_directory

if TYPE_CHECKING:
    from obstore import GetOptions, ObjectMeta
    from obstore.store import ObjectStore

_URL = re.compile(r"[a-z][a-z0-9+.-]*://", re.IGNORECASE)
_ENDPOINT = re.compile(r"https?://([\w.-]+|\[[0-9a-f:]+\])(:\d{1,5})?(/[\w./-]*)?", re.IGNORECASE)
_PIECE_BYTES = 1 << 24
"""What is copied comes in requests of so many bytes."""
_AT_ONCE = 8
_PERCENT_ENCODED = ("file", "http", "https")
"""Schemes whose names are written with percent signs; object stores' own tools write them as they are."""
_RETRIES: dict[str, Any] = {
    "max_retries": 6,
    "retry_timeout": timedelta(seconds=30),
    "backoff": {"init_backoff": timedelta(milliseconds=100), "max_backoff": timedelta(seconds=1), "base": 2},
}
"""A store that does not answer is told after less than 5 s."""
_DENIED = (
    "169.254.169.254", "Account must be specified", "401 Unauthorized", "403 Forbidden", "Missing AccessKeyId", "Missing SecretAccessKey"
)  # fmt: skip
"""What is said where credentials are not set (a cloud machine's own are asked for, in vain), or wrong."""
_CODE = re.compile(r"<Code>(\w+)</Code>")
_STATUS = re.compile(r"\b[45]\d\d [A-Z][A-Za-z ]*(?=: )")
"""After it follows what the server wrote, which may repeat the query."""
_REFUSED = {
    "RequestTimeTooSkewed": "the clock of this machine is wrong; set it",
    "SignatureDoesNotMatch": "the secret key does not belong to the access key",
    "InvalidAccessKeyId": "the store does not know the access key",
    "ExpiredToken": "the credentials have expired",
}
"""Codes of denial that say more than that it is one."""
_CREDENTIALS = {
    "s3": "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true for what is public; AWS_REGION; AWS_ENDPOINT_URL",
    "gs": "GOOGLE_APPLICATION_CREDENTIALS, or GOOGLE_SKIP_SIGNATURE=true for what is public",
    "az": "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY, or AZURE_SKIP_SIGNATURE=true for what is public",
}


@dataclass(frozen=True, slots=True)
class StoredObject:
    """An object: its name in the store, size [byte] and modification time [ns], and the tag that its content has."""

    store: ObjectStore
    url: str
    name: str
    size_bytes: int
    modified_ns: int
    tag: str | None

    def ranges(self, spans: Sequence[tuple[int, int]]) -> list[memoryview]:
        """Return what lies from each start to its stop, some at once.

        Raises
        ------
        LogError : it cannot be had, also after some attempts, or the object is another than it was.
        """
        with convert_errors(self.url):
            if len(spans) == 1:
                return [self._range(spans[0])]
            with ThreadPoolExecutor(_AT_ONCE) as pool:
                return list(pool.map(self._range, spans))

    def copy(self, to: Path) -> None:
        """Write all of it to a file; `LogError` as `ranges`, and where there is no room."""
        with convert_errors(self.url), to.open("wb") as target:
            for start in range(0, self.size_bytes, _PIECE_BYTES):
                target.write(self._range((start, min(start + _PIECE_BYTES, self.size_bytes))))
        os.utime(to, ns=(self.modified_ns, self.modified_ns))

    def _range(self, span: tuple[int, int]) -> memoryview:
        """Return one span of the object as it was when it was found; obstore asks again for what a broken connection cuts short."""
        from obstore.exceptions import PreconditionError  # noqa: PLC0415  most runs stay on this machine

        options: GetOptions = {"range": span, "if_match": self.tag} if self.tag else {"range": span}
        try:
            data = memoryview(self.store.get(self.name, options=options).bytes()).cast("B")
        except PreconditionError:
            raise LogError(f"{self.url}: changed while it was read; run it again") from None
        if len(data) != span[1] - span[0]:
            raise OSError(f"the store gives {len(data)} bytes for those from {span[0]} to {span[1]}")
        return data


def is_url(text: str | Path) -> bool:
    """Return whether a text names something in object storage rather than a path."""
    return _URL.match(str(text)) is not None


def make_absolute(place: str | Path) -> str:
    """Return a path in full, or a URL as it is."""
    return str(place) if is_url(place) else str(Path(place).absolute())


def is_bucket(text: str | Path) -> bool:
    """Return whether a text is the URL of what lies in a bucket, which can be listed and written."""
    return str(text).rstrip("/").startswith(("s3://", "gs://", "az://"))


def split_url(url: str, *, one_object: bool = False) -> tuple[str, str]:
    """Return a URL as it is shown and stored, and its query: only the server of a presigned URL gets that.

    Raises
    ------
    UsageError : it holds a user name or password, or a query that is not one of an ``http(s)://`` URL of ``one_object``.
    """
    scheme, slashes, rest = url.partition("://")
    shown, query = split_secrets(scheme, rest)
    public = f"{scheme}{slashes}{shown}"
    if shown + query != rest:
        raise UsageError(f"{public}: a URL may not contain a user name or password; {_describe_credentials(scheme)}")
    query = query.partition("#")[0].removeprefix("?")
    if query and not (one_object and scheme.lower() in ("http", "https")):
        what = "only the http:// or https:// URL of one log may have a query (?…)"
        raise UsageError(f"{public}: {what}; {_describe_credentials(scheme)}")
    return public, query


def format_path(path: str | Path) -> str:
    """Return a path or the URL of a log as it is shown and stored."""
    return split_url(str(path), one_object=True)[0] if is_url(path) else str(path)


def is_presigned(path: str | Path) -> bool:
    """Return whether this is a URL with a query: nobody can look there again without it."""
    return is_url(path) and bool(split_url(str(path), one_object=True)[1])


def _describe_credentials(scheme: str) -> str:
    """Return how to give the credentials that a URL may not hold."""
    variables = _CREDENTIALS.get(scheme.lower())
    return f"set {variables}" if variables else "give the presigned URL of a log, or copy the files to this machine"


@contextmanager
def lay_out_objects(
    url: str, *, wanted: Callable[[str], bool], by_range: tuple[str, ...]
) -> Iterator[tuple[Path, dict[Path, StoredObject]]]:
    """Lay out an object, or what is wanted below a prefix, in a temporary directory, until the block ends.

    Yields where it lies, and by path the objects for which there are stand-ins of their size that hold nothing; others are copied.

    Parameters
    ----------
    url : an object (``s3://bucket/drives/run.mcap``), or a prefix (``s3://bucket/drives/bag_directory``).
    wanted : whether an object of this name is laid out where a prefix was given.
    by_range : endings of the names of what is not copied.

    Raises
    ------
    LogError : there is no such object, or it cannot be read. What goes wrong inside the block is told with the URL instead of the path.
    """
    shown, query = split_url(url, one_object=True)
    with make_scratch_directory() as directory:
        laid = _lay_out_stand_ins(shown, query, directory, wanted)
        place = _place_of(shown, directory)
        try:
            for path, stored in laid.items():
                if not path.name.lower().endswith(by_range):
                    stored.copy(path)
            yield place, {path: stored for path, stored in laid.items() if path.name.lower().endswith(by_range)}
        except LogError as error:
            raise type(error)(*(problem.replace(str(place), shown.rstrip("/")) for problem in error.problems)) from None


def make_stand_ins(url: str, directory: Path, *, wanted: Callable[[str], bool]) -> Path:
    """Lay out what lies at or below a URL as files of the right names, sizes and times that hold nothing and take no room.

    Raises
    ------
    LogError : there is no such object, or the store cannot be read.
    """
    shown, query = split_url(url, one_object=True)
    _lay_out_stand_ins(shown, query, directory, wanted)
    return _place_of(shown, directory)


def _place_of(url: str, directory: Path) -> Path:
    name = _split_url(url)[1]
    return directory / name if name else directory


def _lay_out_stand_ins(
    url: str, query: str, directory: Path, wanted: Callable[[str], bool]
) -> dict[Path, StoredObject]:
    """Lay out stand-ins, and return their objects."""
    with convert_errors(url):
        store, name = connect_store(url, query)
        found = list(_iterate_objects(store, url, name, wanted, presigned=bool(query)))
        if not found:
            raise LogError(f"{url}: there is no such object, and no log below it")
        laid = {_place(stored.name, directory): stored for stored in found}
        for path, stored in laid.items():
            with path.open("wb") as target:
                target.truncate(stored.size_bytes)
            os.utime(path, ns=(stored.modified_ns, stored.modified_ns))
    return laid


@contextmanager
def convert_errors(url: str, error: type[TcpipeError] = LogError, *, what: str = "read") -> Iterator[None]:
    """Turn what goes wrong while an object is ``read`` or ``written`` into one line; that it is not there passes as `FileNotFoundError`."""
    from obstore.exceptions import BaseError  # noqa: PLC0415

    try:
        yield
    except (BaseError, OSError, ValueError) as found:
        code = _CODE.search(str(found))
        if isinstance(found, FileNotFoundError) and error is not LogError and not (code and code[1] == "NoSuchBucket"):
            raise
        raise error(
            f"{url}: it cannot be {what} ({_describe_store_error(url, found, code and code[1], what)})"
        ) from None


def _describe_store_error(url: str, error: Exception, code: str | None, what: str) -> str:
    """Return in words what a store, or the operating system, answered."""
    from obstore.exceptions import PermissionDeniedError, UnauthenticatedError  # noqa: PLC0415

    reason = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
    if status := _STATUS.search(reason):
        reason = reason[: status.end()]
    scheme = url.partition("://")[0].lower()
    denied = isinstance(error, PermissionDeniedError | UnauthenticatedError) or any(of in reason for of in _DENIED)
    if code == "NoSuchBucket":
        return "there is no such bucket"
    if denied and code in _REFUSED:
        return _REFUSED[code]
    if denied and code == "AccessDenied" and (what == "written" or os.environ.get("AWS_ACCESS_KEY_ID")):
        return "the credentials do not allow it"
    if denied and not code and "403" in reason and scheme == "s3" and os.environ.get("AWS_ACCESS_KEY_ID"):
        return "the store rejects the credentials, or the clock of this machine is wrong"
    if denied and scheme in _CREDENTIALS:
        return f"the store requires credentials; set {_CREDENTIALS[scheme]}"
    return describe_full_disk(error) or reason


def _refuse_endpoints_that_are_none(scheme: str) -> None:
    """Refuse an endpoint that is no address: obstore would end the process."""
    for name in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT"):
        value = os.environ.get(name) or os.environ.get(name.lower())
        if scheme == "s3" and value and not _ENDPOINT.fullmatch(value):
            raise ValueError(f"{name} is {value!r}, expected http://host or https://host, with :port where it has one")


def _split_url(url: str) -> tuple[str, str]:
    """Return the URL of a bucket, directory or server, and the name of the object or prefix in it."""
    scheme, _, rest = url.partition("://")
    scheme, rest = scheme.lower(), rest.rstrip("/")
    if scheme == "file":
        container, _, name = rest.rpartition("/")
        container = container or "/"
    elif scheme in ("http", "https"):
        container, _, name = rest.rpartition("/") if "/" in rest else (rest, "", "")
    else:
        container, _, name = rest.partition("/")
    return f"{scheme}://{container}", unquote(name) if scheme in _PERCENT_ENCODED else name


def connect_store(url: str, query: str = "") -> tuple[ObjectStore, str]:
    """Return the store, and the name of the object or prefix in it; a presigned URL's server gets its ``query`` with each request."""
    import obstore  # noqa: PLC0415

    url = split_url(url)[0]
    container, name = _split_url(url)
    scheme, _, bucket = container.partition("://")
    if not bucket:
        raise ValueError(f"it names no bucket; expected {scheme}://bucket/name")
    _refuse_endpoints_that_are_none(scheme)
    options: dict[str, Any] = {} if scheme == "file" else {"retry_config": _RETRIES}
    if scheme != "file":  # who names an endpoint without TLS means it
        options["client_options"] = {"allow_http": True, "connect_timeout": timedelta(seconds=3)}
    if query:  # also where the host is a bucket's: the query stands for the credentials
        return obstore.store.HTTPStore.from_url(f"{container}?{query}", **options), name
    return obstore.store.from_url(container, **options), name


def _iterate_objects(
    store: ObjectStore, url: str, name: str, wanted: Callable[[str], bool], *, presigned: bool
) -> Iterator[StoredObject]:
    """Yield the object of a name; where there is none, what is wanted below it."""
    if presigned:  # for one object and method: neither HEAD nor a list is allowed
        if name:
            yield _make_stored_object(store, url, name, store.get(name, options={"range": (0, 1)}).meta)
        return
    if name:
        try:
            yield _make_stored_object(store, url, name, store.head(name))
        except (FileNotFoundError, IsADirectoryError):
            pass
        else:
            return
    for listed in store.list(prefix=name or None):
        yield from (
            _make_stored_object(store, url, name, meta) for meta in listed if wanted(PurePosixPath(meta["path"]).name)
        )


def _make_stored_object(store: ObjectStore, url: str, name: str, meta: ObjectMeta) -> StoredObject:
    path, tag = str(meta["path"]), meta.get("e_tag")
    modified_ns = round(meta["last_modified"].timestamp() * 1e6) * 1000
    return StoredObject(store, url.rstrip("/") + path.removeprefix(name), path, int(meta["size"]), modified_ns, tag)


def _place(object_name: str, directory: Path) -> Path:
    name = PurePosixPath(object_name)
    if name.is_absolute() or ".." in name.parts:
        raise LogError(f"{object_name}: an object of this name is not read")
    place = directory / name
    place.parent.mkdir(parents=True, exist_ok=True)
    return place
