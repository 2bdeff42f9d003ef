"""The verdict as every page shows it: a coloured grade for each label, the reasons with their remedies, the worst first, then notes."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from tcpipe.formats.finding_lines import MOST_LINES, FindingGroup, format_finding, format_group, format_remedy_blocks
from tcpipe.tables.catalogue import AFFECTED, Affected, Severity
from tcpipe.tables.findings import Finding, Grade, Verdict, sort_findings

K = TypeVar("K", bound=Hashable)


@dataclass(frozen=True, slots=True)
class ShownFinding:
    """A finding, or those of one code, as a line, with the recipe that fits in no line below it."""

    severity: Severity
    text: str
    recipe: str


@dataclass(frozen=True, slots=True)
class VerdictBox:
    """What a page shows at its top: ``shown`` in full, ``more`` and ``notes`` folded."""

    grades: tuple[tuple[str, Grade], ...]
    shown: tuple[ShownFinding, ...]
    more: tuple[ShownFinding, ...]
    notes: tuple[ShownFinding, ...]


def show_verdict(verdict: Verdict, findings: Iterable[Finding], labels: Sequence[Affected] = AFFECTED) -> VerdictBox:
    """Return the verdict on a run, a dataset or a model with its findings; the grades are those of ``labels``."""
    return _make_box(verdict, _show(sort_findings(findings)), labels)


def show_groups(
    verdict: Verdict, groups: Iterable[FindingGroup[K]], total: int, *, findings: Iterable[Finding] = ()
) -> VerdictBox:
    """Return the verdict on ``total`` runs with their findings by code; ``findings`` are of all of them together."""
    lines = _show(sort_findings(findings))
    return _make_box(verdict, [*lines, *_show_groups((group, total, "runs") for group in groups)])


def show_mixed_groups(verdict: Verdict, groups: Iterable[tuple[FindingGroup[K], int | None, str]]) -> VerdictBox:
    """Return the verdict on a dataset with its findings by code, each group with the arguments of `format_group`."""
    return _make_box(verdict, _show_groups(groups))


def _show_groups(groups: Iterable[tuple[FindingGroup[K], int | None, str]]) -> list[ShownFinding]:
    return [
        ShownFinding(group.severity, format_group(group, total, what), "\n".join(format_remedy_blocks(group.findings)))
        for group, total, what in groups
    ]


def _show(findings: Iterable[Finding]) -> list[ShownFinding]:
    return [ShownFinding(of.severity, format_finding(of), "\n".join(format_remedy_blocks([of]))) for of in findings]


def _make_box(verdict: Verdict, lines: Sequence[ShownFinding], labels: Sequence[Affected] = AFFECTED) -> VerdictBox:
    found = [line for severity in ("error", "warning") for line in lines if line.severity == severity]
    return VerdictBox(
        grades=tuple((name, getattr(verdict, name)) for name in labels),
        shown=tuple(found[:MOST_LINES]),
        more=tuple(found[MOST_LINES:]),
        notes=tuple(line for line in lines if line.severity == "note"),
    )
