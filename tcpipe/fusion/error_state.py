"""The default estimator: error-state unscented filter forward, unscented smoother backward (equations: the kernels).

Memory is bounded: the forward pass keeps a checkpoint per block of events; on the way back each block is filtered once more, this time
with everything kept, and smoothed. The second pass repeats the arithmetic of the first exactly, gates included.

Gates recover. A sensor that has been refused many times in a row and for a long time (GNSS 15 s, 5 s without visual odometry or IMU;
odometry 5 s, 0.3 s where nothing else tells velocity) is taken to be right and the filter wrong: the covariance is lifted by the
innovation before that update, which the smoother sees as process noise. Until then a multipath jump or a slipping wheel costs nothing but
listed refusals. Fixes that contradict the rest while it carries the pose are not followed: in a second round an error of theirs is part of
the state, where both ends tell that they have one (`gnss_faults`). Where fixes scatter far less than they claim, the rest of their error
lasts (`fix_errors`): it is no noise that averages out.

`error_state_pass` runs the kernels over a stretch, `error_state_results` says what they found. The kernels: `state_kernel` (state, errors
and sigma points), `prediction_kernel`, `update_kernel`, `error_state_kernel` (events and gates) and `smoother_kernel`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import FusionError
from tcpipe.fusion import state_kernel as kernel
from tcpipe.fusion.error_state_pass import FilterPass, compute_lag_rows
from tcpipe.fusion.error_state_results import find_gate_resets, make_trajectory
from tcpipe.fusion.fix_errors import FixErrors, find_fix_errors
from tcpipe.fusion.gnss_faults import (
    FaultHypothesis,
    GnssFaults,
    Spans,
    find_returned_fixes,
    find_wrong_fixes,
    is_inside,
)
from tcpipe.fusion.measurements import GNSS, InitialState, Measurements, select_measurements
from tcpipe.fusion.process import VISUAL_SCALE_STD, WHEEL_SCALE_STD
from tcpipe.fusion.signals import compute_median_period_ns
from tcpipe.fusion.stationary import find_stationary_intervals
from tcpipe.fusion.timeline import EventTimeline, build_timeline
from tcpipe.fusion.trajectory import Trajectory
from tcpipe.geometry.rotation import quat_from_matrix
from tcpipe.tables.facts import GateReset
from tcpipe.tables.findings import Subject, make_finding

_MANY_FIXES = 50
_LEVELLING_NS = 60_000_000_000
_ODOMETRY_HOLDS_M, _LASTS_S = 0.1, 30.0


def run_error_state(
    measurements: Measurements,
    initial: InitialState,
    *,
    output_ns: NDArray[np.int64],
    gate_probability: float = 0.999,
    smooth: bool = True,
) -> Trajectory:
    """Filter and smooth one stretch.

    Parameters
    ----------
    measurements : at least one of GNSS, wheels and visual odometry.
    initial : state at the first measurement.
    output_ns : [ns], shape (N,), increasing: the wanted stamps.
    gate_probability : a measurement less likely than 1 minus this is refused.
    smooth : False gives the forward filter.

    Returns
    -------
    States at ``output_ns``, base_link in ENU.

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
    """A stretch that is filtered, more than once where its fixes contradict the rest; with ``errors`` that of the fixes is in the state."""

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
    """Return the spans in which the fixes were wrong, with how far they were off; then those of which nobody can tell."""
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
    """Return what the fixes cannot tell of the odometry's scale: their error at both ends of the ground that they span.

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
