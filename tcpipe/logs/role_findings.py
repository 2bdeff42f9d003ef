"""Findings on roles: those without a topic, topics that are left out, and topics that cannot be decoded."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping

from tcpipe.logs.topics import Topic
from tcpipe.tables.catalogue import Severity
from tcpipe.tables.findings import Finding, Subject, make_finding

_MISSING = {"no-gnss": "gnss", "no-power": "power", "no-imu": "imu", "no-wheel-odometry": "wheel_odometry"}


def find_missing_roles(roles: Collection[str]) -> tuple[Finding, ...]:
    """Return a finding for each role that is not among ``roles`` and without which labels or checks are missing."""
    present = {*roles, "gnss"} if "pose" in roles else roles
    return tuple(make_finding(code, Subject("role", role)) for code, role in _MISSING.items() if role not in present)


def find_left_out(reasons: Mapping[tuple[str, str], str]) -> Iterator[Finding]:
    """Yield a finding for each topic that is not used, by role and topic and with the reason."""
    for (role, name), reason in reasons.items():
        yield make_finding("topic-left-out", Subject("topic", name), names={"role": role, "reason": reason})


def find_undecodable(topics: Iterable[Topic], types: Collection[str]) -> Iterator[Finding]:
    """Yield a finding for each topic that holds data that cannot be decoded: a warning where its type can be used as a role."""
    for topic in topics:
        if topic.problem is not None and topic.message_count != 0:
            yield make_topic_not_decoded(topic, severity="warning" if topic.type_name in types else "note")


def make_topic_not_decoded(topic: Topic, *, severity: Severity = "warning") -> Finding:
    """Return the finding that a topic's messages cannot be decoded."""
    names = {"type": topic.type_name or "?", "encoding": topic.encoding or "?"}
    return make_finding("topic-not-decoded", Subject("topic", topic.name), severity=severity, names=names)
