"""The catalogue of findings (``catalogue.toml``): what each code means, what to do about it, and the thresholds that decide it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from importlib.resources import files
from string import Formatter
from typing import Any, Literal, TypeAlias

Severity: TypeAlias = Literal["error", "warning", "note"]
Affected: TypeAlias = Literal["position", "time", "energy"]
Action: TypeAlias = Literal["kept", "corrected", "inflated", "excluded", "rejected"]
"""What tcpipe did with the subject of a finding; inflated: raised its standard deviations."""

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
AFFECTED: tuple[Affected, ...] = ("position", "time", "energy")


@dataclass(frozen=True, slots=True)
class Entry:
    """One code of the catalogue.

    Attributes
    ----------
    title : what a reader searches for.
    template : one line; ``{subject}``, ``{span}``, numbers (written with the unit of their suffix) and names of the finding.
    severity : of an error, what it affects is not usable; of a warning, it is usable with care; a note changes no verdict.
    action : what tcpipe does with the subject by default.
    affects : labels that the finding makes doubtful.
    cause : why this happens.
    advice : what to do where no remedy is known as data.
    remedies : by name, what a recipe fragment or a command of the finding does.
    thresholds : numbers that decide whether the finding is made; the suffix is the unit.
    flag : the quality bit that marks segments for the same reason; "" for none.
    is_problem : whether it makes ``tcpipe ingest`` exit with 3 until it is acknowledged.
    public : numbers and names that a redacted dataset keeps.
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
        fields: dict[str, Any] = {name: tuple(of) if isinstance(of, list) else of for name, of in values.items()}
        entries[code] = Entry(**fields)
    return entries


def read_sections() -> dict[str, list[str]]:
    """Return the codes by section, in the order of the file."""
    sections: dict[str, list[str]] = {}
    codes: list[str] = []
    for line in _read_text().splitlines():
        if line.startswith("# ---- "):
            codes = sections.setdefault(line.strip("# -"), [])
        elif line.startswith("[") and "." not in line:
            codes.append(line.strip("[]"))
    return sections


@cache
def _read_text() -> str:
    return files("tcpipe.tables").joinpath("catalogue.toml").read_text(encoding="utf-8")


@cache
def read_catalogue_version() -> str:
    """Return the first digits of the catalogue's hash: a verdict that was judged by another catalogue is judged again."""
    return sha256(_read_text().encode()).hexdigest()[:8]


def read_threshold(code: str, name: str) -> float:
    """Return a number that decides whether a finding is made, in the unit of its suffix."""
    return read_catalogue()[code].thresholds[name]


def rank_severity(severity: Severity) -> int:
    """Return 0 for the worst severity, more for others."""
    return SEVERITIES.index(severity)
