"""Claims of the tasks of an array (``--shard I/N``): one task works on a log, and another takes over the log of a killed one.

::

    spool/claims/<log>-<n>.json    the n-th task that works on a log: its process, and when the claim expires unless it is renewed

A task claims a log before it begins, renews the claim while it lives, and removes it when the log is committed. Claims only save time:
two tasks that ingest one log, also at once, make the same files and one run.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Literal

from tcpipe.errors import StoreError
from tcpipe.formats.commits import Process
from tcpipe.formats.json_files import parse_typed_json, to_json
from tcpipe.formats.place import Place
from tcpipe.formats.run_documents import SPOOL
from tcpipe.pipeline.calls import identify_process, is_alive

LEASE_S = 120.0
"""A claim expires after this time. Where clocks differ by more, two tasks do the same work; nothing worse happens."""

Held = Literal["mine", "theirs", "given up"]


@dataclass(frozen=True, slots=True)
class Claim:
    """A task that works on a log, and until when that holds [ns since 1970]."""

    process: Process
    log: str
    until_ns: int

    def is_live(self) -> bool:
        """Return whether the claim has not expired and its process has not ended, as far as can be seen from here."""
        return is_alive(self.process) is not False and time.time_ns() < self.until_ns


class Claims:
    """The claims of one task; see `hold_claims`."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._process = identify_process()
        self._held: dict[str, tuple[str, int]] = {}
        self._lock = threading.Lock()

    def claim(self, key: str, log: str, *, take_over: bool, most: int) -> Held:
        """Claim a log; with ``take_over`` also one whose claim is no longer live, unless ``most`` tasks have tried it."""
        if key in self._held:
            return "mine"
        for number in range(1, most + 1):
            name = f"{key}-{number}.json"
            with self._lock:
                if self._place.put_new(name, self._encode(log)):
                    self._held[key] = log, number
                    return "mine"
            if not take_over:
                return "theirs"
            claim = self._read(name)
            if claim is None or claim.is_live():
                return "theirs"
        return "given up"

    def release(self, key: str) -> None:
        """Remove a claim, and those of killed tasks on the same log; one that cannot be removed expires."""
        with self._lock, suppress(StoreError):
            _, number = self._held.pop(key, ("", 0))
            for last in range(number, 0, -1):
                self._place.delete(f"{key}-{last}.json")

    def renew(self) -> None:
        """Write all claims again, with the full time until they expire."""
        for key in list(self._held):
            with self._lock, suppress(StoreError):
                if key in self._held:
                    log, number = self._held[key]
                    self._place.put(f"{key}-{number}.json", self._encode(log))

    def release_all(self) -> None:
        """Remove all claims of this task."""
        for key in list(self._held):
            self.release(key)

    def remove_expired(self) -> None:
        """Remove the claims that killed tasks left."""
        for name in self._place.files():
            claim = self._read(name)
            if claim is not None and not claim.is_live():
                self._place.delete(name)

    def _encode(self, log: str) -> bytes:
        return to_json(Claim(self._process, log, time.time_ns() + int(LEASE_S * 1e9))).encode()

    def _read(self, name: str) -> Claim | None:
        data = self._place.read(name)
        return None if data is None else parse_typed_json(data, Claim, self._place.where(name))


@contextmanager
def hold_claims(store: Place) -> Iterator[Claims]:
    """Yield the claims of this task; a thread renews them until the block ends, which removes them."""
    claims, ended = Claims(store.below(f"{SPOOL}/claims")), threading.Event()

    def renew() -> None:
        while not ended.wait(LEASE_S / 4):
            claims.renew()

    thread = threading.Thread(target=renew, daemon=True)
    thread.start()
    try:
        yield claims
    finally:
        ended.set()
        claims.release_all()
