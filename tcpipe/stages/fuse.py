"""Fuse streams into one track of base_link at 20 Hz with its uncertainty (L1 to L2).

Time offsets between the clocks of sensors are corrected before fusion. Power is not fused, and its stamps do not
change.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tcpipe.errors import FusionError
from tcpipe.fusion.measurements import GNSS
from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse_clocks import correct_clocks, exclude_other_clocks, find_clocks, find_offsets
from tcpipe.stages.fuse_findings import (
    add_counts,
    find_fuse_findings,
    find_parameter_findings,
    make_fuse_facts,
    rename_role,
)
from tcpipe.stages.fuse_inputs import Section, drop_implausible_sensors, prepare_sections
from tcpipe.stages.fuse_sections import Fused, find_exclusions, fuse_section, make_rejections_table, merge_findings
from tcpipe.stages.message_arrays import find_fixes_role, use_pose_as_fixes
from tcpipe.tables.facts import SensorChecks
from tcpipe.tables.findings import Finding, StageReport, Subject, make_finding, select_findings
from tcpipe.tables.levels import TRACK, Datum, Streams, Track, TrackInfo


def fuse_run(streams: Streams, config: FuseConfig, *, run_id: str) -> Track:
    """Return the track of a run; rows are in order of clock epoch and stamp.

    Each clock epoch, and each part of it between long pauses, is fused separately. Stamps are multiples of the track's
    period. If no sensor measures motion for ``max_gap_s``, the track has no rows there: a gap is a step in the stamps.

    Raises `FusionError`: no sensor measures motion, or the estimate diverges in every section.
    """
    fixes_role = find_fixes_role(streams)
    try:
        return _fuse(streams, config, run_id, fixes_role)
    except FusionError as error:
        raise FusionError(*error.problems, findings=rename_role(error.findings, GNSS, fixes_role)) from error


def _fuse(streams: Streams, config: FuseConfig, run_id: str, fixes_role: str) -> Track:
    """Fuse the streams of a run; ``fixes_role`` is the role of its positions, GNSS or pose."""
    run, read = Subject("run", run_id), streams.report
    # 1. Convert streams to sections of measurements with common frame and units and usable variances, and exclude
    # implausible sensors.
    streams, is_local = use_pose_as_fixes(streams)
    sections = exclude_other_clocks(prepare_sections(streams, config), streams)
    sections = find_clocks(drop_implausible_sensors(sections, streams))
    # 2. Find the initial state of each section; filter and smooth it.
    sections, fused, errors = fuse_sections(sections, streams, config)
    failures = merge_findings(finding for error in errors for finding in error.findings)
    if not fused.found:
        problems = [problem for error in errors for problem in error.problems] or ["no motion to fuse"]
        nothing = [] if errors else [_explain_missing_track(streams, sections, run)]
        raise FusionError(*problems, findings=(*failures, *nothing, *find_exclusions(sections)))
    columns = {name: np.concatenate([part[name] for part in fused.columns]) for name in fused.columns[0]}
    is_local |= bool(np.isnan(columns["lon_deg"]).all())
    if is_local:
        columns |= {name: np.full_like(columns[name], np.nan) for name in ("lon_deg", "lat_deg", "alt_m")}
    table = TRACK.table(**columns)
    origin = next((section.datum_deg_m for section in sections if section.datum_deg_m), None)
    datum = None if is_local or origin is None else Datum(*origin, crs=streams.gnss_crs)
    # 3. List excluded sensors, and findings on the other sensors.
    summary = make_fuse_facts(sections, fused.facts, rows=table.num_rows, skipped_s=fused.skipped_s)
    exclusions = find_exclusions(sections)
    is_antenna_alone = any(section.measurements.is_antenna_alone for section in sections)
    findings = (
        *find_fuse_findings(sections, summary, run=run),
        *(replace(finding, severity="warning") for finding in failures if finding.severity == "error"),
        *exclusions,
        *find_parameter_findings(sections, summary, streams),
        *([make_finding("direction-assumed", Subject("role", GNSS))] if is_antenna_alone else []),
        *find_offsets(sections, streams),
        *sections[0].cuts.values(),
    )
    facts: dict[str, Any] = {
        "fuse": summary,
        "sensor_checks": SensorChecks({finding.subject.name: finding.code for finding in reversed(exclusions)}),
        "clock_offsets": tuple(section.clocks for section in sections),
    }
    findings, facts = rename_role((findings, facts), GNSS, fixes_role)
    report = StageReport((*_update_read_findings(read.findings, findings), *findings), replace(read.facts, **facts))
    info = TrackInfo(run_id, streams.robot, datum, config.rate_hz, config.estimator, report)
    return Track(table, make_rejections_table(sections, fused.found, fixes_role), info)


def fuse_sections(
    sections: Sequence[Section], streams: Streams, config: FuseConfig
) -> tuple[list[Section], Fused, list[FusionError]]:
    """Return the sections after correction of clocks, their track, and the errors of sections without track.

    A section is fused again if its estimate finds that a corrected clock steps; the correction is then left out. A
    local frame continues from the end of the section before. If one section has positions on the earth, sections
    without fixes are skipped.
    """
    given, used, tracks, errors = [*sections], correct_clocks(sections, streams), list[Fused](), list[FusionError]()
    for place, section in enumerate(used):
        last = next((track.found[-1] for track in reversed(tracks) if track.found), None)
        tracks.append(_skip(section))
        try:
            tracks[place] = fuse_section(section, streams, config, last)
            changes = [change for facts in tracks[place].facts for change in facts.changes if change.kind == "clock"]
            unsteady = {change.role for change in changes} & section.offsets.keys()
            if unsteady:
                steady = {role: offset for role, offset in section.clocks.offsets.items() if role not in unsteady}
                given[place] = replace(given[place], clocks=replace(section.clocks, offsets=steady))
                used[place] = correct_clocks(given, streams)[place]
                tracks[place] = fuse_section(used[place], streams, config, last)
        except FusionError as error:
            errors.append(error)
    has_place = any(section.datum_deg_m and track.found for section, track in zip(used, tracks, strict=True))
    fused = Fused()
    for section, track in zip(used, tracks, strict=True):
        fused.append(_skip(section) if has_place and section.datum_deg_m is None else track)
    return used, fused, errors


def _skip(section: Section) -> Fused:
    return Fused(skipped_s=float(np.diff(section.span_ns)[0]) * 1e-9)


def _update_read_findings(read: tuple[Finding, ...], fused: tuple[Finding, ...]) -> Iterator[Finding]:
    """Yield the findings of reading; missing extrinsics lose their remedy if estimated, and are left out if unused."""
    estimated = {
        role for finding in fused for remedy in finding.remedies for role in remedy.recipe.get("read.extrinsics", ())
    }
    unneeded = {each.subject.name for each in select_findings(fused, "track-of-antenna", "imu-too-slow")}
    for finding in read:
        role = finding.subject.name if finding.code == "sensor-not-placed" else ""
        if role not in unneeded:
            yield replace(finding, remedies=()) if role in estimated else finding


def _explain_missing_track(streams: Streams, sections: Sequence[Section], run: Subject) -> Finding:
    rows: dict[str, Any] = {f"{role}_row_count": table.num_rows for role, table in streams.tables.items()}
    counts = add_counts(sections)
    rows |= {f"{role}_unusable_count": count["invalid"] for role, count in counts.items() if count["invalid"]}
    return make_finding("no-motion", run, **rows)
