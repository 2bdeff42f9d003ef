"""An object store in a directory, over HTTP: as much of S3 as a place takes, without authentication."""

import re
import socket
import threading
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape, unescape

FORBIDDEN, SKEWED = "forbidden", "skewed"
"""Bucket without read access, and bucket that answers that the clock is wrong."""
_DENIALS = {FORBIDDEN: "AccessDenied", SKEWED: "RequestTimeTooSkewed"}

READ_ONLY = "read-only"


class Fetched(list[str]):
    """The objects fetched so far, one a request, and their bytes.

    The next ``cuts`` answers with an object break off in the middle; the next ``lost`` objects are written, and nobody is told.
    Until ``away_until`` (`time.monotonic`) no request has an answer; of names with ``busy`` in them no object is taken.
    """

    sent_bytes = 0
    cuts = 0
    lost = 0
    requests = 0
    away_until = 0.0
    busy = ""


class _Server(ThreadingHTTPServer):
    def __init__(self, root: Path) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.root = root
        self.fetched = Fetched()
        self.writing = threading.Lock()

    def verify_request(self, *_: object) -> bool:
        return time.monotonic() >= self.fetched.away_until


class _Handler(BaseHTTPRequestHandler):
    server: "_Server"

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_PUT(self) -> None:
        self.server.fetched.requests += 1
        data = self.rfile.read(int(self.headers["Content-Length"]))
        bucket, _, name = unquote(urlsplit(self.path).path).lstrip("/").partition("/")
        path = self.server.root / bucket / name
        if self.server.fetched.busy and self.server.fetched.busy in name:
            self._send(503, b"<Error><Code>SlowDown</Code></Error>")
            return
        if bucket == READ_ONLY:
            self._send(403, b"<Error><Code>AccessDenied</Code></Error>")
            return
        with self.server.writing:
            path.parent.mkdir(parents=True, exist_ok=True)
            new = path.with_name(f".{threading.get_ident()}")
            new.write_bytes(data)
            new.rename(path)
        if self.server.fetched.lost:
            self.server.fetched.lost -= 1
            self.close_connection = True
            self.connection.shutdown(socket.SHUT_RDWR)
            return
        self._send(200, b"")

    def do_DELETE(self) -> None:
        self.server.fetched.requests += 1
        self._delete(unquote(urlsplit(self.path).path).lstrip("/"))
        self._send(204, b"")

    def do_POST(self) -> None:
        self.server.fetched.requests += 1
        text = self.rfile.read(int(self.headers["Content-Length"])).decode()
        bucket = urlsplit(self.path).path.lstrip("/")
        names = re.findall("<Key>(.*?)</Key>", text)
        for name in names:
            self._delete(f"{bucket}/{unescape(name)}")
        deleted = "".join(f"<Deleted><Key>{name}</Key></Deleted>" for name in names)
        self._send(200, f"<DeleteResult>{deleted}</DeleteResult>".encode())

    def _delete(self, name: str) -> None:
        with suppress(FileNotFoundError, NotADirectoryError, IsADirectoryError):  # there is no such object
            (self.server.root / name).unlink()

    def _answer(self, *, with_body: bool) -> None:
        self.server.fetched.requests += 1
        parts = urlsplit(self.path)
        bucket, _, name = unquote(parts.path).lstrip("/").partition("/")
        if bucket in _DENIALS:
            self._send(403, f"<Error><Code>{_DENIALS[bucket]}</Code></Error>".encode(), with_body=with_body)
        elif not name and with_body:
            self._list(self.server.root / bucket, parse_qs(parts.query))
        elif (self.server.root / bucket / name).is_file():
            self.server.fetched.extend([name] if with_body else [])
            path = self.server.root / bucket / name
            self._send_part(path.read_bytes(), int(path.stat().st_mtime), with_body=with_body)
        else:
            self._send(404, b'<?xml version="1.0"?>\n<Error><Code>NoSuchKey</Code></Error>', with_body=with_body)

    def _list(self, bucket: Path, query: dict[str, list[str]]) -> None:
        if bucket.is_dir():
            asked = (query.get(name, [""])[0] for name in ("prefix", "delimiter"))
            self._send(200, _listing(bucket, *asked))
        else:
            self._send(404, b"<Error><Code>NoSuchBucket</Code></Error>")

    def _send_part(self, data: bytes, modified_s: int, *, with_body: bool) -> None:
        tag = {"ETag": f'"{zlib.crc32(data)}"', "Last-Modified": formatdate(modified_s, usegmt=True)}
        if self.headers["If-Match"] not in (None, tag["ETag"]):
            self._send(412, b"<Error><Code>PreconditionFailed</Code></Error>")
            return
        wanted = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers["Range"] or "")
        if wanted is None:
            self._send(200, data, tag, with_body=with_body)
        elif (start := int(wanted[1])) >= len(data):
            self._send(416, b"<Error><Code>InvalidRange</Code></Error>")
        else:
            end = min(int(wanted[2]) + 1, len(data))
            self._send(206, data[start:end], {"Content-Range": f"bytes {start}-{end - 1}/{len(data)}", **tag})

    def _send(self, status: int, body: bytes, more: dict[str, str] | None = None, *, with_body: bool = True) -> None:
        self.send_response(status)
        more = {"ETag": '"1"', "Last-Modified": formatdate(1_600_000_000, usegmt=True), **(more or {})}
        for key, value in more.items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if with_body:
            cut = status in (200, 206) and self.server.fetched.cuts > 0
            self.server.fetched.cuts -= cut
            self.server.fetched.sent_bytes += len(body)
            self.wfile.write(body[: len(body) // 2] if cut else body)

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@contextmanager
def object_store(root: Path) -> Iterator[tuple[dict[str, str], Fetched]]:
    """Serve each directory below ``root`` as a bucket; yield the environment that leads there, and what was fetched so far."""
    server = _Server(root)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    environment = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{server.server_port}",
        "AWS_SKIP_SIGNATURE": "true",
        "AWS_REGION": "us-east-1",
        "NO_PROXY": "127.0.0.1",
    }
    try:
        yield environment, server.fetched
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def _listing(bucket: Path, prefix: str, delimiter: str) -> bytes:
    names = sorted(path.relative_to(bucket).as_posix() for path in bucket.rglob("*") if path.is_file())
    names = [name for name in names if name.startswith(prefix)]
    deeper = {name for name in names if delimiter and delimiter in name[len(prefix) :]}
    contents = "".join(
        f"<Contents><Key>{escape(name)}</Key><LastModified>{_format_time(int((bucket / name).stat().st_mtime))}</LastModified>"
        f"<Size>{(bucket / name).stat().st_size}</Size></Contents>"
        for name in names
        if name not in deeper
    )
    folders = sorted({prefix + name[len(prefix) :].partition(delimiter)[0] + delimiter for name in deeper})
    contents += "".join(f"<CommonPrefixes><Prefix>{escape(name)}</Prefix></CommonPrefixes>" for name in folders)
    return f"<ListBucketResult><IsTruncated>false</IsTruncated>{contents}</ListBucketResult>".encode()


def _format_time(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
