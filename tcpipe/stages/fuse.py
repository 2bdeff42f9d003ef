"""Fuse: streams become one track of base_link, 20 times a second, with its uncertainty (L1 to L2)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import FusionError
from tcpipe.fusion.checks.audit import (
    count_confirmations,
    find_isolated_sensors,
    find_undecided_sensors,
    is_astray,
    is_consistent,
)
from tcpipe.fusion.checks.mounting import (
    ARM_STD_M,
    Arm,
    Tilt,
    level_imu,
    make_unknown_arm,
    move_antenna,
    solve_arm,
    solve_tilt,
)
from tcpipe.fusion.checks.odometry_scale import Scale, rescale_odometries, solve_scales
from tcpipe.fusion.checks.plausibility import SensorExclusion, refuse_fixes
from tcpipe.fusion.measurements import GNSS, IMU, Measurements
from tcpipe.recipe import FuseConfig
from tcpipe.stages.clock_findings import add_lag_on_path, add_offset_uncertainty, check_clocks
from tcpipe.stages.fuse_findings import find_fuse_findings, make_audit_findings, make_fuse_facts, make_mounting_findings
from tcpipe.stages.fuse_inputs import (
    FusionInputs,
    compute_moved_m,
    convert_pose_to_fixes,
    drop_implausible_sensors,
    exclude_sensors,
    find_recipe_role,
    prepare_inputs,
)
from tcpipe.stages.fuse_sections import Fused, fuse_sections, make_rejections_table
from tcpipe.tables.facts import SensorChecks
from tcpipe.tables.findings import Finding, StageReport, Subject, make_finding
from tcpipe.tables.levels import TRACK, Datum, Streams, Track, TrackInfo


def fuse_run(streams: Streams, config: FuseConfig, *, run_id: str) -> Track:
    """Return the track of a run; rows are in order of clock epoch and stamp.

    Each clock epoch, and each section between long pauses, is fused for itself. Stamps are multiples of the track's period; where no sensor
    measures motion for ``max_gap_s`` there are no rows, so a gap is a step in the stamps.

    Raises
    ------
    FusionError : no sensor measures motion, or the estimate breaks down.
    """
    # 1. A pose made elsewhere is what the fixes are.
    #    Streams become measurements: one frame, one set of units, usable variances; sensors that cannot be right are left out.
    streams, local = convert_pose_to_fixes(streams)
    run = Subject("run", run_id)
    inputs, sanity = drop_implausible_sensors(prepare_inputs(streams, config), streams)
    # 2. Each section for itself: where it starts, filter and smoother; again where that shows other mountings, or a sensor to be alone.
    inputs, sanity, fused = fuse_agreeing(inputs, sanity, streams, config, run=run)
    if not fused.found:
        raise FusionError("no motion to fuse", findings=(_find_nothing(streams, inputs, run), *sanity.findings))
    columns = {name: np.concatenate([part[name] for part in fused.columns]) for name in fused.columns[0]}
    if local:
        columns |= {name: np.full_like(columns[name], np.nan) for name in ("lon_deg", "lat_deg", "alt_m")}
    table = TRACK.table(**columns)
    datum = None if local or inputs.datum_deg_m is None else Datum(*inputs.datum_deg_m, crs=streams.gnss_crs)
    # 3. What was left out, where sensors disagree with the track, and whether their clocks agree.
    summary = make_fuse_facts(inputs, fused.facts, rows=table.num_rows, skipped_s=fused.skipped_s)
    clocks = add_lag_on_path(check_clocks(streams, inputs), fused, inputs, streams)
    table = add_offset_uncertainty(table, clocks.facts)
    mounting, audit = make_mounting_findings(inputs, streams), make_audit_findings(fused, inputs, streams)
    found = (sanity, mounting, audit, clocks)
    findings = (
        *find_fuse_findings(inputs, summary, run=run, fixes=find_recipe_role(GNSS, streams)),
        *(finding for each in found for finding in each.findings),
    )
    facts = replace(
        streams.report.facts,
        fuse=summary,
        sensor_checks=sanity.facts,
        mounting=mounting.facts,
        audit=audit.facts,
        clock_offsets=clocks.facts,
    )
    report = StageReport((*_drop_places(streams.report.findings, findings), *findings), facts)
    info = TrackInfo(run_id, streams.robot, datum, config.rate_hz, config.estimator, report)
    return Track(table, make_rejections_table(inputs, fused.found), info)


def _drop_places(read: tuple[Finding, ...], fused: tuple[Finding, ...]) -> Iterator[Finding]:
    """Yield the findings of reading; one without extrinsics suggests none where fusing has estimated them."""
    estimated = {role for finding in fused for of in finding.remedies for role in of.recipe.get("read.extrinsics", ())}
    for finding in read:
        is_estimated = finding.code == "sensor-not-placed" and finding.subject.name in estimated
        yield replace(finding, remedies=()) if is_estimated else finding


def _find_nothing(streams: Streams, inputs: FusionInputs, run: Subject) -> Finding:
    rows: dict[str, Any] = {f"{role}_row_count": table.num_rows for role, table in streams.tables.items()}
    rows |= {f"{role}_unusable_count": count["invalid"] for role, count in inputs.counts.items() if count["invalid"]}
    return make_finding("no-motion", run, **rows)


Judged = tuple[FusionInputs, StageReport[SensorChecks]]


def fuse_agreeing(
    inputs: FusionInputs, sanity: StageReport[SensorChecks], streams: Streams, config: FuseConfig, *, run: Subject
) -> tuple[FusionInputs, StageReport[SensorChecks], Fused]:
    """Fuse each section; where sensors contradict each other over most of the distance, again without the one that is at fault.

    The sensor that differs from the others is not always the wrong one: an IMU whose bias has jumped leads the track and the odometries
    away from the fixes. So each sensor is excluded for a trial, also where the track contradicts every sensor. Corrections of extrinsics
    and scales that such a track showed are discarded.

    Raises
    ------
    FusionError : the track contradicts every sensor, whichever is excluded.
    """
    found, fused = fuse_mounted(inputs, streams, config)
    lone, astray = find_isolated_sensors(fused.tallies), is_astray(fused.windows, fused.astray)
    if lone or astray or find_undecided_sensors(fused.tallies):
        lone = _find_fault(inputs, sanity, streams, config, astray=astray) or lone
        if lone:
            inputs, sanity = _without(lone, inputs, sanity, streams, astray=astray)
            found, fused = fuse_mounted(inputs, streams, config)
    if is_astray(fused.windows, fused.astray):
        astray_fraction = fused.astray / fused.windows
        finding = make_finding("track-contradicts-sensors", run, astray_fraction=astray_fraction)
        raise FusionError("the track contradicts every sensor", findings=(finding, *sanity.findings))
    return found, sanity, fused


def _without(
    roles: Sequence[str], inputs: FusionInputs, sanity: StageReport[SensorChecks], streams: Streams, *, astray: bool
) -> Judged:
    code = "misleads-track" if astray else "contradicted-by-others"
    odometries = {name for m in inputs.measurements.values() for name in m.odometries()}.difference(roles)
    refusals = [refuse_fixes(code, odometries) if role == GNSS else SensorExclusion(role, code) for role in roles]
    return exclude_sensors(inputs, sanity, refusals, streams)


def _find_fault(
    inputs: FusionInputs, sanity: StageReport[SensorChecks], streams: Streams, config: FuseConfig, *, astray: bool
) -> tuple[str, ...]:
    """Return the one sensor without which the others agree; of several the one whose others confirm each other most, none of two equals.

    Where the track is ``astray``, it is the IMU, of which the process is made, if the track recovers without it; else the only sensor
    without which it recovers.
    """
    roles = sorted({role for m in inputs.measurements.values() for role in m.sensors()})
    if len(roles) <= 2 and not astray:
        return ()
    agreeing: dict[str, int] = {}
    following: list[str] = []
    for role in roles:
        rest, _ = _without([role], inputs, sanity, streams, astray=astray)
        if any(m.gnss is not None or m.odometries() for m in rest.measurements.values()):
            tried = fuse_sections(rest, streams, config)
            if tried.tallies and is_consistent(tried.tallies):
                agreeing[role] = count_confirmations(tried.tallies)
            if tried.found and not is_astray(tried.windows, tried.astray):
                following.append(role)
    best = [role for role, confirmed in agreeing.items() if confirmed == max(agreeing.values())]
    if astray and (len(best) != 1 or best[0] not in following):
        best = [IMU] if IMU in following else following
    return (best[0],) if len(best) == 1 else ()


_ROUNDS = 3
_SURE = 4.0  # standard deviations
_SURE_OF_ARM = 4.0
_LEAST_TILT_RAD = np.radians(1.0)
_MOST_TILT_RAD = np.radians(30.0)  # an IMU that is turned further is told by gravity, before anything is fused
_LEAST_ARM_M = 0.1
_SETTLED_M = 0.02
_SETTLED_RAD = np.radians(0.2)
_STATED_HEIGHT_STD_M = 0.05
_ANTENNA = slice(0, 2)  # what the turns show: forward and left


def fuse_mounted(inputs: FusionInputs, streams: Streams, config: FuseConfig) -> tuple[FusionInputs, Fused]:
    """Fuse each section, and again as long as that shows an antenna or an IMU to be mounted, or an odometry to be scaled, otherwise."""
    fused = fuse_sections(inputs, streams, config)
    for _ in range(_ROUNDS):
        mended = _correct_mounting(inputs, fused, streams)
        if mended is None:
            break
        inputs, fused = mended, fuse_sections(mended, streams, config)
    return inputs, fused


def _correct_mounting(inputs: FusionInputs, fused: Fused, streams: Streams) -> FusionInputs | None:
    """Return the inputs with the extrinsics and scales that a track shows; None where all have settled."""
    tilt = _find_tilt(inputs, fused)
    turn = np.zeros(2) if tilt is None else tilt.rad
    arm, move_m = _find_lever_arm(inputs, fused, streams, trusted=tilt is None)
    scales = solve_scales(fused.ratios)
    if tilt is None and arm is None and not scales:
        return None
    mended = {epoch: _apply_mounting(m, turn, move_m, scales) for epoch, m in inputs.measurements.items()}
    if tilt is not None and inputs.imu_tilt is not None:
        tilt = replace(tilt, rad=tilt.rad + inputs.imu_tilt.rad)
    arm, tilt = arm or inputs.arm, tilt or inputs.imu_tilt
    scales = {role: scale.after(inputs.scales.get(role)) for role, scale in scales.items()}
    return replace(inputs, measurements=mended, arm=arm, imu_tilt=tilt, scales={**inputs.scales, **scales})


def _find_tilt(inputs: FusionInputs, fused: Fused) -> Tilt | None:
    """Return by how much the IMU is still to be turned; None where it stays."""
    tilt = solve_tilt(fused.tilts)
    if tilt is None:
        return None
    known = np.zeros(2) if inputs.imu_tilt is None else inputs.imu_tilt.rad
    least = np.where(known != 0.0, _SETTLED_RAD, np.maximum(_LEAST_TILT_RAD, _SURE * tilt.std_rad))
    told = (np.abs(tilt.rad) > least) & (np.abs(tilt.rad + known) < _MOST_TILT_RAD)
    turned = np.where(told, tilt.rad, 0.0)
    return replace(tilt, rad=turned) if turned.any() else None


def _find_lever_arm(
    inputs: FusionInputs, fused: Fused, streams: Streams, *, trusted: bool
) -> tuple[Arm | None, NDArray[np.float64]]:
    """Return the antenna's arm and by how much to move it; None and zeros where it stays.

    A stated arm is judged only by a track whose attitude is ``trusted``.
    """
    nothing = np.zeros(3)
    if inputs.datum_deg_m is None or GNSS not in streams.sensors:
        return None, nothing
    unknown = streams.sensors[GNSS].placed_by == "assumed"
    moved = compute_moved_m(inputs, streams)
    height_std_m = ARM_STD_M if unknown else _STATED_HEIGHT_STD_M
    arm = solve_arm(fused.arms, moved, height_std_m=height_std_m) or (make_unknown_arm() if unknown else None)
    if arm is None:
        return None, nothing
    if inputs.arm is None and not unknown and not (trusted and _is_contradicted(arm)):
        return None, nothing
    move_m = arm.error[:3] - moved
    if inputs.arm is not None and float(np.linalg.norm(move_m[_ANTENNA])) < _SETTLED_M:
        return None, nothing
    return arm, move_m


def _is_contradicted(arm: Arm) -> bool:
    """Return whether the turns show an antenna elsewhere than it is stated to be."""
    aside = arm.error[_ANTENNA]
    squared = float(aside @ np.linalg.solve(arm.covariance[_ANTENNA, _ANTENNA], aside))
    return squared > _SURE_OF_ARM**2 and float(np.linalg.norm(aside)) > _LEAST_ARM_M


def _apply_mounting(
    m: Measurements, turn_rad: NDArray[np.float64], move_m: NDArray[np.float64], scales: Mapping[str, Scale]
) -> Measurements:
    return replace(
        rescale_odometries(m, scales),
        imu=None if m.imu is None else level_imu(m.imu, turn_rad) if turn_rad.any() else m.imu,
        gnss=None if m.gnss is None else move_antenna(m.gnss, move_m),
    )
