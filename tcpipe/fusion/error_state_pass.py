"""One pass of the error-state filter over a section, and the smoother's way back over it, in blocks of bounded memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion import state_kernel as kernel
from tcpipe.fusion.error_state_kernel import OFF_M, SURELY, filter_block, find_largest_drift
from tcpipe.fusion.gnss_faults import (
    FaultHypothesis,
    FixErrors,
    Innovations,
    Jump,
    Spans,
    compute_unexplained_innovation,
    is_inside,
)
from tcpipe.fusion.measurements import DOPPLER, GNSS, VISUAL, WHEELS, InitialState, Measurements
from tcpipe.fusion.process import (
    SLOPE_RAD,
    estimate_slope_std_rad,
    find_scale_stds,
    is_gliding,
    is_turned_by_course,
    make_process_noise,
    turn_scale_std,
)
from tcpipe.fusion.signals import compute_median_period_ns, find_chi_square_threshold
from tcpipe.fusion.smoother_kernel import smooth_block
from tcpipe.fusion.timeline import EventTimeline
from tcpipe.fusion.trajectory import DISPLACEMENT_LAGS_S
from tcpipe.geometry.rotation import matrix_from_quat
from tcpipe.tables.facts import GateReset

_BLOCK = 2048
_KEPT_BLOCKS = 12
"""Blocks whose forward pass is kept at once: about 2.2 kB an event, 55 MB."""

_Store = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]

ROLES = {
    kernel.GNSS_POSITION: GNSS,
    kernel.WHEEL_VELOCITY: WHEELS,
    kernel.VISUAL_VELOCITY: VISUAL,
    kernel.GNSS_VELOCITY: DOPPLER,
}
DOF = {kernel.GNSS_POSITION: 3, kernel.WHEEL_VELOCITY: 1, kernel.VISUAL_VELOCITY: 3, kernel.STANDING: 3}
DOF |= {kernel.STANDING_RATE: 3, kernel.SIDEWAYS: 2, kernel.LEVEL: 2, kernel.GNSS_VELOCITY: 3}
_LEAST_ERROR_M = 1e-4  # smallest modelled GNSS error
_NO_ERROR = np.empty(0)
_ANY_YAW_STD_RAD = np.pi / np.sqrt(3.0)
_NEVER = 1e18
_FIXED = 1e-6
_CARRIED_M = 0.5  # σ of fixes that odometry improves for a minute
_LOCK_OUT = {
    kernel.GNSS_POSITION: (5.0, 15.0, 5.0),
    kernel.WHEEL_VELOCITY: (5.0, 5.0, 0.3),
    kernel.VISUAL_VELOCITY: (5.0, 5.0, 0.3),
}
_DOUBTED, _DEAF = (5.0, 2.0, 2.0, 1.0), (_NEVER, _NEVER, _NEVER, 0.0)
"""Refusals in a row, and seconds since the last accepted measurement, after which a gate reopens; the seconds where no other sensor
of velocity is heard. `_DOUBTED`: the same of fixes whose error is part of the state; the 1 says that it is lifted, and not the pose.
That of the receiver's velocity never reopens: the fixes tell where the filter is wrong."""
_WITHOUT_PLACE = (kernel.WHEEL_VELOCITY, kernel.VISUAL_VELOCITY, kernel.GNSS_VELOCITY)


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


class FilterPass:
    """One timeline with its constants and what the gates decided; ``lags`` are rows of the wanted stamps (`compute_lag_rows`)."""

    def __init__(
        self, timeline: EventTimeline, measurements: Measurements, gate_probability: float, *, lags: Sequence[int]
    ) -> None:
        self.lags = lags
        self.timeline = timeline
        self.lasting_m2 = np.zeros((1, 3))
        count = timeline.stamp_ns.size
        self.nis = np.full(count, np.nan)
        self.innovation = np.full((count, 3), np.nan)
        self.wrong: tuple[GateReset, ...] = ()  # when the fixes erred together, as both ends tell
        self.start_error_m2 = np.empty(0)  # of the fixes, where the state holds it
        self.kept_error, self.error_noise_m2 = np.ones(count), np.zeros((count, 3))
        self.error_level_m2 = np.zeros((count, 3))
        self.verdict = np.zeros(count, np.int8)
        self.repairs = 0.0
        self.displacement_variance_m2 = np.full((timeline.output.max() + 1, len(DISPLACEMENT_LAGS_S)), np.nan)
        self.gates = np.full(kernel.KINDS, np.inf)
        for kind in (*ROLES, kernel.STANDING, kernel.STANDING_RATE):
            self.gates[kind] = find_chi_square_threshold(DOF[kind], gate_probability)
        self._levers = _collect_lever_arms(measurements)
        self._densities = make_process_noise(measurements)
        self._lock_out = _lock_out(measurements)
        gnss, carriers = measurements.gnss, _has_dead_reckoning(measurements)
        self._tilt_known = measurements.imu is not None
        self.carried = carriers and gnss is not None and float(np.median(gnss.variance_m2[:, 0])) < _CARRIED_M**2
        # Without GNSS nothing tells how long a metre of odometry is; an accelerometer has a scale and an alignment of its own.
        self.unseen_scale_std = 0.0
        # From positions alone forward and reverse look the same: yaw is the course, and may be anything.
        self.unseen_yaw_std = 0.0
        self.antenna_m = self._levers[kernel.GNSS_POSITION].copy()
        self.unplaced = measurements.gnss is None
        self.along_course = is_gliding(measurements)
        self.turns_by_course = is_turned_by_course(measurements)
        self.slope_std_rad = estimate_slope_std_rad(measurements) or SLOPE_RAD
        if self.along_course:
            self._levers[:] = 0.0
        if measurements.imu is None and not measurements.odometries():
            self.unseen_yaw_std = _ANY_YAW_STD_RAD
        self.turn_scale_std = turn_scale_std(measurements)
        self.find_scale_stds = find_scale_stds(measurements)
        self.last: _Memory

    def doubt_fixes(self, errors: FixErrors | None, wrong: Spans = (), *, follows: bool = True) -> None:
        """Make the fixes' own error part of the state: a Gauss-Markov process, as large and as lasting as they are of their kind.

        In the spans in which they are ``wrong`` it may be as large as a wrong fix is. Unless it ``follows``, the gate never reopens.
        """
        stamp_ns = self.timeline.stamp_ns[self.timeline.kind == kernel.GNSS_POSITION]
        if errors is None or stamp_ns.size == 0:
            return
        fix = np.searchsorted(stamp_ns, self.timeline.stamp_ns, "right").clip(1, stamp_ns.size) - 1
        lasting_m2 = np.maximum(errors.lasting_m2, _LEAST_ERROR_M**2)
        if wrong:
            lasting_m2[is_inside(stamp_ns, wrong)] = np.maximum(lasting_m2[is_inside(stamp_ns, wrong)], OFF_M**2)
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
            self._lock_out[kernel.GNSS_POSITION] = _DOUBTED if follows else _DEAF

    def fixes_contradict(self) -> bool:
        """Return whether fixes were rejected for seconds while the other sensors determined the pose: they may err together."""
        of_gnss = np.flatnonzero(self.timeline.kind == kernel.GNSS_POSITION)
        if not self.carried or of_gnss.size == 0:
            return False
        if self.start_error_m2.size:  # it was taken to last, and yet
            return bool((self.verdict[of_gnss] == kernel.REOPENED).any())
        refused = self.verdict[of_gnss] != kernel.ACCEPTED
        edges = np.flatnonzero(np.diff(np.concatenate(([0], refused.astype(np.int8), [0]))))
        first, last = edges[::2], edges[1::2] - 1
        long_s = (self.timeline.stamp_ns[of_gnss[last]] - self.timeline.stamp_ns[of_gnss[first]]) * 1e-9
        if ((last - first + 1 >= _DOUBTED[0]) & (long_s >= _DOUBTED[1])).any():
            return True
        if not self._tilt_known:  # a start that is not level yet looks like a drift
            return False
        heard = of_gnss[~refused]
        normal = self.innovation[heard] / np.sqrt(self.timeline.variance[heard])
        return bool(find_largest_drift(normal) > SURELY * self.gates[kernel.GNSS_POSITION])

    def jumps(self) -> list[Jump]:
        """Return where the gate of the fixes reopened, and which way they then were off."""
        rows = np.flatnonzero((self.timeline.kind == kernel.GNSS_POSITION) & (self.verdict == kernel.REOPENED))
        return [Jump(int(self.timeline.stamp_ns[row]), self.innovation[row, :2]) for row in rows]

    def explained(self, spans: Spans, usual: float) -> FaultHypothesis:
        """Return what remains unexplained if the fixes err in ``spans``; ``usual`` is the squared innovation of a fix that is right."""
        fixes = self._innovations(kernel.GNSS_POSITION)
        others = [self._innovations(kind) for kind in _WITHOUT_PLACE]
        return compute_unexplained_innovation(spans, fixes, others, usual)

    def usual(self) -> float:
        """Return the mean squared normalised innovation of the fixes that the gate took."""
        fixes = self._innovations(kernel.GNSS_POSITION)
        return float(fixes.squared[~fixes.refused].mean()) if (~fixes.refused).any() else DOF[kernel.GNSS_POSITION]

    def _innovations(self, kind: int) -> Innovations:
        rows = self.timeline.kind == kind
        off_m = np.linalg.norm(self.innovation[rows, :2], axis=1)
        refused = self.verdict[rows] != kernel.ACCEPTED
        return Innovations(self.timeline.stamp_ns[rows], self.nis[rows], refused, float(self.gates[kind]), off_m)

    def filtered(self, initial: InitialState, *, keep: bool = False) -> NDArray[np.float64]:
        """Forward states at the wanted stamps, rows as `state_kernel.saved` fills them; ``keep`` what `smooth` wants."""
        outputs = np.full((self.timeline.output.max() + 1, kernel.SAVED), np.nan)
        blocks = self._blocks()
        memory = _start(initial, self.find_scale_stds, self.turn_scale_std, self.start_error_m2)
        self._checkpoints, self._kept = [], {}
        for index, (first, last) in enumerate(blocks):
            self._checkpoints.append(memory.copy())
            if keep and index >= len(blocks) - _KEPT_BLOCKS:
                self._kept[index] = self._store(first, last)
            self._forward(first, last, memory, outputs, self._kept.get(index))
        self.last = memory
        return outputs

    def filtered_like(self, other: FilterPass, initial: InitialState) -> None:
        """Filter, states not kept, what of a timeline differs from ``other``: from its checkpoint before the fixes' error is another."""
        count = self.timeline.stamp_ns.size
        changed = self.kept_error != other.kept_error
        changed |= (self.error_noise_m2 != other.error_noise_m2).any(1)
        changed |= (self.error_level_m2 != other.error_level_m2).any(1)
        first = (int(np.argmax(changed)) if changed.any() else count - 1) // _BLOCK * _BLOCK
        for name in ("nis", "innovation", "verdict"):
            getattr(self, name)[:first] = getattr(other, name)[:first]
        outputs = np.full((self.timeline.output.max() + 1, kernel.SAVED), np.nan)
        memory = other._checkpoints[first // _BLOCK].copy()
        if first == 0:  # the fixes' error at the start may be another, too
            memory = _start(initial, self.find_scale_stds, self.turn_scale_std, self.start_error_m2)
        self._forward(first, count, memory, outputs, None)

    def smoothed(self, initial: InitialState) -> NDArray[np.float64]:
        """Smoothed states at the wanted stamps."""
        outputs = self.filtered(initial, keep=True)
        self.smooth(outputs)
        return outputs

    def smooth(self, outputs: NDArray[np.float64]) -> None:
        """Make the filtered states, as `filtered` has kept them, smoothed ones."""
        n = self._errors
        adjoint, information = np.zeros(n), np.zeros((n, n))
        links = _allocate_links(self.lags, n)
        blocks = self._blocks()
        for index in range(len(blocks) - 1, -1, -1):
            first, last = blocks[index]
            if index not in self._kept:
                self._kept[index] = self._store(first, last)
                self._forward(first, last, self._checkpoints[index], outputs, self._kept[index])
            smooth_block(
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
        self, first: int, last: int, memory: _Memory, outputs: NDArray[np.float64], store: _Store | None
    ) -> None:
        t = self.timeline
        self.repairs += filter_block(
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


def _has_dead_reckoning(m: Measurements) -> bool:
    """Return whether an IMU and an odometry, or a camera that sees all turns, carry the pose on without fixes."""
    return bool(m.odometries()) if m.imu is not None else m.visual is not None and m.visual.turn_rate_radps is not None


def _collect_lever_arms(measurements: Measurements) -> NDArray[np.float64]:
    """Return the lever arm by kind of event [m], shape (9, 3)."""
    levers = np.zeros((kernel.KINDS, 3))
    for kind, source in (
        (kernel.GNSS_POSITION, measurements.gnss),
        (kernel.GNSS_VELOCITY, measurements.gnss),
        (kernel.WHEEL_VELOCITY, measurements.wheels),
        (kernel.SIDEWAYS, measurements.wheels),
        (kernel.VISUAL_VELOCITY, measurements.visual),
    ):
        if source is not None:
            levers[kind] = source.lever_arm_m
    return levers


def _lock_out(measurements: Measurements) -> NDArray[np.float64]:
    """Return by kind of event when its gate reopens, as `filter_block` takes it, shape (9, 4)."""
    lock_out = np.full((kernel.KINDS, 4), _NEVER)
    for kind, limits in _LOCK_OUT.items():
        lock_out[kind] = (*limits, 0.0)
    if measurements.visual is None or measurements.imu is None:  # what is left cannot overrule GNSS for long
        lock_out[kernel.GNSS_POSITION, 1] = _LOCK_OUT[kernel.GNSS_POSITION][2]
    if measurements.imu is None and measurements.visual is None:  # wheels that dig in must not overrule GNSS
        lock_out[kernel.GNSS_POSITION, 1:3] = 1.0
    return lock_out


def _allocate_links(lags: Sequence[int], n: int) -> tuple[NDArray[Any], ...]:
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
    find_scale_stds: tuple[float, float],
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
            np.square(np.maximum(find_scale_stds, _FIXED)),
            fix_error_m2,
        )
    )
    return _Memory(x, P, np.zeros(kernel.KINDS), np.zeros(kernel.KINDS), np.zeros(6))


def compute_lag_rows(output_ns: NDArray[np.int64]) -> list[int]:
    """Rows that each of `DISPLACEMENT_LAGS_S` spans."""
    period_s = compute_median_period_ns(output_ns) * 1e-9 if output_ns.size > 1 else 1.0
    return [max(1, round(lag_s / period_s)) for lag_s in DISPLACEMENT_LAGS_S]
