"""The default estimator: error-state unscented filter forward, unscented smoother backward (kernels and equations: error_state_kernel).

Memory is bounded: the forward pass keeps a checkpoint per block of events; on the way back each block is filtered once more, this time
with everything kept, and smoothed. The second pass repeats the arithmetic of the first exactly, gates included.

Gates recover. A sensor that has been refused many times in a row and for a long time (GNSS 15 s, 5 s without visual odometry or IMU;
odometry 5 s, 0.3 s where nothing else tells velocity) is taken to be right and the filter wrong: the covariance is lifted by the
innovation before that update, which the smoother sees as process noise. Until then a multipath jump or a slipping wheel costs nothing but
listed refusals. Where more than a tenth of all fixes is refused, the receiver's variance is not what they scatter by (a wrong claim, or
a clock that is off): it is raised by 16 or 256 if that lets them in again, and the facts say so. Where fixes scatter far less than they
claim, the rest of their error lasts (satellite-based corrections wander by a metre in minutes): it is no noise that averages out. It is
added to every position's variance and, where it is larger than what odometry drifts by, such fixes count once in half a minute.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import FusionError
from tcpipe.fusion import error_state_kernel as kernel
from tcpipe.fusion.course import course_of
from tcpipe.fusion.gates import chi_square_gate
from tcpipe.fusion.measurements import GNSS, VISUAL, WHEELS, InitialState, Measurements, part
from tcpipe.fusion.process import (
    GROUND,
    SLOPE_RAD,
    UNSEEN_TURN_RADPS,
    VISUAL_SCALE_STD,
    WHEEL_SCALE_STD,
    glides,
    process_noise,
    scale_stds,
    turn_scale_std,
)
from tcpipe.fusion.signals import median_period_ns
from tcpipe.fusion.standing import standing_intervals
from tcpipe.fusion.timeline import EventTimeline, build_timeline
from tcpipe.fusion.trajectory import DISPLACEMENT_LAGS_S, Rejections, Trajectory
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_matrix, quat_from_rpy
from tcpipe.tables.findings import StretchFacts, vector

_WIDTH = 30  # of a row of outputs, see `error_state_kernel._saved`; 81 more with covariances
_BLOCK = 2048
_KEPT_BLOCKS = 12
"""Blocks whose forward pass is kept at once: about 2.2 kB an event, 55 MB."""

_Store = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]

_ROLES = {kernel.GNSS_POSITION: GNSS, kernel.WHEEL_VELOCITY: WHEELS, kernel.VISUAL_VELOCITY: VISUAL}
_DOF = {kernel.GNSS_POSITION: 3, kernel.WHEEL_VELOCITY: 1, kernel.VISUAL_VELOCITY: 3, kernel.STANDING: 3}
_DOF |= {kernel.STANDING_RATE: 3, kernel.SIDEWAYS: 2, kernel.LEVEL: 2}
_MANY_FIXES, _SCATTERS_LITTLE = 50, 0.5
_ODOMETRY_HOLDS_M = 0.1
"""What odometry drifts in half a minute: a lasting error of the fixes that is smaller is followed, a larger one is averaged."""
_LASTS_S = 30.0
_ANY_YAW_STD_RAD = np.pi / np.sqrt(3.0)
_LEVELLING_NS = 60_000_000_000
_NEVER = 1e18
_FIXED = 1e-6
_MANY_REFUSED = 0.1
_GNSS_FACTORS = (16.0, 256.0)
_LOCK_OUT = {
    kernel.GNSS_POSITION: (5.0, 15.0, 5.0),
    kernel.WHEEL_VELOCITY: (5.0, 5.0, 0.3),
    kernel.VISUAL_VELOCITY: (5.0, 5.0, 0.3),
}
"""Refusals in a row, and seconds since the last accepted measurement, after which a gate reopens; the seconds where no other sensor
of velocity is heard."""


def run_error_state(
    measurements: Measurements,
    initial: InitialState,
    *,
    output_ns: NDArray[np.int64],
    gate_probability: float = 0.999,
    smooth: bool = True,
    covariances: bool = False,
) -> Trajectory:
    """Filter and smooth one stretch.

    Parameters
    ----------
    measurements : at least one of GNSS, wheels and visual odometry.
    initial : state at the first measurement.
    output_ns : [ns], shape (N,), increasing: the wanted stamps.
    gate_probability : a measurement less likely than 1 minus this is refused.
    smooth : False gives the forward filter.
    covariances : keep the covariance of every state as well.

    Returns
    -------
    States at ``output_ns``, base_link in ENU.

    Raises
    ------
    FusionError
        The estimate is not finite.
    """
    if measurements.imu is None and output_ns.size:
        initial = _levelled(measurements, initial, output_ns, gate_probability)
    timeline = build_timeline(measurements, standing_intervals(measurements), output_ns)
    run = _Run(timeline, measurements, gate_probability, lags=_lags(output_ns), covariances=covariances)
    outputs = run.smoothed(initial) if smooth else run.filtered(initial)
    if run.refused_share(kernel.GNSS_POSITION) > _MANY_REFUSED:
        softer = _softened(run, initial, measurements, gate_probability)
        if softer is not None:
            run, outputs = softer, (softer.smoothed(initial) if smooth else softer.filtered(initial))
    lasting_m2 = _lasting_variance(run, measurements)
    if lasting_m2[0] > _ODOMETRY_HOLDS_M**2:
        run = _less_often(run, measurements, gate_probability, lasting_m2[0])
        outputs = run.smoothed(initial) if smooth else run.filtered(initial)
    run.lasting_m2 = lasting_m2
    run.unseen_scale_std = _unseen_scale_std(run, measurements)
    if not np.isfinite(outputs).all():
        raise FusionError("fusion: the estimate is not finite; look at the streams' values with tcpipe inspect --full")
    return _trajectory(timeline, outputs, run, output_ns)


def _levelled(
    measurements: Measurements, initial: InitialState, output_ns: NDArray[np.int64], gate_probability: float
) -> InitialState:
    """Return the start with the attitude that its first minute, smoothed, says it had: without an IMU it starts level, on any slope."""
    output_ns = output_ns[output_ns < output_ns[0] + _LEVELLING_NS]
    first = part(measurements, np.iinfo(np.int64).min, int(output_ns[-1]))
    timeline = build_timeline(first, standing_intervals(first), output_ns)
    outputs = _Run(timeline, first, gate_probability, lags=_lags(output_ns)).smoothed(initial)
    if not np.isfinite(outputs[0]).all():
        return initial
    return replace(initial, quat_xyzw=quat_from_matrix(outputs[0, 0:9].reshape(3, 3)))


def _softened(run: _Run, initial: InitialState, measurements: Measurements, gate_probability: float) -> _Run | None:
    """Return a run whose GNSS variances are raised until few fixes are refused; None where that does not help."""
    for factor in _GNSS_FACTORS:
        variance = run.timeline.variance.copy()
        variance[run.timeline.kind == kernel.GNSS_POSITION] *= factor
        trial = _Run(
            replace(run.timeline, variance=variance),
            measurements,
            gate_probability,
            lags=run.lags,
            covariances=run.covariances,
            gnss_factor=factor,
        )
        trial.filtered(initial)
        if trial.refused_share(kernel.GNSS_POSITION) <= _MANY_REFUSED:
            return trial
    return None


def _lasting_variance(run: _Run, measurements: Measurements) -> NDArray[np.float64]:
    """Return what the fixes err by together [m²], shape (3,): where they scatter far less than they claim, the rest of it lasts."""
    of_gnss = (run.timeline.kind == kernel.GNSS_POSITION) & (run.verdict == kernel.ACCEPTED)
    if measurements.gnss is None or of_gnss.sum() < _MANY_FIXES:
        return np.zeros(3)
    scatter = float(np.mean(run.nis[of_gnss])) / _DOF[kernel.GNSS_POSITION]
    share = 1.0 - scatter if scatter < _SCATTERS_LITTLE else 0.0
    return np.asarray(share * np.median(run.timeline.variance[of_gnss], axis=0))


def _unseen_scale_std(run: _Run, measurements: Measurements) -> float:
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
    return float(min(own, np.sqrt(2.0 * max(run.lasting_m2[0], few_m2)) / max(span_m, 1e-3)))


def _less_often(run: _Run, measurements: Measurements, gate_probability: float, lasting_m2: float) -> _Run:
    """Return a run that counts an error of the fixes that lasts once in half a minute, or less often where odometry knows no better."""
    gnss = measurements.gnss
    fixes = 1.0 if gnss is None else max(1.0, _LASTS_S * 1e9 / median_period_ns(gnss.stamp_ns))
    variance = run.timeline.variance.copy()
    variance[run.timeline.kind == kernel.GNSS_POSITION] *= min(fixes, lasting_m2 / _ODOMETRY_HOLDS_M**2)
    return _Run(
        replace(run.timeline, variance=variance),
        measurements,
        gate_probability,
        lags=run.lags,
        covariances=run.covariances,
        gnss_factor=run.gnss_factor,
    )


@dataclass(slots=True)
class _Memory:
    """What the filter carries from event to event."""

    x: NDArray[np.float64]
    P: NDArray[np.float64]
    refused: NDArray[np.float64]
    silent: NDArray[np.float64]

    def copy(self) -> _Memory:
        return _Memory(self.x.copy(), self.P.copy(), self.refused.copy(), self.silent.copy())


class _Run:
    """One timeline with its constants and what the gates said."""

    def __init__(
        self,
        timeline: EventTimeline,
        measurements: Measurements,
        gate_probability: float,
        *,
        lags: Sequence[int],
        covariances: bool = False,
        gnss_factor: float = 1.0,
    ) -> None:
        self.lags = lags
        self.covariances = covariances
        self._width = _WIDTH + 81 if covariances else _WIDTH
        self.timeline = timeline
        self.lasting_m2 = np.zeros(3)
        self.gnss_factor = gnss_factor
        count = timeline.stamp_ns.size
        self.nis = np.full(count, np.nan)
        self.verdict = np.zeros(count, np.int8)
        self.repairs = 0.0
        self.displacement_variance_m2 = np.full((timeline.output.max() + 1, len(DISPLACEMENT_LAGS_S)), np.nan)
        self.gates = np.full(8, np.inf)
        for kind in (*_ROLES, kernel.STANDING, kernel.STANDING_RATE):
            self.gates[kind] = chi_square_gate(_DOF[kind], gate_probability)
        self._levers = np.zeros((8, 3))
        for kind, source in (
            (kernel.GNSS_POSITION, measurements.gnss),
            (kernel.WHEEL_VELOCITY, measurements.wheels),
            (kernel.SIDEWAYS, measurements.wheels),
            (kernel.VISUAL_VELOCITY, measurements.visual),
        ):
            if source is not None:
                self._levers[kind] = source.lever_arm_m
        self._densities = process_noise(measurements)
        self._lock_out = np.full((8, 3), _NEVER)
        for kind, limits in _LOCK_OUT.items():
            self._lock_out[kind] = limits
        if measurements.visual is None or measurements.imu is None:  # what is left cannot overrule GNSS for long
            self._lock_out[kernel.GNSS_POSITION, 1] = _LOCK_OUT[kernel.GNSS_POSITION][2]
        if measurements.imu is None and measurements.visual is None:  # wheels that dig in must not overrule GNSS
            self._lock_out[kernel.GNSS_POSITION, 1:] = 1.0
        # Without GNSS nothing tells how long a metre of odometry is; an accelerometer has a scale and an alignment of its own.
        self.unseen_scale_std = 0.0
        # From positions alone forward and reverse look the same: yaw is the course, and may be anything.
        self.unseen_yaw_std = 0.0
        self.antenna_m = self._levers[kernel.GNSS_POSITION].copy()
        self.unplaced = measurements.gnss is None
        self.along_course = glides(measurements)
        if self.along_course:
            self._levers[:] = 0.0
        if measurements.imu is None and not measurements.odometries():
            self.unseen_yaw_std = _ANY_YAW_STD_RAD
        self.turn_scale_std = turn_scale_std(measurements)
        self.scale_stds = scale_stds(measurements)
        self.last: _Memory

    def refused_share(self, kind: int) -> float:
        """Share of the measurements of a kind that the gate refused."""
        verdict = self.verdict[self.timeline.kind == kind]
        return float(np.mean(verdict == kernel.REFUSED)) if verdict.size else 0.0

    def filtered(self, initial: InitialState) -> NDArray[np.float64]:
        """Forward states at the wanted stamps, rows as `error_state_kernel` saves them."""
        outputs = np.full((self.timeline.output.max() + 1, self._width), np.nan)
        memory = _start(initial, self.scale_stds, self.turn_scale_std)
        self._forward(0, self.timeline.stamp_ns.size, memory, outputs, None)
        self.last = memory
        return outputs

    def smoothed(self, initial: InitialState) -> NDArray[np.float64]:
        """Smoothed states at the wanted stamps."""
        count = self.timeline.stamp_ns.size
        outputs = np.full((self.timeline.output.max() + 1, self._width), np.nan)
        edges = [*range(0, count, _BLOCK), count]
        blocks = list(pairwise(edges))
        memory = _start(initial, self.scale_stds, self.turn_scale_std)
        checkpoints: list[_Memory] = []
        kept: dict[int, _Store] = {}
        for index, (first, last) in enumerate(blocks):
            checkpoints.append(memory.copy())
            if index >= len(blocks) - _KEPT_BLOCKS:
                kept[index] = self._store(first, last)
            self._forward(first, last, memory, outputs, kept.get(index))
        self.last = memory
        adjoint, information = np.zeros(kernel.N), np.zeros((kernel.N, kernel.N))
        links = _links(self.lags)
        for index in range(len(blocks) - 1, -1, -1):
            first, last = blocks[index]
            if index not in kept:
                kept[index] = self._store(first, last)
                self._forward(first, last, checkpoints[index], outputs, kept[index])
            kernel.smooth_block(
                first,
                last,
                self.timeline.output,
                kept.pop(index),
                adjoint,
                information,
                outputs,
                links,
                self.displacement_variance_m2,
            )
        return outputs

    def _store(self, first: int, last: int) -> _Store:
        """Return room for what the smoother wants of some events."""
        events, wanted = last - first, int(np.count_nonzero(self.timeline.output[first:last] >= 0))
        n = kernel.N
        return np.empty((events, 12, 9)), np.empty((events, 2, 3, n)), np.empty((events, 24)), np.empty((wanted, n, n))

    def _forward(
        self,
        first: int,
        last: int,
        memory: _Memory,
        outputs: NDArray[np.float64],
        store: _Store | None,
    ) -> None:
        t = self.timeline
        self.repairs += kernel.filter_block(
            first,
            last,
            t.dt_s,
            t.kind,
            t.mode,
            t.shake_m2ps3,
            t.value,
            t.variance,
            t.turn_rate_radps,
            t.force_mps2,
            t.turn_rate_now_radps,
            t.output,
            self._levers,
            self._densities,
            self.gates,
            self._lock_out,
            memory.x,
            memory.P,
            memory.refused,
            memory.silent,
            store is not None,
            store or self._store(0, 0),
            self.nis,
            self.verdict,
            outputs,
        )


def _links(lags: Sequence[int]) -> tuple[NDArray[Any], ...]:
    """Return what the smoother remembers to link each wanted stamp to those ``lags`` rows later, in the kernel's order.

    The chain from the event at hand to the next wanted stamp; by node and row (a ring) the chains over the node's lag; by row the columns
    of I - L P that belong to the position, and east, north with their smoothed covariance; by node the two nodes whose product it is;
    the nodes' lags; the nodes wanted. The first node is one row; a longer one is made of its halves.
    """
    nodes: dict[int, tuple[int, int]] = {}

    def add(lag: int) -> None:
        if lag not in nodes:
            halves = (lag - lag // 2, lag // 2)
            for half in halves if lag > 1 else ():
                add(half)
            nodes[lag] = halves

    for lag in (1, *lags):
        add(lag)
    index = {lag: k for k, lag in enumerate(nodes)}
    recipe = np.array([[index.get(half, 0) for half in halves] for halves in nodes.values()])
    size = max(nodes) + 1
    n = kernel.N
    chains = np.zeros((len(nodes), size, n, n))
    wanted = np.array([index[lag] for lag in lags])
    return np.eye(n), chains, np.zeros((size, n, 2)), np.zeros((size, 6)), recipe, np.array(list(nodes)), wanted


def _start(initial: InitialState, scale_stds: tuple[float, float], turn_scale_std: float = 0.0) -> _Memory:
    """Return the state at the start; with a scale error of the turn rate to be found in the place of the gyroscope's bias, or without."""
    x = np.zeros(kernel.NX)
    rotation = matrix_from_quat(initial.quat_xyzw)
    x[0:9] = rotation.ravel()
    bias_std = turn_scale_std or initial.gyro_bias_std_radps
    x[9:12] = 0.0 if turn_scale_std else initial.gyro_bias_radps
    x[15:18] = initial.velocity_enu_mps
    x[18:21] = initial.position_enu_m
    P = np.zeros((kernel.N, kernel.N))
    P[0:3, 0:3] = rotation.T @ np.diag(np.square([initial.tilt_std_rad] * 2 + [initial.yaw_std_rad])) @ rotation
    index = np.arange(3, kernel.N)
    P[index, index] = np.concatenate(
        (
            np.full(3, bias_std**2),
            np.full(3, 0.15**2),
            np.full(3, initial.velocity_std_mps**2),
            initial.position_std_m**2,
            np.square(np.maximum(scale_stds, _FIXED)),
        )
    )
    return _Memory(x, P, np.zeros(8), np.zeros(8))


def _trajectory(
    timeline: EventTimeline, outputs: NDArray[np.float64], run: _Run, output_ns: NDArray[np.int64]
) -> Trajectory:
    rate_radps = timeline.output_rate_radps
    if run.along_course:
        rate_radps = _look_along(outputs, output_ns, run.antenna_m)
    rotation = outputs[:, 0:9].reshape(-1, 3, 3)
    scale_std, speed_mps = run.unseen_scale_std, np.linalg.norm(outputs[:, 15:18], axis=1)
    outputs[:, 23:26] += run.lasting_m2
    if run.unplaced:
        outputs[:, 23:26] += (scale_std * (outputs[:, 18:21] - outputs[0, 18:21])) ** 2
    if run.covariances:
        for axis in range(3):
            outputs[:, _WIDTH + 10 * (6 + axis)] += run.lasting_m2[axis]
    if run.unseen_yaw_std:
        _doubt_yaw(outputs, rotation, run.unseen_yaw_std, run.antenna_m)
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
        rejections=_rejections(timeline, run),
        displacement_std_m=np.hypot(
            np.hypot(_displacement_std_m(run, output_ns), _sway_m(run, speed_mps)),
            scale_std * speed_mps[:, None] * DISPLACEMENT_LAGS_S,
        ),
        facts=_facts(timeline, run),
        covariance=outputs[:, _WIDTH:].reshape(-1, 9, 9) if run.covariances else None,
    )


def _look_along(
    outputs: NDArray[np.float64], output_ns: NDArray[np.int64], antenna_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Make the antenna's states the body's, level and along its course; return how fast that turns [rad/s], shape (N, 3)."""
    yaw = course_of(outputs[:, 15:18])
    rotation = matrix_from_quat(quat_from_rpy(0.0, 0.0, yaw))
    outputs[:, 0:9] = rotation.reshape(-1, 9)
    outputs[:, 18:21] -= rotation @ antenna_m
    # The antenna sways over ground that no sensor shows.
    outputs[:, 23:25] += (SLOPE_RAD * antenna_m[2]) ** 2
    outputs[:, 27] += (UNSEEN_TURN_RADPS * antenna_m[2]) ** 2
    rate = np.zeros((yaw.size, 3))
    if yaw.size > 1:
        rate[:, 2] = np.gradient(yaw, (output_ns - output_ns[0]) * 1e-9)
    return rate


def _sway_m(run: _Run, speed_mps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return by how much an antenna on a body of unseen attitude moves otherwise than the body over each displacement, shape (N, 4)."""
    if not run.along_course:
        return np.zeros((speed_mps.size, 1))
    tilt2 = np.minimum(GROUND * speed_mps[:, None] * DISPLACEMENT_LAGS_S, 2 * SLOPE_RAD**2)
    return np.asarray(np.sqrt(tilt2) * abs(run.antenna_m[2]))


def _doubt_yaw(
    outputs: NDArray[np.float64], rotation: NDArray[np.float64], yaw_std: float, antenna_m: NDArray[np.float64]
) -> None:
    """Add what cannot be known where yaw may be anything: itself, where below its antenna the robot is, and whether it drives forward."""
    velocity, beside = outputs[:, 15:18], rotation @ antenna_m
    aside2 = np.sum(beside[:, :2] ** 2, axis=1)
    above2 = 2 * (rotation[:, 2, :2] @ antenna_m[:2]) ** 2
    outputs[:, 23:26] += np.column_stack((aside2, aside2, above2))
    outputs[:, 26] += yaw_std**2
    outputs[:, 27] += 1.5 * np.sum(velocity**2, axis=1)
    if outputs.shape[1] > _WIDTH:
        up = rotation[:, 2, :]  # the vertical, in base_link's axes
        covariance = outputs[:, _WIDTH:].reshape(-1, 9, 9)
        covariance[:, :3, :3] += yaw_std**2 * up[:, :, None] * up[:, None, :]
        for row, doubt in ((6, aside2), (7, aside2), (8, above2)):
            covariance[:, row, row] += doubt


def _lags(output_ns: NDArray[np.int64]) -> list[int]:
    """Rows that each of `DISPLACEMENT_LAGS_S` spans."""
    period_s = median_period_ns(output_ns) * 1e-9 if output_ns.size > 1 else 1.0
    return [max(1, round(lag_s / period_s)) for lag_s in DISPLACEMENT_LAGS_S]


def _displacement_std_m(run: _Run, output_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    std = np.sqrt(run.displacement_variance_m2)
    for column, (lag, lag_s) in enumerate(zip(_lags(output_ns), DISPLACEMENT_LAGS_S, strict=True)):
        step_s = (output_ns[lag:] - output_ns[:-lag]) * 1e-9
        std[: step_s.size, column][np.abs(step_s - lag_s) > 0.1 * lag_s] = np.nan  # across a gap
    return std


def _rejections(timeline: EventTimeline, run: _Run) -> Rejections:
    refused = np.flatnonzero((run.verdict == kernel.REFUSED) & np.isin(timeline.kind, list(_ROLES)))
    kind = timeline.kind[refused]
    return Rejections(
        stamp_ns=timeline.stamp_ns[refused],
        role=np.array([_ROLES[int(k)] for k in kind], np.str_),
        reason=np.full(refused.size, "gate"),
        normalized_innovation_squared=run.nis[refused],
        threshold=run.gates[kind],
    )


def _facts(timeline: EventTimeline, run: _Run) -> StretchFacts:
    kinds = {role: timeline.kind == kind for kind, role in _ROLES.items() if (timeline.kind == kind).any()}
    taken = {role: of_kind & (run.verdict == kernel.ACCEPTED) for role, of_kind in kinds.items()}
    dof = {role: _DOF[kind] for kind, role in _ROLES.items()}
    x, deviation = run.last.x, np.sqrt(np.diag(run.last.P))
    return StretchFacts(
        nis_mean={role: float(run.nis[t].mean()) / dof[role] if t.any() else None for role, t in taken.items()},
        measurements={role: int(of_kind.sum()) for role, of_kind in kinds.items()},
        rejected={role: int((of_kind & (run.verdict == kernel.REFUSED)).sum()) for role, of_kind in kinds.items()},
        reopened={role: int((of_kind & (run.verdict == kernel.REOPENED)).sum()) for role, of_kind in kinds.items()},
        events=int(timeline.stamp_ns.size),
        standing_updates=int((timeline.kind == kernel.STANDING).sum()),
        gnss_variance_factor=run.gnss_factor,
        gnss_lasting_error_m=float(np.sqrt(run.lasting_m2[0])),
        covariance_repairs=int(run.repairs),
        gyro_bias_radps=None if run.turn_scale_std else vector(x[9:12]),
        turn_scale=float(1 + x[11]) if run.turn_scale_std else None,
        accelerometer_bias_mps2=vector(x[12:15]),
        wheel_scale=float(1 + x[21]),
        wheel_scale_std=float(max(deviation[15], run.unseen_scale_std)),
        visual_scale=float(1 + x[22]),
        visual_scale_std=float(max(deviation[16], run.unseen_scale_std)),
        common_scale_std=run.unseen_scale_std,
    )
