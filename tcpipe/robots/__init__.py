"""Profiles of robots and of messages with their power: TOML files in this folder, read by `tcpipe.formats.recipe_toml`.

A recipe may contain the same tables, ``[robots.NAME]`` and ``[[power_sources]]``, which have priority.

Robots and power sources as plain records: one schema for the package's own TOML files and for a recipe's tables.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

from tcpipe.tables.bounds import Bounds
from tcpipe.tables.findings import omit

Size = Annotated[float, Bounds(ge=0.05, le=100)]
"""Size of a robot [m]: from a toy's to a mining truck's."""
Speed = Annotated[float, Bounds(ge=0.01, le=100)]
PlausibleSpeed = Annotated[float, Bounds(ge=2, le=1000)]
"""A bound that no true track reaches [m/s]: at walking pace it would refuse robots that drive."""
Volt = Annotated[float, Bounds(ge=0.1, le=1e4)]
Scale = Annotated[float, Bounds(gt=0, le=1e9)]
Share = Annotated[float, Bounds(ge=0, le=1)]
Amp = Annotated[float, Bounds(ge=-1e4, le=1e4)]
Mass = Annotated[float, Bounds(ge=0.1, le=1e6)]
Watt = Annotated[float, Bounds(ge=0.1, le=1e7)]

GAIN_STD_FRACTION, OFFSET_STD_AMP = 0.02, 0.2
"""σ of gain and zero [A] of a current sensor without better knowledge: those of open-loop Hall sensors (Allegro ACS712,
20 A, data sheet: total output error ± 1.5 %; its zero drifts by 3.4 mA per kelvin, 0.14 A over 40 K), times 1.5."""

OFFSET_STD_WATT = 5.0
"""σ of the zero of a power without voltage [W]: that of a current at 24 V."""
NOMINAL_STD_FRACTION = 0.1
"""Relative σ of an assumed voltage [1]: lead batteries fall by 20 % of the nominal voltage, lithium by 25 %."""

TORQUE_GAIN_STD_FRACTION, LOSS_STD_FRACTION = 0.1, 0.3
"""Relative σ [1] of the gain of torques, which most drivers compute from the motor current with a nominal torque
constant (data sheets: ± 10 %), and of a stated loss: copper's resistance rises by 0.39 % a kelvin."""

TABLE_POWER = "tcpipe/msg/TablePower"
"""The type of a table of power, if it is neither a plain voltage nor a plain current."""

UNMEASURED_AMP = {
    "battery_status": (-1.0,),
    "": (0.0, 1.0, 1e-3, *(limit / 10**digits for limit in (32767, 32768, 65535) for digits in range(4))),
}
"""Currents [A] that mean "not measured", by message: PX4 defines -1. In all others (""), -1 and the limits of 16-bit
registers, of either sign, may be real: they count only if both neighbours are far. NaN, and a voltage of 0 V or less,
are never a measurement."""

GENERIC = "generic"
"""Name of an unknown robot."""

MAX_PLAUSIBLE_MPS = 15.0
"""No ground robot that records terrain costs is faster [m/s]: a faster track is an estimate that went astray."""

KNOWN_ENERGY = "e-scooter 36 to 146, Husky 170 to 340, Warthog 440 to 810 J/m"
"""Energy per metre of known robots: 51 trips of e-scooters (SFIEssential/DualEMobilityData), a simulated Husky, and
Warthogs on grass and snow (norlab-ulaval/DRIVE, fomo-sdk)."""

CurrentSign = Literal["drawn_positive", "drawn_negative", "auto"]

_QUANTITIES = ("voltage", "current", "power", "energy", "joints")
_FIELD = re.compile(r"\s*(?P<path>[\w.]+)(?P<of_list>\[(?P<index>\d*)\](?P<inner>\.[\w.]+)?)?\s*")
_TYPE = re.compile(r"\w+/msg/\w+")


@dataclass(frozen=True, slots=True)
class FieldPath:
    """One field of a message that a power source names.

    ``column`` is its column: the dotted name, with ``[]`` behind a list of messages (``drivers[].current``). ``index``
    selects an element of a list; with ``every`` all are summed. ``sign`` is -1 for a subtracted field.
    """

    column: str
    index: int | None = None
    every: bool = False
    sign: int = 1


@dataclass(frozen=True, slots=True)
class Robot:
    """Properties of a robot model; omitted keys are unknown."""

    width_m: Size | None = None
    """Width of its footprint, wheels or tracks included [m]."""
    length_m: Size | None = None
    """Length of its footprint [m]."""
    max_velocity_mps: Speed | None = None
    """Maximum speed [m/s]; below this command the terrain does not limit the speed."""
    max_plausible_mps: PlausibleSpeed = omit(MAX_PLAUSIBLE_MPS)
    """Largest plausible speed of a track [m/s]; faster rows get no label."""
    voltage_range_volt: tuple[Volt, Volt] | None = None
    """Lowest and highest voltage of the battery [V]; segments outside are flagged."""
    mass_kg: Mass | None = None
    """Mass while driving, with load [kg]; with it the power on slopes shows whether the power's scale is possible."""
    power_range_watt: tuple[Watt, Watt] | None = None
    """Range of the median power while driving, measured on this model and widened by a factor of three [W]."""
    platform: str | None = None
    """Platform code that power sources refer to (Clearpath's, as A200)."""
    status_types: list[str] = field(default_factory=list)
    """Message types that only this robot publishes; they identify it."""
    topic_words: list[str] = field(default_factory=list)
    """Words in topic names that identify this robot; whole words, in lower case."""

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield each key with an invalid value, and the expected value."""
        for key, what in (("voltage_range_volt", "voltages"), ("power_range_watt", "powers")):
            limits = getattr(self, key)
            if limits is not None and limits[0] >= limits[1]:
                yield key, f"the lower of two {what} first"


@dataclass(frozen=True, slots=True)
class PowerSource:
    """One power rail in a message type: a voltage and the current that drives the wheels at it. Use one table per rail.

    Fields are named by dotted path; ``volts[0]`` is an element of a list, ``drivers[0].amps`` a field of a message in a
    list, ``drivers[].amps`` the sum over all of them; ``left + right - spare`` is a sum of fields.
    """

    type: str
    """Message type, as package/msg/Name in ROS 1 and 2 alike."""
    voltage: str = ""
    """Field of the voltage [V]; omit it if the message contains only a current."""
    current: str = ""
    """Field of the current [A]; omit it if the message contains only a voltage, or a counter."""
    energy: str = ""
    """Field of a counter of energy, in place of a current, for example drawn - given_back."""
    power: str = omit("")
    """Field of the power [W], in place of a current; needs no voltage."""
    joints: str = omit("")
    """Joints whose torque times speed is the power: a regular expression of whole names."""
    voltage_scale: Scale = 1.0
    """Factor on the voltage: 0.001 if it is in millivolts."""
    current_scale: Scale = 1.0
    """Factor on the current or power: 0.001 if it is in milliamperes."""
    energy_scale: Scale = 1.0
    """Factor on the counter: 3600 if it counts watt-hours."""
    torque_scale: Scale = omit(1.0)
    """Factor on the efforts of joints, to N m."""
    speed_scale: Scale = omit(1.0)
    """Factor on the velocities of joints, to rad/s."""
    loss_watt_per_nm2: Annotated[float, Bounds(ge=0, le=1e6)] = omit(0.0)
    """Loss of each joint per squared torque: motor resistance / torque constant², at the joint."""
    recovered: bool = omit(False)
    """Whether negative power of a joint counts."""
    nominal_voltage_volt: Volt | None = omit()
    """Assumed voltage of a current [V]."""
    nominal_voltage_std_fraction: Share = omit(NOMINAL_STD_FRACTION)
    """Its σ, as a fraction: one error of a run."""
    counter_wraps: Annotated[float, Bounds(gt=0, le=1e19)] | None = None
    """Value at which the counter wraps to zero, in its own unit; if omitted, a decrease is a reset."""
    rail: str = ""
    """Name of the rail; default: that of the topic."""
    averaged: bool = False
    """Whether a value is the mean over the period that ends with the message, not an instantaneous sample."""
    averaging_unknown: bool = False
    """Averaging is unknown: tcpipe estimates it from the motion if possible, otherwise uses `averaged`."""
    sign: CurrentSign = "drawn_positive"
    """Sign of a drawn current; auto if it differs by robot: the mean over the run decides."""
    propulsion: bool = True
    """Whether the current feeds only the drives; such sources have priority."""
    gain_std_fraction: Share | None = omit()
    """σ of the sensor's gain, one error of a whole run; default: 0.02, of torques 0.1."""
    offset_std_amp: Annotated[float, Bounds(ge=0, le=1e4)] = omit(OFFSET_STD_AMP)
    """σ of the zero of the current, likewise [A]."""
    offset_std_watt: Annotated[float, Bounds(ge=0, le=1e6)] = omit(OFFSET_STD_WATT)
    """The same of a power without voltage [W]."""
    rest_current_amp: tuple[Amp, Amp] | None = omit()
    """Lowest and highest current of the stationary robot, if known; beyond is an offset [A]."""
    other_loads: str = ""
    """Other loads of the current; named in a warning."""
    open_questions: str = ""
    """Unknown properties; listed in the reference."""
    unsupported_reason: str = ""
    """Why this type does not measure power, and an alternative; the type is then never used and needs no fields."""
    rate_setting: str = ""
    """Setting of its rate; named if the rate is too low."""
    fallback: bool = False
    """Used only if the other tables of the type cannot be read or have no power (a current that is always zero)."""
    platform: str | None = None
    """Only for robots of this platform."""
    topic: str | None = None
    """Only for topics whose name ends with this."""
    husky_power: Literal["battery", "drivers"] | None = None
    """Only with this value of `read.husky_power`."""
    currents_listed: Annotated[int, Bounds(ge=1, le=1000)] | None = None
    """Number of currents in the message's list, if its definition states it; other lengths are rejected."""
    wraps_amp: Annotated[float, Bounds(ge=1, le=1e9)] | None = None
    """Currents above half of this are negative ones read as unsigned [A]; if omitted, inferred from the data."""

    @property
    def lacks_voltage(self) -> bool:
        """Whether only power or energy is known."""
        return bool(self.power or self.energy or self.joints) and not self.voltage and self.nominal_voltage_volt is None

    @property
    def zero_std(self) -> float:
        """σ of the zero of what is measured: of a current [A], of a power without voltage [W]; torques have none."""
        if self.joints:
            return 0.0
        return self.offset_std_watt if self.lacks_voltage else self.offset_std_amp

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield each key with an invalid value, and the expected value."""
        if not _TYPE.fullmatch(self.type):
            yield "type", "package/msg/Name"
        yield from self._field_contradictions([key for key in _QUANTITIES if getattr(self, key)])
        if self.rest_current_amp is not None and self.rest_current_amp[0] > self.rest_current_amp[1]:
            yield "rest_current_amp", "the lower of two currents first"
        if self.voltage and self.nominal_voltage_volt is not None:
            yield "nominal_voltage_volt", "no measured voltage besides it"

    def _field_contradictions(self, keys: Sequence[str]) -> Iterator[tuple[str, str]]:
        for key in keys:
            if key != "joints" and not all(map(_FIELD.fullmatch, re.split(r"[+-]", getattr(self, key)))):
                yield key, "fields joined by + or -, for example status.left_amp + amps[1] or drivers[].amp"
        if self.unsupported_reason:
            if keys:
                yield "unsupported_reason", "no field besides it"
        elif not keys:
            yield "current", "a voltage, a current or both, a power, a counter of energy, or joints"
        elif len(set(keys) - {"voltage"}) > 1 or (self.joints and self.voltage):
            yield "current", "one of current, power, energy and joints (these without a voltage)"
        try:
            re.compile(self.joints)
        except re.error as problem:
            yield "joints", f"a regular expression ({problem})"


@dataclass(frozen=True, slots=True)
class Profiles:
    """All that is known: robots by name, and power sources, best first."""

    robots: dict[str, Robot] = field(default_factory=dict)
    power_sources: list[PowerSource] = field(default_factory=list)

    def types(self, *, propulsion: bool = False) -> list[str]:
        """Return message types with power, best first; with ``propulsion`` those that measure it separately."""
        return list(
            dict.fromkeys(
                source.type
                for source in self.power_sources
                if (source.propulsion and not source.unsupported_reason) or not propulsion
            )
        )

    def refusals(self) -> dict[str, str]:
        """Return the message types that carry currents but do not determine the power, and why."""
        telling = {source.type for source in self.power_sources if not source.unsupported_reason}
        return {source.type: source.unsupported_reason for source in self.power_sources if source.type not in telling}

    def before(self, others: Profiles) -> Profiles:
        """Return these and others: a robot's name and a message type that are here are not taken from there."""
        own_types = set(self.types())
        kept_sources = [source for source in others.power_sources if source.type not in own_types]
        return Profiles({**others.robots, **self.robots}, [*self.power_sources, *kept_sources])


def parse_fields(text: str) -> list[FieldPath]:
    """Return the fields that a source's text joins by + and -."""
    found = []
    for part in re.finditer(r"([+-]?)([^+-]+)", text):
        if match := _FIELD.fullmatch(part[2]):
            column = match["path"] + (f"[]{match['inner']}" if match["inner"] else "")
            index = int(match["index"]) if match["index"] else None
            found.append(
                FieldPath(column, index, bool(match["of_list"]) and index is None, -1 if part[1] == "-" else 1)
            )
    return found
