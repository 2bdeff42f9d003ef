"""Rails from the messages of power topics: verified, with every current positive when drawn."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from tcpipe.arrays import Columns, Floats
from tcpipe.power.audit import measure_sag
from tcpipe.power.plausibility import EXCLUDED, REJECTED, find_isolated, find_missing_rows, undo_overflow
from tcpipe.power.rails import UNIT_VOLT, is_power_only, make_rail, make_samples
from tcpipe.power.sources import (
    BATTERY_STATE,
    FLOAT_TYPES,
    HuskyPower,
    JointPower,
    RailReadings,
    apply_sign,
    find_rejection,
    find_sources,
    find_wrap,
    read_rails,
    read_values,
    reject_power,
    sign_by_mean,
    unwrap_currents,
)
from tcpipe.power.witnesses import compare_charge, compare_meters
from tcpipe.recipe.suggestions import suggest
from tcpipe.robots import (
    GAIN_STD_FRACTION,
    LOSS_STD_FRACTION,
    TORQUE_GAIN_STD_FRACTION,
    CurrentSign,
    PowerSource,
    parse_fields,
)
from tcpipe.tables.facts import PowerSign
from tcpipe.tables.findings import (
    Finding,
    Findings,
    Remedy,
    Severity,
    Subject,
    make_finding,
    read_threshold,
    select_findings,
)

_LOG_TIME = "log_time_ns"
_POWER = Subject("role", "power")
_ASSUMED, _WRAPPED, _NOMINAL = "current-sign-assumed", "current-wrapped", "voltage-assumed"
_STATUS, _CHARGING = "power_supply_status", 1
"""Field of sensor_msgs/BatteryState and its value while the battery is charged."""
_SIGNS = ("drawn_negative", "drawn_positive")

Rails = Mapping[str, list[RailReadings]]
"""By topic."""
TopicRailReadings = dict[str, list[RailReadings]]
Topics = Mapping[str, tuple[str, Columns]]
"""Type and columns of each topic."""


def _list_rails(rails: Rails) -> list[tuple[str, RailReadings]]:
    return [(topic, rail) for topic, of_topic in rails.items() for rail in of_topic]


@dataclass(frozen=True, slots=True)
class Sides:
    """Currents of both sides of the drive [A], positive when drawn, shape (N,), and log times of their rows [ns]."""

    log_time_ns: Floats
    first_amp: Floats
    second_amp: Floats


@dataclass(frozen=True, slots=True)
class PowerReadings:
    """Power topics: ``rails`` have one row a message; without rails ``findings`` give the reason of rejection."""

    rails: Rails = field(default_factory=dict)
    findings: Findings = ()
    facts: PowerSign | None = None
    """None without power; its ``zero_amp`` is not subtracted yet."""
    averaging_unknown: bool = False
    """Whether the source averages is unknown; ``facts.averaged`` is the assumption if the motion does not show it."""
    sides: Sides | None = None
    """Currents of both sides of the drive; None if they are not measured separately."""

    @property
    def is_rejected(self) -> bool:
        """Whether there are power topics, but tcpipe does not use them."""
        return any(finding.code == REJECTED for finding in self.findings)


def read_power(
    topics: Topics,
    known: Sequence[PowerSource],
    *,
    platform: str | None = None,
    husky_power: HuskyPower = "battery",
    current_sign: CurrentSign = "auto",
    current_scale: float = 1.0,
    offset_amp: float = 0.0,
) -> PowerReadings:
    """Return the rails of all power topics, with every current positive when drawn.

    ``topics``: message type and columns by topic; ``known``: tables of message types; ``platform``: the robot's; the
    rest are recipe keys.
    """
    rails: TopicRailReadings = {}
    sources: list[PowerSource] = []
    rejected: list[Finding] = []
    scaled: dict[str, list[PowerSource]] = {}
    findings: list[Finding] = []
    gains: list[float] = []
    for topic, (type_name, columns) in topics.items():
        if too_few := _find_too_few(topic, _read_log_times(columns)):
            rejected += too_few
            continue
        choices = find_sources(type_name, topic, known, platform=platform, husky_power=husky_power)
        if not isinstance(choices, Finding):
            choices = [[_scale_source(source, current_scale) for source in choice] for choice in choices]
        found = [choices] if isinstance(choices, Finding) else _read_first_valid(topic, columns, choices, known)
        if isinstance(found, list):
            rejected += found
            scaled[topic] = (
                [] if isinstance(choices, Finding) else _convert_thousandths(topic, columns, choices[0], known)
            )
            continue
        sources += found.sources
        findings += found.findings
        gains += [_find_gain_std(source, rail.joints) for source, rail in zip(found.sources, found.rails, strict=True)]
        rails[topic] = found.rails if current_sign != "auto" else found.apply_type_signs()
    rails = _pair_rails(rails)
    rejected = rejected or _find_incomplete(rails)
    log_times = {topic: _read_log_times(columns) for topic, (_, columns) in topics.items()}
    if not rejected:
        rails, excluded = _exclude_rows(rails, log_times)
        rails, wrapped = _undo_overflows(rails, log_times)
        findings += [*excluded, *wrapped]
        rejected = select_findings(findings, REJECTED) or _find_too_small(rails)
    if rejected:
        if len(scaled) == len(topics) and all(scaled.values()):
            rejected[0] = replace(rejected[0], remedies=_propose_sources(scaled))
        return PowerReadings(findings=tuple(rejected))
    given: CurrentSign = "auto" if any(source.joints for source in sources) else current_sign
    sign, sign_findings, sign_source = _find_drawn_sign(rails, log_times, sources, given)
    if sign == 0:
        return PowerReadings(findings=sign_findings)
    includes = tuple(dict.fromkeys(source.other_loads for source in sources if source.other_loads))
    loads = (make_finding("power-includes-loads", _POWER, names={"loads": name}) for name in includes)
    nominal = list(_find_nominal(sources))
    constant = [] if nominal else list(_find_constant_voltages(rails, _sum_currents(rails, log_times)[1]))
    findings += [*sign_findings, *loads, *nominal, *constant]
    signed = {topic: [apply_sign(rail, sign) for rail in found] for topic, found in rails.items()}
    counts = any(source.energy for source in sources)
    rest_amp = [source.rest_current_amp for source in sources if source.current and source.rest_current_amp]
    is_rest_known = rest_amp and len(rest_amp) == sum(bool(source.current or source.energy) for source in sources)
    facts = PowerSign(
        sign_source,
        counts or any(source.averaged for source in sources),
        includes,
        math.hypot(max(gains), *(finding.numbers["std_fraction"] for finding in constant)),
        max(source.zero_std for source in sources),
        (min(low for low, _ in rest_amp), max(high for _, high in rest_amp)) if is_rest_known else None,
        offset_amp,
        any(np.any(columns.get(_STATUS, ()) == _CHARGING) for _, columns in topics.values()),
        _compare_charges(topics, signed),
    )
    unknown = any(source.averaging_unknown for source in sources) and not counts
    return PowerReadings(
        signed, tuple(dict.fromkeys(findings)), facts, unknown, _find_sides(topics, sources, signed, sign)
    )


def _read_log_times(columns: Columns) -> Floats:
    return np.asarray(columns[_LOG_TIME], float)


def _scale_source(source: PowerSource, factor: float) -> PowerSource:
    """Return a source with its currents, powers, counters and torques multiplied."""
    scales = ("current_scale", "energy_scale", "torque_scale")
    return replace(source, **{name: factor * getattr(source, name) for name in scales})


def _compare_charges(topics: Topics, rails: Rails) -> float | None:
    """Return the integral of the current over the fall of the charge, of the topic whose charge contradicts it most."""
    ratios = []
    for topic, of_topic in rails.items():
        _, columns = topics[topic]
        charge_ah = _read_charge(columns)
        if charge_ah is not None and not is_power_only(of_topic[0].voltage_volt):
            time_s = _read_log_times(columns) * 1e-9
            ratios.append(compare_charge(time_s, np.sum([rail.current_amp for rail in of_topic], axis=0), charge_ah))
    return max((ratio for ratio in ratios if ratio), key=lambda ratio: abs(math.log(abs(ratio))), default=None)


def _read_charge(columns: Columns) -> Floats | None:
    """Return a battery's charge [Ah], shape (N,): measured, else state of charge times capacity; None without both."""
    names = ("charge", "percentage", "capacity", "design_capacity")
    values = {name: np.asarray(columns[name], np.float64) for name in names if name in columns}
    measured = {name: value for name, value in values.items() if (value > 0.0).any()}  # 0 and NaN: not measured
    if "charge" in measured:
        return measured["charge"]
    share, capacity_ah = measured.get("percentage"), measured.get("capacity", measured.get("design_capacity"))
    if share is None or capacity_ah is None:
        return None
    return share * capacity_ah / (100.0 if np.nanmax(share) > 1.0 else 1.0)


_MIN_CORRELATION = 0.7  # smallest correlation at which a second meter measures the same power


def compare_second_meters(
    power: PowerReadings, topics: Topics, meters: Topics, known: Sequence[PowerSource], *, platform: str | None = None
) -> PowerReadings:
    """Return the power with the slope of the most contradictory second meter; ``meters``: power topics not used."""
    series = [_sum_watt(topics[topic][1], rails) for topic, rails in power.rails.items()]
    if power.facts is None or not meters:
        return power
    slopes = []
    for topic, (type_name, columns) in meters.items():
        choices = find_sources(type_name, topic, known, platform=platform, husky_power="battery")
        rails = choices if isinstance(choices, Finding) else read_rails(columns, choices[0], topic, known)
        if isinstance(rails, Finding) or len(columns[_LOG_TIME]) < read_threshold(REJECTED, "min_messages_count"):
            continue
        at_ns, watt = _sum_watt(columns, rails)
        drive = sum(np.interp(at_ns, *each, left=np.nan, right=np.nan) for each in series)
        slope, correlation = compare_meters(np.asarray(drive, float), watt) or (np.nan, 0.0)
        if abs(correlation) > _MIN_CORRELATION:
            slopes.append(abs(slope))
    worst = max(slopes, key=lambda slope: abs(math.log(slope)), default=None)
    return replace(power, facts=replace(power.facts, meter_slope=worst))


def _sum_watt(columns: Columns, rails: Sequence[RailReadings]) -> tuple[Floats, Floats]:
    """Return the log times [ns] at which all rails of a topic have a power, and their sum [W]."""
    watt = np.sum([rail.voltage_volt * rail.current_amp for rail in rails], axis=0)
    known = np.isfinite(watt)
    return _read_log_times(columns)[known], watt[known]


def _find_sides(topics: Topics, sources: Sequence[PowerSource], rails: Rails, sign: int) -> Sides | None:
    """Return the currents of both sides: the two currents that one source adds, or two rails called left and right."""
    if len(sources) == 1 and len(fields_added := parse_fields(sources[0].current)) == 2:
        (topic,) = rails
        _, columns = topics[topic]
        of_sign = -1 if sources[0].sign == "drawn_negative" else 1
        first, second = (of_sign * sign * field.sign * read_values(columns, field) for field in fields_added)
        return Sides(_read_log_times(columns), first, second)
    entries = _list_rails(rails)
    left, right = ([entry for entry in entries if side in entry[1].name.lower()] for side in ("left", "right"))
    if len(entries) != 2 or len(left) != 1 or len(right) != 1:
        return None
    left_ns, right_ns = (_read_log_times(topics[topic][1]) for topic, _ in (*left, *right))
    left_amp, right_amp = (rail.current_amp for _, rail in (*left, *right))
    known = np.isfinite(right_amp)
    return Sides(left_ns, left_amp, np.interp(left_ns, right_ns[known], right_amp[known]))


def _find_nominal(sources: Sequence[PowerSource]) -> Iterator[Finding]:
    """Yield the finding that a voltage is assumed."""
    for source in sources:
        if (volt := source.nominal_voltage_volt) is not None:
            names, fraction = {"rail": source.rail or source.topic or source.type}, source.nominal_voltage_std_fraction
            yield make_finding(_NOMINAL, _POWER, names=names, voltage_volt=volt, std_fraction=fraction)


def _find_constant_voltages(rails: Rails, amp: Floats) -> Iterator[Finding]:
    """Yield the rails whose voltage has too few levels to be measured, while the whole current [A] changes."""
    fraction, least = (read_threshold(_NOMINAL, f"constant_{name}") for name in ("std_fraction", "levels_count"))
    for _, rail in _list_rails(rails):
        levels = np.unique(rail.voltage_volt[np.isfinite(rail.voltage_volt)])
        if 0 < levels.size < least and levels[0] != UNIT_VOLT and np.unique(amp).size > 4 * least:
            names, volt = {"rail": rail.name}, levels.mean()
            yield make_finding(_NOMINAL, _POWER, names=names, voltage_volt=volt, std_fraction=fraction)


@dataclass(frozen=True, slots=True)
class _TopicRails:
    """Sources of a topic's messages, and a rail for each."""

    sources: list[PowerSource]
    rails: list[RailReadings]
    findings: list[Finding]

    def apply_type_signs(self) -> list[RailReadings]:
        """Return the rails with the sign that their type gives a drawn current."""
        each = zip(self.rails, self.sources, strict=True)
        return [
            apply_sign(rail, -1 if source.sign == "drawn_negative" and not source.joints else 1)
            for rail, source in each
        ]


def _read_first_valid(
    topic: str, columns: Columns, choices: Sequence[list[PowerSource]], known: Sequence[PowerSource]
) -> _TopicRails | list[Finding]:
    """Return the rails of the first choice whose numbers can be power, or why no choice can."""
    rejected: list[Finding] = []
    for sources in choices:
        found = read_rails(columns, sources, topic, known)
        if isinstance(found, Finding):
            rejected.append(found)
            continue
        read = [_unwrap_currents(rail) for rail in found]
        rails, findings = [rail for rail, _ in read], [found for _, each in read for found in each]
        if problems := [why for rail in rails if (why := find_rejection(rail, topic, columns)) is not None]:
            rejected += problems
            continue
        used = " + ".join(rail.name for rail in rails)
        findings += [_find_joints(rail.joints) for rail in rails if rail.joints]
        findings += [make_finding("power-fallback", why.subject, names={**why.names, "used": used}) for why in rejected]
        return _TopicRails(sources, rails, findings)
    return rejected


def _find_gain_std(source: PowerSource, joints: JointPower | None) -> float:
    """Return the σ of a rail's gain; an error of torques changes their loss twice as much."""
    loss = joints.loss_fraction if joints else 0.0
    default_std = TORQUE_GAIN_STD_FRACTION if joints else GAIN_STD_FRACTION
    stated = default_std if source.gain_std_fraction is None else source.gain_std_fraction
    nominal = 0.0 if source.nominal_voltage_volt is None else source.nominal_voltage_std_fraction
    return math.hypot(stated * (1.0 + loss), LOSS_STD_FRACTION * loss, nominal)


def _find_joints(joints: JointPower) -> Finding:
    """Return the finding that power is mechanical."""
    names, loss, returned = {"joints": ", ".join(joints.names)}, joints.loss_fraction, joints.returned_fraction
    return make_finding("power-from-joints", _POWER, names=names, loss_fraction=loss, returned_fraction=returned)


def _convert_thousandths(
    topic: str, columns: Columns, sources: Sequence[PowerSource], known: Sequence[PowerSource]
) -> list[PowerSource]:
    """Return the sources in mV or mA whose numbers give possible power then; none if they do not."""
    for volt, amp in ((1.0, 1e-3), (1e-3, 1.0), (1e-3, 1e-3)):
        scaled = [
            replace(source, voltage_scale=volt * source.voltage_scale, current_scale=amp * source.current_scale)
            for source in sources
        ]
        found = read_rails(columns, scaled, topic, known)
        if not isinstance(found, Finding) and all(find_rejection(rail, topic, columns) is None for rail in found):
            return scaled
    return []


def _propose_sources(sources: Mapping[str, Sequence[PowerSource]]) -> tuple[Remedy, ...]:
    """Return the tables of a recipe for the sources of topics; of one topic alone for all of its type."""
    rows, alone = [], len(sources) == 1
    for topic, of_topic in sources.items():
        named = [
            source if alone and source.type not in FLOAT_TYPES else replace(source, topic=topic) for source in of_topic
        ]
        rows += [
            {entry.name: value for entry in fields(each) if (value := getattr(each, entry.name)) != entry.default}
            for each in named
        ]
    return suggest("scale", {"power_sources": rows})


def _unwrap_currents(rail: RailReadings) -> tuple[RailReadings, list[Finding]]:
    """Return a rail with wrapped negative currents restored, and findings on them and on its energy counter."""
    names = {"rail": rail.name}
    if rail.counter is not None:
        resets = int(rail.counter.resets.max(initial=0))
        return rail, [make_finding("counter-reset", _POWER, names=names, resets_count=resets)] if resets else []
    wraps_amp = find_wrap(rail.current_amp)
    if wraps_amp is None:
        return rail, []
    count = int(np.count_nonzero(rail.current_amp > wraps_amp / 2))
    found = make_finding(_WRAPPED, _POWER, names=names, currents_count=count, wraps_amp=wraps_amp)
    return replace(rail, current_amp=unwrap_currents(rail.current_amp, wraps_amp)), [found]


def _pair_rails(rails: TopicRailReadings) -> TopicRailReadings:
    """Give the one rail without current and the one without voltage a common name: they are one rail on two topics."""
    without_voltage = [rail.name for _, rail in _list_rails(rails) if not np.isfinite(rail.voltage_volt).any()]
    without_current = [rail.name for _, rail in _list_rails(rails) if not np.isfinite(rail.current_amp).any()]
    if len(without_voltage) != 1 or len(without_current) != 1 or without_voltage == without_current:
        return rails
    pair = {*without_voltage, *without_current}
    return {
        topic: [replace(rail, name="battery") if rail.name in pair else rail for rail in found]
        for topic, found in rails.items()
    }


def _find_incomplete(rails: Rails) -> list[Finding]:
    """Return the topics whose rails give no power, because they lack a voltage or a current."""
    parts: dict[str, list[tuple[str, RailReadings]]] = {}
    for topic, rail in _list_rails(rails):
        parts.setdefault(rail.name, []).append((topic, rail))
    return [
        reject_power(named_parts[0][0], f"no-{quantity}", names={"rail": name})
        for name, named_parts in parts.items()
        for quantity, column in (("voltage", "voltage_volt"), ("current", "current_amp"))
        if not any(np.isfinite(getattr(part, column)).any() for _, part in named_parts)
    ]


def _find_too_small(rails: Rails) -> list[Finding]:
    """Return why rails together are no power: the smallest motors take more without load, their unit is another one."""
    parts = _list_rails(rails)
    volts = {rail.name: np.nanmedian(rail.voltage_volt) for _, rail in parts if np.isfinite(rail.voltage_volt).any()}
    amps = {
        rail.name: np.nanquantile(np.abs(rail.current_amp), 0.99)
        for _, rail in parts
        if np.isfinite(rail.current_amp).any()
    }
    high_watt = float(sum(amp * volts[name] for name, amp in amps.items()))
    if high_watt >= read_threshold(REJECTED, "min_high_watt"):
        return []
    return [reject_power(parts[0][0], "power-too-small", high_watt=high_watt)]


def _find_too_few(topic: str, log_time_ns: Floats) -> list[Finding]:
    """Return why a topic's rate is too low for the energy of a segment: too few messages, or too far apart."""
    if log_time_ns.size < read_threshold(REJECTED, "min_messages_count"):
        return [reject_power(topic, "too-few-messages", messages_count=log_time_ns.size)]
    period_s = float(np.median(np.diff(log_time_ns))) / 1e9
    return (
        [reject_power(topic, "too-slow", period_s=period_s)]
        if period_s > read_threshold(REJECTED, "max_period_s")
        else []
    )


def _exclude_rows(rails: Rails, log_times: Mapping[str, Floats]) -> tuple[TopicRailReadings, list[Finding]]:
    """Return the rails with NaN in rows without a measurement, and findings: their number, or rejection of the power.

    A row is one measurement: if its voltage or current is missing or implausible, both are excluded. Rows that a driver
    sends before the sensor starts and after it stops are not counted.
    """
    kept: TopicRailReadings = {topic: [] for topic in rails}
    findings = []
    for topic, rail in _list_rails(rails):
        volt, amp, names = rail.voltage_volt, rail.current_amp, {"rail": rail.name}
        excluded = np.abs(amp) > rail.largest_amp
        stated = np.nan if rail.counter else np.where(excluded, np.nan, amp)  # a counter's first row has no current
        excluded |= find_missing_rows(volt, np.broadcast_to(stated, amp.shape))
        isolated, is_rejected = find_isolated(undo_overflow(np.where(excluded, np.nan, amp))[0], log_times[topic] / 1e9)
        excluded |= isolated
        live = np.flatnonzero((np.isfinite(volt) | np.isfinite(amp)) & ~excluded)
        inner = excluded[live.min(initial=len(volt)) : live.max(initial=0)]
        count = max(int(np.count_nonzero(inner)), rail.unmeasured_count)
        if is_rejected:
            findings.append(reject_power(topic, "isolated-values", names=names))
        elif count:
            fraction = count / len(volt)
            findings.append(make_finding(EXCLUDED, _POWER, names=names, rows_count=count, rows_fraction=fraction))
        volt, amp = np.where(excluded, np.nan, volt), np.where(excluded, np.nan, amp)
        kept[topic].append(replace(rail, voltage_volt=volt, current_amp=amp))
    return kept, findings


def _undo_overflows(
    rails: TopicRailReadings, log_times: Mapping[str, Floats]
) -> tuple[TopicRailReadings, list[Finding]]:
    """Return rails without overflow of signed currents, and findings; reject power if the voltage contradicts them."""
    whole: TopicRailReadings = {topic: [] for topic in rails}
    findings, are_clear = [], True
    for topic, rail in _list_rails(rails):
        current_amp, span_amp, is_clear = undo_overflow(rail.current_amp)
        whole[topic].append(replace(rail, current_amp=current_amp))
        if span_amp and not rail.counter:
            count = int(np.count_nonzero(np.abs(current_amp - rail.current_amp) > span_amp / 2))
            names, are_clear = {"rail": rail.name}, are_clear and is_clear
            findings.append(make_finding(_WRAPPED, _POWER, names=names, currents_count=count, wraps_amp=span_amp))
    if not findings:
        return whole, []
    before, after = (_correlate_voltage(each, log_times) for each in (rails, whole))
    least = read_threshold(_WRAPPED, "min_correlation")
    if before >= max(after, least):
        return dict(rails), []
    if not are_clear or after < least:
        return whole, [reject_power(next(iter(rails)), "current-overflow", names=findings[0].names)]
    return whole, findings


def _correlate_voltage(rails: Rails, log_times: Mapping[str, Floats]) -> float:
    """Return the correlation of voltage and whole current within seconds, of either sign; 0 if it is unknown."""
    time_s, amp = _sum_currents(rails, log_times)
    volts = ((log_times[topic], rail.voltage_volt) for topic, rail in _list_rails(rails))
    at_ns, volt = next(each for each in volts if np.isfinite(each[1]).any())
    samples = [make_samples(at.astype(np.int64), value) for at, value in ((at_ns, volt), (1e9 * time_s, amp))]
    sag = measure_sag([make_rail("", *samples, averaged=False)])
    return 0.0 if sag is None or not sag.amp.any() else abs(float(np.corrcoef(sag.volt, sag.amp)[0, 1]))


def _find_drawn_sign(
    rails: Rails, log_times: Mapping[str, Floats], sources: list[PowerSource], given: CurrentSign
) -> tuple[int, Findings, str]:
    """Return the sign of a drawn current (0 if the record contradicts its type), findings, and the sign's source."""
    if given != "auto":
        return (1 if given == "drawn_positive" else -1), (), f"{given} (recipe)"
    time_s, whole = _sum_currents(rails, log_times)
    sign, net = sign_by_mean(whole, _weight_s(time_s))
    signs = {"drawn_positive" if source.joints else source.sign for source in sources}
    if "auto" not in signs:
        likely, other = "drawn_positive", "drawn_negative"
        if signs == {other}:
            likely, other = other, likely
        if sign >= 0 or time_s.size < read_threshold(REJECTED, "min_sign_count"):
            return 1, (), f"{likely} (message type)"
        return 0, (_find_sign(REJECTED, {"reason": "current-flows-back"}, net, other, likely),), ""
    return _sign_by_charge(sign, net, sources)


def _sign_by_charge(sign: int, net: float, sources: Sequence[PowerSource]) -> tuple[int, Findings, str]:
    """Return the result of `_find_drawn_sign` from the mean current, else by the convention of ROS, else no power."""
    if sign < 0:
        return -1, (), "drawn_negative (mean, as ROS has it)"
    if sign > 0:
        return 1, (_find_sign(_ASSUMED, {"sign": "drawn_positive"}, net, "drawn_positive"),), "drawn_positive (mean)"
    if any(source.sign == "auto" and source.type not in (BATTERY_STATE, *FLOAT_TYPES) for source in sources):
        return 0, (_find_sign(REJECTED, {"reason": "sign-unknown"}, net, *_SIGNS),), ""
    return -1, (_find_sign(_ASSUMED, {"sign": "drawn_negative"}, net, *_SIGNS),), "drawn_negative (ROS)"


def _find_sign(code: str, names: Mapping[str, str], net: float, *signs: str) -> Finding:
    """Return a finding on the sign of a drawn current: a note if nearly all charge flows one way (suggested sign)."""
    severity: Severity | None = "note" if len(signs) == 1 else None
    remedies = [remedy for sign in signs for remedy in suggest(sign, {"read": {"current_sign": sign}})]
    return make_finding(code, _POWER, severity=severity, names=names, remedies=remedies, net_fraction=abs(net))


def _weight_s(time_s: Floats) -> Floats:
    """Return the time of each row [s]; next to a gap at most the usual period, so that no row dominates a run."""
    if time_s.size < 2:
        return np.ones_like(time_s)
    between = np.gradient(time_s)
    return np.clip(between, 0.0, 3.0 * float(np.median(between)))


def _sum_currents(rails: Rails, log_times: Mapping[str, Floats]) -> tuple[Floats, Floats]:
    """Return the sum of all rails' currents [A] at the log times of the first topic with a current, and these [s]."""
    parts = [
        (log_times[topic][known] / 1e9, rail.current_amp[known])
        for topic, rail in _list_rails(rails)
        if (known := np.isfinite(rail.current_amp)).any()
    ]
    time_s = parts[0][0]
    return time_s, np.sum([np.interp(time_s, at, current) for at, current in parts], axis=0)
