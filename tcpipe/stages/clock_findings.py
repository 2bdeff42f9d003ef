"""Time offsets between the clocks of sensors and their drift, the remedy of each, and the time offset of GNSS along the path."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import pyarrow as pa

from tcpipe.fusion.checks.clock_offsets import ClockOffsets, Pair, PowerSignal, RoleOffset, find_clock_offsets
from tcpipe.fusion.measurements import GNSS, IMU
from tcpipe.power.rails import compute_power_at
from tcpipe.recipe.suggestions import suggest
from tcpipe.stages.fuse_inputs import FusionInputs, find_longest_epoch, find_recipe_role
from tcpipe.stages.message_arrays import make_rails
from tcpipe.tables.columns import to_floats
from tcpipe.tables.facts import ClockFacts, ClockOffset, ClockPair
from tcpipe.tables.findings import Finding, StageReport, Subject, make_finding
from tcpipe.tables.levels import Streams

_MAX_GAP_NS = 300_000_000
_FINE_S = 0.004
_TURNED_OVER_M = 1.0


def check_clocks(streams: Streams, inputs: FusionInputs) -> StageReport[ClockFacts]:
    """Return the offsets between the sensors' clocks in the longest clock epoch; nothing is corrected.

    The remedy that would correct an offset includes what the recipe adds already.
    """
    epoch = find_longest_epoch(inputs)
    found = find_clock_offsets(inputs.measurements[epoch], _make_power_signal(streams, epoch))
    offsets = {role: ClockOffset(**_select_known(offset)) for role, offset in found.offsets.items()}
    findings = [
        _find_offset(found, role, offset, streams)
        for role, offset in found.offsets.items()
        if offset.drifts or offset.noted
    ]
    pairs = tuple(ClockPair(**_select_known(pair), determined=pair.determined) for pair in found.pairs)
    lost = found.position_offset_s or None, found.heading_offset_s or None
    return StageReport(tuple(findings), ClockFacts(epoch, found.reference, pairs, offsets, *lost))


def _find_offset(found: ClockOffsets, role: str, offset: RoleOffset, streams: Streams) -> Finding:
    """Return the finding on a clock: which is off where two others agree, else that two differ."""
    name = find_recipe_role(role, streams)
    compared = dict.fromkeys(p.by for p in found.pairs if p.determined and role in {p.late, p.against})
    subject, names = Subject("role", name), {"reference": found.reference, "by": ", ".join(compared)}
    offset_s, offset_2std_s = offset.offset_s, 2 * offset.std_s
    hours = found.span_s / 3600
    drift_s, drift_2std_s = offset.drift_s_per_h * hours, 2 * offset.drift_std_s_per_h * hours
    if not offset.blamed:
        return make_finding(
            "clocks-differ",
            subject,
            action="inflated" if GNSS in {role, found.reference} else None,
            names=names,
            offset_s=offset_s,
            offset_2std_s=offset_2std_s,
            apart_s=abs(offset_s) + (abs(drift_s) / 2 if offset.drifts else 0.0),
            drift_s=drift_s,
            drift_2std_s=drift_2std_s,
        )
    if offset.drifts:
        by_log = streams.sensors[role].time_source == "log"
        remedies = () if by_log else suggest("use_log_time", {"read.time_source": {name: "log"}})
        return make_finding(
            "clock-drift", subject, names=names, remedies=remedies, drift_s=drift_s, drift_2std_s=drift_2std_s
        )
    given_s = streams.report.facts.time_offset_s.get(name, 0.0)
    correction_s = round(given_s - offset_s, 3 if offset.std_s < _FINE_S else 2)
    is_inflated = role == IMU and bool(found.heading_offset_s)
    return make_finding(
        "time-offset",
        subject,
        severity="note" if is_inflated else None,
        action="inflated" if is_inflated else None,
        names=names,
        remedies=suggest("correct", {"read.time_offset_s": {name: correction_s}}),
        offset_s=offset_s,
        offset_2std_s=offset_2std_s,
    )


def _select_known(each: RoleOffset | Pair) -> dict[str, Any]:
    """Return the fields by name, None for unknown values."""
    return {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in asdict(each).items()}


def add_offset_uncertainty(track: pa.Table, clocks: ClockFacts) -> pa.Table:
    """Return the track with what an unresolved offset costs, in the positions' deviations.

    Of the fixes' clock the way that is driven in it; of the IMU's what it turns in it, over the metre in which the fixes set that right.
    """
    driven_s, turned_s = clocks.position_offset_s or 0.0, clocks.heading_offset_s or 0.0
    if not (driven_s or turned_s):
        return track
    aside_m = turned_s * _TURNED_OVER_M * to_floats(track, "yaw_rate_radps")
    for axis, name in zip("xyz", ("east", "north", "up"), strict=True):
        column = f"{axis}_std_m"
        lost_m = np.hypot(driven_s * to_floats(track, f"{name}_velocity_mps"), aside_m if axis != "z" else 0.0)
        raised = np.hypot(to_floats(track, column), lost_m)
        track = track.set_column(track.column_names.index(column), track.schema.field(column), pa.array(raised))
    return track


def _make_power_signal(streams: Streams, epoch: int) -> PowerSignal | None:
    rails = make_rails(streams, epoch)
    if not rails or any(rail.current.stamp_ns.size < 2 for rail in rails):
        return None
    stamp_ns = np.unique(np.concatenate([rail.current.stamp_ns for rail in rails]))
    _, _, watt = compute_power_at(rails, stamp_ns, max_gap_ns=_MAX_GAP_NS)
    known = np.isfinite(watt)
    return PowerSignal(stamp_ns[known], watt[known], streams.power_averaged) if known.sum() > 1 else None
