"""What the sensors' clocks look like: offsets between them and their drift, for the manifest, and the recipe line that corrects each."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import pyarrow as pa

from tcpipe.fusion.checks.clock_offsets import ClockOffsets, Pair, PowerSignal, RoleOffset, find_clock_offsets
from tcpipe.fusion.measurements import GNSS
from tcpipe.power.rails import power_at
from tcpipe.recipe.suggestions import RecipeFragment, suggested
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_sanity import longest_epoch
from tcpipe.stages.power_rails import rails_of
from tcpipe.stages.read_pose import recipe_role
from tcpipe.tables.columns import floats
from tcpipe.tables.facts import ClockFacts, ClockOffset, ClockPair
from tcpipe.tables.findings import StageReport
from tcpipe.tables.levels import Streams

_MAX_GAP_NS = 300_000_000
_FINE_S = 0.004
_TURNED_OVER_M = 1.0


def clock_findings(streams: Streams, inputs: FusionInputs) -> StageReport[ClockFacts]:
    """Return the offsets between the sensors' clocks in the longest clock epoch; nothing is corrected.

    The recipe lines that would correct an offset include what the recipe adds already.
    """
    epoch = longest_epoch(inputs)
    found = find_clock_offsets(inputs.measurements[epoch], _power(streams, epoch))
    given_s = streams.report.facts.time_offset_s
    offsets, warnings = {}, []
    for role, offset in found.offsets.items():
        name = recipe_role(role, streams)
        by_log = streams.sensors[role].time_source == "log"
        remedy_s = round(given_s.get(name, 0.0) - offset.offset_s, 3 if offset.std_s < _FINE_S else 2)
        tables = {"read.time": {name: "log"}} if offset.drifts else {"read.time_offset_s": {name: remedy_s}}
        useless = _is_open(offset) or (offset.drifts and by_log)
        offsets[role] = ClockOffset(**_told(offset), recipe="" if useless else RecipeFragment(tables).toml())
        if offset.drifts or offset.noted:
            purpose = "where the recorder's clock is the better one" if offset.drifts else "to correct it"
            warnings.append(_said(found, role, offset, name) + ("" if useless else suggested(purpose, tables)))
    pairs = tuple(ClockPair(**_told(pair), determined=pair.determined) for pair in found.pairs)
    lost = found.position_offset_s or None, found.heading_offset_s or None
    return StageReport(tuple(warnings), ClockFacts(epoch, found.reference, pairs, offsets, *lost))


def _is_open(offset: RoleOffset) -> bool:
    """Whether two clocks differ and nothing tells whose is off."""
    return (offset.noted or offset.drifts) and not offset.blamed


def _said(found: ClockOffsets, role: str, offset: RoleOffset, name: str) -> str:
    """Return what a person should know of a clock; ``name`` is what the recipe calls the role."""
    change_s, change_std_s = (each * found.span_s / 3600 for each in (offset.drift_s_per_h, offset.drift_std_s_per_h))
    drift = f"over the run (± {2 * change_std_s:.2f} s, by {_means(found, role)})"
    constant = f"(± {2 * offset.std_s:.2f} s, by {_means(found, role)})"
    if _is_open(offset):
        by = (
            f"drift apart by {abs(change_s):.2f} s {drift}"
            if offset.drifts
            else f"differ by {abs(offset.offset_s):.2f} s {constant}"
        )
        cost = "; the deviations of positions count what is driven in it" if GNSS in {role, found.reference} else ""
        return (
            f"{name} and {found.reference}: their stamps {by}, and no two other sensors agree on which of them is off: "
            f"nothing is corrected or advised{cost}"
        )
    if offset.drifts:
        return f"{name}: its stamps drift against {found.reference} by {change_s:+.2f} s {drift}: no constant offset corrects that"
    return (
        f"{name}: its stamps seem {abs(offset.offset_s):.2f} s {'late' if offset.offset_s > 0 else 'early'} against {found.reference} "
        f"{constant}; nothing is corrected"
    )


def _told(each: RoleOffset | Pair) -> dict[str, Any]:
    """Return the fields by name, None for what is not known."""
    return {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in asdict(each).items()}


def _means(found: ClockOffsets, role: str) -> str:
    """Return by what the role was compared."""
    return " and ".join(dict.fromkeys(p.by for p in found.pairs if p.determined and role in {p.late, p.against}))


def with_offset_cost(track: pa.Table, clocks: ClockFacts) -> pa.Table:
    """Return the track with what an unresolved offset costs, in the positions' deviations.

    Of the fixes' clock the way that is driven in it; of the IMU's what it turns in it, over the metre in which the fixes set that right.
    """
    driven_s, turned_s = clocks.position_offset_s or 0.0, clocks.heading_offset_s or 0.0
    if not (driven_s or turned_s):
        return track
    aside_m = turned_s * _TURNED_OVER_M * floats(track, "yaw_rate_radps")
    for axis, name in zip("xyz", ("east", "north", "up"), strict=True):
        column = f"{axis}_std_m"
        lost_m = np.hypot(driven_s * floats(track, f"{name}_velocity_mps"), aside_m if axis != "z" else 0.0)
        raised = np.hypot(floats(track, column), lost_m)
        track = track.set_column(track.column_names.index(column), track.schema.field(column), pa.array(raised))
    return track


def _power(streams: Streams, epoch: int) -> PowerSignal | None:
    rails = rails_of(streams, epoch)
    if not rails or any(rail.current.stamp_ns.size < 2 for rail in rails):
        return None
    stamp_ns = np.unique(np.concatenate([rail.current.stamp_ns for rail in rails]))
    _, _, watt = power_at(rails, stamp_ns, max_gap_ns=_MAX_GAP_NS)
    known = np.isfinite(watt)
    return PowerSignal(stamp_ns[known], watt[known], streams.power_averaged) if known.sum() > 1 else None
