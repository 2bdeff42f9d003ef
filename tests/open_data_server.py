"""A catalogue of open data and its rasters over https on this machine, with the faults that servers have."""

import json
import re
import ssl
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path


@dataclass
class OpenDataServer:
    """What is there by path, and what becomes of it."""

    root: Path
    files: dict[str, bytes] = field(default_factory=dict)
    faults: dict[str, object] = field(default_factory=dict)
    """By path: a status; ``whole`` (ranges are ignored), ``cut``, ``slow``, ``unversioned``, ``changing``, or a URL to redirect to."""
    requests: list[tuple[str, str | None]] = field(default_factory=list)
    """Path with query and range of each."""
    port: int = 0

    @property
    def host(self):
        return f"localhost:{self.port}"

    @property
    def url(self):
        return f"https://{self.host}"

    @property
    def env(self):
        """Of a command that is to trust this server's certificate."""
        return {"SSL_CERT_FILE": str(self.root / "certificate.pem"), "TCPIPE_CACHE": str(self.root / "cache")}

    def put(self, path, content):
        self.files[path] = content if isinstance(content, bytes) else json.dumps(content).encode()
        return self.url + path

    def sent(self, path):
        """Ranges that were asked of a path."""
        return [of for name, of in self.requests if name == path]


class _Handler(BaseHTTPRequestHandler):
    known: OpenDataServer
    timeout = 1.0

    def do_GET(self):
        server, path = self.known, self.path.partition("?")[0]
        ranged = self.headers["Range"]
        server.requests.append((self.path, ranged))
        content, fault = server.files.get(self.path, server.files.get(path)), server.faults.get(path)
        if isinstance(fault, list):
            fault = fault.pop(0) if fault else None
        if content is None or isinstance(fault, int):
            self.send_error(fault if content is not None else 404)
            return
        if isinstance(fault, str) and "://" in fault:
            self.send_response(302)
            self.send_header("Location", fault)
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        first, last = 0, len(content) - 1
        if ranged and fault != "whole":
            first, last = (int(of) for of in re.fullmatch(r"bytes=(\d+)-(\d+)", ranged).groups())
            last = min(last, len(content) - 1)
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {first}-{last}/{len(content)}")
        else:
            self.send_response(200)
        if fault != "unversioned":
            self.send_header(
                "ETag", f'"{len(server.requests) if fault == "changing" else sha256(content).hexdigest()[:16]}"'
            )
        body = content[first : last + 1]
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if fault == "slow":
            for at in range(0, len(body), 1000):
                self.wfile.write(body[at : at + 1000])
                self.wfile.flush()
                time.sleep(0.02)
            return
        self.wfile.write(body[: len(body) // 2] if fault == "cut" else body)

    def log_message(self, *_):
        """Print nothing."""


class _QuietServer(ThreadingHTTPServer):
    def handle_error(self, *_):
        """A client that goes away is part of the test."""


@contextmanager
def serve_open_data(root: Path) -> Iterator[OpenDataServer]:
    """Serve over https, with a certificate of its own for localhost."""
    key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-keyout", str(root / "key.pem")]
    name = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
    subprocess.run(
        ["openssl", "req", "-x509", *key, "-out", str(root / "certificate.pem"), "-days", "30", *name],
        check=True,
        capture_output=True,
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(root / "certificate.pem", root / "key.pem")
    known = OpenDataServer(root)
    with _QuietServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"known": known})) as server:
        server.socket = context.wrap_socket(server.socket, server_side=True, do_handshake_on_connect=False)
        known.port = server.server_address[1]
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield known
        finally:
            server.shutdown()
            thread.join()
