"""One self-contained HTML page from plain values."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined

from tcpipe import __version__
from tcpipe.errors import plain_line

_UNSEEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]")
"""Characters that cannot be seen in a page, or turn its text round: a name may hold them."""


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
    page = environment.from_string(source).render(
        title=title, lead=lead, numbers=numbers, warnings=warnings, sections=sections, version=__version__
    )
    return _UNSEEN.sub(lambda found: plain_line(found[0]), page)


def _breakable(cell: object) -> str:
    """Return a cell's text as HTML, escaped, that may break after every / and _, as topics and types are long."""
    return html.escape(str(cell)).replace("/", "/<wbr>").replace("_", "_<wbr>")
