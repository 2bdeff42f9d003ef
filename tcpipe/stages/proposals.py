"""What a log could be read as by a recipe: fixes, inertial measurements and power in messages that no rule knows, judged by their values.

`tcpipe inspect`, `preflight`, `ingest` and `init --from` all have it from here. A proposal whose values cannot be what its names say is not
made; one that the values do not settle says in ``doubt`` what remains to be checked.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.logs.field_mapping import list_number_fields, match_field_names
from tcpipe.logs.power_fields import match_power_fields, split_sides, split_words
from tcpipe.logs.roles import OVERLAY, ROLE_TYPES, RoleAssignment
from tcpipe.logs.topics import Topic
from tcpipe.power.sources import FLOAT_TYPES, find_quantity, find_rejection, is_of_drives, make_rail_name, read_rails
from tcpipe.recipe import ReadConfig
from tcpipe.recipe.suggestions import TomlValue, suggest
from tcpipe.robots import PowerSource, Profiles, parse_fields
from tcpipe.stages.message_arrays import LogReader, make_message_arrays
from tcpipe.tables.findings import Finding, Subject, make_finding

Columns = Mapping[str, NDArray[Any]]
Floats = NDArray[np.float64]

JOINT_STATE = "sensor_msgs/msg/JointState"
_GRAVITY_MPS2 = 9.80665
_UNSETTLED = {"sign": "auto", "averaging_unknown": True}
"""What no name says of a current."""


def find_proposals(
    log: LogReader, assignment: RoleAssignment, config: ReadConfig, known: Profiles
) -> tuple[Finding, ...]:
    """Return what could play roles that nothing plays; nothing for roles that the recipe speaks of."""
    free = [topic for topic in log.topics.values() if _is_free(topic, config)]
    return (
        *_propose_roles(log, free, {*assignment.roles, *config.topics}),
        *_propose_power(log, free, assignment, config, known),
    )


def _is_free(topic: Topic, config: ReadConfig) -> bool:
    readable = topic.problem is None and topic.message_count != 0
    return readable and topic.name not in config.ignore_topics and not topic.name.startswith(OVERLAY)


def read_columns(log: LogReader, topic: str, in_lists: Iterable[str] = ()) -> dict[str, NDArray[Any]]:
    """Return a topic's messages by field; {} where they cannot be decoded."""
    tables = log.tables([topic])
    return make_message_arrays(tables[topic], [*in_lists]) if topic in tables else {}


_PROPOSED = ("gnss", "imu")
"""Roles whose fields are called so that nothing else is taken for them."""


def _propose_roles(log: LogReader, free: Sequence[Topic], settled: set[str]) -> Iterator[Finding]:
    """Yield a finding for each message type that no role knows and whose fields are called as those of a role that nothing can play."""
    types = {topic.type_name for topic in free}
    for role in _PROPOSED:
        if role in settled or types & set(ROLE_TYPES[role]):
            continue
        for topic in free:
            fields = [name for name in list_number_fields(topic) if "[]" not in name]
            if found := match_field_names(role, fields):
                columns = read_columns(log, topic.name)
                if not set(found.values()) <= set(columns):
                    continue
                mapped, doubt = judge_fields(role, found, {name: columns[of] for name, of in found.items()})
                remedies = suggest("map", {"read.topics": {role: [topic.name]}, "read.fields": {role: mapped}})
                names = {"role": role, "type": topic.type_name, **({"doubt": doubt} if doubt else {})}
                yield make_finding("role-proposed", Subject("topic", topic.name), names=names, remedies=remedies)


def judge_fields(role: str, found: Mapping[str, str], columns: Columns) -> tuple[dict[str, str], str]:
    """Return what each field is taken from, with the factor that its values show, and what they leave open.

    ``found`` are the names that are matched, ``columns`` their values by field.
    """
    values = {name: np.asarray(of, np.float64) for name, of in columns.items()}
    values = {name: of[np.isfinite(of) & (of != 0.0)] for name, of in values.items()}
    if role == "gnss":
        return _judge_fixes(dict(found), values)
    if role == "imu":
        return _judge_imu(dict(found), values)
    return dict(found), ""


def _largest(values: Floats) -> float:
    return float(np.abs(values).max()) if values.size else np.nan


def _judge_fixes(found: dict[str, str], values: Mapping[str, Floats]) -> tuple[dict[str, str], str]:
    latitude, longitude = (_largest(values[name]) for name in ("latitude", "longitude"))
    doubt = ""
    is_whole = not any(np.any(values[name] % 1.0) for name in ("latitude", "longitude"))
    if is_whole and 90.0 < latitude <= 90e7 and longitude <= 180e7:  # as in u-blox' messages, whose heights are in mm
        found |= {name: f"{found[name]} * 1e-7" for name in ("latitude", "longitude")}
        found |= {"altitude": f"{found['altitude']} * 0.001"} if "altitude" in found else {}
        values = {**values, "altitude": values.get("altitude", np.zeros(0)) * 0.001}
    elif not (latitude <= 90.0 and longitude <= 180.0):
        doubt = f"latitudes to {latitude:.6g} are no degrees: convert them"
    elif latitude <= np.pi / 2 and longitude <= np.pi:
        doubt = "check that these are degrees: the values could be radians"
    if "altitude" in found and not (values["altitude"].size and _largest(values["altitude"]) < 9000.0):
        del found["altitude"]
    return found, doubt


def _judge_imu(found: dict[str, str], values: Mapping[str, Floats]) -> tuple[dict[str, str], str]:
    """Judge by gravity: the median of each axis is what a robot that drives about feels."""
    acceleration = [name for name in found if name.startswith("linear")]
    felt = float(np.sqrt(sum(np.median(values[name]) ** 2 if values[name].size else 0.0 for name in acceleration)))
    if abs(felt - 1.0) < 0.1:
        return found | {name: f"{found[name]} * {_GRAVITY_MPS2}" for name in acceleration}, ""
    near = abs(felt - _GRAVITY_MPS2) < 1.0
    return found, "" if near else f"the acceleration at rest is {felt:.3g}, not 9.81 m/s²: check axes and units"


@dataclass(frozen=True, slots=True)
class _Candidate:
    """Topics that could be power together: the tables that read them, what their values are, and what is unclear."""

    topics: tuple[str, ...]
    sources: tuple[dict[str, TomlValue], ...]
    numbers: Mapping[str, float]
    doubt: str = ""


def _propose_power(
    log: LogReader, free: Sequence[Topic], assignment: RoleAssignment, config: ReadConfig, known: Profiles
) -> Iterator[Finding]:
    """Yield what could be power in a log without a power topic, the likeliest first."""
    if "power" in assignment.roles or "power" in config.topics:
        return
    told = {*known.types(), *(of for types in ROLE_TYPES.values() for of in types)}
    own = [topic for topic in free if topic.type_name not in told]
    found = (
        _find_bare_rails(log, free)
        or [*_find_own_types(log, own), *_find_bare_watts(log, free)]
        or [*_find_joints(log, free)]
    )
    if not found:
        return
    found.sort(key=lambda of: bool(of.doubt))
    best = found[0]
    used: list[TomlValue] = list(best.topics)
    doubt = best.doubt or (
        ", ".join(found[1].topics) + " could be meant as well" if len(found) > 1 and not found[1].doubt else ""
    )
    yield make_finding(
        "power-candidates",
        Subject("role", "power"),
        names={
            "topics": ", ".join(topic for of in found for topic in of.topics),
            **({"doubt": doubt} if doubt else {}),
        },
        remedies=suggest("use", {"read.topics": {"power": used}, "power_sources": best.sources})
        if best.sources
        else (),
        topics_count=sum(len(of.topics) for of in found),
        **best.numbers,
    )


def _read_candidate(
    log: LogReader, topics: Sequence[Topic], sources: Sequence[Mapping[str, Any]], doubt: str
) -> _Candidate | None:
    """Return a candidate with the factors that its values show; None where they cannot be power."""
    made, numbers = [], dict[str, float]()
    for keys in sources:
        on = [topic for topic in topics if topic.name == keys.get("topic", topic.name)]
        for topic in on:
            judged = _judge_source(log, topic, keys, numbers)
            if judged is None:
                return None
            keys = judged  # noqa: PLW2901  one table for all topics of a type
        made.append(dict(keys))
    return _Candidate(tuple(dict.fromkeys(topic.name for topic in topics)), tuple(made), numbers, doubt)


_THOUSANDTHS = {"voltage-in-millivolts": "voltage_scale", "current-in-milliamperes": "current_scale"}


def _judge_source(
    log: LogReader, topic: Topic, keys: Mapping[str, Any], numbers: dict[str, float]
) -> Mapping[str, Any] | None:
    """Return the table of a source with the factors that make its values plausible, and add their range to ``numbers``."""
    texts = [str(keys.get(what, "")) for what in ("voltage", "current", "power")]
    columns = read_columns(
        log, topic.name, [of.column for text in texts for of in parse_fields(text) if "[]." in of.column]
    )
    if not columns:
        return None
    for _ in range(3):
        source = PowerSource(**keys)
        rails = read_rails(columns, [source], topic.name)
        if isinstance(rails, Finding):
            return None
        (rail,) = rails
        why = find_rejection(rail, topic.name, columns)
        if why is None:
            break
        scale = _THOUSANDTHS.get(why.names["reason"])
        if scale is None or scale in keys:
            return None
        keys = {**keys, scale: 0.001}
    for unit, values in (("volt", rail.voltage_volt), ("watt" if source.power else "amp", rail.current_amp)):
        known = values[np.isfinite(values)]
        if known.size and not (unit == "volt" and source.power):
            if not known.any():
                return None
            numbers[f"low_{unit}"] = min(numbers.get(f"low_{unit}", np.inf), float(known.min()))
            numbers[f"high_{unit}"] = max(numbers.get(f"high_{unit}", -np.inf), float(known.max()))
    return keys


def _find_bare_rails(log: LogReader, free: Sequence[Topic]) -> list[_Candidate]:
    """Return the rails that bare numbers make: each current with the voltage that is called alike, or with the only one."""
    numbers = dict[str, float]()
    judged: list[tuple[Topic, str, Mapping[str, Any]]] = []
    for topic in free:
        what = find_quantity(topic.name) if topic.type_name in FLOAT_TYPES else None
        keys = {"type": topic.type_name, "topic": topic.name, str(what): "data", "rail": "", "sign": "auto"}
        if what and (found := _judge_source(log, topic, keys, numbers)):
            judged.append((topic, what, found))
    if not judged:
        return []
    used = _pair_rails(judged)
    if not used and all(what == "current" for _, what, _ in judged):
        sources = tuple({**keys, **NOMINAL, "rail": make_rail_name(of.name)} for of, _, keys in judged)
        return [_Candidate(tuple(of.name for of, _, _ in judged), sources, numbers, NO_VOLTAGE)]
    topics = dict.fromkeys(of.name for of, _, _ in ([each for _, each in used] or judged))
    sources = tuple({**keys, "rail": rail} for rail, (_, _, keys) in used)
    return [_Candidate(tuple(topics), sources, numbers, _OF_DRIVES)]


_OF_DRIVES = "uncomment if these feed the drives"
NOMINAL = {"nominal_voltage_volt": 24.0}
NO_VOLTAGE = "nothing is a voltage: state that of the battery"


def _pair_rails(
    found: Sequence[tuple[Topic, str, Mapping[str, Any]]],
) -> list[tuple[str, tuple[Topic, str, Mapping[str, Any]]]]:
    """Return each rail's voltage and current: called alike, or all currents at the only voltage; of drives alone where some are."""
    voltages = {make_rail_name(of[0].name): of for of in found if of[1] == "voltage"}
    currents = [of for of in found if of[1] == "current"]
    currents = [of for of in currents if is_of_drives(of[0].name)] or currents
    used = []
    for of in currents:
        rail = make_rail_name(of[0].name)
        voltage = voltages.get(rail) or (next(iter(voltages.values())) if len(voltages) == 1 else None)
        if voltage is None:
            return []
        used += [(rail, voltage), (rail, of)]
    return used


_WATT = {"power", "watt", "watts"}


def _find_bare_watts(log: LogReader, free: Sequence[Topic]) -> Iterator[_Candidate]:
    """Yield the bare numbers whose topic's name says that they are a power."""
    named = [of for of in free if of.type_name in FLOAT_TYPES and _WATT & set(split_words(of.name.rpartition("/")[2]))]
    for group in _group_by_sides(named):
        sources = [{"type": of.type_name, "topic": of.name, "power": "data", **_UNSETTLED} for of in group]
        if found := _read_candidate(log, group, sources, _OF_DRIVES):
            yield found


def _find_own_types(log: LogReader, own: Sequence[Topic]) -> Iterator[_Candidate]:
    """Yield the messages of somebody's own that hold voltage and current, or power; topics of one type that differ by side are summed."""
    for group in _group_by_sides(own):
        matched = match_power_fields(list_number_fields(group[0]))
        if matched is None:
            continue
        scales = {f"{what}_scale": factor for what, factor in matched.scales.items()}
        named = ({"rail": f"{group[0].name}/{number}"} if len(matched.rails) > 1 else {} for number in range(9))
        sources = [
            {"type": group[0].type_name, **rail, **scales, **name, **_UNSETTLED}
            for rail, name in zip(matched.rails, named, strict=False)
        ]
        doubt = matched.doubt
        if not {"voltage", "power"} & set(matched.rails[0]):
            sources, doubt = [{**keys, **NOMINAL} for keys in sources], NO_VOLTAGE
        if found := _read_candidate(log, group, sources, doubt):
            yield found


def _group_by_sides(topics: Iterable[Topic]) -> list[list[Topic]]:
    """Return topics of one type that are called alike but for a side or a number, together."""
    groups: dict[tuple[Any, ...], list[Topic]] = {}
    for topic in topics:
        groups.setdefault((topic.type_name, split_sides(topic.name)[0]), []).append(topic)
    return list(groups.values())


_DRIVING = re.compile(r".*(wheel|drive|motor|track|axle)(?!.*steer).*")


def _find_joints(log: LogReader, free: Sequence[Topic]) -> Iterator[_Candidate]:
    """Yield the joint states that have efforts and velocities: mechanical power."""
    for topic in free:
        if topic.type_name != JOINT_STATE:
            continue
        columns = read_columns(log, topic.name, ["name[]"])
        names = [str(name) for name in np.unique(columns.get("name[]", np.zeros(0, "U1"))).tolist() if name]
        wheels = sorted(name for name in names if _DRIVING.fullmatch(name.lower()))
        moving = [columns[of] for of in ("velocity", "effort") if of in columns and np.any(np.nan_to_num(columns[of]))]
        if wheels and len(moving) == 2:
            keys: dict[str, TomlValue] = {
                "type": topic.type_name,
                "joints": "|".join(map(re.escape, wheels)),
                "sign": "auto",
            }
            yield _Candidate(
                (topic.name,), (keys,), {}, "uncomment if efforts are torques [N m]: mechanical power, without losses"
            )
