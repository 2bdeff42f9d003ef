"""Requests over https to a list of hosts, and to no other: what a catalogue of open data names is not trusted.

A private address is asked only if it is in the list: a name in the list that leads into a private network has no certificate there. obstore
and most libraries follow any redirect, so this is urllib with each URL checked.
"""

from __future__ import annotations

import ssl
import time
from collections.abc import Iterable
from contextlib import closing
from http.client import HTTPException, HTTPMessage
from typing import IO, Any
from urllib.error import HTTPError, URLError
from urllib.parse import urljoin, urlsplit
from urllib.request import HTTPRedirectHandler, HTTPSHandler, Request, build_opener

from tcpipe import __version__
from tcpipe.errors import MapError

_SILENT_S = 30.0
"""Longest time without a byte."""
_REQUEST_S = 120.0
"""Longest time that a body takes, however slowly it comes."""
_PAUSES_S = (1.0, 4.0, None)
"""After a failed request; None: it was the last."""
_TRY_AGAIN = {429, 500, 502, 503, 504}
_PIECE_BYTES = 1 << 16


class HttpsClient:
    """Makes requests to hosts, each ``name`` or ``name:port``; all replies together have a size that they may have."""

    def __init__(self, hosts: Iterable[str], *, most_bytes: int) -> None:
        self.hosts = frozenset(host.lower() for host in hosts)
        self.left_bytes = self._most_bytes = most_bytes
        self._opener = build_opener(HTTPSHandler(context=ssl.create_default_context()), _CheckedRedirects(self))

    def check_url(self, url: str) -> None:
        """Raise `MapError` for a URL that may not be asked."""
        parts = urlsplit(url)
        if parts.scheme != "https":
            raise MapError(f"{url}: expected an https:// URL; tcpipe opens no other")
        if (host := parts.netloc.lower().removesuffix(":443")) not in self.hosts:
            raise MapError(
                f"{url}: is on {host}, which the catalogue's entry does not name ({', '.join(sorted(self.hosts))}); "
                "if you trust it, add it to hosts in the TOML file that you give with --stac"
            )

    def check_left(self, url: str, wanted_bytes: int) -> None:
        """Raise `MapError` where so many bytes more are too many."""
        if wanted_bytes > self.left_bytes:
            raise MapError(
                f"{url}: would be {wanted_bytes / 1e6:.3g} MB, {self.left_bytes / 1e6:.3g} of {self._most_bytes / 1e6:g} MB a command "
                "are left; name fewer runs with --around, or a smaller --margin"
            )

    def get(self, url: str, *, most: int, span: tuple[int, int] | None = None) -> tuple[bytes, HTTPMessage]:
        """Return the body of a URL, or its bytes from first to last, and the head of the reply; a failed request is made three times.

        `MapError`: it may not be asked, is not there, or is larger, slower or shorter than it may be.
        """
        headers = {"User-Agent": f"tcpipe/{__version__}"} | ({"Range": f"bytes={span[0]}-{span[1]}"} if span else {})
        for pause_s in _PAUSES_S:
            try:
                self.check_url(url)
                self.check_left(url, most)
                with self._opener.open(Request(url, headers=headers), timeout=_SILENT_S) as reply:  # noqa: S310  checked
                    if span and reply.status != 206:
                        remedy = "download it and give it with --height or --ortho"
                        raise MapError(f"{url}: its server ignores ranges and sends the whole file; {remedy}")
                    return self._read(reply, url, most), reply.headers
            except (OSError, HTTPException, ValueError) as error:
                reason: str | BaseException = error
                if isinstance(error, HTTPError):
                    error.close()
                elif isinstance(error, URLError):
                    reason = error.reason
                is_lasting = isinstance(error, HTTPError) and error.code not in _TRY_AGAIN
                if pause_s is None or is_lasting or isinstance(reason, ssl.SSLCertVerificationError | ValueError):
                    raise MapError(f"{url}: cannot be read ({reason or type(reason).__name__})") from None
                time.sleep(pause_s)
        raise AssertionError

    def _read(self, reply: Any, url: str, most: int) -> bytes:
        deadline_s, data = time.monotonic() + _REQUEST_S, b""
        while len(data) <= most and (piece := reply.read1(_PIECE_BYTES)):
            data += piece
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"{len(data)} bytes in {_REQUEST_S:g} s")
        if len(data) > most:
            raise MapError(f"{url}: sends more than {most} bytes, expected at most these; it is no such file")
        if reply.length:
            raise HTTPException(f"ended after {len(data)} of {len(data) + reply.length} bytes")
        self.left_bytes -= len(data)
        return data


class _CheckedRedirects(HTTPRedirectHandler):
    def __init__(self, client: HttpsClient) -> None:
        self._client = client

    def http_error_302(self, req: Request, fp: IO[bytes], code: int, msg: str, headers: HTTPMessage) -> Any:
        with closing(fp):
            self._client.check_url(urljoin(req.full_url, headers["Location"] or ""))
            return super().http_error_302(req, fp, code, msg, headers)

    http_error_301 = http_error_303 = http_error_307 = http_error_308 = http_error_302
