"""Clocks of the sensors by section: large offsets exclude a sensor; small offsets and drifts are corrected."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tcpipe.fusion.checks.clock_offsets import find_clock_offsets, find_other_clocks, shift_sensors
from tcpipe.fusion.checks.sanity import SensorExclusion
from tcpipe.fusion.course import MIN_SPEED_MPS
from tcpipe.fusion.measurements import DOPPLER, GNSS
from tcpipe.fusion.preparation import inflate_late_fixes
from tcpipe.fusion.signals import MAX_GAP_NS
from tcpipe.logs.clocks import LOG_CLOCK
from tcpipe.recipe import FuseConfig
from tcpipe.recipe.suggestions import suggest
from tcpipe.stages.fuse_findings import rename_role
from tcpipe.stages.fuse_inputs import Section, exclude_sensors, find_span_s, prepare_sections, rank_sections
from tcpipe.stages.fuse_sections import merge_findings
from tcpipe.stages.message_arrays import find_fixes_role, use_pose_as_fixes
from tcpipe.tables.facts import ClockFacts, ClockOffset
from tcpipe.tables.findings import Finding, Remedy, Subject, make_finding
from tcpipe.tables.levels import Streams


def exclude_other_clocks(sections: Sequence[Section], streams: Streams) -> list[Section]:
    """Return the sections without sensors whose clocks differ by more than a second, here or in the longest section.

    No label of the run is usable until the recipe states the offset, since it is unknown which clock stamps power.
    """
    found, known = [*sections], dict[str, tuple[str, ClockOffset]]()
    for place in rank_sections(sections):
        section = sections[place]
        offsets = find_other_clocks(section.measurements)
        reference = next((role for role, offset in offsets.items() if not offset.is_significant), "")
        known |= {role: (reference, offset) for role, offset in offsets.items() if offset.is_significant}
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
    """Return, by role, the delay of each sensor's stamps relative to most sensors [s]; unknown delays are missing."""
    sections = prepare_sections(use_pose_as_fixes(streams)[0], config)
    if not sections:
        return {}
    offsets = find_other_clocks(sections[rank_sections(sections)[0]].measurements, always=True)
    return rename_role({role: offset.offset_s for role, offset in offsets.items()}, GNSS, find_fixes_role(streams))


def find_clocks(sections: Sequence[Section]) -> list[Section]:
    """Return the sections with the time offsets between their sensors.

    Each section determines its own clocks. If it cannot compare the clock of a sensor, it takes the constant offset
    from the section with the longest drive: latency is a constant of the driver. If the clock drifts there, the offset
    is unknown.
    """
    found = [*sections]
    best_offsets: dict[str, tuple[ClockOffset, str, int]] = {}
    for index in rank_sections(sections):
        m = sections[index].measurements
        clocks = find_clock_offsets(m, clock_epoch=sections[index].clock_epoch)
        middle_ns = sum(sections[index].span_ns) // 2
        own = {
            role: (offset, clocks.reference, middle_ns)
            for role, offset in clocks.offsets.items()
            if offset.is_significant
        }
        for role in sorted(best_offsets.keys() & m.sensors().keys() - clocks.offsets.keys() - {clocks.reference}):
            offset, reference, at_ns = best_offsets[role]
            if offset.drift_ppm:
                drift_s = offset.drift_ppm * 1e-6 * (middle_ns - at_ns) * 1e-9
                offset = ClockOffset(0.0, float(np.hypot(offset.std_s, drift_s)), is_significant=True, is_wrong=False)
            clocks = replace(clocks, reference=clocks.reference or reference, offsets={**clocks.offsets, role: offset})
        best_offsets = own | best_offsets
        found[index] = replace(sections[index], clocks=clocks)
    return found


def correct_clocks(sections: Sequence[Section], streams: Streams) -> list[Section]:
    """Return the sections with corrected stamps: without clock offsets and drifts (about the section's middle)."""
    corrected, stated_s = [], streams.report.facts.time_offset_s.get(GNSS, 0.0)
    for section in sections:
        middle_ns = sum(section.span_ns) // 2
        shifted = shift_sensors(section.measurements, section.offsets, middle_ns)
        if shifted.gnss is not None:
            found_s = section.offsets[GNSS].offset_s if GNSS in section.offsets else 0.0
            shifted = replace(shifted, gnss=inflate_late_fixes(shifted.gnss, stated_s + found_s))
        corrected.append(replace(section, measurements=shifted))
    cuts = dict(find_clock_jumps(corrected))
    return [replace(section, cuts=cuts) for section in corrected]


def find_offsets(sections: Sequence[Section], streams: Streams) -> list[Finding]:
    """Return the findings on clocks; with several sections, each finding has the time span of its section."""
    findings = []
    for section in (sections[place] for place in rank_sections(sections)):
        span_s = find_span_s(*section.span_ns, streams)
        for role, offset in section.offsets.items():
            finding = _find_offset(section.clocks, role, offset, streams, span_s[1] - span_s[0])
            findings.append(replace(finding, span_s=span_s) if len(sections) > 1 else finding)
    return merge_findings(findings)


def _find_offset(found: ClockFacts, role: str, offset: ClockOffset, streams: Streams, span_s: float) -> Finding:
    """Return the finding on a clock: that it is wrong if two others agree, else that two clocks differ."""
    compared = dict.fromkeys(p.by for p in found.pairs if p.determined and role in {p.late, p.against})
    names, drift_s = {"reference": found.reference, "by": ", ".join(compared)}, 1e-6 * offset.drift_ppm * span_s
    numbers: dict[str, Any] = {"offset_s": offset.offset_s, "offset_2std_s": 2 * offset.std_s}
    if not offset.is_wrong:
        return make_finding("clocks-differ", Subject("role", role), names=names, drift_s=drift_s, **numbers)
    code, remedies = "time-offset", _state_offset(role, offset, streams)
    if offset.drift_ppm:
        code, numbers = "clock-drift", {"drift_s": drift_s}
        by_log = streams.sensors[role].time_source == "log"
        remedies = () if by_log else suggest("use_log_time", {"read.time_source": {role: "log"}})
    return make_finding(code, Subject("role", role), action="corrected", names=names, remedies=remedies, **numbers)


def _state_offset(role: str, offset: ClockOffset, streams: Streams) -> tuple[Remedy, ...]:
    """Return the recipe lines that correct the stamps of a sensor; a receiver's velocity has the clock of its fixes."""
    given_s = streams.report.facts.time_offset_s.get(role, 0.0)
    correction_s = round(given_s - offset.offset_s, 3)
    roles = (role, DOPPLER) if role == GNSS and DOPPLER in streams.tables else (role,)
    return suggest("correct", {"read.time_offset_s": dict.fromkeys(roles, correction_s)})


def find_clock_jumps(sections: Sequence[Section]) -> Iterator[tuple[int, Finding]]:
    """Yield the first stamp [ns] after each forward step of the clock of all sensors, and its finding.

    A forward step has no measurements before it, and the robot, which drives before and after, does not move meanwhile
    according to the fixes.
    """
    stamps = [sensor.stamp_ns for section in sections for sensor in section.measurements.sensors().values()]
    for epoch in dict.fromkeys(section.clock_epoch for section in sections):
        of_epoch = [section.measurements for section in sections if section.clock_epoch == epoch]
        odometries = [m.first_odometry for m in of_epoch if m.first_odometry is not None]
        fixes = [m.gnss for m in of_epoch if m.gnss is not None]
        if not odometries or not fixes:
            continue
        wheels_ns, fixes_ns = (np.concatenate([each.stamp_ns for each in of_role]) for of_role in (odometries, fixes))
        speed_mps = np.concatenate([each.velocity_mps[:, 0] for each in odometries])
        place_m = np.concatenate([each.position_enu_m[:, :2] for each in fixes])
        stamp_ns = np.unique(np.concatenate([sensor.stamp_ns for m in of_epoch for sensor in m.sensors().values()]))
        ends_ns = np.stack((stamp_ns[:-1], stamp_ns[1:]))[:, np.diff(stamp_ns) > MAX_GAP_NS]
        steps_s = np.diff(ends_ns, axis=0)[0] * 1e-9
        slowest_mps = np.abs(np.interp(ends_ns, wheels_ns, speed_mps)).min(axis=0)
        moved_m = np.hypot(*(np.diff(np.interp(ends_ns, fixes_ns, axis), axis=0)[0] for axis in place_m.T))
        jumps = (slowest_mps > MIN_SPEED_MPS) & (moved_m < 0.5 * slowest_mps * steps_s)
        for after_ns, step_s in zip(ends_ns[1, jumps].tolist(), steps_s[jumps].tolist(), strict=True):
            at_s = (after_ns - min(int(each[0]) for each in stamps)) * 1e-9
            span_s, names = (at_s, at_s), {"topics": "all topics"}
            yield after_ns, make_finding("clock-step", LOG_CLOCK, span_s=span_s, names=names, step_s=step_s, at_s=at_s)
