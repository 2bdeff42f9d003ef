"""Findings on a log as a whole: that it is damaged, and that it cannot be ingested."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tcpipe.logs.topics import Topic
from tcpipe.tables.findings import Finding, Subject, make_finding


def find_damaged_log(damage: Sequence[Finding], subject: Subject) -> tuple[Finding, ...]:
    """Return the finding that a log is damaged, which decides exit codes and is acknowledged, whatever the damage is called."""
    places = sum(finding.numbers.get("places_count", 1) for finding in damage)
    return (make_finding("log-damaged", subject, damage_count=places),) if damage else ()


def find_total_loss(topics: Iterable[Topic], damage: Sequence[Finding]) -> tuple[str, ...]:
    """Return the problem that damage leaves no message of any topic, if so: then no sensor is missing, but the file is cut."""
    is_lost = damage and all(topic.message_count == 0 for topic in topics)
    return ("the log is damaged, and no message can be read",) if is_lost else ()


def find_failure(log: str, error: str) -> tuple[Finding, ...]:
    """Return the finding that a log gave no run; ``error`` is the class of the error."""
    return (make_finding("log-failed", Subject("log", log), names={"error": error}),)
