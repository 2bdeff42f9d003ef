"""How many labels carry each quality bit, as a run's and a dataset's page say it."""

from __future__ import annotations

from collections.abc import Mapping

from tcpipe.report.page import Section
from tcpipe.tables.bits import Quality, name_of

QUALITY_WORDS = {
    Quality.LOW_POWER_RATE: "power was sampled too slowly",
    Quality.NEAR_GAP: "a gap in the data is less than a chord away",
    Quality.HIGH_SLIP: "wheels and ground differ by more than 20 %",
    Quality.WEAK_GNSS: "position is uncertain",
    Quality.CURVED: "the path bends",
    Quality.MEAN_POWER_DIFFERS: "mean power and energy over time differ by more than 5 %",
    Quality.NO_COMMAND: "no command topic: full speed is not proved",
    Quality.VOLTAGE_OUT_OF_RANGE: "voltage leaves the robot's range",
    Quality.CLOCK_DOUBTFUL: "a clock is doubtful",
    Quality.PHYSICS_OUTLIER: "power is far from what physics predicts",
    Quality.NOT_AT_LIMIT: "commanded below full speed",
    Quality.SENSORS_DISAGREE: "sensors disagree",
}
"""What a bit says, in words."""


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
