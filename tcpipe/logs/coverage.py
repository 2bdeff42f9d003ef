"""How much of a drive a topic covers, as the log's index tells it: its messages, and the time between them without long silences."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import accumulate

from tcpipe.logs.topics import Topic

LITTLE_SPAN = 0.5
"""A sensor that was silent for more than half of the drive does not win by its name."""
LITTLE_SPAN_OF_POWER = 0.1
"""What tells propulsion apart and what tells a whole battery are not of one quantity: there coverage weighs less."""
_SILENCE_NS, _SILENT_PERIODS = 5_000_000_000, 10
_LITTLE_COUNT = 0.01
"""Sensors that could play one role differ in rate, but not a hundredfold: 1 Hz of GNSS against 20 Hz, 10 Hz of odometry against 200 Hz."""


def covering_little(
    topics: Iterable[Topic], rivals: Iterable[Topic], *, little_span: float = LITTLE_SPAN
) -> frozenset[str]:
    """Return which topics, by name, cover less than such a share of what a rival covers, or hold less than a hundredth of its messages.

    What the index does not tell speaks against nobody.
    """
    listed = list(rivals)
    least_s = little_span * max((_covered_s(rival) or 0.0 for rival in listed), default=0.0)
    least = _LITTLE_COUNT * max((rival.message_count or 0 for rival in listed), default=0)
    return frozenset(topic.name for topic in topics if _is_little(topic, least_s, least))


def silence_ns(spans_ns: Sequence[tuple[int, int]], count: int | None) -> int:
    """Return how long a topic was silent [ns], by the spans (first, last time) of those pieces of a log that hold messages of it.

    Silences below 5 s, or below ten of its mean periods, are none.
    """
    if len(spans_ns) < 2 or not count:
        return 0
    rising = sorted(spans_ns)
    ends = list(accumulate((end for _, end in rising), max))
    least_ns = max(_SILENCE_NS, _SILENT_PERIODS * (ends[-1] - rising[0][0]) // count)
    pauses = (start - end for (start, _), end in zip(rising[1:], ends, strict=False))
    return sum(pause for pause in pauses if pause > least_ns)


def _is_little(topic: Topic, least_s: float, least: float) -> bool:
    span_s, count = _covered_s(topic), topic.message_count
    return (span_s is not None and span_s < least_s) or (count is not None and count < least)


def coverage(topic: Topic) -> str:
    """Return ``658 messages over 65.7 s``, as far as the index tells."""
    span_s = _span_s(topic)
    count = "some messages" if topic.message_count is None else f"{topic.message_count} messages"
    silent = f", silent for {topic.silent_ns / 1e9:.1f} s of them" if topic.silent_ns else ""
    return count if span_s is None else f"{count} over {span_s:.1f} s{silent}"


def _covered_s(topic: Topic) -> float | None:
    span_s = _span_s(topic)
    return None if span_s is None else span_s - topic.silent_ns / 1e9


def _span_s(topic: Topic) -> float | None:
    if topic.start_ns is None or topic.end_ns is None:
        return None
    return (topic.end_ns - topic.start_ns) / 1e9
