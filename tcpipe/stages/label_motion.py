"""Motion over every segment of one clock epoch (turn, attitude, slip, vibration), and the segments' quality bits.

Facts and findings of labelling: the run's energy by entry, the noise floor, the count of every quality bit.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Floats, Ints, Mask, accumulate
from tcpipe.cost.labels import (
    Labels,
    estimate_energy_budget,
    find_noise,
    find_wanted_rate,
    has_low_power_rate,
    spans_near,
    touches_voltage_outside,
)
from tcpipe.fusion.densities import PRIORS
from tcpipe.fusion.measurements import IMU
from tcpipe.fusion.preparation import GRAVITY_BAND_MPS2
from tcpipe.fusion.signals import compute_median_period_ns, estimate_white_noise
from tcpipe.geometry.piecewise_linear import interpolate, mean_between
from tcpipe.motion.distance_breakdown import find_interval_reason, sum_by_reason
from tcpipe.motion.row_sections import number_pieces
from tcpipe.motion.vibration import compute_vibration_mps2
from tcpipe.power.noise import compute_median_period_s
from tcpipe.power.rails import Rail, Rule, integrate_recorded_energy
from tcpipe.tables.bits import DropReason, Quality, flag_name
from tcpipe.tables.columns import read_spans_ns, select_rows, stack_floats, to_floats, to_integers, to_numbers
from tcpipe.tables.facts import EnergyBudget, LabelFacts, PhysicsFacts
from tcpipe.tables.findings import Finding, Findings, Subject, make_finding, read_threshold
from tcpipe.tables.levels import Streams, TrackInfo

Arrays = dict[str, Floats]

_ROLLING_MPS = 0.05  # wheels slower than this are stationary: their slip is unknown
_SLIPPING = 0.2  # share of the wheels' speed, a mean along the slope, by which that of the robot may differ


def make_motion_columns(cut: pa.Table, rows: pa.Table, streams: Streams, info: TrackInfo, cost: Labels) -> Arrays:
    """Return the columns `tcpipe.tables.levels.MOTION_COLUMNS` of one epoch's segments ``cut``, shape (M,) each.

    ``rows``: the epoch's rows of the masked track; ``streams``: with the IMU's samples; ``cost``: uncertainty of the
    segments' velocity.
    """
    epoch = int(to_integers(cut, "clock_epoch")[0])
    imu = select_rows(streams.tables["imu"], "clock_epoch", epoch) if "imu" in streams.tables else None
    spans = read_spans_ns(cut)
    stamp_ns, middle_ns = to_integers(rows, "stamp_ns"), spans[0] + (spans[1] - spans[0]) // 2
    return {
        **_compute_turns(cut, rows, imu, info),
        **{name: interpolate(stamp_ns, to_floats(rows, name), middle_ns) for name in ("roll_rad", "pitch_rad")},
        **_compute_slip(cut, rows, cost),
        **_compute_vibration(imu, *spans),
    }


def _compute_turns(cut: pa.Table, rows: pa.Table, imu: pa.Table | None, info: TrackInfo) -> Arrays:
    stamp_ns, (start_ns, end_ns) = to_integers(rows, "stamp_ns"), read_spans_ns(cut)
    yaw_rad = np.unwrap(to_floats(rows, "yaw_rad"))
    yaw_change_rad = interpolate(stamp_ns, yaw_rad, end_ns) - interpolate(stamp_ns, yaw_rad, start_ns)
    duration_s, arc_m = (end_ns - start_ns) * 1e-9, to_floats(cut, "arc_length_m")
    std_rad = np.sqrt(_turn_density(cut, imu, info) * duration_s)
    return {
        "yaw_change_rad": yaw_change_rad,
        "yaw_change_std_rad": std_rad,
        "mean_abs_yaw_rate_radps": mean_between(stamp_ns, np.abs(to_floats(rows, "yaw_rate_radps")), start_ns, end_ns),
        "mean_abs_yaw_rate_std_radps": std_rad / duration_s,
        "curvature_radpm": yaw_change_rad / arc_m,
        "curvature_std_radpm": std_rad / arc_m,
    }


def _turn_density(cut: pa.Table, imu: pa.Table | None, info: TrackInfo) -> Floats:
    """Return the growth rate of a yaw change's variance [rad²/s], shape (M,): over 1 m only the gyroscope counts.

    NaN without a gyroscope, and for a forward filter, whose yaw changes with every measurement.
    """
    start_ns, density = to_integers(cut, "start_ns"), np.full(cut.num_rows, np.nan)
    facts = info.report.facts.fuse
    if imu is None or imu.num_rows < 2 or facts is None or info.estimator != "smoother":
        return density
    rate_hz = 1e9 / compute_median_period_ns(np.unique(to_integers(imu, "stamp_ns")))
    epoch = int(to_integers(cut, "clock_epoch")[0])
    for each in facts.sections:
        if each.clock_epoch == epoch and IMU in each.sensors and each.gyro_noise_radps is not None:
            is_inside = (start_ns >= each.start_ns) & (start_ns <= each.end_ns)
            density[is_inside] = 1.5 * each.gyro_noise_radps**2 / rate_hz + PRIORS["imu turn"].variance
    return density


def _compute_slip(cut: pa.Table, rows: pa.Table, cost: Labels) -> Arrays:
    """Return the slip and its standard deviation, by the distance over ground and the wheels' white noise."""
    stamp_ns, wheel_mps = to_integers(rows, "stamp_ns"), to_floats(rows, "wheel_velocity_mps")
    mean_mps = mean_between(stamp_ns, wheel_mps, *read_spans_ns(cut))
    rolling_mps = np.where(np.abs(mean_mps) > _ROLLING_MPS, mean_mps, np.nan)
    ratio = to_floats(cut, "fused_velocity_mps") / rolling_mps
    noise_mps = estimate_white_noise(wheel_mps[np.isfinite(wheel_mps), None])
    period_s = compute_median_period_ns(stamp_ns) * 1e-9
    wheel_std_mps = noise_mps * np.sqrt(period_s / cost.duration_s)
    relative = np.hypot(cost.velocity_std_mps / cost.velocity_mps, wheel_std_mps / rolling_mps)
    return {"slip_fraction": 1.0 - ratio, "slip_std_fraction": np.abs(ratio) * relative}


def _compute_vibration(imu: pa.Table | None, start_ns: Ints, end_ns: Ints) -> Arrays:
    """Return the vibration and its standard deviation; NaN without an IMU that measures specific force with gravity."""
    found = np.full(len(start_ns), np.nan), np.full(len(start_ns), np.nan)
    if imu is not None:
        force = stack_floats(imu, *(f"linear_acceleration_{axis}_mps2" for axis in "xyz"))
        is_known = np.isfinite(force).all(axis=1)
        low, high = GRAVITY_BAND_MPS2  # outside (other unit, gravity removed) the vibration is unknown
        if is_known.any() and low <= float(np.median(np.linalg.norm(force[is_known], axis=1))) <= high:
            found = compute_vibration_mps2(to_integers(imu, "stamp_ns")[is_known], force[is_known], start_ns, end_ns)
    return dict(zip(("vibration_mps2", "vibration_std_mps2"), found, strict=True))


Flags = dict[Quality, Mask]


def find_power_flags(cut: pa.Table, rails: list[Rail], *, range_volt: tuple[float, float] | None) -> Flags:
    """Return the flags of one epoch's segments by its power samples; without a range [V] no voltage is outside it."""
    spans = read_spans_ns(cut)
    return {
        Quality.LOW_POWER_RATE: np.full(cut.num_rows, has_low_power_rate(rails)),
        Quality.VOLTAGE_OUT_OF_RANGE: touches_voltage_outside(rails, *spans, range_volt=range_volt),
    }


def find_motion_flags(
    cut: pa.Table, rows: pa.Table, info: TrackInfo, *, arc_to_chord: float, max_position_std_m: float
) -> Flags:
    """Return the flags that the masked rows of one epoch give its segments.

    A segment is flagged if it is more curved than ``arc_to_chord`` or an end is less certain than
    ``max_position_std_m`` [m].
    """
    stamp_ns, (start_ns, end_ns) = to_integers(rows, "stamp_ns"), read_spans_ns(cut)
    chord_m = to_floats(cut, "chord_m")
    wheel_mps = mean_between(stamp_ns, to_floats(rows, "wheel_velocity_mps"), start_ns, end_ns)
    driven_m = accumulate(np.hypot(*(np.diff(to_floats(rows, f"{axis}_m")) for axis in "xy")))
    start_m, end_m = (interpolate(stamp_ns, driven_m, at_ns) for at_ns in (start_ns, end_ns))
    mask, commanded_mps = info.report.facts.mask, to_floats(cut, "commanded_velocity_mps")
    full_speed_mps = mask.full_speed_mps if mask else None
    return {
        Quality.NEAR_GAP: spans_near(
            driven_m[_find_gap_edges(rows, info.rate_hz)], start_m, end_m, within_m=float(chord_m[0])
        ),
        Quality.HIGH_SLIP: np.abs(wheel_mps - to_floats(cut, "fused_velocity_mps")) > _SLIPPING * np.abs(wheel_mps),
        Quality.WEAK_GNSS: to_floats(cut, "position_std_m") > max_position_std_m,
        Quality.CURVED: to_floats(cut, "arc_length_m") > arc_to_chord * chord_m,
        Quality.NO_COMMAND: np.isnan(commanded_mps),
        Quality.BELOW_FULL_SPEED: np.abs(commanded_mps) < (full_speed_mps or 0.0),
        Quality.SENSORS_DISAGREE: _find_disputed(cut, info),
    }


def _find_disputed(cut: pa.Table, info: TrackInfo) -> Mask:
    """Return the segments of one epoch that touch a time in which sensors disagree.

    Fixes were off the track, or the estimate of the whole section does not explain its sensors.
    """
    limits = (
        read_threshold("measurements-rejected", "max_rejected_fraction"),
        read_threshold("changes-unlikely", "max_change_count"),
    )
    (start_ns, end_ns), epoch = read_spans_ns(cut), to_integers(cut, "clock_epoch")
    facts = info.report.facts
    times: list[tuple[int, int, int]] = []
    for section in facts.fuse.sections if facts.fuse else ():
        times += [(section.clock_epoch, r.start_ns, r.end_ns) for r in section.gate_resets]
        if not section.is_explained(*limits):
            times.append((section.clock_epoch, section.start_ns, section.end_ns))
    disputed = np.zeros(cut.num_rows, dtype=bool)
    for of_epoch, first_ns, last_ns in times:
        disputed |= (epoch == of_epoch) & (start_ns <= last_ns) & (end_ns >= first_ns)
    return disputed


def number_row_pieces(rows: pa.Table, rate_hz: float) -> Ints:
    """Return for each row of a track the number of its uninterrupted piece, as `number_pieces`, shape (N,)."""
    return number_pieces(to_integers(rows, "stamp_ns"), to_integers(rows, "clock_epoch"), period_ns=1e9 / rate_hz)


def _find_gap_edges(rows: pa.Table, rate_hz: float) -> Mask:
    """Return the rows that are in a gap of a sensor, or next to a gap of the track."""
    piece = number_row_pieces(rows, rate_hz)
    hole = np.diff(piece) != 0
    edge: Mask = (to_numbers(rows["dropped_by"]) & np.uint32(DropReason.GAP)) != 0
    edge[:-1] |= hole
    edge[1:] |= hole
    return edge


def is_clock_doubtful(streams: Streams, info: TrackInfo) -> bool:
    """Return whether a clock of the run stepped or has an offset, or motion or power has the recorder's time.

    Commands mostly have no stamp of their own, and labels do not depend on it. A known offset is corrected; σ of w and
    E contains the delay of power.
    """
    recorder = any(s.time_source == "log" for role, s in streams.sensors.items() if role != "command")
    offsets = (offset for clocks in info.report.facts.clock_offsets for offset in clocks.offsets.values())
    has_offset, checks = (
        any(offset.is_significant and not offset.is_wrong for offset in offsets),
        info.report.facts.sensor_checks,
    )
    has_far_clock = checks is not None and "clocks-differ" in checks.excluded.values()
    # A step of all clocks leaves them together.
    return recorder or has_offset or has_far_clock or any(step.topics for step in streams.report.facts.clock_steps)


_POWER, _WHEELS = Subject("role", "power"), Subject("role", "wheel_odometry")


def make_label_facts(
    table: pa.Table,
    rails: Mapping[int, list[Rail]],
    energy_by_entry_joule: Mapping[str, float],
    distance_by_reason_m: Mapping[str, float],
    energy_variance_j2: Sequence[Mapping[str, Floats]],
    *,
    rule: Rule,
    velocity: str,
    physics: PhysicsFacts,
) -> LabelFacts:
    """Return the facts of a labelled run.

    Parameters
    ----------
    rails : drive rails by clock epoch.
    energy_by_entry_joule, distance_by_reason_m : [J] and [m], by entry of the distance breakdown.
    energy_variance_j2 : [J²], of the segments' energies by cause, epoch by epoch in the table's order.
    velocity : which velocity trains, ground or fused.
    """
    powered = any(len(each.stamp_ns) for epoch in rails.values() for each in epoch)
    quality = to_numbers(table["quality"])
    energy = to_floats(table, "energy_joule")
    return LabelFacts(
        distance_m=sum(distance_by_reason_m.values()),
        energy_joule=sum(energy_by_entry_joule.values()) if powered else None,
        energy_by_entry_joule=dict(energy_by_entry_joule) if powered else None,
        integration=rule,
        velocity=velocity,
        segments=table.num_rows,
        segments_without_power=int(np.isnan(energy).sum()),
        median_power_watt=_compute_median(to_floats(table, "power_watt")),
        relative_std_median={
            name: _compute_median(
                _compute_share(to_floats(table, f"{name}_std_{unit}"), to_floats(table, f"{name}_{unit}"))
            )
            for name, unit in (("duration", "s"), ("velocity", "mps"), ("power", "watt"), ("energy", "joule"))
        },
        energy_budget=_make_budget(energy, energy_variance_j2),
        quality={flag_name(bit): int(((quality & np.uint32(bit)) != 0).sum()) for bit in Quality},
        physics=physics,
    )


def _make_budget(energy_joule: Floats, variance_j2: Sequence[Mapping[str, Floats]]) -> EnergyBudget | None:
    if not variance_j2:
        return None
    return estimate_energy_budget(
        energy_joule, {name: np.concatenate([part[name] for part in variance_j2]) for name in variance_j2[0]}
    )


def find_label_findings(facts: LabelFacts, rails: Iterable[Rail]) -> Findings:
    """Return the findings of labelling, from all rails of a run."""
    findings = []
    if facts.quality["low_power_rate"] and facts.segments_without_power < facts.segments:
        findings.append(_find_low_rate(facts, rails))
    if facts.energy_joule is not None and facts.segments and facts.segments_without_power:
        lost, total = facts.segments_without_power, facts.segments
        findings.append(
            make_finding("segments-without-power", _POWER, unlabelled_count=lost, segment_count=total)
            if lost < total
            else make_finding("no-power", _POWER)
        )
    slips = facts.quality["high_slip"]
    if slips > read_threshold("wheels-slip", "min_segment_fraction") * facts.segments:
        findings.append(make_finding("wheels-slip", _WHEELS, segment_fraction=slips / facts.segments))
    idle, driving = facts.physics.idle_watt, facts.median_power_watt
    least, few = (read_threshold("idle-power-high", name) for name in ("min_idle_fraction", "min_idle_watt"))
    if idle is not None and driving is not None and idle > max(least * driving, few):
        findings.append(make_finding("idle-power-high", _POWER, idle_watt=idle, driving_watt=driving))
    return (*findings, *find_noise(facts.energy_budget, _POWER))


def _find_low_rate(facts: LabelFacts, rails: Iterable[Rail]) -> Finding:
    """Return the finding that the current, or else the voltage, is measured too slowly."""
    signals = zip(*((each.current, each.voltage) for each in rails), strict=True)
    periods_s = (filter(np.isfinite, map(compute_median_period_s, of_rails)) for of_rails in signals)
    current_hz, voltage_hz = (1.0 / max(of_rails, default=np.inf) for of_rails in periods_s)
    wanted_hz = find_wanted_rate(averaged=facts.integration == "averaged")
    quantity, rate_hz = ("current", current_hz) if current_hz < wanted_hz else ("voltage", voltage_hz)
    return make_finding("power-too-slow", _POWER, names={"quantity": quantity}, rate_hz=rate_hz, wanted_hz=wanted_hz)


def _compute_share(part: Floats, whole: Floats) -> Floats:
    """Return a part of each value; NaN where the value is zero (no current, no energy)."""
    return np.divide(part, whole, out=np.full_like(part, np.nan), where=whole != 0.0)


def _compute_median(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(np.abs(known))) if len(known) else None


def sum_energy_entries(rows: pa.Table, rails: list[Rail], *, rate_hz: float, rule: Rule) -> dict[str, float]:
    """Return the energy of one epoch's rows by entry of the breakdown [J]; their sum is all that was recorded.

    Entries are every `DropReason` by name, ``steady`` (kept, curved and leftover), and ``outside_track`` (before or
    after the track). ``rate_hz`` is the track's.
    """
    stamp_ns = to_integers(rows, "stamp_ns")
    piece = number_row_pieces(rows, rate_hz)
    reason = find_interval_reason(to_numbers(rows["dropped_by"]), piece)
    spent = integrate_recorded_energy(rails, stamp_ns[:-1], stamp_ns[1:], rule=rule)
    record = _integrate_whole_record(rails, rule)
    steady = float(spent[reason == 0].sum())
    return sum_by_reason(reason, spent) | {"steady": steady, "outside_track": record - float(spent.sum())}


def _integrate_whole_record(rails: list[Rail], rule: Rule) -> float:
    stamps: list[Ints] = [each.stamp_ns[[0, -1]] for each in rails if len(each.stamp_ns)]
    if not stamps:
        return 0.0
    ends = np.sort(np.concatenate(stamps))
    return float(integrate_recorded_energy(rails, ends[:1], ends[-1:], rule=rule)[0])
