"""Findings as lines for people: the one place that turns them into sentences, for the command line, the pages and the documentation."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from tcpipe.recipe.suggestions import RecipeFragment
from tcpipe.tables.catalogue import Entry, read_catalogue
from tcpipe.tables.findings import Finding, Remedy, sort_findings

K = TypeVar("K", bound=Hashable)

_UNITS: Mapping[str, tuple[str, float]] = {
    "_mps2": (" m/s²", 1.0), "_mps": (" m/s", 1.0), "_radps": (" °/s", 180.0 / np.pi), "_rad": ("°", 180.0 / np.pi), "_hz": (" Hz", 1.0),
    "_volt": (" V", 1.0), "_amp": (" A", 1.0), "_watt": (" W", 1.0), "_joule": (" J", 1.0), "_fraction": (" %", 100.0),
    "_bytes": (" bytes", 1.0), "_px": (" px", 1.0), "_deg": ("°", 1.0), "_m": (" m", 1.0), "_s": (" s", 1.0),
}  # fmt: skip
"""Unit as people read it, and the factor to it, by the suffix of a number's name; the first that fits counts."""
_DIGITS = 3
_LARGEST_PLAIN = 1e6


def format_number(name: str, value: float) -> str:
    """Return a number with the unit of its name's suffix, with three significant digits; one that ends in ``_count`` as a whole number."""
    if name.endswith("_count"):
        return f"{value:.0f}"
    unit, factor = next((of for suffix, of in _UNITS.items() if name.endswith(suffix)), ("", 1.0))
    value *= factor
    if not np.isfinite(value) or abs(value) >= _LARGEST_PLAIN:
        return f"{value:.{_DIGITS}g}{unit}"
    digits = max(_DIGITS - 1 - int(np.floor(np.log10(abs(value)))), 0) if value else 0
    text = f"{value:.{min(digits, 6)}f}"
    return f"{text.rstrip('0').rstrip('.') if '.' in text else text}{unit}"


def describe_finding(finding: Finding) -> str:
    """Return what was observed, in one line without its remedy and code."""
    entry = read_catalogue().get(finding.code)
    if entry is None:  # made by another version
        return f"{finding.subject.name}: {finding.code.replace('-', ' ')}"
    values = {name: format_number(name, number) for name, number in finding.numbers.items()}
    if finding.span_s is not None:
        values["span"] = "{:.0f} to {:.0f} s".format(*finding.span_s)
    missing = dict.fromkeys(entry.fields, "?")  # a redacted finding keeps only what is public
    return entry.template.format(**{**missing, **values, **finding.names, "subject": finding.subject.name})


def describe_title(finding: Finding) -> str:
    """Return what its code means, in a few words."""
    entry = read_catalogue().get(finding.code)
    return entry.title if entry else finding.code.replace("-", " ")


def describe_remedy(finding: Finding, remedy: Remedy) -> str:
    """Return what a remedy does and the keys or the command that do it, in one line."""
    entry = read_catalogue().get(finding.code)
    purpose = (entry.remedies.get(remedy.name) if entry else None) or remedy.name.replace("_", " ")
    what = [f"'{remedy.command}'"] if remedy.command else []
    what += [RecipeFragment(remedy.recipe).inline()] if remedy.recipe else []
    return f"{purpose}: {' and '.join(what)}"


def format_finding(finding: Finding) -> str:
    """Return a finding as one line: what was observed, its first remedy or the catalogue's advice, and its code."""
    entry = read_catalogue().get(finding.code)
    advice = entry.advice if entry else ""
    remedy = "; ".join(describe_remedy(finding, of) for of in finding.remedies) or advice
    return f"{describe_finding(finding)}{f'; {remedy}' if remedy else ''} [{finding.code}]"


def recipe_lines(finding: Finding) -> list[str]:
    """Return the lines of a recipe that the finding's remedies propose, as they stand in a file."""
    return [line for of in finding.remedies if of.recipe for line in RecipeFragment(of.recipe).toml().splitlines()]


def format_findings(findings: Iterable[Finding], *, most: int = 8, more: str = "") -> list[str]:
    """Return at most ``most`` lines, the worst first, then how many others there are and where (``more``) they are listed."""
    ordered = sort_findings(findings)
    shown = [of for of in ordered if of.severity != "note"][:most]
    rest = len(ordered) - len(shown)
    lines = [f"{of.severity}: {format_finding(of)}" for of in shown]
    return lines + (
        [f"and {rest} more {'finding' if rest == 1 else 'findings'}{f': {more}' if more else ''}"] if rest else []
    )


@dataclass(frozen=True, slots=True)
class FindingGroup(Generic[K]):
    """Findings of one code in several runs, logs or maps."""

    code: str
    of: Mapping[K, tuple[Finding, ...]]
    """By run, log or map."""

    @property
    def findings(self) -> list[Finding]:
        """All of them, the worst first."""
        return sort_findings(finding for of in self.of.values() for finding in of)


def group_findings(findings: Iterable[tuple[K, Iterable[Finding]]]) -> list[FindingGroup[K]]:
    """Return the findings grouped by code: the worst first, then those of most runs."""
    found: dict[str, dict[K, tuple[Finding, ...]]] = {}
    for key, each in findings:
        for finding in each:
            of = found.setdefault(finding.code, {})
            of[key] = (*of.get(key, ()), finding)
    groups = [FindingGroup(code, of) for code, of in found.items()]
    order = {
        of.code: number
        for number, of in reversed(list(enumerate(sort_findings(f for g in groups for f in g.findings))))
    }
    return sorted(groups, key=lambda group: (order[group.code], -len(group.of)))


def format_group(group: FindingGroup[K], total: int, what: str = "runs") -> str:
    """Return a group as one line, with how many of ``total`` runs it concerns; of one run alone what was observed there."""
    findings = group.findings
    if len(group.of) == 1 and len(findings) == 1:
        key = next(iter(group.of))
        return f"{key}: {format_finding(findings[0])}"
    entry = read_catalogue().get(group.code)
    title = entry.title if entry else group.code.replace("-", " ")
    subjects = ", ".join(sorted({of.subject.name for of in findings})[:_DIGITS])
    details = "; ".join(filter(None, (subjects, _format_range(entry, findings))))
    return f"{len(group.of)} of {total} {what}: {title} ({details}) [{group.code}]"


def _format_range(entry: Entry | None, findings: Sequence[Finding]) -> str:
    """Return the range of the first number that the template names."""
    name = next((of for of in (findings[0].numbers if entry else ()) if entry and of in entry.fields), None)
    if name is None:
        return ""
    values = [of.numbers[name] for of in findings if name in of.numbers]
    low, high = format_number(name, min(values)), format_number(name, max(values))
    return low if low == high else f"{low} to {high}"
