"""The default estimator: an error-state unscented filter on SE(3), and its smoother (`filter_kernel`: equations).

If sensors contradict each other for long, tcpipe searches changes that explain the contradiction (`changes`) and
estimates the section again.

Memory is bounded: the forward pass stores a checkpoint for each block of ticks. Before a block is smoothed, it is
filtered again and all steps are stored. The second pass repeats the arithmetic of the first exactly, including gates.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints
from tcpipe.errors import FusionError
from tcpipe.fusion import state
from tcpipe.fusion.changes import (
    EVENTS,
    LARGER_ERRORS,
    POSSIBLE,
    ROLES,
    Change,
    Hypothesis,
    compute_evidence,
    drop_outliers,
    is_contradicted,
    join_events,
)
from tcpipe.fusion.course import compute_course
from tcpipe.fusion.densities import PRIORS, NoiseModel, fit_noise, inflate_unclaimed_fixes
from tcpipe.fusion.filter_kernel import FilterModel, GateVerdict, Memory, Tests, allocate_steps, filter_ticks
from tcpipe.fusion.initial import find_stationary_intervals
from tcpipe.fusion.measurements import (
    DISPLACEMENT_LAGS_S,
    IMU,
    MAX_VARIANCE,
    NO_LEVER_ARM,
    STATED_ARM_STD_M,
    UNSTATED_ARM_STD_M,
    WHEELS,
    InitialState,
    Measurements,
    Trajectory,
)
from tcpipe.fusion.pair_residuals import find_residuals
from tcpipe.fusion.parameters import PARAMETERS, find_walk, make_model, make_priors, make_start, widen_start
from tcpipe.fusion.process import GROUND, SLOPE_RAD, UNSEEN_TURN_RADPS, find_best_scale_std, is_length_observable
from tcpipe.fusion.smoother_kernel import (
    LARGEST_EVENT,
    STD_INTERVAL,
    Candidates,
    Smoothed,
    make_adjoint,
    smooth_ticks,
)
from tcpipe.fusion.state import Error, Kind
from tcpipe.fusion.ticks import Pass, Ticks, build_ticks
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_matrix, quat_from_rpy
from tcpipe.robust import MIN_SIGMAS
from tcpipe.tables.facts import ChangeFacts, GateReset, ParameterFacts, SectionFacts
from tcpipe.tables.findings import Subject, make_finding, read_threshold

_UNCHANGED = Hypothesis(())
_BLOCK = 1024  # ticks between checkpoints
_MIN_EVENT_GAIN = 20.0
"""Least log evidence of an event minus its cost [nat]: the best tick of a section reaches 12 by chance."""


def run_error_state(m: Measurements, initial: InitialState, *, output_ns: Ints, gate_probability: float = 0.999) -> Trajectory:  # fmt: skip
    """Filter and smooth one section; return the states of base_link in ENU at ``output_ns``.

    Parameters
    ----------
    m : at least one of GNSS, wheels and visual odometry.
    initial : state at the first measurement.
    output_ns : [ns], shape (N,), increasing multiples of the track's period.
    gate_probability : a measurement less likely than 1 minus this is rejected.

    Raises
    ------
    FusionError : the estimate is not finite.
    """
    section = prepare_section(m, output_ns, gate_probability)
    start, explanation = section.make_start(initial), _UNCHANGED
    # The first minute is filtered twice: the second time from its own smoothed attitude and yaw at the start.
    minute = round(60.0 / section.ticks.inputs.period_s)
    levelled, _ = smooth_section(section.filter(start, until=minute), with_displacements=False)
    start.x[:9] = levelled.states[0, :9]
    forward = section.filter(start)
    smoothed, events = smooth_section(forward)
    if (corrected := section.correct_arm(forward, smoothed)) is not section:
        section = corrected
        start = section.make_start(initial)._replace(x=start.x)
        forward = section.filter(start)
        smoothed, events = smooth_section(forward)
    if _are_changes_observable(section.measurements):
        explanation = section.explain(forward, events, start)
    if explanation.changes:
        forward = section.filter(start, explanation)
        smoothed, _ = smooth_section(forward)
    if not np.isfinite(smoothed.states).all():
        finding = make_finding("estimate-not-finite", Subject("run", ""))
        raise FusionError("the estimate is not finite", findings=[finding])
    return make_trajectory(section, forward, smoothed, output_ns, explanation)


def _are_changes_observable(m: Measurements) -> bool:
    """Return whether another sensor can reveal a change, and fixes are more accurate than a minute without them.

    A change is revealed by an IMU with an odometry, or by a camera that measures all turns. Of two odometries without
    fixes and IMU it is unknown which one changed.
    """
    if m.gnss is None:
        return len(m.odometries()) > 1 and m.imu is not None
    carries = (
        bool(m.odometries()) if m.imu is not None else m.visual is not None and m.visual.turn_rate_radps is not None
    )
    return carries and float(np.median(m.gnss.variance_m2[:, 0])) < 0.5**2  # m²; less accurate than dead reckoning


def prepare_section(m: Measurements, output_ns: Ints, gate_probability: float) -> SectionModel:
    """Return the model of a section for an estimator; its noise comes from the residuals of all pairs of sensors."""
    residuals, standing = find_residuals(m), find_stationary_intervals(m)
    m = inflate_unclaimed_fixes(m, residuals)
    noise = fit_noise(m, residuals)
    start_ns = [int(sensor.stamp_ns[0]) for role, sensor in m.sensors().items() if role != IMU]
    first_ns, last_ns = min([*start_ns, int(output_ns[0])]), int(output_ns[-1])
    ticks = build_ticks(m, noise, standing, first_ns, last_ns, output_ns=output_ns)
    return SectionModel(m, noise, ticks, make_priors(m, noise, ticks)[0], gate_probability)


@dataclass(frozen=True, slots=True)
class SectionModel:
    """Model of a section for estimators; a hypothesis of changes may alter it.

    ``std`` is the prior standard deviation of every error, shape (45,).
    """

    measurements: Measurements
    noise: NoiseModel
    ticks: Ticks
    std: Floats
    gate_probability: float

    def make_start(self, initial: InitialState) -> Memory:
        """Return the state, with all errors, at the first tick."""
        gnss = self.measurements.gnss
        is_placed = gnss is not None and not self.measurements.is_antenna_alone
        return make_start(initial, self.std, gnss.lever_arm_m if gnss is not None and is_placed else NO_LEVER_ARM)

    def filter(
        self,
        start: Memory,
        hypothesis: Hypothesis = _UNCHANGED,
        *,
        judges: bool = False,
        kept: Floats | None = None,
        until: int | None = None,
    ) -> Pass:
        """Return the forward pass under a hypothesis from a start with all errors.

        With ``judges`` the pass estimates all errors that an event could change, and makes no gate resets. With
        ``kept`` measurements, (K, 9, 3), the pass uses only those, without a gate.
        """
        ticks, model, begin = self.prepare(start, hypothesis, judges=judges)
        if kept is not None:
            ticks = replace(ticks, inputs=ticks.inputs._replace(value=kept))
            model = model._replace(gates=np.full(state.KINDS, np.inf))
            exact = [
                index for index, error in enumerate(model.active) if error in POSSIBLE and not begin.P[index, index]
            ]
            begin.P[exact, exact] = 1e-4**2  # sigma points need a non-zero width
        return filter_section(ticks, model, begin, until=until)

    def prepare(
        self, start: Memory, hypothesis: Hypothesis = _UNCHANGED, *, judges: bool = False
    ) -> tuple[Ticks, FilterModel, Memory]:
        """Return ticks, model and start of a pass under a hypothesis; for the arguments see `filter`."""
        ticks = hypothesis.alter_ticks(self.ticks)
        std, walk, time_s = make_priors(self.measurements, self.noise, ticks)
        hypothesis.alter_priors(std, walk, time_s)
        if judges and self.measurements.imu is not None:  # a jump of the bias would have inflated the fitted walk
            walk[Error.GYRO_BIAS : Error.GYRO_BIAS + 3] = find_walk(PRIORS["imu bias"])
        model = make_model(
            self.measurements,
            std,
            walk,
            hypothesis.events,
            period_s=ticks.inputs.period_s,
            gate_probability=self.gate_probability,
            time_s=time_s,
            possible=POSSIBLE if judges else (),
        )
        return ticks, model, widen_start(start, std).select(model.active)

    def correct_arm(self, forward: Pass, smoothed: Smoothed) -> SectionModel:
        """Return the section with the estimated antenna position, if it was unknown and differs significantly."""
        gnss, active = self.measurements.gnss, list(forward.model.active)
        if gnss is None or Error.ARM not in active:
            return self
        difference = np.abs(smoothed.states[-1, Error.ARM + 6 : Error.ARM + 9] - gnss.lever_arm_m)
        index = active.index(Error.ARM)
        known = smoothed.stds[-1, index : index + 3]
        if not (difference > np.maximum(2.0 * np.asarray(gnss.lever_arm_std_m), MIN_SIGMAS * known)).any():
            return self
        m = replace(self.measurements, gnss=replace(gnss, lever_arm_std_m=UNSTATED_ARM_STD_M))
        return replace(self, measurements=m, std=make_priors(m, self.noise, self.ticks)[0])

    def explain(self, forward: Pass, events: Sequence[Change], start: Memory) -> Hypothesis:
        """Return the changes that best explain contradictions between sensors; none if there is no contradiction.

        ``events`` explain most of the contradictions in ``forward``.
        """
        period_s, most = self.ticks.inputs.period_s, read_threshold("changes-unlikely", "max_change_count")
        if not events and not is_contradicted(forward.tests, period_s):
            return _UNCHANGED
        plain, tests = self._judge((), start)
        best, tests_of_best = self._add_events(plain, tests, start)
        if len(best.changes) <= most and not is_contradicted(tests_of_best, period_s):
            return best
        # Errors may be larger than usual in the whole section; many changes would explain that, too.
        larger, tests = self._find_larger_errors(plain, tests, start)
        if not larger.changes:
            return best
        larger, _ = self._add_events(larger, tests, start)
        return larger if len(best.changes) > most else max(best, larger, key=lambda each: each.score)

    def _find_larger_errors(self, plain: Hypothesis, tests: Tests, start: Memory) -> tuple[Hypothesis, Tests]:
        """Return the most likely hypothesis of larger errors in the whole section, and the tests of its pass."""
        best, sensors = (plain, tests), self.measurements.sensors()
        kinds = {key: sizes for key, sizes in LARGER_ERRORS.items() if ROLES[key[1]] in sensors}
        while kinds:
            tried = {
                key: self._judge((*best[0].changes, Change(*key, 0, size=sizes[0])), start)
                for key, sizes in kinds.items()
            }
            top = max(tried, key=lambda key: tried[key][0].score)
            # Gains are -5 to 59 nat on clean runs, above 1,000 on runs with steps.
            if tried[top][0].score <= best[0].score + 100.0:
                break
            others, best = best[0].changes, tried[top]
            for size in kinds.pop(top)[1:]:
                larger = self._judge((*others, Change(*top, 0, size=size)), start)
                if larger[0].score <= best[0].score + 8.0:  # nat; least gain by a larger error
                    break
                best = larger
        return best

    def _add_events(self, given: Hypothesis, tests: Tests, start: Memory) -> tuple[Hypothesis, Tests]:
        """Return a hypothesis with further events, by evidence; ``tests`` belong to the pass of ``given``."""
        best, events = (given, tests), list[Change]()
        for _ in range(6):  # two events may be one change
            kept = drop_outliers(self.ticks, best[1])
            hypothesis = replace(given, changes=(*given.changes, *events))
            likely = smooth_section(self.filter(start, hypothesis, judges=True, kept=kept), with_displacements=False)[1]
            if not likely:
                break
            events.append(likely[0])
            best = self._judge((*given.changes, *join_events(events)), start)
        return best

    def _judge(self, changes: Sequence[Change], start: Memory) -> tuple[Hypothesis, Tests]:
        """Return the hypothesis of some changes with its score, and the tests of its pass.

        The score is the log likelihood of all measurements, less the costs of the changes.
        """
        forward = self.filter(start, Hypothesis(tuple(changes)), judges=True)
        score = compute_evidence(forward.tests, forward.model.gates) - sum(change.cost for change in changes)
        return Hypothesis(tuple(changes), score), forward.tests


def make_tests(size: int) -> Tests:
    """Return empty tests, which the filter fills."""
    shape = size, state.KINDS
    return Tests(np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, np.int8), np.full((size, 3), np.nan))


def _list_blocks(size: int) -> list[tuple[int, int]]:
    """Return first and last tick of each block, the last excluded."""
    return list(pairwise([*range(0, size, _BLOCK), size]))


def filter_section(ticks: Ticks, model: FilterModel, start: Memory, *, until: int | None = None) -> Pass:
    """Return the forward pass from a start, over all ticks or those before ``until``."""
    size = min(until or ticks.stamp_ns.size, ticks.stamp_ns.size)
    forward = Pass(ticks, model, [], make_tests(size), start.copy())
    empty = allocate_steps(0, model.active.size)
    for first, last in _list_blocks(size):
        forward.checkpoints.append(forward.last.copy())
        filter_ticks(first, last, ticks.inputs, model, forward.last, empty, forward.tests)
    return forward


def smooth_section(forward: Pass, *, with_displacements: bool = True) -> tuple[Smoothed, tuple[Change, ...]]:
    """Return the smoothed estimate of a forward pass, and the events with more evidence than cost, best first."""
    size, n = len(forward.tests.nis), forward.model.active.size
    lags = np.array([round(lag_s / forward.ticks.inputs.period_s) for lag_s in DISPLACEMENT_LAGS_S])
    adjoint = make_adjoint(n, int(lags.max()) if with_displacements else 0)
    possible, candidates = _list_candidates(forward)
    out = Smoothed(
        np.zeros((size, state.NX)),
        np.zeros((size, 5)),
        np.full((size, lags.size), np.nan),
        np.zeros((-(-size // STD_INTERVAL), n)),
    )
    steps = allocate_steps(min(size, _BLOCK), n)
    for (first, last), memory in zip(reversed(_list_blocks(size)), reversed(forward.checkpoints), strict=True):
        steps.used[:] = False
        filter_ticks(first, last, forward.ticks.inputs, forward.model, memory.copy(), steps, forward.tests)
        smooth_ticks(first, last, forward.ticks.inputs, forward.model, steps, lags, adjoint, candidates, out)
    gains = candidates.best[:, 0] - np.array([EVENTS[key].cost for key in possible])
    events = []
    for row in np.argsort(-gains, kind="stable"):
        (kind, role), count, (_, tick, *change) = possible[row], candidates.sizes[row], candidates.best[row].tolist()
        event = Change(
            kind,
            role,
            int(tick) if np.isfinite(tick) else 0,
            size=float(np.linalg.norm(change[: min(count, 3)])),
            impulse=tuple(change[:count]),
            impulse_std=tuple(change[LARGEST_EVENT : LARGEST_EVENT + count]),
        )
        if gains[row] >= _MIN_EVENT_GAIN and event.size >= EVENTS[kind, role].least:
            events.append(event)
    return out, tuple(events)


def _list_candidates(forward: Pass) -> tuple[list[tuple[str, int]], Candidates]:
    """Return the events whose errors the model has."""
    position = {int(error): index for index, error in enumerate(forward.model.active)}
    possible = [key for key, kind in EVENTS.items() if all(error in position for error, _ in kind.block)]
    shape = len(possible), LARGEST_EVENT
    indices, stds, sizes = np.zeros(shape, np.int64), np.ones(shape), np.zeros(shape[0], np.int64)
    for row, key in enumerate(possible):
        block = EVENTS[key].block
        sizes[row] = len(block)
        indices[row, : len(block)], stds[row, : len(block)] = zip(
            *((position[e], std) for e, std in block), strict=True
        )
    best = np.full((shape[0], 2 + 2 * shape[1]), -np.inf)
    earliest = round(1.0 / forward.ticks.inputs.period_s)  # an event in the first second would be an error of the start
    return possible, Candidates(indices, stds, sizes, earliest, best)


def make_trajectory(
    section: SectionModel, forward: Pass, smoothed: Smoothed, output_ns: Ints, explained: Hypothesis
) -> Trajectory:
    """Return the trajectory at the output stamps [ns]; its standard deviations include errors outside the filter."""
    m, noise, std, ticks = section.measurements, section.noise, section.std, forward.ticks
    at = np.searchsorted(ticks.stamp_ns, output_ns)
    rotation, velocity, rate = _make_motion(smoothed.states, ticks, at)
    position, variances = smoothed.states[at, 9:12], smoothed.variances[at]
    position_variance, yaw_variance, speed_variance = variances[:, :3], variances[:, 3], variances[:, 4]
    speed = np.linalg.norm(velocity, axis=1)
    links = _interpolate_displacement_variances(smoothed, at, output_ns)
    if m.gnss is not None and not m.gnss.has_heights:
        position_variance[:, 2] += MAX_VARIANCE
    if m.gnss is not None and not m.has_absolute_tilt:
        # On slopes that no sensor measures, an antenna of unknown height moves sideways.
        height_m2 = max(0.0, m.gnss.lever_arm_std_m[2] ** 2 - STATED_ARM_STD_M[2] ** 2)
        height_m2 += m.is_antenna_alone * m.gnss.lever_arm_m[2] ** 2
        links += np.minimum(GROUND * speed[:, None] * DISPLACEMENT_LAGS_S, 2.0 * SLOPE_RAD**2) * height_m2
    if m.gnss is not None and m.is_antenna_alone:  # assumed level, with the yaw of the course
        antenna = np.asarray(m.gnss.lever_arm_m)
        yaw = compute_course(velocity)
        rotation = matrix_from_quat(quat_from_rpy(0.0, 0.0, yaw))
        rate = np.zeros((yaw.size, 3))
        rate[:, 2] = np.gradient(yaw, (output_ns - output_ns[0]) * 1e-9) if yaw.size > 1 else 0.0
        yaw_variance = (np.pi / np.sqrt(3.0)) ** 2 * speed_variance / (speed_variance + speed**2)
        position -= rotation @ antenna
        position_variance[:, :2] += (yaw_variance * np.sum(antenna[:2] ** 2))[:, None]
        speed_variance += (UNSEEN_TURN_RADPS * antenna[2]) ** 2
    is_open = m.odometries() and not is_length_observable(m, noise.horizontal)
    scale_std = find_best_scale_std(m) if is_open else 0.0
    if m.gnss is None:
        position_variance += (scale_std * (position - position[0])) ** 2
    links += (scale_std * speed[:, None] * DISPLACEMENT_LAGS_S) ** 2
    return Trajectory(
        stamp_ns=output_ns,
        position_enu_m=position,
        quat_xyzw=quat_from_matrix(rotation),
        velocity_enu_mps=velocity,
        angular_velocity_radps=rate,
        position_std_m=np.sqrt(position_variance),
        yaw_std_rad=np.sqrt(yaw_variance),
        forward_velocity_std_mps=np.sqrt(speed_variance + (scale_std * speed) ** 2),
        rejections=_make_rejections(m, forward),
        displacement_std_m=np.sqrt(links),
        facts=_make_facts(m, forward, smoothed, std, scale_std, explained),
    )


def _make_motion(x: Floats, ticks: Ticks, at: Ints) -> tuple[Floats, Floats, Floats]:
    """Return attitude (N, 3, 3), velocity in ENU [m/s] and angular velocity in robot axes [rad/s], shapes (N, 3)."""
    imu = x[at, :9].reshape(-1, 3, 3)
    mount = x[at, Error.MOUNT + 6 : Error.MOUNT + 9]
    rotation = imu + np.cross(imu, mount[:, None])  # small-angle rotation
    rotation = matrix_from_quat(quat_from_matrix(rotation)) if mount.any() else imu
    velocity = np.einsum("nij,nj->ni", imu, x[at, Error.U + 6 : Error.U + 9])
    gyro = ticks.inputs.has_gyro[at, None]
    bias, scale = x[at, Error.GYRO_BIAS + 6 : Error.GYRO_BIAS + 9], x[at, Error.TURN_SCALE + 6, None]
    rate = (ticks.inputs.rate[at] - np.where(gyro, bias, 0.0)) * (1.0 - scale)
    return rotation, velocity, rate - np.cross(mount, rate)


def _interpolate_displacement_variances(smoothed: Smoothed, at: Ints, output_ns: Ints) -> Floats:
    """Return the variance of displacements at each output stamp [m²], shape (N, 6); NaN if the end is missing."""
    found = np.full((output_ns.size, len(DISPLACEMENT_LAGS_S)), np.nan)
    for column, lag_s in enumerate(DISPLACEMENT_LAGS_S):
        known = np.flatnonzero(np.isfinite(smoothed.displacement_m2[:, column]))
        if known.size == 0:
            continue
        found[:, column] = np.interp(at, known, smoothed.displacement_m2[known, column])
        later = output_ns + round(lag_s * 1e9)
        row = np.searchsorted(output_ns, later).clip(0, output_ns.size - 1)
        found[np.abs(output_ns[row] - later) > 0.1e9 * lag_s, column] = np.nan
    return found


def _list_rows(m: Measurements, forward: Pass) -> Mapping[int, tuple[Ints, Ints]]:
    """Return by kind of measurement the stamps of its rows, and the tick of each."""
    sensors = m.sensors()
    found = {}
    for kind, role in ROLES.items():
        if role in sensors and kind in forward.ticks.rows:
            ticks = forward.ticks.rows[kind]
            inside = (ticks >= 0) & (ticks < len(forward.tests.nis))
            found[kind] = sensors[role].stamp_ns[inside], ticks[inside]
    return found


def _make_rejections(m: Measurements, forward: Pass) -> dict[str, NDArray[Any]]:
    """Return the rejected measurements, in time order: columns of the level REJECTIONS."""
    parts = []
    for kind, (stamp_ns, tick) in _list_rows(m, forward).items():
        refused = forward.tests.verdict[tick, kind] == GateVerdict.REJECTED
        parts.append((stamp_ns[refused], np.full(int(refused.sum()), ROLES[kind]), forward.tests.nis[tick[refused], kind],
                      np.full(int(refused.sum()), forward.model.gates[kind])))  # fmt: skip
    names = "stamp_ns", "role", "normalized_innovation_squared", "threshold"
    columns = {name: np.concatenate(values) for name, values in zip(names, zip(*parts, strict=True), strict=True)}
    order = np.argsort(columns["stamp_ns"], kind="stable")
    return {name: values[order] for name, values in columns.items()} | {"reason": np.full(order.size, "gate")}


def _find_gate_resets(forward: Pass) -> tuple[GateReset, ...]:
    """Return each gate reset of the fixes: start of the rejections, and distance of the fixes from the track [m]."""
    verdict, stamp_ns = forward.tests.verdict[:, Kind.FIX], forward.ticks.stamp_ns
    rows = np.flatnonzero(verdict != GateVerdict.NONE)
    starts = rows[np.diff((verdict[rows] == GateVerdict.REJECTED).astype(np.int8), prepend=0) > 0]
    resets = np.flatnonzero(verdict == GateVerdict.RESET)
    return tuple(
        GateReset(
            int(stamp_ns[first]),
            int(stamp_ns[tick]),
            float(np.linalg.norm(forward.tests.fix_innovation[tick, :2])),
        )
        for first, tick in zip(starts[np.searchsorted(starts, resets) - 1], resets, strict=True)
    )


def _list_changes(forward: Pass, smoothed: Smoothed, explained: Hypothesis) -> Iterator[ChangeFacts]:
    """Yield the changes of the best hypothesis."""
    for change in explained.changes:
        last, size, role = change.last or len(forward.tests.nis) - 1, change.size, ROLES[change.role]
        if change.kind == "varies":
            indices = (
                (Error.WHEEL_SCALE, Error.WHEEL_SLIP) if role == WHEELS else (Error.VISUAL_SCALE, Error.VISUAL_SLIP)
            )
            size = float(smoothed.states[:, [index + 6 for index in indices]].sum(axis=1).std())
        start_ns, end_ns = forward.ticks.stamp_ns[[change.first, last]].tolist()
        yield ChangeFacts(change.kind, role, start_ns, end_ns, size)


def _make_facts(  # noqa: PLR0917
    m: Measurements, forward: Pass, smoothed: Smoothed, std: Floats, scale_std: float, explained: Hypothesis
) -> SectionFacts:
    rows = _list_rows(m, forward)
    tests = forward.tests
    nis, verdicts = {}, {}
    for role in dict.fromkeys(ROLES[kind] for kind in rows):
        kinds = [kind for kind in rows if ROLES[kind] == role]
        taken = np.concatenate([tests.nis[tests.verdict[:, kind] == GateVerdict.ACCEPTED, kind] for kind in kinds])
        nis[role] = float(taken.mean()) / state.SIZES[kinds[0]] if taken.size else None
        verdicts[role] = np.concatenate([tests.verdict[rows[kind][1], kind] for kind in kinds])
    return SectionFacts(
        nis_mean=nis,
        measurements={role: int(verdict.size) for role, verdict in verdicts.items()},
        rejected={role: int((verdict == GateVerdict.REJECTED).sum()) for role, verdict in verdicts.items()},
        gate_resets=_find_gate_resets(forward),
        changes=tuple(_list_changes(forward, smoothed, explained)),
        common_scale_std=scale_std,
        parameters=_describe_parameters(m, forward, smoothed, std),
    )


def _describe_parameters(
    m: Measurements, forward: Pass, smoothed: Smoothed, std: Floats
) -> Mapping[str, ParameterFacts]:
    """Return the estimate of each parameter that was not known exactly, at the end of the section."""
    active, found = list(forward.model.active), {}
    for parameter in PARAMETERS:
        errors = range(parameter.place, parameter.place + parameter.count)
        if not any(std[e] for e in errors):
            continue
        value = smoothed.states[-1, [e + 6 for e in errors]]
        if parameter.place == Error.ARM and m.gnss is not None:
            value = value - m.gnss.lever_arm_m
        spread = np.array([smoothed.stds[-1, active.index(e)] if e in active else 0.0 for e in errors])
        prior = std[list(errors)]
        varies = smoothed.states[:, [e + 6 for e in errors]].std(axis=0)
        found[parameter.name] = ParameterFacts(*(tuple(each.tolist()) for each in (value, spread, prior, varies)))
    return found
