"""Verdicts: whether position, time and energy of a run, a dataset, a store or a model are usable, judged from findings alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

from tcpipe.tables.catalogue import Affected, Severity, read_catalogue, read_catalogue_version
from tcpipe.tables.findings import Finding, sort_findings

Grade: TypeAlias = Literal["usable", "usable with care", "not usable"]

GRADES: tuple[Grade, ...] = ("usable", "usable with care", "not usable")
PREDICTED: tuple[Affected, ...] = ("time", "energy")
"""Labels that models predict."""
_GRADE_OF: Mapping[Severity, Grade] = {"error": "not usable", "warning": "usable with care"}


@dataclass(frozen=True, slots=True)
class Verdict:
    """A grade each for position, time and energy, and the findings that decided, the worst first."""

    position: Grade = "usable"
    time: Grade = "usable"
    energy: Grade = "usable"
    reasons: tuple[Finding, ...] = ()
    catalogue: str = field(default_factory=read_catalogue_version)
    """Version of the catalogue that judged."""

    @property
    def worst(self) -> Grade:
        """The worst of the three grades."""
        return max((self.position, self.time, self.energy), key=GRADES.index)


def judge(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict: each label has the grade of the worst finding that affects it."""
    catalogue = read_catalogue()
    decisive = (of for of in findings if of.severity != "note" and of.code in catalogue and catalogue[of.code].affects)
    reasons = tuple(sort_findings(decisive))
    grades: dict[Affected, Grade] = {}
    for finding in reversed(reasons):
        grades |= dict.fromkeys(catalogue[finding.code].affects, _GRADE_OF[finding.severity])
    return Verdict(**grades, reasons=reasons)


def judge_by_code(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict of many runs together: of each code the worst finding alone is a reason."""
    verdict, worst = judge(findings), dict[str, Finding]()
    for finding in verdict.reasons:
        worst.setdefault(finding.code, finding)
    return replace(verdict, reasons=tuple(worst.values()))


def judge_again(verdict: Verdict, findings: Iterable[Finding]) -> Verdict:
    """Return a verdict that was stored; where another catalogue judged it, the verdict of this one."""
    return verdict if verdict.catalogue == read_catalogue_version() else judge(findings)
