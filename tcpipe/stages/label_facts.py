"""What labelling noticed: the run's energy by entry, the noise floor, the count of every quality bit, and warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.cost.budget import energy_budget
from tcpipe.cost.quality import wanted_rate_hz
from tcpipe.power.energy import Rule
from tcpipe.power.rails import Rail
from tcpipe.stages.power_rails import rail_facts
from tcpipe.tables.arrays import numbers
from tcpipe.tables.bits import Quality, name_of
from tcpipe.tables.columns import floats
from tcpipe.tables.facts import EnergyBudget, LabelFacts, PhysicsFacts

_MUCH_SLIP = 0.05  # of the segments
_MUCH_STANDING = 0.5
_FEW_WATT = 20.0


def label_facts(
    table: pa.Table,
    rails: Mapping[int, list[Rail]],
    energy_by_entry_joule: Mapping[str, float],
    ledger_m: Mapping[str, float],
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
    energy_by_entry_joule : [J], what was recorded, by ledger entry.
    ledger_m : [m], by entry; its sum is the distance.
    energy_variance_j2 : [J²], of the segments' energies by cause, epoch by epoch in the table's order.
    velocity : which velocity trains, ground or fused.
    """
    powered = any(len(each.stamp_ns) for epoch in rails.values() for each in epoch)
    quality = numbers(table["quality"])
    energy = floats(table, "energy_joule")
    return LabelFacts(
        distance_m=sum(ledger_m.values()),
        energy_joule=sum(energy_by_entry_joule.values()) if powered else None,
        energy_by_entry_joule=dict(energy_by_entry_joule) if powered else None,
        integration=rule,
        velocity=velocity,
        rails={str(epoch): tuple(rail_facts(each) for each in rails[epoch]) for epoch in rails if rails[epoch]},
        segments=table.num_rows,
        segments_without_power=int(np.isnan(energy).sum()),
        median_power_watt=_median(floats(table, "power_watt")),
        relative_std_median={
            name: _median(_share(floats(table, f"{name}_std_{unit}"), floats(table, f"{name}_{unit}")))
            for name, unit in (("duration", "s"), ("velocity", "mps"), ("power", "watt"), ("energy", "joule"))
        },
        energy_budget=_budget(energy, energy_variance_j2),
        quality={name_of(bit): int(((quality & np.uint32(bit)) != 0).sum()) for bit in Quality},
        physics=physics,
    )


def _budget(
    energy_joule: NDArray[np.float64], variance_j2: Sequence[Mapping[str, NDArray[np.float64]]]
) -> EnergyBudget | None:
    if not variance_j2:
        return None
    return energy_budget(
        energy_joule, {name: np.concatenate([part[name] for part in variance_j2]) for name in variance_j2[0]}
    )


def label_warnings(facts: LabelFacts) -> tuple[str, ...]:
    """Return what a person should look at."""
    warnings = []
    if facts.quality["low_power_rate"] and facts.segments_without_power < facts.segments:
        rails = [rail for each in facts.rails.values() for rail in each]
        current, voltage = (
            min((each.rate_hz for each in signals if each.rate_hz), default=0.0)
            for signals in ([rail.current for rail in rails], [rail.voltage for rail in rails])
        )
        wanted_hz = wanted_rate_hz(averaged=facts.integration == "averaged")
        what, rate = ("current", current) if current < wanted_hz else ("voltage", voltage)
        warnings.append(
            f"power: the {what} is measured at {rate:.1f} Hz only, {wanted_hz:g} Hz are wanted: energy_std_joule holds what that costs"
        )
    if facts.energy_joule is not None and facts.segments and facts.segments_without_power:
        count = f"{facts.segments_without_power} of {facts.segments} segments"
        warnings.append(f"{count} have no label: the power record does not reach over them")
    slips = facts.quality["high_slip"]
    if slips > _MUCH_SLIP * facts.segments:
        warnings.append(
            f"wheel_odometry: on {slips} of {facts.segments} segments wheels and ground differ by more than 20 % of speed (high_slip): "
            "they slip there, or what tells the speed over ground is wrong"
        )
    standing, driving = facts.physics.standing_watt, facts.median_power_watt
    if standing is not None and driving is not None and standing > max(_MUCH_STANDING * driving, _FEW_WATT):
        warnings.append(
            f"power: {standing:.0f} W are drawn while standing, of {driving:.0f} W while driving: an offset of the current, or more "
            "than propulsion; labels hold all of it"
        )
    return tuple(warnings)


def _share(part: NDArray[np.float64], whole: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a part of each value; NaN where the value is zero (no current, no energy)."""
    return np.divide(part, whole, out=np.full_like(part, np.nan), where=whole != 0.0)


def _median(values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(np.abs(known))) if len(known) else None
