"""From the messages of one or several power topics to rails that can be believed, with every current positive when drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from tcpipe.power.sources import (
    BATTERY_STATE,
    FLOAT_TYPES,
    LARGEST_AMP,
    Columns,
    Floats,
    HuskyPower,
    RailReadings,
    read_rails,
    sign_by_mean,
    sources_of,
    why_refused,
    with_sign,
)
from tcpipe.power.wrapped import wrap_of
from tcpipe.recipe.suggestions import RecipeFragment, suggested
from tcpipe.robots.profiles import CurrentSign, PowerSource
from tcpipe.tables.facts import NoPower

_LOG_TIME = "log_time_ns"
_OF_USUAL_VOLTAGE = (0.2, 3.0)
"""A battery's voltage stays within these shares of its median."""
_FEWEST_MESSAGES = 3
_SLOWEST_S = 10.0
_FEWEST_ROWS = 20
"""Fewer rows say nothing against the sign of their type."""

Rails = Mapping[str, list[RailReadings]]
"""By topic."""


@dataclass(frozen=True, slots=True)
class PowerReadings:
    """What the power topics hold: ``rails`` row by row as the messages; none where the power was refused, and ``warnings`` says why."""

    rails: Rails = field(default_factory=dict)
    averaged: bool = False
    averaging_unknown: bool = False
    """Nobody knows whether it averages; ``averaged`` is what to take where the motion does not tell either."""
    warnings: tuple[str, ...] = ()
    current_sign: str | None = None
    """What a drawn current is counted as, and what tells it; None without power."""
    includes: tuple[str, ...] = ()
    """What the currents feed besides the drives."""
    refusal: NoPower | None = None
    """Why there are no rails, where there are topics."""


def read_power(
    topics: Mapping[str, tuple[str, Columns]],
    known: Sequence[PowerSource],
    *,
    platform: str | None = None,
    husky_power: HuskyPower = "battery",
    current_sign: CurrentSign = "auto",
) -> PowerReadings:
    """Return the rails of all power topics, with every current positive when drawn.

    Parameters
    ----------
    topics : message type and columns by topic.
    known : what message types tell of power.
    platform : of the robot.
    husky_power, current_sign : recipe keys.
    """
    rails: dict[str, list[RailReadings]] = {}
    sources: list[PowerSource] = []
    refused: list[str] = []
    mended: dict[str, list[PowerSource]] = {}
    warnings: list[str] = []
    for topic, (type_name, columns) in topics.items():
        if seldom := _too_seldom(topic, np.asarray(columns[_LOG_TIME], np.float64)):
            refused += seldom
            continue
        choices = sources_of(type_name, topic, known, platform=platform, husky_power=husky_power)
        found = choices if isinstance(choices, str) else _first_that_holds_power(topic, columns, choices, known)
        if isinstance(found, str):
            refused.append(found)
            mended[topic] = [] if isinstance(choices, str) else _in_thousandths(topic, columns, choices[0], known)
            continue
        sources += found.sources
        warnings += found.warnings
        rails[topic] = found.rails if current_sign != "auto" else found.by_type()
    rails = _paired(rails)
    refused = refused or _incomplete([rail for found in rails.values() for rail in found])
    if refused:
        lines = tuple(f"power refused: {why}; there will be no energy" for why in refused)
        alone = len(mended) == len(topics) == 1
        recipe = _propose_recipe(mended, alone=alone) if len(mended) == len(topics) and all(mended.values()) else ""
        more = "; where its numbers are thousandths, write in a recipe:" if recipe else ""
        return PowerReadings(warnings=lines, refusal=NoPower("; ".join(lines) + more, recipe))
    rails, odd = _believable(rails)
    log_times = {topic: np.asarray(columns[_LOG_TIME], np.float64) for topic, (_, columns) in topics.items()}
    sign, told, told_by = _sign(rails, log_times, sources, current_sign)
    if sign == 0:
        return PowerReadings(warnings=tuple(told), refusal=NoPower("; ".join(told)))
    includes = tuple(dict.fromkeys(of.includes for of in sources if of.includes))
    warnings += [*told, *odd, *(f"power: {what} are part of it" for what in includes)]
    signed = {topic: [with_sign(rail, sign) for rail in found] for topic, found in rails.items()}
    counts = any(of.energy for of in sources)
    unknown = any(of.averaging_unknown for of in sources) and not counts
    averaged = counts or any(of.averaged for of in sources)
    return PowerReadings(signed, averaged, unknown, tuple(dict.fromkeys(warnings)), told_by, includes)


@dataclass(frozen=True, slots=True)
class _Told:
    """What a topic's messages hold: a rail for each source."""

    sources: list[PowerSource]
    rails: list[RailReadings]
    warnings: list[str]

    def by_type(self) -> list[RailReadings]:
        """Return the rails with the sign that their type gives a drawn current."""
        each = zip(self.rails, self.sources, strict=True)
        return [with_sign(rail, -1 if of.sign == "drawn_negative" else 1) for rail, of in each]


def _first_that_holds_power(
    topic: str, columns: Columns, choices: Sequence[list[PowerSource]], known: Sequence[PowerSource]
) -> _Told | str:
    """Return the rails of the first choice whose numbers can be power, or why there are none."""
    why_not: list[str] = []
    for sources in choices:
        found = read_rails(columns, sources, topic, known)
        if isinstance(found, str):
            why_not.append(found)
            continue
        read = [_unwrapped(rail) for rail in found]
        rails, warnings = [rail for rail, _ in read], [line for _, lines in read for line in lines]
        if problems := [why for rail in rails if (why := why_refused(rail, columns)) is not None]:
            why_not.append("; ".join(problems))
            continue
        instead = " + ".join(rail.name for rail in rails)
        warnings += [f"power: {why}; {instead} is taken instead" for why in why_not]
        return _Told(sources, rails, warnings)
    return "; ".join(why_not)


def _in_thousandths(
    topic: str, columns: Columns, sources: Sequence[PowerSource], known: Sequence[PowerSource]
) -> list[PowerSource]:
    """Return the sources in millivolts or milliamperes, as far as their numbers are power then; none where they are not."""
    for volt, amp in ((1.0, 1e-3), (1e-3, 1.0), (1e-3, 1e-3)):
        scaled = [
            replace(of, voltage_scale=volt * of.voltage_scale, current_scale=amp * of.current_scale) for of in sources
        ]
        found = read_rails(columns, scaled, topic, known)
        if not isinstance(found, str) and all(why_refused(rail, columns) is None for rail in found):
            return scaled
    return []


def _propose_recipe(sources: Mapping[str, Sequence[PowerSource]], *, alone: bool) -> str:
    """Return the tables of a recipe for the sources of topics; of one topic alone for all of its type."""
    rows = []
    for topic, of_topic in sources.items():
        named = [of if alone and of.type not in FLOAT_TYPES else replace(of, topic=topic) for of in of_topic]
        rows += [
            {of.name: value for of in fields(each) if (value := getattr(each, of.name)) != of.default} for each in named
        ]
    return RecipeFragment({"power_sources": rows}).toml()


def _unwrapped(rail: RailReadings) -> tuple[RailReadings, list[str]]:
    """Return a rail with its counter's resets said, and with negative currents that were read as unsigned made negative again."""
    if rail.counter is not None:
        resets = int(rail.counter.resets.max(initial=0))
        said = f"power: {rail.name}: its counter of energy was reset {resets} times; what was drawn across that is not known"
        return rail, [said] if resets else []
    wraps_amp = wrap_of(rail.current_amp)
    if wraps_amp is None:
        return rail, []
    upper = rail.current_amp > wraps_amp / 2
    said = f"power: {rail.name}: {np.count_nonzero(upper)} currents are negative ones read as unsigned: {wraps_amp:g} A less each"
    return replace(rail, current_amp=np.where(upper, rail.current_amp - wraps_amp, rail.current_amp)), [said]


def _paired(rails: dict[str, list[RailReadings]]) -> dict[str, list[RailReadings]]:
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


def _incomplete(rails: list[RailReadings]) -> list[str]:
    missing = []
    for name in dict.fromkeys(rail.name for rail in rails):
        parts = [rail for rail in rails if rail.name == name]
        if not any(np.isfinite(part.voltage_volt).any() for part in parts):
            missing.append(f"{name}: it carries no voltage")
        if not any(np.isfinite(part.current_amp).any() for part in parts):
            missing.append(f"{name}: it carries no current")
    return missing


def _too_seldom(topic: str, log_time_ns: Floats) -> list[str]:
    """Return why a topic cannot tell what a metre costs: too few messages, or too far apart."""
    if log_time_ns.size < _FEWEST_MESSAGES:
        return [f"{topic}: it holds {log_time_ns.size} messages only"]
    period_s = float(np.median(np.diff(log_time_ns))) / 1e9
    return [f"{topic}: it comes every {period_s:.0f} s only"] if period_s > _SLOWEST_S else []


def _believable(rails: Rails) -> tuple[dict[str, list[RailReadings]], list[str]]:
    """Return the rails with NaN for single values that no battery and no drive has (saturated, lost), and a line on each rail.

    Without current a low voltage may be true: a drive that is not switched on yet tells zeros.
    """
    kept: dict[str, list[RailReadings]] = {}
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
    rails: Rails, log_times: Mapping[str, Floats], sources: list[PowerSource], given: CurrentSign
) -> tuple[int, list[str], str]:
    """Return what makes a drawn current positive (0 where the record contradicts its type), warnings, and what tells it."""
    if given != "auto":
        return (1 if given == "drawn_positive" else -1), [], f"{given} (recipe)"
    time_s, whole = _whole_current(rails, log_times)
    sign, one_sided = sign_by_mean(whole, _weight_s(time_s))
    share = f"{100 * abs(one_sided):.0f} % of the charge moved"
    signs = {source.sign for source in sources}
    if "auto" not in signs:
        told, other = "drawn_positive", "drawn_negative"
        if signs == {other}:
            told, other = other, told
        if sign >= 0 or time_s.size < _FEWEST_ROWS:
            return 1, [], f"{told} (message type)"
        negative = "negative" if told == "drawn_positive" else "positive"
        why = f"power refused: the current is {negative}, {share} flows back; there will be no energy"
        cures = {"if this robot counts drawn current so": other, "if it truly rolled downhill throughout": told}
        return 0, [why + _sign_lines(cures)], ""
    if sign > 0:
        why = f"power: the current counts as positive when drawn, against the ROS convention: {share} is positive"
        return 1, [why + _sign_lines({"to settle it": "drawn_positive"})], "drawn_positive (mean)"
    if sign < 0:
        return -1, [], "drawn_negative (mean, as ROS has it)"
    return _unclear(share, sources)


def _unclear(share: str, sources: Sequence[PowerSource]) -> tuple[int, list[str], str]:
    """Return what `_sign` does where as much flows one way as the other: ROS' convention counts where it may be meant, else it is asked."""
    if any(of.sign == "auto" and of.type not in (BATTERY_STATE, *FLOAT_TYPES) for of in sources):
        why = f"power refused: which sign a drawn current has is not known of its type, nor clear from the record (net {share})"
        return 0, [why + _sign_lines(_EITHER)], ""
    why = f"power: the current's sign is unclear (net {share}): taken as negative when drawn, as ROS has it"
    return -1, [why + _sign_lines(_EITHER)], "drawn_negative (ROS)"


_EITHER = {f"if a drawn current is {word}": f"drawn_{word}" for word in ("negative", "positive")}


def _sign_lines(signs: Mapping[str, str]) -> str:
    """Return what settles the sign of currents, by what speaks for it."""
    return "".join(suggested(purpose, {"read": {"current_sign": sign}}) for purpose, sign in signs.items())


def _weight_s(time_s: Floats) -> Floats:
    """Return the time that each row stands for [s]; beside a hole no more than usual, or one row would outweigh a run."""
    if time_s.size < 2:
        return np.ones_like(time_s)
    between = np.gradient(time_s)
    weight: Floats = np.clip(between, 0.0, 3.0 * float(np.median(between)))
    return weight


def _whole_current(rails: Rails, log_times: Mapping[str, Floats]) -> tuple[Floats, Floats]:
    """Return the sum of all rails' currents [A] at the log times of the first topic that carries one, and these times [s]."""
    parts = [
        (log_times[topic][known] / 1e9, rail.current_amp[known])
        for topic, found in rails.items()
        for rail in found
        if (known := np.isfinite(rail.current_amp)).any()
    ]
    time_s = parts[0][0]
    return time_s, np.sum([np.interp(time_s, at, current) for at, current in parts], axis=0)
