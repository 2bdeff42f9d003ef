"""Errors common to all segments of a run (gain and zero of power, scale of a single odometry), and their findings."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints
from tcpipe.cost.labels import SensorError
from tcpipe.fusion.measurements import FIXES, VISUAL, WHEELS
from tcpipe.motion.row_sections import find_runs
from tcpipe.power.audit import (
    Sag,
    estimate_offset_std,
    estimate_resistance_ohm,
    find_gain_change,
    find_lost_signs,
    measure_rest_currents,
    measure_sag,
    summarize_rest,
)
from tcpipe.power.rails import IdlePower, Rail, Rule, integrate_energy, is_power_only, sum_power
from tcpipe.power.sampling import (
    DELAY_MARGIN_S,
    SMOOTHING_MARGIN_S,
    PowerFit,
    find_delay,
    find_smoothing,
    make_power_fit,
)
from tcpipe.power.witnesses import estimate_missing_std_fraction
from tcpipe.recipe import LabelConfig
from tcpipe.recipe.suggestions import Keys, suggest
from tcpipe.robots import GAIN_STD_FRACTION, OFFSET_STD_AMP
from tcpipe.stages.label_motion import number_row_pieces
from tcpipe.tables.bits import DropReason
from tcpipe.tables.columns import read_rise, read_spans_ns, select_rows, to_floats, to_integers, to_numbers
from tcpipe.tables.facts import LabelFacts, PhysicsFacts, PowerSensorFacts, PowerSign, StageFacts
from tcpipe.tables.findings import Finding, Subject, make_finding, read_threshold
from tcpipe.tables.levels import Streams, TrackInfo


def find_stationary_ns(rows: pa.Table, rate_hz: float, *, but: int = 0) -> Ints:
    """Return begin and end [ns] of the spans that are stationary and have none of the reasons ``but``, shape (S, 2)."""
    stamp_ns = to_integers(rows, "stamp_ns")
    piece = number_row_pieces(rows, rate_hz)
    reasons = to_numbers(rows["dropped_by"])
    standing = ((reasons & np.uint32(DropReason.STATIONARY)) != 0) & ((reasons & np.uint32(but)) == 0)
    return stamp_ns[find_runs(standing, piece)]


def audit_power_sensor(
    rows: pa.Table, rails_by_epoch: Mapping[int, list[Rail]], info: TrackInfo, config: LabelConfig
) -> PowerSensorFacts:
    """Return the power sensor's uncertainty: by the recipe, else by the kind of source and by evidence in the run.

    ``rows`` are those of the masked track.
    """
    power = info.report.facts.power
    sags = [measure_sag(rails) for rails in rails_by_epoch.values()]
    resistances_ohm = [ohm for sag in sags if (ohm := estimate_resistance_ohm(sag)) is not None]
    battery_ohm = float(np.median(resistances_ohm)) if resistances_ohm else None
    corrected_s = info.report.facts.time_offset_s.get("power", 0.0)
    found = [
        find_smoothing(fit, corrected_s=corrected_s) for fit in _fit_power(rows, rails_by_epoch, SMOOTHING_MARGIN_S)
    ]
    smoothing = max(filter(None, found), key=lambda of_epoch: of_epoch.width_s, default=None)
    delays = [] if smoothing else [find_delay(fit) for fit in _fit_power(rows, rails_by_epoch, DELAY_MARGIN_S)]
    delay_s = min(filter(None, delays), key=lambda delay_and_std: delay_and_std[1], default=None)
    gain_std, offset_std_amp = _find_prior(power)
    gain_std = float(np.hypot(gain_std, estimate_missing_std_fraction(power.side_share if power else None)))
    facts = PowerSensorFacts(gain_std, offset_std_amp, battery_ohm=battery_ohm, smoothing=smoothing, delay_s=delay_s)
    if config.power_gain_std_fraction is not None:
        facts = replace(facts, gain_std_fraction=config.power_gain_std_fraction)
    else:
        facts = _add_gain_change(facts, sags)
    if config.power_offset_std_amp is not None:
        return replace(facts, offset_std_amp=config.power_offset_std_amp)
    range_amp = None if power is None else power.rest_current_amp
    rest_amp: dict[str, list[Floats]] = {}
    unsettled_s = np.array(facts.unsettled_s) * (1.0, -1.0)
    for epoch, rails in rails_by_epoch.items():
        still_ns = find_stationary_ns(select_rows(rows, "clock_epoch", epoch), info.rate_hz, but=DropReason.STUCK)
        still_ns = still_ns + np.rint(1e9 * unsettled_s).astype(np.int64)
        for rail in (rail for rail in rails if not is_power_only(rail.voltage.value)):
            rest_amp.setdefault(rail.name, []).append(measure_rest_currents(rail, still_ns))
    joined = [current_amp for parts in rest_amp.values() if (current_amp := np.concatenate(parts)).size]
    if not joined:
        return facts
    std_amp = max(estimate_offset_std(current_amp, range_amp, facts.offset_std_amp) for current_amp in joined)
    low, high = zip(*map(summarize_rest, joined), strict=True)
    return replace(facts, offset_std_amp=std_amp, rest_amp=(min(low), max(high)) if range_amp else None)


def _find_prior(power: PowerSign | None) -> tuple[float, float]:
    """Return the standard deviations of gain and zero [A] that the kind of source states."""
    gain, offset = (power.gain_std_fraction, power.offset_std_amp) if power else (None, None)
    return GAIN_STD_FRACTION if gain is None else gain, OFFSET_STD_AMP if offset is None else offset


def _add_gain_change(facts: PowerSensorFacts, sags: Sequence[Sag | None]) -> PowerSensorFacts:
    """Return the facts with a changed gain: of both parts of the run either may be right."""
    changes = [found for sag in sags if (found := find_gain_change(sag))]
    if not changes:
        return facts
    change = max(changes, key=lambda candidate: abs(candidate.ratio - 1.0))
    std = float(np.hypot(facts.gain_std_fraction, (change.ratio - 1.0) / 2.0**0.5))
    return replace(facts, gain_std_fraction=std, gain_ratio=change.ratio, gain_changed_ns=change.at_ns)


def _fit_power(rows: pa.Table, rails_by_epoch: Mapping[int, list[Rail]], margin_s: float) -> list[PowerFit]:
    """Return the power of each clock epoch beside the motion of the track, where both are known for long enough."""
    fits = []
    for epoch, rails in rails_by_epoch.items():
        epoch_rows = select_rows(rows, "clock_epoch", epoch)
        motion = np.column_stack(
            [to_floats(epoch_rows, name) for name in ("forward_velocity_mps", "yaw_rate_radps", "pitch_rad")]
        )
        motion[:, 2] = -motion[:, 0] * np.sin(motion[:, 2])  # pitch is positive nose down
        known = np.isfinite(motion).all(axis=1)
        if (power := sum_power(rails)) is not None:
            stamp_ns, averaged = to_integers(epoch_rows, "stamp_ns")[known], any(rail.averaged for rail in rails)
            fits.append(make_power_fit(power, stamp_ns, motion[known], averaged=averaged, margin_s=margin_s))
    return [fit for fit in fits if fit is not None]


_POWER = Subject("role", "power")


def find_sensor_findings(label: LabelFacts, info: TrackInfo, start_ns: int) -> Iterator[Finding]:
    """Yield the findings of the audit of the power sensor; ``start_ns`` is the start of the track."""
    facts, power = label.power_sensor, info.report.facts.power
    if facts is None:
        return
    given_s = info.report.facts.time_offset_s.get("power", 0.0)
    if facts.rest_amp and power and power.rest_current_amp and facts.offset_std_amp > _find_prior(power)[1]:
        yield make_finding(
            "current-offset",
            _POWER,
            lowest_amp=facts.rest_amp[0],
            highest_amp=facts.rest_amp[1],
            least_amp=power.rest_current_amp[0],
            most_amp=power.rest_current_amp[1],
            offset_std_amp=facts.offset_std_amp,
        )
    if facts.gain_ratio is not None and facts.gain_changed_ns is not None:
        at_s = (facts.gain_changed_ns - start_ns) * 1e-9
        yield make_finding(
            "current-gain-changes",
            _POWER,
            span_s=(at_s, at_s),
            gain_ratio=facts.gain_ratio,
            at_s=at_s,
            gain_std_fraction=facts.gain_std_fraction,
        )
    if (smoothing := facts.smoothing) is not None:
        yield make_finding(
            "power-smoothed", _POWER,
            remedies=suggest("correct", {"read.time_offset_s": {"power": given_s - smoothing.late_s}})
            if smoothing.late_s else (),
            width_s=smoothing.width_s, late_s=smoothing.late_s,
        )  # fmt: skip
    delay_s, delay_std_s = facts.delay_s or (0.0, 0.0)
    error_fraction = (label.energy_budget and label.energy_budget.delay) or 0.0
    least_ratio, least_error = (
        read_threshold("power-delayed", f"min_{name}") for name in ("std_ratio", "error_fraction")
    )
    if error_fraction > least_error and abs(delay_s) > least_ratio * delay_std_s:
        yield make_finding(
            "power-delayed", _POWER,
            remedies=suggest("correct", {"read.time_offset_s": {"power": round(given_s - delay_s, 2)}}),
            delay_s=delay_s, delay_2std_s=2.0 * delay_std_s, error_fraction=error_fraction,
        )  # fmt: skip
    if facts.lost_signs:
        yield make_finding("current-sign-lost", _POWER, segment_fraction=facts.lost_signs / label.segments)


_NEGATIVE = "idle-power-negative"


def find_negative_idle(
    idle: IdlePower, driving_watt: float | None, power: PowerSign | None, rails: Sequence[Rail]
) -> Iterator[Finding]:
    """Yield a finding, with remedy, if power is clearly negative in every stop and the battery is not being charged."""
    if power is None or power.charging or driving_watt is None:
        return
    least_watt = read_threshold(_NEGATIVE, "min_driving_fraction") * driving_watt
    if not (idle.highest_watt < 0.0 and idle.watt < -least_watt):
        return
    volt = float(sum(np.median(rail.voltage.value) for rail in rails))
    low_amp, high_amp = power.rest_current_amp or (0.0, 0.0)
    unknown_amp = (high_amp - low_amp) / 2.0
    if power.rest_current_amp is None:
        unknown_amp = read_threshold(_NEGATIVE, "idle_std_fraction") * (driving_watt - idle.watt) / volt
    offset_amp = power.zero_amp + idle.watt / volt - (low_amp + high_amp) / 2.0
    std_amp = float(np.hypot(_find_prior(power)[1], unknown_amp))
    offset, std = {"current_offset_amp": round(offset_amp, 3)}, {"power_offset_std_amp": round(std_amp, 2)}
    remedies = suggest("correct", {"read": offset, "label": std})
    yield make_finding(_NEGATIVE, _POWER, remedies=remedies, idle_watt=idle.watt, driving_watt=driving_watt)


_FEWEST_UNPOWERED = 5  # segments in a row: fewer may be chance
_IDLE_FRACTION = 0.1  # share of the median net power
_MISSING_RESIDUALS = 3.0


def find_unpowered_motion(
    table: pa.Table, needed_watt: Floats, physics: PhysicsFacts, info: TrackInfo, start_ns: int
) -> Iterator[tuple[slice, Finding]]:
    """Yield the rows and the finding of each span in which the robot moves with its idle power.

    The power [W] that speed and slope of these segments need, ``needed_watt``, shape (M,), clearly exceeds the idle
    power.
    """
    watt = to_floats(table, "power_watt")
    idle_watt, fit = physics.idle_watt, physics.fit
    if idle_watt is None or fit is None:
        return
    is_idle = np.abs(watt - idle_watt) < _IDLE_FRACTION * (np.nanmedian(watt) - idle_watt)
    is_idle &= np.isfinite(needed_watt)
    for first, last in find_runs(is_idle, to_integers(table, "clock_epoch")).tolist():
        missing_watt = float(np.mean((needed_watt - watt)[first : last + 1]))
        if last + 1 - first < _FEWEST_UNPOWERED or missing_watt < _MISSING_RESIDUALS * fit.residual_watt:
            continue
        begin_s, end_s = (
            (table[name][row].as_py() - start_ns) * 1e-9 for name, row in (("start_ns", first), ("end_ns", last))
        )
        window: Keys = {"run": info.run_id, "start": float(np.floor(begin_s)), "end": float(np.ceil(end_s))}
        finding = make_finding(
            "motion-without-power",
            _POWER,
            remedies=suggest("drop", {"mask.windows": [window]}),
            span_s=(begin_s, end_s),
            segments_count=last + 1 - first,
            missing_watt=missing_watt,
        )
        yield slice(first, last + 1), finding


def make_sensor_error(cut: pa.Table, rails: list[Rail], facts: PowerSensorFacts, *, rule: Rule) -> SensorError:
    """Return one epoch's segment errors by the power sensor: zeros of rails are independent, gains are common."""
    spans = read_spans_ns(cut)
    offsets = [
        integrate_energy(
            [replace(rail, current_amp=np.full_like(rail.current_amp, facts.offset_std_amp))], *spans, rule=rule
        )
        for rail in rails
    ]
    rise = read_rise(cut)
    lost = find_lost_signs(measure_sag(rails), *spans, rise)
    # Returned energy counts as drawn: the error is twice this energy.
    sign_joule = np.where(lost, np.abs(integrate_energy(rails, *spans, rule=rule)), 0.0)
    offset_joule = np.linalg.norm(offsets, axis=0) if offsets else np.nan
    return SensorError(facts.gain_std_fraction, offset_joule, sign_joule)


_MOTION = (*FIXES, WHEELS, VISUAL)  # roles of the independent sensors of motion


def count_confirming_sensors(cut: pa.Table, streams: Streams, facts: StageFacts) -> NDArray[np.int32]:
    """Return how many sensors measured motion in each segment of one epoch and were fused, shape (M,)."""
    start_ns, end_ns = read_spans_ns(cut)
    epoch = int(to_integers(cut, "clock_epoch")[0])
    count = np.zeros(cut.num_rows, dtype=np.int32)
    for sensor in (role for role in _MOTION if role in streams.tables):
        stamp_ns = np.sort(to_integers(select_rows(streams.tables[sensor], "clock_epoch", epoch), "stamp_ns"))
        confirms = np.searchsorted(stamp_ns, end_ns, side="right") > np.searchsorted(stamp_ns, start_ns, side="left")
        fused = [
            (section.start_ns, section.end_ns)
            for section in (facts.fuse.sections if facts.fuse else ())
            if section.clock_epoch == epoch and sensor in section.sensors
        ]
        touched = np.zeros(len(start_ns), dtype=bool)
        for first_ns, last_ns in fused:
            touched |= (start_ns <= last_ns) & (end_ns >= first_ns)
        count += confirms & touched
    return count
