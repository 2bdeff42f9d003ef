"""Topics of power: their messages as rails, whether they are averages, and rows that repeat a slower reading."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tcpipe.arrays import Columns, Floats, Ints
from tcpipe.logs.messages import LOG_TIME, Readings, read_header_ns
from tcpipe.logs.roles import RoleAssignment
from tcpipe.logs.topics import Topic
from tcpipe.power.readings import PowerReadings, compare_second_meters, read_power
from tcpipe.power.sampling import find_readings, is_stated_averaged
from tcpipe.power.sources import FLOAT_TYPES, Counter, RailReadings, find_lone_side, reject_power
from tcpipe.power.witnesses import compute_side_share
from tcpipe.recipe import ReadConfig
from tcpipe.recipe.suggestions import suggest
from tcpipe.robots import Profiles
from tcpipe.tables.columns import Tables, select_rows, stack_floats, to_floats, to_integers, to_texts
from tcpipe.tables.findings import Finding, Findings, Severity, Subject, make_finding, read_threshold
from tcpipe.tables.levels import STREAMS


def read_power_of_topics(
    topics: Mapping[str, tuple[str, Columns]],
    assignment: RoleAssignment,
    config: ReadConfig,
    *,
    known: Profiles,
    meters: Mapping[str, tuple[str, Columns]],
) -> PowerReadings:
    """Return the rails of the topics used as power, by message type and columns; none unless all can be decoded.

    ``meters`` are power topics that are not used; the power is compared with them.
    """
    wanted = len(assignment.roles["power"].topics) if "power" in assignment.roles else 0
    if not topics:
        return PowerReadings()
    if len(topics) < wanted:
        lost = [topic for topic in assignment.roles["power"].topics if topic not in topics]
        return PowerReadings(findings=tuple(reject_power(topic, "not-decoded") for topic in lost))
    if "power" not in config.topics and (topic := find_lone_side(topics)):
        return PowerReadings(findings=(reject_power(topic, "other-side-missing"),))
    platform = known.robots[assignment.robot].platform
    power = read_power(
        topics,
        known.power_sources,
        platform=platform,
        husky_power=config.husky_power,
        current_sign=config.current_sign,
        current_scale=config.current_scale,
        offset_amp=config.current_offset_amp,
    )
    return compare_second_meters(power, topics, meters, known.power_sources, platform=platform)


def list_second_meters(
    assignment: RoleAssignment, topics: Mapping[str, Topic], config: ReadConfig, known: Profiles
) -> list[str]:
    """Return the topics of known power messages that are not used, to be compared with those that are."""
    if "power" not in assignment.roles:
        return []
    types = set(known.types()) - {*known.refusals(), *FLOAT_TYPES}
    excluded = {*config.ignore_topics, *(topic for role in assignment.roles.values() for topic in role.topics)}
    return [
        topic
        for topic in assignment.left_out
        if topic not in excluded and topics[topic].type_name in types and topics[topic].problem is None
    ]


_STRAIGHT_RADPS, _MOVING_MPS, _STILL_MPS = 0.05, 0.2, 0.01
"""Largest turn rate and smallest speed of straight driving, largest speed at rest."""


def add_side_share(power: PowerReadings, streams: Tables) -> PowerReadings:
    """Return power with one side's share of the current in straight driving above that at rest (needs an odometry)."""
    motion = _choose_odometry(streams)
    if power.facts is None or power.sides is None or motion is None:
        return power
    at_ns = to_integers(motion, "log_time_ns").astype(float)
    order = np.argsort(at_ns, kind="stable")
    speed_mps, turn_radps = (
        np.interp(power.sides.log_time_ns, at_ns[order], np.abs(to_floats(motion, name))[order])
        for name in ("velocity_x_mps", "angular_velocity_z_radps")
    )
    is_straight = (speed_mps > _MOVING_MPS) & (turn_radps < _STRAIGHT_RADPS)
    sides = [
        amp - (np.median(rest_amp) if (rest_amp := amp[(speed_mps < _STILL_MPS) & np.isfinite(amp)]).size else 0.0)
        for amp in (power.sides.first_amp, power.sides.second_amp)
    ]
    share = compute_side_share(sides[0], sides[1], is_straight)
    return replace(power, facts=replace(power.facts, side_share=share))


def _choose_odometry(streams: Tables) -> pa.Table | None:
    return next((streams[role] for role in ("wheel_odometry", "visual_odometry") if role in streams), None)


def name_rail_columns(rail: str) -> tuple[str, str]:
    """Return the names of a rail's voltage and current columns in its topic's readings."""
    return f"{rail}: voltage_volt", f"{rail}: current_amp"


def name_counter_columns(rail: str) -> tuple[str, str]:
    """Return the names of the columns of a rail's counter of energy, where it has one."""
    return f"{rail}: energy_joule", f"{rail}: resets"


def select_power_rows(columns: Columns, rails: Sequence[RailReadings]) -> Readings:
    """Return the rows in which a rail has a voltage or a current; only rows between them count as not used."""
    values = {
        name: values
        for rail in rails
        for name, values in zip(name_rail_columns(rail.name), (rail.voltage_volt, rail.current_amp), strict=True)
    }
    row = np.flatnonzero(np.any([np.isfinite(value) for value in values.values()], axis=0))
    for rail in rails:
        if rail.counter is not None:
            energy, resets = name_counter_columns(rail.name)
            values |= {energy: rail.counter.energy_joule, resets: rail.counter.resets.astype(float)}
    stamps = read_header_ns(columns)
    lost = row[-1] + 1 - row[0] - len(row) if len(row) else len(columns[LOG_TIME])
    return Readings(
        row,
        columns[LOG_TIME][row].astype(np.int64),
        None if stamps is None else stamps[row],
        {name: value[row] for name, value in values.items()},
        {"not_finite": lost} if lost else {},
    )


def read_rail_power(rail: RailReadings, times: Columns, columns: Columns) -> tuple[Floats, Floats]:
    """Return a rail's voltages [V] and currents [A] in its topic's readings.

    Those of a counter of energy are means by the times that rule; none across a reset or a step of the clock.
    """
    voltage, current = (columns[name] for name in name_rail_columns(rail.name))
    if rail.counter is not None:
        energy, resets = (columns[name] for name in name_counter_columns(rail.name))
        breaks = resets + times["clock_epoch"] * (1 + np.max(resets, initial=0))
        current = np.where(np.isnan(current), np.nan, Counter(energy, breaks).mean_amp(times["stamp_ns"], voltage))
    return voltage, current


def add_averaging(power: PowerReadings, streams: Tables, config: ReadConfig) -> tuple[PowerReadings, Findings]:
    """Return the power with whether its values are means over their period, and the finding where that is assumed."""
    counts = any(rail.counter is not None for rails in power.rails.values() for rail in rails)
    if power.facts is not None and config.power_averaged != "auto" and not counts:
        return replace(power, facts=replace(power.facts, averaged=config.power_averaged == "yes")), ()
    if power.facts is None or not power.averaging_unknown or "power" not in streams:
        return power, ()
    table = select_rows(streams["power"], "clock_epoch", 0)
    rail = select_rows(table, "rail", table["rail"][0].as_py())
    power_ns, watt = _compute_power_at_currents(rail)
    period_s = float(np.median(np.diff(power_ns))) / 1e9 if len(power_ns) > 1 else np.inf
    if period_s < read_threshold(_ASSUMED, "min_period_s"):
        return power, ()
    motion = _choose_odometry(streams)
    verdict = None if motion is None else _test_by_motion(power_ns, watt, select_rows(motion, "clock_epoch", 0))
    averaged = power.facts.averaged if verdict is None else verdict
    power = replace(power, facts=replace(power.facts, averaged=averaged))
    if verdict is None and period_s < read_threshold(_ASSUMED, "min_unobserved_period_s"):
        return power, ()
    severity: Severity | None = "warning" if verdict is None else None
    names = {"value": "mean" if averaged else "sample", "evidence": "nothing" if verdict is None else "motion"}
    remedies = [remedy for value in ("yes", "no") for remedy in suggest(value, {"read": {"power_averaged": value}})]
    power_role = Subject("role", "power")
    found = make_finding(_ASSUMED, power_role, severity=severity, names=names, remedies=remedies, period_s=period_s)
    return power, (found,)


_ASSUMED = "power-averaging-assumed"


def _compute_power_at_currents(rail: pa.Table) -> tuple[Ints, Floats]:
    """Return the stamps [ns] of a rail's currents and its power there [W]: its voltage may come at other times."""
    stamp_ns, voltage, current = (
        to_integers(rail, "stamp_ns"),
        to_floats(rail, "voltage_volt"),
        to_floats(rail, "current_amp"),
    )
    at_ns = (stamp_ns - stamp_ns[0]).astype(float)
    of_voltage, of_current = np.isfinite(voltage), np.isfinite(current)
    if not of_voltage.any():
        return stamp_ns[:0], current[:0]
    return stamp_ns[of_current], current[of_current] * np.interp(
        at_ns[of_current], at_ns[of_voltage], voltage[of_voltage]
    )


def _test_by_motion(power_ns: Ints, watt: Floats, motion: pa.Table) -> bool | None:
    twist = stack_floats(motion, "velocity_x_mps", "angular_velocity_z_radps")
    moving = np.isfinite(twist).all(axis=1)
    return is_stated_averaged(power_ns, watt, to_integers(motion, "stamp_ns")[moving], *twist[moving].T)


_QUANTITIES = {"current": "current_amp", "voltage": "voltage_volt"}
_BETWEEN_EPOCHS_NS = 1_000_000_000_000  # their stamps may overlap; no reading lasts as long

Streams = dict[str, pa.Table]
Values = Mapping[str, Floats]


@dataclass(frozen=True, slots=True)
class RepeatedValues:
    """The rates [Hz] of the messages that carry a rail's current or voltage, and of the readings that they repeat."""

    rail: str
    quantity: str
    message_hz: float
    reading_hz: float


def remove_repeats(streams: Streams) -> tuple[Streams, list[RepeatedValues]]:
    """Return the streams with only new readings of power, and the repeats; unchanged if there are no repeats.

    A reading has the stamp of its first message.
    """
    power = streams.get("power")
    if power is None:
        return streams, []
    step_ns = np.where(
        np.diff(to_integers(power, "clock_epoch")) != 0, _BETWEEN_EPOCHS_NS, np.diff(to_integers(power, "stamp_ns"))
    )
    at_ns = np.concatenate(([0], np.cumsum(step_ns)))
    values = {quantity: to_floats(power, column) for quantity, column in _QUANTITIES.items()}
    kept = {quantity: np.isfinite(value) for quantity, value in values.items()}
    repeats: list[RepeatedValues] = []
    for rail in pc.unique(power["rail"]).to_pylist():
        rows = np.flatnonzero(to_texts(power["rail"]) == rail)
        for quantity in _QUANTITIES:
            own = rows[np.isfinite(values[quantity][rows])]
            readings = _find_readings(at_ns, own, quantity, values)
            if readings is not None:
                kept[quantity][np.setdiff1d(own, readings)] = False
                repeats.append(RepeatedValues(rail, quantity, _rate_hz(at_ns[own]), _rate_hz(at_ns[readings])))
    if not repeats:
        return streams, []
    columns = {name: power[name] for name in power.column_names}
    columns |= {column: np.where(kept[quantity], values[quantity], np.nan) for quantity, column in _QUANTITIES.items()}
    table = STREAMS["power"].table(**columns).filter(kept["current"] | kept["voltage"])
    return {**streams, "power": table}, repeats


def _find_readings(at_ns: Ints, own: Ints, quantity: str, values: Values) -> Ints | None:
    """Return the rows of a quantity's readings, by its own changes or, if these are unclear, by both quantities'."""
    found = find_readings(at_ns[own], values[quantity][own, None])
    if found is None and all(np.isfinite(value[own]).all() for value in values.values()):
        found = find_readings(at_ns[own], np.stack([value[own] for value in values.values()], axis=-1))
    return None if found is None else own[found]


def _rate_hz(at_ns: Ints) -> float:
    step_ns = np.diff(at_ns)
    return 1e9 / float(np.mean(step_ns[step_ns < 1.5 * np.median(step_ns)]))


def find_repeats(repeats: Sequence[RepeatedValues]) -> Iterator[Finding]:
    """Yield the finding that messages repeat readings, for the slowest; labelling decides whether it is too slow."""
    if not repeats:
        return
    slowest = min(repeats, key=lambda repeat: repeat.reading_hz)
    names = {
        attribute: ", ".join(dict.fromkeys(getattr(each, attribute) for each in repeats))
        for attribute in ("quantity", "rail")
    }
    message_hz, reading_hz = slowest.message_hz, slowest.reading_hz
    yield make_finding("power-readings-repeated", _POWER, names=names, message_hz=message_hz, reading_hz=reading_hz)


_POWER = Subject("role", "power")
