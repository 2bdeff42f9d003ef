"""One self-contained HTML page from plain values."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined

from tcpipe import __version__


@dataclass(frozen=True, slots=True)
class Number:
    """One headline figure."""

    value: str
    label: str


@dataclass(frozen=True, slots=True)
class Section:
    """A heading with a sentence, pictures (SVG text) and a table, each optional."""

    title: str
    text: str = ""
    svg: str = ""
    header: Sequence[str] = field(default_factory=tuple)
    rows: Sequence[Sequence[Any]] = field(default_factory=tuple)
    figures_from: int | None = None
    """First column of figures that are written out already: these stand to the right, as numbers do."""


def render_page(
    *, title: str, lead: str, numbers: Sequence[Number], warnings: Sequence[str], sections: Sequence[Section]
) -> str:
    """Return the page's HTML; every text is escaped, pictures are inline."""
    source = files("tcpipe.report").joinpath("page.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters["breakable"] = _breakable
    return environment.from_string(source).render(
        title=title, lead=lead, numbers=numbers, warnings=warnings, sections=sections, version=__version__
    )


def _breakable(cell: object) -> str:
    """Return a cell's text as HTML, escaped, that may break after every / and _, as topics and types are long."""
    return html.escape(str(cell)).replace("/", "/<wbr>").replace("_", "_<wbr>")
