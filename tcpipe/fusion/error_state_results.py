"""What the error-state estimator says of a stretch: states with their deviations, what was refused, facts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion import state_kernel as kernel
from tcpipe.fusion.course import compute_course
from tcpipe.fusion.error_state_pass import DOF, ROLES, FilterPass, compute_lag_rows
from tcpipe.fusion.measurements import GNSS
from tcpipe.fusion.process import GROUND, UNSEEN_TURN_RADPS
from tcpipe.fusion.timeline import EventTimeline
from tcpipe.fusion.trajectory import DISPLACEMENT_LAGS_S, Rejections, Trajectory
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_matrix, quat_from_rpy
from tcpipe.tables.facts import GateReset, StretchFacts, make_vector


def make_trajectory(
    timeline: EventTimeline, outputs: NDArray[np.float64], run: FilterPass, output_ns: NDArray[np.int64]
) -> Trajectory:
    """Return the trajectory at the wanted stamps [ns], of ``outputs`` as `FilterPass` gives them; they are changed in place.

    What no row of the filter can know is added: lasting errors of fixes, a scale or a yaw that nothing has measured.
    """
    rate_radps = timeline.output_rate_radps
    if run.along_course:
        rate_radps = _look_along(outputs, output_ns, run.antenna_m, run.slope_std_rad)
    rotation = outputs[:, 0:9].reshape(-1, 3, 3)
    scale_std, speed_mps = run.unseen_scale_std, np.linalg.norm(outputs[:, 15:18], axis=1)
    outputs[:, 23:26] += run.lasting_m2
    if run.unplaced:
        outputs[:, 23:26] += (scale_std * (outputs[:, 18:21] - outputs[0, 18:21])) ** 2
    if run.turns_by_course:
        # The course takes a sway of the antenna for a turn: nothing tells one from the other, and roll is taken to be none.
        outputs[:, 23:25] += (run.slope_std_rad * run.antenna_m[2] * rotation[:, :2, 1]) ** 2
    if run.unseen_yaw_std:
        _add_unknown_yaw(outputs, rotation, run.unseen_yaw_std, run.antenna_m)
    bias = outputs[:, 9:12] * (timeline.output_rate_radps if run.turn_scale_std else timeline.output_has_gyro[:, None])
    return Trajectory(
        stamp_ns=output_ns,
        position_enu_m=outputs[:, 18:21].copy(),
        quat_xyzw=quat_from_matrix(rotation),
        velocity_enu_mps=outputs[:, 15:18].copy(),
        angular_velocity_radps=rate_radps - bias,
        position_std_m=np.sqrt(outputs[:, 23:26]),
        yaw_std_rad=np.sqrt(outputs[:, 26]),
        forward_velocity_std_mps=np.hypot(np.sqrt(outputs[:, 27]), scale_std * speed_mps),
        rejections=_make_rejections(timeline, run),
        displacement_std_m=np.hypot(
            np.hypot(_compute_displacement_std_m(run, output_ns), _compute_sway_m(run, speed_mps)),
            scale_std * speed_mps[:, None] * DISPLACEMENT_LAGS_S,
        ),
        facts=_make_facts(timeline, run),
    )


def _look_along(
    outputs: NDArray[np.float64], output_ns: NDArray[np.int64], antenna_m: NDArray[np.float64], slope_std_rad: float
) -> NDArray[np.float64]:
    """Make the antenna's states the body's, level and along its course; return how fast that turns [rad/s], shape (N, 3)."""
    yaw = compute_course(outputs[:, 15:18])
    rotation = matrix_from_quat(quat_from_rpy(0.0, 0.0, yaw))
    outputs[:, 0:9] = rotation.reshape(-1, 9)
    outputs[:, 18:21] -= rotation @ antenna_m
    # The antenna sways over ground that no sensor shows.
    outputs[:, 23:25] += (slope_std_rad * antenna_m[2]) ** 2
    outputs[:, 27] += (UNSEEN_TURN_RADPS * antenna_m[2]) ** 2
    rate = np.zeros((yaw.size, 3))
    if yaw.size > 1:
        rate[:, 2] = np.gradient(yaw, (output_ns - output_ns[0]) * 1e-9)
    return rate


def _compute_sway_m(run: FilterPass, speed_mps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return by how much an antenna on a body of unseen attitude moves otherwise than the body over each displacement, shape (N, 4)."""
    if not run.along_course:
        return np.zeros((speed_mps.size, 1))
    tilt2 = np.minimum(GROUND * speed_mps[:, None] * DISPLACEMENT_LAGS_S, 2 * run.slope_std_rad**2)
    return np.asarray(np.sqrt(tilt2) * abs(run.antenna_m[2]))


def _add_unknown_yaw(
    outputs: NDArray[np.float64], rotation: NDArray[np.float64], yaw_std: float, antenna_m: NDArray[np.float64]
) -> None:
    """Add what cannot be known where yaw may be anything: itself, where below its antenna the robot is, and whether it drives forward."""
    velocity, beside = outputs[:, 15:18], rotation @ antenna_m
    aside2 = np.sum(beside[:, :2] ** 2, axis=1)
    above2 = 2 * (rotation[:, 2, :2] @ antenna_m[:2]) ** 2
    outputs[:, 23:26] += np.column_stack((aside2, aside2, above2))
    outputs[:, 26] += yaw_std**2
    outputs[:, 27] += 1.5 * np.sum(velocity**2, axis=1)


def _compute_displacement_std_m(run: FilterPass, output_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    std = np.sqrt(run.displacement_variance_m2)
    for column, (lag, lag_s) in enumerate(zip(compute_lag_rows(output_ns), DISPLACEMENT_LAGS_S, strict=True)):
        step_s = (output_ns[lag:] - output_ns[:-lag]) * 1e-9
        std[: step_s.size, column][np.abs(step_s - lag_s) > 0.1 * lag_s] = np.nan  # across a gap
    return std


def _make_rejections(timeline: EventTimeline, run: FilterPass) -> Rejections:
    refused = np.flatnonzero((run.verdict == kernel.REFUSED) & np.isin(timeline.kind, list(ROLES)))
    kind = timeline.kind[refused]
    return Rejections(
        stamp_ns=timeline.stamp_ns[refused],
        role=np.array([ROLES[int(k)] for k in kind], np.str_),
        reason=np.full(refused.size, "gate"),
        normalized_innovation_squared=run.nis[refused],
        threshold=run.gates[kind],
    )


def find_gate_resets(timeline: EventTimeline, run: FilterPass) -> tuple[GateReset, ...]:
    """Return each gate_reset of a gate: since when the sensor was refused, and how far it was off."""
    found = []
    for event in np.flatnonzero(run.verdict == kernel.REOPENED):
        same = np.flatnonzero(timeline.kind[:event] == timeline.kind[event])
        heard = same[run.verdict[same] != kernel.REFUSED]
        first = same[same > heard[-1]][0] if heard.size and heard[-1] < same[-1] else event
        size = float(np.linalg.norm(run.innovation[event, : 2 if timeline.kind[event] == kernel.GNSS_POSITION else 1]))
        role = ROLES[int(timeline.kind[event])]
        if role == GNSS and any(w.start_ns <= timeline.stamp_ns[event] <= w.end_ns for w in run.wrong):
            continue  # known by both ends
        found.append(GateReset(role, int(timeline.stamp_ns[first]), int(timeline.stamp_ns[event]), size))
    return tuple(sorted((*run.wrong, *found), key=lambda gate_reset: gate_reset.start_ns))


def _make_facts(timeline: EventTimeline, run: FilterPass) -> StretchFacts:
    kinds = {role: timeline.kind == kind for kind, role in ROLES.items() if (timeline.kind == kind).any()}
    taken = {role: of_kind & (run.verdict == kernel.ACCEPTED) for role, of_kind in kinds.items()}
    dof = {role: DOF[kind] for kind, role in ROLES.items()}
    x, deviation = run.last.x, np.sqrt(np.diag(run.last.P))
    return StretchFacts(
        nis_mean={role: float(run.nis[t].mean()) / dof[role] if t.any() else None for role, t in taken.items()},
        measurements={role: int(of_kind.sum()) for role, of_kind in kinds.items()},
        rejected={role: int((of_kind & (run.verdict == kernel.REFUSED)).sum()) for role, of_kind in kinds.items()},
        reopened={role: int((of_kind & (run.verdict == kernel.REOPENED)).sum()) for role, of_kind in kinds.items()},
        events=int(timeline.stamp_ns.size),
        zero_velocity_updates=int((timeline.kind == kernel.STANDING).sum()),
        gnss_lasting_error_m=run.lasting_error_m(),
        gate_resets=find_gate_resets(timeline, run),
        covariance_repairs=int(run.repairs),
        gyro_bias_radps=None if run.turn_scale_std else make_vector(x[9:12]),
        turn_scale=float(1 + x[11]) if run.turn_scale_std else None,
        accelerometer_bias_mps2=make_vector(x[12:15]),
        wheel_scale=float(1 + x[21]),
        wheel_scale_std=float(max(deviation[15], run.unseen_scale_std)),
        visual_scale=float(1 + x[22]),
        visual_scale_std=float(max(deviation[16], run.unseen_scale_std)),
        common_scale_std=run.unseen_scale_std,
    )
