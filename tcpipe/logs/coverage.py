"""How much of a drive a topic covers, as the log's index tells it: its messages, and the span between the first and the last."""

from __future__ import annotations

from collections.abc import Iterable

from tcpipe.logs.topics import Topic

_LITTLE_SPAN = 0.1
_LITTLE_COUNT = 0.01
"""Sensors that could play one role differ in rate, but not a hundredfold: 1 Hz of GNSS against 20 Hz, 10 Hz of odometry against 200 Hz."""


def covering_little(topics: Iterable[Topic], rivals: Iterable[Topic]) -> frozenset[str]:
    """Return which topics, by name, cover less than a tenth of a rival's span, or hold less than a hundredth of its messages.

    What the index does not tell speaks against nobody.
    """
    listed = list(rivals)
    most_s = max((_span_s(rival) or 0.0 for rival in listed), default=0.0)
    most = max((rival.message_count or 0 for rival in listed), default=0)
    return frozenset(topic.name for topic in topics if _is_little(topic, most_s, most))


def _is_little(topic: Topic, most_s: float, most: int) -> bool:
    span_s, count = _span_s(topic), topic.message_count
    short = span_s is not None and span_s < _LITTLE_SPAN * most_s
    return short or (count is not None and count < _LITTLE_COUNT * most)


def coverage(topic: Topic) -> str:
    """Return ``658 messages over 65.7 s``, as far as the index tells."""
    span_s = _span_s(topic)
    count = "some messages" if topic.message_count is None else f"{topic.message_count} messages"
    return count if span_s is None else f"{count} over {span_s:.1f} s"


def _span_s(topic: Topic) -> float | None:
    if topic.start_ns is None or topic.end_ns is None:
        return None
    return (topic.end_ns - topic.start_ns) / 1e9
