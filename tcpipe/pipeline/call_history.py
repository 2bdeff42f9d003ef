"""What calls of ingest and build-dataset did and took, and estimates from that."""

from __future__ import annotations

import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from tcpipe.execution import read_cluster_cpu_s
from tcpipe.formats.commits import CallRecord
from tcpipe.store import Store

INGEST, BUILD = "ingest", "build-dataset"


@dataclass(frozen=True, slots=True)
class Rates:
    """What work takes: CPU seconds and bytes written, for a byte of log or for a sample; and CPU seconds of a call, whatever it does."""

    cpu_s: float
    written_bytes: float
    call_s: float


MEASURED = {INGEST: Rates(0.2e-6, 1.1, 0.7), BUILD: Rates(180e-6, 4_300.0, 1.5)}
"""Of drives without a camera, on one core of 2025, and of patches of three layers and 40 px (docs/how-to/nights.md)."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """What is to be expected: work, time and room."""

    of: str
    amount: int
    """Bytes of log, or samples."""
    wall_s: float
    written_bytes: int
    source: str
    """What it was taken from."""

    def __str__(self) -> str:
        """Return it as one line."""
        amount = format_bytes(self.amount) if self.of == "logs" else f"{self.amount} {self.of}"
        return f"{amount}: about {format_duration(self.wall_s)} and {format_bytes(self.written_bytes)} ({self.source})"


@dataclass(frozen=True, slots=True)
class Stopwatch:
    """When a call began: by the wall [ns since 1970], by a clock that only runs, and in CPU seconds."""

    begin_ns: int
    running_s: float
    cpu_s: float


def start_stopwatch() -> Stopwatch:
    """Return that a call begins now."""
    return Stopwatch(time.time_ns(), time.monotonic(), _read_cpu_s())


def measure_call(watch: Stopwatch, call: CallRecord) -> CallRecord:
    """Return a call with what it took."""
    begin = datetime.fromtimestamp(watch.begin_ns / 1e9, UTC)
    return replace(
        call,
        begin=begin.isoformat(timespec="milliseconds"),
        wall_s=round(time.monotonic() - watch.running_s, 3),
        cpu_s=round(_read_cpu_s() - watch.cpu_s, 3),
    )


def estimate(calls: Sequence[CallRecord], command: str, amount: int, *, jobs: int) -> Estimate:
    """Return what work will take: by the calls that did the like, or by what was measured elsewhere.

    What was measured counts as one more call, of as much work as takes as long as a call alone: few samples tell little of a million.
    """
    like = [call for call in calls if call.command == command and _parse_amount(call)]
    of = "logs" if command == INGEST else "samples"
    rates, source = MEASURED[command], "by figures measured elsewhere: this store has no history of it"
    if like:
        done, alone = sum(_parse_amount(call) for call in like), rates.call_s / rates.cpu_s
        more_s = sum(max(0.0, call.cpu_s - rates.call_s) for call in like)
        written = sum(call.written_bytes for call in like) + rates.written_bytes * alone
        rates = Rates((more_s + rates.call_s) / (done + alone), written / (done + alone), rates.call_s)
        source = f"by {len(like)} earlier call{'s' * (len(like) > 1)}"
    return Estimate(of, amount, rates.call_s + rates.cpu_s * amount / jobs, int(rates.written_bytes * amount), source)


def stored_bytes(store: Store, run_ids: Sequence[str]) -> int:
    """Return what runs take in the store [byte]."""
    return sum(entry.size_bytes for run_id in run_ids for entry in store.runs_place.entries(run_id))


def format_duration(seconds: float) -> str:
    """Return a duration in words."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def format_bytes(count: float) -> str:
    """Return a size in words."""
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:.0f} B"


def _parse_amount(call: CallRecord) -> int:
    return call.done_bytes if call.command == INGEST else call.counts.get("samples", 0)


def _read_cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(of.ru_utime + of.ru_stime for of in used) + read_cluster_cpu_s()
