"""From a power topic's messages to voltages and currents, by the tables that say what its type means; and whether they can be believed.

A *rail* is one voltage and the currents drawn at it; a robot's propulsion power is the sum over its rails. What feeds computers and user
ports is never part of it where the message tells them apart (paper, section IV-A: "current consumed by the motors for propulsion").
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.power.counters import Counter, counted
from tcpipe.recipe.suggestions import recipe_key
from tcpipe.robots.profiles import FieldPath, PowerSource, fields_of

Columns = Mapping[str, NDArray[Any]]
Floats = NDArray[np.float64]
HuskyPower = Literal["battery", "drivers"]


@dataclass(frozen=True, slots=True)
class RailReadings:
    """A rail's readings, NaN where a row carries none: voltage [V] and current [A], shape (N,).

    Of a counter of energy the current is a first one, by times that nobody has judged yet.
    """

    name: str
    voltage_volt: Floats
    current_amp: Floats
    counter: Counter | None = None


BATTERY_STATE = "sensor_msgs/msg/BatteryState"
_PERCENTAGE = "percentage"

FLOAT_TYPES = ("std_msgs/msg/Float32", "std_msgs/msg/Float64")
"""A voltage or a current alone, told apart by the topic's name."""


def sources_of(
    type_name: str, topic: str, known: Sequence[PowerSource], *, platform: str | None, husky_power: HuskyPower
) -> list[list[PowerSource]] | str:
    """Return what a topic says about power, one source a rail, then what to fall back on; or one plain line why it cannot be known.

    Of the tables of its type that fit, the most particular count: those of ``husky_power``, of the platform, of the topic.
    """
    of_type = [source for source in known if source.type == type_name]
    fitting = [
        source
        for source in of_type
        if source.platform in (None, platform)
        and source.husky_power in (None, husky_power)
        and topic.endswith(source.topic or "")
    ]
    choices = [_most_particular([of for of in fitting if of.fallback is last]) for last in (False, True)]
    if choices := [choice for choice in choices if choice]:
        refused = next((of.refused for of in choices[0] if of.refused), None)
        return f"{topic}: {type_name} {refused}" if refused else choices
    if type_name in FLOAT_TYPES:
        return _float_source(type_name, topic)
    platforms = sorted({source.platform for source in of_type if source.platform})
    if platforms:
        which = f"this robot's is {platform or 'not known'}; name the robot with --robot"
        return f"{topic}: {type_name} names its currents by platform ({', '.join(platforms)}), {which}"
    return f"{topic}: {type_name} carries no power that is known here; describe it ({recipe_key('power_sources')})"


def power_lists(type_name: str, known: Sequence[PowerSource]) -> frozenset[str]:
    """Return the columns inside lists of messages that a type's tables name, as drivers[].current."""
    texts = [text for of in known if of.type == type_name for text in (of.voltage, of.current, of.energy)]
    return frozenset(of.column for text in texts for of in fields_of(text) if "[]." in of.column)


def _most_particular(fitting: Sequence[PowerSource]) -> list[PowerSource]:
    best = max(map(_particular, fitting), default=None)
    return [source for source in fitting if _particular(source) == best]


def _particular(source: PowerSource) -> tuple[bool, bool, bool]:
    return source.husky_power is not None, source.platform is not None, source.topic is not None


_QUANTITY = re.compile(r"volt(?:age)?|curr(?:ent)?|amp(?:ere)?s?")
_CORRECTED = "_corrected"


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


def is_of_drives(topic: str) -> bool:
    """Whether a topic's name says that it is of what drives, rather than of a whole battery."""
    return re.search(r"drive|motor|traction|wheel|esc(?![a-z])|inverter", topic.lower()) is not None


def is_corrected(topic: str) -> bool:
    """Whether a topic is the corrected form of another (which is called the same without the word)."""
    return topic.lower().endswith(_CORRECTED)


def _float_source(type_name: str, topic: str) -> list[list[PowerSource]] | str:
    """Return the source of a bare number, by its topic's name."""
    what = quantity(topic)
    if what is None:
        return f"{topic}: neither its type nor its name says whether it is a voltage or a current"
    voltage, current = ("data", "") if what == "voltage" else ("", "data")
    return [[PowerSource(type_name, voltage, current, sign="auto")]]


def read_rails(
    columns: Columns, sources: Sequence[PowerSource], topic: str, known: Sequence[PowerSource] = ()
) -> list[RailReadings] | str:
    """Return the rails of a topic, or one plain line that says why its messages do not fit the sources.

    Parameters
    ----------
    columns : ``log_time_ns`` and the message's fields by dotted name; lists as shape (N, k), rows padded with NaN.
    sources : from `sources_of`.
    topic : its name; a rail without a name of its own is called so.
    known : every table, for those that would fit.
    """
    for source in sources:
        if why := _misfit(columns, source, known):
            return f"{topic}: {why}"
    return [_rail(columns, source, topic) for source in sources]


def _misfit(columns: Columns, source: PowerSource, known: Sequence[PowerSource]) -> str | None:
    """Return why messages do not fit a source."""
    currents = fields_of(source.current)
    for of in [*fields_of(source.voltage), *currents, *fields_of(source.energy)]:
        if of.column not in columns:
            return f"its messages have no field {of.column}"
        width = columns[of.column].shape[1] if columns[of.column].ndim == 2 else None
        if not of.every and of.index is None and width is not None:
            return f"{of.column} is a list; wanted {of.column}[0] for one of its values, {of.column}[] for their sum"
        needed = of.index + 1 if of.index is not None else int(of.every)
        if needed and (width is None or width < needed):
            return f"{of.column} holds {width or 0} values, the robot's platform needs {needed}"
        if of in currents and source.currents_listed not in (None, width):
            return f"{of.column} holds {width} values, this platform's {source.currents_listed}; {_fitting(source, width, known)}"
    return None


def _fitting(source: PowerSource, width: int | None, known: Sequence[PowerSource]) -> str:
    """Return which robot's message it could be, by how many currents it lists."""
    platforms = {of.platform for of in known if of.type == source.type and of.currents_listed == width and of.platform}
    which = f" of platform {', '.join(sorted(platforms))}" if platforms else ""
    return f"name the robot{which} with --robot"


def _rail(columns: Columns, source: PowerSource, topic: str) -> RailReadings:
    name = source.rail or (rail_of(topic) if source.type in FLOAT_TYPES else topic)
    voltage = source.voltage_scale * _summed(columns, fields_of(source.voltage))
    if source.energy:
        parts = [(of.sign * source.energy_scale, _values(columns, of)) for of in fields_of(source.energy)]
        counter = counted(parts, wraps=source.counter_wraps)
        return RailReadings(name, voltage, counter.mean_amp(_first_stamps(columns), voltage), counter)
    current = source.current_scale * _summed(columns, fields_of(source.current))
    if source.wraps_amp is not None:
        current = np.where(current > source.wraps_amp / 2, current - source.wraps_amp, current)
    return RailReadings(name, voltage, current)


def _first_stamps(columns: Columns) -> NDArray[np.int64]:
    """Return the header's stamps where all are set, else the log's times [ns]: messages are written down in bursts."""
    if "header.stamp.sec" in columns:
        stamps = np.asarray(columns["header.stamp.sec"], np.int64) * 1_000_000_000
        stamps += np.asarray(columns["header.stamp.nanosec"], np.int64)
        if stamps.all():
            return stamps
    return np.asarray(columns["log_time_ns"], np.int64)


def _summed(columns: Columns, fields: Sequence[FieldPath]) -> Floats:
    """Return the sum of fields, NaN where there is none or one of them is not known."""
    if not fields:
        return np.full(len(next(iter(columns.values()))), np.nan)
    parts = [
        np.where(np.abs(values) <= _IMPOSSIBLE, values, np.nan) for values in (_values(columns, of) for of in fields)
    ]
    total: Floats = np.sum([of.sign * values for of, values in zip(fields, parts, strict=True)], axis=0)
    return total


_IMPOSSIBLE = 1e6
"""No battery has more volts, no drive more amperes (a current in milliamperes is refused by its median)."""


def _values(columns: Columns, of: FieldPath) -> Floats:
    """Return a field's values, shape (N,); of a list that is summed NaN where a row is shorter than others."""
    values = np.asarray(columns[of.column], np.float64)
    return values.sum(axis=1) if of.every else values if of.index is None else values[:, of.index]


def why_refused(rail: RailReadings, columns: Columns) -> str | None:
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
    if typical_volt > LARGEST_VOLT:
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


LARGEST_VOLT = 1000.0  # the median of no robot's battery: millivolts
LARGEST_AMP = 1000.0  # no drive draws more: milliamperes, or a number that wrapped
_MIN_ROWS_TO_JUDGE = 20  # fewer may be equal by chance, rounded as they are
_UNAMBIGUOUS = 0.8  # of the charge moved flows one way


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


def with_sign(rail: RailReadings, sign: int) -> RailReadings:
    """Return the rail with its current positive when drawn."""
    counter = None if rail.counter is None else rail.counter.times(sign)
    return replace(rail, current_amp=sign * rail.current_amp, counter=counter)
