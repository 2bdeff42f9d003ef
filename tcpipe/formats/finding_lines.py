"""Findings as sentences, for the command line, the pages and the documentation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from string import Formatter

import numpy as np

from tcpipe.motion.distance_breakdown import StoreLoss, make_loss_code
from tcpipe.recipe.suggestions import RecipeFragment
from tcpipe.robots import KNOWN_ENERGY
from tcpipe.tables.facts import CAUSES, EnergyBudget
from tcpipe.tables.findings import (
    AFFECTED,
    GRADES,
    WITNESSES_OF_LABEL,
    Affected,
    Finding,
    Findings,
    Remedy,
    Severity,
    Verdict,
    find_entry,
    rank_severity,
    sort_findings,
)

_UNITS: Mapping[str, tuple[str, float]] = {
    "_jpm": (" J/m", 1.0), "_spm": (" s/m", 1.0),
    "_mps2": (" m/s²", 1.0), "_mps": (" m/s", 1.0), "_radps": (" °/s", 180.0 / np.pi), "_rad": ("°", 180.0 / np.pi), "_hz": (" Hz", 1.0),
    "_volt": (" V", 1.0), "_amp": (" A", 1.0), "_watt": (" W", 1.0), "_joule": (" J", 1.0), "_fraction": (" %", 100.0),
    "_m2": (" m²", 1.0), "_bytes": (" MB", 1e-6), "_px": (" px", 1.0), "_deg": ("°", 1.0), "_m": (" m", 1.0), "_s": (" s", 1.0),
}  # fmt: skip
"""Unit as people read it, and the factor to it, by the suffix of a number's name; the first that fits counts."""
MOST_LINES = 8
"""Findings that a command prints; 'tcpipe inspect' lists all."""
_DAMAGE: Mapping[str, str] = {
    "places_count": "{} places", "first_offset": "at byte {}", "lost_messages_count": "{} messages lost", "lost_bytes": "{} lost"
}  # fmt: skip
"""Numbers that follow a line in brackets, where they are more than zero and the template lacks them."""
_EVIDENCE = ("field", "wanted", "joints", "platforms")  # names that are appended, if the template lacks them
_MOST_SUBJECTS = 3
_DIGITS = 3
_LARGEST_PLAIN = 1e6
_SHORT_S = 2.0  # shorter spans are written with tenths of a second


def format_number(name: str, value: float) -> str:
    """Return a number with the unit in its name's suffix and three significant digits; counts are integers."""
    if name.endswith(("_count", "_offset")):
        return f"{value:.0f}"
    unit, factor = next(
        (unit_and_factor for suffix, unit_and_factor in _UNITS.items() if name.endswith(suffix)), ("", 1.0)
    )
    value *= factor
    if not np.isfinite(value) or abs(value) >= _LARGEST_PLAIN:
        return f"{value:.{_DIGITS}g}{unit}"
    digits = max(_DIGITS - 1 - int(np.floor(np.log10(abs(value)))), 0) if value else 0
    text = f"{value:.{min(digits, 6)}f}"
    return f"{text.rstrip('0').rstrip('.') if '.' in text else text}{unit}"


def describe_finding(finding: Finding) -> str:
    """Return the observation in one line, without remedy and code."""
    entry = find_entry(finding.code)
    values = {name: format_number(name, number) for name, number in finding.numbers.items()}
    if finding.span_s is not None:
        begin_s, end_s = finding.span_s
        digits = 0 if end_s - begin_s >= _SHORT_S else 1
        values["span"] = f"{begin_s:.{digits}f} to {end_s:.{digits}f} s"
    missing = dict.fromkeys(entry.fields, "?")  # in a dataset without coordinates, findings have only public values
    line = entry.template.format(**{**missing, **values, **finding.names, "subject": finding.subject.name})
    numbers = finding.numbers.keys() - entry.fields
    details = [f"{name} {finding.names[name]}" for name in _EVIDENCE if name in finding.names.keys() - entry.fields]
    details += [
        text.format(values[name]) for name, text in _DAMAGE.items() if name in numbers and finding.numbers[name]
    ]
    return f"{line} ({', '.join(details)})" if details else line


def describe_remedy(finding: Finding, remedy: Remedy) -> str:
    """Return the action of a remedy with its keys or command as one line; arrays of tables follow separately."""
    purpose = _find_purpose(finding.code, remedy)
    what = [f"'{remedy.command}'"] if remedy.command else []
    what += (
        ["the recipe below"]
        if _is_block(remedy)
        else [_build_recipe_fragment(remedy).inline()]
        if remedy.recipe
        else []
    )
    return f"{purpose}: {' and '.join(what)}" if what else purpose


def _find_purpose(code: str, remedy: Remedy) -> str:
    return find_entry(code).remedies.get(remedy.name) or remedy.name.replace("_", " ")


def list_remedies(findings: Sequence[Finding]) -> list[tuple[str, list[str]]]:
    """Return the remedy of findings of one code: action, commands and recipe lines; or the advice without a remedy."""
    remedies: list[Remedy] = []
    for remedy in chain.from_iterable(finding.remedies for finding in findings):
        if remedy not in remedies:
            remedies.append(remedy)
    code = findings[0].code
    if remedies and len(remedies) <= MOST_LINES:
        return [(_find_purpose(code, remedy), _list_changes(remedy)) for remedy in remedies]
    return [(advice, [])] if (advice := find_entry(code).advice) else []


def _list_changes(remedy: Remedy) -> list[str]:
    recipe = [_build_recipe_fragment(remedy).toml()] if remedy.recipe else []
    return [*([remedy.command] if remedy.command else []), *recipe]


def format_finding(finding: Finding) -> str:
    """Return a finding as one line: the observation, its remedies or the catalogue's advice, and its code."""
    remedies = ". ".join(describe_remedy(finding, remedy) for remedy in finding.remedies)
    remedies = remedies or find_entry(finding.code).advice
    return f"{describe_finding(finding)}{f'. {remedies}' if remedies else ''}".rstrip(".") + f" [{finding.code}]"


def format_remedy_blocks(findings: Iterable[Finding]) -> list[str]:
    """Return the recipes of remedies that need several lines, each once, as lines of a file."""
    remedies = (remedy for finding in findings for remedy in finding.remedies if _is_block(remedy))
    blocks = dict.fromkeys(_build_recipe_fragment(remedy).toml() for remedy in remedies)
    return [line for block in blocks for line in block.splitlines()]


def _is_block(remedy: Remedy) -> bool:
    return any(not isinstance(keys, Mapping) for keys in remedy.recipe.values())


def _build_recipe_fragment(remedy: Remedy) -> RecipeFragment:
    """Return the part of a recipe without checking it: another version may have written it."""
    return RecipeFragment(remedy.recipe, is_checked=True)


def format_findings(findings: Iterable[Finding], *, more: str = "") -> list[str]:
    """Return at most `MOST_LINES` findings as lines, the worst first, then the number of those that ``more`` lists."""
    return format_groups(_make_single_groups(findings), more=more)


def list_findings(findings: Iterable[Finding]) -> list[str]:
    """Return every finding as a line, the worst first, notes too, with the recipe that fits in no line below it."""
    return list_groups(_make_single_groups(findings))


def _make_single_groups(findings: Iterable[Finding]) -> list[FindingGroup]:
    return [FindingGroup(each.code, {each.subject.name: (each,)}) for each in sort_findings(findings)]


def format_verdict(verdict: Verdict) -> str:
    """Return the grades as one line, the worst first: ``energy not usable; position and time usable with care``."""
    labels = {grade: [name for name in AFFECTED if getattr(verdict, name) == grade] for grade in reversed(GRADES)}
    return "; ".join(f"{_join(names)} {grade}" for grade, names in labels.items() if names)


def list_verdict(verdict: Verdict, quantities: Sequence[Affected] = AFFECTED) -> list[str]:
    """Return a line for each label: ``energy 172 ± 7 J/m · confirmed by: slope · usable``; ± is σ of one segment."""
    return [
        " · ".join([*describe_label(name, verdict.find_label(name)), getattr(verdict, name)]) for name in quantities
    ]


def describe_power(verdict: Verdict) -> list[str]:
    """Return idle and driving power, and the energy per metre of known robots, as one line; "" without energy."""
    finding = verdict.find_label("energy")
    if finding is None or "driving_watt" not in finding.numbers:
        return []
    sizes = {name: format_number(name, number) for name, number in finding.numbers.items()}
    idle = f"idle {sizes['idle_watt']}, " if "idle_watt" in sizes else ""
    return [f"power: {idle}driving {sizes['driving_watt']}; known robots: {KNOWN_ENERGY}"]


def describe_label(name: str, finding: Finding | None) -> list[str]:
    """Return the size of a label with its σ, and its witnesses, if known."""
    if finding is None:
        return [name]
    missing = f" ({finding.names['missing']})" if "missing" in finding.names else ""
    size = next((_format_size(key, finding.numbers) for key in finding.numbers if key.startswith("std")), "")
    witnesses = ", ".join(f"{each}{_PROVES.get(each, '')}" for each in finding.names["witnesses"].split(", "))
    return [f"{name}{size}", f"confirmed by: {witnesses}{missing}"]


# Certainty of the scale of power by each witness.
_PROVES = dict.fromkeys(("slope", "charge"), " (to a factor of three)") | {"second_meter": " (to a factor of two)"}


def _format_size(key: str, numbers: Mapping[str, float]) -> str:
    """Return `` 172 ± 7 J/m`` or, for several runs, `` 158 to 190 ± 7 J/m``, with the decimals of σ."""
    std, suffix = numbers[key], key.removeprefix("std")
    digits = max(-int(np.floor(np.log10(std))), 0) if std > 0.0 else 3
    means = [numbers[name] for name in (f"mean{suffix}", f"most{suffix}") if name in numbers]
    values = dict.fromkeys(f"{mean:.{digits}f}" for mean in means)
    return f" {' to '.join(values)}{' ' if values else ''}± {std:.{digits}f}{_UNITS[suffix][0]}"


def _join(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def format_loss(loss: StoreLoss) -> str:
    """Return a loss of distance and its remedy as one line."""
    runs = "1 run" if loss.runs == 1 else f"{loss.runs} runs"
    advice = advise_on_loss(loss.reason)
    return f"{loss.metres:>9.1f} m ({loss.share:.1%}) {loss.reason.replace('_', ' ')} in {runs}{f': {advice}' if advice else ''}"


def advise_on_loss(reason: str) -> str:
    """Return the remedy for a reason of the distance breakdown; "" without one."""
    return find_entry(make_loss_code(reason)).advice


@dataclass(frozen=True)
class FindingGroup:
    """Findings of one code in several runs, logs or maps."""

    code: str
    of: Mapping[str, Findings]
    """By run, log or map."""
    total: int | None = None
    """Number of runs or maps, also of those without such a finding; None where it is not printed."""
    noun: str = "runs"

    @cached_property
    def findings(self) -> list[Finding]:
        """All of them, the worst first."""
        return sort_findings(finding for findings in self.of.values() for finding in findings)

    @cached_property
    def severity(self) -> Severity:
        """The worst of their severities."""
        return min((finding.severity for findings in self.of.values() for finding in findings), key=rank_severity)


def group_findings(
    findings: Iterable[tuple[str, Iterable[Finding]]], total: int | None = None, noun: str = "runs"
) -> list[FindingGroup]:
    """Return the findings of ``total`` runs or maps grouped by code: the worst first, then those of most runs."""
    found: dict[str, dict[str, Findings]] = {}
    for key, each in findings:
        for finding in each:
            findings_by_subject = found.setdefault(finding.code, {})
            findings_by_subject[key] = (*findings_by_subject.get(key, ()), finding)

    def rank(group: FindingGroup) -> tuple[int, int, int]:
        return rank_severity(group.severity), -len(find_entry(group.code).affects), -len(group.of)

    return sorted((FindingGroup(code, grouped, total, noun) for code, grouped in found.items()), key=rank)


def format_group(group: FindingGroup) -> str:
    """Return a group as one line, with its number of runs out of the total if known; of one finding its evidence."""
    findings = group.findings
    if len(group.of) == 1 and len(findings) == 1:
        key, line = next(iter(group.of)), format_finding(findings[0])
        return line if key == findings[0].subject.name else f"{key}: {line}"
    shared = findings[0].remedies if all(finding.remedies == findings[0].remedies for finding in findings) else ()
    remedies = ". ".join(describe_remedy(findings[0], remedy) for remedy in shared)
    details = _describe_range(findings)
    return format_count(group.code, len(group.of), group.total, group.noun, details, remedy=remedies)


def describe_group(group: FindingGroup) -> str:
    """Return the summary of a group of findings: number, subjects and range, without title, remedy and code."""
    findings, key = group.findings, next(iter(group.of))
    if len(group.of) == 1 and len(findings) == 1:
        line = describe_finding(findings[0])
        return line if key == findings[0].subject.name else f"{key}: {line}"
    head = "" if group.total is None else f"{len(group.of)} of {group.total} {group.noun}: "
    return f"{head}{_describe_range(findings)}"


def _describe_range(findings: Sequence[Finding]) -> str:
    subjects = ", ".join(sorted({finding.subject.name for finding in findings})[:_MOST_SUBJECTS])
    return "; ".join(filter(None, (subjects, _format_range(findings))))


def format_count(
    code: str, count: int, total: int | None, what: str = "runs", details: str = "", *, remedy: str = ""
) -> str:
    """Return as one line that ``count`` of ``total`` runs have a finding."""
    head = "" if total is None else f"{count} of {total} {what}: "
    return (
        f"{head}{find_entry(code).title}{f' ({details})' if details else ''}{f'. {remedy}' if remedy else ''} [{code}]"
    )


def _format_range(findings: Sequence[Finding]) -> str:
    """Return the range of the first number that the template names."""
    fields = Formatter().parse(find_entry(findings[0].code).template)
    name = next((name for _, name, _, _ in fields if name in findings[0].numbers), None)
    if name is None:
        return ""
    values = [finding.numbers[name] for finding in findings if name in finding.numbers]
    low, high = format_number(name, min(values)), format_number(name, max(values))
    return low if low == high else f"{low} to {high}"


def format_groups(groups: Iterable[FindingGroup], *, more: str = "") -> list[str]:
    """Return at most `MOST_LINES` groups as lines, the worst first.

    The last line states how many others and notes are listed by the command ``more``.
    """
    printed = _sort_printed(groups)
    problems = [group for group in printed if group.severity != "note"]
    counted = ((max(len(problems) - MOST_LINES, 0), "more finding"), (len(printed) - len(problems), "note"))
    rest = " and ".join(f"{count} {what}{'' if count == 1 else 's'}" for count, what in counted if count)
    return list_groups(problems[:MOST_LINES]) + ([f"and {rest}{f': {more}' if more else ''}"] if rest else [])


def _sort_printed(groups: Iterable[FindingGroup]) -> list[FindingGroup]:
    """Return the groups, the worst first, except those on witnesses, which are lines of the verdict."""
    printed = (group for group in groups if group.code != WITNESSES_OF_LABEL)
    return sorted(printed, key=lambda group: rank_severity(group.severity))


def list_groups(groups: Iterable[FindingGroup]) -> list[str]:
    """Return every group as a line, the worst first, notes too, with the recipe that fits in no line below it."""
    lines = []
    for group in _sort_printed(groups):
        lines += [f"{group.severity}: {format_group(group)}"]
        lines += [f"    {line}" for line in format_remedy_blocks(group.findings)]
    return lines


def format_budget(budget: EnergyBudget) -> str:
    """Return the budget as a sentence: the floor, its causes in order, and the floor with power at 20 Hz if lower."""
    names = {"position": "position", "rate": "power rate", "current": "current noise", "voltage": "voltage"}
    shares = {cause: getattr(budget, cause) for cause in CAUSES}
    causes = ", ".join(
        f"{names[cause]} {100 * shares[cause]:.1f}" for cause in sorted(CAUSES, key=lambda c: -shares[c])
    )
    floor = f"Noise floor of E {100 * budget.total:.1f} % of a segment's mean {budget.mean_energy_joule:.0f} J"
    text = f"{floor}: {causes} (they add in square)"
    if budget.at_20_hz < 0.95 * budget.total:
        text += f"; power at 20 Hz would leave {100 * budget.at_20_hz:.1f} %"
    return text + "."
