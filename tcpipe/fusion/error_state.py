"""The default estimator: error-state unscented filter forward, unscented smoother backward (equations: the kernels).

Memory is bounded: the forward pass keeps a checkpoint per block of events; on the way back each block is filtered once more, this time
with everything kept, and smoothed. The second pass repeats the arithmetic of the first exactly, gates included.

Gates recover. A sensor that has been refused many times in a row and for a long time (GNSS 15 s, 5 s without visual odometry or IMU;
odometry 5 s, 0.3 s where nothing else tells velocity) is taken to be right and the filter wrong: the covariance is lifted by the
innovation before that update, which the smoother sees as process noise. Until then a multipath jump or a slipping wheel costs nothing but
listed refusals. Fixes that contradict the rest while it carries the pose are not followed: in a second round an error of theirs is part of
the state, where both ends tell that they have one (`gnss_faults`). Where fixes scatter far less than they claim, the rest of their error
lasts (`find_fix_errors`): it is no noise that averages out.

`error_state_pass` runs the kernels over a section. The kernels: `state_kernel` (state, errors and sigma points, prediction),
`error_state_kernel` (updates, events and gates) and `smoother_kernel`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import FusionError
from tcpipe.fusion import state_kernel as kernel
from tcpipe.fusion.error_state_pass import DOF, ROLES, FilterPass, compute_lag_rows
from tcpipe.fusion.gnss_faults import (
    FaultHypothesis,
    FixErrors,
    GnssFaults,
    Spans,
    find_fix_errors,
    find_returned_fixes,
    find_wrong_fixes,
    is_inside,
)
from tcpipe.fusion.initial import compute_course, find_stationary_intervals
from tcpipe.fusion.measurements import GNSS, InitialState, Measurements, select_measurements
from tcpipe.fusion.process import GROUND, UNSEEN_TURN_RADPS, VISUAL_SCALE_STD, WHEEL_SCALE_STD
from tcpipe.fusion.signals import compute_median_period_ns
from tcpipe.fusion.timeline import EventTimeline, build_timeline
from tcpipe.fusion.trajectory import DISPLACEMENT_LAGS_S, Rejections, Trajectory
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_matrix, quat_from_rpy
from tcpipe.tables.facts import GateReset, StretchFacts, make_vector
from tcpipe.tables.findings import Subject, make_finding

_MANY_FIXES = 50  # fewest fixes for an average
_LEVELLING_NS = 60_000_000_000  # first pass for roll and pitch without IMU
_ODOMETRY_HOLDS_M = 0.1  # odometry drift in `_LASTS_S`
_LASTS_S = 30.0  # spacing of fixes whose metre-size error lasts


def run_error_state(
    measurements: Measurements,
    initial: InitialState,
    *,
    output_ns: NDArray[np.int64],
    gate_probability: float = 0.999,
    smooth: bool = True,
) -> Trajectory:
    """Filter one section and, unless ``smooth`` is False, smooth it; return the states of base_link in ENU at ``output_ns``.

    Parameters
    ----------
    measurements : at least one of GNSS, wheels and visual odometry.
    initial : state at the first measurement.
    output_ns : [ns], shape (N,), increasing.
    gate_probability : a measurement less likely than 1 minus this is rejected.

    Raises
    ------
    FusionError : the estimate is not finite.
    """
    if measurements.imu is None and output_ns.size:
        initial = _level_start(measurements, initial, output_ns, gate_probability)
    standing = find_stationary_intervals(measurements)
    errors = find_fix_errors(measurements)
    case = _FilterSection(measurements, initial, output_ns, gate_probability, None)
    if errors is not None and errors.matters:
        case = replace(case, errors=errors)
    timeline = case.timeline(standing, errors)
    run, outputs = case.passed(timeline, keep=smooth)
    wrong = None
    if errors is not None and run.fixes_contradict():  # again, with an error of theirs where both ends tell of one
        del run, outputs, timeline  # each takes room as the log is long
        case = replace(case, errors=errors)
        timeline = case.timeline(standing, errors)
        wrong = _find_gnss_faults(case, timeline)
        run, outputs = case.passed(timeline, () if wrong is None else wrong.spans, keep=smooth)
    elif not run.carried:
        wrong = find_returned_fixes(run.jumps())
    if smooth:
        run.smooth(outputs)
    if errors is not None and case.errors is None:
        run.lasting_m2 = _interpolate_fix_error(errors, measurements, output_ns)
    if wrong is not None:
        run.wrong = _as_reopenings(wrong, outputs, output_ns)
        run.lasting_m2 = run.lasting_m2 + wrong.doubt_m2(output_ns)
    run.unseen_scale_std = _compute_unseen_scale_std(run, measurements)
    if not np.isfinite(outputs).all():
        raise FusionError(
            "the estimate is not finite", findings=[make_finding("estimate-not-finite", Subject("run", ""))]
        )
    return make_trajectory(run.timeline, outputs, run, output_ns)


@dataclass(frozen=True, slots=True)
class _FilterSection:
    """A section that is filtered, more than once where its fixes contradict the rest; with ``errors`` that of the fixes is in the state."""

    measurements: Measurements
    initial: InitialState
    output_ns: NDArray[np.int64]
    gate_probability: float
    errors: FixErrors | None

    def timeline(self, standing: NDArray[np.int64], errors: FixErrors | None) -> EventTimeline:
        """Return the events, fixes with the variance that counts from one to the next."""
        heard = _inflate_correlated_fixes(self.measurements, errors, doubted=self.errors is not None)
        return build_timeline(heard, standing, self.output_ns)

    def passed(
        self, timeline: EventTimeline, spans: Spans = (), *, follows: bool = True, keep: bool = False
    ) -> tuple[FilterPass, NDArray[np.float64]]:
        """Return the forward pass in which the error of the fixes is free in ``spans``, and its states at the wanted stamps."""
        run = self.prepared(timeline, spans, follows=follows)
        return run, run.filtered(self.initial, keep=keep)

    def prepared(self, timeline: EventTimeline, spans: Spans, *, follows: bool) -> FilterPass:
        """Return the pass before it is made."""
        run = FilterPass(timeline, self.measurements, self.gate_probability, lags=compute_lag_rows(self.output_ns))
        if self.errors is not None:
            run.doubt_fixes(self.errors, spans, follows=follows)
        return run


def _find_gnss_faults(case: _FilterSection, timeline: EventTimeline) -> GnssFaults | None:
    """Return when the fixes erred together, where that explains what contradicts them."""
    follower, _ = case.passed(timeline)
    known = tuple((r.start_ns, r.end_ns) for r in find_gate_resets(timeline, follower) if r.role == GNSS)
    del follower
    plain, _ = case.passed(timeline, follows=False)
    usual = plain.usual()

    def tried(spans: Spans) -> FaultHypothesis:
        run = case.prepared(timeline, spans, follows=False) if spans else plain
        if spans:
            run.filtered_like(plain, case.initial)
        return run.explained(spans, usual)

    return find_wrong_fixes(tried, (int(timeline.stamp_ns[0]), int(timeline.stamp_ns[-1])), known)


def _as_reopenings(
    wrong: GnssFaults, outputs: NDArray[np.float64], output_ns: NDArray[np.int64]
) -> tuple[GateReset, ...]:
    """Return the spans in which the fixes were wrong, with their error; then those that are undecided."""
    off_m = np.linalg.norm(outputs[:, kernel.SAVED - 3 : kernel.SAVED - 1], axis=1)
    found = []
    for span in wrong.spans:
        within = off_m[is_inside(output_ns, (span,))]
        found.append(GateReset(GNSS, *span, float(within.max()) if within.size else wrong.size_m))
    return (*found, *(GateReset(GNSS, *span, wrong.size_m) for span in wrong.doubtful))


def _inflate_correlated_fixes(measurements: Measurements, errors: FixErrors | None, *, doubted: bool) -> Measurements:
    """Return the measurements with the variance of fixes that counts from one to the next: the claim, where nothing else holds the rest."""
    if errors is None or measurements.gnss is None:
        return measurements
    gnss = measurements.gnss
    variance = errors.white_m2 if doubted else np.maximum(errors.white_m2, gnss.variance_m2)
    if gnss.unclaimed is not None:
        variance = np.where(gnss.unclaimed[:, None], errors.white_m2, variance)
    if errors.of_metres:  # odometry knows better for half a minute: so often they count
        together = max(1.0, _LASTS_S * 1e9 / compute_median_period_ns(gnss.stamp_ns))
        lasting_m2 = np.median(errors.lasting_m2[:, 0])
        variance = np.maximum(variance, errors.lasting_m2) * min(together, lasting_m2 / _ODOMETRY_HOLDS_M**2)
    return replace(measurements, gnss=replace(measurements.gnss, variance_m2=variance))


def _interpolate_fix_error(
    errors: FixErrors, measurements: Measurements, output_ns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return what lasts of the fixes' errors at each wanted stamp [m²], shape (N, 3)."""
    if measurements.gnss is None:
        return np.zeros((output_ns.size, 3))
    nearest = np.searchsorted(measurements.gnss.stamp_ns, output_ns).clip(0, measurements.gnss.stamp_ns.size - 1)
    return np.asarray(errors.lasting_m2[nearest])


def _level_start(
    measurements: Measurements, initial: InitialState, output_ns: NDArray[np.int64], gate_probability: float
) -> InitialState:
    """Return the start with the attitude that its first minute, smoothed, says it had: without an IMU it starts level, on any slope."""
    output_ns = output_ns[output_ns < output_ns[0] + _LEVELLING_NS]
    first = select_measurements(measurements, np.iinfo(np.int64).min, int(output_ns[-1]))
    timeline = build_timeline(first, find_stationary_intervals(first), output_ns)
    outputs = FilterPass(timeline, first, gate_probability, lags=compute_lag_rows(output_ns)).smoothed(initial)
    if not np.isfinite(outputs[0]).all():
        return initial
    return replace(initial, quat_xyzw=quat_from_matrix(outputs[0, 0:9].reshape(3, 3)))


def _compute_unseen_scale_std(run: FilterPass, measurements: Measurements) -> float:
    """Return the uncertainty of the odometry's scale that the fixes leave: their error at both ends of the ground that they span.

    It is at most the scale's own deviation. The white part of the error of many fixes is the filter's business.
    """
    own = WHEEL_SCALE_STD if measurements.visual is None else VISUAL_SCALE_STD
    of_gnss = (run.timeline.kind == kernel.GNSS_POSITION) & (run.verdict == kernel.ACCEPTED)
    if measurements.wheels is None and measurements.visual is None:
        return 0.0
    if of_gnss.sum() < 2:
        return own
    few_m2 = np.median(run.timeline.variance[of_gnss, 0]) if of_gnss.sum() < _MANY_FIXES else 0.0
    span_m = np.linalg.norm(np.ptp(run.timeline.value[of_gnss, :2], axis=0))
    lasting_m2 = run.lasting_error_m() ** 2
    return float(min(own, np.sqrt(2.0 * max(lasting_m2, few_m2)) / max(span_m, 1e-3)))


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
    """Return each gate reset: since when the sensor was rejected, and its difference."""
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
