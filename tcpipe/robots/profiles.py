"""Robots and power sources as plain records: one schema for the package's own TOML files and for a recipe's tables."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Le

_STRICT = {"extra": "forbid", "use_attribute_docstrings": True, "allow_inf_nan": False}

Size = Annotated[float, Ge(0.05), Le(100)]
"""Of a robot [m]: from a toy's to a mining truck's."""
Speed = Annotated[float, Ge(0.01), Le(100)]
Volt = Annotated[float, Ge(0.1), Le(1e4)]

GENERIC = "generic"
"""The name of a robot of which nothing is known."""

CurrentSign = Literal["drawn_positive", "drawn_negative", "auto"]

_FIELD = re.compile(r"\s*([\w.]+)(?:\[(\d+)\])?\s*")
_TYPE = re.compile(r"\w+/msg/\w+")


@dataclass(frozen=True, slots=True)
class Robot:
    """What is known of a robot before its log is opened; what is left out is not known."""

    __pydantic_config__ = _STRICT

    width_m: Size | None = None
    """Width of its footprint, wheels or tracks included [m]."""
    length_m: Size | None = None
    """Length of its footprint [m]."""
    max_velocity_mps: Speed | None = None
    """Maximum speed [m/s]; a segment that was commanded slower than this is not at the terrain's limit."""
    voltage_range_volt: tuple[Volt, Volt] | None = None
    """Lowest and highest voltage that its battery has [V]; a segment beyond is flagged."""
    platform: str | None = None
    """The kind of robot by which power sources tell it apart (Clearpath's code, as A200)."""
    status_types: list[str] = field(default_factory=list)
    """Message types that only this robot publishes; a log that holds one is of it."""
    called: list[str] = field(default_factory=list)
    """Words by which a topic's name tells this robot; whole words, in small letters."""

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield each key whose value cannot be, and what was wanted."""
        if self.voltage_range_volt is not None and self.voltage_range_volt[0] >= self.voltage_range_volt[1]:
            yield "voltage_range_volt", "the lower of two voltages first"


@dataclass(frozen=True, slots=True)
class PowerSource:
    """What a message type tells of one rail: one voltage and the current that drives the wheels at it. Several rails are several tables."""

    __pydantic_config__ = _STRICT

    type: str
    """Message type, as package/msg/Name in ROS 1 and 2 alike."""
    voltage: str = ""
    """Field of the voltage [V] by dotted name, an element of a list as volts[0]; none where the message carries a current alone."""
    current: str = ""
    """Field of the current [A], several that are to be summed as left_current + right_current; none where it carries a voltage alone."""
    rail: str = ""
    """The rail's name; none takes the topic's."""
    averaged: bool = False
    """Whether a value is the mean over the period that ends with the message, rather than sampled."""
    sign: CurrentSign = "drawn_positive"
    """Which sign a drawn current has; auto where robots disagree: the mean over the run tells."""
    propulsion: bool = True
    """Whether the current drives the wheels alone; such a source is taken before others."""
    includes: str = ""
    """What the current feeds besides the drives; said in a warning."""
    platform: str | None = None
    """Only for robots of this platform."""
    topic: str | None = None
    """Only for topics whose name ends so."""
    husky_power: Literal["battery", "drivers"] | None = None
    """Only where `read.husky_power` says so."""
    currents_listed: Annotated[int, Ge(1), Le(1000)] | None = None
    """How many currents the message's list holds, where its definition says so; a message of another length is refused."""
    wraps_amp: Annotated[float, Ge(1), Le(1e9)] | None = None
    """A current above half of this is a negative one that was read as unsigned [A]."""

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield each key whose value cannot be, and what was wanted."""
        if not _TYPE.fullmatch(self.type):
            yield "type", "package/msg/Name"
        for key in ("voltage", "current"):
            if (text := getattr(self, key)) and not all(map(_FIELD.fullmatch, text.split("+"))):
                yield key, "fields joined by +, for example status.left_amp + amps[1]"
        if not self.voltage and not self.current:
            yield "current", "a voltage, a current or both"


@dataclass(frozen=True, slots=True)
class Profiles:
    """All that is known: robots by name, and power sources, best first."""

    robots: dict[str, Robot] = field(default_factory=dict)
    power_sources: list[PowerSource] = field(default_factory=list)

    def types(self, *, propulsion: bool = False) -> list[str]:
        """Return the message types that carry power, best first; with ``propulsion`` those that tell it apart for some robot."""
        return list(dict.fromkeys(of.type for of in self.power_sources if of.propulsion or not propulsion))

    def before(self, others: Profiles) -> Profiles:
        """Return these and others: a robot's name and a message type that are here are not taken from there."""
        mine = set(self.types())
        there = [source for source in others.power_sources if source.type not in mine]
        return Profiles({**others.robots, **self.robots}, [*self.power_sources, *there])


def fields_of(text: str) -> list[tuple[str, int | None]]:
    """Return the fields that a source's text joins by +: dotted name, and index where it is an element of a list."""
    found = [_FIELD.fullmatch(part) for part in text.split("+") if text]
    return [(of[1], None if of[2] is None else int(of[2])) for of in found if of]
