"""Bare numbers that could be the power of the drives: what they are called, their range, and the recipe that would read them as power."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tcpipe.logs.roles import OVERLAY, RoleAssignment
from tcpipe.logs.topics import Topic
from tcpipe.power.sources import FLOAT_TYPES, LARGEST_AMP, LARGEST_VOLT, is_of_drives, quantity, rail_of
from tcpipe.recipe import ReadConfig
from tcpipe.recipe.suggestions import RecipeFragment, TomlValue
from tcpipe.stages.message_arrays import message_arrays
from tcpipe.stages.protocols import LogReader
from tcpipe.tables.facts import NoPower


@dataclass(frozen=True, slots=True)
class _Candidate:
    topic: Topic
    what: str
    scale: float
    """What its numbers are multiplied by, to be V or A."""
    range: tuple[float, float]

    def __str__(self) -> str:
        unit = ("m" if self.scale != 1.0 else "") + ("V" if self.what == "voltage" else "A")
        return f"{self.topic.name} ({unit}, {self.range[0]:.4g} to {self.range[1]:.4g})"

    def source(self, rail: str) -> Mapping[str, TomlValue]:
        """Return the table that reads it as a part of a rail."""
        keys = {"type": self.topic.type_name, "topic": self.topic.name, self.what: "data", "rail": rail, "sign": "auto"}
        return keys | ({f"{self.what}_scale": self.scale} if self.scale != 1.0 else {})


def power_candidates(log: LogReader, assignment: RoleAssignment, config: ReadConfig) -> NoPower | None:
    """Return what could be power in a log of which no topic plays it; None where power is played, settled or nothing could be it."""
    if "power" in assignment.roles or "power" in config.topics:
        return None
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
            found.append(_Candidate(topic, what, scale, (float(known.min()), float(known.max()))))
    if not found:
        return None
    why = f"no topic plays power; what could tell it: {', '.join(map(str, found))}"
    used = _rails(found)
    if not used:
        return NoPower(f"{why}; which voltage goes with which current is not clear from their names")
    names: list[TomlValue] = list(dict.fromkeys(each.topic.name for _, each in used))
    fragment = RecipeFragment(
        {"read.topics": {"power": names}, "power_sources": [of.source(rail) for rail, of in used]}
    )
    return NoPower(f"{why}; where these feed the drives, write in a recipe:", fragment.toml())


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
