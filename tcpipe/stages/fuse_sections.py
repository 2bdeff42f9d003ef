"""Fuse each section of a run: initial state, filter and smoother, and further columns of the track."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Floats, Ints
from tcpipe.fusion.checks.clock_offsets import NOTED_S
from tcpipe.fusion.checks.sanity import Command
from tcpipe.fusion.error_state import run_error_state
from tcpipe.fusion.initial import find_initial_state, find_stationary_intervals
from tcpipe.fusion.measurements import (
    DISPLACEMENT_LAGS_S,
    GNSS,
    BodyVelocities,
    InitialState,
    TrackSection,
    Trajectory,
    cut_sections,
    make_track_stamps,
)
from tcpipe.fusion.signals import Signal, compute_seconds, hold_last, is_covered
from tcpipe.geometry.datum import geodetic_from_enu
from tcpipe.geometry.rotation import matrix_from_quat, rpy_from_matrix
from tcpipe.power.rails import compute_power_at
from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse_inputs import Section, rank_sections
from tcpipe.stages.message_arrays import make_rails
from tcpipe.tables.facts import SectionFacts
from tcpipe.tables.findings import Finding
from tcpipe.tables.levels import REJECTIONS, Streams


@dataclass(slots=True)
class Fused:
    """Trajectories, facts and columns of all sections; time without track [s]."""

    found: list[Trajectory] = field(default_factory=list)
    facts: list[SectionFacts] = field(default_factory=list)
    columns: list[Mapping[str, Signal]] = field(default_factory=list)
    skipped_s: float = 0.0

    def append(self, other: Fused) -> None:
        """Append the track of a later section."""
        for name in (entry.name for entry in fields(self)):
            setattr(self, name, getattr(self, name) + getattr(other, name))


def fuse_section(section: Section, streams: Streams, config: FuseConfig, last: Trajectory | None = None) -> Fused:
    """Fuse each part of a section between pauses; a local frame continues from the end of ``last``, the last track."""
    fused = Fused()
    period_ns, max_gap_ns = round(1e9 / config.rate_hz), int(config.max_gap_s * 1e9)
    for part in cut_sections({section.clock_epoch: section.measurements}, tuple(section.cuts)):
        m, output_ns = part.measurements, make_track_stamps(part, period_ns=period_ns, max_gap_ns=max_gap_ns)
        if output_ns.size == 0 or (section.datum_deg_m is not None and m.gnss is None):
            fused.skipped_s += (part.end_ns - part.start_ns) * 1e-9
            continue
        # 1. Find the initial state.
        initial = find_initial_state(m, find_stationary_intervals(m), part.start_ns)
        if last is not None and section.datum_deg_m is None:
            initial = replace(initial, position_enu_m=last.position_enu_m[-1], quat_xyzw=last.quat_xyzw[-1])
        # 2. Filter and smooth.
        trajectory = _estimate(part, initial, output_ns, config)
        fused.found.append(trajectory)
        fused.facts.append(make_section_facts(part, initial, trajectory))
        # 3. Compute other quantities at the track's stamps.
        fused.columns.append(_make_columns(part, trajectory, section, streams, config))
        last = trajectory
    return fused


def _estimate(section: TrackSection, initial: InitialState, output_ns: Ints, config: FuseConfig) -> Trajectory:
    if config.estimator == "ukf":
        from tcpipe.fusion.ukf15 import run_ukf15 as run  # noqa: PLC0415  filterpy takes a second to load
    else:
        run = run_error_state
    return run(section.measurements, initial, output_ns=output_ns, gate_probability=config.gate_probability)


def _make_columns(
    part: TrackSection, trajectory: Trajectory, section: Section, streams: Streams, config: FuseConfig
) -> dict[str, Signal]:
    stamp_ns, gap_ns, power_gap_ns = trajectory.stamp_ns, int(config.max_gap_s * 1e9), int(config.max_power_gap_s * 1e9)
    return {
        "stamp_ns": stamp_ns,
        "clock_epoch": np.full(stamp_ns.size, section.clock_epoch, np.int16),
        **make_pose_columns(trajectory, section.datum_deg_m),
        "wheel_velocity_mps": make_wheel_column(part.measurements.wheels, stamp_ns, max_gap_ns=gap_ns),
        **make_command_columns(section.command, stamp_ns),
        **make_power_columns(streams, section.clock_epoch, stamp_ns, max_gap_ns=power_gap_ns),
    }


Arrays = dict[str, Floats]


def make_pose_columns(found: Trajectory, datum_deg_m: tuple[float, float, float] | None) -> Arrays:
    """Return pose, twist and their standard deviations; longitude, latitude and height are NaN in a local frame."""
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


def make_wheel_column(wheels: BodyVelocities | None, at_ns: Ints, *, max_gap_ns: int) -> Floats:
    """Return the wheels' forward velocity, interpolated; NaN in gaps."""
    if wheels is None:
        return np.full(at_ns.size, np.nan)
    zero = int(wheels.stamp_ns[0])
    between = np.interp(compute_seconds(at_ns, zero), compute_seconds(wheels.stamp_ns, zero), wheels.velocity_mps[:, 0])
    return np.where(is_covered(wheels.stamp_ns, at_ns, at_ns, least_ns=max_gap_ns), between, np.nan)


def make_command_columns(command: Command | None, at_ns: Ints) -> Arrays:
    """Return the last command at each stamp; NaN before the first, during a dropout, and without commands."""
    none = np.empty(0)
    command = command or Command(np.empty(0, np.int64), none, none)
    return {
        "commanded_velocity_mps": hold_last(command.stamp_ns, command.forward_velocity_mps, at_ns),
        "commanded_yaw_rate_radps": hold_last(command.stamp_ns, command.yaw_rate_radps, at_ns),
    }


def make_power_columns(streams: Streams, epoch: int, at_ns: Ints, *, max_gap_ns: int) -> Arrays:
    """Return voltage, current and power at each stamp; NaN in power gaps and without power."""
    values = compute_power_at(make_rails(streams, epoch), at_ns, max_gap_ns=max_gap_ns)
    return dict(zip(("voltage_volt", "current_amp", "power_watt"), values, strict=True))


def make_rejections_table(sections: Sequence[Section], found: Sequence[Trajectory], fixes: str = GNSS) -> pa.Table:
    """Return all measurements that the gate rejected or that are unusable, by time; ``fixes`` is the role of fixes."""
    parts = [trajectory.rejections for trajectory in found]
    invalid = [(role, each.invalid_ns) for section in sections for role, each in sorted(section.prepared.items())]
    size = sum(stamps.size for _, stamps in invalid)
    unknown = np.full(size, np.nan)
    unusable = {
        "stamp_ns": [stamps for _, stamps in invalid],
        "role": [np.full(stamps.size, role) for role, stamps in invalid],
        "reason": [np.full(size, "invalid")],
        "normalized_innovation_squared": [unknown],
        "threshold": [unknown],
    }
    joined = {name: np.concatenate([p[name] for p in parts] + values) for name, values in unusable.items()}
    joined["role"] = np.where(joined["role"] == GNSS, fixes, joined["role"])
    order = np.lexsort((joined["role"], joined["stamp_ns"]))
    return REJECTIONS.table(**{name: values[order] for name, values in joined.items()})


def make_section_facts(section: TrackSection, initial: InitialState, found: Trajectory) -> SectionFacts:
    """Return the facts of one section: results of the filter, its time span and its start."""
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


def find_exclusions(sections: Sequence[Section]) -> list[Finding]:
    """Return the findings of excluded sensors; equal findings of several sections are merged over their time span."""
    return merge_findings(finding for place in rank_sections(sections) for finding in sections[place].excluded.values())


def merge_findings(findings: Iterable[Finding]) -> list[Finding]:
    """Merge findings of several sections that have the same code and subject; the numbers are those of the first.

    Time offsets that differ are not merged and have no remedy, because the recipe can state only one.
    """
    merged: list[Finding] = []
    for finding in findings:
        for place, first in enumerate(merged):
            off_s = finding.numbers.get("offset_s", 0.0) - first.numbers.get("offset_s", 0.0)
            if (first.code, first.subject) == (finding.code, finding.subject) and abs(off_s) < 2.0 * NOTED_S:
                spans = [each.span_s for each in (first, finding) if each.span_s is not None]
                span_s = (min(start for start, _ in spans), max(end for _, end in spans)) if spans else None
                merged[place] = replace(first, span_s=span_s)
                break
        else:
            merged.append(finding)
    offsets = Counter(finding.subject for finding in merged if "offset_s" in finding.numbers)
    return [replace(each, remedies=()) if offsets[each.subject] > 1 else each for each in merged]
