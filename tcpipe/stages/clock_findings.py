"""Time offsets between the clocks of sensors and their drift: taken out before fusion, with the remedy of each.

Power is not fused, and its stamps stay as they are.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.clock_offsets import (
    POWER,
    ClockOffsets,
    Pair,
    PowerSignal,
    RoleOffset,
    find_clock_offsets,
    shift_stamps,
)
from tcpipe.fusion.checks.lags import find_span_ns
from tcpipe.fusion.measurements import DOPPLER, GNSS, IMU, VISUAL, WHEELS, Measurements
from tcpipe.logs.clocks import LOG_CLOCK
from tcpipe.power.rails import compute_power_at
from tcpipe.recipe.suggestions import suggest
from tcpipe.stages.fuse_inputs import FusionInputs, find_longest_epoch, find_recipe_role
from tcpipe.stages.message_arrays import make_rails
from tcpipe.tables.facts import ClockFacts, ClockOffset, ClockPair
from tcpipe.tables.findings import Action, Finding, StageReport, Subject, make_finding
from tcpipe.tables.levels import Streams

_MAX_GAP_NS = 300_000_000
_FINE_S = 0.004
_JUMP_NS = 500_000_000
_DRIVES_MPS = 0.3


def correct_clocks(
    streams: Streams, inputs: FusionInputs, unsteady: Collection[str] = ()
) -> tuple[FusionInputs, StageReport[ClockFacts | None]]:
    """Return the inputs on one clock, and the offsets that were taken out, by the longest clock epoch.

    The remedy that states an offset includes what the recipe adds already. Clocks of ``unsteady`` sensors step: they have no offset.
    """
    if not inputs.measurements:
        return inputs, StageReport((), None)
    epoch = find_longest_epoch(inputs)
    found = find_clock_offsets(inputs.measurements[epoch], _make_power_signal(streams, epoch))
    steady = {role: offset for role, offset in found.offsets.items() if role not in unsteady}
    off = {role: offset for role, offset in steady.items() if offset.drifts or offset.noted}
    findings = tuple(_find_offset(found, role, offset, streams) for role, offset in off.items())
    pairs = tuple(ClockPair(**_select_known(pair), determined=pair.determined) for pair in found.pairs)
    offsets = {role: ClockOffset(**_select_known(offset)) for role, offset in steady.items()}
    span = find_span_ns(inputs.measurements[epoch])
    if span is not None:
        aligned = {number: _align(m, off, span[0], found.span_s) for number, m in inputs.measurements.items()}
        inputs = replace(inputs, measurements=aligned)
    cuts_ns, jumps = find_clock_jumps(inputs)
    inputs, findings = replace(inputs, cuts_ns=cuts_ns), (*findings, *jumps)
    return inputs, StageReport(findings, ClockFacts(epoch, found.reference, pairs, offsets))


def find_clock_jumps(inputs: FusionInputs) -> tuple[tuple[int, ...], tuple[Finding, ...]]:
    """Return the first stamps [ns] after the clock of all sensors was set forward, and the findings.

    Nothing is measured before them, and by the fixes the robot, which drives before and after, does not drive meanwhile.
    """
    jumps: list[tuple[int, int]] = []
    for m in inputs.measurements.values():
        odometry = m.wheels or m.visual
        if m.gnss is None or odometry is None:
            continue
        stamp_ns = np.unique(np.concatenate([sensor.stamp_ns for sensor in m.sensors().values()]))
        for row in np.flatnonzero(np.diff(stamp_ns) > _JUMP_NS):
            ends_ns = stamp_ns[[row, row + 1]]
            driven = odometry.velocity_mps[_find_rows_around(odometry.stamp_ns, ends_ns[0]), 0]
            moved_m = np.diff(m.gnss.position_enu_m[_find_rows_around(m.gnss.stamp_ns, ends_ns[0]), :2], axis=0)
            slowest_mps = float(np.abs(driven).min())
            if slowest_mps > _DRIVES_MPS and np.linalg.norm(moved_m) < 0.5e-9 * slowest_mps * np.diff(ends_ns)[0]:
                jumps.append((int(ends_ns[0]), int(ends_ns[1])))
    return tuple(after_ns for _, after_ns in jumps), tuple(_find_jump(inputs, *ends_ns) for ends_ns in jumps)


def _find_rows_around(stamp_ns: NDArray[np.int64], at_ns: int) -> NDArray[np.int64]:
    """Return the last row until a stamp [ns] and the one after it."""
    after = np.searchsorted(stamp_ns, at_ns, "right")
    return np.array([after - 1, after]).clip(0, stamp_ns.size - 1)


def _find_jump(inputs: FusionInputs, before_ns: int, after_ns: int) -> Finding:
    stamps = [int(sensor.stamp_ns[0]) for m in inputs.measurements.values() for sensor in m.sensors().values()]
    at_s, step_s = (after_ns - min(stamps)) * 1e-9, (after_ns - before_ns) * 1e-9
    return make_finding(
        "clock-step", LOG_CLOCK, span_s=(at_s, at_s), names={"topics": "all topics"}, step_s=step_s, at_s=at_s
    )


def _align(m: Measurements, off: Mapping[str, RoleOffset], first_ns: int, span_s: float) -> Measurements:
    names = {GNSS: "gnss", DOPPLER: "doppler", IMU: "imu", WHEELS: "wheels", VISUAL: "visual"}
    shifted: dict[str, Any] = {
        names[role]: replace(sensor, stamp_ns=shift_stamps(sensor.stamp_ns, off[role], first_ns, span_s))
        for role, sensor in m.sensors().items()
        if role in off
    }
    return replace(m, **shifted)


def _find_offset(found: ClockOffsets, role: str, offset: RoleOffset, streams: Streams) -> Finding:
    """Return the finding on a clock: which is off where two others agree, else that two differ."""
    name = find_recipe_role(role, streams)
    compared = dict.fromkeys(p.by for p in found.pairs if p.determined and role in {p.late, p.against})
    subject, names = Subject("role", name), {"reference": found.reference, "by": ", ".join(compared)}
    action: Action = "kept" if role == POWER else "corrected"
    offset_s, offset_2std_s = offset.offset_s, 2 * offset.std_s
    hours = found.span_s / 3600
    drift_s, drift_2std_s = offset.drift_s_per_h * hours, 2 * offset.drift_std_s_per_h * hours
    if not offset.blamed:
        return make_finding(
            "clocks-differ",
            subject,
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
            "clock-drift",
            subject,
            action=action,
            names=names,
            remedies=remedies,
            drift_s=drift_s,
            drift_2std_s=drift_2std_s,
        )
    given_s = streams.report.facts.time_offset_s.get(name, 0.0)
    correction_s = round(given_s - offset_s, 3 if offset.std_s < _FINE_S else 2)
    return make_finding(
        "time-offset",
        subject,
        severity="note" if role == DOPPLER else None,
        action=action,
        names=names,
        remedies=suggest("correct", {"read.time_offset_s": {name: correction_s}}),
        offset_s=offset_s,
        offset_2std_s=offset_2std_s,
    )


def _select_known(each: RoleOffset | Pair) -> dict[str, Any]:
    """Return the fields by name, None for unknown values."""
    return {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in asdict(each).items()}


def _make_power_signal(streams: Streams, epoch: int) -> PowerSignal | None:
    rails = make_rails(streams, epoch)
    if not rails or any(rail.current.stamp_ns.size < 2 for rail in rails):
        return None
    stamp_ns = np.unique(np.concatenate([rail.current.stamp_ns for rail in rails]))
    _, _, watt = compute_power_at(rails, stamp_ns, max_gap_ns=_MAX_GAP_NS)
    known = np.isfinite(watt)
    return PowerSignal(stamp_ns[known], watt[known], streams.power_averaged) if known.sum() > 1 else None
