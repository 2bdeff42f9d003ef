"""Topics in words, for the lines that people read."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from tcpipe.logs.topics import Topic

LISTED = 8
"""Of a long list so many are named."""


def listing(topics: Iterable[Topic], types: Sequence[str] | None = None) -> str:
    """Return topics as ``/name (type, n messages, rate)``, the longest lists cut; those of ``types`` only, where there are any."""
    every = list(topics)
    of_type = [topic for topic in every if types is not None and topic.type_name in types]
    chosen = of_type or every
    shown = ", ".join(_described(topic) for topic in chosen[:LISTED])
    more = f", and {len(chosen) - LISTED} more" if len(chosen) > LISTED else ""
    return shown + more if chosen else "no topic at all"


def _described(topic: Topic) -> str:
    parts = [topic.type_name]
    if topic.message_count is not None:
        parts.append(f"{topic.message_count} messages")
        if topic.start_ns is not None and topic.end_ns is not None and topic.end_ns > topic.start_ns:
            parts.append(f"{(topic.message_count - 1) / (topic.end_ns - topic.start_ns) * 1e9:.3g} Hz")
    return f"{topic.name} ({', '.join(parts)})"


def short_list(topics: Sequence[Topic]) -> str:
    """Return the topics' names, the longest lists cut."""
    shown = ", ".join(topic.name for topic in topics[:LISTED])
    return f"{shown} and {len(topics) - LISTED} more" if len(topics) > LISTED else shown


def list_undecodable(topics: Iterable[Topic]) -> Iterator[str]:
    """Yield one line of the topics that hold data that cannot be decoded, by the reason; none where all can be."""
    by_reason: dict[str, list[Topic]] = {}
    for topic in topics:
        if topic.problem is not None and topic.message_count != 0:
            by_reason.setdefault(topic.problem, []).append(topic)
    if by_reason:
        reasons = "; ".join(f"{short_list(topics)}: {why}" for why, topics in list(by_reason.items())[:LISTED])
        more = f"; {len(by_reason) - LISTED} more reasons" if len(by_reason) > LISTED else ""
        yield f"topics that hold data which cannot be decoded: {reasons}{more}"
