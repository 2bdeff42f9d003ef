"""The topics that play power: their messages as rails, and a topic's usable rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.logs.messages import LOG_TIME, Readings, header_ns
from tcpipe.logs.roles import RoleAssignment
from tcpipe.power.counters import Counter
from tcpipe.power.readings import PowerReadings, read_power
from tcpipe.power.sources import RailReadings, reject_power
from tcpipe.recipe import ReadConfig
from tcpipe.robots.profiles import Profiles


def power_of_topics(
    topics: Mapping[str, tuple[str, Mapping[str, NDArray[Any]]]],
    assignment: RoleAssignment,
    config: ReadConfig,
    *,
    known: Profiles,
) -> PowerReadings:
    """Return what the topics that play power hold, by topic their message type and columns; nothing unless all of them can be decoded."""
    wanted = len(assignment.roles["power"].topics) if "power" in assignment.roles else 0
    if not topics:
        return PowerReadings()
    if len(topics) < wanted:
        lost = [topic for topic in assignment.roles["power"].topics if topic not in topics]
        return PowerReadings(findings=tuple(reject_power(topic, "not-decoded") for topic in lost))
    return read_power(
        topics,
        known.power_sources,
        platform=known.robots[assignment.robot].platform,
        husky_power=config.husky_power,
        current_sign=config.current_sign,
    )


def columns_of(rail: str) -> tuple[str, str]:
    """Return the names of a rail's voltage and current columns in its topic's readings."""
    return f"{rail}: voltage_volt", f"{rail}: current_amp"


def counter_of(rail: str) -> tuple[str, str]:
    """Return the names of the columns in which a rail's counter of energy stands, where it has one."""
    return f"{rail}: energy_joule", f"{rail}: resets"


def power_rows(columns: Mapping[str, NDArray[Any]], rails: Sequence[RailReadings]) -> Readings:
    """Return the rows of a power topic on which at least one rail carries a voltage or a current."""
    values = {
        name: values
        for rail in rails
        for name, values in zip(columns_of(rail.name), (rail.voltage_volt, rail.current_amp), strict=True)
    }
    row = np.flatnonzero(np.any([np.isfinite(value) for value in values.values()], axis=0))
    for rail in rails:
        if rail.counter is not None:
            energy, resets = counter_of(rail.name)
            values |= {energy: rail.counter.energy_joule, resets: rail.counter.resets.astype(np.float64)}
    stamps = header_ns(columns)
    lost = len(columns[LOG_TIME]) - len(row)
    return Readings(
        row,
        columns[LOG_TIME][row].astype(np.int64),
        None if stamps is None else stamps[row],
        {name: value[row] for name, value in values.items()},
        {"not_finite": lost} if lost else {},
    )


def currents_of(
    rail: RailReadings, times: Mapping[str, NDArray[Any]], columns: Mapping[str, NDArray[Any]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a rail's voltages [V] and currents [A] in its topic's readings.

    Those of a counter of energy are means by the times that rule; none across a reset or a step of the clock.
    """
    voltage, current = (columns[name] for name in columns_of(rail.name))
    if rail.counter is not None:
        energy, resets = (columns[name] for name in counter_of(rail.name))
        breaks = resets + times["epoch"] * (1 + np.max(resets, initial=0))
        current = np.where(np.isnan(current), np.nan, Counter(energy, breaks).mean_amp(times["stamp_ns"], voltage))
    return voltage, current
