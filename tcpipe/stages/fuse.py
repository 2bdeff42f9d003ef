"""Fuse: streams become one track of base_link, 20 times a second, with its uncertainty (L1 to L2).

Time offsets between the clocks of sensors are taken out before fusion. Power is not fused, and its stamps stay as they are.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from tcpipe.errors import FusionError
from tcpipe.fusion.checks.audit import is_astray
from tcpipe.fusion.checks.clock_offsets import find_clock_offsets, find_middle_ns, shift_stamps
from tcpipe.fusion.checks.sanity import SensorExclusion, make_fix_exclusion
from tcpipe.fusion.measurements import DOPPLER, GNSS, IMU
from tcpipe.logs.clocks import LOG_CLOCK
from tcpipe.recipe import FuseConfig
from tcpipe.recipe.suggestions import suggest
from tcpipe.stages.fuse_findings import (
    find_fuse_findings,
    find_parameter_findings,
    make_audit_findings,
    make_fuse_facts,
)
from tcpipe.stages.fuse_inputs import (
    FusionInputs,
    drop_implausible_sensors,
    exclude_sensors,
    find_longest_epoch,
    name_pose,
    prepare_inputs,
    prepare_pose,
)
from tcpipe.stages.fuse_sections import Fused, fuse_sections, make_rejections_table
from tcpipe.tables.facts import ClockFacts, ClockOffset, SensorChecks
from tcpipe.tables.findings import Finding, StageReport, Subject, make_finding, select_findings
from tcpipe.tables.levels import TRACK, Datum, Streams, Track, TrackInfo


def fuse_run(streams: Streams, config: FuseConfig, *, run_id: str) -> Track:
    """Return the track of a run; rows are in order of clock epoch and stamp.

    Each clock epoch, and each section between long pauses, is fused separately. Stamps are multiples of the track's period; where no sensor
    measures motion for ``max_gap_s`` there are no rows, so a gap is a step in the stamps.

    Raises `FusionError`: no sensor measures motion, or the estimate breaks down.
    """
    try:
        return _fuse(streams, config, run_id)
    except FusionError as error:
        raise FusionError(*error.problems, findings=name_pose(error.findings, streams)) from error


def _fuse(streams: Streams, config: FuseConfig, run_id: str) -> Track:
    # 1. A pose made elsewhere is what the fixes are.
    #    Streams become measurements: one frame, one set of units, usable variances; sensors that cannot be right are left out.
    streams, local = prepare_pose(streams)
    run = Subject("run", run_id)
    inputs = drop_implausible_sensors(prepare_inputs(streams, config), streams)
    # 2. Each section for itself: where it starts, filter and smoother; again without a sensor that leads the track away from all others,
    #    and on the clock of a sensor as it is where the estimate finds that it steps: it has no offset.
    aligned, clocks = correct_clocks(streams, inputs)
    used, fused = fuse_recovering(aligned, streams, config, run=run)
    unsteady = {change.role for section in fused.facts for change in section.changes if change.kind == "clock"}
    if clocks.facts is not None and any(
        offset.noted for role, offset in clocks.facts.offsets.items() if role in unsteady
    ):
        aligned, clocks = correct_clocks(streams, inputs, unsteady)
        used, fused = fuse_recovering(aligned, streams, config, run=run)
    if not fused.found:
        raise FusionError("no motion to fuse", findings=(_find_nothing(streams, used, run), *used.excluded.values()))
    columns = {name: np.concatenate([part[name] for part in fused.columns]) for name in fused.columns[0]}
    if local:
        columns |= {name: np.full_like(columns[name], np.nan) for name in ("lon_deg", "lat_deg", "alt_m")}
    table = TRACK.table(**columns)
    datum = None if local or used.datum_deg_m is None else Datum(*used.datum_deg_m, crs=streams.gnss_crs)
    # 3. What was left out, what the run shows of the sensors, and where the track follows none.
    summary = make_fuse_facts(used, fused.facts, rows=table.num_rows, skipped_s=fused.skipped_s)
    audit = make_audit_findings(fused, used, streams)
    findings = (
        *find_fuse_findings(used, summary, run=run),
        *used.excluded.values(),
        *find_parameter_findings(used, summary, streams),
        *([make_finding("direction-assumed", Subject("role", GNSS))] if fused.is_forward_assumed else []),
        *audit.findings,
        *clocks.findings,
    )
    checks = SensorChecks({role: finding.code for role, finding in used.excluded.items()})
    findings = name_pose(findings, streams)
    facts = replace(
        streams.report.facts,
        fuse=name_pose(summary, streams),
        sensor_checks=name_pose(checks, streams),
        audit=name_pose(audit.facts, streams),
        clock_offsets=name_pose(clocks.facts, streams),
    )
    report = StageReport((*_drop_places(streams.report.findings, findings), *findings), facts)
    info = TrackInfo(run_id, streams.robot, datum, config.rate_hz, config.estimator, report)
    return Track(table, make_rejections_table(used, fused.found, name_pose(GNSS, streams)), info)


def _drop_places(read: tuple[Finding, ...], fused: tuple[Finding, ...]) -> Iterator[Finding]:
    """Yield the findings of reading: on missing extrinsics without remedy if fusing estimates them, and not at all if none are needed."""
    estimated = {
        role for finding in fused for remedy in finding.remedies for role in remedy.recipe.get("read.extrinsics", ())
    }
    unneeded = {each.subject.name for each in select_findings(fused, "track-of-antenna", "imu-too-slow")}
    for finding in read:
        role = finding.subject.name if finding.code == "sensor-not-placed" else ""
        if role not in unneeded:
            yield replace(finding, remedies=()) if role in estimated else finding


def _find_nothing(streams: Streams, inputs: FusionInputs, run: Subject) -> Finding:
    rows: dict[str, Any] = {f"{role}_row_count": table.num_rows for role, table in streams.tables.items()}
    rows |= {f"{role}_unusable_count": count["invalid"] for role, count in inputs.counts.items() if count["invalid"]}
    return make_finding("no-motion", run, **rows)


def fuse_recovering(
    inputs: FusionInputs, streams: Streams, config: FuseConfig, *, run: Subject
) -> tuple[FusionInputs, Fused]:
    """Fuse each section; where the track contradicts every sensor, again without the one that misleads it.

    That is the IMU, which carries the state from tick to tick, if the track recovers without it; else the only sensor without which it
    does. A single sensor of motion that its own track contradicts is not consistent: there is nothing to fuse without it.

    Raises `FusionError`: the track contradicts every sensor, whichever is excluded, or the only one.
    """
    fused = fuse_sections(inputs, streams, config)
    if not is_astray(fused.windows, fused.astray):
        return inputs, fused
    roles = sorted({role for m in inputs.measurements.values() for role in m.sensors()})
    recovered = {}
    for role in roles:
        rest = _exclude_misleading(role, inputs, streams)
        if any(m.gnss is not None or m.odometries() for m in rest.measurements.values()):
            tried = fuse_sections(rest, streams, config)
            if tried.found and not is_astray(tried.windows, tried.astray):
                recovered[role] = rest, tried
    if IMU in recovered:
        return recovered[IMU]
    if len(recovered) == 1:
        return next(iter(recovered.values()))
    code, subject = "track-contradicts-sensors", run
    motion = {*roles} - {IMU, DOPPLER}
    if len(motion) == 1:
        code, subject = "sensor-contradicts-itself", Subject("role", motion.pop())
    finding = make_finding(code, subject, astray_fraction=fused.astray / fused.windows)
    raise FusionError("the track contradicts every sensor", findings=(finding, *inputs.excluded.values()))


def _exclude_misleading(role: str, inputs: FusionInputs, streams: Streams) -> FusionInputs:
    odometries = {name for m in inputs.measurements.values() for name in m.odometries()}.difference({role})
    code = "misleads-track"
    exclusion = make_fix_exclusion(code, odometries) if role == GNSS else SensorExclusion(role, code)
    return exclude_sensors(inputs, [exclusion], streams)


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
    found = find_clock_offsets(inputs.measurements[epoch], clock_epoch=epoch)
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
    if offset.drift_ppm:
        by_log = streams.sensors[role].time_source == "log"
        remedies = () if by_log else suggest("use_log_time", {"read.time_source": {role: "log"}})
        return make_finding("clock-drift", subject, action="corrected", names=names, remedies=remedies, drift_s=drift_s)
    given_s = streams.report.facts.time_offset_s.get(name_pose(role, streams), 0.0)
    correction_s = round(given_s - offset_s, 3 if offset.std_s < _FINE_S else 2)
    return make_finding(
        "time-offset",
        subject,
        severity="note" if role == DOPPLER else None,
        action="corrected",
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
            step_s = float(np.diff(ends_ns)[0]) * 1e-9
            at_s = float(ends_ns[1] - min(each[0] for each in stamps)) * 1e-9
            driven = np.interp(ends_ns, odometry.stamp_ns, odometry.velocity_mps[:, 0])
            moved_m = [np.diff(np.interp(ends_ns, m.gnss.stamp_ns, axis)) for axis in m.gnss.position_enu_m[:, :2].T]
            slowest_mps = float(np.abs(driven).min())
            if slowest_mps > _DRIVES_MPS and np.linalg.norm(moved_m) < 0.5 * slowest_mps * step_s:
                span_s, names = (at_s, at_s), {"topics": "all topics"}
                finding = make_finding("clock-step", LOG_CLOCK, span_s=span_s, names=names, step_s=step_s, at_s=at_s)
                yield int(ends_ns[1]), finding
