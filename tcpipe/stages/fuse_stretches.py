"""Each stretch of a run from its start to its track: where it begins, filter and smoother, and what else is known at its stamps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.audit import Tally, audited
from tcpipe.fusion.checks.mounting import (
    ArmEvidence,
    TiltEvidence,
    antenna_doubt,
    arm_evidence,
    tilt_evidence,
    with_antenna_doubt,
)
from tcpipe.fusion.checks.odometry_scale import way_ratios
from tcpipe.fusion.error_state import run_error_state
from tcpipe.fusion.initial import find_initial_state
from tcpipe.fusion.measurements import InitialState
from tcpipe.fusion.standing import standing_intervals
from tcpipe.fusion.stretches import Stretch, cut_stretches, track_stamps
from tcpipe.fusion.trajectory import Trajectory
from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse_columns import command_columns, pose_columns, power_columns, wheel_column
from tcpipe.stages.fuse_findings import stretch_facts
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.tables.facts import Disagreement, StretchFacts
from tcpipe.tables.levels import Streams


@dataclass(slots=True)
class Fused:
    """Every stretch's trajectory, facts and columns, its audit, what it tells of mountings; how long no track could be placed [s]."""

    found: list[Trajectory] = field(default_factory=list)
    facts: list[StretchFacts] = field(default_factory=list)
    columns: list[Mapping[str, NDArray[Any]]] = field(default_factory=list)
    disagreements: list[Disagreement] = field(default_factory=list)
    tallies: list[Tally] = field(default_factory=list)
    windows: int = 0
    astray: int = 0
    arms: list[ArmEvidence | None] = field(default_factory=list)
    tilts: list[TiltEvidence | None] = field(default_factory=list)
    ratios: list[Mapping[str, NDArray[np.float64]]] = field(default_factory=list)
    skipped_s: float = 0.0


def fuse_stretches(inputs: FusionInputs, streams: Streams, config: FuseConfig) -> Fused:
    """Fuse each stretch for itself, in order of epoch and stamp."""
    fused = Fused()
    period_ns, max_gap_ns = round(1e9 / config.rate_hz), int(config.max_gap_s * 1e9)
    for stretch in cut_stretches(inputs.measurements):
        output_ns = track_stamps(stretch, period_ns=period_ns, max_gap_ns=max_gap_ns)
        if output_ns.size == 0 or (inputs.datum_deg_m is not None and stretch.measurements.gnss is None):
            fused.skipped_s += (stretch.end_ns - stretch.start_ns) * 1e-9
            continue
        # 1. Where it starts; a local frame goes on from where the last stretch ended.
        initial = _initial(stretch, fused.found[-1] if fused.found and inputs.datum_deg_m is None else None)
        # 2. Filter and smoother.
        trajectory = _estimate(stretch, initial, output_ns, config)
        # 3. What it tells of how antenna and IMU are mounted and odometries scaled, and what nobody knows of it.
        fused.arms.append(arm_evidence(trajectory, stretch.measurements))
        fused.tilts.append(tilt_evidence(trajectory, stretch.measurements))
        fused.ratios.append(way_ratios(trajectory, stretch.measurements))
        trajectory = _doubted(trajectory, stretch, inputs)
        # 4. What came out is held against what went in.
        trajectory, audit = audited(trajectory, stretch.measurements)
        fused.disagreements += (replace(each, epoch=stretch.epoch) for each in audit.disagreements)
        fused.tallies += audit.tallies
        fused.windows, fused.astray = fused.windows + audit.windows, fused.astray + audit.astray
        fused.found.append(trajectory)
        fused.facts.append(stretch_facts(stretch, initial, trajectory))
        # 5. What else is known at the track's stamps.
        fused.columns.append(_columns(stretch, trajectory, inputs, streams, config))
    return fused


def _doubted(found: Trajectory, stretch: Stretch, inputs: FusionInputs) -> Trajectory:
    """Return the trajectory with what is not known of a mended or unstated mounting."""
    gnss = stretch.measurements.gnss
    covariance = None if gnss is None else antenna_doubt(inputs.arm, inputs.imu_tilt, gnss.lever_arm_m)
    return found if gnss is None or covariance is None else with_antenna_doubt(found, covariance, gnss)


def _initial(stretch: Stretch, last: Trajectory | None) -> InitialState:
    m = stretch.measurements
    initial = find_initial_state(m, standing_intervals(m), stretch.start_ns)
    if last is None:
        return initial
    return replace(initial, position_enu_m=last.position_enu_m[-1], quat_xyzw=last.quat_xyzw[-1])


def _estimate(stretch: Stretch, initial: InitialState, output_ns: NDArray[np.int64], config: FuseConfig) -> Trajectory:
    gate = config.gate_probability
    if config.estimator == "ukf":
        from tcpipe.fusion.ukf15 import run_ukf15  # noqa: PLC0415  its kernels load only when it is asked for

        return run_ukf15(
            stretch.measurements, initial, output_ns=output_ns, gate_probability=gate, engine=config.engine
        )
    return run_error_state(stretch.measurements, initial, output_ns=output_ns, gate_probability=gate)


def _columns(
    stretch: Stretch, trajectory: Trajectory, inputs: FusionInputs, streams: Streams, config: FuseConfig
) -> dict[str, NDArray[Any]]:
    stamp_ns, gap_ns, power_gap_ns = trajectory.stamp_ns, int(config.max_gap_s * 1e9), int(config.max_power_gap_s * 1e9)
    return {
        "stamp_ns": stamp_ns,
        "epoch": np.full(stamp_ns.size, stretch.epoch, np.int16),
        **pose_columns(trajectory, inputs.datum_deg_m),
        "wheel_velocity_mps": wheel_column(stretch.measurements.wheels, stamp_ns, max_gap_ns=gap_ns),
        **command_columns(streams, stretch.epoch, stamp_ns),
        **power_columns(streams, stretch.epoch, stamp_ns, max_gap_ns=power_gap_ns),
    }
