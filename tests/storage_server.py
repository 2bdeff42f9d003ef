"""An object store in a directory, over HTTP: as much of S3 as reading and listing objects takes."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

FORBIDDEN = "forbidden"
"""The bucket that nobody may read."""


@contextmanager
def object_store(root: Path) -> Iterator[tuple[dict[str, str], list[str]]]:
    """Serve each directory below ``root`` as a bucket; yield the environment that leads there, and the objects fetched so far."""
    fetched: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_HEAD(self) -> None:
            self._answer(with_body=False)

        def do_GET(self) -> None:
            self._answer(with_body=True)

        def _answer(self, *, with_body: bool) -> None:
            parts = urlsplit(self.path)
            bucket, _, name = unquote(parts.path).lstrip("/").partition("/")
            if bucket == FORBIDDEN:
                self._send(403, b"<Error><Code>AccessDenied</Code></Error>")
            elif not name and with_body:
                self._send(200, _listing(root / bucket, parse_qs(parts.query).get("prefix", [""])[0]))
            elif (root / bucket / name).is_file():
                fetched.extend([name] if with_body else [])
                self._send(200, (root / bucket / name).read_bytes(), with_body=with_body)
            else:
                self._send(404, b'<?xml version="1.0"?>\n<Error><Code>NoSuchKey</Code></Error>', with_body=with_body)

        def _send(self, status: int, body: bytes, *, with_body: bool = True) -> None:
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Last-Modified", formatdate(1_600_000_000, usegmt=True))
            self.send_header("ETag", '"1"')
            self.end_headers()
            if with_body:
                self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    environment = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{server.server_port}",
        "AWS_SKIP_SIGNATURE": "true",
        "AWS_REGION": "us-east-1",
        "NO_PROXY": "127.0.0.1",
    }
    try:
        yield environment, fetched
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def _listing(bucket: Path, prefix: str) -> bytes:
    names = sorted(str(path.relative_to(bucket)) for path in bucket.rglob("*") if path.is_file())
    contents = "".join(
        f"<Contents><Key>{escape(name)}</Key><LastModified>2020-09-13T12:26:40.000Z</LastModified>"
        f"<Size>{(bucket / name).stat().st_size}</Size></Contents>"
        for name in names
        if name.startswith(prefix)
    )
    return f"<ListBucketResult><IsTruncated>false</IsTruncated>{contents}</ListBucketResult>".encode()
