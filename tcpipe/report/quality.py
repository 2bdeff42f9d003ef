"""How many labels carry each quality bit, as a run's and a dataset's page say it."""

from __future__ import annotations

from collections.abc import Mapping

from tcpipe.report.page import Section
from tcpipe.tables.bits import Quality, name_of


def quality_sections(counts: Mapping[str, int], of_what: str) -> list[Section]:
    """Return the table of the bits that any label carries; ``counts`` are by the bit's name."""
    rows = [(name_of(bit).replace("_", " "), count) for bit in Quality if (count := counts.get(name_of(bit), 0))]
    if not rows:
        return [Section("Quality flags", f"None: all {of_what} are clean.")] if counts else []
    return [
        Section(
            "Quality flags",
            "A label may carry several; docs/reference/columns.md says what each means.",
            header=("flag", of_what),
            rows=rows,
        )
    ]
