"""Time offsets between the clocks of sensors: taken out before fusion, with the remedy of each.

Power is not fused, and its stamps stay as they are.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace

import numpy as np

from tcpipe.fusion.checks.clock_offsets import POWER, PowerSignal, find_clock_offsets, find_middle_ns, shift_stamps
from tcpipe.fusion.measurements import DOPPLER
from tcpipe.logs.clocks import LOG_CLOCK
from tcpipe.power.rails import compute_power_at
from tcpipe.recipe.suggestions import suggest
from tcpipe.stages.fuse_inputs import FusionInputs, find_longest_epoch, name_pose
from tcpipe.stages.message_arrays import make_rails
from tcpipe.tables.facts import ClockFacts, ClockOffset
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
    found = find_clock_offsets(inputs.measurements[epoch], _make_power_signal(streams, epoch), clock_epoch=epoch)
    found = replace(found, offsets={role: offset for role, offset in found.offsets.items() if role not in unsteady})
    middle_ns, span_s = find_middle_ns(inputs.measurements[epoch])
    off = {role: offset for role, offset in found.offsets.items() if offset.noted}
    findings = [_find_offset(found, role, offset, streams, span_s) for role, offset in off.items()]
    aligned = {
        number: m.replace_sensors(
            {
                role: replace(sensor, stamp_ns=shift_stamps(sensor.stamp_ns, off[role], middle_ns))
                for role, sensor in m.sensors().items()
                if role in off
            }
        )
        for number, m in inputs.measurements.items()
    }
    inputs = replace(inputs, measurements=aligned)
    jumps = dict(find_clock_jumps(inputs))
    return replace(inputs, cuts_ns=tuple(jumps)), StageReport((*findings, *jumps.values()), found)


def _find_offset(found: ClockFacts, role: str, offset: ClockOffset, streams: Streams, span_s: float) -> Finding:
    """Return the finding on a clock: which is off where two others agree, else that two differ."""
    compared = dict.fromkeys(p.by for p in found.pairs if p.determined and role in {p.late, p.against})
    subject, names = Subject("role", role), {"reference": found.reference, "by": ", ".join(compared)}
    offset_s, offset_2std_s, drift_s = offset.offset_s, 2 * offset.std_s, 1e-6 * offset.drift_ppm * span_s
    if not offset.blamed:
        return make_finding(
            "clocks-differ", subject, names=names, offset_s=offset_s, offset_2std_s=offset_2std_s, drift_s=drift_s
        )
    action: Action = "kept" if role == POWER else "corrected"
    if offset.drift_ppm:
        by_log = streams.sensors[role].time_source == "log"
        remedies = () if by_log else suggest("use_log_time", {"read.time_source": {role: "log"}})
        return make_finding("clock-drift", subject, action=action, names=names, remedies=remedies, drift_s=drift_s)
    given_s = streams.report.facts.time_offset_s.get(name_pose(role, streams), 0.0)
    correction_s = round(given_s - offset_s, 3 if offset.std_s < _FINE_S else 2)
    return make_finding(
        "time-offset",
        subject,
        severity="note" if role == DOPPLER else None,
        action=action,
        names=names,
        remedies=suggest("correct", {"read.time_offset_s": {role: correction_s}}),
        offset_s=offset_s,
        offset_2std_s=offset_2std_s,
    )


def find_clock_jumps(inputs: FusionInputs) -> Iterator[tuple[int, Finding]]:
    """Yield the first stamps [ns] after the clock of all sensors was set forward, and the findings.

    Nothing is measured before them, and by the fixes the robot, which drives before and after, does not drive meanwhile.
    """
    sets = [m for m in inputs.measurements.values() if m.sensors()]
    stamps = [np.unique(np.concatenate([sensor.stamp_ns for sensor in m.sensors().values()])) for m in sets]
    for m, stamp_ns in zip(sets, stamps, strict=True):
        odometry = m.first_odometry
        if m.gnss is None or odometry is None:
            continue
        for ends_ns in np.stack((stamp_ns[:-1], stamp_ns[1:]), -1)[np.diff(stamp_ns) > _JUMP_NS]:
            step_s, at_s = float(np.diff(ends_ns)[0]) * 1e-9, float(ends_ns[1] - min(of[0] for of in stamps)) * 1e-9
            driven = np.interp(ends_ns, odometry.stamp_ns, odometry.velocity_mps[:, 0])
            moved_m = [np.diff(np.interp(ends_ns, m.gnss.stamp_ns, axis)) for axis in m.gnss.position_enu_m[:, :2].T]
            slowest_mps = float(np.abs(driven).min())
            if slowest_mps > _DRIVES_MPS and np.linalg.norm(moved_m) < 0.5 * slowest_mps * step_s:
                span_s, names = (at_s, at_s), {"topics": "all topics"}
                finding = make_finding("clock-step", LOG_CLOCK, span_s=span_s, names=names, step_s=step_s, at_s=at_s)
                yield int(ends_ns[1]), finding


def _make_power_signal(streams: Streams, epoch: int) -> PowerSignal | None:
    rails = make_rails(streams, epoch)
    if not rails or any(rail.current.stamp_ns.size < 2 for rail in rails):
        return None
    stamp_ns = np.unique(np.concatenate([rail.current.stamp_ns for rail in rails]))
    _, _, watt = compute_power_at(rails, stamp_ns, max_gap_ns=_MAX_GAP_NS)
    known = np.isfinite(watt)
    return PowerSignal(stamp_ns[known], watt[known], streams.power_averaged) if known.sum() > 1 else None
