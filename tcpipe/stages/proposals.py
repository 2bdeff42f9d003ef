"""Proposals for a recipe: fixes, inertial measurements and power in unknown messages, by names and values.

`tcpipe inspect`, `preflight`, `ingest` and `init --from` use them. Values that contradict the names exclude a proposal;
``doubt`` states the points that the user must check.
"""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tcpipe.arrays import Columns, Floats
from tcpipe.logs.expressions import UNITS
from tcpipe.logs.field_mapping import list_number_fields, match_field_names
from tcpipe.logs.power_fields import match_power_fields, split_sides, split_words
from tcpipe.logs.roles import OVERLAY, ROLE_TYPES, RoleAssignment
from tcpipe.logs.topics import Topic
from tcpipe.power.sources import FLOAT_TYPES, find_quantity, find_rejection, is_of_drives, make_rail_name, read_rails
from tcpipe.recipe import ReadConfig
from tcpipe.recipe.suggestions import Keys, format_first, suggest
from tcpipe.robots import PowerSource, Profiles
from tcpipe.stages.message_arrays import LogReader, make_message_arrays
from tcpipe.tables.findings import Finding, Findings, Subject, make_finding

JOINT_STATE = "sensor_msgs/msg/JointState"
_GRAVITY_MPS2 = UNITS["m/s2"]["g"]
_UNSETTLED: Keys = {"sign": "auto", "averaging_unknown": True}  # keys of a current that its name does not determine


def find_proposals(log: LogReader, assignment: RoleAssignment, config: ReadConfig, known: Profiles) -> Findings:
    """Return proposals for roles without a topic that the recipe does not mention. The log is read once."""
    readable = [topic for topic in log.topics.values() if topic.problem is None and topic.message_count != 0]
    free = [of for of in readable if of.name not in config.ignore_topics and not of.name.startswith(OVERLAY)]
    assigned, types = {*assignment.roles, *config.topics}, {topic.type_name for topic in free}
    known_types = {*known.types(), *(type_name for types in ROLE_TYPES.values() for type_name in types)}
    of_role = {
        (role, topic): fields
        for role in ("gnss", "imu")  # their field names are unambiguous
        if role not in assigned and not types & set(ROLE_TYPES[role])
        for topic in free
        if (fields := match_field_names(role, [field for field in list_number_fields(topic) if "[]" not in field]))
    }
    of_power = [topic for topic in free if "power" not in assigned and _may_be_power(topic, known_types)]
    lists = {
        topic.name: [field for field in [*list_number_fields(topic), "name[]"] if "[]" in field] for topic in of_power
    }
    tables = log.tables(list(dict.fromkeys([*(topic.name for _, topic in of_role), *lists])))
    columns = {name: make_message_arrays(table, lists.get(name, ())) for name, table in tables.items()}
    read = [topic for topic in of_power if topic.name in columns]
    return (*_propose_roles(of_role, columns), *_propose_power(read, columns))


def _may_be_power(topic: Topic, known_types: Collection[str]) -> bool:
    if topic.type_name in FLOAT_TYPES:
        return bool(_find_bare_quantity(topic.name))
    is_own = topic.type_name not in known_types
    return topic.type_name == JOINT_STATE or (is_own and match_power_fields(list_number_fields(topic)) is not None)


def _propose_roles(
    matched: Mapping[tuple[str, Topic], Mapping[str, str]], columns: Mapping[str, Columns]
) -> Iterator[Finding]:
    """Yield a finding for each unknown message type with fields named like those of a role that has no topic."""
    for (role, topic), found in matched.items():
        own = columns.get(topic.name, {})
        if set(found.values()) <= set(own):
            mapped, doubt = judge_fields(role, found, {name: own[column] for name, column in found.items()})
            remedies = suggest("map", {"read.topics": {role: [topic.name]}, "read.fields": {role: mapped}})
            names = {field: format_first(own[column]) for field, column in found.items() if field != "quality"}
            names |= {"role": role, "type": topic.type_name, **({"doubt": doubt} if doubt else {})}
            yield make_finding("role-proposed", Subject("topic", topic.name), names=names, remedies=remedies)


def judge_fields(role: str, found: Mapping[str, str], columns: Columns) -> tuple[dict[str, str], str]:
    """Return the source of each field of ``gnss`` or ``imu``, with the factor by its values, and what is unclear.

    ``found``: matched names; ``columns``: their values by field.
    """
    values = {name: np.asarray(column, float) for name, column in columns.items()}
    values = {name: value[np.isfinite(value) & (value != 0.0)] for name, value in values.items()}
    return _judge_fixes(dict(found), values) if role == "gnss" else _judge_imu(dict(found), values)


def _largest(values: Floats) -> float:
    return float(np.abs(values).max()) if values.size else np.nan


def _judge_fixes(found: dict[str, str], values: Mapping[str, Floats]) -> tuple[dict[str, str], str]:
    latitude, longitude = (_largest(values[name]) for name in ("latitude", "longitude"))
    doubt = "" if np.isfinite(latitude + longitude) else "no position in the log"
    is_whole = not any(np.any(values[name] % 1.0) for name in ("latitude", "longitude"))
    if is_whole and 90.0 < latitude <= 90e7 and longitude <= 180e7:  # as in u-blox' messages, whose heights are in mm
        found |= {name: f"{found[name]} * 1e-7" for name in ("latitude", "longitude")}
        in_mm = [name for name in ("altitude", "east_std", "north_std", "up_std") if name in found]
        found |= {name: f"{found[name]} * 0.001" for name in in_mm}
        values = {**values, "altitude": values.get("altitude", np.zeros(0)) * 0.001}
    elif latitude > 90.0 or longitude > 180.0:
        doubt = f"latitudes to {latitude:.6g} are no degrees: convert them"
    elif latitude <= np.pi / 2 and longitude <= np.pi:
        doubt = "check that these are degrees: the values could be radians"
    if "altitude" in found and not (values["altitude"].size and _largest(values["altitude"]) < 9000.0):
        del found["altitude"]
    return found, doubt


def _judge_imu(found: dict[str, str], values: Mapping[str, Floats]) -> tuple[dict[str, str], str]:
    """Judge accelerations by gravity, the median of each axis; beside accelerations in g, high rates are in deg/s."""

    def measure(begin: str) -> float:
        axes = [np.median(np.abs(of)) for name, of in values.items() if name.startswith(begin) and of.size]
        return float(np.linalg.norm(axes))

    force = measure("linear")
    if abs(force - 1.0) >= 0.1:
        is_near = abs(force - _GRAVITY_MPS2) < 1.0
        return found, "" if is_near else f"the acceleration at rest is {force:.3g}, not 9.81 m/s²: check axes and units"
    factors = {"linear_acceleration": _GRAVITY_MPS2}
    if measure("angular_velocity") > _FASTEST_MEDIAN_RADPS:
        factors["angular_velocity"] = np.pi / 180.0
    for name, factor in ((name, factors.get(name[:-2])) for name in found):
        found[name] += f" * {factor:.9g}" if factor else ""
    return found, ""


_FASTEST_MEDIAN_RADPS = 0.3  # no robot turns at half of the time as fast as this


@dataclass(frozen=True, slots=True)
class _Candidate:
    """Topics that could be power together: their recipe tables, the range of their values, and what is unclear."""

    topics: tuple[str, ...]
    sources: tuple[Keys, ...]
    numbers: Mapping[str, Any] = field(default_factory=dict)
    doubt: str = ""


def _propose_power(topics: Sequence[Topic], columns: Mapping[str, Columns]) -> list[Finding]:
    """Return candidates for power in a log without a power topic: bare numbers, then own messages, then torques."""
    bare = [topic for topic in topics if topic.type_name in FLOAT_TYPES]
    own = [topic for topic in topics if topic.type_name not in (*FLOAT_TYPES, JOINT_STATE)]
    found = [*_find_bare(bare, columns)] or [*_find_own(own, columns)] or [*_find_joints(topics, columns)]
    if not found:
        return []
    best, *others = sorted(found, key=lambda candidate: bool(candidate.doubt))
    rivals = [name for other in others if not other.doubt for name in other.topics]
    doubt = best.doubt or (f"{', '.join(rivals)} could be meant as well" if rivals else "")
    listed = [name for candidate in (best, *others) for name in candidate.topics]
    names = {"topics": ", ".join(listed), **({"doubt": doubt} if doubt else {})}
    used = list(dict.fromkeys(str(keys["topic"]) for keys in best.sources if "topic" in keys))
    if not used and len(best.topics) > 1:  # one topic of a type that is known needs no name
        used = [*best.topics]
    chosen: dict[str, Keys | Sequence[Keys]] = {"read.topics": {"power": used}} if used else {}
    remedies = suggest("use", {**chosen, "power_sources": best.sources}) if best.sources else ()
    numbers = {"topics_count": len(listed), **best.numbers}
    return [make_finding("power-candidates", Subject("role", "power"), names=names, remedies=remedies, **numbers)]


_THOUSANDTHS = {"voltage-in-millivolts": "voltage_scale", "current-in-milliamperes": "current_scale"}


def _judge_source(columns: Columns, topic: str, keys: Keys, numbers: dict[str, float]) -> Keys | None:
    """Return a power source with plausible factors, and add its range to ``numbers``; None without such factors."""
    made: dict[str, Any] = {**keys}
    for _ in range(3):
        found = read_rails(columns, [PowerSource(**made)], topic)
        if isinstance(found, Finding):
            return None
        (rail,) = found
        why = find_rejection(rail, topic, columns)
        scale = _THOUSANDTHS.get(why.names["reason"], "") if why else ""
        if scale in {"", *made}:
            break
        made[scale] = 0.001
    if why is not None:
        return None
    for values, unit in ((rail.voltage_volt, "volt"), (rail.current_amp, "watt" if "power" in made else "amp")):
        known = values[np.isfinite(values)]
        if known.size and ("voltage" in made or unit != "volt"):
            if not known.any():
                return None
            numbers[f"low_{unit}"] = min(numbers.get(f"low_{unit}", np.inf), float(known.min()))
            numbers[f"high_{unit}"] = max(numbers.get(f"high_{unit}", -np.inf), float(known.max()))
    return made


def _find_bare_quantity(topic: str) -> str:
    """Return the quantity of a plain number by its topic's name: voltage, current or power; "" if unknown."""
    is_watt = bool({"power", "watt", "watts"} & set(split_words(topic.rpartition("/")[2])))
    return find_quantity(topic) or ("power" if is_watt else "")


def _find_bare(bare: Sequence[Topic], columns: Mapping[str, Columns]) -> Iterator[_Candidate]:
    """Yield candidates of bare numbers: rails of voltage and current, or powers, or currents without a voltage."""
    numbers = dict[str, float]()
    judged: dict[str, list[Keys]] = {"voltage": [], "current": [], "power": []}
    for topic in bare:
        what = _find_bare_quantity(topic.name)
        unsettled = _UNSETTLED if what == "power" else {"rail": make_rail_name(topic.name), "sign": "auto"}
        keys = {"type": topic.type_name, "topic": topic.name, what: "data", **unsettled}
        if found := _judge_source(columns[topic.name], topic.name, keys, numbers):
            judged[what].append(found)
    sources, doubt = _pair_rails(judged["voltage"], judged["current"]), "uncomment if these feed the drives"
    if not sources and judged["power"]:
        name = split_sides(str(judged["power"][0]["topic"]))[0]
        sources = [keys for keys in judged["power"] if split_sides(str(keys["topic"]))[0] == name]
    elif not sources and not judged["voltage"]:
        sources, doubt = [{**keys, **NOMINAL} for keys in judged["current"]], NO_VOLTAGE
    if topics := [str(keys["topic"]) for judged_keys in judged.values() for keys in judged_keys]:
        yield _Candidate(tuple(topics), tuple(sources), numbers, doubt)


NOMINAL: Keys = {"nominal_voltage_volt": 24.0}
NO_VOLTAGE = "nothing is a voltage: state that of the battery"


def _pair_rails(voltages: Sequence[Keys], currents: Sequence[Keys]) -> list[Keys]:
    """Return rails of equal name, or all currents at the only voltage; only those of drives if there are any."""
    by_rail = {keys["rail"]: keys for keys in voltages}
    used: list[Keys] = []
    for keys in [current for current in currents if is_of_drives(str(current["topic"]))] or currents:
        voltage = by_rail.get(keys["rail"]) or (voltages[0] if len(voltages) == 1 else None)
        if voltage is None:
            return []
        used += [{**voltage, "rail": keys["rail"]}, keys]
    return used


def _find_own(own: Sequence[Topic], columns: Mapping[str, Columns]) -> Iterator[_Candidate]:
    """Yield own messages with voltage and current, or power; topics of a type that differ by side are summed."""
    groups: dict[tuple[str, tuple[str, ...]], list[Topic]] = {}
    for topic in own:
        groups.setdefault((topic.type_name, split_sides(topic.name)[0]), []).append(topic)
    for (type_name, _), group in groups.items():
        matched = match_power_fields(list_number_fields(group[0]))
        if matched is None or (len(matched.rails) > 1 and len(group) > 1):
            continue
        scales = {f"{what}_scale": factor for what, factor in matched.scales.items()}
        numbers, doubt, sources = dict[str, float](), matched.doubt, list[Keys]()
        for rail in matched.rails:
            named = {"rail": rail["current"]} if len(matched.rails) > 1 else {}
            lacks_voltage = not {"voltage", "power"} & set(rail)
            doubt = NO_VOLTAGE if lacks_voltage else doubt
            assumed = NOMINAL if lacks_voltage else {}
            keys: Keys | None = {"type": type_name, **named, **rail, **scales, **_UNSETTLED, **assumed}
            for topic in group:
                keys = keys and _judge_source(columns[topic.name], topic.name, keys, numbers)
            sources += [keys] if keys else []
        if len(sources) == len(matched.rails):
            yield _Candidate(tuple(topic.name for topic in group), tuple(sources), numbers, doubt)


_DRIVING = re.compile(r".*(wheel|drive|motor|track|axle)(?!.*steer).*")


def _find_joints(topics: Sequence[Topic], columns: Mapping[str, Columns]) -> Iterator[_Candidate]:
    """Yield the joint states that have efforts and velocities of the drives."""
    for topic in topics:
        own = columns[topic.name] if topic.type_name == JOINT_STATE else {}
        names = [str(name) for name in np.unique(own.get("name[]", np.zeros(0, "U1"))).tolist()]
        wheels = "|".join(re.escape(name) for name in names if _DRIVING.fullmatch(name.lower()))
        if wheels and all(np.any(np.nan_to_num(own.get(quantity, np.zeros(1)))) for quantity in ("velocity", "effort")):
            keys: Keys = {"type": topic.type_name, "joints": wheels, "sign": "auto"}
            yield _Candidate(
                (topic.name,), (keys,), doubt="uncomment if efforts are torques [N m]: mechanical power alone"
            )
