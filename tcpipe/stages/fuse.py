"""Fuse: streams become one track of base_link, 20 times a second, with its uncertainty (L1 to L2).

Time offsets between the clocks of sensors are taken out before fusion. Power is not fused, and its stamps stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from tcpipe.errors import FusionError
from tcpipe.fusion.checks.audit import is_astray
from tcpipe.fusion.checks.clock_offsets import find_clock_offsets, find_middle_ns, find_other_clocks, shift_sensors
from tcpipe.fusion.checks.coarse_lag import NEAR_S
from tcpipe.fusion.checks.sanity import SensorExclusion, make_fix_exclusion
from tcpipe.fusion.measurements import DOPPLER, GNSS, IMU, Measurements, Trajectory
from tcpipe.logs.clocks import LOG_CLOCK
from tcpipe.recipe import FuseConfig
from tcpipe.recipe.suggestions import suggest
from tcpipe.stages.fuse_findings import (
    add_counts,
    find_fuse_findings,
    find_parameter_findings,
    make_audit_findings,
    make_fuse_facts,
)
from tcpipe.stages.fuse_inputs import (
    Section,
    drop_implausible_sensors,
    exclude_sensors,
    find_exclusions,
    find_fixes_role,
    find_span_s,
    merge_findings,
    prepare_sections,
    rank_sections,
    rename_role,
    use_pose_as_fixes,
)
from tcpipe.stages.fuse_sections import Fused, fuse_section, make_rejections_table
from tcpipe.tables.facts import ClockFacts, ClockOffset, SensorChecks
from tcpipe.tables.findings import Finding, Remedy, StageReport, Subject, make_finding, select_findings
from tcpipe.tables.levels import TRACK, Datum, Streams, Track, TrackInfo


def fuse_run(streams: Streams, config: FuseConfig, *, run_id: str) -> Track:
    """Return the track of a run; rows are in order of clock epoch and stamp.

    Each clock epoch, and each part of it between long pauses, is fused separately. Stamps are multiples of the track's period; where no
    sensor measures motion for ``max_gap_s`` there are no rows, so a gap is a step in the stamps.

    Raises `FusionError`: no sensor measures motion, or the estimate breaks down in every section.
    """
    fixes = find_fixes_role(streams)
    try:
        return _fuse(streams, config, run_id, fixes)
    except FusionError as error:
        raise FusionError(*error.problems, findings=rename_role(error.findings, GNSS, fixes)) from error


def _fuse(streams: Streams, config: FuseConfig, run_id: str, fixes: str) -> Track:
    run, read = Subject("run", run_id), streams.report
    # 1. Streams become sections of measurements: one frame, one set of units, usable variances, without sensors that cannot be right.
    streams, is_local = use_pose_as_fixes(streams)
    sections = exclude_other_clocks(prepare_sections(streams, config), streams)
    sections = find_clocks(drop_implausible_sensors(sections, streams))
    # 2. Initial state, filter and smoother of each section.
    sections, fused, errors = fuse_sections(sections, streams, config, run=run)
    failures = merge_findings(finding for error in errors for finding in error.findings)
    if not fused.found:
        problems = [problem for error in errors for problem in error.problems] or ["no motion to fuse"]
        nothing = [] if errors else [_find_nothing(streams, sections, run), *find_exclusions(sections)]
        raise FusionError(*problems, findings=(*failures, *nothing))
    columns = {name: np.concatenate([part[name] for part in fused.columns]) for name in fused.columns[0]}
    is_local |= bool(np.isnan(columns["lon_deg"]).all())
    if is_local:
        columns |= {name: np.full_like(columns[name], np.nan) for name in ("lon_deg", "lat_deg", "alt_m")}
    table = TRACK.table(**columns)
    origin = next((section.datum_deg_m for section in sections if section.datum_deg_m), None)
    datum = None if is_local or origin is None else Datum(*origin, crs=streams.gnss_crs)
    # 3. Excluded sensors, what the run shows of the others, and where the track contradicts all of them.
    summary = make_fuse_facts(sections, fused.facts, rows=table.num_rows, skipped_s=fused.skipped_s)
    audit = make_audit_findings(fused, sections, streams)
    exclusions = find_exclusions(sections)
    findings = (
        *find_fuse_findings(sections, summary, run=run),
        *(replace(finding, severity="warning") for finding in failures if finding.severity == "error"),
        *exclusions,
        *find_parameter_findings(sections, summary, streams),
        *([make_finding("direction-assumed", Subject("role", GNSS))] if fused.is_forward_assumed else []),
        *audit.findings,
        *find_offsets(sections, streams),
        *sections[0].cuts.values(),
    )
    facts: dict[str, Any] = {
        "fuse": summary,
        "sensor_checks": SensorChecks({finding.subject.name: finding.code for finding in reversed(exclusions)}),
        "audit": audit.facts,
        "clock_offsets": tuple(section.clocks for section in sections),
    }
    findings, facts = rename_role((findings, facts), GNSS, fixes)
    report = StageReport((*_drop_places(read.findings, findings), *findings), replace(read.facts, **facts))
    info = TrackInfo(run_id, streams.robot, datum, config.rate_hz, config.estimator, report)
    return Track(table, make_rejections_table(sections, fused.found, fixes), info)


def fuse_sections(
    sections: Sequence[Section], streams: Streams, config: FuseConfig, *, run: Subject
) -> tuple[list[Section], Fused, list[FusionError]]:
    """Return the sections as they were fused, their track, and why some have none.

    A section is fused again without the offset of a clock that its estimate finds to step. Where one section has a place on the earth,
    those without fixes are skipped.
    """
    given, used, tracks, errors = [*sections], correct_clocks(sections), list[Fused](), list[FusionError]()
    for place in range(len(given)):
        last = next((track.found[-1] for track in reversed(tracks) if track.found), None)
        fuse = partial(fuse_recovering, streams=streams, config=config, run=run, last=last)
        tracks.append(_skip(used[place]))
        try:
            section, track = fuse(used[place])
            unsteady = {change.role for facts in track.facts for change in facts.changes if change.kind == "clock"}
            if unsteady & section.offsets.keys():
                steady = {role: offset for role, offset in section.clocks.offsets.items() if role not in unsteady}
                given[place] = replace(given[place], clocks=replace(section.clocks, offsets=steady))
                section, track = fuse(correct_clocks(given)[place])
            used[place], tracks[place] = section, track
        except FusionError as error:
            errors.append(error)
    has_place = any(section.datum_deg_m and track.found for section, track in zip(used, tracks, strict=True))
    fused = Fused()
    for section, track in zip(used, tracks, strict=True):
        fused.append(_skip(section) if has_place and section.datum_deg_m is None else track)
    return used, fused, errors


def _skip(section: Section) -> Fused:
    return Fused(skipped_s=float(np.diff(section.span_ns)[0]) * 1e-9)


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


def _find_nothing(streams: Streams, sections: Sequence[Section], run: Subject) -> Finding:
    rows: dict[str, Any] = {f"{role}_row_count": table.num_rows for role, table in streams.tables.items()}
    counts = add_counts(sections)
    rows |= {f"{role}_unusable_count": count["invalid"] for role, count in counts.items() if count["invalid"]}
    return make_finding("no-motion", run, **rows)


def fuse_recovering(
    inputs: Section, streams: Streams, config: FuseConfig, *, run: Subject, last: Trajectory | None = None
) -> tuple[Section, Fused]:
    """Fuse a section; where the track contradicts every sensor, again without the one that misleads it.

    That is the IMU, which carries the state from tick to tick, if the track recovers without it; else the only sensor without which it
    does. A single sensor of motion that its own track contradicts is not consistent: there is nothing to fuse without it. A local frame
    goes on from the end of ``last``.

    Raises `FusionError`: the track contradicts every sensor, whichever is excluded, or the only one.
    """
    fused = fuse_section(inputs, streams, config, last)
    if not is_astray(fused.windows, fused.astray):
        return inputs, fused
    roles = sorted(inputs.measurements.sensors())
    recovered = {}
    for role in roles:
        rest = _exclude_misleading(role, inputs, streams)
        if rest.measurements.gnss is not None or rest.measurements.odometries():
            tried = fuse_section(rest, streams, config, last)
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
    span_s = find_span_s(*inputs.span_ns, streams)
    finding = make_finding(code, subject, span_s=span_s, astray_fraction=fused.astray / fused.windows)
    raise FusionError("the track contradicts every sensor", findings=(finding, *inputs.excluded.values()))


def _exclude_misleading(role: str, inputs: Section, streams: Streams) -> Section:
    odometries = set(inputs.measurements.odometries()).difference({role})
    code = "misleads-track"
    exclusion = make_fix_exclusion(code, odometries) if role == GNSS else SensorExclusion(role, code)
    return exclude_sensors(inputs, [exclusion], streams)


def exclude_other_clocks(sections: Sequence[Section], streams: Streams) -> list[Section]:
    """Return the sections without sensors whose clocks are more than a second off the others', there or where the drive is longer.

    No label of the run is usable until the recipe states the offset, since it is unknown which of the clocks power has.
    """
    found, known = [*sections], dict[str, tuple[str, ClockOffset]]()
    for place in rank_sections(sections):
        section = sections[place]
        offsets = find_other_clocks(section.measurements)
        reference = next((role for role, offset in offsets.items() if not offset.noted), "")
        known |= {role: (reference, offset) for role, offset in offsets.items() if offset.noted}
        for role in [role for role in known if role in section.measurements.sensors()]:
            against, offset = known[role]
            numbers = {"offset_s": offset.offset_s, "offset_2std_s": 2 * offset.std_s}
            exclusion = SensorExclusion(role, "clocks-differ", {"reference": against}, numbers)
            section = exclude_sensors(section, [exclusion], streams)
            remedies = _state_offset(role, offset, streams) + section.excluded[role].remedies
            finding = replace(section.excluded[role], severity="error", remedies=remedies)
            section = replace(section, excluded={**section.excluded, role: finding})
        found[place] = section
    return found


def find_late_sensors(streams: Streams, config: FuseConfig) -> dict[str, float]:
    """Return how late sensors' stamps are against those of most sensors [s], by role; those whose offset is unknown are missing."""
    sections = prepare_sections(use_pose_as_fixes(streams)[0], config)
    if not sections:
        return {}
    offsets = find_other_clocks(sections[rank_sections(sections)[0]].measurements, always=True)
    return rename_role({role: offset.offset_s for role, offset in offsets.items()}, GNSS, find_fixes_role(streams))


_FINE_S = 0.004
_JUMP_NS = 500_000_000
_DRIVES_MPS = 0.3


def find_clocks(sections: Sequence[Section]) -> list[Section]:
    """Return the sections with the time offsets between their sensors.

    A section decides about its own clocks. A sensor whose clock it cannot compare has the constant offset that a section with a longer
    drive shows: latency is a constant of the driver. If the clock drifts there, its offset here is unknown, and is doubted.
    """
    found = [*sections]
    shown: dict[str, tuple[ClockOffset, str, int]] = {}
    for place in rank_sections(sections):
        m = sections[place].measurements
        clocks, middle_ns = find_clock_offsets(m, clock_epoch=sections[place].clock_epoch), find_middle_ns(m)[0]
        own = {role: (offset, clocks.reference, middle_ns) for role, offset in clocks.offsets.items() if offset.noted}
        for role in sorted(shown.keys() & m.sensors().keys() - clocks.offsets.keys() - {clocks.reference}):
            offset, reference, at_ns = shown[role]
            if offset.drift_ppm:
                drift_s = offset.drift_ppm * 1e-6 * (middle_ns - at_ns) * 1e-9
                offset = ClockOffset(0.0, float(np.hypot(offset.std_s, drift_s)), noted=True, blamed=False)
            clocks = replace(clocks, reference=clocks.reference or reference, offsets={**clocks.offsets, role: offset})
        shown = own | shown
        found[place] = replace(sections[place], clocks=clocks)
    return found


def correct_clocks(sections: Sequence[Section]) -> list[Section]:
    """Return the sections on one clock each: offset and drift of each clock, about the middle of its section, are taken out."""
    corrected = []
    for section in sections:
        middle_ns = find_middle_ns(section.measurements)[0]
        shifted = shift_sensors(section.measurements, section.offsets, middle_ns)
        corrected.append(replace(section, measurements=shifted))
    cuts = dict(find_clock_jumps(corrected))
    return [replace(section, cuts=cuts) for section in corrected]


def find_offsets(sections: Sequence[Section], streams: Streams) -> list[Finding]:
    """Return the findings on clocks; those of several sections name the time of theirs."""
    findings = []
    for section in (sections[place] for place in rank_sections(sections)):
        span_s = find_span_s(*section.span_ns, streams)
        for role, offset in section.offsets.items():
            finding = _find_offset(section.clocks, role, offset, streams, span_s[1] - span_s[0])
            findings.append(replace(finding, span_s=span_s) if len(sections) > 1 else finding)
    return merge_findings(findings)


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
    return make_finding(
        "time-offset",
        subject,
        severity="note" if role == DOPPLER else None,
        action="corrected",
        names=names,
        remedies=_state_offset(role, offset, streams),
        offset_s=offset_s,
        offset_2std_s=offset_2std_s,
    )


def _state_offset(role: str, offset: ClockOffset, streams: Streams) -> tuple[Remedy, ...]:
    """Return what corrects the stamps of a sensor; a receiver's own velocity has the clock of its fixes."""
    given_s = streams.report.facts.time_offset_s.get(role, 0.0)
    correction_s = round(given_s - offset.offset_s, 3 if offset.std_s < _FINE_S else 2)
    is_far = abs(offset.offset_s) > NEAR_S and role == GNSS and DOPPLER in streams.tables
    roles = (role, DOPPLER) if is_far else (role,)
    return suggest("correct", {"read.time_offset_s": dict.fromkeys(roles, correction_s)})


def find_clock_jumps(sections: Sequence[Section]) -> Iterator[tuple[int, Finding]]:
    """Yield the first stamps [ns] after the clock of all sensors was set forward, and the findings.

    Nothing is measured before them, and by the fixes the robot, which drives before and after, does not drive meanwhile.
    """
    epochs: dict[int, list[Measurements]] = {}
    for section in sections:
        epochs.setdefault(section.clock_epoch, []).append(section.measurements)
    stamps = {
        epoch: np.unique(np.concatenate([sensor.stamp_ns for m in of_epoch for sensor in m.sensors().values()]))
        for epoch, of_epoch in epochs.items()
        if any(m.sensors() for m in of_epoch)
    }
    for epoch, stamp_ns in stamps.items():
        wheels = [m.first_odometry for m in epochs[epoch] if m.first_odometry is not None]
        fixes = [m.gnss for m in epochs[epoch] if m.gnss is not None]
        if not wheels or not fixes:
            continue
        wheels_ns, fixes_ns = (np.concatenate([each.stamp_ns for each in of_role]) for of_role in (wheels, fixes))
        speed_mps = np.concatenate([each.velocity_mps[:, 0] for each in wheels])
        place_m = np.concatenate([each.position_enu_m[:, :2] for each in fixes])
        for ends_ns in np.stack((stamp_ns[:-1], stamp_ns[1:]), -1)[np.diff(stamp_ns) > _JUMP_NS]:
            step_s = float(np.diff(ends_ns)[0]) * 1e-9
            at_s = float(ends_ns[1] - min(each[0] for each in stamps.values())) * 1e-9
            driven = np.interp(ends_ns, wheels_ns, speed_mps)
            moved_m = [np.diff(np.interp(ends_ns, fixes_ns, axis)) for axis in place_m.T]
            slowest_mps = float(np.abs(driven).min())
            if slowest_mps > _DRIVES_MPS and np.linalg.norm(moved_m) < 0.5 * slowest_mps * step_s:
                span_s, names = (at_s, at_s), {"topics": "all topics"}
                finding = make_finding("clock-step", LOG_CLOCK, span_s=span_s, names=names, step_s=step_s, at_s=at_s)
                yield int(ends_ns[1]), finding
