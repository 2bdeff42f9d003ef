"""Fuse: streams become one track of base_link, 20 times a second, with its uncertainty (L1 to L2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import FusionError
from tcpipe.fusion.error_state import run_error_state
from tcpipe.fusion.initial import find_initial_state
from tcpipe.fusion.measurements import InitialState
from tcpipe.fusion.standing import standing_intervals
from tcpipe.fusion.stretches import Stretch, cut_stretches, track_stamps
from tcpipe.fusion.trajectory import Trajectory
from tcpipe.fusion.ukf15 import run_ukf15
from tcpipe.recipe import FuseConfig
from tcpipe.stages.clock_doctor import clock_findings
from tcpipe.stages.fuse_columns import command_columns, pose_columns, power_columns, wheel_column
from tcpipe.stages.fuse_findings import fuse_facts, fuse_warnings, rejections_table, stretch_facts
from tcpipe.stages.fuse_inputs import Inputs, prepare_inputs
from tcpipe.stages.fuse_sanity import sane_inputs
from tcpipe.tables.levels import TRACK, Datum, Streams, Track, TrackInfo, with_findings


def fuse_run(streams: Streams, config: FuseConfig, *, run_id: str) -> Track:
    """Return the track of a run.

    Each clock epoch, and each stretch between long pauses, is fused for itself; rows stand in order of epoch and stamp. Stamps are
    multiples of the track's period; where no sensor tells motion for ``max_gap_s`` there are no rows, so a gap is a step in the stamps.

    Parameters
    ----------
    streams : what `read_run` made of a log.
    config : estimator, rate and noise.
    run_id : stands in the track's info.

    Raises
    ------
    FusionError
        Nothing tells motion, or the estimate breaks down.
    """
    # 1. Streams become measurements: one frame, one set of units, usable variances; sensors that cannot be right are left out.
    inputs, sanity = sane_inputs(prepare_inputs(streams, config), streams)
    stretches = cut_stretches(inputs.measurements)
    period_ns = round(1e9 / config.rate_hz)
    columns: list[Mapping[str, NDArray[Any]]] = []
    found: list[Trajectory] = []
    facts: list[dict[str, Any]] = []
    skipped_s = 0.0
    for stretch in stretches:
        output_ns = track_stamps(stretch, period_ns=period_ns, max_gap_ns=int(config.max_gap_s * 1e9))
        if output_ns.size == 0 or (inputs.datum_deg_m is not None and stretch.measurements.gnss is None):
            skipped_s += (stretch.end_ns - stretch.start_ns) * 1e-9
            continue
        # 2. Where it starts; a local frame goes on from where the last stretch ended.
        initial = _initial(stretch, found[-1] if found and inputs.datum_deg_m is None else None)
        # 3. Filter and smoother.
        trajectory = _estimate(stretch, initial, output_ns, config)
        found.append(trajectory)
        facts.append(stretch_facts(stretch, initial, trajectory))
        # 4. What else is known at the track's stamps.
        columns.append(_columns(stretch, trajectory, inputs, streams, config))
    if not found:
        raise FusionError(_nothing(streams, inputs), *sanity.warnings)
    table = TRACK.table(**{name: np.concatenate([part[name] for part in columns]) for name in columns[0]})
    datum = None if inputs.datum_deg_m is None else Datum(*inputs.datum_deg_m, crs=streams.gnss_crs)
    info = TrackInfo(run_id, streams.robot, datum, config.rate_hz, config.estimator, streams.findings)
    summary = fuse_facts(inputs, facts, rows=table.num_rows, skipped_s=skipped_s)
    info = with_findings(info, "fuse", fuse_warnings(inputs, facts, summary), summary)
    # 5. What was left out, and whether the sensors' clocks agree.
    info = with_findings(info, "sensor_checks", sanity.warnings, sanity.facts)
    clocks = clock_findings(streams, inputs)
    info = with_findings(info, "clock_offsets", clocks.warnings, clocks.facts)
    return Track(table, rejections_table(inputs, found), info)


def _initial(stretch: Stretch, last: Trajectory | None) -> InitialState:
    standing = standing_intervals(stretch.measurements)
    initial = find_initial_state(stretch.measurements, standing, stretch.start_ns)
    if last is None:
        return initial
    return replace(initial, position_enu_m=last.position_enu_m[-1], quat_xyzw=last.quat_xyzw[-1])


def _estimate(stretch: Stretch, initial: InitialState, output_ns: NDArray[np.int64], config: FuseConfig) -> Trajectory:
    gate = config.gate_probability
    if config.estimator == "ukf":
        return run_ukf15(
            stretch.measurements, initial, output_ns=output_ns, gate_probability=gate, engine=config.engine
        )
    return run_error_state(stretch.measurements, initial, output_ns=output_ns, gate_probability=gate)


def _columns(
    stretch: Stretch, trajectory: Trajectory, inputs: Inputs, streams: Streams, config: FuseConfig
) -> dict[str, NDArray[Any]]:
    stamp_ns = trajectory.stamp_ns
    gap_ns, power_gap_ns = int(config.max_gap_s * 1e9), int(config.max_power_gap_s * 1e9)
    return {
        "stamp_ns": stamp_ns,
        "epoch": np.full(stamp_ns.size, stretch.epoch, np.int16),
        **pose_columns(trajectory, inputs.datum_deg_m),
        "wheel_velocity_mps": wheel_column(stretch.measurements.wheels, stamp_ns, max_gap_ns=gap_ns),
        **command_columns(streams, stretch.epoch, stamp_ns),
        **power_columns(streams, stretch.epoch, stamp_ns, max_gap_ns=power_gap_ns),
    }


def _nothing(streams: Streams, inputs: Inputs) -> str:
    rows = {role: table.num_rows for role, table in streams.tables.items()}
    unusable = {role: count["invalid"] for role, count in inputs.counts.items() if count["invalid"]}
    return (
        f"fusion: no motion to fuse; rows by role: {rows}, unusable: {unusable}; wanted GNSS, wheel or visual odometry over "
        "some time: see the topics with tcpipe inspect, and name them in the recipe under [read.topics]"
    )
