"""The largest losses of drives, by entry of the distance breakdown; the catalogue of findings says how to avoid each (``lost-...``)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from tcpipe.tables.catalogue import read_threshold
from tcpipe.tables.findings import Finding, Subject, make_finding

KEPT = "kept"
"""The entry of metres that are in use."""
_MOST_LOSSES = 10
_WORTH_M = 0.05


def make_loss_code(reason: str) -> str:
    """Return the code of the finding on metres that were lost for a reason, as ``below_full_speed``."""
    return f"lost-{reason.replace('_', '-')}"


def find_losses(breakdown_m: Mapping[str, float], subject: Subject) -> list[Finding]:
    """Return the findings on losses of more than a twentieth of the distance [m], the largest first; none of a robot that did not move."""
    total_m = sum(breakdown_m.values())
    if total_m < read_threshold("no-segments", "min_driven_m"):
        return []
    least_m = read_threshold("lost-gap", "min_lost_fraction") * total_m
    lost = sorted(breakdown_m.items(), key=lambda item: -item[1])
    return [
        make_finding(make_loss_code(reason), subject, lost_m=lost_m, lost_fraction=lost_m / total_m)
        for reason, lost_m in lost
        if reason != KEPT and lost_m > least_m
    ]


@dataclass(frozen=True, slots=True)
class StoreLoss:
    """Metres that are in no segment for one reason."""

    reason: str
    metres: float
    share: float
    """Of all metres driven [1]."""
    runs: int
    """Runs that lost metres so."""


def find_largest_losses(ledgers_m: Iterable[Mapping[str, float]]) -> tuple[StoreLoss, ...]:
    """Return the ten largest losses of runs, by their ledgers [m], the largest first."""
    metres, of_runs = Counter[str](), Counter[str]()
    for distance_by_reason_m in ledgers_m:
        metres.update(distance_by_reason_m)
        of_runs.update(reason for reason, lost_m in distance_by_reason_m.items() if lost_m >= _WORTH_M)
    total = sum(metres.values())
    lost = [(reason, lost_m) for reason, lost_m in metres.most_common() if reason != KEPT and of_runs[reason]]
    return tuple(StoreLoss(reason, lost_m, lost_m / total, of_runs[reason]) for reason, lost_m in lost[:_MOST_LOSSES])
