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
from tcpipe.fusion.fix_errors import FixErrors, find_fix_errors
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
from tcpipe.tables.findings import Reopening, StretchFacts, vector

_WIDTH = kernel.SAVED  # of a row of outputs; 81 more with covariances
_BLOCK = 2048
_KEPT_BLOCKS = 12
"""Blocks whose forward pass is kept at once: about 2.2 kB an event, 55 MB."""

_Store = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]

_ROLES = {kernel.GNSS_POSITION: GNSS, kernel.WHEEL_VELOCITY: WHEELS, kernel.VISUAL_VELOCITY: VISUAL}
_DOF = {kernel.GNSS_POSITION: 3, kernel.WHEEL_VELOCITY: 1, kernel.VISUAL_VELOCITY: 3, kernel.STANDING: 3}
_DOF |= {kernel.STANDING_RATE: 3, kernel.SIDEWAYS: 2, kernel.LEVEL: 2}
_MANY_FIXES = 50
_LEAST_ERROR_M = 1e-4
_NO_ERROR = np.empty(0)
_ANY_YAW_STD_RAD = np.pi / np.sqrt(3.0)
_LEVELLING_NS = 60_000_000_000
_NEVER = 1e18
_FIXED = 1e-6
_LOCK_OUT = {
    kernel.GNSS_POSITION: (5.0, 15.0, 5.0),
    kernel.WHEEL_VELOCITY: (5.0, 5.0, 0.3),
    kernel.VISUAL_VELOCITY: (5.0, 5.0, 0.3),
}
_DOUBTED = (5.0, 2.0, 2.0, 1.0)
_GROWS_NS = 3_000_000_000
_PASSES = 3
_ODOMETRY_HOLDS_M, _LASTS_S = 0.1, 30.0
_CARRIED_M = 0.5
"""Refusals in a row, and seconds since the last accepted measurement, after which a gate reopens; the seconds where no other sensor
of velocity is heard. `_DOUBTED`: the same of fixes whose error is part of the state; the 1 says that it is lifted, and not the pose."""


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
    standing = standing_intervals(measurements)
    errors = find_fix_errors(measurements)
    suspects: tuple[Reopening, ...] = ()
    doubted = errors is not None and errors.matters
    for _ in range(_PASSES):
        heard = _counted(measurements, errors, doubted=doubted)
        timeline = build_timeline(heard, standing, output_ns)
        run = _Run(timeline, heard, gate_probability, lags=_lags(output_ns), covariances=covariances)
        if doubted:
            run.doubt_fixes(errors, suspects)
        outputs = run.filtered(initial, keep=smooth)
        found = tuple(reopening for reopening in _reopenings(timeline, run) if reopening.role == GNSS)
        if suspects or not (run.fixes_contradict() if not doubted else run.carried and found):
            break
        # Once more: with an error of the fixes as part of the state, then with what led up to where they were off.
        doubted, suspects = True, found if doubted else ()
    run.suspects = suspects
    if smooth:
        run.smooth(outputs)
    if errors is not None and not doubted:
        run.lasting_m2 = _at_outputs(errors, heard, output_ns)
    run.unseen_scale_std = _unseen_scale_std(run, heard)
    if not np.isfinite(outputs).all():
        raise FusionError("fusion: the estimate is not finite; look at the streams' values with tcpipe inspect --full")
    return _trajectory(timeline, outputs, run, output_ns)


def _counted(measurements: Measurements, errors: FixErrors | None, *, doubted: bool) -> Measurements:
    """Return the measurements with the variance of fixes that counts from one to the next: the claim, where nothing else holds the rest."""
    if errors is None or measurements.gnss is None:
        return measurements
    gnss = measurements.gnss
    variance = errors.white_m2 if doubted else np.maximum(errors.white_m2, gnss.variance_m2)
    if errors.of_metres:  # odometry knows better for half a minute: so often they count
        together = max(1.0, _LASTS_S * 1e9 / median_period_ns(gnss.stamp_ns))
        lasting_m2 = np.median(errors.lasting_m2[:, 0])
        variance = np.maximum(variance, errors.lasting_m2) * min(together, lasting_m2 / _ODOMETRY_HOLDS_M**2)
    return replace(measurements, gnss=replace(measurements.gnss, variance_m2=variance))


def _at_outputs(errors: FixErrors, measurements: Measurements, output_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return what lasts of the fixes' errors at each wanted stamp [m²], shape (N, 3)."""
    if measurements.gnss is None:
        return np.zeros((output_ns.size, 3))
    nearest = np.searchsorted(measurements.gnss.stamp_ns, output_ns).clip(0, measurements.gnss.stamp_ns.size - 1)
    return np.asarray(errors.lasting_m2[nearest])


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
    lasting_m2 = run.lasting_error_m() ** 2
    return float(min(own, np.sqrt(2.0 * max(lasting_m2, few_m2)) / max(span_m, 1e-3)))


@dataclass(slots=True)
class _Memory:
    """What the filter carries from event to event."""

    x: NDArray[np.float64]
    P: NDArray[np.float64]
    refused: NDArray[np.float64]
    silent: NDArray[np.float64]
    opened: NDArray[np.float64]

    def copy(self) -> _Memory:
        return _Memory(self.x.copy(), self.P.copy(), self.refused.copy(), self.silent.copy(), self.opened.copy())


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
    ) -> None:
        self.lags = lags
        self.covariances = covariances
        self._width = _WIDTH + 81 if covariances else _WIDTH
        self.timeline = timeline
        self.lasting_m2 = np.zeros((1, 3))
        count = timeline.stamp_ns.size
        self.nis = np.full(count, np.nan)
        self.innovation = np.full((count, 3), np.nan)
        self.suspects: tuple[Reopening, ...] = ()
        self.start_error_m2 = np.empty(0)  # of the fixes, where the state holds it
        self.kept_error, self.error_noise_m2 = np.ones(count), np.zeros((count, 3))
        self.error_level_m2 = np.zeros((count, 3))
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
        self._lock_out = np.full((8, 4), _NEVER)
        for kind, limits in _LOCK_OUT.items():
            self._lock_out[kind] = (*limits, 0.0)
        gnss, carriers = measurements.gnss, measurements.imu is not None and bool(measurements.odometries())
        self.carried = carriers and gnss is not None and float(np.median(gnss.variance_m2[:, 0])) < _CARRIED_M**2
        if measurements.visual is None or measurements.imu is None:  # what is left cannot overrule GNSS for long
            self._lock_out[kernel.GNSS_POSITION, 1] = _LOCK_OUT[kernel.GNSS_POSITION][2]
        if measurements.imu is None and measurements.visual is None:  # wheels that dig in must not overrule GNSS
            self._lock_out[kernel.GNSS_POSITION, 1:3] = 1.0
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

    def doubt_fixes(self, errors: FixErrors | None, suspects: Sequence[Reopening]) -> None:
        """Make the fixes' own error part of the state: a Gauss-Markov process, as large and as lasting as they are of their kind.

        In the seconds before they were found to be off, ``suspects``, it may have grown already.
        """
        stamp_ns = self.timeline.stamp_ns[self.timeline.kind == kernel.GNSS_POSITION]
        if errors is None or stamp_ns.size == 0:
            return
        fix = np.searchsorted(stamp_ns, self.timeline.stamp_ns, "right").clip(1, stamp_ns.size) - 1
        lasting_m2 = np.maximum(errors.lasting_m2, _LEAST_ERROR_M**2)
        for off in suspects:
            before = (stamp_ns > off.start_ns - _GROWS_NS) & (stamp_ns < off.start_ns)
            lasting_m2[before] = np.maximum(lasting_m2[before], max(off.size, kernel.OFF_M) ** 2)
        lasting_m2 = lasting_m2[fix]
        # What comes with another kind of fix comes when time passes next.
        passes = np.maximum.accumulate(np.where(self.timeline.dt_s > 0, np.arange(fix.size), 0))
        lasting_m2 = lasting_m2[passes]
        before = np.concatenate((lasting_m2[:1], lasting_m2[:-1]))
        shrunk = np.sqrt(np.minimum(1.0, lasting_m2[:, 0] / before[:, 0]))
        self.kept_error = np.exp(-self.timeline.dt_s / errors.lasts_s[fix]) * shrunk
        self.error_noise_m2 = np.maximum(lasting_m2 - self.kept_error[:, None] ** 2 * before, 0.0)
        self.error_level_m2 = lasting_m2
        self.start_error_m2 = lasting_m2[0]
        if self.carried:
            self._lock_out[kernel.GNSS_POSITION] = _DOUBTED

    def fixes_contradict(self) -> bool:
        """Return whether fixes were refused for seconds on end while the other sensors carried the pose: they may err together."""
        of_gnss = np.flatnonzero(self.timeline.kind == kernel.GNSS_POSITION)
        if not self.carried or of_gnss.size == 0:
            return False
        refused = self.verdict[of_gnss] != kernel.ACCEPTED
        edges = np.flatnonzero(np.diff(np.concatenate(([0], refused.astype(np.int8), [0]))))
        first, last = edges[::2], edges[1::2] - 1
        long_s = (self.timeline.stamp_ns[of_gnss[last]] - self.timeline.stamp_ns[of_gnss[first]]) * 1e-9
        if ((last - first + 1 >= _DOUBTED[0]) & (long_s >= _DOUBTED[1])).any():
            return True
        heard = of_gnss[~refused]
        normal = self.innovation[heard] / np.sqrt(self.timeline.variance[heard])
        return bool(kernel.most_drift(normal) > kernel.SURELY * self.gates[kernel.GNSS_POSITION])

    def filtered(self, initial: InitialState, *, keep: bool = False) -> NDArray[np.float64]:
        """Forward states at the wanted stamps, rows as `error_state_kernel` saves them; ``keep`` what `smooth` wants."""
        count = self.timeline.stamp_ns.size
        outputs = np.full((self.timeline.output.max() + 1, self._width), np.nan)
        blocks = self._blocks()
        memory = _start(initial, self.scale_stds, self.turn_scale_std, self.start_error_m2)
        self._checkpoints, self._kept = [], {}
        if not keep:
            self._forward(0, count, memory, outputs, None)
        for index, (first, last) in enumerate(blocks if keep else ()):
            self._checkpoints.append(memory.copy())
            if index >= len(blocks) - _KEPT_BLOCKS:
                self._kept[index] = self._store(first, last)
            self._forward(first, last, memory, outputs, self._kept.get(index))
        self.last = memory
        return outputs

    def smoothed(self, initial: InitialState) -> NDArray[np.float64]:
        """Smoothed states at the wanted stamps."""
        outputs = self.filtered(initial, keep=True)
        self.smooth(outputs)
        return outputs

    def smooth(self, outputs: NDArray[np.float64]) -> None:
        """Make the filtered states, as `filtered` has kept them, smoothed ones."""
        n = self._errors
        adjoint, information = np.zeros(n), np.zeros((n, n))
        links = _links(self.lags, n)
        blocks = self._blocks()
        for index in range(len(blocks) - 1, -1, -1):
            first, last = blocks[index]
            if index not in self._kept:
                self._kept[index] = self._store(first, last)
                self._forward(first, last, self._checkpoints[index], outputs, self._kept[index])
            kernel.smooth_block(
                first,
                last,
                self.timeline.output,
                self._kept.pop(index),
                adjoint,
                information,
                outputs,
                links,
                self.displacement_variance_m2,
            )

    def lasting_error_m(self) -> float:
        """Return how large an error of the fixes that lasts was taken to be, most of the time."""
        if self.start_error_m2.size == 0:
            return float(np.sqrt(np.median(self.lasting_m2[:, 0])))
        return float(np.sqrt(np.median(self.error_level_m2[:, 0])))

    def _blocks(self) -> list[tuple[int, int]]:
        count = self.timeline.stamp_ns.size
        return list(pairwise([*range(0, count, _BLOCK), count]))

    @property
    def _errors(self) -> int:
        return kernel.N + self.start_error_m2.size

    def _store(self, first: int, last: int) -> _Store:
        """Return room for what the smoother wants of some events."""
        events, wanted = last - first, int(np.count_nonzero(self.timeline.output[first:last] >= 0))
        n = self._errors
        return np.empty((events, 12, 9)), np.empty((events, 2, 3, n)), np.empty((events, 25)), np.empty((wanted, n, n))

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
            self.kept_error,
            self.error_noise_m2,
            self.error_level_m2,
            memory.x,
            memory.P,
            memory.refused,
            memory.silent,
            memory.opened,
            store is not None,
            store or self._store(0, 0),
            self.nis,
            self.innovation,
            self.verdict,
            outputs,
        )


def _links(lags: Sequence[int], n: int) -> tuple[NDArray[Any], ...]:
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
    chains = np.zeros((len(nodes), size, n, n))
    wanted = np.array([index[lag] for lag in lags])
    return np.eye(n), chains, np.zeros((size, n, 2)), np.zeros((size, 6)), recipe, np.array(list(nodes)), wanted


def _start(
    initial: InitialState,
    scale_stds: tuple[float, float],
    turn_scale_std: float = 0.0,
    fix_error_m2: NDArray[np.float64] = _NO_ERROR,
) -> _Memory:
    """Return the state at the start; with a scale error of the turn rate to be found in the place of the gyroscope's bias, or without."""
    n = kernel.N + fix_error_m2.size
    x = np.zeros(n + 6)
    rotation = matrix_from_quat(initial.quat_xyzw)
    x[0:9] = rotation.ravel()
    bias_std = turn_scale_std or initial.gyro_bias_std_radps
    x[9:12] = 0.0 if turn_scale_std else initial.gyro_bias_radps
    x[15:18] = initial.velocity_enu_mps
    x[18:21] = initial.position_enu_m
    P = np.zeros((n, n))
    P[0:3, 0:3] = rotation.T @ np.diag(np.square([initial.tilt_std_rad] * 2 + [initial.yaw_std_rad])) @ rotation
    index = np.arange(3, n)
    P[index, index] = np.concatenate(
        (
            np.full(3, bias_std**2),
            np.full(3, 0.15**2),
            np.full(3, initial.velocity_std_mps**2),
            initial.position_std_m**2,
            np.square(np.maximum(scale_stds, _FIXED)),
            fix_error_m2,
        )
    )
    return _Memory(x, P, np.zeros(8), np.zeros(8), np.zeros(6))


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
            outputs[:, _WIDTH + 10 * (6 + axis)] += run.lasting_m2[:, axis]
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


def _reopenings(timeline: EventTimeline, run: _Run) -> tuple[Reopening, ...]:
    """Return each reopening of a gate: since when the sensor was refused, and how far it was off."""
    found = []
    for event in np.flatnonzero(run.verdict == kernel.REOPENED):
        same = np.flatnonzero(timeline.kind[:event] == timeline.kind[event])
        heard = same[run.verdict[same] != kernel.REFUSED]
        first = same[same > heard[-1]][0] if heard.size and heard[-1] < same[-1] else event
        size = float(np.linalg.norm(run.innovation[event, : 2 if timeline.kind[event] == kernel.GNSS_POSITION else 1]))
        role = _ROLES[int(timeline.kind[event])]
        if any(
            abs(int(timeline.stamp_ns[first]) - known.start_ns) < _GROWS_NS
            for known in run.suspects
            if known.role == role
        ):
            continue  # known from the pass before
        found.append(Reopening(role, int(timeline.stamp_ns[first]), int(timeline.stamp_ns[event]), size))
    return tuple(sorted((*run.suspects, *found), key=lambda reopening: reopening.start_ns))


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
        gnss_lasting_error_m=run.lasting_error_m(),
        reopenings=_reopenings(timeline, run),
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
