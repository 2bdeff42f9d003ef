"""Facts and findings of labelling: the run's energy by entry, the noise floor, the count of every quality bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.cost.labels import estimate_energy_budget, find_noise, find_wanted_rate
from tcpipe.motion.distance_breakdown import find_interval_reason, sum_by_reason
from tcpipe.motion.row_sections import number_pieces
from tcpipe.power.noise import compute_median_period_s, estimate_resolution
from tcpipe.power.rails import Rail, Rule, Samples, integrate_recorded_energy
from tcpipe.tables.arrays import to_numbers
from tcpipe.tables.bits import Quality, flag_name
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.facts import EnergyBudget, LabelFacts, PhysicsFacts, RailFacts, SignalFacts
from tcpipe.tables.findings import Finding, Subject, make_finding, read_threshold

_POWER, _WHEELS = Subject("role", "power"), Subject("role", "wheel_odometry")


def make_label_facts(
    table: pa.Table,
    rails: Mapping[int, list[Rail]],
    energy_by_entry_joule: Mapping[str, float],
    distance_by_reason_m: Mapping[str, float],
    energy_variance_j2: Sequence[Mapping[str, NDArray[np.float64]]],
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
        rails={str(epoch): tuple(describe_rail(each) for each in rails[epoch]) for epoch in rails if rails[epoch]},
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


def _make_budget(
    energy_joule: NDArray[np.float64], variance_j2: Sequence[Mapping[str, NDArray[np.float64]]]
) -> EnergyBudget | None:
    if not variance_j2:
        return None
    return estimate_energy_budget(
        energy_joule, {name: np.concatenate([part[name] for part in variance_j2]) for name in variance_j2[0]}
    )


def find_label_findings(facts: LabelFacts) -> tuple[Finding, ...]:
    """Return what was observed while labelling."""
    findings = []
    if facts.quality["low_power_rate"] and facts.segments_without_power < facts.segments:
        findings.append(_find_low_rate(facts))
    if facts.energy_joule is not None and facts.segments and facts.segments_without_power:
        lost, total = facts.segments_without_power, facts.segments
        findings.append(make_finding("segments-without-power", _POWER, unlabelled_count=lost, segment_count=total))
    slips = facts.quality["high_slip"]
    if slips > read_threshold("wheels-slip", "min_segment_fraction") * facts.segments:
        findings.append(make_finding("wheels-slip", _WHEELS, segment_fraction=slips / facts.segments))
    idle, driving = facts.physics.idle_watt, facts.median_power_watt
    least, few = (read_threshold("idle-power-high", name) for name in ("min_idle_fraction", "min_idle_watt"))
    if idle is not None and driving is not None and idle > max(least * driving, few):
        findings.append(make_finding("idle-power-high", _POWER, idle_watt=idle, driving_watt=driving))
    return (*findings, *find_noise(facts.energy_budget, _POWER))


def _find_low_rate(facts: LabelFacts) -> Finding:
    """Return the finding that the current, or else the voltage, is measured too slowly."""
    rails = [rail for each in facts.rails.values() for rail in each]
    current_hz, voltage_hz = (
        min((each.rate_hz for each in signals if each.rate_hz), default=0.0)
        for signals in ([rail.current for rail in rails], [rail.voltage for rail in rails])
    )
    wanted_hz = find_wanted_rate(averaged=facts.integration == "averaged")
    quantity, rate_hz = ("current", current_hz) if current_hz < wanted_hz else ("voltage", voltage_hz)
    return make_finding("power-too-slow", _POWER, names={"quantity": quantity}, rate_hz=rate_hz, wanted_hz=wanted_hz)


def _compute_share(part: NDArray[np.float64], whole: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a part of each value; NaN where the value is zero (no current, no energy)."""
    return np.divide(part, whole, out=np.full_like(part, np.nan), where=whole != 0.0)


def _compute_median(values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(np.abs(known))) if len(known) else None


def describe_rail(each: Rail) -> RailFacts:
    """Return counts, rates and resolutions of a rail's samples."""
    return RailFacts(each.name, *(_describe_signal(signal) for signal in (each.voltage, each.current)))


def _describe_signal(signal: Samples) -> SignalFacts:
    period_s = compute_median_period_s(signal)
    return SignalFacts(
        len(signal.value), 1.0 / period_s if np.isfinite(period_s) else None, estimate_resolution(signal)
    )


def sum_energy_entries(rows: pa.Table, rails: list[Rail], *, rate_hz: float, rule: Rule) -> dict[str, float]:
    """Return the energy of one epoch's rows by entry of the breakdown [J]; their sum is all that was recorded.

    Entries are every `DropReason` by name, ``steady`` (kept, curved and leftover), and ``outside_track`` (recorded before the track begins
    or after it ends). ``rate_hz`` is the track's.
    """
    stamp_ns = to_integers(rows, "stamp_ns")
    piece = number_pieces(stamp_ns, to_integers(rows, "clock_epoch"), period_ns=1e9 / rate_hz)
    reason = find_interval_reason(to_numbers(rows["dropped_by"]), piece)
    spent = integrate_recorded_energy(rails, stamp_ns[:-1], stamp_ns[1:], rule=rule)
    record = _integrate_whole_record(rails, rule)
    steady = float(spent[reason == 0].sum())
    return sum_by_reason(reason, spent) | {"steady": steady, "outside_track": record - float(spent.sum())}


def _integrate_whole_record(rails: list[Rail], rule: Rule) -> float:
    stamps: list[NDArray[np.int64]] = [each.stamp_ns[[0, -1]] for each in rails if len(each.stamp_ns)]
    if not stamps:
        return 0.0
    ends = np.sort(np.concatenate(stamps))
    return float(integrate_recorded_energy(rails, ends[:1], ends[-1:], rule=rule)[0])
