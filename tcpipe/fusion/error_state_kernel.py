"""Forward pass of the error-state unscented filter: updates by one measurement, events in order, gates that reject and reset, GNSS error.

Every update draws new sigma points. State, errors and the prediction are in `state_kernel`, the backward pass in
`smoother_kernel`.
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel
from tcpipe.fusion.state_kernel import (
    ACCEPTED,
    CENTRE_WEIGHT,
    DECAY,
    GNSS_POSITION,
    GNSS_VELOCITY,
    GYRO_TURN,
    LEVEL,
    NX,
    PREDICT,
    REFUSED,
    REOPENED,
    STANDING,
    STANDING_RATE,
    VISUAL_VELOCITY,
    WHEEL_VELOCITY,
    Matrix,
    N,
    Vector,
    allocate_workspace,
    copy_values,
    displace_state,
    factorize_covariance,
    predict,
    save_state,
)


@compile_kernel
def compute_observation(U: Matrix, Z: Matrix, H: Matrix) -> None:
    """Fill H, shape (3, n): H' = P⁻⁻¹ cov(dx⁻, z) = U⁻¹ M, by the sigma points of `compute_innovation`."""
    n = U.shape[0]
    for a in range(3):
        for i in range(n - 1, -1, -1):
            s = 0.5 / sqrt(n) * (Z[i, a] - Z[i + n, a])
            for j in range(i + 1, n):
                s -= U[i, j] * H[a, j]
            H[a, i] = s / U[i, i]


@compile_kernel
def _predict_measurement(kind: int, x: Vector, w: Vector, lever: Vector, bias: float, out: Vector) -> None:
    """Measurement h(x) of an event; w: angular velocity now, of which ``bias`` times b_g is taken off."""
    out[0] = 0.0
    out[1] = 0.0
    out[2] = 0.0
    if kind == GNSS_POSITION:
        for i in range(3):
            out[i] = x[18 + i] + x[3 * i] * lever[0] + x[3 * i + 1] * lever[1] + x[3 * i + 2] * lever[2]
            if x.size > NX:
                out[i] += x[NX + i]
    elif kind == STANDING:
        for i in range(3):
            out[i] = x[15 + i]
    elif kind == STANDING_RATE:
        for i in range(3):
            out[i] = x[9 + i]
    elif kind == LEVEL:
        out[0] = x[6]
        out[1] = x[7]
    else:
        w0 = w[0] - x[9] * bias
        w1 = w[1] - x[10] * bias
        w2 = w[2] - x[11] * bias
        v0 = x[0] * x[15] + x[3] * x[16] + x[6] * x[17] + w1 * lever[2] - w2 * lever[1]
        v1 = x[1] * x[15] + x[4] * x[16] + x[7] * x[17] + w2 * lever[0] - w0 * lever[2]
        v2 = x[2] * x[15] + x[5] * x[16] + x[8] * x[17] + w0 * lever[1] - w1 * lever[0]
        if kind == WHEEL_VELOCITY:
            out[0] = v0 * (1.0 + x[21])
            out[1] = v1
            out[2] = v2
        elif kind == VISUAL_VELOCITY:
            s = 1.0 + x[22]
            out[0] = v0 * s
            out[1] = v1 * s
            out[2] = v2 * s
        elif kind == GNSS_VELOCITY:
            for i in range(3):
                out[i] = x[3 * i] * v0 + x[3 * i + 1] * v1 + x[3 * i + 2] * v2
        else:
            out[0] = v1
            out[1] = v2


@compile_kernel
def compute_innovation(
    kind: int, x: Vector, P: Matrix, z: Vector, r: Vector, w: Vector, lever: Vector, bias: float, work: Any, gain: Any
) -> float:
    """Fill innovation, cross covariance and the inverse innovation covariance; return the squared normalised innovation.

    Of a wheel event only the wheels' own velocity counts, not the constraint that comes with it.
    """
    U, _, d, _, _, shifted, _, turn, tally = work
    y, Z, S, cross, inverse = gain
    n = P.shape[0]
    gamma, wi = sqrt(n), 0.5 / n
    factorize_covariance(P, U, tally)
    _predict_measurement(kind, x, w, lever, bias, y)
    centre0 = y[0]
    centre1 = y[1]
    centre2 = y[2]
    for a in range(3):
        y[a] = 0.0
        for j in range(n):
            cross[a, j] = 0.0
    for i in range(n):
        for j in range(n):
            d[j] = gamma * U[i, j] if j >= i else 0.0
        for side in range(2):
            displace_state(x, d, 1.0 - 2.0 * side, i < 3, shifted, turn)
            _predict_measurement(kind, shifted, w, lever, bias, Z[i + side * n])
        for a in range(3):
            y[a] += wi * (Z[i, a] + Z[i + n, a])
            e = wi * (Z[i, a] - Z[i + n, a])
            for j in range(n):
                cross[a, j] += e * d[j]
    centre = (centre0 - y[0], centre1 - y[1], centre2 - y[2])
    for a in range(3):
        for b in range(3):
            s = CENTRE_WEIGHT * centre[a] * centre[b]
            for i in range(2 * n):
                s += wi * (Z[i, a] - y[a]) * (Z[i, b] - y[b])
            S[a, b] = s
        S[a, a] += r[a]
        y[a] = z[a] - y[a]
    inverse[0, 0] = S[1, 1] * S[2, 2] - S[1, 2] * S[1, 2]
    inverse[0, 1] = S[0, 2] * S[1, 2] - S[0, 1] * S[2, 2]
    inverse[0, 2] = S[0, 1] * S[1, 2] - S[0, 2] * S[1, 1]
    inverse[1, 1] = S[0, 0] * S[2, 2] - S[0, 2] * S[0, 2]
    inverse[1, 2] = S[0, 1] * S[0, 2] - S[0, 0] * S[1, 2]
    inverse[2, 2] = S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]
    determinant = S[0, 0] * inverse[0, 0] + S[0, 1] * inverse[0, 1] + S[0, 2] * inverse[0, 2]
    nis = 0.0
    for a in range(3):
        for b in range(a, 3):
            inverse[a, b] /= determinant
            inverse[b, a] = inverse[a, b]
            nis += (1.0 if a == b else 2.0) * y[a] * y[b] * inverse[a, b]
    if kind == WHEEL_VELOCITY:
        nis = y[0] * y[0] / S[0, 0]
    return nis


@compile_kernel
def _reset(a: float, b: float, c: float, out: Matrix) -> None:
    """Fill J, which carries a small rotation error over to the axes that a correction by (a, b, c) has turned (Solà 2017, eq. 183).

    J = I - (1 - cos |t|) / |t|² [t]x + (|t| - sin |t|) / |t|³ [t]x², the right Jacobian of SO(3).
    """
    t2 = a * a + b * b + c * c
    if t2 < 1e-4:
        f = 0.5 - t2 / 24.0
        g = (1.0 - t2 / 20.0) / 6.0
    else:
        t = sqrt(t2)
        f = (1.0 - cos(t)) / t2
        g = (t - sin(t)) / (t2 * t)
    axis = (a, b, c)
    for i in range(3):
        for j in range(3):
            out[i, j] = g * axis[i] * axis[j] + (1.0 - g * t2 if i == j else 0.0)
    out[0, 1] += f * c
    out[1, 0] -= f * c
    out[1, 2] += f * a
    out[2, 1] -= f * a
    out[2, 0] += f * b
    out[0, 2] -= f * b


@compile_kernel
def correct(x: Vector, P: Matrix, work: Any, gain: Any, J: Matrix) -> None:
    """X ⊞ K y and J (P - K S K') J' with what `compute_innovation` left; K' stays in the first rows of the work's second array."""
    _, D, d, _, _, shifted, _, turn, _ = work
    y, _, _, cross, inverse = gain
    n = P.shape[0]
    for j in range(n):
        d[j] = 0.0
    for a in range(3):
        row = D[a]  # row a of K'
        for j in range(n):
            row[j] = inverse[a, 0] * cross[0, j] + inverse[a, 1] * cross[1, j] + inverse[a, 2] * cross[2, j]
            d[j] += row[j] * y[a]
    for i in range(n):
        for j in range(n):
            P[i, j] -= D[0, i] * cross[0, j] + D[1, i] * cross[1, j] + D[2, i] * cross[2, j]
    _reset(d[0], d[1], d[2], J)
    for j in range(n):
        p0 = P[0, j]
        p1 = P[1, j]
        p2 = P[2, j]
        for i in range(3):
            P[i, j] = J[i, 0] * p0 + J[i, 1] * p1 + J[i, 2] * p2
    for j in range(n):
        p0 = P[j, 0]
        p1 = P[j, 1]
        p2 = P[j, 2]
        for i in range(3):
            P[j, i] = J[i, 0] * p0 + J[i, 1] * p1 + J[i, 2] * p2
    for i in range(n):
        for j in range(i):
            s = 0.5 * (P[i, j] + P[j, i])
            P[i, j] = s
            P[j, i] = s
    displace_state(x, d, 1.0, True, shifted, turn)
    for i in range(x.size):
        x[i] = shifted[i]


FIXED = 1e-10
"""A scale of no more variance is held."""
_FORGOTTEN_S = 300.0
_ANEW = 0.1
OFF_M = 0.5
"""What fixes that contradict the rest may be off by, at least."""
_KNOWN_M = 0.1
_MEAN_OF = 10
SURELY = 2.5  # times the gate; clean drives stay below 2
_WILD = 4.0


@compile_kernel
def _inflate_after_lockout(kind: int, P: Matrix, y: Vector, alone: bool) -> None:  # noqa: FBT001
    """Lift P after a lock-out so that the sensor can be heard again: the state may have jumped, or the sensor's scale."""
    if kind == GNSS_POSITION:
        P[2, 2] += 0.1**2
        if P[15, 15] > FIXED:
            P[15, 15] += 0.3**2
        for i in range(3):
            P[9 + i, 9 + i] += 0.3**2
            P[12 + i, 12 + i] += y[i] * y[i]
    else:
        scale = 15 if kind == WHEEL_VELOCITY else 16
        if P[scale, scale] > FIXED:
            P[scale, scale] += 0.1**2
        if alone:
            for i in range(3):
                P[9 + i, 9 + i] += y[0] * y[0] + y[1] * y[1] + y[2] * y[2]


@compile_kernel
def _reset_fix_error(x: Vector, P: Matrix, variance: Vector) -> None:
    """Forget the fixes' error: another one has taken its place."""
    for i in range(N, P.shape[0]):
        x[6 + i] = 0.0
        for j in range(P.shape[0]):
            P[i, j] = 0.0
            P[j, i] = 0.0
    for i in range(N, P.shape[0]):
        P[i, i] = variance[i - N]


@compile_kernel
def _has_drift(y: Vector, S: Matrix, gate: float, opened: Vector) -> bool:
    """Whether innovations lie on one side on average, each of them within the gate as it may be; the mean follows in ``opened[3:]``."""
    size = 0.0
    for a in range(3):
        normal = min(max(y[a] / sqrt(S[a, a]), -_WILD), _WILD)
        opened[3 + a] += (normal - opened[3 + a]) / _MEAN_OF
        size += opened[3 + a] * opened[3 + a]
    return (2 * _MEAN_OF - 1) * size > SURELY * gate


@compile_kernel
def _is_gone(x: Vector, P: Matrix) -> bool:
    """Whether the fixes' error is known well enough to say that it is none."""
    gone = True
    for i in range(N, N + 2):
        gone = gone and P[i, i] < _KNOWN_M**2 and x[6 + i] * x[6 + i] < P[i, i]
    return gone


@compile_kernel
def find_largest_drift(normal: Matrix) -> float:
    """Return the largest that `_has_drift` would see in normalised innovations, shape (F, 3)."""
    mean = np.zeros(3)
    most = 0.0
    for row in range(normal.shape[0]):
        size = 0.0
        for a in range(3):
            mean[a] += (min(max(normal[row, a], -_WILD), _WILD) - mean[a]) / _MEAN_OF
            size += mean[a] * mean[a]
        if row >= _MEAN_OF:
            most = max(most, (2 * _MEAN_OF - 1) * size)
    return most


@compile_kernel
def _decay_fix_error(x: Vector, P: Matrix, kept: float, noise: Vector, opened: Vector, dt: float) -> None:
    """Let the fixes' error fade: ``kept`` of it remains, ``noise`` is added; where a gate has reopened it may stay as large as that."""
    for i in range(N, P.shape[0]):
        x[6 + i] *= kept
        for j in range(P.shape[0]):
            P[i, j] *= kept
            P[j, i] *= kept
        opened[i - N] *= 1.0 - min(dt / _FORGOTTEN_S, 1.0) if kept > _ANEW else 0.0
        P[i, i] += noise[i - N] + opened[i - N] * max(1.0 - kept * kept, 0.0)


@compile_kernel
def filter_block(
    first: int,
    last: int,
    dt: Vector,
    kind: NDArray[np.int8],
    mode: NDArray[np.int8],
    q_v: Vector,
    z: Matrix,
    r: Matrix,
    turn_rate: Matrix,
    force: Matrix,
    turn_rate_now: Matrix,
    output: NDArray[np.int64],
    levers: Matrix,
    densities: Matrix,
    gates: Vector,
    lock_out: Matrix,
    kept_error: Vector,
    error_noise: Matrix,
    error_level: Matrix,
    x: Vector,
    P: Matrix,
    refused: Vector,
    silent: Vector,
    opened: Vector,
    keep: bool,  # noqa: FBT001
    store: Any,
    nis: Vector,
    innovation: Matrix,
    verdict: NDArray[np.int8],
    outputs: Matrix,
) -> float:
    """Filter events ``first`` to ``last``; return how often P had to be repaired.

    Parameters
    ----------
    dt : [s], time since the event before. kind, mode : as in `state_kernel`. q_v : noise of v since then, see `predict`.
    z, r : measurement and variances, shape (E, 3); unused entries are 0 and 1.
    turn_rate, force : mean angular velocity and specific force since the event before, shape (E, 3).
    turn_rate_now : angular velocity at the event, shape (E, 3).
    output : row of ``outputs`` that the event fills, or -1.
    levers : lever arm by kind, shape (9, 3). densities : process noise by mode, shape (4, 21), see `predict`.
    gates : threshold of the squared normalised innovation by kind; infinite where there is no gate.
    lock_out : by kind (9, 4): refusals in a row, and seconds since the last accepted one, after which the gate reopens; the seconds
        where no other sensor that tells velocity has been accepted for 2 s; 1 where the fixes' error is lifted, not the pose.
    kept_error, error_noise, error_level : what remains of the fixes' error since the event before, the variances added to it [m²],
        shape (E, 3), and those that it has in the long run, shape (E, 3).
    x, P, refused, silent, opened : state and memory at ``first``, of 17 errors or, with that of the fixes, of 20; refusals in a row and
        silence by kind; variance [m²] of what made the gate of fixes reopen, and their mean innovation. They become those after
        ``last - 1``.
    keep, store : with ``keep``, row e - first of the first three becomes F (12, 9), K' and H (2, 3, n), and (25,): 1 where time passed,
        what remains of s_w, 1 where something was measured and used, S⁻¹ y, S⁻¹, J, what remains of the fixes' error; the last gets P of
        each wanted stamp in turn.
    nis, innovation, verdict, outputs : filled for the events.
    """
    work, gain = allocate_workspace(P.shape[0])
    store_F, store_KH, store_y, store_P = store
    F = np.zeros((12 if keep else 0, 9))
    J = np.zeros((3, 3))
    wanted = 0
    for e in range(first, last):
        kept = kept_error[e]
        if P.shape[0] > N:
            _decay_fix_error(x, P, kept, error_noise[e], opened, dt[e])
        if dt[e] > 0.0:
            predict(x, P, densities[mode[e]], q_v[e], dt[e], turn_rate[e], force[e], mode[e], F, work)
            for k in range(silent.size):
                silent[k] += dt[e]
        k = kind[e]
        hears = False
        if k != PREDICT:
            # A scale of the turn rate is told by turns alone: beside a lever arm the rate's own noise would pass for one.
            bias = 1.0 if mode[e] >= GYRO_TURN else 0.0
            if k == GNSS_POSITION and opened[0] > 0.0 and _is_gone(x, P):
                kept = 0.0
                opened[:] = 0.0
                _reset_fix_error(x, P, error_level[e])
            value = compute_innovation(k, x, P, z[e], r[e], turn_rate_now[e], levers[k], bias, work, gain)
            hears = True
            verdict[e] = ACCEPTED
            for a in range(3):
                innovation[e, a] = gain[0][a]
            off_for_long = False
            if k == GNSS_POSITION and lock_out[k, 3] > 0.0 and opened[0] == 0.0:
                off_for_long = _has_drift(gain[0], gain[2], gates[k], opened)
            if off_for_long or not value <= gates[k]:
                hears = False
                verdict[e] = REFUSED
                refused[k] += 1.0
                alone = True
                for other in range(GNSS_POSITION, VISUAL_VELOCITY + 1):
                    alone = alone and (other == k or silent[other] > 2.0)
                long = silent[k] >= lock_out[k, 2 if alone else 1] or (k == GNSS_POSITION and opened[0] > 0.0)
                if refused[k] >= lock_out[k, 0] and long:
                    if lock_out[k, 3] > 0.0 and P.shape[0] > N:
                        kept = 0.0  # either the fixes are right again, or they err in another way
                        _reset_fix_error(x, P, error_level[e])
                        again = compute_innovation(k, x, P, z[e], r[e], turn_rate_now[e], levers[k], bias, work, gain)
                        for a in range(3):
                            opened[a] = max(gain[0][a] ** 2, OFF_M**2) if again > SURELY * gates[k] else 0.0
                            opened[3 + a] = 0.0
                        if again > SURELY * gates[k]:
                            _reset_fix_error(x, P, np.maximum(opened[:3], error_level[e]))
                    else:
                        _inflate_after_lockout(k, P, gain[0], alone)
                    again = compute_innovation(k, x, P, z[e], r[e], turn_rate_now[e], levers[k], bias, work, gain)
                    softer = max(again / gates[k], 1.0)
                    for a in range(3):
                        gain[2][a, a] = r[e, a] * softer * softer
                    compute_innovation(
                        k, x, P, z[e], np.diag(gain[2]).copy(), turn_rate_now[e], levers[k], bias, work, gain
                    )
                    hears = True
                    verdict[e] = REOPENED
            nis[e] = value
        row = e - first
        if keep:
            copy_values(F, store_F[row])
            store_y[row, 0] = 1.0 if dt[e] > 0.0 else 0.0
            store_y[row, 1] = 1.0 - dt[e] * densities[mode[e], DECAY]
            store_y[row, 2] = 1.0 if hears else 0.0
            store_y[row, 24] = kept
            if hears:
                y, Z, _, _, inverse = gain
                compute_observation(work[0], Z, store_KH[row, 1])
                for a in range(3):
                    store_y[row, 3 + a] = inverse[a, 0] * y[0] + inverse[a, 1] * y[1] + inverse[a, 2] * y[2]
                    for b in range(3):
                        store_y[row, 6 + 3 * a + b] = inverse[a, b]
        if hears:
            correct(x, P, work, gain, J)
            refused[k] = 0.0
            silent[k] = 0.0
            if keep:
                copy_values(work[1], store_KH[row, 0])
                for a in range(3):
                    for b in range(3):
                        store_y[row, 15 + 3 * a + b] = J[a, b]
        if keep and output[e] >= 0:
            copy_values(P, store_P[wanted])
            wanted += 1
        if output[e] >= 0:
            save_state(x, P, outputs[output[e]])
    repairs: float = work[8][0]
    return repairs
