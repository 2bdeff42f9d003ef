"""What fusing noticed: facts for the manifest and warnings for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tcpipe.fusion.measurements import GNSS, IMU, VISUAL, WHEELS, InitialState
from tcpipe.fusion.stretches import Stretch
from tcpipe.fusion.trajectory import Trajectory
from tcpipe.geometry.rotation import rpy_from_quat
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_sanity import without_role
from tcpipe.tables.facts import FuseFacts, StretchFacts

_MANY_REFUSED = 0.2
_COMMON = 0.02
_LOCAL = "the track lies in a local frame that starts at 0, 0, 0 and cannot be placed on a map"


def stretch_facts(stretch: Stretch, initial: InitialState, found: Trajectory) -> StretchFacts:
    """Return the facts of one stretch: the filter's, and where it lies and began."""
    m = stretch.measurements
    return replace(
        found.facts,
        epoch=stretch.epoch,
        start_ns=stretch.start_ns,
        end_ns=stretch.end_ns,
        rows=int(found.stamp_ns.size),
        sensors=tuple(m.sensors()),
        gyro_noise_radps=None if m.imu is None else m.imu.gyro_std_radps,
        accelerometer_noise_mps2=None if m.imu is None else m.imu.accelerometer_std_mps2,
        initial_yaw_rad=float(rpy_from_quat(initial.quat_xyzw)[2]),
        initial_yaw_std_rad=initial.yaw_std_rad,
        heading_from=initial.heading_from,
    )


def fuse_facts(inputs: FusionInputs, stretches: Sequence[StretchFacts], *, rows: int, skipped_s: float) -> FuseFacts:
    """Return the facts of the run: counts by role over all stretches, what was set aside, and each stretch."""
    roles = sorted({role for stretch in stretches for role in stretch.measurements})
    nis: dict[str, float | None] = {}
    for role in roles:
        means = [(s.nis_mean.get(role), s.measurements[role]) for s in stretches if role in s.measurements]
        known = [(mean, count) for mean, count in means if mean is not None]
        if known:
            nis[role] = float(np.average([mean for mean, _ in known], weights=[count for _, count in known]))
    return FuseFacts(
        rows=rows,
        sensors=tuple(sorted({role for stretch in stretches for role in stretch.sensors})),
        measurements={role: sum(stretch.measurements.get(role, 0) for stretch in stretches) for role in roles},
        rejected={role: sum(stretch.rejected.get(role, 0) for stretch in stretches) for role in roles},
        nis_mean=nis,
        set_aside=inputs.counts,
        skipped_s=skipped_s,
        stretches=tuple(stretches),
    )


def fuse_warnings(inputs: FusionInputs, facts: FuseFacts, *, fixes: str = GNSS) -> tuple[str, ...]:
    """Return what a person should know before trusting the track; ``fixes`` is the role in the recipe of what tells positions."""
    counts = {role: count for role, count in inputs.counts.items() if role not in inputs.refused}
    found = [remark for remark in inputs.remarks if remark.split(":")[0] not in inputs.refused]
    if inputs.datum_deg_m is None and GNSS in inputs.counts:  # a log without any fix was warned of when it was read
        found.append(f"no GNSS position is used: {_LOCAL}")
    elif inputs.datum_deg_m is not None:
        found += [
            f"clock epoch {stretch.epoch}: no 5 m of course over ground, so its initial yaw is from {stretch.heading_from}"
            for stretch in facts.stretches
            if stretch.heading_from != "course over ground"
        ]
    found += _reopened(facts)
    common = max((stretch.common_scale_std or 0.0 for stretch in facts.stretches), default=0.0)
    if common > _COMMON:
        what = "these fixes are too few or too coarse to tell it" if GNSS in facts.sensors else "a GNSS would tell it"
        known = "nothing tells how long a metre of odometry is: its scale stays 1"
        if inputs.scales:
            known, what = (
                "how long a metre of odometry is, these fixes tell but roughly",
                "finer or more fixes would tell it better",
            )
        found.append(
            f"{known}, and {common:.0%} are in the deviations of velocity, duration, power and energy as one error of the whole run; {what}"
        )
    if IMU not in facts.sensors:
        found.append("no IMU is used: attitude is inferred from the path; roll and pitch are weak")
    found += [
        f"{(name := fixes if role == GNSS else role)}: {facts.rejected[role]} of {count} measurements were refused by the gate "
        f"(rejections.parquet){without_role(name, 'if it is what errs, to leave it out')}"
        for role, count in facts.measurements.items()
        if facts.rejected[role] > _MANY_REFUSED * count
    ]
    for key, text in (
        ("variances_replaced", "rows without a usable variance; the recipe's is used"),
        ("invalid", "rows without a usable value"),
    ):
        found += [f"{role}: {count[key]} {text}" for role, count in counts.items() if count[key]]
    if facts.skipped_s:
        found.append(f"{facts.skipped_s:.1f} s between pauses or clock steps hold too little to place a track")
    return tuple(found)


def _reopened(facts: FuseFacts) -> list[str]:
    """Return by sensor how often it left the path of the others for seconds, and where most."""
    found = []
    every = [reopening for stretch in facts.stretches for reopening in stretch.reopenings]
    ways = [role for role in (WHEELS, VISUAL) if role in facts.sensors]
    doubt = f"; or {ways[0]} errs there: nothing else tells how far the robot goes" if len(ways) == 1 else ""
    for role in sorted({reopening.role for reopening in every}):
        mine = [reopening for reopening in every if reopening.role == role]
        worst = max(mine, key=lambda reopening: reopening.size)
        unit = "m" if role == GNSS else "m/s"
        found.append(
            f"{role}: {len(mine)} times it contradicted the other sensors for seconds, most by {worst.size:.2f} {unit} from "
            f"{worst.start_ns} to {worst.end_ns} ns (run.json: reopenings): look there at its clock, its mounting and its surroundings"
            f"{doubt if role == GNSS else ''}"
        )
    return found
