"""Whether a receiver's velocity is over ground: its messages name a frame, and the body's own is none of that."""

from __future__ import annotations

from dataclasses import replace

from tcpipe.logs.messages import GNSS_VELOCITY, Readings
from tcpipe.logs.placements import is_base
from tcpipe.recipe.suggestions import suggest
from tcpipe.tables.findings import make_finding


def over_ground(readings: Readings, frame: str, topic: str) -> Readings:
    """Return a receiver's velocities, none with a finding where their frame is the body's: whose axes they have is not known."""
    if not is_base(frame):
        return readings
    remedies = suggest("use", {"read.topics": {"gnss_velocity": [topic]}})
    found = make_finding("velocity-not-over-ground", GNSS_VELOCITY, names={"frame": frame}, remedies=remedies)
    none = slice(0, 0)
    return replace(
        readings,
        row=readings.row[none],
        log_time_ns=readings.log_time_ns[none],
        header_ns=None if readings.header_ns is None else readings.header_ns[none],
        columns={name: values[none] for name, values in readings.columns.items()},
        findings=(*readings.findings, found),
    )
