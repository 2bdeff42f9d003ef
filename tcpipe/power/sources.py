"""Voltages and currents of a power topic's messages, by the tables of its type; and reasons to reject them.

A *rail* is one voltage and the currents drawn at it; a robot's propulsion power is the sum over its rails. It excludes
the supply of computers and user ports if the message measures it separately (paper, section IV-A: "current consumed by
the motors for propulsion").

Power of joints (sensor_msgs/JointState): each draws p = torque * speed + r * torque². If the torque is the motor
current's (times the torque constant, at the shaft whose speed is measured) and r the motor's resistance over the
squared constant, p is the motor's electrical power, including losses of gears and bearings. A torque measured behind
the gear excludes them. Electronics and the idle power of drives are never included. A braking joint gives back -p where
p is negative; unless the source states that this is recovered, it counts as 0: a brake resistor or the drive takes it.
"""

from __future__ import annotations

import re
from collections import Counter as Counts
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from tcpipe.arrays import Columns, Floats, Ints, Mask, Texts
from tcpipe.power.plausibility import REJECTED
from tcpipe.power.rails import UNIT_VOLT, is_power_only
from tcpipe.robots import FieldPath, PowerSource, parse_fields
from tcpipe.tables.findings import Finding, Subject, make_finding, read_threshold

HuskyPower = Literal["battery", "drivers"]

NAMES, SPEED, TORQUE = "name[]", "velocity", "effort"
"""Columns of such messages."""


@dataclass(frozen=True, slots=True)
class JointMotion:
    """Torques [N m] and speeds [rad/s] of some joints, shape (N, J); NaN where a message lacks a joint or its value."""

    names: tuple[str, ...]
    torque_nm: Floats
    speed_radps: Floats


def select_joints(columns: Columns, source: PowerSource) -> JointMotion:
    """Return a source's joints, in any order in messages; ``columns``: of messages that have all three fields."""
    layouts = _find_layouts(columns[NAMES])
    joints = sorted({name for layout in layouts for name in layout if name and re.fullmatch(source.joints, name)})
    values = np.full((2, len(columns[NAMES]), len(joints)), np.nan)
    for value, field in zip(values, (TORQUE, SPEED), strict=True):
        for layout, rows in layouts.items():
            for at, name in enumerate(layout[: columns[field].shape[1]]):
                if name in joints:
                    value[rows, joints.index(name)] = columns[field][rows, at]
    return JointMotion(tuple(joints), source.torque_scale * values[0], source.speed_scale * values[1])


def _find_layouts(names: Texts) -> dict[tuple[str, ...], Ints]:
    """Return the rows of at least one message, shape (N, k), by their lists of names."""
    first = np.flatnonzero(np.concatenate(([True], (names[1:] != names[:-1]).any(axis=1))))
    found: dict[tuple[str, ...], list[Ints]] = {}
    for rows in np.split(np.arange(len(names)), first[1:]):
        found.setdefault(tuple(names[rows[0]].tolist()), []).append(rows)
    return {layout: np.concatenate(parts) for layout, parts in found.items()}


@dataclass(frozen=True, slots=True)
class JointPower:
    """Power that joints draw [W], shape (N,), and shares of its sum: loss, and energy given back but not counted."""

    names: tuple[str, ...]
    watt: Floats
    loss_fraction: float
    returned_fraction: float


def compute_joint_power(motion: JointMotion, source: PowerSource, *, sign: int) -> JointPower:
    """Return the power of joints, with torques times ``sign``; NaN in rows that lack one."""
    loss = source.loss_watt_per_nm2 * motion.torque_nm**2
    joint = sign * motion.torque_nm * motion.speed_radps + loss
    drawn_watt = joint if source.recovered else np.where(joint < 0.0, 0.0, joint)
    watt = drawn_watt.sum(axis=1)
    known = np.isfinite(watt)
    total = float(watt[known].sum())
    lost, returned = float(loss[known].sum()), float((drawn_watt - joint)[known].sum())
    return JointPower(motion.names, watt, *((lost / total, returned / total) if total > 0.0 else (0.0, 0.0)))


def reject_power(topic: str, reason: str, *, names: Mapping[str, str] | None = None, **numbers: Any) -> Finding:
    """Return the finding that a topic's power is not used; ``reason`` in kebab case; names and numbers are evidence."""
    return make_finding(REJECTED, Subject("topic", topic), names={"reason": reason, **(names or {})}, **numbers)


@dataclass(frozen=True, slots=True)
class RailReadings:
    """A rail's readings, NaN where a row carries none: voltage [V] and current [A], shape (N,).

    For an energy counter the current is preliminary, by times that are not verified yet. In ``unmeasured_count`` rows
    one of the summed currents was frozen or clipped: there the current is NaN.
    """

    name: str
    voltage_volt: Floats
    current_amp: Floats
    counter: Counter | None = None
    joints: JointPower | None = None
    unmeasured_count: int = 0

    @property
    def largest_amp(self) -> float:
        """The largest plausible current [A]; where only power is known, the largest power [W]."""
        return LARGEST_AMP * (_LARGEST_PER_VOLT if is_power_only(self.voltage_volt) else 1.0)


BATTERY_STATE = "sensor_msgs/msg/BatteryState"
_PERCENTAGE = "percentage"

FLOAT_TYPES = ("std_msgs/msg/Float32", "std_msgs/msg/Float64")
"""Types of a single voltage or current; the topic's name determines which."""


def find_sources(
    type_name: str, topic: str, known: Sequence[PowerSource], *, platform: str | None, husky_power: HuskyPower
) -> list[list[PowerSource]] | Finding:
    """Return the power sources of a topic's messages, one a rail, then alternatives; or the reason why none is known.

    Of the tables of its type that fit, the most specific counts: of ``husky_power``, of the platform, of the topic.
    """
    of_type = [source for source in known if source.type == type_name]
    fitting = [
        source
        for source in of_type
        if source.platform in (None, platform)
        and source.husky_power in (None, husky_power)
        and topic.endswith(source.topic or "")
    ]
    choices = [
        _select_most_specific([source for source in fitting if source.fallback is last]) for last in (False, True)
    ]
    if choices := [choice for choice in choices if choice]:
        is_refused = any(source.unsupported_reason for source in choices[0])
        return reject_power(topic, "no-battery-current", names={"type": type_name}) if is_refused else choices
    if type_name in FLOAT_TYPES:
        return _make_float_source(type_name, topic)
    names = {"type": type_name}
    if platforms := sorted({source.platform for source in of_type if source.platform}):
        return reject_power(topic, "robot-platform-unknown", names=names | {"platforms": ", ".join(platforms)})
    return reject_power(topic, "message-type-unknown", names=names)


def list_power_lists(type_name: str, known: Sequence[PowerSource]) -> frozenset[str]:
    """Return the columns inside lists of messages that a type's tables name (drivers[].current), and joint names."""
    of_type = [source for source in known if source.type == type_name]
    texts = [text for source in of_type for text in (source.voltage, source.current, source.power, source.energy)]
    numbers = {field.column for text in texts for field in parse_fields(text) if "[]." in field.column}
    return frozenset(numbers | ({NAMES} if any(source.joints for source in of_type) else set()))


def _select_most_specific(fitting: Sequence[PowerSource]) -> list[PowerSource]:
    ranks = [(each.husky_power is not None, each.platform is not None, each.topic is not None) for each in fitting]
    return [source for source, rank in zip(fitting, ranks, strict=True) if rank == max(ranks)]


_QUANTITY = re.compile(r"volt(?:age)?|curr(?:ent)?|amp(?:ere)?s?")
_CORRECTED = "_corrected"


def find_quantity(topic: str) -> Literal["voltage", "current"] | None:
    """Return the quantity of a plain number on a topic, from the last word of its name that states one."""
    found = _QUANTITY.findall(topic.lower())
    if not found:
        return None
    return "voltage" if found[-1].startswith("v") else "current"


def make_rail_name(topic: str) -> str:
    """Return the rail's name: the topic's without its quantity, so that a rail's voltage and current share it."""
    return _QUANTITY.sub("", topic.lower().removesuffix(_CORRECTED)).rstrip("/_")


def is_of_drives(topic: str) -> bool:
    """Return whether a topic's name indicates the drives, rather than a whole battery."""
    return re.search(r"drive|motor|traction|wheel|esc(?![a-z])|inverter", topic.lower()) is not None


_OTHER_SIDE = {"left": "right", "right": "left"}


def find_lone_side(topics: Collection[str]) -> str | None:
    """Return a topic of the drives of one side whose other side is not among the topics; None without one."""
    names = {topic.lower() for topic in topics}
    for topic in filter(is_of_drives, topics):
        sides = set(re.findall("left|right", topic.lower()))
        if len(sides) == 1 and topic.lower().replace(side := sides.pop(), _OTHER_SIDE[side]) not in names:
            return topic
    return None


def is_corrected(topic: str) -> bool:
    """Whether a topic is the corrected form of another (which is called the same without the word)."""
    return topic.lower().endswith(_CORRECTED)


def _make_float_source(type_name: str, topic: str) -> list[list[PowerSource]] | Finding:
    """Return the source of a plain number, by its topic's name."""
    what = find_quantity(topic)
    if what is None:
        return reject_power(topic, "quantity-unknown", names={"type": type_name})
    voltage, current = ("data", "") if what == "voltage" else ("", "data")
    return [[PowerSource(type_name, voltage, current, sign="auto")]]


def read_rails(
    columns: Columns, sources: Sequence[PowerSource], topic: str, known: Sequence[PowerSource] = ()
) -> list[RailReadings] | Finding:
    """Return the rails of a topic, or why its messages do not fit the sources.

    Parameters
    ----------
    columns : ``log_time_ns`` and the message's fields by dotted name; lists as shape (N, k), rows padded with NaN.
    sources : from `find_sources`.
    known : every table, for the platforms that would fit.
    """
    for source in sources:
        if found := _find_misfit(columns, source, topic, known):
            return found
    rails = []
    for source in sources:
        rail = _read_joints(columns, source, topic) if source.joints else _read_rail(columns, source, topic)
        if isinstance(rail, Finding):
            return rail
        rails.append(rail)
    joints = Counts(name for rail in rails if rail.joints for name in rail.joints.names)
    if twice := [name for name, count in joints.items() if count > 1]:
        return reject_power(topic, "joint-in-two-tables", names={"joints": ", ".join(twice)})
    return rails


def _read_joints(columns: Columns, source: PowerSource, topic: str) -> RailReadings | Finding:
    """Return the power of a source's joints, or why it is unknown; torques against the motion have the wrong sign."""
    motion = select_joints(columns, source)
    if not motion.names:
        known_joints = ", ".join(np.unique(columns[NAMES]).tolist())
        return reject_power(topic, "no-joint", names={"wanted": source.joints, "joints": known_joints})
    for reason, values in (("no-effort", motion.torque_nm), ("no-velocity", motion.speed_radps)):
        if lacking := [name for name, column in zip(motion.names, values.T, strict=True) if np.isnan(column).all()]:
            return reject_power(topic, reason, names={"joints": ", ".join(lacking)})
    watt = (motion.torque_nm * motion.speed_radps).sum(axis=1)
    if np.isnan(watt).all():
        return reject_power(topic, "joints-apart", names={"joints": ", ".join(motion.names)})
    mean_sign, net = sign_by_mean(watt, np.ones(len(watt)))
    sign = {"drawn_positive": 1, "drawn_negative": -1, "auto": mean_sign}[source.sign]
    if not sign or mean_sign == -sign:
        return reject_power(topic, "torque-against-motion" if sign else "sign-unknown", net_fraction=abs(net))
    found = compute_joint_power(motion, source, sign=sign)
    return RailReadings(source.rail or topic, np.full(len(watt), UNIT_VOLT), found.watt, joints=found)


def _find_misfit(columns: Columns, source: PowerSource, topic: str, known: Sequence[PowerSource]) -> Finding | None:
    """Return why messages do not fit a source."""
    if source.joints and (lacking := [name for name in (NAMES, SPEED, TORQUE) if name not in columns]):
        return reject_power(topic, "field-missing", names={"field": ", ".join(lacking).replace("[]", "")})
    currents = parse_fields(source.current)
    others = (source.voltage, source.power, source.energy)
    for field in [*currents, *(term for text in others for term in parse_fields(text))]:
        names = {"field": field.column}
        if field.column not in columns:
            return reject_power(topic, "field-missing", names=names)
        width = columns[field.column].shape[1] if columns[field.column].ndim == 2 else None
        if not field.every and field.index is None and width is not None:
            return reject_power(topic, "field-is-a-list", names=names)
        needed = field.index + 1 if field.index is not None else int(field.every)
        listed = source.currents_listed if field in currents else None
        if (needed and (width or 0) < needed) or listed not in (None, width):
            fitting = [
                candidate
                for candidate in known
                if width and candidate.type == source.type and candidate.currents_listed == width
            ]
            if platforms := sorted({candidate.platform for candidate in fitting if candidate.platform}):
                names["platforms"] = ", ".join(platforms)
            counts = {"values_count": width or 0, "expected_count": listed or needed}
            return reject_power(topic, "values-count-differs", names=names, **counts)
    return None


def _read_rail(columns: Columns, source: PowerSource, topic: str) -> RailReadings:
    name = source.rail or (make_rail_name(topic) if source.type in FLOAT_TYPES else topic)
    voltage = source.voltage_scale * _sum_fields(columns, parse_fields(source.voltage))
    if not source.voltage and (source.lacks_voltage or source.nominal_voltage_volt is not None):
        voltage = np.full(len(voltage), UNIT_VOLT if source.lacks_voltage else source.nominal_voltage_volt)
    if source.energy:
        parts = [
            (field.sign * source.energy_scale, read_values(columns, field)) for field in parse_fields(source.energy)
        ]
        counter = count_energy(parts, wraps=source.counter_wraps)
        return RailReadings(name, voltage, counter.mean_amp(_choose_stamps(columns), voltage), counter)
    current = source.current_scale * _sum_fields(columns, parse_fields(source.current))
    if source.power:
        watt = source.current_scale * _sum_fields(columns, parse_fields(source.power))
        current = np.divide(watt, voltage, out=np.full(len(watt), np.nan), where=voltage > 0.0)
    if source.wraps_amp is not None:
        current = unwrap_currents(current, source.wraps_amp)
    currents = [source.current_scale * read_values(columns, field) for field in parse_fields(source.current)]
    unmeasured = np.zeros(len(current), bool)
    if currents:
        unmeasured = find_unmeasured(np.column_stack(currents), _choose_stamps(columns), wraps_amp=source.wraps_amp)
    current = np.where(unmeasured, np.nan, current)
    return RailReadings(name, voltage, current, unmeasured_count=int(unmeasured.sum()))


_FROZEN_NS, _FEWEST_EQUAL = 5_000_000_000, 20
_MIN_MOVE_SHARE = 0.5  # share of the range of 90 % of a current: a current that changes by more is driven
_BESIDE, _CROWDED = 20, 10.0
"""Levels next to the end of a range, and least count at the end of a clipped current over that of such a level."""


def find_unmeasured(parts: Floats, stamp_ns: Ints, *, wraps_amp: float | None = None) -> Mask:
    """Return rows in which one of the currents, shape (N, K), is clipped, or repeats as another changes, (N,)."""
    found = np.zeros(len(parts), bool)
    parts = np.where(np.abs(parts) <= _IMPOSSIBLE, parts, np.nan)
    for column, values in enumerate(parts.T):
        wraps = wraps_amp or find_wrap(values)  # the end of an unsigned current is the smallest that flows back
        is_clipped = _is_clipped(values if wraps is None else unwrap_currents(values, wraps))
        found |= is_clipped | _is_frozen(values, np.delete(parts, column, axis=1), stamp_ns)
    return found


def _is_clipped(values: Floats) -> Mask:
    """Return where a current is at the end of its sensor's range: values crowd there, and stay."""
    levels, counts = np.unique(values[np.isfinite(values)], return_counts=True)
    at_end = np.zeros(len(values), bool)
    if len(levels) <= _BESIDE:
        return at_end
    if abs(levels[0]) > abs(levels[-1]):
        levels, counts = levels[::-1], counts[::-1]
    if counts[-1] >= max(_FEWEST_EQUAL, _CROWDED * float(counts[-1 - _BESIDE : -1].mean())):
        at_end = values == levels[-1]
    stays = at_end[1:] & at_end[:-1]
    return at_end if 2 * stays.sum() >= at_end.sum() else np.zeros_like(at_end)


def _is_frozen(values: Floats, others: Floats, stamp_ns: Ints) -> Mask:
    """Return rows in which a current repeats for seconds while one of the others, shape (N, K), changes (driving)."""
    frozen = np.zeros(len(values), bool)
    first = np.flatnonzero(np.concatenate(([True], values[1:] != values[:-1])))
    last = np.append(first[1:], len(values)) - 1
    is_long = (last - first >= _FEWEST_EQUAL) & (stamp_ns[last] - stamp_ns[first] >= _FROZEN_NS)
    others = others[:, np.isfinite(others).any(axis=0)]
    if is_long.any() and others.size:
        low, high = np.nanquantile(others, (0.05, 0.95), axis=0)
        for begin, end in zip(first[is_long], last[is_long] + 1, strict=True):
            frozen[begin:end] = (np.ptp(others[begin:end], axis=0) > _MIN_MOVE_SHARE * (high - low)).any()
    return frozen


_VALUES = 65536
_STEPS_AMP = (*(2.0**-bits for bits in range(9)), 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
_OFF_GRID = 0.02


def find_wrap(current_amp: Floats) -> float | None:
    """Return the wrap to subtract from upper values of a current [A], shape (N,), NaN if unknown; None without wraps.

    A Warthog's motor controllers send a signed number of 1/16 A as unsigned (norlab-ulaval/warthog_sevcon_fix),
    AgileX's sent 0.1 A so until 2024 (agilexrobotics/ugv_sdk, 7769abf): -2 A reads as 4094 A, or as 6551.6 A. A current
    wraps if all values are on the grid of a number of 16 bits, some in its upper quarter, and none in the two middle
    quarters, which no current crosses without a value there.
    """
    known = current_amp[np.isfinite(current_amp)]
    if known.size < _FEWEST_EQUAL or known.min() < 0.0:
        return None
    top = float(known.max())
    for step_amp in _STEPS_AMP:
        wraps_amp = _VALUES * step_amp
        if not 0.75 * wraps_amp < top < wraps_amp or np.any((known > wraps_amp / 4) & (known < 0.75 * wraps_amp)):
            continue
        if np.all(np.abs(known / step_amp - np.rint(known / step_amp)) < _OFF_GRID):
            return wraps_amp
    return None


def unwrap_currents(current_amp: Floats, wraps_amp: float) -> Floats:
    """Return currents [A], shape (N,), with the sign restored of values that were read as unsigned."""
    return np.where(current_amp > wraps_amp / 2, current_amp - wraps_amp, current_amp)


def _choose_stamps(columns: Columns) -> Ints:
    """Return the header's stamps where all are set, else the log's times [ns]: messages are written down in bursts."""
    if "header.stamp.sec" in columns:
        stamps = np.asarray(columns["header.stamp.sec"], np.int64) * 1_000_000_000
        stamps += np.asarray(columns["header.stamp.nanosec"], np.int64)
        if stamps.all():
            return stamps
    return np.asarray(columns["log_time_ns"], np.int64)


def _sum_fields(columns: Columns, fields: Sequence[FieldPath]) -> Floats:
    """Return the sum of fields, NaN without fields or where one of them is unknown."""
    if not fields:
        return np.full(len(next(iter(columns.values()))), np.nan)
    parts = [
        np.where(np.abs(values) <= _IMPOSSIBLE, values, np.nan)
        for values in (read_values(columns, field) for field in fields)
    ]
    return np.asarray(np.sum([field.sign * values for field, values in zip(fields, parts, strict=True)], axis=0))


_IMPOSSIBLE = 1e6
"""No battery has more volts, no drive more amperes (a current in milliamperes is refused by its median)."""


def read_values(columns: Columns, field: FieldPath) -> Floats:
    """Return a field's values, shape (N,); of a list that is summed NaN where a row is shorter than others."""
    values = np.asarray(columns[field.column], float)
    return values.sum(axis=1) if field.every else values if field.index is None else values[:, field.index]


def find_rejection(rail: RailReadings, topic: str, columns: Columns) -> Finding | None:
    """Return why a rail's numbers cannot be power, with the evidence, or None if they can.

    Each rule needs every row to agree, or the median; a single deviating row is no evidence.
    """
    voltage, current = (values[np.isfinite(values)] for values in (rail.voltage_volt, rail.current_amp))
    live = voltage[voltage > 0.0]
    volt = float(np.median(live if len(live) else voltage)) if len(voltage) else np.nan
    amp = float(np.median(np.abs(current))) if len(current) else np.nan
    reason = _check_voltage(voltage, volt, rail.voltage_volt, columns) or _check_current(current, amp, rail.largest_amp)
    if 2 * rail.unmeasured_count > len(rail.current_amp):
        reason = "current-constant"
    if not len(voltage) and not len(current):
        reason = "no-numbers"
    if reason is None:
        return None
    evidence = {"median_volt": volt, "median_amp": amp, "rows_count": float(len(rail.voltage_volt))}
    evidence = {name: value for name, value in evidence.items() if np.isfinite(value)}
    return reject_power(topic, reason, names={"rail": rail.name}, **evidence)


def _check_voltage(voltage: Floats, median_volt: float, every_voltage: Floats, columns: Columns) -> str | None:
    if not len(voltage):
        return None
    if not np.any(voltage):
        return "voltage-zero"
    if _PERCENTAGE in columns:
        charge = np.asarray(columns[_PERCENTAGE], float)
        if np.all(np.isclose(charge, every_voltage) | np.isclose(100 * charge, every_voltage)):
            return "voltage-is-charge"
    if median_volt > LARGEST_VOLT:
        return "voltage-in-millivolts"
    return "voltage-too-small" if median_volt < _SMALLEST_VOLT else None


def _check_current(current: Floats, median_amp: float, largest_amp: float) -> str | None:
    if len(current) > _MIN_ROWS_TO_JUDGE and np.ptp(current) == 0:
        return "current-constant"
    return "current-in-milliamperes" if median_amp > largest_amp else None


LARGEST_VOLT, LARGEST_AMP = read_threshold(REJECTED, "max_median_volt"), read_threshold(REJECTED, "max_median_amp")
_LARGEST_PER_VOLT = 100.0  # times the largest current is the largest power [W]: 100 kW
_SMALLEST_VOLT = read_threshold(REJECTED, "min_median_volt")
_MIN_ROWS_TO_JUDGE = read_threshold(REJECTED, "max_equal_count")
_UNAMBIGUOUS = read_threshold(REJECTED, "min_net_fraction")  # of the charge moved flows one way


def sign_by_mean(current_amp: Floats, weight_s: Floats) -> tuple[int, float]:
    """Return the sign that makes the robot draw power over the run (0: unclear), and ∫I dt / ∫|I| dt, in [-1, 1].

    A driving robot draws more than it feeds back, so its mean current shows the sign. ``current_amp`` [A], shape (N,):
    sum of all rails as recorded; ``weight_s`` [s]: time of each row.
    """
    whole = float(np.nansum(np.abs(current_amp) * weight_s))
    ratio = float(np.nansum(current_amp * weight_s)) / whole if whole > 0 else 0.0
    return (int(np.sign(ratio)) if abs(ratio) > _UNAMBIGUOUS else 0), ratio


def apply_sign(rail: RailReadings, sign: int) -> RailReadings:
    """Return the rail with its current positive when drawn."""
    counter = None if rail.counter is None else rail.counter.times(sign)
    return replace(rail, current_amp=sign * rail.current_amp, counter=counter)


@dataclass(frozen=True, slots=True)
class Counter:
    """Counter by row: energy since the first row [J], shape (N,), NaN if a row has none, and earlier resets."""

    energy_joule: Floats
    resets: Ints

    def times(self, factor: int) -> Counter:
        """Return the counter with its energy multiplied."""
        return replace(self, energy_joule=factor * self.energy_joule)

    def mean_amp(self, stamp_ns: Ints, voltage_volt: Floats) -> Floats:
        """Return the mean current since the row before [A], at the row's voltage [V], shape (N,); stamps in [ns].

        Voltage times current, applied backwards from each stamp as for averaging sources, then equals the counted
        energy. NaN on the first row, after a reset, and where the stamp does not advance.
        """
        amp = np.full(len(stamp_ns), np.nan)
        row = np.flatnonzero(np.isfinite(self.energy_joule) & (voltage_volt > 0.0))
        passed_s = np.diff(stamp_ns[row]) / 1e9
        whole = (np.diff(self.resets[row]) == 0) & (passed_s > 0.0)
        joule = np.diff(self.energy_joule[row])
        amp[row[1:][whole]] = joule[whole] / passed_s[whole] / voltage_volt[row[1:]][whole]
        return amp


def count_energy(parts: Sequence[tuple[float, Floats]], *, wraps: float | None) -> Counter:
    """Return the summed energy of counters that only rise.

    ``parts``: energy of each counter's unit [J], negative if subtracted, and its values, shape (N,). A counter restarts
    from zero at ``wraps``, in its own unit; a fall that no wrap explains is a reset.
    """
    energy = np.zeros(len(parts[0][1]))
    resets = np.zeros(len(energy), np.int64)
    for unit_joule, reading in parts:
        row = np.flatnonzero(np.isfinite(reading))
        rise = np.diff(reading[row])
        if wraps is not None:
            rise = np.where((rise < 0.0) & (rise + wraps < wraps / 2), rise + wraps, rise)
        fell = rise < 0.0
        energy[np.setdiff1d(np.arange(len(energy)), row)] = np.nan
        energy[row[1:]] += unit_joule * np.cumsum(np.where(fell, 0.0, rise))
        resets[row[1:]] += np.cumsum(fell)
    return Counter(energy, resets)
