"""The frame of every page: one self-contained HTML file, which loads nothing and works without a mouse.

A page with figures (`tcpipe.report.plots.Plot`) contains BokehJS once. A page's own script is a file beside this one,
which reads ``page.data`` and finds figures by ``page.model(name)`` (``page.js``).

Columns of numbers inside a page, small: quantised where that changes no digit that is shown, deflated, in base64.

=========  ======================================================================================
kind       what a reader gets
=========  ======================================================================================
``u8``     whole numbers to 255; ``u16`` to 65 535; ``u32`` to 4 294 967 295
``f32``    a float32
``half``   the upper 16 bits of a float32, rounded: to 0.4 %, for slopes and deviations
``steps``  ``low + step * number`` over the column's range in 65 534 steps, for coordinates and labels
=========  ======================================================================================

NaN stays NaN; among ``steps`` it is 65 535. ``page.js`` reads it.
"""

from __future__ import annotations

import base64
import html
import json
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any, Literal
from urllib.parse import quote

import numpy as np
from jinja2 import Environment, StrictUndefined

from tcpipe import __version__
from tcpipe.arrays import Floats, GenericArray
from tcpipe.errors import clean_line
from tcpipe.formats.finding_lines import (
    MOST_LINES,
    FindingGroup,
    describe_finding,
    describe_group,
    describe_label,
    list_remedies,
)
from tcpipe.formats.json_files import Json
from tcpipe.report import plots
from tcpipe.report.plots import Plot
from tcpipe.tables.findings import (
    AFFECTED,
    WITNESSES_OF_LABEL,
    Affected,
    Finding,
    Grade,
    Severity,
    Verdict,
    find_entry,
    sort_findings,
)

_INVISIBLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]")
"""Invisible characters and those that reverse the direction of text; a name may contain them."""

_NUMBER = r"[-+±]?(?:\d+(?:\.\d+)?|nan)(?: ?(?:[%°]|[a-zA-Z/]{1,3}\b))?(?: \([^)]*\))?"
_NUMBERS = re.compile(rf"{_NUMBER}(?:(?:, | to ){_NUMBER})*|(?:–|none)?")

_SCRIPTS = "<!-- scripts -->"


@dataclass(frozen=True, slots=True)
class Link:
    """Another page: text and relative path, not yet quoted."""

    text: str
    path: str

    def __html__(self) -> str:
        """Return it as HTML; no path becomes another scheme or leaves the attribute."""
        return f'<a href="{quote(self.path)}">{_format_breakable(self.text)}</a>'


@dataclass(frozen=True, slots=True)
class Shaded:
    """A cell of a table that is a heat map: its text, and how full it is, from 0 to 1; ``alarm`` marks it."""

    text: str
    share: float
    alarm: bool = False

    def __html__(self) -> str:
        """Return it as HTML."""
        mark = " alarm" if self.alarm else ""
        return f'<span class="shaded{mark}" style="--share:{min(max(self.share, 0.0), 1.0):.2f}">{_format_breakable(self.text)}</span>'


@dataclass(frozen=True, slots=True)
class ShownFinding:
    """The findings of one code: meaning, observations with times, and remedies with lines to copy."""

    severity: Severity
    code: str
    title: str
    observed: Sequence[tuple[str, tuple[float, float] | None]]
    remedies: Sequence[tuple[str, Sequence[str]]]


@dataclass(frozen=True, slots=True)
class VerdictBox:
    """The verdict at the top of a page: findings ``shown`` in full, ``more`` and ``notes`` folded."""

    grades: tuple[tuple[str, Grade, str], ...]
    """Label, grade, and size and witnesses of the label."""
    shown: tuple[ShownFinding, ...]
    more: tuple[ShownFinding, ...]
    notes: tuple[ShownFinding, ...]


def show_verdict(
    verdict: Verdict,
    findings: Iterable[Finding] = (),
    groups: Iterable[FindingGroup] = (),
    *,
    labels: Sequence[Affected] = AFFECTED,
) -> VerdictBox:
    """Return a verdict: the grades of ``labels``, findings with their remedies, and ``groups`` for `describe_group`."""
    by_code: dict[tuple[Severity, str], list[Finding]] = {}
    for finding in sort_findings(findings):
        by_code.setdefault((finding.severity, finding.code), []).append(finding)
    entries = []
    for (severity, code), of_code in by_code.items():
        observed = [(describe_finding(finding), finding.span_s) for finding in of_code]
        entries.append(ShownFinding(severity, code, find_entry(code).title, observed, list_remedies(of_code)))
    for group in groups:
        title, text = find_entry(group.code).title, describe_group(group)
        entries.append(ShownFinding(group.severity, group.code, title, [(text, None)], list_remedies(group.findings)))
    problems = [line for severity in ("error", "warning") for line in entries if line.severity == severity]
    return VerdictBox(
        grades=tuple((name, getattr(verdict, name), _describe_witnesses(verdict, name)) for name in labels),
        shown=tuple(problems[:MOST_LINES]),
        more=tuple(problems[MOST_LINES:]),
        notes=tuple(line for line in entries if line.severity == "note" and line.code != WITNESSES_OF_LABEL),
    )


def _describe_witnesses(verdict: Verdict, label: Affected) -> str:
    """Return size and witnesses of a label; "" if it has none."""
    finding = verdict.find_label(label)
    return "" if finding is None else " · ".join(describe_label(label, finding)).removeprefix(label).strip()


@dataclass(frozen=True, slots=True)
class PageSection:
    """A heading with a sentence, figures, controls and a table, each optional."""

    title: str
    text: str = ""
    """Text; the part after a line break is folded."""
    header: Sequence[str] = field(default_factory=tuple)
    rows: Sequence[Sequence[Any]] = field(default_factory=tuple)
    plots: Sequence[Plot] = ()
    controls: str = ""
    """File beside this one with the HTML above the figures."""
    folded: bool = False
    """Whether the table waits behind a line to click."""
    stacked: bool = False
    """Whether the figures are one below the other on wide pages too, as those with one axis are."""
    parts: Sequence[PageSection] = ()
    """Sections below it, which have no parts; those without figures wait behind their titles."""

    def list_number_columns(self) -> list[bool]:
        """Return which columns of the table show only numbers, which are aligned to the right."""
        return [all(_NUMBERS.fullmatch(str(cell)) for cell in column) for column in zip(*self.rows, strict=True)]


def render_page(
    *,
    title: str,
    lead: str,
    numbers: Sequence[tuple[str, str]],
    sections: Sequence[PageSection],
    verdict: VerdictBox | None = None,
    warnings: Sequence[str] = (),
    links: Sequence[Link] = (),
    script: str = "",
    data: Json = None,
    made_from: str = "",
) -> str:
    """Return the page's HTML; every text is escaped, everything is inline.

    Parameters
    ----------
    title, lead, verdict, numbers, warnings : the top of the page, in this order; a number is a value and its label.
    sections : in the order of the page; the first is next to the verdict, the titles form the table of contents.
    links : pages that belong to it.
    script, data : file beside this one that runs when all figures are drawn, and its data.
    made_from : digest of the inputs, by which `is_made_from` finds that the page need not be rendered again; "" if it
    has to be.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters["cell"] = _format_cell
    all_plots = [plot for section in sections for part in (section, *section.parts) for plot in part.plots]
    figures, ids = plots.render_plots(all_plots)
    page = environment.from_string(_read_file("page.html.j2")).render(
        title=title,
        lead=lead,
        numbers=numbers,
        warnings=warnings,
        verdict=verdict,
        links=links,
        made_from=_MADE_FROM.format(made_from) if made_from else "",
        sections=sections,
        ids={plot.figure.name: id_ for plot, id_ in zip(all_plots, ids, strict=True)},
        read_file=_read_file,
        version=__version__,
        style=_read_file("page.css"),
        scripts=_SCRIPTS,
    )
    visible = _INVISIBLE.sub(lambda match: clean_line(match[0]), page)
    blocks = [_format_json("page-data", _clean_data(data)), _format_json("page-figures", figures)]
    code = [plots.BOKEH_SCRIPT.read_text(encoding="utf-8")] if ids else []
    code += [_read_file("page.js"), *([_read_file(script)] if script else [])]
    return visible.replace(_SCRIPTS, "\n".join(blocks + [f"<script>\n{part}\n</script>" for part in code]), 1)


_MADE_FROM = '<meta name="tcpipe-made-from" content="{}">'
_HEAD_BYTES = 4096


def is_made_from(page: bytes, made_from: str) -> bool:
    """Return whether a page was made from inputs with this digest."""
    return _MADE_FROM.format(made_from).encode() in page[:_HEAD_BYTES]


def _read_file(name: str) -> str:
    return files("tcpipe.report").joinpath(name).read_text(encoding="utf-8")


def _format_json(name: str, value: Json) -> str:
    """Return JSON as a part of the page that no text in it can end."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{text}</script>'


def _clean_data(value: Json) -> Json:
    """Return plain data with every text as one printable line."""
    if isinstance(value, str):
        return value if value.isprintable() else clean_line(value)
    if value is None or isinstance(value, int | float):
        return value
    if isinstance(value, Mapping):
        return {clean_line(key): _clean_data(part) for key, part in value.items()}
    return [_clean_data(part) for part in value] if isinstance(value, Sequence) else value


def _format_cell(cell: object) -> str:
    """Return a cell as HTML."""
    return cell.__html__() if isinstance(cell, Link | Shaded) else _format_breakable(cell)


def _format_breakable(cell: object) -> str:
    """Return a text as HTML, escaped, that may break after every / and _, as topics and types are long."""
    return html.escape(str(cell)).replace("/", "/<wbr>").replace("_", "_<wbr>")


Kind = Literal["u8", "u16", "u32", "f32", "half", "steps"]
Column = tuple[Kind, GenericArray]

_WHOLE = {"u8": "<u1", "u16": "<u2", "u32": "<u4"}


def pack_columns(columns: Mapping[str, Column]) -> Json:
    """Return columns by name, each of shape (N,), as JSON."""
    described: list[Json] = []
    blob = bytearray()
    for name, (kind, values) in columns.items():
        low, step = _scale(values) if kind == "steps" else (0.0, 1.0)
        data = _to_bytes(kind, values, low, step)
        described.append({"name": name, "kind": kind, "at": len(blob), "bytes": len(data), "low": low, "step": step})
        blob += data
    return {"columns": described, "data": base64.b64encode(zlib.compress(bytes(blob), 6)).decode("ascii")}


def make_shown_column(digits: int, values: Floats) -> Column:
    """Return a column with a number of decimals: in steps where these are finer than half of the last one."""
    return ("steps" if _scale(values)[1] < 0.5 * 10.0**-digits else "f32"), values


def _scale(values: GenericArray) -> tuple[float, float]:
    numbers = values.astype(float)
    known = numbers[np.isfinite(numbers)]
    return (float(known.min()), (float(known.max()) - float(known.min())) / 65534 or 1.0) if len(known) else (0.0, 1.0)


def _to_bytes(kind: Kind, values: GenericArray, low: float, step: float) -> bytes:
    if kind in _WHOLE:
        return values.astype(_WHOLE[kind]).tobytes()
    if kind == "steps":
        steps = np.round((values.astype(float) - low) / step)
        return np.where(np.isfinite(steps), steps, 65535).astype("<u2").tobytes()
    bits = values.astype("<f4").view("<u4")
    if kind == "half":
        upper = np.where(np.isnan(values.astype(float)), 0x7FC0, (bits.astype(np.uint64) + 0x8000) >> 16)
        return upper.astype("<u2").tobytes()
    return (bits >> 16).astype("<u2").tobytes() + (bits & 0xFFFF).astype("<u2").tobytes()
