"""Fuse: streams become one track of base_link, 20 times a second, with its uncertainty (L1 to L2).

Each section of a run is fused for itself, from where it begins. Time offsets between the clocks of sensors are taken out before fusion.
Power is not fused, and its stamps stay as they are.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import FusionError
from tcpipe.fusion.checks.audit import audit_trajectory, is_astray
from tcpipe.fusion.checks.clock_offsets import POWER, PowerSignal, find_clock_offsets, find_middle_ns, shift_stamps
from tcpipe.fusion.checks.sanity import SensorExclusion, make_fix_exclusion
from tcpipe.fusion.error_state import run_error_state
from tcpipe.fusion.initial import find_initial_state, find_stationary_intervals
from tcpipe.fusion.measurements import (
    DISPLACEMENT_LAGS_S,
    DOPPLER,
    GNSS,
    IMU,
    BodyVelocities,
    InitialState,
    TrackSection,
    Trajectory,
    cut_sections,
    make_track_stamps,
)
from tcpipe.fusion.signals import compute_seconds, hold_last, is_covered
from tcpipe.geometry.datum import geodetic_from_enu
from tcpipe.geometry.rotation import matrix_from_quat, rpy_from_matrix
from tcpipe.logs.clocks import LOG_CLOCK
from tcpipe.power.rails import compute_power_at
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
from tcpipe.stages.message_arrays import make_rails
from tcpipe.tables.arrays import select_rows
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.facts import ClockFacts, ClockOffset, Disagreement, SensorChecks, StretchFacts
from tcpipe.tables.findings import Action, Finding, StageReport, Subject, make_finding
from tcpipe.tables.levels import REJECTIONS, TRACK, Datum, Streams, Track, TrackInfo


def fuse_run(streams: Streams, config: FuseConfig, *, run_id: str) -> Track:
    """Return the track of a run; rows are in order of clock epoch and stamp.

    Each clock epoch, and each section between long pauses, is fused for itself. Stamps are multiples of the track's period; where no sensor
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
    audit = make_audit_findings(fused.disagreements, fused.facts, used, streams)
    findings = (
        *find_fuse_findings(used, summary, run=run),
        *used.excluded.values(),
        *find_parameter_findings(used, summary, streams),
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
    """Yield the findings of reading; one without extrinsics suggests none where fusing has estimated them."""
    estimated = {role for finding in fused for of in finding.remedies for role in of.recipe.get("read.extrinsics", ())}
    for finding in read:
        is_estimated = finding.code == "sensor-not-placed" and finding.subject.name in estimated
        yield replace(finding, remedies=()) if is_estimated else finding


def _find_nothing(streams: Streams, inputs: FusionInputs, run: Subject) -> Finding:
    rows: dict[str, Any] = {f"{role}_row_count": table.num_rows for role, table in streams.tables.items()}
    rows |= {f"{role}_unusable_count": count["invalid"] for role, count in inputs.counts.items() if count["invalid"]}
    return make_finding("no-motion", run, **rows)


def fuse_recovering(
    inputs: FusionInputs, streams: Streams, config: FuseConfig, *, run: Subject
) -> tuple[FusionInputs, Fused]:
    """Fuse each section; where the track contradicts every sensor, again without the one that misleads it.

    That is the IMU, which carries the state from tick to tick, if the track recovers without it; else the only sensor without which it
    does.

    Raises `FusionError`: the track contradicts every sensor, whichever is excluded.
    """
    fused = fuse_sections(inputs, streams, config)
    if not is_astray(fused.windows, fused.astray):
        return inputs, fused
    recovered = {}
    for role in sorted({role for m in inputs.measurements.values() for role in m.sensors()}):
        rest = _exclude_misleading(role, inputs, streams)
        if any(m.gnss is not None or m.odometries() for m in rest.measurements.values()):
            tried = fuse_sections(rest, streams, config)
            if tried.found and not is_astray(tried.windows, tried.astray):
                recovered[role] = rest, tried
    if IMU in recovered:
        return recovered[IMU]
    if len(recovered) == 1:
        return next(iter(recovered.values()))
    finding = make_finding("track-contradicts-sensors", run, astray_fraction=fused.astray / fused.windows)
    raise FusionError("the track contradicts every sensor", findings=(finding, *inputs.excluded.values()))


def _exclude_misleading(role: str, inputs: FusionInputs, streams: Streams) -> FusionInputs:
    odometries = {name for m in inputs.measurements.values() for name in m.odometries()}.difference({role})
    code = "misleads-track"
    exclusion = make_fix_exclusion(code, odometries) if role == GNSS else SensorExclusion(role, code)
    return exclude_sensors(inputs, [exclusion], streams)


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


# Sections


@dataclass(slots=True)
class Fused:
    """Every section's trajectory, facts, columns and audit; time without a track [s]."""

    found: list[Trajectory] = field(default_factory=list)
    facts: list[StretchFacts] = field(default_factory=list)
    columns: list[Mapping[str, NDArray[Any]]] = field(default_factory=list)
    disagreements: list[Disagreement] = field(default_factory=list)
    windows: int = 0
    astray: int = 0
    skipped_s: float = 0.0


def fuse_sections(inputs: FusionInputs, streams: Streams, config: FuseConfig) -> Fused:
    """Fuse each section for itself, in order of epoch and stamp."""
    fused = Fused()
    period_ns, max_gap_ns = round(1e9 / config.rate_hz), int(config.max_gap_s * 1e9)
    for section in cut_sections(inputs.measurements, inputs.cuts_ns):
        output_ns = make_track_stamps(section, period_ns=period_ns, max_gap_ns=max_gap_ns)
        if output_ns.size == 0 or (inputs.datum_deg_m is not None and section.measurements.gnss is None):
            fused.skipped_s += (section.end_ns - section.start_ns) * 1e-9
            continue
        # 1. Where it starts; a local frame goes on from where the last section ended.
        initial = _make_initial_state(section, fused.found[-1] if fused.found and inputs.datum_deg_m is None else None)
        # 2. Filter and smoother.
        trajectory = _estimate(section, initial, output_ns, config)
        # 3. What came out is held against what went in.
        trajectory, audit = audit_trajectory(trajectory, trajectory.corrected or section.measurements)
        fused.disagreements += (replace(each, clock_epoch=section.clock_epoch) for each in audit.disagreements)
        fused.windows, fused.astray = fused.windows + audit.windows, fused.astray + audit.astray
        fused.found.append(trajectory)
        fused.facts.append(make_section_facts(section, initial, trajectory))
        # 4. What else is known at the track's stamps.
        fused.columns.append(_make_columns(section, trajectory, inputs, streams, config))
    return fused


def _make_initial_state(section: TrackSection, last: Trajectory | None) -> InitialState:
    m = section.measurements
    initial = find_initial_state(m, find_stationary_intervals(m), section.start_ns)
    if last is None:
        return initial
    return replace(initial, position_enu_m=last.position_enu_m[-1], quat_xyzw=last.quat_xyzw[-1])


def _estimate(
    section: TrackSection, initial: InitialState, output_ns: NDArray[np.int64], config: FuseConfig
) -> Trajectory:
    gate = config.gate_probability
    if config.estimator == "ukf":
        from tcpipe.fusion.ukf15 import run_ukf15  # noqa: PLC0415  scipy.linalg takes a while to load

        return run_ukf15(section.measurements, initial, output_ns=output_ns, gate_probability=gate)
    return run_error_state(section.measurements, initial, output_ns=output_ns, gate_probability=gate)


def _make_columns(
    section: TrackSection, trajectory: Trajectory, inputs: FusionInputs, streams: Streams, config: FuseConfig
) -> dict[str, NDArray[Any]]:
    stamp_ns, gap_ns, power_gap_ns = trajectory.stamp_ns, int(config.max_gap_s * 1e9), int(config.max_power_gap_s * 1e9)
    return {
        "stamp_ns": stamp_ns,
        "clock_epoch": np.full(stamp_ns.size, section.clock_epoch, np.int16),
        **make_pose_columns(trajectory, inputs.datum_deg_m),
        "wheel_velocity_mps": make_wheel_column(section.measurements.wheels, stamp_ns, max_gap_ns=gap_ns),
        **make_command_columns(streams, section.clock_epoch, stamp_ns),
        **make_power_columns(streams, section.clock_epoch, stamp_ns, max_gap_ns=power_gap_ns),
    }


Arrays = dict[str, NDArray[np.float64]]


def make_pose_columns(found: Trajectory, datum_deg_m: tuple[float, float, float] | None) -> Arrays:
    """Return pose, twist and their deviations; longitude, latitude and height are NaN in a local frame."""
    rotation = matrix_from_quat(found.quat_xyzw)
    rpy = rpy_from_matrix(rotation)
    columns = {f"{name}_rad": rpy[:, k] for k, name in enumerate(("roll", "pitch", "yaw"))}
    for k, (axis, name) in enumerate(zip("xyz", ("east", "north", "up"), strict=True)):
        columns[f"{axis}_m"] = found.position_enu_m[:, k]
        columns[f"{axis}_std_m"] = found.position_std_m[:, k]
        columns[f"{name}_velocity_mps"] = found.velocity_enu_mps[:, k]
    unknown = np.full(found.stamp_ns.size, np.nan)
    place = (unknown,) * 3
    if datum_deg_m is not None:
        place = geodetic_from_enu(found.position_enu_m, datum_deg_m=datum_deg_m)
    columns |= dict(zip(("lon_deg", "lat_deg", "alt_m"), place, strict=True))
    columns["forward_velocity_mps"] = np.sum(rotation[:, :, 0] * found.velocity_enu_mps, axis=1)
    columns["yaw_rate_radps"] = found.angular_velocity_radps[:, 2]
    columns["yaw_std_rad"] = found.yaw_std_rad
    columns["forward_velocity_std_mps"] = found.forward_velocity_std_mps
    for k, lag_s in enumerate(DISPLACEMENT_LAGS_S):
        name = f"{lag_s:.0f}s" if lag_s >= 1 else f"{1e3 * lag_s:.0f}ms"
        columns[f"displacement_std_{name}_m"] = found.displacement_std_m[:, k]
    return columns


def make_wheel_column(
    wheels: BodyVelocities | None, at_ns: NDArray[np.int64], *, max_gap_ns: int
) -> NDArray[np.float64]:
    """Return the wheels' forward velocity, interpolated; NaN in gaps."""
    if wheels is None:
        return np.full(at_ns.size, np.nan)
    zero = int(wheels.stamp_ns[0])
    between = np.interp(compute_seconds(at_ns, zero), compute_seconds(wheels.stamp_ns, zero), wheels.velocity_mps[:, 0])
    return np.where(is_covered(wheels.stamp_ns, at_ns, at_ns, least_ns=max_gap_ns), between, np.nan)


def make_command_columns(streams: Streams, epoch: int, at_ns: NDArray[np.int64]) -> Arrays:
    """Return the last command at each stamp; NaN before the first and without commands."""
    table = streams.tables.get("command")
    names = {"commanded_velocity_mps": "forward_velocity_mps", "commanded_yaw_rate_radps": "yaw_rate_radps"}
    if table is None:
        return {name: np.full(at_ns.size, np.nan) for name in names}
    table = select_rows(table, "clock_epoch", epoch)
    stamp_ns = to_integers(table, "stamp_ns")
    return {name: hold_last(stamp_ns, to_floats(table, source), at_ns) for name, source in names.items()}


def make_power_columns(streams: Streams, epoch: int, at_ns: NDArray[np.int64], *, max_gap_ns: int) -> Arrays:
    """Return voltage, current and power at each stamp; NaN in power gaps and without power."""
    values = compute_power_at(make_rails(streams, epoch), at_ns, max_gap_ns=max_gap_ns)
    return dict(zip(("voltage_volt", "current_amp", "power_watt"), values, strict=True))


def make_rejections_table(inputs: FusionInputs, found: list[Trajectory], fixes: str = GNSS) -> pa.Table:
    """Return every refused measurement in order of time: by the gate, and those without a usable value; ``fixes`` is a role's name."""
    parts = [trajectory.rejections for trajectory in found]
    invalid = [(role, np.concatenate(stamps)) for role, stamps in sorted(inputs.invalid_ns.items())]
    size = sum(stamps.size for _, stamps in invalid)
    unknown = np.full(size, np.nan)
    columns = {
        "stamp_ns": [p.stamp_ns for p in parts] + [stamps for _, stamps in invalid],
        "role": [p.role for p in parts] + [np.full(stamps.size, role) for role, stamps in invalid],
        "reason": [p.reason for p in parts] + [np.full(size, "invalid")],
        "normalized_innovation_squared": [p.normalized_innovation_squared for p in parts] + [unknown],
        "threshold": [p.threshold for p in parts] + [unknown],
    }
    joined = {name: np.concatenate(values) for name, values in columns.items()}
    joined["role"] = np.where(joined["role"] == GNSS, fixes, joined["role"])
    order = np.lexsort((joined["role"], joined["stamp_ns"]))
    return REJECTIONS.table(**{name: values[order] for name, values in joined.items()})


def make_section_facts(section: TrackSection, initial: InitialState, found: Trajectory) -> StretchFacts:
    """Return the facts of one section: the filter's, and where it lies and began."""
    m = section.measurements
    return replace(
        found.facts,
        clock_epoch=section.clock_epoch,
        start_ns=section.start_ns,
        end_ns=section.end_ns,
        rows=int(found.stamp_ns.size),
        sensors=tuple(m.sensors()),
        gyro_noise_radps=None if m.imu is None else m.imu.gyro_std_radps,
        heading_from=initial.heading_from,
    )
