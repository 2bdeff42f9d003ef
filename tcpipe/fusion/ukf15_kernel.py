"""The paper's forward filter, compiled: one unscented Kalman filter over the 15 states of robot_localization.

State, in this order: position x y z [m] in the ENU plane; roll, pitch, yaw [rad]; body velocity [m/s]; body angular velocity
[rad/s]; body acceleration, which is the derivative of the body velocity [m/s²]. The process holds angular velocity and
acceleration constant (T. Moore and D. Stouch, A Generalized Extended Kalman Filter Implementation for the Robot Operating
System, 2014; robot_localization 3.6, ``ukf.cpp``).

Scaled unscented transform with alpha = 1, kappa = 0, beta = 2 (E. A. Wan and R. van der Merwe, 2000), so that with n = 15 the
points lie at sqrt(n) deviations, the centre has mean weight 0 and covariance weight 2, and no weight is negative. Beyond
robot_localization: the posterior subtracts K·S·Kᵀ with the measurement noise in S, sigma points are drawn anew once the process
noise is in the covariance, and angles are averaged and subtracted on the circle.

What makes it fast is exact, not approximate:

* The Cholesky factor is lower triangular, so the sigma points of its columns 6 to 14 share the attitude of the centre; there the
  process is linear, and a pair of points is one deviation.
* A measurement that selects state entries is linear: its innovation covariance is P[index, index] + R, without sigma points.

All inner loops run over rows padded to 16 entries, element by element, so that they vectorise under IEEE arithmetic.
"""

from __future__ import annotations

from math import atan2, cos, floor, pi, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel

NOT_RUN = 0
"""Outcome of a measurement that was not reached."""
ACCEPTED = 1
"""Outcome: fused."""
REJECTED = 2
"""Outcome: rejected by the gate."""
RECOVERED = 3
"""Outcome: fused although outside the gate, after the states it measures were opened up (see `tcpipe.fusion.ukf15_kernel.run`)."""


class FilterState(NamedTuple):
    """What the filter knows at one moment; moved in place, so that a long run can be filtered in blocks."""

    x: NDArray[np.float64]
    """State, shape (16,), the last entry 0."""
    P: NDArray[np.float64]
    """Covariance, shape (15, 16), the last column 0."""
    clock_s: NDArray[np.float64]
    """Its time, seconds since the run's origin, shape (1,)."""
    refused: NDArray[np.float64]
    """Per source, rejections in a row, and since when [s], shape (S, 2)."""


class Sources(NamedTuple):
    """What each source measures; see `tcpipe.fusion.ukf15_kernel.update`."""

    kind: NDArray[np.int64]
    """`SELECT`, `ANTENNA`, `SPECIFIC_FORCE` or `SENSOR_VELOCITY`, shape (S,)."""
    width: NDArray[np.int64]
    """Entries in a measurement, shape (S,)."""
    entries: NDArray[np.int64]
    """Which states, or which of the sensor's three entries, shape (S, 6)."""
    lever_m: NDArray[np.float64]
    """Position of the sensor in base_link [m], shape (S, 3)."""
    gate: NDArray[np.float64]
    """Largest normalised innovation squared that is fused, shape (S,)."""


class Events(NamedTuple):
    """All measurements of a run in order of time."""

    time_s: NDArray[np.float64]
    """Seconds since the run's origin, ascending, shape (E,)."""
    source: NDArray[np.int8]
    """Which source, shape (E,)."""
    at: NDArray[np.int64]
    """Where in ``z`` the measurement begins, shape (E,)."""
    z: NDArray[np.float64]
    """Measurements, end to end."""
    variance: NDArray[np.float64]
    """Their variances, end to end."""


class Outputs(NamedTuple):
    """What a run writes."""

    time_s: NDArray[np.float64]
    """When the state is wanted, seconds since the run's origin, ascending, shape (K,)."""
    x: NDArray[np.float64]
    """States, shape (K, 15)."""
    variance: NDArray[np.float64]
    """Their variances, shape (K, 15)."""
    nis: NDArray[np.float64]
    """Normalised innovation squared of each event, shape (E,)."""
    outcome: NDArray[np.int8]
    """`NOT_RUN`, `ACCEPTED`, `REJECTED` or `RECOVERED`, shape (E,)."""


STATES = 15
"""Length of the state."""
X, Y, Z, ROLL, PITCH, YAW, VX, VY, VZ, WX, WY, WZ, AX, AY, AZ = range(STATES)
"""Place of each entry in the state: position, angles, velocity, angular velocity, acceleration."""
POSITION, ANGLES, VELOCITY, TURN, ACCELERATION = (slice(first, first + 3) for first in (X, ROLL, VX, WX, AX))

SELECT = 0
"""z_k = x[index_k]."""
ANTENNA = 1
"""z = position + R(roll, pitch, yaw)·lever, entries index_k of the three."""
SPECIFIC_FORCE = 2
"""z = acceleration + w × v + w × (w × lever) + Rᵀ·g, entries index_k of the three."""
SENSOR_VELOCITY = 3
"""z = v + w × lever, in the body's axes, entries index_k of the three."""

GRAVITY_MPS2 = 9.80665
"""Standard gravity."""

ROW = 16
"""A row of state or covariance, padded for vectorisation."""
_POSED = 6  # so many entries are pose: columns of the Cholesky factor from here on leave a sigma point's pose alone
_SPREAD = sqrt(15.0)  # gamma = sqrt(n + lambda), lambda = 0
_WEIGHT = 1.0 / 30.0  # of each of the 2n outer points, for mean and covariance
_CENTRE = 2.0  # covariance weight of the centre: 1 - alpha² + beta
MAX_STEP_S = 0.1
"""Longer predictions are divided, so that an angle's deviation stays far below pi [s]."""
MAX_OPENED_RAD = 0.5
"""No angle is opened up further than this: sigma points must not go round the circle [rad]."""
_LOCKOUT_S, _LOCKOUT_COUNT = 5.0, 5


@compile_kernel
def _wrap(angle: float) -> float:
    if -pi <= angle < pi:
        return angle
    wrapped = angle - 2.0 * pi * floor((angle + pi) / (2.0 * pi))
    return wrapped if wrapped < pi else -pi


@compile_kernel
def _factorize(P: NDArray[np.float64], L: NDArray[np.float64]) -> bool:
    """Write the Cholesky factor's columns as rows of L; False where P is not positive definite."""
    for k in range(STATES):
        row, first = L[k], k // 4 * 4  # from a multiple of four on, so that it vectorises
        for j in range(first, ROW):
            row[j] = P[k, j]
        for i in range(k):
            factor = L[i, k]
            for j in range(first, ROW):
                row[j] -= factor * L[i, j]
        pivot = L[k, k]
        if not pivot > 0.0:
            return False
        scale = 1.0 / sqrt(pivot)
        for j in range(k):
            L[k, j] = 0.0
        for j in range(k, ROW):
            L[k, j] *= scale
    return True


@compile_kernel
def _sin(angle: float) -> float:
    """Sine, by its series where that is exact to the last bit or two: most angles here are small deviations."""
    if abs(angle) > 0.3:
        return sin(angle)
    t = angle * angle
    return angle * (1.0 + t * (-1 / 6 + t * (1 / 120 + t * (-1 / 5040 + t * (1 / 362880 - t / 39916800)))))


@compile_kernel
def _cos(angle: float) -> float:
    """Cosine, likewise."""
    if abs(angle) > 0.3:
        return cos(angle)
    t = angle * angle
    return 1.0 + t * (-1 / 2 + t * (1 / 24 + t * (-1 / 720 + t * (1 / 40320 - t / 3628800))))


@compile_kernel
def _compute_attitude_terms(s: NDArray[np.float64], c: NDArray[np.float64], C: NDArray[np.float64]) -> None:
    """Write what the process needs of sines and cosines of roll, pitch, yaw: the rotation map_from_body, and the Euler rates' terms."""
    sr, sp, sy = s[0], s[1], s[2]
    cr, cp, cy = c[0], c[1], c[2]
    C[0], C[1], C[2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    C[3], C[4], C[5] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    C[6], C[7], C[8] = -sp, cp * sr, cp * cr
    C[9], C[10], C[11], C[12] = sr, cr, sp / cp, 1.0 / cp


@compile_kernel
def _process(x: NDArray[np.float64], C: NDArray[np.float64], dt: float, out: NDArray[np.float64]) -> None:
    """Move one point by dt with the attitude terms C; linear in everything but the attitude."""
    half = 0.5 * dt
    dx, dy, dz = dt * (x[VX] + half * x[AX]), dt * (x[VY] + half * x[AY]), dt * (x[VZ] + half * x[AZ])
    out[X] = x[X] + C[0] * dx + C[1] * dy + C[2] * dz
    out[Y] = x[Y] + C[3] * dx + C[4] * dy + C[5] * dz
    out[Z] = x[Z] + C[6] * dx + C[7] * dy + C[8] * dz
    turn = dt * (C[9] * x[WY] + C[10] * x[WZ])
    out[ROLL] = x[ROLL] + dt * x[WX] + C[11] * turn
    out[PITCH] = x[PITCH] + dt * (C[10] * x[WY] - C[9] * x[WZ])
    out[YAW] = x[YAW] + C[12] * turn
    out[VX], out[VY], out[VZ] = x[VX] + dt * x[AX], x[VY] + dt * x[AY], x[VZ] + dt * x[AZ]
    for k in range(WX, ROW):
        out[k] = x[k]


@compile_kernel
def predict(
    x: NDArray[np.float64], P: NDArray[np.float64], q: NDArray[np.float64], dt: float, work: NDArray[np.float64]
) -> bool:
    """Move state x, (16,) with a last 0, and covariance P, (15, 16) with a last column of 0, by a step of ``dt`` [s], in place.

    ``q``, (15,), is the variance that each state gains in a second; ``work``, (48, 16), is scratch. Return False, with both untouched,
    where P was not positive definite.
    """
    L = work[0:16]
    D = work[16:38]  # deviations: 12 points, 9 linear pairs, the mean
    xs, centre, C, turned = work[40], work[41], work[42], work[43]
    s0, c0, s1, c1 = turned[0:3], turned[3:6], turned[6:9], turned[9:12]
    if not _factorize(P, L):
        return False
    for k in range(3):
        s0[k], c0[k] = sin(x[ROLL + k]), cos(x[ROLL + k])
    _compute_attitude_terms(s0, c0, C)
    _process(x, C, dt, centre)
    # columns that leave the attitude alone: both points of a pair deviate by the same, with opposite signs
    for i in range(_POSED, STATES):
        for j in range(ROW):
            xs[j] = _SPREAD * L[i, j]
        _process(xs, C, dt, D[_POSED + i])
    for i in range(_POSED):
        for side in range(2):
            spread = _SPREAD if side == 0 else -_SPREAD
            for j in range(ROW):
                xs[j] = x[j] + spread * L[i, j]
            for k in range(3):
                step = spread * L[i, ROLL + k]
                ds, dc = _sin(step), _cos(step)
                s1[k], c1[k] = s0[k] * dc + c0[k] * ds, c0[k] * dc - s0[k] * ds
            row = D[2 * i + side]
            _compute_attitude_terms(s1, c1, C)
            _process(xs, C, dt, row)
            for j in range(ROW):
                row[j] -= centre[j]
    mean = D[21]
    for j in range(X, Z + 1):
        total = 0.0
        for s in range(12):
            total += D[s, j]
        mean[j] = _WEIGHT * total
    for k in range(ROLL, YAW + 1):
        sines, cosines = 0.0, 6.0  # the three columns of the acceleration leave the attitude alone altogether
        for s in range(12):
            D[s, k] = _wrap(D[s, k])
            sines += _sin(D[s, k])
            cosines += _cos(D[s, k])
        for s in range(12, 18):
            cosines += 2.0 * _cos(D[s, k])
        mean[k] = atan2(sines, cosines)
    for j in range(VX, ROW):
        mean[j] = 0.0  # linear in the state: the mean is the centre's
    for s in range(12):
        for j in range(_POSED):
            D[s, j] -= mean[j]
        for k in range(ROLL, YAW + 1):
            D[s, k] = _wrap(D[s, k])
    for j in range(STATES):
        x[j] = centre[j] + mean[j]
    for k in range(ROLL, YAW + 1):
        x[k] = _wrap(x[k])
    for s in range(12, 21):
        for j in range(ROW):
            D[s, j] *= sqrt(2.0)
    scale = sqrt(18.0 + _CENTRE / _WEIGHT)
    for j in range(_POSED):
        mean[j] *= scale
    # velocity, angular velocity and acceleration move linearly, and so does their covariance
    for k in range(3):
        for j in range(VX, ROW):
            P[VX + k, j] += dt * P[AX + k, j]
    for i in range(VX, STATES):
        for k in range(3):
            P[i, VX + k] += dt * P[i, AX + k]
    for i in range(0, _POSED, 2):
        for b in range(
            0, ROW, 4
        ):  # two rows and four columns at a time stay in registers: plain rows took 12 % longer in all
            s0, s1, s2, s3, t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for s in range(22):
                u, v = D[s, i], D[s, i + 1]
                d0, d1, d2, d3 = D[s, b], D[s, b + 1], D[s, b + 2], D[s, b + 3]
                s0 += u * d0
                s1 += u * d1
                s2 += u * d2
                s3 += u * d3
                t0 += v * d0
                t1 += v * d1
                t2 += v * d2
                t3 += v * d3
            P[i, b], P[i, b + 1], P[i, b + 2], P[i, b + 3] = s0, s1, s2, s3
            P[i + 1, b], P[i + 1, b + 1], P[i + 1, b + 2], P[i + 1, b + 3] = t0, t1, t2, t3
    for i in range(_POSED):
        for j in range(ROW):
            P[i, j] *= _WEIGHT
    for i in range(STATES):
        for j in range(i):
            P[i, j] = P[j, i]
        P[i, i] += q[i] * dt
    return True


@compile_kernel
def _observe(kind: int, x: NDArray[np.float64], lever: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Write the three entries that a sensor of this kind would show in state x."""
    lx, ly, lz = lever[0], lever[1], lever[2]
    wx, wy, wz = x[WX], x[WY], x[WZ]
    ux, uy, uz = x[VX] + (wy * lz - wz * ly), x[VY] + (wz * lx - wx * lz), x[VZ] + (wx * ly - wy * lx)
    if kind == SENSOR_VELOCITY:
        out[0], out[1], out[2] = ux, uy, uz
        return
    sr, cr, sp, cp = sin(x[ROLL]), cos(x[ROLL]), sin(x[PITCH]), cos(x[PITCH])
    if kind == ANTENNA:
        sy, cy = sin(x[YAW]), cos(x[YAW])
        out[0] = x[X] + cy * cp * lx + (cy * sp * sr - sy * cr) * ly + (cy * sp * cr + sy * sr) * lz
        out[1] = x[Y] + sy * cp * lx + (sy * sp * sr + cy * cr) * ly + (sy * sp * cr - cy * sr) * lz
        out[2] = x[Z] - sp * lx + cp * sr * ly + cp * cr * lz
        return
    out[0] = x[AX] + wy * uz - wz * uy - GRAVITY_MPS2 * sp
    out[1] = x[AY] + wz * ux - wx * uz + GRAVITY_MPS2 * cp * sr
    out[2] = x[AZ] + wx * uy - wy * ux + GRAVITY_MPS2 * cp * cr


@compile_kernel
def _correct(
    x: NDArray[np.float64],
    P: NDArray[np.float64],
    C: NDArray[np.float64],
    S: NDArray[np.float64],
    y: NDArray[np.float64],
    size: int,
    gate: float,
) -> float:
    """Gate and fuse: C is the cross-covariance (size, 16), S the innovation covariance; all three are destroyed."""
    for i in range(size):
        for j in range(i + 1):
            total = S[i, j]
            for k in range(j):
                total -= S[i, k] * S[j, k]
            if i == j:
                if not total > 0.0:
                    return np.inf
                S[i, i] = sqrt(total)
            else:
                S[i, j] = total / S[j, j]
    nis = 0.0
    for a in range(size):
        total = y[a]
        for k in range(a):
            total -= S[a, k] * y[k]
        y[a] = total / S[a, a]
        nis += y[a] * y[a]
    if not nis <= gate:
        return nis
    for a in range(size):
        for k in range(a):
            factor = S[a, k]
            for j in range(ROW):
                C[a, j] -= factor * C[k, j]
        inverse = 1.0 / S[a, a]
        for j in range(ROW):
            C[a, j] *= inverse
        gain = y[a]
        for j in range(STATES):
            x[j] += gain * C[a, j]
    for i in range(STATES):
        for a in range(size):
            factor = C[a, i]
            for j in range(i // 4 * 4, ROW):
                P[i, j] -= factor * C[a, j]
        for j in range(i):
            P[i, j] = P[j, i]
    for k in range(ROLL, YAW + 1):
        x[k] = _wrap(x[k])
    return nis


@compile_kernel
def update(
    x: NDArray[np.float64],
    P: NDArray[np.float64],
    kind: int,
    index: NDArray[np.int64],
    lever: NDArray[np.float64],
    z: NDArray[np.float64],
    variance: NDArray[np.float64],
    gate: float,
    work: NDArray[np.float64],
) -> float:
    """Fuse one measurement in place unless its gate rejects it; return the normalised innovation squared.

    It is infinite where the covariance was not positive definite; above ``gate`` nothing has changed.

    Parameters
    ----------
    x, P, work : as `predict`.
    kind : `SELECT`, `ANTENNA`, `SPECIFIC_FORCE` or `SENSOR_VELOCITY`.
    index : which states (`SELECT`), or which of the sensor's three entries, are measured, shape (m,), m ≤ 6.
    lever : position of the sensor in base_link [m], shape (3,).
    z, variance : measurement and its variance, shape (m,).
    """
    size = index.size
    C = work[38:44]
    S = work[44:47].ravel()[:36].reshape(6, 6)
    y = work[47]
    if kind == SELECT:
        for a in range(size):
            i = index[a]
            y[a] = z[a] - x[i]
            if ROLL <= i <= YAW:
                y[a] = _wrap(y[a])
            for j in range(ROW):
                C[a, j] = P[i, j]
            for b in range(size):
                S[a, b] = P[i, index[b]]
            S[a, a] += variance[a]
        return float(_correct(x, P, C, S, y, size, gate))
    L = work[0:16]
    # of row i the entries of the pair of points i, plus in 0..2 and minus in 3..5; row 15: the centre and the mean
    seen = work[16:32]
    xs = work[32]
    if not _factorize(P, L):
        return np.inf
    centre = seen[15]
    _observe(kind, x, lever, centre)
    points = _POSED if kind == ANTENNA else STATES  # position and attitude alone show in an antenna's position
    for i in range(points):
        for j in range(ROW):
            xs[j] = x[j] + _SPREAD * L[i, j]
        _observe(kind, xs, lever, seen[i])
        for j in range(ROW):
            xs[j] = x[j] - _SPREAD * L[i, j]
        _observe(kind, xs, lever, seen[i, 3:6])
    for a in range(size):
        c = index[a]
        mean = 0.0
        for i in range(points):
            mean += (seen[i, c] - centre[c]) + (seen[i, 3 + c] - centre[c])
        centre[3 + c] = centre[c] + _WEIGHT * mean
        y[a] = z[a] - centre[3 + c]
        for j in range(ROW):
            C[a, j] = 0.0
        for i in range(points):
            factor = _WEIGHT * _SPREAD * (seen[i, c] - seen[i, 3 + c])
            for j in range(ROW):
                C[a, j] += factor * L[i, j]
    for a in range(size):
        c = index[a]
        for b in range(a + 1):
            d = index[b]
            shift = (centre[c] - centre[3 + c]) * (centre[d] - centre[3 + d])
            total = _CENTRE * shift + _WEIGHT * 2.0 * (STATES - points) * shift
            for i in range(points):
                total += _WEIGHT * (seen[i, c] - centre[3 + c]) * (seen[i, d] - centre[3 + d])
                total += _WEIGHT * (seen[i, 3 + c] - centre[3 + c]) * (seen[i, 3 + d] - centre[3 + d])
            S[a, b] = total
        S[a, a] += variance[a]
    return float(_correct(x, P, C, S, y, size, gate))


@compile_kernel
def _forget_correlations(P: NDArray[np.float64]) -> None:
    """Make a covariance positive definite that rounding has made useless: keep its variances alone."""
    for i in range(STATES):
        variance = abs(P[i, i])
        for j in range(ROW):
            P[i, j] = 0.0
        P[i, i] = max(variance, 1e-12)


@compile_kernel
def advance(
    x: NDArray[np.float64], P: NDArray[np.float64], q: NDArray[np.float64], dt: float, work: NDArray[np.float64]
) -> None:
    """Predict over dt [s] in equal steps of at most 0.1 s."""
    if not dt > 0.0:
        return
    steps = max(1, int(np.ceil(dt / MAX_STEP_S - 1e-9)))
    for _ in range(steps):
        if not predict(x, P, q, dt / steps, work):
            _forget_correlations(P)
            predict(x, P, q, dt / steps, work)


@compile_kernel
def find_observed_state(kind: int, index: int) -> int:
    """Return the state that entry ``index`` of a measurement of this kind shows most directly."""
    return index + (AX if kind == SPECIFIC_FORCE else VX if kind == SENSOR_VELOCITY else X)


@compile_kernel
def _open_up(
    x: NDArray[np.float64],
    P: NDArray[np.float64],
    kind: int,
    index: NDArray[np.int64],
    lever: NDArray[np.float64],
    z: NDArray[np.float64],
    work: NDArray[np.float64],
) -> None:
    """Add the squared innovation to the variance of the states that a source shows; positions open the yaw, which leads them astray."""
    seen = x if kind == SELECT else work[47]
    if kind != SELECT:
        _observe(kind, x, lever, seen)
    for a in range(index.size):
        i = find_observed_state(kind, index[a])
        y = z[a] - seen[index[a]]
        if ROLL <= i <= YAW:
            y = min(abs(_wrap(y)), MAX_OPENED_RAD)
        P[i, i] += y * y
        if i == X:
            P[YAW, YAW] += MAX_OPENED_RAD * MAX_OPENED_RAD


@compile_kernel
def is_locked_out(count: float, since_s: float, now_s: float) -> bool:
    """Return whether ``count`` rejections in a row since ``since_s`` show that the estimate is wrong."""
    return count >= _LOCKOUT_COUNT and now_s - since_s >= _LOCKOUT_S


@compile_kernel
def run(belief: FilterState, q: NDArray[np.float64], events: Events, sources: Sources, outputs: Outputs) -> None:
    """Filter forward through all events up to the last output. ``belief`` moves in place.

    When a gate has rejected every measurement of a source for 5 s (and five of them), the estimate is wrong: the variance of the states
    that the source measures is inflated by the innovation, the measurement is fused, and its outcome is `RECOVERED`. ``q`` is the variance
    that each state gains in a second; ``outputs`` are written in place; its times are read.
    """
    x, P, refused = belief.x, belief.P, belief.refused
    work = np.zeros((48, ROW))
    clock_s = belief.clock_s[0]
    e = 0
    for k in range(outputs.time_s.size):
        while e < events.time_s.size and events.time_s[e] <= outputs.time_s[k]:
            now_s = events.time_s[e]
            advance(x, P, q, now_s - clock_s, work)
            clock_s = max(clock_s, now_s)
            s = events.source[e]
            kind, gate, lever = sources.kind[s], sources.gate[s], sources.lever_m[s]
            index = sources.entries[s, : sources.width[s]]
            z = events.z[events.at[e] : events.at[e] + index.size]
            variance = events.variance[events.at[e] : events.at[e] + index.size]
            nis = update(x, P, kind, index, lever, z, variance, gate, work)
            if nis == np.inf:
                _forget_correlations(P)
                nis = update(x, P, kind, index, lever, z, variance, gate, work)
            outputs.nis[e] = nis
            outputs.outcome[e] = ACCEPTED
            if nis <= gate:
                refused[s, 0] = 0.0
            else:
                outputs.outcome[e] = REJECTED
                if refused[s, 0] == 0.0:
                    refused[s, 1] = now_s
                refused[s, 0] += 1.0
                if is_locked_out(refused[s, 0], refused[s, 1], now_s):
                    _open_up(x, P, kind, index, lever, z, work)
                    update(x, P, kind, index, lever, z, variance, np.inf, work)
                    outputs.outcome[e] = RECOVERED
                    refused[s, 0] = 0.0
            e += 1
        advance(x, P, q, outputs.time_s[k] - clock_s, work)
        clock_s = max(clock_s, outputs.time_s[k])
        for i in range(STATES):
            outputs.x[k, i] = x[i]
            outputs.variance[k, i] = P[i, i]
    belief.clock_s[0] = clock_s
