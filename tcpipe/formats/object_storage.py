"""Logs in object storage (``s3://``, ``gs://``, ``az://``, ``http(s)://``, ``file://``), read by range or copied.

The home of obstore. Credentials, region and endpoint come from the environment, as the store's own tools take them
(``AWS_…``), and from an ``aws`` profile.
"""

from __future__ import annotations

import configparser
import multiprocessing
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import unquote

from tcpipe.errors import LogError, StoreError, TcpipeError, UsageError, hide_secrets, split_secrets
from tcpipe.formats.atomic import Location, describe_full_disk, make_scratch_directory

if TYPE_CHECKING:
    from obstore import GetOptions, ObjectMeta
    from obstore.store import ObjectStore

T = TypeVar("T")
U = TypeVar("U")

_SETTINGS = ("AWS_", "GOOGLE_", "AZURE_", "HTTP", "NO_PROXY", "TCPIPE_RETRY_MINUTES")
_URL = re.compile(r"[a-z][a-z0-9+.-]*://", re.IGNORECASE)
_ENDPOINT = re.compile(r"https?://([\w.-]+|\[[0-9a-f:]+\])(:\d{1,5})?(/[\w./-]*)?", re.IGNORECASE)
_PIECE_BYTES = 1 << 24  # size of a request for a part of a large file [byte]
_AT_ONCE = 8
# Schemes with percent-encoded names; URLs of object stores are not encoded.
_PERCENT_ENCODED = ("file", "http", "https")
# The first request of a process waits so long for an answer, and is repeated for so long: a user may be watching.
_FIRST_S, _FIRST_RETRY_S = 4.0, 1.0
# Time for which obstore repeats later requests [min], unless TCPIPE_RETRY_MINUTES is set: a store may restart.
_RETRY_MINUTES = "10"
_MAX_RETRIES = 10_000  # more than fit into that time: the time alone decides
_DENIED = (
    "169.254.169.254", "Account must be specified", "401 Unauthorized", "403 Forbidden", "Missing AccessKeyId", "Missing SecretAccessKey"
)  # fmt: skip
"""Messages of the libraries if credentials are missing (also those of a cloud machine) or wrong."""
_NO_ANSWER = {
    "ConnectionRefused": "connection refused",
    "dns error": "the name of the host is not known",
    "InvalidCertificate": "the certificate of the host is not valid",
    "InvalidContentType": "the host does not use TLS: http:// instead of https://",
    "kind: Timeout": "no answer in time",
    "TimedOut": "no answer in time",
}
"""Texts of obstore on a broken connection, and the message for each."""
_CODE = re.compile(r"<Code>(\w+)</Code>")
_STATUS = re.compile(r"\b([45]\d\d) [A-Z][A-Za-z ]*(?=: )")
_ADDRESS = re.compile(r"https?://(?:[^\s/@]*@)?[^\s/?)]+")
_REFUSED = {
    "RequestTimeTooSkewed": "the clock of this machine is wrong; set it",
    "SignatureDoesNotMatch": "the secret key does not belong to the access key",
    "InvalidAccessKeyId": "the store does not know the access key",
    "ExpiredToken": "the credentials have expired",
}
"""Error codes that give the reason for denied access."""
_CREDENTIALS = {
    "s3": "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE; AWS_SKIP_SIGNATURE=true for public data; AWS_REGION; "
    "AWS_ENDPOINT_URL",
    "gs": "GOOGLE_APPLICATION_CREDENTIALS, or GOOGLE_SKIP_SIGNATURE=true for what is public",
    "az": "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY, or AZURE_SKIP_SIGNATURE=true for what is public",
}


@dataclass(frozen=True, slots=True)
class StoredObject:
    """An object: its name in the store, size [byte] and modification time [ns], and the tag that its content has."""

    url: str
    bucket: str
    """Or directory or server."""
    query: str
    """Parameters of the query of a presigned URL."""
    name: str
    size_bytes: int
    modified_ns: int
    tag: str | None

    def ranges(self, spans: Sequence[tuple[int, int]]) -> list[memoryview]:
        """Return the bytes of each range, with several requests in parallel."""
        return run_side_by_side(self._range, spans)

    def copy(self, to: Path) -> None:
        """Write the whole object to a file; `LogError` as in `ranges`, and if the disk is full."""
        try:
            with to.open("wb") as target:
                for span in split_into_pieces(self.size_bytes):
                    target.write(self._range(span))
        except OSError as error:
            raise LogError(
                f"{self.url}: it cannot be copied ({describe_full_disk(error) or error.strerror})"
            ) from error
        os.utime(to, ns=(self.modified_ns, self.modified_ns))

    def _range(self, span: tuple[int, int]) -> memoryview:
        """Return one span of the object in the version that was listed."""
        from obstore.exceptions import PreconditionError  # noqa: PLC0415  most runs stay on this machine

        options: GetOptions = {"range": span, "if_match": self.tag} if self.tag else {"range": span}

        def get(store: ObjectStore) -> memoryview:
            try:
                data = memoryview(store.get(self.name, options=options).bytes()).cast("B")
            except PreconditionError:
                raise LogError(f"{self.url}: changed while it was read; run it again") from None
            if len(data) != span[1] - span[0]:
                raise OSError(f"the store gives {len(data)} bytes for those from {span[0]} to {span[1]}")
            return data

        return ask_store(self.url, get, LogError, bucket=self.bucket, query=self.query)


def split_into_pieces(size_bytes: int) -> Iterator[tuple[int, int]]:
    """Yield start and stop of each piece of a file that is read or copied piece by piece."""
    for start in range(0, size_bytes, _PIECE_BYTES):
        yield start, min(start + _PIECE_BYTES, size_bytes)


def is_url(text: Location) -> bool:
    """Return whether a text names something in object storage rather than a path."""
    return _URL.match(str(text)) is not None


def make_absolute(place: Location) -> str:
    """Return an absolute path, or an unchanged URL."""
    return str(place) if is_url(place) else str(Path(place).absolute())


def is_bucket(text: Location) -> bool:
    """Return whether a text is a URL in a bucket, which can be listed and written."""
    return str(text).rstrip("/").startswith(("s3://", "gs://", "az://"))


def split_url(url: str, *, one_object: bool = False) -> tuple[str, str]:
    """Return a URL as it is shown and stored, and its query: only the server of a presigned URL gets that.

    A user name or password, and the query of anything but one ``http(s)`` object, is a `UsageError`.
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


def format_path(path: Location) -> str:
    """Return a path or the URL of a log as it is shown and stored."""
    return split_url(str(path), one_object=True)[0] if is_url(path) else str(path)


def is_presigned(path: Location) -> bool:
    """Return whether this is a URL with a query, without which it cannot be read again."""
    return is_url(path) and bool(split_url(str(path), one_object=True)[1])


def _describe_credentials(scheme: str) -> str:
    """Return the instruction for credentials, which a URL may not contain."""
    variables = _CREDENTIALS.get(scheme.lower())
    return f"set {variables}" if variables else "give the presigned URL of a log, or copy the files to this machine"


@contextmanager
def lay_out_objects(
    url: str, *, wanted: Callable[[str], bool], by_range: tuple[str, ...]
) -> Iterator[tuple[Path, dict[Path, StoredObject]]]:
    """Represent an object, or the requested objects below a prefix, as files in a temporary directory during the block.

    Yields the path, and, by path, the objects with empty placeholders of their size; others
    are copied.

    Objects whose names end as in ``by_range`` get empty placeholders of their size; all others that are
    ``wanted`` are copied.

    `LogError`: there is no such object, or it cannot be read; errors inside the block have the URL in place of
    the path.
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
    """Create placeholders of the objects at or below a URL: files with their names, sizes and times."""
    shown, query = split_url(url, one_object=True)
    _lay_out_stand_ins(shown, query, directory, wanted)
    return _place_of(shown, directory)


def _place_of(url: str, directory: Path) -> Path:
    name = split_bucket(url)[1]
    return directory / name if name else directory


def _lay_out_stand_ins(
    url: str, query: str, directory: Path, wanted: Callable[[str], bool]
) -> dict[Path, StoredObject]:
    """Create placeholders, and return their objects."""
    found = ask_store(url, lambda store: list(_iterate_objects(store, url, query, wanted)), LogError, query=query)
    if not found:
        raise LogError(f"{url}: there is no such object, and no log below it")
    laid = {_place(stored.name, directory): stored for stored in found}
    try:
        for path, stored in laid.items():
            with path.open("wb") as target:
                target.truncate(stored.size_bytes)
            os.utime(path, ns=(stored.modified_ns, stored.modified_ns))
    except OSError as error:
        raise LogError(
            f"{url}: its local copy cannot be created ({describe_full_disk(error) or error.strerror})"
        ) from error
    return laid


# By bucket and environment: whether the last request had an answer. Workers begin with True: their parent had one.
_has_answered: dict[object, bool] = {}


def ask_store(
    url: str,
    request: Callable[[ObjectStore], T],
    error: type[TcpipeError] = StoreError,
    *,
    what: str = "read",
    bucket: str = "",
    query: str = "",
) -> T:
    """Return the result of a request that reads or writes an object.

    Without an answer the first request of a command fails within 5 s; later ones, and those of worker processes, are
    repeated for minutes. After one of them has failed, the next ones fail soon, too, until the store answers again. An
    error is one line; `FileNotFoundError` (no such object) and `AlreadyExistsError` pass.
    """
    from obstore.exceptions import AlreadyExistsError, BaseError  # noqa: PLC0415

    bucket = bucket or split_bucket(url)[0]
    settings = tuple(sorted((key, value) for key, value in os.environ.items() if key.upper().startswith(_SETTINGS)))
    key = bucket, query, settings
    is_first = not _has_answered.get(key, multiprocessing.parent_process() is not None)
    try:
        result = request(_connect(bucket, query, settings, is_first=is_first))
    except (BaseError, OSError, ValueError) as found:
        code = _CODE.search(str(found))
        is_answer = isinstance(found, FileNotFoundError | AlreadyExistsError) and error is not LogError
        _has_answered[key] = is_answer and not (code and code[1] == "NoSuchBucket")
        if _has_answered[key]:
            raise
        reason = _describe_store_error(url, found, code and code[1], what)
        raise error(f"{url}: it cannot be {what} ({reason})") from None
    _has_answered[key] = True
    return result


def run_side_by_side(function: Callable[[T], U], items: Sequence[T]) -> list[U]:
    """Return the result of a function that queries a store for each item, with several queries in parallel."""
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        return list(pool.map(function, items) if len(items) > 1 else map(function, items))


def _describe_store_error(url: str, error: Exception, code: str | None, what: str) -> str:
    """Return the store's answer in plain words, and what to check."""
    from obstore.exceptions import BaseError, PermissionDeniedError, UnauthenticatedError  # noqa: PLC0415

    text, scheme = str(error), url.partition("://")[0].lower()
    denied = isinstance(error, PermissionDeniedError | UnauthenticatedError) or any(
        pattern in text for pattern in _DENIED
    )
    if denied and scheme in _CREDENTIALS:
        return _describe_denial(scheme, text, code, what)
    if code == "NoSuchBucket":
        return "there is no such bucket"
    if isinstance(error, FileNotFoundError):
        return "there is no such object"
    if not isinstance(error, BaseError):  # of this module
        return text
    if scheme == "file":
        return "the operating system does not allow it, or it is no file"
    status = _STATUS.search(text)
    return f"the store answers {status[0]}{f', {code}' if code else ''}" if status else _describe_no_answer(error)


def _describe_denial(scheme: str, text: str, code: str | None, what: str) -> str:
    if code in _REFUSED:
        return _REFUSED[code]
    has_key = any(os.environ.get(name) for name in ("AWS_ACCESS_KEY_ID", "AWS_PROFILE"))
    if code == "AccessDenied" and (what == "written" or has_key):
        return "the credentials do not allow it"
    if not code and "403" in text and scheme == "s3" and has_key:
        return "the store rejects the credentials, or the clock of this machine is wrong"
    return f"the store requires credentials; set {_CREDENTIALS[scheme]}"


def _describe_no_answer(error: Exception) -> str:
    """Return the address that does not answer, the error, and what to check."""
    text = str(error)
    address, status = _ADDRESS.search(text), _STATUS.search(text)
    problem = next((words for pattern, words in _NO_ANSWER.items() if pattern in text), "the connection broke")
    problem = f"it answers {status[0]}" if status else problem
    where = hide_secrets(address[0]) if address else "the store"
    return f"no answer from {where}: {problem}; check that it runs and that the address is right"


def split_bucket(url: str) -> tuple[str, str]:
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


_PROFILE_KEYS = {
    "aws_access_key_id": "access_key_id",
    "aws_secret_access_key": "secret_access_key",
    "aws_session_token": "session_token",
}
_ENDPOINT_VARIABLES = ("AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT")
_PROFILE_LOCATIONS = {
    "region": ("region", ("AWS_REGION", "AWS_DEFAULT_REGION")),
    "endpoint_url": ("endpoint", _ENDPOINT_VARIABLES),
}
"""By entry of a profile: obstore's name for it, and the environment variables that take precedence."""
_OTHER_CREDENTIALS = (
    *("AWS_ACCESS_KEY_ID", "AWS_SKIP_SIGNATURE", "AWS_WEB_IDENTITY_TOKEN_FILE"),
    *("AWS_CONTAINER_CREDENTIALS_RELATIVE_URI", "AWS_CONTAINER_CREDENTIALS_FULL_URI"),
)
"""Environment variables that take precedence over the keys of a profile."""


def read_aws_profile(environment: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the settings of the profile ``AWS_PROFILE`` (or ``default``) that are not in the environment.

    `ValueError`: there is no profile of that name, or it has no keys (single sign-on, a role, a program that gives
    them).
    """
    wanted = environment.get("AWS_PROFILE")
    name, home = wanted or "default", Path(environment.get("HOME", "~")).expanduser() / ".aws"
    credentials = Path(environment.get("AWS_SHARED_CREDENTIALS_FILE", home / "credentials")).expanduser()
    config = Path(environment.get("AWS_CONFIG_FILE", home / "config")).expanduser()
    sections = (
        _read_section(config, name if name == "default" else f"profile {name}"),
        _read_section(credentials, name),
    )
    if wanted and sections == (None, None):
        raise ValueError(f"{credentials} and {config} have no profile {name}, which AWS_PROFILE names")
    found = {**(sections[0] or {}), **(sections[1] or {})}
    locations = {
        key: found[entry]
        for entry, (key, given) in _PROFILE_LOCATIONS.items()
        if entry in found and not environment.keys() & given
    }
    if environment.keys() & _OTHER_CREDENTIALS:
        return locations
    keys = {key: found[entry] for entry, key in _PROFILE_KEYS.items() if entry in found}
    if wanted and not {"access_key_id", "secret_access_key"} <= keys.keys():
        export = f'eval "$(aws configure export-credentials --profile {name} --format env)"'
        raise ValueError(f"the profile {name} contains no keys; run: {export}")
    return locations | keys


def _read_section(path: Path, name: str) -> Mapping[str, str] | None:
    parser = configparser.RawConfigParser(default_section="")
    try:
        parser.read(path, encoding="utf-8")
    except (configparser.Error, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read as an AWS configuration ({type(error).__name__})") from None
    return dict(parser[name]) if parser.has_section(name) else None


@lru_cache(maxsize=64)
def _connect(container: str, query: str, settings: tuple[tuple[str, str], ...], *, is_first: bool) -> ObjectStore:
    """Return a bucket, directory or server, one for each setting of the environment; presigned URLs keep the query."""
    import obstore  # noqa: PLC0415

    del settings
    scheme, _, bucket = container.partition("://")
    if not bucket:
        raise ValueError(f"it contains no bucket; expected {scheme}://bucket/name")
    for name in _ENDPOINT_VARIABLES:
        value = os.environ.get(name) or os.environ.get(name.lower())
        if scheme == "s3" and value and not _ENDPOINT.fullmatch(value):
            raise ValueError(f"{name} is {value!r}, expected http://host or https://host, with :port where it has one")
    options: dict[str, Any] = {}
    if scheme != "file":  # who names an endpoint without TLS means it
        client = {"allow_http": True, "connect_timeout": timedelta(seconds=3)}
        client |= {"timeout": timedelta(seconds=_FIRST_S)} if is_first else {}
        given = os.environ.get("TCPIPE_RETRY_MINUTES", _RETRY_MINUTES)
        if not re.fullmatch(r"\d{1,5}(\.\d*)?", given):
            raise ValueError(
                f"TCPIPE_RETRY_MINUTES is {given!r}, expected a number of minutes, such as {_RETRY_MINUTES}"
            )
        limit_s = 60.0 * float(given)
        limit_s = min(limit_s, _FIRST_RETRY_S) if is_first else limit_s
        backoff = {"init_backoff": timedelta(milliseconds=100), "max_backoff": timedelta(seconds=3), "base": 2}
        retry = {"max_retries": _MAX_RETRIES, "retry_timeout": timedelta(seconds=limit_s), "backoff": backoff}
        options = {"retry_config": retry, "client_options": client}
    options |= read_aws_profile() if scheme == "s3" else {}
    if query:  # also for the host of a bucket: the query contains the credentials
        return obstore.store.HTTPStore.from_url(f"{container}?{query}", **options)
    return obstore.store.from_url(container, **options)


def _iterate_objects(store: ObjectStore, url: str, query: str, wanted: Callable[[str], bool]) -> Iterator[StoredObject]:
    """Yield the object of a name; without one, the wanted objects below it."""
    name = split_bucket(url)[1]
    if query:  # presigned for one object and method: neither HEAD nor a list is allowed
        if name:
            yield _make_stored_object(url, query, name, store.get(name, options={"range": (0, 1)}).meta)
        return
    if name:
        try:
            yield _make_stored_object(url, query, name, store.head(name))
        except (FileNotFoundError, IsADirectoryError):
            pass
        else:
            return
    for listed in store.list(prefix=name or None):
        yield from (
            _make_stored_object(url, query, name, meta) for meta in listed if wanted(PurePosixPath(meta["path"]).name)
        )


def _make_stored_object(url: str, query: str, name: str, meta: ObjectMeta) -> StoredObject:
    path, tag = str(meta["path"]), meta.get("e_tag")
    bucket, url = split_bucket(url)[0], url.rstrip("/") + path.removeprefix(name)
    return StoredObject(url, bucket, query, path, int(meta["size"]), read_modified_ns(meta), tag)


def read_modified_ns(meta: ObjectMeta) -> int:
    """Return when an object was written [ns since 1970]; stores have microseconds at most."""
    return round(meta["last_modified"].timestamp() * 1e6) * 1000


def _place(object_name: str, directory: Path) -> Path:
    name = PurePosixPath(object_name)
    if name.is_absolute() or ".." in name.parts:
        raise LogError(f"{object_name}: an object of this name is not read")
    place = directory / name
    place.parent.mkdir(parents=True, exist_ok=True)
    return place
