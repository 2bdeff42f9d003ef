"""A role's checked table, from the usable readings of the topics that play it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.logs.clocks import Timeline
from tcpipe.power.readings import PowerReadings
from tcpipe.stages.read_power import currents_of
from tcpipe.stages.read_sources import TopicReadings
from tcpipe.tables.levels import STREAMS


def role_table(
    role: str, sources: Sequence[TopicReadings], timelines: Mapping[str, Timeline], power: PowerReadings
) -> pa.Table:
    """Return a role's table, sorted by epoch and stamp; the columns of its sources' readings are taken out."""
    parts = []
    for source in sources:
        if source.role == role:
            parts += list(_parts(source, timelines[source.key], power))
    if len(parts) == 1:  # in order already
        return STREAMS[role].table(**parts[0])
    columns = {name: np.concatenate([part.pop(name) for part in parts]) for name in list(parts[0])}
    order = np.lexsort((columns["stamp_ns"], columns["epoch"]))
    return STREAMS[role].table(**{name: columns.pop(name)[order] for name in list(columns)})


def _parts(source: TopicReadings, timeline: Timeline, power: PowerReadings) -> list[dict[str, NDArray[Any]]]:
    """Return a topic's columns; one part a rail where it plays power."""
    readings = source.readings.columns
    columns = {name: readings.pop(name)[timeline.row] for name in list(readings)}
    times: dict[str, NDArray[Any]] = {
        "stamp_ns": timeline.stamp_ns,
        "log_time_ns": source.readings.log_time_ns[timeline.row],
        "epoch": timeline.epoch,
    }
    if source.role != "power":
        return [times | columns]
    parts = []
    for rail in power.rails[source.topic]:
        voltage, current = currents_of(rail, times, columns)
        known = np.isfinite(voltage) | np.isfinite(current)
        values = {**times, "rail": np.full(len(known), rail.name), "voltage_volt": voltage, "current_amp": current}
        parts.append({name: value[known] for name, value in values.items()})
    return parts
