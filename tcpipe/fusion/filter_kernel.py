"""Forward pass of the error-state unscented filter over ticks of the track; the smoother: `smoother_kernel`.

The function of the central state gives the mean. Sigma points give the covariance: they cover only the errors on which
the function depends, with their marginal covariance. With ``P_s = L L'``, the points ``x ± √3 L_i`` give the linear map
``F`` that fits the function best, and the misfit of that map as additional noise::

    F L_i = (f(x + √3 L_i) - f(x - √3 L_i)) / 2√3        misfit: Σ e_i e_i' / 3,  e_i = (f(x + √3 L_i) + f(x - √3 L_i)) / 2 - f(x)

Reference: M. Brossard et al., "A code for unscented Kalman filtering on manifolds (UKF-M)", ICRA 2020.
"""

from __future__ import annotations

from enum import IntEnum
from math import log, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Mask
from tcpipe.compiled import compile_kernel
from tcpipe.fusion.state import (
    KINDS,
    MOVING,
    NX,
    SIZES,
    Error,
    Kind,
    Matrix,
    Mode,
    N,
    Vector,
    compute_moving_error,
    displace_state,
    make_rotation,
    move_state,
    predict_measurement,
)


class GateVerdict(IntEnum):
    """Verdicts of the gate. RESET: rejections lasted so long that the state is assumed wrong, not the sensor."""

    NONE, ACCEPTED, REJECTED, RESET = range(4)


RESET_REJECTIONS, RESET_SPEED_STD_MPS = 5, 0.3
"""Fewest consecutive rejections before a reset [1], and σ of the velocity after it, as at the start [m/s]."""

Indices = NDArray[np.int64]


class TickInputs(NamedTuple):
    """All measurements of a section, by tick k of K; see `tcpipe.fusion.ticks`.

    Attributes
    ----------
    period_s : time between ticks [s].
    mode, turned, gained : motion since the tick before, see `move_state`, (K,), (K, 9), (K, 6).
    noise : variance added to rotation and body velocity [rad², m²/s²], (K, 6).
    rate, has_gyro : measured angular velocity at the tick [rad/s], (K, 3), and whether a gyroscope measured it, (K,).
    acceleration : forward acceleration of the body at the tick [m/s²], (K,), from sensors. The acceleration of the
    state is too noisy: its noise would act as a delay of every sensor.
    value, variance : measurements by kind, (K, 9, 3); NaN: none. The value of an attitude is zero: it is a rotation
    from ``attitude``.
    tau : time of the measurement after the tick [s], (K, 9).
    levers : lever arms of odometries [m], (9, 3).
    fix_kept, fix_noise : decay factor of the fixes' correlated error since the tick before, (K,), and variance added to
    that error [m²], (K, 3).
    attitude : rotation vector of a pose's attitude, enu_from_robot [rad], (K, 3).
    """

    period_s: float
    mode: NDArray[np.int8]
    turned: Matrix
    gained: Matrix
    noise: Matrix
    rate: Matrix
    has_gyro: Mask
    acceleration: Vector
    value: Floats
    variance: Floats
    tau: Matrix
    levers: Matrix
    fix_kept: Vector
    fix_noise: Matrix
    attitude: Matrix


class FilterModel(NamedTuple):
    """Assumptions of the filter.

    Attributes
    ----------
    active : errors that are not known exactly, in order, (n,).
    depends : for each kind of measurement, then motion by odometry and by gyroscope: indices in ``active`` of the
        errors on which it depends, (11, n); only the first ``counts`` (11,) are valid.
    kept, noise : decay factor of each error over a tick, and variance added, (n,).
    gates : largest squared normalised innovation by kind; infinite: no gate.
    patience_s : by kind, time since the last accepted measurement after which one is accepted [s], (9,).
    mount : index of the IMU's mounting in ``active``; -1: known exactly.
    events : changes of errors: (tick, index in ``active``, whether the error is drawn anew), (e, 3).
    sizes, shifts : variance that each event adds, and mean change of the error, (e,).
    """

    active: Indices
    depends: NDArray[np.int64]
    counts: Indices
    kept: Vector
    noise: Vector
    gates: Vector
    patience_s: Vector
    mount: int
    events: NDArray[np.int64]
    sizes: Vector
    shifts: Vector


class Memory(NamedTuple):
    """State between ticks: x (51,), P (n, n), rejections in a row and seconds since acceptance by kind, (9, 2)."""

    x: Vector
    P: Matrix
    waits: Matrix

    def copy(self) -> Memory:
        """Return a copy."""
        return Memory(self.x.copy(), self.P.copy(), self.waits.copy())

    def select(self, active: Indices) -> Memory:
        """Return a copy with some of the errors."""
        return Memory(self.x.copy(), self.P[np.ix_(active, active)], self.waits.copy())


class Steps(NamedTuple):
    """Inputs of the smoother, B ticks: motion F, decay factors, updates by kind (K, H, S⁻¹ y, S⁻¹, turn), last x, P."""

    F: Floats
    kept: Matrix
    used: Mask
    K: Floats
    H: Floats
    pull: Floats
    inverse: Floats
    turn: Floats
    x: Matrix
    P: Floats


class Tests(NamedTuple):
    """By tick and kind: squared normalised innovation, log det S, verdict of the gate; innovation of the fixes."""

    nis: Matrix
    log_det: Matrix
    verdict: NDArray[np.int8]
    fix_innovation: Matrix


MOST = MOVING + 1  # largest number of errors on which motion depends
_SPREAD = sqrt(3.0)  # matches the fourth moment of a normal distribution


def allocate_steps(ticks: int, n: int) -> Steps:
    """Return empty arrays for the inputs of the smoother over this many ticks."""
    return Steps(
        np.zeros((ticks, MOST, MOST)),
        np.ones((ticks, n)),
        np.zeros((ticks, KINDS), np.bool_),
        np.zeros((ticks, KINDS, 3, n)),
        np.zeros((ticks, KINDS, 3, n)),
        np.zeros((ticks, KINDS, 3)),
        np.zeros((ticks, KINDS, 3, 3)),
        np.zeros((ticks, KINDS, 18)),
        np.zeros((ticks, NX)),
        np.zeros((ticks, n, n)),
    )


@compile_kernel
def factorize(P: Matrix, indices: Indices, m: int, L: Matrix) -> None:
    """Fill L with the lower Cholesky factor of P at m indices; pivots that rounding made too small are raised."""
    for i in range(m):
        for j in range(i + 1):
            s = P[indices[i], indices[j]]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = sqrt(max(s, 1e-14 * P[indices[i], indices[i]] + 1e-300))
            else:
                L[i, j] = s / L[j, j]


@compile_kernel
def _solve_for_map(M: Matrix, rows: int, L: Matrix, m: int, F: Matrix) -> None:
    """Fill F with M L⁻¹."""
    for a in range(rows):
        for i in range(m - 1, -1, -1):
            s = M[a, i]
            for j in range(i + 1, m):
                s -= F[a, j] * L[j, i]
            F[a, i] = s / L[i, i]


@compile_kernel
def _draw_sigma_point(i: int, m: int, active: Indices, indices: Indices, L: Matrix, d: Vector) -> None:
    """Fill d with the errors of the i-th sigma point: √3 times a column of the factor of P at m indices."""
    d[:] = 0.0
    for r in range(i, m):
        d[active[indices[r]]] = _SPREAD * L[r, i]


@compile_kernel
def _move(k: int, inputs: TickInputs, model: FilterModel, x: Vector, P: Matrix, F: Matrix, room: Any) -> None:
    """Propagate x and P over the motion of tick k; F becomes the map of the errors on which the motion depends."""
    L, M, W, misfit, d, high, low, centre, turn, up, down = room
    mode = inputs.mode[k]
    row = KINDS + (mode >= Mode.GYRO_TURN)
    indices, m, n = model.depends[row], model.counts[row], P.shape[0]
    move_state(x, mode, inputs.period_s, inputs.turned[k], inputs.gained[k], centre, turn)
    factorize(P, indices, m, L)
    misfit[:] = 0.0
    for i in range(m):
        _draw_sigma_point(i, m, model.active, indices, L, d)
        displace_state(x, d, 1.0, low, turn)
        move_state(low, mode, inputs.period_s, inputs.turned[k], inputs.gained[k], high, turn)
        compute_moving_error(high, centre, up)
        displace_state(x, d, -1.0, low, turn)
        move_state(low, mode, inputs.period_s, inputs.turned[k], inputs.gained[k], high, turn)
        compute_moving_error(high, centre, down)
        for a in range(m):
            e = model.active[indices[a]]
            if e < MOVING:
                M[a, i] = 0.5 / _SPREAD * (up[e] - down[e])
                d[e] = 0.5 * (up[e] + down[e])
            else:
                M[a, i] = L[a, i] if a >= i else 0.0
                d[e] = 0.0
        for a in range(m):
            for b in range(m):
                misfit[a, b] += d[model.active[indices[a]]] * d[model.active[indices[b]]] / 3.0
    _solve_for_map(M, m, L, m, F)
    for a in range(m):
        W[a] = 0.0
        for b in range(m):
            f = F[a, b]
            line = P[indices[b]]
            for j in range(n):
                W[a, j] += f * line[j]
    for a in range(m):
        P[indices[a]] = W[a]
        P[:, indices[a]] = W[a]
    for a in range(m):
        for b in range(a + 1):
            s = misfit[a, b]
            for c in range(m):
                s += W[a, indices[c]] * F[b, c]
            P[indices[a], indices[b]] = s
            P[indices[b], indices[a]] = s
    x[:] = centre
    for e in range(3):  # rotation and velocity are always active, and first
        P[Error.THETA + e, Error.THETA + e] += inputs.noise[k, e]
        P[Error.U + e, Error.U + e] += inputs.noise[k, 3 + e]


@compile_kernel
def _decay(k: int, inputs: TickInputs, model: FilterModel, x: Vector, P: Matrix, kept: Vector) -> None:
    """Apply decay, random walk and events of parameters at tick k; ``kept`` becomes the decay factor of each error."""
    n = P.shape[0]
    for i in range(n):
        is_fix_error = Error.FIX_ERROR <= model.active[i] < Error.FIX_ERROR + 3
        kept[i] = inputs.fix_kept[k] if is_fix_error else model.kept[i]
    for j in range(model.events.shape[0]):
        tick, place, is_new = model.events[j]
        if tick == k and is_new:
            kept[place] = 0.0
    for i in range(n):
        if kept[i] != 1.0:
            x[model.active[i] + 6] *= kept[i]
            P[i] *= kept[i]
            P[:, i] *= kept[i]
        P[i, i] += model.noise[i]
        if Error.FIX_ERROR <= model.active[i] < Error.FIX_ERROR + 3:
            P[i, i] += inputs.fix_noise[k, model.active[i] - Error.FIX_ERROR]
    for j in range(model.events.shape[0]):
        if model.events[j, 0] == k:
            place = model.events[j, 1]
            P[place, place] += model.sizes[j]
            x[model.active[place] + 6] += model.shifts[j]


@compile_kernel
def _compute_innovation(
    k: int,
    kind: int,
    inputs: TickInputs,
    model: FilterModel,
    x: Vector,
    P: Matrix,
    acceleration: Vector,
    gain: Any,
    room: Any,
) -> float:
    """Fill innovation, H, P H', S and S⁻¹ of one measurement; return log det S."""
    y, H, Hs, cross, S, inverse = gain
    L, M, misfit, d, high, turn, up, down = room[0], room[1], room[3], room[4], room[5], room[8], room[9], room[10]
    indices, m, size, n = model.depends[kind], model.counts[kind], SIZES[kind], P.shape[0]
    rate, gyro, tau = inputs.rate[k], inputs.has_gyro[k], inputs.tau[k, kind]
    lever = inputs.attitude[k] if kind == Kind.ATTITUDE else inputs.levers[kind]
    centre = S[0]
    predict_measurement(kind, x, rate, gyro, acceleration, tau, lever, centre)
    y[:] = centre
    factorize(P, indices, m, L)
    misfit[:3, :3] = 0.0
    for i in range(m):
        _draw_sigma_point(i, m, model.active, indices, L, d)
        displace_state(x, d, 1.0, high, turn)
        predict_measurement(kind, high, rate, gyro, acceleration, tau, lever, up)
        displace_state(x, d, -1.0, high, turn)
        predict_measurement(kind, high, rate, gyro, acceleration, tau, lever, down)
        for a in range(size):
            M[a, i] = 0.5 / _SPREAD * (up[a] - down[a])
            for b in range(a + 1):
                misfit[a, b] += (0.5 * (up[a] + down[a]) - y[a]) * (0.5 * (up[b] + down[b]) - y[b]) / 3.0
    if kind == Kind.FIX:  # error of yaw times error of distance since the last fix: sideways
        for a in range(3):
            for b in range(3):
                misfit[a, b] += (
                    P[Error.THETA + 2, Error.THETA + 2] * P[Error.RHO, Error.RHO] * x[3 * a + 1] * x[3 * b + 1]
                )
    _solve_for_map(M, size, L, m, Hs)
    for a in range(size):
        H[a], cross[a] = 0.0, 0.0
        for i in range(m):
            h = Hs[a, i]
            H[a, indices[i]] = h
            line = P[indices[i]]
            for j in range(n):
                cross[a, j] += h * line[j]
    for a in range(size):
        for b in range(a + 1):
            s = misfit[a, b]
            for i in range(m):
                s += Hs[b, i] * cross[a, indices[i]]
            S[a, b] = s
            S[b, a] = s
        S[a, a] += inputs.variance[k, kind, a]
        y[a] = inputs.value[k, kind, a] - y[a]
    log_det: float = _invert(S, size, inverse)
    return log_det


@compile_kernel
def _invert(S: Matrix, size: int, out: Matrix) -> float:
    """Fill ``out`` with the inverse of a positive definite matrix of 1 to 3 rows; return the log of its determinant."""
    if size == 1:
        out[0, 0] = 1.0 / S[0, 0]
        return log(S[0, 0])
    if size == 2:
        determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]
        out[0, 0], out[1, 1] = S[1, 1] / determinant, S[0, 0] / determinant
        out[0, 1] = out[1, 0] = -S[0, 1] / determinant
        return log(determinant)
    out[0, 0] = S[1, 1] * S[2, 2] - S[1, 2] * S[1, 2]
    out[0, 1] = S[0, 2] * S[1, 2] - S[0, 1] * S[2, 2]
    out[0, 2] = S[0, 1] * S[1, 2] - S[0, 2] * S[1, 1]
    out[1, 1] = S[0, 0] * S[2, 2] - S[0, 2] * S[0, 2]
    out[1, 2] = S[0, 1] * S[0, 2] - S[0, 0] * S[1, 2]
    out[2, 2] = S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]
    determinant = S[0, 0] * out[0, 0] + S[0, 1] * out[0, 1] + S[0, 2] * out[0, 2]
    for a in range(3):
        for b in range(a, 3):
            out[a, b] /= determinant
            out[b, a] = out[a, b]
    return log(determinant)


@compile_kernel
def _compute_nis(y: Vector, inverse: Matrix, size: int) -> float:
    """Return the squared normalised innovation."""
    s = 0.0
    for a in range(size):
        for b in range(size):
            s += y[a] * y[b] * inverse[a, b]
    return s


@compile_kernel
def _make_turn(a: float, b: float, c: float, out: Vector) -> None:
    """Fill ``out`` with the rotations of the axes of rotation and position errors by a correction (a, b, c).

    These are the right Jacobian of SO(3) to second order (Solà 2017, eq. 183), and the inverse rotation.
    """
    make_rotation(-a, -b, -c, out[9:])
    make_rotation(-0.5 * a, -0.5 * b, -0.5 * c, out)


@compile_kernel
def turn_rows(A: Matrix, turn: Vector, columns: int, transposed: bool) -> None:
    """Multiply the first two blocks of three rows of A from the left by two 3 x 3 matrices, or by their transposes."""
    for block in range(2):
        r, o = 3 * block, 9 * block
        for j in range(columns):
            a, b, c = A[r, j], A[r + 1, j], A[r + 2, j]
            for i in range(3):
                if transposed:
                    A[r + i, j] = turn[o + i] * a + turn[o + 3 + i] * b + turn[o + 6 + i] * c
                else:
                    A[r + i, j] = turn[o + 3 * i] * a + turn[o + 3 * i + 1] * b + turn[o + 3 * i + 2] * c


@compile_kernel
def _correct(x: Vector, P: Matrix, active: Indices, size: int, gain: Any, K: Matrix, turn: Vector, room: Any) -> None:
    """Correct x and P by the result of `_compute_innovation`; fill K' and the rotation of the axes."""
    y, _, _, cross, _, inverse = gain
    d, high, small = room[4], room[5], room[8]
    n = P.shape[0]
    d[:] = 0.0
    for a in range(size):
        for j in range(n):
            s = 0.0
            for b in range(size):
                s += inverse[a, b] * cross[b, j]
            K[a, j] = s
            d[active[j]] += s * y[a]
    for a in range(size):
        for i in range(n):
            f = K[a, i]
            for j in range(n):
                P[i, j] -= f * cross[a, j]
    displace_state(x, d, 1.0, high, small)
    x[:] = high
    _make_turn(d[0], d[1], d[2], turn)
    turn_rows(P, turn, n, False)
    turn_rows(P.T, turn, n, False)
    for i in range(n):
        for j in range(i):
            s = 0.5 * (P[i, j] + P[j, i])
            P[i, j] = s
            P[j, i] = s


@compile_kernel
def filter_ticks(
    first: int,
    last: int,
    inputs: TickInputs,
    model: FilterModel,
    memory: Memory,
    steps: Steps,
    tests: Tests,
) -> None:
    """Filter ticks ``first`` to ``last``, the latter excluded; ``memory`` becomes the state after them.

    Parameters
    ----------
    inputs, model : see `TickInputs`, `FilterModel`.
    memory : state at tick ``first - 1``, or at tick 0 if ``first`` is 0.
    steps : filled, unless it is empty; tick k has row ``k - first``.
    tests : filled for these ticks.
    """
    x, P, waits = memory
    keep = steps.used.shape[0] > 0
    n = P.shape[0]
    room = (
        np.zeros((n, n)),
        np.zeros((n, n)),
        np.zeros((MOST, n)),
        np.zeros((MOST, MOST)),
        np.zeros(N),
        np.zeros(NX),
        np.zeros(NX),
        np.zeros(NX),
        np.zeros(9),
        np.zeros(MOVING),
        np.zeros(MOVING),
    )
    gain = (np.zeros(3), np.zeros((3, n)), np.zeros((3, n)), np.zeros((3, n)), np.zeros((3, 3)), np.zeros((3, 3)))
    F, kept, K, turn = np.zeros((MOST, MOST)), np.ones(n), np.zeros((3, n)), np.zeros(18)
    acceleration = np.zeros(3)
    y, H, _, _, _, inverse = gain
    for k in range(first, last):
        if k > 0:
            _move(k, inputs, model, x, P, F, room)
            _decay(k, inputs, model, x, P, kept)
        if keep and k > 0:
            steps.F[k - first], steps.kept[k - first] = F, kept
        acceleration[0] = inputs.acceleration[k]
        for kind in range(KINDS):
            waits[kind, 1] += inputs.period_s
            if not np.isfinite(inputs.value[k, kind, 0]):
                continue
            size = SIZES[kind]
            log_det = _compute_innovation(k, kind, inputs, model, x, P, acceleration, gain, room)
            nis = _compute_nis(y, inverse, size)
            tests.nis[k, kind] = nis
            tests.log_det[k, kind] = log_det
            verdict = GateVerdict.ACCEPTED
            if kind == Kind.FIX:
                tests.fix_innovation[k] = y
            if not nis <= model.gates[kind]:
                verdict = GateVerdict.REJECTED
                waits[kind, 0] += 1.0
                if waits[kind, 0] >= RESET_REJECTIONS and waits[kind, 1] >= model.patience_s[kind]:
                    verdict = GateVerdict.RESET
                    measured = Error.RHO if kind == Kind.FIX else Error.THETA
                    for i in range(3):
                        P[measured + i, measured + i] += y[i] * y[i]
                        P[Error.U + i, Error.U + i] += RESET_SPEED_STD_MPS**2
                    P[Error.THETA + 2, Error.THETA + 2] += 0.1**2  # rad
                    _compute_innovation(k, kind, inputs, model, x, P, acceleration, gain, room)
            tests.verdict[k, kind] = verdict
            if verdict == GateVerdict.REJECTED:
                continue
            waits[kind, 0] = 0.0
            waits[kind, 1] = 0.0
            _correct(x, P, model.active, size, gain, K, turn, room)
            if keep:
                row = k - first
                steps.used[row, kind], steps.inverse[row, kind], steps.turn[row, kind] = True, inverse, turn
                steps.K[row, kind], steps.H[row, kind] = K, H
                for a in range(size):
                    s = 0.0
                    for b in range(size):
                        s += inverse[a, b] * y[b]
                    steps.pull[row, kind, a] = s
        if keep:
            steps.x[k - first], steps.P[k - first] = x, P
