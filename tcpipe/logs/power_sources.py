"""Power sources: which message types carry voltage and current, which of their fields drive the wheels, and whether they can be believed.

A *rail* is one voltage and the currents drawn at it; a robot's propulsion power is the sum over its rails. What feeds computers and user
ports is never part of it where the message tells them apart (paper, section IV-A: "current consumed by the motors for propulsion").

Sources: husky_msgs/HuskyStatus, clearpath_platform_msgs/Power, jackal_msgs/Status and /Power, warthog_msgs/Status and
sensor_msgs/BatteryState as their packages define them; "Averaged over the message period" is those definitions' own wording.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.logs.profiles import Robot

Columns = Mapping[str, NDArray[Any]]
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Field:
    """A message field: its dotted name, and the index where it is a list."""

    column: str
    index: int | None = None


@dataclass(frozen=True, slots=True)
class RailFields:
    """Where a rail's voltage and currents stand in a message; None where it carries none. The currents are summed.

    A current above half of ``wraps_amp`` is a negative one that was read as unsigned.
    """

    name: str
    voltage: Field | None
    currents: tuple[Field, ...]
    wraps_amp: float | None = None


@dataclass(frozen=True, slots=True)
class PowerSource:
    """What a message type says about power.

    ``averaged``: over the message period, rather than sampled. ``sign``: +1 where a positive current is drawn, -1 where it charges, 0 where
    robots disagree. ``includes``: what the current feeds besides the drives. ``currents``: how many currents the message's list holds,
    where its definition says so.
    """

    rails: tuple[RailFields, ...]
    averaged: bool = False
    sign: int = 1
    includes: str = ""
    currents: int | None = None


@dataclass(frozen=True, slots=True)
class Rail:
    """A rail's readings, NaN where a row carries none: voltage [V] and current [A], shape (N,)."""

    name: str
    voltage_volt: Floats
    current_amp: Floats


BATTERY_STATE = "sensor_msgs/msg/BatteryState"
HUSKY_STATUS = "husky_msgs/msg/HuskyStatus"
CLEARPATH_POWER = "clearpath_platform_msgs/msg/Power"
_PERCENTAGE = "percentage"
_CURRENTS = "measured_currents"


def _of_list(name: str, *currents: int, averaged: bool = True, includes: str = "") -> PowerSource:
    """Return the source of a message whose lists begin with the battery's voltage."""
    fields = tuple(Field(_CURRENTS, index) for index in currents)
    return PowerSource((RailFields(name, Field("measured_voltages", 0), fields),), averaged, includes=includes)


_TOTAL = "computers and user ports (the message holds the total current only)"

_HUSKY_DRIVERS = ("left", "right")

POWER_SOURCES: dict[tuple[str, str], PowerSource] = {
    (HUSKY_STATUS, ""): PowerSource(
        (
            RailFields(
                "drive", Field("battery_voltage"), tuple(Field(f"{side}_driver_current") for side in _HUSKY_DRIVERS)
            ),
        )
    ),
    (HUSKY_STATUS, "drivers"): PowerSource(
        tuple(
            RailFields(f"{side}_driver", Field(f"{side}_driver_voltage"), (Field(f"{side}_driver_current"),))
            for side in _HUSKY_DRIVERS
        )
    ),
    (CLEARPATH_POWER, "A200"): replace(_of_list("drive", 1, 2), currents=3),
    (CLEARPATH_POWER, "A200 drivers"): PowerSource(
        tuple(
            RailFields(f"{side}_driver", Field("measured_voltages", index), (Field(_CURRENTS, index),))
            for index, side in enumerate(_HUSKY_DRIVERS, 1)
        ),
        averaged=True,
        currents=3,
    ),
    (CLEARPATH_POWER, "J100"): _of_list("drive", 2),
    **{(CLEARPATH_POWER, platform): _of_list("battery", 0, includes=_TOTAL) for platform in ("W200", "D100", "R100")},
    ("jackal_msgs/msg/Power", ""): _of_list("drive", 2),
    ("jackal_msgs/msg/Status", ""): PowerSource(
        (RailFields("drive", Field("measured_battery"), (Field("drive_current"),)),), averaged=True
    ),
    ("warthog_msgs/msg/Status", ""): PowerSource(
        (RailFields("battery", Field("measured_battery"), (Field("current_battery"),)),), averaged=True, includes=_TOTAL
    ),
    (BATTERY_STATE, ""): PowerSource((RailFields("", Field("voltage"), (Field("current"),)),), sign=0),
}
"""Power by message type and variant (platform; for a Husky also how its voltage is taken). D100 is every Dingo."""

PROPULSION_TYPES = (HUSKY_STATUS, CLEARPATH_POWER, "jackal_msgs/msg/Power", "jackal_msgs/msg/Status")
"""Message types that tell propulsion apart, best first."""

FLOAT_TYPES = ("std_msgs/msg/Float32", "std_msgs/msg/Float64")
"""A voltage or a current alone, told apart by the topic's name."""

POWER_TYPES = tuple(dict.fromkeys(type_name for type_name, _ in POWER_SOURCES))
"""Message types that carry voltage and current together."""


def power_source(
    type_name: str, topic: str, robot: Robot, *, husky_power: Literal["battery", "drivers"]
) -> PowerSource | str:
    """Return what a topic says about power, or one plain line that says why it cannot be known."""
    if type_name in FLOAT_TYPES:
        return _float_source(topic, robot)
    platform = robot.platform or ""
    variants = [platform, ""]
    if husky_power == "drivers":
        variants = [f"{platform} drivers", "drivers", *variants]
    for variant in variants:
        if (type_name, variant) in POWER_SOURCES:
            return POWER_SOURCES[type_name, variant]
    known = sorted(platform for name, platform in POWER_SOURCES if name == type_name and " " not in platform)
    if known:
        return f"{topic}: {type_name} names its currents by platform ({', '.join(known)}), robot {robot.name} is none of them"
    return f"{topic}: {type_name} carries no power that is known here"


_QUANTITY = re.compile(r"volt(?:age)?|curr(?:ent)?|amp(?:ere)?s?")
_CORRECTED = "_corrected"
_SEVCON_WRAP_AMP = 4096.0


def quantity(topic: str) -> Literal["voltage", "current"] | None:
    """Return what a bare number on a topic is, by the topic's last word that says so."""
    found = _QUANTITY.findall(topic.lower())
    if not found:
        return None
    return "voltage" if found[-1].startswith("v") else "current"


def bare_unit(type_name: str, topic: str) -> str | None:
    """Return the unit of a bare number on a topic, V or A, None where neither its type nor the name says so."""
    return {"voltage": "V", "current": "A", None: None}[quantity(topic) if type_name in FLOAT_TYPES else None]


def rail_of(topic: str) -> str:
    """Return the rail's name: the topic's without its quantity, so that a rail's voltage and current share it."""
    return _QUANTITY.sub("", topic.lower().removesuffix(_CORRECTED)).rstrip("/_")


def is_corrected(topic: str) -> bool:
    """Whether a topic is the corrected form of another (which is called the same without the word)."""
    return topic.lower().endswith(_CORRECTED)


def _float_source(topic: str, robot: Robot) -> PowerSource | str:
    """Return the source of a bare number, by its topic's name."""
    field = Field("data")
    match quantity(topic):
        case "voltage":
            return PowerSource((RailFields(rail_of(topic), field, ()),), sign=0)
        case "current":
            # The Warthog's motor controllers send a signed 16-bit number of 1/16 A as unsigned (norlab-ulaval/warthog_sevcon_fix).
            wraps = robot.name == "warthog" and topic.endswith("drive/status/battery_current")
            return PowerSource(
                (RailFields(rail_of(topic), None, (field,), _SEVCON_WRAP_AMP if wraps else None),), sign=0
            )
    return f"{topic}: neither its type nor its name says whether it is a voltage or a current"


def read_rails(columns: Columns, source: PowerSource, topic: str) -> list[Rail] | str:
    """Return the rails of a topic, or one plain line that says why its messages do not fit the source.

    Parameters
    ----------
    columns : the message's fields by dotted name; lists as shape (N, k), rows padded with NaN.
    source : from `power_source`.
    topic : its name; a rail without a name of its own is called so.
    """
    fields = [f for rail in source.rails for f in (rail.voltage, *rail.currents) if f is not None]
    for field in fields:
        if field.column not in columns:
            return f"{topic}: its messages have no field {field.column}"
        width = columns[field.column].shape[1] if columns[field.column].ndim == 2 else None
        if field.index is not None and (width is None or width <= field.index):
            return f"{topic}: {field.column} holds {width or 0} values, the robot's platform needs {field.index + 1}"
    held = columns[_CURRENTS].shape[1] if _CURRENTS in columns and columns[_CURRENTS].ndim == 2 else None
    if source.currents is not None and held != source.currents:
        return (
            f"{topic}: {_CURRENTS} holds {held} values, this platform's {source.currents}; name the robot with --robot"
        )
    rows = len(columns[fields[0].column])
    rails = []
    for rail in source.rails:
        voltage = np.full(rows, np.nan) if rail.voltage is None else _values(columns, rail.voltage)
        current = np.full(rows, np.nan)
        if rail.currents:
            current = np.sum([_values(columns, field) for field in rail.currents], axis=0)
        if rail.wraps_amp is not None:
            current = np.where(current > rail.wraps_amp / 2, current - rail.wraps_amp, current)
        rails.append(Rail(rail.name or topic, voltage, current))
    return rails


_IMPOSSIBLE = 1e6
"""No battery has more volts, no drive more amperes (a current in milliamperes is refused by its median)."""


def _values(columns: Columns, field: Field) -> Floats:
    values = columns[field.column]
    chosen = np.asarray(values if field.index is None else values[:, field.index], np.float64)
    return np.where(np.abs(chosen) <= _IMPOSSIBLE, chosen, np.nan)


def why_refused(rail: Rail, columns: Columns) -> str | None:
    """Return why a rail's numbers cannot be power, with the evidence, or None where they can.

    Each rule needs every row to agree, or the median; a single odd row is no evidence.
    """
    voltage, current = (values[np.isfinite(values)] for values in (rail.voltage_volt, rail.current_amp))
    if not len(voltage) and not len(current):
        return f"{rail.name}: neither voltage nor current is a number on any of {len(rail.voltage_volt)} rows"
    evidence = _against_voltage(voltage, current, rail.voltage_volt, columns) or _against_current(current)
    return None if evidence is None else f"{rail.name}: {evidence}"


def _against_voltage(voltage: Floats, current: Floats, every_voltage: Floats, columns: Columns) -> str | None:
    if not len(voltage):
        return None
    if not np.any(voltage):
        still = " and the current are" if len(current) and not np.any(current) else " is"
        return f"the voltage{still} zero on all {len(voltage)} rows"
    if _PERCENTAGE in columns:
        charge = np.asarray(columns[_PERCENTAGE], np.float64)
        if np.all(np.isclose(charge, every_voltage) | np.isclose(100 * charge, every_voltage)):
            return f"the voltage equals the percentage of charge on all {len(charge)} rows (first {voltage[0]:g})"
    typical_volt = float(np.median(voltage))
    if typical_volt > _LARGEST_VOLT:
        return f"the median voltage is {typical_volt:g} V (millivolts?)"
    if typical_volt < 1.0:
        return f"the median voltage is {typical_volt:g} V (a share of charge, or reversed?)"
    return None


def _against_current(current: Floats) -> str | None:
    if len(current) > _MIN_ROWS_TO_JUDGE and np.ptp(current) == 0:
        return f"the current is {current[0]:g} A on all {len(current)} rows"
    typical_amp = float(np.median(np.abs(current))) if len(current) else 0.0
    if typical_amp > LARGEST_AMP:
        return f"the median current is {typical_amp:g} A (milliamperes?)"
    return None


_LARGEST_VOLT = 1000.0
LARGEST_AMP = 1000.0
_MIN_ROWS_TO_JUDGE = 20
_UNAMBIGUOUS = 0.8


def sign_by_mean(current_amp: Floats, weight_s: Floats) -> tuple[int, float]:
    """Return the sign that makes the robot draw power over the run, and how one-sided its current is.

    A driving robot draws more than it feeds back, so the mean of its whole current tells how it is counted.

    Parameters
    ----------
    current_amp : [A], shape (N,), the sum of all rails as recorded.
    weight_s : [s], shape (N,), the time each row stands for.

    Returns
    -------
    sign : +1 or -1 where |∫I dt| > 0.8 ∫|I| dt, else 0.
    one_sidedness : ∫I dt / ∫|I| dt, in [-1, 1]; 0 where there is no current.
    """
    whole = float(np.nansum(np.abs(current_amp) * weight_s))
    ratio = float(np.nansum(current_amp * weight_s)) / whole if whole > 0 else 0.0
    return (int(np.sign(ratio)) if abs(ratio) > _UNAMBIGUOUS else 0), ratio


def with_sign(rail: Rail, sign: int) -> Rail:
    """Return the rail with its current positive when drawn."""
    return replace(rail, current_amp=sign * rail.current_amp)
