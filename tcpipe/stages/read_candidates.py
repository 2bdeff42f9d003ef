"""Bare numbers that could be the power of the drives: their names, their range, and the recipe that would read them as power."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tcpipe.logs.roles import OVERLAY, RoleAssignment
from tcpipe.logs.topics import Topic
from tcpipe.power.sources import FLOAT_TYPES, LARGEST_AMP, LARGEST_VOLT, is_of_drives, quantity, rail_of
from tcpipe.recipe import ReadConfig
from tcpipe.recipe.suggestions import TomlValue, suggest
from tcpipe.stages.message_arrays import message_arrays
from tcpipe.stages.protocols import LogReader
from tcpipe.tables.findings import Finding, Subject, make_finding


@dataclass(frozen=True, slots=True)
class _Candidate:
    topic: Topic
    what: str
    scale: float
    """What its numbers are multiplied by, to be V or A."""
    range: tuple[float, float]
    """Lowest and highest [V] or [A]."""

    def source(self, rail: str) -> Mapping[str, TomlValue]:
        """Return the table that reads it as a part of a rail."""
        keys = {"type": self.topic.type_name, "topic": self.topic.name, self.what: "data", "rail": rail, "sign": "auto"}
        return keys | ({f"{self.what}_scale": self.scale} if self.scale != 1.0 else {})


def power_candidates(log: LogReader, assignment: RoleAssignment, config: ReadConfig) -> tuple[Finding, ...]:
    """Return what could be power in a log without a power topic; nothing where the recipe names its topics or there are no such numbers."""
    if "power" in assignment.roles or "power" in config.topics:
        return ()
    wanted = [topic for topic in log.topics.values() if _is_wanted(topic, config)]
    tables = log.tables([topic.name for topic in wanted]) if wanted else {}
    found = []
    for topic in wanted:
        values = message_arrays(tables[topic.name], ()).get("data") if topic.name in tables else None
        known = np.asarray([] if values is None else values, np.float64)
        known = known[np.isfinite(known)]
        what = str(quantity(topic.name))
        if known.size and np.any(known):
            most = LARGEST_VOLT if what == "voltage" else LARGEST_AMP
            scale = 0.001 if np.median(np.abs(known)) > most else 1.0
            found.append(_Candidate(topic, what, scale, (scale * float(known.min()), scale * float(known.max()))))
    if not found:
        return ()
    used = _rails(found)
    topics: list[TomlValue] = list(dict.fromkeys(each.topic.name for _, each in used))
    sources = [of.source(rail) for rail, of in used]
    ranges: dict[str, Any] = {
        f"{end}_{unit}": choose(number for of in found if of.what == what for number in of.range)
        for what, unit in (("voltage", "volt"), ("current", "amp"))
        if any(of.what == what for of in found)
        for end, choose in (("low", min), ("high", max))
    }
    return (
        make_finding(
            "power-candidates",
            Subject("role", "power"),
            names={"topics": ", ".join(of.topic.name for of in found)},
            remedies=suggest("use", {"read.topics": {"power": topics}, "power_sources": sources}) if used else (),
            topics_count=len(found),
            **ranges,
        ),
    )


def _is_wanted(topic: Topic, config: ReadConfig) -> bool:
    told = topic.type_name in FLOAT_TYPES and quantity(topic.name) is not None
    readable = topic.problem is None and topic.message_count != 0
    return told and readable and topic.name not in config.ignore_topics and not topic.name.startswith(OVERLAY)


def _rails(found: Sequence[_Candidate]) -> list[tuple[str, _Candidate]]:
    """Return each rail's voltage and current: called alike, or all currents at the only voltage; of drives alone where some are."""
    voltages = {rail_of(of.topic.name): of for of in found if of.what == "voltage"}
    currents = [of for of in found if of.what == "current"]
    currents = [of for of in currents if is_of_drives(of.topic.name)] or currents
    used = []
    for of in currents:
        rail = rail_of(of.topic.name)
        voltage = voltages.get(rail) or (next(iter(voltages.values())) if len(voltages) == 1 else None)
        if voltage is None:
            return []
        used += [(rail, voltage), (rail, of)]
    return used
