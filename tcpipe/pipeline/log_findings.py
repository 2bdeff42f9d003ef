"""Findings on a log as a whole: that it is damaged, and that it cannot be ingested."""

from __future__ import annotations

from collections.abc import Sequence

from tcpipe.tables.findings import Finding, Subject, make_finding


def find_damage(damage: Sequence[str], subject: Subject) -> tuple[Finding, ...]:
    """Return the finding that a log is damaged, by its lines of damage."""
    return (make_finding("log-damaged", subject, damage_count=len(damage)),) if damage else ()


def find_failure(log: str, error: str) -> tuple[Finding, ...]:
    """Return the finding that a log gave no run; ``error`` is the class of the error."""
    return (make_finding("log-failed", Subject("log", log), names={"error": error}),)
