"""What the error of a label is made of, as a run's and a dataset's page say it."""

from __future__ import annotations

from tcpipe.cost.budget import in_words
from tcpipe.report.page import Section
from tcpipe.tables.facts import EnergyBudget

_ROWS = {
    "position": "position of both ends",
    "rate": "what the current did between two samples",
    "current": "noise and rounding of the current",
    "voltage": "voltage",
    "total": "all together",
    "at_20_hz": "all together, with power at 20 Hz",
}


def budget_sections(budget: EnergyBudget | None) -> list[Section]:
    """Return the section on the noise floor of E; none where no segment has an energy."""
    if budget is None:
        return []
    rows = [(text, f"{100 * getattr(budget, name):.2f} %") for name, text in _ROWS.items()]
    return [Section("How wrong a label may be", in_words(budget), header=("from", "of E"), rows=rows, figures_from=1)]
