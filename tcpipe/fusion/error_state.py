"""The default estimator: an error-state unscented filter on SE(3), and its smoother (`filter_kernel`: equations).

Where sensors contradict each other for long, changes are searched that explain it (`changes`), and the section is
estimated again.

Memory is bounded: the forward pass keeps a checkpoint for each block of ticks; on the way back each block is filtered
once more, this time with everything kept. The second filter repeats the arithmetic of the first exactly, gates
included.
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
    NO_LEVER_ARM,
    NO_TRUST,
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
from tcpipe.fusion.smoother_kernel import LARGEST_EVENT, SELDOM, Candidates, Smoothed, make_adjoint, smooth_ticks
from tcpipe.fusion.state import Error, Kind
from tcpipe.fusion.ticks import Pass, Ticks, build_ticks
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_matrix, quat_from_rpy
from tcpipe.robust import MIN_SIGMAS
from tcpipe.tables.facts import ChangeFacts, GateReset, ParameterFacts, StretchFacts
from tcpipe.tables.findings import Subject, make_finding, read_threshold

_UNCHANGED = Hypothesis(())
_BLOCK = 1024
"""Ticks between checkpoints."""
_MIN_EVENT_GAIN = 20.0
"""Least log evidence of an event beyond its cost [nat]: the best of a section's ticks reaches 12 by chance."""


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
    # The first minute is filtered twice: the second time from the attitude and yaw that it shows of its beginning.
    minute = round(60.0 / section.ticks.inputs.period_s)
    levelled, _ = smooth_section(section.filter(start, until=minute), with_displacements=False)
    start.x[:9] = levelled.states[0, :9]
    made = section.filter(start)
    smoothed, events = smooth_section(made)
    if (corrected := section.correct_arm(made, smoothed)) is not section:
        section = corrected
        start = section.make_start(initial)._replace(x=start.x)
        made = section.filter(start)
        smoothed, events = smooth_section(made)
    if _can_tell_changes(section.measurements):
        explanation = section.explain(made, events, start)
    if explanation.changes:
        made = section.filter(start, explanation)
        smoothed, _ = smooth_section(made)
    if not np.isfinite(smoothed.states).all():
        finding = make_finding("estimate-not-finite", Subject("run", ""))
        raise FusionError("the estimate is not finite", findings=[finding])
    return make_trajectory(section, made, smoothed, output_ns, explanation)


def _can_tell_changes(m: Measurements) -> bool:
    """Return whether another sensor shows the change, and fixes are no worse than a minute without them.

    An IMU and an odometry carry it, or a camera that sees all turns. Two odometries without fixes and IMU do not show
    which of them changed.
    """
    if m.gnss is None:
        return len(m.odometries()) > 1 and m.imu is not None
    carries = (
        bool(m.odometries()) if m.imu is not None else m.visual is not None and m.visual.turn_rate_radps is not None
    )
    return carries and float(np.median(m.gnss.variance_m2[:, 0])) < 0.5**2  # m²; motion carries the pose better


def prepare_section(m: Measurements, output_ns: Ints, gate_probability: float) -> SectionModel:
    """Return what an estimator needs of a section: its noise comes from the residuals of all pairs of sensors."""
    residuals, standing = find_residuals(m), find_stationary_intervals(m)
    m = inflate_unclaimed_fixes(m, residuals)
    noise = fit_noise(m, residuals)
    start_ns = [int(sensor.stamp_ns[0]) for role, sensor in m.sensors().items() if role != IMU]
    first_ns, last_ns = min([*start_ns, int(output_ns[0])]), int(output_ns[-1])
    ticks = build_ticks(m, noise, standing, first_ns, last_ns, output_ns=output_ns)
    return SectionModel(m, noise, ticks, make_priors(m, noise, ticks)[0], gate_probability)


@dataclass(frozen=True, slots=True)
class SectionModel:
    """A section as estimators take it, under one hypothesis or another.

    ``std`` is the standard deviation of every error before the measurements, shape (45,).
    """

    measurements: Measurements
    noise: NoiseModel
    ticks: Ticks
    std: Floats
    gate_probability: float

    def make_start(self, initial: InitialState) -> Memory:
        """Return the state of all errors at the first tick."""
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
        """Return the forward pass under a hypothesis from a start of all errors.

        One that ``judges`` holds all errors that an event could change, and follows no fix that is rejected. With
        ``kept`` measurements, (K, 9, 3), the pass uses those, without a gate.
        """
        ticks, model, begin = self.prepare(start, hypothesis, judges=judges)
        if kept is not None:
            ticks = replace(ticks, inputs=ticks.inputs._replace(value=kept))
            model = model._replace(gates=np.full(state.KINDS, np.inf))
            exact = [
                place for place, error in enumerate(model.active) if error in POSSIBLE and not begin.P[place, place]
            ]
            begin.P[exact, exact] = 1e-4**2  # sigma points need a width
        return filter_section(ticks, model, begin, until=until)

    def prepare(
        self, start: Memory, hypothesis: Hypothesis = _UNCHANGED, *, judges: bool = False
    ) -> tuple[Ticks, FilterModel, Memory]:
        """Return ticks, model and start of a pass under a hypothesis; see `filter`."""
        ticks = hypothesis.alter_ticks(self.ticks)
        std, walk, time_s = make_priors(self.measurements, self.noise, ticks)
        hypothesis.alter_priors(std, walk, time_s)
        if judges and self.measurements.imu is not None:  # a jump of the bias has made the walk that was fitted larger
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

    def correct_arm(self, made: Pass, smoothed: Smoothed) -> SectionModel:
        """Return the section with an antenna of unknown place if it surely shows another than stated; else itself."""
        gnss, active = self.measurements.gnss, list(made.model.active)
        if gnss is None or Error.ARM not in active:
            return self
        off = np.abs(smoothed.states[-1, Error.ARM + 6 : Error.ARM + 9] - gnss.lever_arm_m)
        place = active.index(Error.ARM)
        known = smoothed.spreads[-1, place : place + 3]
        if not (off > np.maximum(2.0 * np.asarray(gnss.lever_arm_std_m), MIN_SIGMAS * known)).any():
            return self
        m = replace(self.measurements, gnss=replace(gnss, lever_arm_std_m=UNSTATED_ARM_STD_M))
        return replace(self, measurements=m, std=make_priors(m, self.noise, self.ticks)[0])

    def explain(self, made: Pass, events: Sequence[Change], start: Memory) -> Hypothesis:
        """Return the changes that explain most of where sensors contradict each other, none where they do not.

        ``events`` explain much of the pass ``made``.
        """
        period_s, most = self.ticks.inputs.period_s, read_threshold("changes-unlikely", "max_change_count")
        if not events and not is_contradicted(made.tests, period_s):
            return _UNCHANGED
        plain, tests = self._judge((), start)
        best, tests_of_best = self._add_events(plain, tests, start)
        if len(best.changes) <= most and not is_contradicted(tests_of_best, period_s):
            return best
        # Errors may be larger than usual throughout: many changes would explain that, too.
        larger, tests = self._find_larger_errors(plain, tests, start)
        if not larger.changes:
            return best
        larger, _ = self._add_events(larger, tests, start)
        return larger if len(best.changes) > most else max(best, larger, key=lambda each: each.score)

    def _find_larger_errors(self, plain: Hypothesis, tests: Tests, start: Memory) -> tuple[Hypothesis, Tests]:
        """Return the most likely errors that are larger than usual throughout, and the tests under them."""
        best, sensors = (plain, tests), self.measurements.sensors()
        kinds = {key: sizes for key, sizes in LARGER_ERRORS.items() if ROLES[key[1]] in sensors}
        while kinds:
            tried = {
                key: self._judge((*best[0].changes, Change(*key, 0, size=sizes[0])), start)
                for key, sizes in kinds.items()
            }
            top = max(tried, key=lambda key: tried[key][0].score)
            # Gains are -5 to 59 nat on clean runs, above 1,000 on stepped ones.
            if tried[top][0].score <= best[0].score + 100.0:
                break
            others, best = best[0].changes, tried[top]
            for size in kinds.pop(top)[1:]:
                larger = self._judge((*others, Change(*top, 0, size=size)), start)
                if larger[0].score <= best[0].score + 8.0:  # nat; gain by a larger error
                    break
                best = larger
        return best

    def _add_events(self, given: Hypothesis, tests: Tests, start: Memory) -> tuple[Hypothesis, Tests]:
        """Return a hypothesis with the events that explain most beyond it, one by one; ``tests`` are of its pass."""
        best, events = (given, tests), list[Change]()
        for _ in range(6):  # two of them may be one change
            kept = drop_outliers(self.ticks, best[1])
            hypothesis = replace(given, changes=(*given.changes, *events))
            likely = smooth_section(self.filter(start, hypothesis, judges=True, kept=kept), with_displacements=False)[1]
            if not likely:
                break
            events.append(likely[0])
            best = self._judge((*given.changes, *join_events(events)), start)
        return best

    def _judge(self, changes: Sequence[Change], start: Memory) -> tuple[Hypothesis, Tests]:
        """Return the hypothesis of some changes, and the tests of its pass.

        Its score is the log likelihood of all measurements, less the costs of the changes.
        """
        made = self.filter(start, Hypothesis(tuple(changes)), judges=True)
        score = compute_evidence(made.tests, made.model.gates) - sum(change.cost for change in changes)
        return Hypothesis(tuple(changes), score), made.tests


def make_tests(size: int) -> Tests:
    """Return tests to be filled."""
    shape = size, state.KINDS
    return Tests(np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, np.int8), np.full((size, 3), np.nan))


def _list_blocks(size: int) -> list[tuple[int, int]]:
    """Return first and last tick, the latter excluded, of each block."""
    return list(pairwise([*range(0, size, _BLOCK), size]))


def filter_section(ticks: Ticks, model: FilterModel, start: Memory, *, until: int | None = None) -> Pass:
    """Return the forward pass from a start, over all ticks or those before ``until``."""
    size = min(until or ticks.stamp_ns.size, ticks.stamp_ns.size)
    made = Pass(ticks, model, [], make_tests(size), start.copy())
    empty = allocate_steps(0, model.active.size)
    for first, last in _list_blocks(size):
        made.checkpoints.append(made.last.copy())
        filter_ticks(first, last, ticks.inputs, model, made.last, empty, made.tests)
    return made


def smooth_section(made: Pass, *, with_displacements: bool = True) -> tuple[Smoothed, tuple[Change, ...]]:
    """Return the smoothed estimate of a forward pass, and events worth more than their cost, the most likely first."""
    size, n = len(made.tests.nis), made.model.active.size
    lags = np.array([round(lag_s / made.ticks.inputs.period_s) for lag_s in DISPLACEMENT_LAGS_S])
    adjoint = make_adjoint(n, int(lags.max()) if with_displacements else 0)
    possible, candidates = _list_candidates(made)
    out = Smoothed(
        np.zeros((size, state.NX)),
        np.zeros((size, 5)),
        np.full((size, lags.size), np.nan),
        np.zeros((-(-size // SELDOM), n)),
    )
    steps = allocate_steps(min(size, _BLOCK), n)
    for (first, last), memory in zip(reversed(_list_blocks(size)), reversed(made.checkpoints), strict=True):
        steps.used[:] = False
        filter_ticks(first, last, made.ticks.inputs, made.model, memory.copy(), steps, made.tests)
        smooth_ticks(first, last, made.ticks.inputs, made.model, steps, lags, adjoint, candidates, out)
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


def _list_candidates(made: Pass) -> tuple[list[tuple[str, int]], Candidates]:
    """Return the events whose errors the model has."""
    position = {int(error): place for place, error in enumerate(made.model.active)}
    possible = [key for key, kind in EVENTS.items() if all(error in position for error, _ in kind.block)]
    shape = len(possible), LARGEST_EVENT
    places, stds, sizes = np.zeros(shape, np.int64), np.ones(shape), np.zeros(shape[0], np.int64)
    for row, key in enumerate(possible):
        block = EVENTS[key].block
        sizes[row] = len(block)
        places[row, : len(block)], stds[row, : len(block)] = zip(*((position[e], std) for e, std in block), strict=True)
    best = np.full((shape[0], 2 + 2 * shape[1]), -np.inf)
    earliest = round(1.0 / made.ticks.inputs.period_s)  # an event of the first second is an error of the start
    return possible, Candidates(places, stds, sizes, earliest, best)


def make_trajectory(
    section: SectionModel, made: Pass, smoothed: Smoothed, output_ns: Ints, explained: Hypothesis
) -> Trajectory:
    """Return the trajectory at the wanted stamps [ns]; its standard deviations include errors outside the filter."""
    m, noise, std, ticks = section.measurements, section.noise, section.std, made.ticks
    at = np.searchsorted(ticks.stamp_ns, output_ns)
    rotation, velocity, rate = _make_motion(smoothed.states, ticks, at)
    position, variances = smoothed.states[at, 9:12], smoothed.variances[at]
    position_variance, yaw_variance, speed_variance = variances[:, :3], variances[:, 3], variances[:, 4]
    speed = np.linalg.norm(velocity, axis=1)
    links = _interpolate_links(smoothed, at, output_ns)
    if m.gnss is not None and not m.gnss.has_heights:
        position_variance[:, 2] += NO_TRUST
    if m.gnss is not None and not m.has_absolute_tilt:
        # On slopes that nothing measures an antenna of unknown height moves sideways.
        height_m2 = max(0.0, m.gnss.lever_arm_std_m[2] ** 2 - STATED_ARM_STD_M[2] ** 2)
        height_m2 += m.is_antenna_alone * m.gnss.lever_arm_m[2] ** 2
        links += np.minimum(GROUND * speed[:, None] * DISPLACEMENT_LAGS_S, 2.0 * SLOPE_RAD**2) * height_m2
    if m.gnss is not None and m.is_antenna_alone:  # level, and along the course
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
        rejections=_make_rejections(m, made),
        displacement_std_m=np.sqrt(links),
        facts=_make_facts(m, made, smoothed, std, scale_std, explained),
    )


def _make_motion(x: Floats, ticks: Ticks, at: Ints) -> tuple[Floats, Floats, Floats]:
    """Return attitude (N, 3, 3), velocity in ENU [m/s] and angular velocity in robot axes [rad/s], shapes (N, 3)."""
    imu = x[at, :9].reshape(-1, 3, 3)
    mount = x[at, Error.MOUNT + 6 : Error.MOUNT + 9]
    rotation = imu + np.cross(imu, mount[:, None])  # a small turn
    rotation = matrix_from_quat(quat_from_matrix(rotation)) if mount.any() else imu
    velocity = np.einsum("nij,nj->ni", imu, x[at, Error.U + 6 : Error.U + 9])
    gyro = ticks.inputs.has_gyro[at, None]
    bias, scale = x[at, Error.GYRO_BIAS + 6 : Error.GYRO_BIAS + 9], x[at, Error.TURN_SCALE + 6, None]
    rate = (ticks.inputs.rate[at] - np.where(gyro, bias, 0.0)) * (1.0 - scale)
    return rotation, velocity, rate - np.cross(mount, rate)


def _interpolate_links(smoothed: Smoothed, at: Ints, output_ns: Ints) -> Floats:
    """Return the variance of displacements at each wanted stamp [m²], shape (N, 6); NaN without another end."""
    found = np.full((output_ns.size, len(DISPLACEMENT_LAGS_S)), np.nan)
    for column, lag_s in enumerate(DISPLACEMENT_LAGS_S):
        known = np.flatnonzero(np.isfinite(smoothed.links[:, column]))
        if known.size == 0:
            continue
        found[:, column] = np.interp(at, known, smoothed.links[known, column])
        later = output_ns + round(lag_s * 1e9)
        row = np.searchsorted(output_ns, later).clip(0, output_ns.size - 1)
        found[np.abs(output_ns[row] - later) > 0.1e9 * lag_s, column] = np.nan
    return found


def _list_rows(m: Measurements, made: Pass) -> Mapping[int, tuple[Ints, Ints]]:
    """Return by kind of measurement the stamps of its rows, and the tick of each."""
    sensors = m.sensors()
    found = {}
    for kind, role in ROLES.items():
        if role in sensors and kind in made.ticks.rows:
            ticks = made.ticks.rows[kind]
            inside = (ticks >= 0) & (ticks < len(made.tests.nis))
            found[kind] = sensors[role].stamp_ns[inside], ticks[inside]
    return found


def _make_rejections(m: Measurements, made: Pass) -> dict[str, NDArray[Any]]:
    """Return the rejected measurements, in time order: columns of the level REJECTIONS."""
    parts = []
    for kind, (stamp_ns, tick) in _list_rows(m, made).items():
        refused = made.tests.verdict[tick, kind] == GateVerdict.REJECTED
        parts.append((stamp_ns[refused], np.full(int(refused.sum()), ROLES[kind]), made.tests.nis[tick[refused], kind],
                      np.full(int(refused.sum()), made.model.gates[kind])))  # fmt: skip
    names = "stamp_ns", "role", "normalized_innovation_squared", "threshold"
    columns = {name: np.concatenate(values) for name, values in zip(names, zip(*parts, strict=True), strict=True)}
    order = np.argsort(columns["stamp_ns"], kind="stable")
    return {name: values[order] for name, values in columns.items()} | {"reason": np.full(order.size, "gate")}


def _find_gate_resets(made: Pass) -> tuple[GateReset, ...]:
    """Return each gate reset of the fixes: since when they were rejected, and how far they were off [m]."""
    verdict, stamp_ns = made.tests.verdict[:, Kind.FIX], made.ticks.stamp_ns
    rows = np.flatnonzero(verdict != GateVerdict.NONE)
    starts = rows[np.diff((verdict[rows] == GateVerdict.REJECTED).astype(np.int8), prepend=0) > 0]
    resets = np.flatnonzero(verdict == GateVerdict.RESET)
    return tuple(
        GateReset(int(stamp_ns[first]), int(stamp_ns[tick]), float(np.linalg.norm(made.tests.fix_innovation[tick, :2])))
        for first, tick in zip(starts[np.searchsorted(starts, resets) - 1], resets, strict=True)
    )


def _list_changes(made: Pass, smoothed: Smoothed, explained: Hypothesis) -> Iterator[ChangeFacts]:
    """Yield the changes that explain the run best."""
    for change in explained.changes:
        last, size, role = change.last or len(made.tests.nis) - 1, change.size, ROLES[change.role]
        if change.kind == "varies":
            places = (
                (Error.WHEEL_SCALE, Error.WHEEL_SLIP) if role == WHEELS else (Error.VISUAL_SCALE, Error.VISUAL_SLIP)
            )
            size = float(smoothed.states[:, [place + 6 for place in places]].sum(axis=1).std())
        start_ns, end_ns = made.ticks.stamp_ns[[change.first, last]].tolist()
        yield ChangeFacts(change.kind, role, start_ns, end_ns, size)


def _make_facts(  # noqa: PLR0917
    m: Measurements, made: Pass, smoothed: Smoothed, std: Floats, scale_std: float, explained: Hypothesis
) -> StretchFacts:
    rows = _list_rows(m, made)
    tests = made.tests
    nis, verdicts = {}, {}
    for role in dict.fromkeys(ROLES[kind] for kind in rows):
        kinds = [kind for kind in rows if ROLES[kind] == role]
        taken = np.concatenate([tests.nis[tests.verdict[:, kind] == GateVerdict.ACCEPTED, kind] for kind in kinds])
        nis[role] = float(taken.mean()) / state.SIZES[kinds[0]] if taken.size else None
        verdicts[role] = np.concatenate([tests.verdict[rows[kind][1], kind] for kind in kinds])
    return StretchFacts(
        nis_mean=nis,
        measurements={role: int(verdict.size) for role, verdict in verdicts.items()},
        rejected={role: int((verdict == GateVerdict.REJECTED).sum()) for role, verdict in verdicts.items()},
        gate_resets=_find_gate_resets(made),
        changes=tuple(_list_changes(made, smoothed, explained)),
        common_scale_std=scale_std,
        parameters=_describe_parameters(m, made, smoothed, std),
    )


def _describe_parameters(m: Measurements, made: Pass, smoothed: Smoothed, std: Floats) -> Mapping[str, ParameterFacts]:
    """Return what the section showed of each parameter that was not known exactly, at its end."""
    active, found = list(made.model.active), {}
    for parameter in PARAMETERS:
        errors = range(parameter.place, parameter.place + parameter.count)
        if not any(std[e] for e in errors):
            continue
        value = smoothed.states[-1, [e + 6 for e in errors]]
        if parameter.place == Error.ARM and m.gnss is not None:
            value = value - m.gnss.lever_arm_m
        spread = np.array([smoothed.spreads[-1, active.index(e)] if e in active else 0.0 for e in errors])
        prior = std[list(errors)]
        varies = smoothed.states[:, [e + 6 for e in errors]].std(axis=0)
        found[parameter.name] = ParameterFacts(*(tuple(each.tolist()) for each in (value, spread, prior, varies)))
    return found
