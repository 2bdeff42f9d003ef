"""Findings: observations in a log, a map or a run, as data, and verdicts, judged from findings alone.

An error, a warning, the reason for a verdict and the cause of an exit code are all a `Finding`. Code that decides
anything about a run reads findings; only the command line and the pages turn them into sentences.

Catalogue of findings (``catalogue.toml``): meaning and remedy of each code, and the thresholds that decide it.
"""

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from hashlib import sha256
from importlib.resources import files
from math import isfinite
from string import Formatter
from typing import Any, Generic, Literal, TypeAlias, TypeVar

Severity: TypeAlias = Literal["error", "warning", "note"]
Affected: TypeAlias = Literal["position", "time", "energy"]
WITNESSES_OF_LABEL = "label-witnesses"
"""Code of the findings on witnesses; their subject is the label."""
Witness: TypeAlias = Literal["wheel_odometry", "visual_odometry", "slope", "charge", "second_meter", "nothing"]
"""Measurement that can confirm a label: other odometry than GNSS (position, time); power needed by slopes, fall of the
battery's charge, or a second meter (energy)."""
NOTHING: Witness = "nothing"

Action: TypeAlias = Literal["kept", "corrected", "inflated", "excluded", "rejected"]
"""How tcpipe treated the subject of a finding; inflated: raised its standard deviations."""

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
AFFECTED: tuple[Affected, ...] = ("position", "time", "energy")


@dataclass(frozen=True, slots=True)
class Entry:
    """One code of the catalogue.

    Attributes
    ----------
    title : words that a reader searches for.
    template : one line; ``{subject}``, ``{span}``, numbers (written with the unit of their suffix) and names of the
        finding.
    severity : error: the affected labels are not usable; warning: usable with care; note: no change of the verdict.
    action : what tcpipe does with the subject by default.
    affects : labels that the finding makes doubtful.
    cause : why this happens.
    advice : what to do where no remedy is known as data.
    remedies : by name, what a recipe fragment or a command of the finding does.
    thresholds : numbers that decide whether the finding is made; the suffix is the unit.
    flag : the quality bit that marks segments for the same reason; "" for none.
    is_problem : whether it makes ``tcpipe ingest`` exit with 3 until it is acknowledged.
    public : numbers and names that a dataset without coordinates keeps.
    words : other words under which readers search.
    """

    title: str
    template: str
    cause: str
    severity: Severity = "warning"
    action: Action = "kept"
    affects: tuple[Affected, ...] = ()
    advice: str = ""
    remedies: Mapping[str, str] = field(default_factory=dict)
    thresholds: Mapping[str, float] = field(default_factory=dict)
    flag: str = ""
    is_problem: bool = False
    public: tuple[str, ...] = ()
    words: tuple[str, ...] = ()

    @property
    def fields(self) -> set[str]:
        """Names that the template needs."""
        return {name for _, name, _, _ in Formatter().parse(self.template) if name}


@cache
def read_catalogue() -> Mapping[str, Entry]:
    """Return the entries by code, in the order of the file."""
    entries = dict[str, Entry]()
    for code, values in tomllib.loads(_read_text()).items():
        fields: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in values.items()
        }
        entries[code] = Entry(**fields)
    return entries


@cache
def _read_text() -> str:
    return files("tcpipe.tables").joinpath("catalogue.toml").read_text(encoding="utf-8")


@cache
def read_catalogue_version() -> str:
    """Return the first digits of the catalogue's hash; a verdict by another catalogue is judged again."""
    return sha256(_read_text().encode()).hexdigest()[:8]


def find_entry(code: str) -> Entry:
    """Return the entry of a code; of an unknown code of another version, an entry from its name."""
    words = code.replace("-", " ")
    return read_catalogue().get(code) or Entry(words, f"{{subject}}: {words}", "")


def read_threshold(code: str, name: str) -> float:
    """Return a number that decides whether a finding is made, in the unit of its suffix."""
    return read_catalogue()[code].thresholds[name]


def rank_severity(severity: Severity) -> int:
    """Return 0 for the worst severity, more for others."""
    return SEVERITIES.index(severity)


F = TypeVar("F")

SubjectKind: TypeAlias = Literal[
    "role", "topic", "frame", "layer", "run", "class", "slope", "file", "log", "map", "dataset", "column", "tag",
    "call", "model", "robot", "split", "label",
]  # fmt: skip


def omit(default: object = None) -> Any:
    """Return a field that the JSON object omits while it has its default (a collection: while it is empty)."""
    omitted = (None, {}, [], ()) if default in ({}, [], ()) else (default,)
    if isinstance(default, dict | list):
        return field(default_factory=type(default), metadata={"json": omitted})
    return field(default=default, metadata={"json": omitted})


@dataclass(frozen=True, slots=True)
class Subject:
    """The thing that a finding is about."""

    kind: SubjectKind
    name: str


@dataclass(frozen=True, slots=True)
class Remedy:
    """A change that removes a finding: keys of the recipe, or a command."""

    name: str
    """Key in the catalogue's ``remedies`` of the finding's code."""
    recipe: Mapping[str, Any] = omit({})
    """Keys by the dotted name of their table; an array of tables as a list."""
    command: str | None = omit()


@dataclass(frozen=True, slots=True)
class Finding:
    """One observation, made by `make_finding`.

    Attributes
    ----------
    code : key in the catalogue.
    span_s : begin and end [s] since the start of the run.
    numbers : by name; the suffix is the unit, as in column names.
    names : other names that the catalogue's template needs: a reference sensor, topics, a unit.
    """

    code: str
    severity: Severity
    subject: Subject
    action: Action
    span_s: tuple[float, float] | None = omit()
    numbers: Mapping[str, float] = omit({})
    names: Mapping[str, str] = omit({})
    remedies: tuple[Remedy, ...] = omit(())

    def __hash__(self) -> int:
        """Return a hash that differs from run to run: of ten thousand runs one by code alone would collide."""
        return hash((self.code, self.subject, self.span_s, frozenset(self.numbers.items())))


Findings: TypeAlias = tuple[Finding, ...]


def make_finding(
    code: str,
    subject: Subject,
    *,
    action: Action | None = None,
    severity: Severity | None = None,
    span_s: tuple[float, float] | None = None,
    names: Mapping[str, str] | None = None,
    remedies: Iterable[Remedy] = (),
    **numbers: float,
) -> Finding:
    """Return a finding that the catalogue knows, with the catalogue's severity and action unless they are given.

    `ValueError` is a bug: the catalogue lacks the code or a remedy, or a number or name of the template is missing.
    """
    entry = read_catalogue().get(code)
    if entry is None:
        raise ValueError(f"the catalogue of findings has no code {code!r}")
    remedies = tuple(remedies)
    given = {*numbers, *(names or {}), "subject"} | ({"span"} if span_s else set())
    problems = [f"the template needs {{{name}}}" for name in sorted(entry.fields - given)]
    problems += [f"it has no remedy {remedy.name!r}" for remedy in remedies if remedy.name not in entry.remedies]
    if problems:
        raise ValueError(f"finding {code}: {'; '.join(problems)}")
    numbers = {name: float(number) for name, number in numbers.items() if isfinite(number)}  # JSON has no others
    return Finding(
        code, severity or entry.severity, subject, action or entry.action, span_s, numbers, dict(names or {}), remedies
    )


def sort_findings(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings without repetitions, the worst first: by severity, then by how many labels they affect."""

    def rank(finding: Finding) -> tuple[int, int]:
        return rank_severity(finding.severity), -len(find_entry(finding.code).affects)

    objects = {id(finding): finding for finding in findings}.values()  # runs share most of them, and a hash takes long
    return sorted(dict.fromkeys(objects), key=rank)


def select_findings(findings: Iterable[Finding], *codes: str) -> list[Finding]:
    """Return the findings of some codes, in their order."""
    return [finding for finding in findings if finding.code in codes]


def is_problem(finding: Finding) -> bool:
    """Return whether a finding causes exit code 3; a note never does."""
    return finding.severity != "note" and find_entry(finding.code).is_problem


def select_problems(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings that are a problem until somebody has acknowledged them."""
    return [finding for finding in findings if is_problem(finding)]


@dataclass(frozen=True, slots=True)
class StageReport(Generic[F]):
    """Observations of a stage, or of all stages so far: findings, and facts that the next stages and the pages use."""

    findings: Findings
    facts: F


Grade: TypeAlias = Literal["usable", "usable with care", "not usable"]

GRADES: tuple[Grade, ...] = ("usable", "usable with care", "not usable")
PREDICTED: tuple[Affected, ...] = ("time", "energy")
"""Labels that models predict."""
_GRADE_OF: Mapping[Severity, Grade] = {"error": "not usable", "warning": "usable with care"}


@dataclass(frozen=True, slots=True)
class Verdict:
    """A grade each for position, time and energy, and the findings that decided, the worst first.

    ``confirmed_by``: witnesses of each compared label, ``nothing`` if none was found; ``labels``: findings with size, σ
    and witnesses of each label.
    """

    position: Grade = "usable"
    time: Grade = "usable"
    energy: Grade = "usable"
    reasons: Findings = ()
    confirmed_by: Mapping[Affected, tuple[Witness, ...]] = field(default_factory=dict)
    labels: Findings = ()
    catalogue: str = field(default_factory=read_catalogue_version)
    """Version of the catalogue that judged."""

    @property
    def worst(self) -> Grade:
        """The worst of the three grades."""
        return max((self.position, self.time, self.energy), key=GRADES.index)

    def find_label(self, label: str) -> Finding | None:
        """Return the finding with size, σ and witnesses of a label; None if there is no such finding."""
        return next((finding for finding in self.labels if finding.subject.name == label), None)


def judge(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict: the grade of each label's worst finding; without a witness at best usable with care."""
    findings = tuple(findings)
    decisive = (finding for finding in findings if finding.severity != "note" and find_entry(finding.code).affects)
    reasons = tuple(sort_findings(decisive))
    witnesses = select_findings(findings, WITNESSES_OF_LABEL)
    by_label = [[finding for finding in witnesses if finding.subject.name == label] for label in AFFECTED]
    labels = tuple(_merge_label(of_label) for of_label in by_label if of_label)
    confirmed_by: dict[Affected, tuple[Witness, ...]] = {
        finding.subject.name: tuple(finding.names["witnesses"].split(", "))  # type: ignore[arg-type,misc]
        for finding in labels
    }
    grades: dict[Affected, Grade] = {
        label: "usable with care" for label, witnesses in confirmed_by.items() if witnesses == (NOTHING,)
    }
    for finding in reversed(reasons):
        for label in find_entry(finding.code).affects:
            grades[label] = max(grades.get(label, "usable"), _GRADE_OF[finding.severity], key=GRADES.index)
    return Verdict(**grades, reasons=reasons, confirmed_by=confirmed_by, labels=labels)


def _merge_label(findings: Sequence[Finding]) -> Finding:
    """Return one finding for the witnesses of a label, of several runs with the range of their means."""
    first = findings[0]
    if len(findings) == 1:
        return first
    witnesses = dict.fromkeys(name for finding in findings for name in finding.names["witnesses"].split(", "))
    names = {"witnesses": ", ".join(witnesses)}
    if NOTHING in witnesses:
        count = sum(finding.names["witnesses"] == NOTHING for finding in findings)
        others = ", ".join(name for name in witnesses if name != NOTHING)
        rest = f"; the others by {others}" if others else ""
        names = {"witnesses": NOTHING, "missing": f"in {count} of {len(findings)} runs{rest}"}
    values = {name: [each.numbers[name] for each in findings if name in each.numbers] for name in first.numbers}
    numbers = {name: max(each) if name.startswith("std") else min(each) for name, each in values.items()}
    numbers |= {name.replace("mean", "most"): max(each) for name, each in values.items() if name.startswith("mean")}
    return replace(first, names=names, numbers=numbers)


def judge_by_code(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict of many runs together: of each code the worst finding alone is a reason."""
    verdict, worst = judge(findings), dict[str, Finding]()
    for finding in verdict.reasons:
        worst.setdefault(finding.code, finding)
    return replace(verdict, reasons=tuple(worst.values()))


def judge_again(verdict: Verdict, findings: Iterable[Finding]) -> Verdict:
    """Return a verdict that was stored; where another catalogue judged it, the verdict of this one."""
    return verdict if verdict.catalogue == read_catalogue_version() else judge(findings)
