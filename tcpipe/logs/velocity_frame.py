"""Whether a receiver's velocity is over ground: its messages name a frame, and the body's own is none of that."""

from __future__ import annotations

from dataclasses import replace

from tcpipe.logs.messages import Readings
from tcpipe.logs.placements import is_base
from tcpipe.recipe.suggestions import suggested


def over_ground(readings: Readings, frame: str, topic: str) -> Readings:
    """Return a receiver's velocities, none with a warning where their frame is the body's."""
    if not is_base(frame):
        return readings
    why = (
        f"its frame is {frame!r}: of the body, or of the antenna over ground, nobody can tell, so it is not used"
        + suggested("if it is east, north, up", {"read.topics": {"gnss_velocity": [topic]}})
    )
    none = slice(0, 0)
    return replace(
        readings,
        row=readings.row[none],
        log_time_ns=readings.log_time_ns[none],
        header_ns=None if readings.header_ns is None else readings.header_ns[none],
        columns={name: values[none] for name, values in readings.columns.items()},
        warnings=(*readings.warnings, why),
    )
