"""Update of the error-state unscented filter by one measurement; every update draws fresh sigma points (`state_kernel`)."""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import Any

from tcpipe.compiled import compile_kernel
from tcpipe.fusion.state_kernel import (
    CENTRE_WEIGHT,
    GNSS_POSITION,
    GNSS_VELOCITY,
    LEVEL,
    NX,
    STANDING,
    STANDING_RATE,
    VISUAL_VELOCITY,
    WHEEL_VELOCITY,
    Matrix,
    Vector,
    displace_state,
    factorize_covariance,
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
