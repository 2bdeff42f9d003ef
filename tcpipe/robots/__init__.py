"""What is known of robots and of the messages that tell their power: TOML files beside this one, read by `tcpipe.formats.recipe_toml`.

A recipe holds the same tables, ``[robots.NAME]`` and ``[[power_sources]]``; they go before these.

Robots and power sources as plain records: one schema for the package's own TOML files and for a recipe's tables.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Literal

from tcpipe.tables.bounds import Bounds

Size = Annotated[float, Bounds(ge=0.05, le=100)]
"""Of a robot [m]: from a toy's to a mining truck's."""
Speed = Annotated[float, Bounds(ge=0.01, le=100)]
PlausibleSpeed = Annotated[float, Bounds(ge=2, le=1000)]
"""A bound that no true track reaches [m/s]: at walking pace it would refuse robots that drive."""
Volt = Annotated[float, Bounds(ge=0.1, le=1e4)]
Scale = Annotated[float, Bounds(gt=0, le=1e9)]

GENERIC = "generic"
"""The name of a robot of which nothing is known."""

MAX_PLAUSIBLE_MPS = 15.0
"""No ground robot that records terrain costs is faster [m/s]: a faster track is an estimate that went astray."""

CurrentSign = Literal["drawn_positive", "drawn_negative", "auto"]

_FIELD = re.compile(r"\s*(?P<path>[\w.]+)(?P<of_list>\[(?P<index>\d*)\](?P<inner>\.[\w.]+)?)?\s*")
_TYPE = re.compile(r"\w+/msg/\w+")


@dataclass(frozen=True, slots=True)
class FieldPath:
    """One field of a message that a power source names.

    ``column`` is its column: the dotted name, with ``[]`` behind a list of messages (``drivers[].current``). Of a list ``index`` is the
    element that is meant, and with ``every`` all are summed. ``sign`` is -1 where it is subtracted.
    """

    column: str
    index: int | None = None
    every: bool = False
    sign: int = 1


@dataclass(frozen=True, slots=True)
class Robot:
    """What is known of a robot before its log is opened; what is left out is not known."""

    width_m: Size | None = None
    """Width of its footprint, wheels or tracks included [m]."""
    length_m: Size | None = None
    """Length of its footprint [m]."""
    max_velocity_mps: Speed | None = None
    """Maximum speed [m/s]; a segment that was commanded slower than this is not at the terrain's limit."""
    max_plausible_mps: PlausibleSpeed = field(default=MAX_PLAUSIBLE_MPS, metadata={"json": (MAX_PLAUSIBLE_MPS,)})
    """A track of this robot that is faster is wrong [m/s]: it bears no label there."""
    voltage_range_volt: tuple[Volt, Volt] | None = None
    """Lowest and highest voltage that its battery has [V]; a segment beyond is flagged."""
    platform: str | None = None
    """The kind of robot by which power sources tell it apart (Clearpath's code, as A200)."""
    status_types: list[str] = field(default_factory=list)
    """Message types that only this robot publishes; a log that holds one is of it."""
    topic_words: list[str] = field(default_factory=list)
    """Words by which a topic's name tells this robot; whole words, in small letters."""

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield each key whose value cannot be, and what was wanted."""
        if self.voltage_range_volt is not None and self.voltage_range_volt[0] >= self.voltage_range_volt[1]:
            yield "voltage_range_volt", "the lower of two voltages first"


@dataclass(frozen=True, slots=True)
class PowerSource:
    """What a message type tells of one rail: one voltage and the current that drives the wheels at it. Several rails are several tables.

    Fields are named by dotted path; ``volts[0]`` is an element of a list, ``drivers[0].amps`` a field of a message in a list,
    ``drivers[].amps`` the sum over all of them; ``left + right - spare`` is a sum of fields.
    """

    type: str
    """Message type, as package/msg/Name in ROS 1 and 2 alike."""
    voltage: str = ""
    """Field of the voltage [V]; none where the message carries a current alone."""
    current: str = ""
    """Field of the current [A]; none where it carries a voltage alone, or a counter."""
    energy: str = ""
    """Field of a counter of energy, in place of a current, for example drawn - given_back."""
    voltage_scale: Scale = 1.0
    """What the voltage's field is multiplied by: 0.001 where it is in millivolts."""
    current_scale: Scale = 1.0
    """What the current's field is multiplied by: 0.001 where it is in milliamperes."""
    energy_scale: Scale = 1.0
    """What the counter is multiplied by: 3600 where it counts watt-hours."""
    counter_wraps: Annotated[float, Bounds(gt=0, le=1e19)] | None = None
    """Where the counter begins at zero again, in its own unit; without, a counter that falls was reset."""
    rail: str = ""
    """The rail's name; none takes the topic's."""
    averaged: bool = False
    """Whether a value is the mean over the period that ends with the message, rather than sampled."""
    averaging_unknown: bool = False
    """Nobody knows whether it averages: the motion tells where it can, else `averaged` counts."""
    sign: CurrentSign = "drawn_positive"
    """Which sign a drawn current has; auto where robots disagree: the mean over the run tells."""
    propulsion: bool = True
    """Whether the current drives the wheels alone; such a source is taken before others."""
    other_loads: str = ""
    """What the current feeds besides the drives; said in a warning."""
    open_questions: str = ""
    """What is not known of it; stands in the reference."""
    unsupported_reason: str = ""
    """Why this type tells no power, and what would; then it plays no role, and no field is named."""
    rate_setting: str = ""
    """What sets its rate; said where it comes too slowly."""
    fallback: bool = False
    """Only where the type's other tables cannot be read or hold no power (a current that is zero throughout)."""
    platform: str | None = None
    """Only for robots of this platform."""
    topic: str | None = None
    """Only for topics whose name ends so."""
    husky_power: Literal["battery", "drivers"] | None = None
    """Only where `read.husky_power` says so."""
    currents_listed: Annotated[int, Bounds(ge=1, le=1000)] | None = None
    """How many currents the message's list holds, where its definition says so; a message of another length is refused."""
    wraps_amp: Annotated[float, Bounds(ge=1, le=1e9)] | None = None
    """A current above half of this is a negative one that was read as unsigned [A]; without, the record tells."""

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield each key whose value cannot be, and what was wanted."""
        if not _TYPE.fullmatch(self.type):
            yield "type", "package/msg/Name"
        for key in ("voltage", "current", "energy"):
            if (text := getattr(self, key)) and not all(map(_FIELD.fullmatch, re.split(r"[+-]", text))):
                yield key, "fields joined by + or -, for example status.left_amp + amps[1] or drivers[].amp"
        if self.unsupported_reason:
            if self.voltage or self.current or self.energy:
                yield "unsupported_reason", "no field beside it"
        elif not self.voltage and not self.current:
            yield "current", "a voltage, a current or both"
        if self.energy and (self.current or not self.voltage):
            yield "energy", "a voltage beside it, and no current"


@dataclass(frozen=True, slots=True)
class Profiles:
    """All that is known: robots by name, and power sources, best first."""

    robots: dict[str, Robot] = field(default_factory=dict)
    power_sources: list[PowerSource] = field(default_factory=list)

    def types(self, *, propulsion: bool = False) -> list[str]:
        """Return the message types that carry power, best first; with ``propulsion`` those that tell it apart for some robot."""
        return list(
            dict.fromkeys(
                of.type for of in self.power_sources if (of.propulsion and not of.unsupported_reason) or not propulsion
            )
        )

    def refusals(self) -> dict[str, str]:
        """Return the message types that carry currents but tell no power, and why."""
        telling = {of.type for of in self.power_sources if not of.unsupported_reason}
        return {of.type: of.unsupported_reason for of in self.power_sources if of.type not in telling}

    def before(self, others: Profiles) -> Profiles:
        """Return these and others: a robot's name and a message type that are here are not taken from there."""
        mine = set(self.types())
        there = [source for source in others.power_sources if source.type not in mine]
        return Profiles({**others.robots, **self.robots}, [*self.power_sources, *there])


def parse_fields(text: str) -> list[FieldPath]:
    """Return the fields that a source's text joins by + and -."""
    found = []
    for part in re.finditer(r"([+-]?)([^+-]+)", text):
        if of := _FIELD.fullmatch(part[2]):
            column = of["path"] + (f"[]{of['inner']}" if of["inner"] else "")
            index = int(of["index"]) if of["index"] else None
            found.append(FieldPath(column, index, bool(of["of_list"]) and index is None, -1 if part[1] == "-" else 1))
    return found
