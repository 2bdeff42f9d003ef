"""From the messages of one or several power topics to rails that can be believed, with every current positive when drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from tcpipe.logs.messages import LOG_TIME, Columns, Floats, Readings, header_ns
from tcpipe.logs.power_sources import (
    LARGEST_AMP,
    PowerSource,
    Rail,
    power_source,
    read_rails,
    sign_by_mean,
    why_refused,
    with_sign,
)
from tcpipe.logs.profiles import Robot

_OF_USUAL_VOLTAGE = (0.2, 3.0)
"""A battery's voltage stays within these shares of its median."""
_FEWEST_MESSAGES = 3
_SLOWEST_S = 10.0
_FEWEST_ROWS = 20
"""Fewer rows say nothing against the sign of their type."""

CurrentSign = Literal["auto", "drawn_positive", "drawn_negative"]


@dataclass(frozen=True, slots=True)
class PowerReadings:
    """What the power topics hold.

    ``readings`` has, by topic, one voltage and one current column for each of its ``rails`` (see `columns_of`); it is empty where the power
    was refused, and ``warnings`` says why.
    """

    readings: dict[str, Readings] = field(default_factory=dict)
    rails: dict[str, tuple[str, ...]] = field(default_factory=dict)
    averaged: bool = False
    warnings: tuple[str, ...] = ()
    current_sign: str | None = None
    """What a drawn current is counted as, and what tells it; None without power."""


def columns_of(rail: str) -> tuple[str, str]:
    """Return the names of a rail's voltage and current columns in its topic's readings."""
    return f"{rail}: voltage_volt", f"{rail}: current_amp"


def read_power(
    topics: Mapping[str, tuple[str, Columns]],
    robot: Robot,
    *,
    husky_power: Literal["battery", "drivers"] = "battery",
    current_sign: CurrentSign = "auto",
) -> PowerReadings:
    """Return the rails of all power topics.

    Parameters
    ----------
    topics : message type and columns by topic.
    robot : the profile; it names the platform of clearpath_platform_msgs/Power.
    husky_power, current_sign : recipe keys.
    """
    rails: dict[str, list[Rail]] = {}
    sources: list[PowerSource] = []
    refused: list[str] = []
    for topic, (type_name, columns) in topics.items():
        source = power_source(type_name, topic, robot, husky_power=husky_power)
        found = source if isinstance(source, str) else read_rails(columns, source, topic)
        if isinstance(found, str) or isinstance(source, str):
            refused.append(str(found))
            continue
        refused += [why for rail in found if (why := why_refused(rail, columns)) is not None]
        refused += _too_seldom(topic, np.asarray(columns[LOG_TIME], np.float64))
        sources.append(source)
        rails[topic] = found
    rails = _paired(rails)
    refused = refused or _incomplete([rail for found in rails.values() for rail in found])
    if refused:
        return PowerReadings(warnings=tuple(f"power refused: {why}; there will be no energy" for why in refused))
    rails, odd = _believable(rails)
    log_times = {topic: np.asarray(columns[LOG_TIME], np.float64) for topic, (_, columns) in topics.items()}
    sign, warnings, told = _sign(rails, log_times, sources, current_sign)
    if sign == 0:
        return PowerReadings(warnings=tuple(warnings))
    warnings += odd
    warnings += [f"power: {source.includes} are part of it" for source in sources if source.includes]
    return PowerReadings(
        {
            topic: _readings(topics[topic][1], [with_sign(rail, sign) for rail in found])
            for topic, found in rails.items()
        },
        {topic: tuple(rail.name for rail in found) for topic, found in rails.items()},
        any(source.averaged for source in sources),
        tuple(dict.fromkeys(warnings)),
        told,
    )


def _paired(rails: dict[str, list[Rail]]) -> dict[str, list[Rail]]:
    """Give the one rail without current and the one without voltage a common name: they are one rail on two topics."""
    flat = [rail for found in rails.values() for rail in found]
    without_voltage = [rail.name for rail in flat if not np.isfinite(rail.voltage_volt).any()]
    without_current = [rail.name for rail in flat if not np.isfinite(rail.current_amp).any()]
    if len(without_voltage) != 1 or len(without_current) != 1 or without_voltage == without_current:
        return rails
    pair = {*without_voltage, *without_current}
    return {
        topic: [replace(rail, name="battery") if rail.name in pair else rail for rail in found]
        for topic, found in rails.items()
    }


def _incomplete(rails: list[Rail]) -> list[str]:
    missing = []
    for name in dict.fromkeys(rail.name for rail in rails):
        parts = [rail for rail in rails if rail.name == name]
        for what, values in (
            ("voltage", [rail.voltage_volt for rail in parts]),
            ("current", [rail.current_amp for rail in parts]),
        ):
            if not any(np.isfinite(value).any() for value in values):
                missing.append(f"{name}: it carries no {what}")
    return missing


def _too_seldom(topic: str, log_time_ns: Floats) -> list[str]:
    """Return why a topic cannot tell what a metre costs: too few messages, or too far apart."""
    if log_time_ns.size < _FEWEST_MESSAGES:
        return [f"{topic}: it holds {log_time_ns.size} messages only"]
    period_s = float(np.median(np.diff(log_time_ns))) / 1e9
    return [f"{topic}: it comes every {period_s:.0f} s only"] if period_s > _SLOWEST_S else []


def _believable(rails: Mapping[str, list[Rail]]) -> tuple[dict[str, list[Rail]], list[str]]:
    """Return the rails with NaN for single values that no battery and no drive has (saturated, lost), and a line on each rail.

    Without current a low voltage may be true: a drive that is not switched on yet tells zeros.
    """
    kept: dict[str, list[Rail]] = {}
    lines = []
    for topic, found in rails.items():
        kept[topic] = []
        for rail in found:
            known = rail.voltage_volt[np.isfinite(rail.voltage_volt)]
            usual = float(np.median(known)) if known.size else np.nan
            low_volt, high_volt = usual * _OF_USUAL_VOLTAGE[0], usual * _OF_USUAL_VOLTAGE[1]
            odd_volt = ((rail.voltage_volt < low_volt) & (rail.current_amp != 0.0)) | (rail.voltage_volt > high_volt)
            odd_amp = np.abs(rail.current_amp) > LARGEST_AMP
            counts = [(odd_volt, f"voltages outside {low_volt:.0f} to {high_volt:.0f} V")]
            counts += [(odd_amp, f"currents above {LARGEST_AMP:.0f} A")]
            said = [f"{np.count_nonzero(odd)} {what}" for odd, what in counts if odd.any()]
            if said:
                lines.append(f"power: {rail.name}: {' and '.join(said)} are set aside")
            volt, amp = np.where(odd_volt, np.nan, rail.voltage_volt), np.where(odd_amp, np.nan, rail.current_amp)
            kept[topic].append(replace(rail, voltage_volt=volt, current_amp=amp))
    return kept, lines


def _sign(
    rails: Mapping[str, list[Rail]], log_times: Mapping[str, Floats], sources: list[PowerSource], given: CurrentSign
) -> tuple[int, list[str], str]:
    """Return what makes a drawn current positive (0 where the record contradicts its type), warnings, and what tells it."""
    if given != "auto":
        return (1 if given == "drawn_positive" else -1), [], f"{given} (recipe)"
    time_s, whole = _whole_current(rails, log_times)
    sign, one_sided = sign_by_mean(whole, _weight_s(time_s))
    share = f"{100 * abs(one_sided):.0f} % of the charge moved"
    if all(source.sign for source in sources):
        if sign >= 0 or time_s.size < _FEWEST_ROWS:
            return 1, [], "drawn_positive (message type)"
        why = f"power refused: the current is negative, {share} flows back; there will be no energy"
        cure = (
            'if this robot counts drawn current so, write in the recipe under [read]: current_sign = "drawn_negative"'
        )
        return 0, [f'{why}; {cure}; if it truly rolled downhill throughout: "drawn_positive"'], ""
    if sign > 0:
        why = f"power: the current counts as positive when drawn, against the ROS convention: {share} is positive"
        return (
            1,
            [f'{why}; settle it with read.current_sign = "drawn_positive"'],
            "drawn_positive (mean)",
        )
    if sign < 0:
        return -1, [], "drawn_negative (mean, as ROS has it)"
    why = f"power: the current's sign is unclear (net {share}): taken as negative when drawn, as ROS has it"
    return (
        -1,
        [f'{why}; settle it with read.current_sign = "drawn_positive" or "drawn_negative"'],
        "drawn_negative (ROS)",
    )


def _weight_s(time_s: Floats) -> Floats:
    """Return the time that each row stands for [s]; beside a hole no more than usual, or one row would outweigh a run."""
    if time_s.size < 2:
        return np.ones_like(time_s)
    between = np.gradient(time_s)
    weight: Floats = np.clip(between, 0.0, 3.0 * float(np.median(between)))
    return weight


def _whole_current(rails: Mapping[str, list[Rail]], log_times: Mapping[str, Floats]) -> tuple[Floats, Floats]:
    """Return the sum of all rails' currents [A] at the log times of the first topic that carries one, and these times [s]."""
    parts = [
        (log_times[topic][known] / 1e9, rail.current_amp[known])
        for topic, found in rails.items()
        for rail in found
        if (known := np.isfinite(rail.current_amp)).any()
    ]
    time_s = parts[0][0]
    return time_s, np.sum([np.interp(time_s, at, current) for at, current in parts], axis=0)


def _readings(columns: Columns, rails: list[Rail]) -> Readings:
    """Return the rows on which at least one rail carries a voltage or a current."""
    values = {
        name: v
        for rail in rails
        for name, v in zip(columns_of(rail.name), (rail.voltage_volt, rail.current_amp), strict=True)
    }
    row = np.flatnonzero(np.any([np.isfinite(value) for value in values.values()], axis=0))
    stamps = header_ns(columns)
    lost = len(columns[LOG_TIME]) - len(row)
    return Readings(
        row,
        columns[LOG_TIME][row].astype(np.int64),
        None if stamps is None else stamps[row],
        {name: value[row] for name, value in values.items()},
        {"not_finite": lost} if lost else {},
    )
