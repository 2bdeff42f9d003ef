r"""Compiled error-state unscented filter and unscented Rauch-Tung-Striebel smoother.

The state lives on a manifold, its error in a vector space of 17 dimensions (Solà 2017, section 4; Hertzberg et al. 2013)::

    x  = (R, b_g, b_a, v, p, s_w, s_v)      R = enu_from_base_link in SO(3), v and p in ENU, biases in base_link axes
    dx = (th, db_g, db_a, dv, dp, ds_w, ds_v)
    x ⊞ dx = (R exp(th), b_g + db_g, …)     y ⊟ x = (log(Rx' Ry), …)

Process, over an interval dt with the mean angular velocity w and specific force a of the IMU::

    R⁺ = R exp((w - b_g) dt)    v⁺ = v + (R exp((w - b_g) dt/2) (a - b_a) - g e_z) dt    p⁺ = p + v dt + ½ (v⁺ - v) dt

Without a usable accelerometer the body velocity is kept instead (v⁺ = R⁺ R' v), without a gyroscope the turn rate of an odometry
takes its place; both with more noise. A log without any gyroscope has no b_g: the three hold the scale errors of that turn rate,
w (1 - b_g). The wheels' scale may decay towards one (slip comes and goes).

Sigma points x ⊞ ±√n L_i with α = 1, κ = 0, β = 2, so that the centre has weight 0 in the mean and 2 in the covariance and no weight is
negative (Wan & van der Merwe 2000). Errors of columns that do not touch R or b_g move linearly; their sigma points are summed in closed
form, which is the same number. Every update draws fresh sigma points.

Smoother: the unscented Rauch-Tung-Striebel smoother (Särkkä 2008) in the form of Bryson and Frazier (Bierman 1973), which inverts no
covariance and smooths only where an estimate is wanted. The sigma points of a prediction and of an update are, to second moments, those
of the linear maps F = C' P⁻¹ with C = cov(dx_k, dx_{k+1}⁻), and H = (P⁻⁻¹ cov(dx⁻, z))'. With K, S and the innovation y of each update,
and J, which carries errors over to the axes that the update has turned (`_reset`), back in time::

    l ← J' l, L ← J' L J    l ← (I - K H)' l - H' S⁻¹ y,  L ← (I - K H)' L (I - K H) + H' S⁻¹ H    l ← F' l, L ← F' L F
    x^s = x ⊞ (-P l)    P^s = P - P L P    cov(dx_j, dx_k) = P_j (product of all J (I - K H) F from j to k)' (I - L_k P_k),  j < k

Layout: ``x`` is flat, length 23: R row-major 0:9, b_g 9:12, b_a 12:15, v 15:18, p 18:21, s_w 21, s_v 22. ``dx``: th 0:3, b_g 3:6, b_a 6:9,
v 9:12, p 12:15, s_w 15, s_v 16. Cholesky factors are upper, P = U'U, so that their rows are sigma points and every inner loop
runs along memory.

References: E. A. Wan, R. van der Merwe, "The unscented Kalman filter for nonlinear estimation", AS-SPCC 2000; S. Särkkä, "Unscented
Rauch-Tung-Striebel smoother", IEEE TAC 53 (3), 2008; J. Solà, "Quaternion kinematics for the error-state Kalman filter",
arXiv 1711.02508, 2017; C. Hertzberg et al., "Integrating generic sensor fusion algorithms with sound state representations
through encapsulation of manifolds", Information Fusion 14 (1), 2013; G. J. Bierman, "Fixed interval smoothing with discrete measurements",
International Journal of Control 18 (1), 1973.
"""

from __future__ import annotations

from math import atan2, cos, sin, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import kernel

N = 17
NX = 23
FIXED = 1e-10
"""A scale of no more variance is held."""
SAVED = 33
GRAVITY_MPS2 = 9.80665
_WC0 = 2.0
_FORGOTTEN_S = 300.0
_ANEW = 0.1
OFF_M = 0.5
"""What fixes that contradict the rest may be off by, at least."""
_KNOWN_M = 0.1
_MEAN_OF, SURELY, _WILD = 10, 2.5, 4.0

PREDICT, GNSS_POSITION, WHEEL_VELOCITY, VISUAL_VELOCITY, STANDING, STANDING_RATE, SIDEWAYS, LEVEL = range(8)
"""Kinds of events. SIDEWAYS: y and z of the body velocity are about zero; LEVEL: roll and pitch are small."""

FLAT_TURN, VISUAL_TURN, GYRO_TURN, INERTIAL = range(4)
"""Process modes: what tells how the robot turns. All but INERTIAL keep the body velocity."""

_MOVED = (0, 1, 2, 9, 10, 11, 12, 13, 14)
"""Errors that others move into: th, v, p. All others stay what they are, but s_w, which may decay."""

SLIDING, DECAY, TURNING, SCALED, GROUND = 9, *range(N, N + 4)
"""Places in a row of process noise beside the densities, see `predict`."""

NOT_A_MEASUREMENT, ACCEPTED, REFUSED, REOPENED = range(4)
"""Verdicts of the gate."""

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@kernel
def _exp(x: float, y: float, z: float, out: Vector) -> None:
    """Rotation matrix (flat) of a rotation vector. Solà eq. 77."""
    t2 = x * x + y * y + z * z
    if t2 < 1e-8:
        a = 1.0 - t2 / 6.0
        b = 0.5 - t2 / 24.0
    else:
        t = sqrt(t2)
        a = sin(t) / t
        b = (1.0 - cos(t)) / t2
    out[0] = 1.0 - b * (y * y + z * z)
    out[4] = 1.0 - b * (x * x + z * z)
    out[8] = 1.0 - b * (x * x + y * y)
    out[1] = b * x * y - a * z
    out[3] = b * x * y + a * z
    out[2] = b * x * z + a * y
    out[6] = b * x * z - a * y
    out[5] = b * y * z - a * x
    out[7] = b * y * z + a * x


@kernel
def _difference(y: Vector, x: Vector, out: Vector) -> None:
    """Error y ⊟ x."""
    a = 0.0
    b = 0.0
    c = 0.0
    trace = -1.0
    for k in range(3):  # antisymmetric part and trace of Rx' Ry
        x0 = x[3 * k]
        x1 = x[3 * k + 1]
        x2 = x[3 * k + 2]
        y0 = y[3 * k]
        y1 = y[3 * k + 1]
        y2 = y[3 * k + 2]
        a += x2 * y1 - x1 * y2
        b += x0 * y2 - x2 * y0
        c += x1 * y0 - x0 * y1
        trace += x0 * y0 + x1 * y1 + x2 * y2
    sine2 = 0.25 * (a * a + b * b + c * c)
    if sine2 < 1e-8 and trace > 0.0:
        f = 0.5 * (1.0 + sine2 / 6.0)
    else:
        sine = max(sqrt(sine2), 1e-12)
        f = 0.5 * atan2(sine, 0.5 * trace) / sine
    out[0] = f * a
    out[1] = f * b
    out[2] = f * c
    for i in range(3, out.size):
        out[i] = y[i + 6] - x[i + 6]


@kernel
def _displaced(x: Vector, d: Vector, sign: float, rotate: bool, out: Vector, turn: Vector) -> None:  # noqa: FBT001
    """State x ⊞ sign d; ``rotate`` is False where d has no rotation."""
    if rotate:
        _exp(sign * d[0], sign * d[1], sign * d[2], turn)
        for i in range(0, 9, 3):
            for j in range(3):
                out[i + j] = x[i] * turn[j] + x[i + 1] * turn[3 + j] + x[i + 2] * turn[6 + j]
    else:
        for i in range(9):
            out[i] = x[i]
    for i in range(3, d.size):
        out[i + 6] = x[i + 6] + sign * d[i]


@kernel
def _propagated(x: Vector, w: Vector, a: Vector, dt: float, mode: int, q: Vector, out: Vector, turn: Vector) -> None:
    """State after dt; see the module's equations. q as in `predict`."""
    h = 0.5 * dt
    if mode >= GYRO_TURN:
        _exp(h * (w[0] - x[9]), h * (w[1] - x[10]), h * (w[2] - x[11]), turn)
    else:
        s = q[SCALED]
        _exp(h * w[0] * (1.0 - s * x[9]), h * w[1] * (1.0 - s * x[10]), h * w[2] * (1.0 - s * x[11]), turn)
    f0 = a[0] - x[12]
    f1 = a[1] - x[13]
    f2 = a[2] - x[14]
    vx = x[15]
    vy = x[16]
    vz = x[17]
    for i in range(3):  # velocity in the body, for the modes that keep it
        out[15 + i] = x[i] * vx + x[3 + i] * vy + x[6 + i] * vz
    u0 = out[15]
    u1 = out[16]
    u2 = out[17]
    for i in range(0, 9, 3):
        m0 = x[i] * turn[0] + x[i + 1] * turn[3] + x[i + 2] * turn[6]
        m1 = x[i] * turn[1] + x[i + 1] * turn[4] + x[i + 2] * turn[7]
        m2 = x[i] * turn[2] + x[i + 1] * turn[5] + x[i + 2] * turn[8]
        out[i] = m0 * turn[0] + m1 * turn[3] + m2 * turn[6]
        out[i + 1] = m0 * turn[1] + m1 * turn[4] + m2 * turn[7]
        out[i + 2] = m0 * turn[2] + m1 * turn[5] + m2 * turn[8]
        k = i // 3
        if mode == INERTIAL:
            gain = dt * (m0 * f0 + m1 * f1 + m2 * f2)
            if k == 2:
                gain -= dt * GRAVITY_MPS2
            out[15 + k] = x[15 + k] + gain
        else:
            out[15 + k] = out[i] * u0 + out[i + 1] * u1 + out[i + 2] * u2
        out[18 + k] = x[18 + k] + h * (x[15 + k] + out[15 + k])
    for i in range(9, 15):
        out[i] = x[i]
    out[21] = x[21] * (1.0 - dt * q[DECAY])
    for i in range(22, x.size):
        out[i] = x[i]


@kernel
def _cholesky(P: Matrix, U: Matrix) -> bool:
    """Upper factor of P = U'U; False where P is not positive definite."""
    n = P.shape[0]
    for i in range(n):
        for j in range(i, n):
            U[i, j] = P[i, j]
    for k in range(n):
        pivot = U[k, k]
        if not pivot > 0.0:
            return False
        scale = 1.0 / sqrt(pivot)
        for j in range(k, n):
            U[k, j] *= scale
        for i in range(k + 1, n):
            f = U[k, i]
            for j in range(i, n):
                U[i, j] -= f * U[k, j]
    return True


@kernel
def _factor(P: Matrix, U: Matrix, tally: Vector) -> None:
    """`_cholesky`, with P lifted a little where rounding has spoiled it; how often is counted."""
    lift = 1e-12
    while not _cholesky(P, U):
        tally[0] += 1.0
        for i in range(P.shape[0]):
            P[i, i] += lift * abs(P[i, i]) + 1e-3 * lift
        lift *= 10.0
        if lift > 1.0:  # beyond repair, or not a number: forget what is correlated
            for i in range(P.shape[0]):
                variance = P[i, i] if P[i, i] > 1e-6 and P[i, i] < 1e12 else 1e-6
                for j in range(P.shape[0]):
                    P[i, j] = 0.0
                    P[j, i] = 0.0
                P[i, i] = variance


@kernel
def _stray(P: Matrix, x: Vector, centre: Vector, q: Vector, q_v: float, dt: float, w: Vector, mode: int) -> None:
    """Add the noise of attitude and velocity over dt to P; see `predict`. A velocity that is kept in the body turns with its noise."""
    speed = sqrt(x[15] * x[15] + x[16] * x[16] + x[17] * x[17])
    for k in range(3):
        turned = dt * (q[k] + q[TURNING] * w[k] * w[k] + (q[GROUND] * speed if k < 2 else 0.0))
        P[k, k] += turned
        P[9 + k, 9 + k] += q_v * dt
        if mode == INERTIAL:
            continue
        b = (k + 1) % 3
        c = (k + 2) % 3
        ub = x[b] * x[15] + x[3 + b] * x[16] + x[6 + b] * x[17]
        uc = x[c] * x[15] + x[3 + c] * x[16] + x[6 + c] * x[17]
        more = 0.0  # of the noise along body axis k beyond ``q_v``
        if k > 0:
            more = dt * (q[9 + k] + (q[SLIDING] - 1.0) * q_v)
        for i in range(3):
            vi = centre[3 * i + c] * ub - centre[3 * i + b] * uc  # R⁺ (e_k x u)
            P[k, 9 + i] += turned * vi
            P[9 + i, k] += turned * vi
            for j in range(3):
                vj = centre[3 * j + c] * ub - centre[3 * j + b] * uc
                P[9 + i, 9 + j] += turned * vi * vj + more * centre[3 * i + k] * centre[3 * j + k]


@kernel
def predict(
    x: Vector, P: Matrix, q: Vector, q_v: float, dt: float, w: Vector, a: Vector, mode: int, F: Matrix, work: Any
) -> None:
    """Advance x and P by dt.

    q holds 17 noise densities [unit²/s], of which that of v is left out: it is ``q_v`` in all directions, or where the body velocity is
    kept ``q_v`` forward, and sideways and upward what stands there and SLIDING times ``q_v``. Then come the rate at which
    s_w decays (DECAY), how much the noise of the turn grows with its square (TURNING), whether b_g are scale errors (SCALED, 0 or 1),
    and by how much roll and pitch stray on a metre of ground [rad²/m] (GROUND).
    F, shape (12, 9), becomes what the first 12 errors turn into of those in `_MOVED`; a F of no rows is left alone.
    """
    U, D, d, moved, middle, shifted, centre, turn, tally = work
    n = P.shape[0]
    gamma, wi = sqrt(n), 0.5 / n
    _factor(P, U, tally)
    _propagated(x, w, a, dt, mode, q, centre, turn)
    for i in range(0, 9, 3):  # R exp(half the turn)
        for j in range(3):
            middle[i + j] = x[i] * turn[j] + x[i + 1] * turn[3 + j] + x[i + 2] * turn[6 + j]
    mean = D[2]
    for j in range(n):
        mean[j] = 0.0
        for i in range(n):
            P[i, j] = 0.0
    h = 0.5 * dt
    for i in range(n):
        for j in range(n):
            d[j] = gamma * U[i, j] if j >= i else 0.0
        if i < 6:  # touches R or b_g
            for side in range(2):
                _displaced(x, d, 1.0 - 2.0 * side, i < 3, shifted, turn)
                _propagated(shifted, w, a, dt, mode, q, moved, turn)
                _difference(moved, centre, D[side])
            for j in range(n):
                mean[j] += wi * (D[0, j] + D[1, j])
            for r in range(n):
                e = wi * D[0, r]
                g = wi * D[1, r]
                for j in range(n):
                    P[r, j] += e * D[0, j] + g * D[1, j]
            if F.shape[0] > 0:
                for c in range(9):
                    F[i, c] = 0.5 / gamma * (D[0, _MOVED[c]] - D[1, _MOVED[c]])
        else:
            for j in range(n):
                D[0, j] = d[j]
            if mode == INERTIAL:
                for k in range(3):
                    gain = 0.0
                    for j in range(3):
                        gain += middle[3 * k + j] * d[6 + j]
                    D[0, 9 + k] = d[9 + k] - dt * gain
            else:
                for k in range(3):  # R⁺ R' dv
                    gain = 0.0
                    for j in range(3):
                        body = x[j] * d[9] + x[3 + j] * d[10] + x[6 + j] * d[11]
                        gain += centre[3 * k + j] * body
                    D[0, 9 + k] = gain
            for k in range(3):
                D[0, 12 + k] = d[12 + k] + h * (d[9 + k] + D[0, 9 + k])
            D[0, 15] = d[15] * (1.0 - dt * q[DECAY])
            for r in range(6, n):
                e = 2.0 * wi * D[0, r]
                for j in range(n):
                    P[r, j] += e * D[0, j]
    for i in range(n):
        for j in range(n):
            P[i, j] += (_WC0 - 1.0) * mean[i] * mean[j]
        if i >= 3 and not 9 <= i < 12 and i < N:
            P[i, i] += q[i] * dt
    _stray(P, x, centre, q, q_v, dt, w, mode)
    if F.shape[0] > 0:
        _transition(x, middle, centre, dt, mode, U, F)
    _displaced(centre, mean, 1.0, True, x, turn)


@kernel
def _transition(x: Vector, middle: Vector, centre: Vector, dt: float, mode: int, U: Matrix, F: Matrix) -> None:
    """Complete F' = P⁻¹ C = U⁻¹ M, of which rows 0 to 5 hold M; what b_a, v and p become is linear and known."""
    h = 0.5 * dt
    for m in range(3):
        for k in range(3):
            own = 1.0 if m == k else 0.0
            force = -dt * middle[3 * k + m] if mode == INERTIAL else 0.0
            kept = own
            if mode != INERTIAL:
                kept = 0.0
                for j in range(3):
                    kept += centre[3 * k + j] * x[3 * m + j]
            F[6 + m, k] = 0.0
            F[6 + m, 3 + k] = force
            F[6 + m, 6 + k] = h * force
            F[9 + m, k] = 0.0
            F[9 + m, 3 + k] = kept
            F[9 + m, 6 + k] = h * (own + kept)
    for i in range(5, -1, -1):
        for r in range(i + 1, 12):
            f = U[i, r]
            for c in range(9):
                F[i, c] -= f * F[r, c]
        for k in range(3):
            F[i, 6 + k] -= U[i, 12 + k]
        f = 1.0 / U[i, i]
        for c in range(9):
            F[i, c] *= f


@kernel
def _observation(U: Matrix, Z: Matrix, H: Matrix) -> None:
    """Fill H, shape (3, n): H' = P⁻⁻¹ cov(dx⁻, z) = U⁻¹ M, by the sigma points of `_innovation`."""
    n = U.shape[0]
    for a in range(3):
        for i in range(n - 1, -1, -1):
            s = 0.5 / sqrt(n) * (Z[i, a] - Z[i + n, a])
            for j in range(i + 1, n):
                s -= U[i, j] * H[a, j]
            H[a, i] = s / U[i, i]


@kernel
def _expected(kind: int, x: Vector, w: Vector, lever: Vector, bias: float, out: Vector) -> None:
    """Measurement h(x) of an event; w: angular velocity now, of which ``bias`` times b_g is taken off; -1 where b_g are scale errors."""
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
        w0 = w[0] - x[9] * (bias if bias >= 0.0 else w[0])
        w1 = w[1] - x[10] * (bias if bias >= 0.0 else w[1])
        w2 = w[2] - x[11] * (bias if bias >= 0.0 else w[2])
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
        else:
            out[0] = v1
            out[1] = v2


@kernel
def _innovation(
    kind: int, x: Vector, P: Matrix, z: Vector, r: Vector, w: Vector, lever: Vector, bias: float, work: Any, gain: Any
) -> float:
    """Fill innovation, cross covariance and the inverse innovation covariance; return the squared normalised innovation.

    Of a wheel event only the wheels' own velocity counts, not the constraint that comes with it.
    """
    U, _, d, _, _, shifted, _, turn, tally = work
    y, Z, S, cross, inverse = gain
    n = P.shape[0]
    gamma, wi = sqrt(n), 0.5 / n
    _factor(P, U, tally)
    _expected(kind, x, w, lever, bias, y)
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
            _displaced(x, d, 1.0 - 2.0 * side, i < 3, shifted, turn)
            _expected(kind, shifted, w, lever, bias, Z[i + side * n])
        for a in range(3):
            y[a] += wi * (Z[i, a] + Z[i + n, a])
            e = wi * (Z[i, a] - Z[i + n, a])
            for j in range(n):
                cross[a, j] += e * d[j]
    centre = (centre0 - y[0], centre1 - y[1], centre2 - y[2])
    for a in range(3):
        for b in range(3):
            s = _WC0 * centre[a] * centre[b]
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


@kernel
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


@kernel
def _correct(x: Vector, P: Matrix, work: Any, gain: Any, J: Matrix) -> None:
    """X ⊞ K y and J (P - K S K') J' with what `_innovation` left; K' stays in the first rows of the work's second array."""
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
    _displaced(x, d, 1.0, True, shifted, turn)
    for i in range(x.size):
        x[i] = shifted[i]


@kernel
def _lifted(kind: int, P: Matrix, y: Vector, alone: bool) -> None:  # noqa: FBT001
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


@kernel
def _renewed(x: Vector, P: Matrix, variance: Vector) -> None:
    """Forget the fixes' error: another one has taken its place."""
    for i in range(N, P.shape[0]):
        x[6 + i] = 0.0
        for j in range(P.shape[0]):
            P[i, j] = 0.0
            P[j, i] = 0.0
    for i in range(N, P.shape[0]):
        P[i, i] = variance[i - N]


@kernel
def _drifts(y: Vector, S: Matrix, gate: float, opened: Vector) -> bool:
    """Whether innovations lie on one side on average, each of them within the gate as it may be; the mean follows in ``opened[3:]``."""
    size = 0.0
    for a in range(3):
        normal = min(max(y[a] / sqrt(S[a, a]), -_WILD), _WILD)
        opened[3 + a] += (normal - opened[3 + a]) / _MEAN_OF
        size += opened[3 + a] * opened[3 + a]
    return (2 * _MEAN_OF - 1) * size > SURELY * gate


@kernel
def _is_gone(x: Vector, P: Matrix) -> bool:
    """Whether the fixes' error is known well enough to say that it is none."""
    gone = True
    for i in range(N, N + 2):
        gone = gone and P[i, i] < _KNOWN_M**2 and x[6 + i] * x[6 + i] < P[i, i]
    return gone


@kernel
def most_drift(normal: Matrix) -> float:
    """Return the largest that `_drifts` would see in normalised innovations, shape (F, 3)."""
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


@kernel
def _faded(x: Vector, P: Matrix, kept: float, noise: Vector, opened: Vector, dt: float) -> None:
    """Let the fixes' error fade: ``kept`` of it remains, ``noise`` is added; where a gate has reopened it may stay as large as that."""
    for i in range(N, P.shape[0]):
        x[6 + i] *= kept
        for j in range(P.shape[0]):
            P[i, j] *= kept
            P[j, i] *= kept
        opened[i - N] *= 1.0 - min(dt / _FORGOTTEN_S, 1.0) if kept > _ANEW else 0.0
        P[i, i] += noise[i - N] + opened[i - N] * max(1.0 - kept * kept, 0.0)


@kernel
def _saved(x: Vector, P: Matrix, out: Vector) -> None:
    """State, then variances of p (3), yaw and forward velocity, then of s_w and s_v, then the fixes' error, shape (33,).

    Where ``out`` is longer by 81, the covariance of (th, v, p) follows.
    """
    for i in range(NX):
        out[i] = x[i]
    for i in range(3):
        out[23 + i] = P[12 + i, 12 + i]
    level2 = max(x[0] * x[0] + x[3] * x[3], 1e-6)
    # Yaw = atan2(R10, R00): d yaw = (R21 th_y + R22 th_z) / (R00² + R10²).
    jy = x[7] / level2
    jz = x[8] / level2
    out[26] = jy * jy * P[1, 1] + 2.0 * jy * jz * P[1, 2] + jz * jz * P[2, 2]
    # Forward velocity u = e_x' R' v: du = e_x' R' dv + u_y th_z - u_z th_y.
    uy = x[1] * x[15] + x[4] * x[16] + x[7] * x[17]
    uz = x[2] * x[15] + x[5] * x[16] + x[8] * x[17]
    index = (1, 2, 9, 10, 11)
    slope = (-uz, uy, x[0], x[3], x[6])
    s = 0.0
    for i in range(5):
        for j in range(5):
            s += slope[i] * slope[j] * P[index[i], index[j]]
    out[27] = s
    out[28] = P[15, 15]
    out[29] = P[16, 16]
    for i in range(3):
        out[30 + i] = x[NX + i] if x.size > NX else 0.0
    if out.size == SAVED + 81:
        for i in range(9):
            for j in range(9):
                out[SAVED + 9 * i + j] = P[i if i < 3 else i + 6, j if j < 3 else j + 6]


@kernel
def workspace(n: int) -> Any:
    """Scratch memory of the functions above for n errors; the last entry counts repairs of P."""
    work = (
        np.zeros((n, n)),
        np.zeros((3, n)),
        np.zeros(n),
        np.zeros(n + 6),
        np.zeros(n + 6),
        np.zeros(n + 6),
        np.zeros(n + 6),
        np.zeros(9),
        np.zeros(1),
    )
    gain = (np.zeros(3), np.zeros((2 * n, 3)), np.zeros((3, 3)), np.zeros((3, n)), np.zeros((3, 3)))
    return work, gain


@kernel
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
    dt : [s], time since the event before. kind, mode : see above. q_v : noise of v since then, see `predict`.
    z, r : measurement and variances, shape (E, 3); unused entries are 0 and 1.
    turn_rate, force : mean angular velocity and specific force since the event before, shape (E, 3).
    turn_rate_now : angular velocity at the event, shape (E, 3).
    output : row of ``outputs`` that the event fills, or -1.
    levers : lever arm by kind, shape (8, 3). densities : process noise by mode, shape (4, 21), see `predict`.
    gates : threshold of the squared normalised innovation by kind; infinite where there is no gate.
    lock_out : by kind (8, 4): refusals in a row, and seconds since the last accepted one, after which the gate reopens; the seconds
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
    work, gain = workspace(P.shape[0])
    store_F, store_KH, store_y, store_P = store
    F = np.zeros((12 if keep else 0, 9))
    J = np.zeros((3, 3))
    wanted = 0
    for e in range(first, last):
        kept = kept_error[e]
        if P.shape[0] > N:
            _faded(x, P, kept, error_noise[e], opened, dt[e])
        if dt[e] > 0.0:
            predict(x, P, densities[mode[e]], q_v[e], dt[e], turn_rate[e], force[e], mode[e], F, work)
            for k in range(silent.size):
                silent[k] += dt[e]
        k = kind[e]
        hears = False
        if k != PREDICT:
            bias = 1.0 if mode[e] >= GYRO_TURN else -densities[mode[e], SCALED]
            if k == GNSS_POSITION and opened[0] > 0.0 and _is_gone(x, P):
                kept = 0.0
                opened[:] = 0.0
                _renewed(x, P, error_level[e])
            value = _innovation(k, x, P, z[e], r[e], turn_rate_now[e], levers[k], bias, work, gain)
            hears = True
            verdict[e] = ACCEPTED
            for a in range(3):
                innovation[e, a] = gain[0][a]
            off_for_long = False
            if k == GNSS_POSITION and lock_out[k, 3] > 0.0 and opened[0] == 0.0:
                off_for_long = _drifts(gain[0], gain[2], gates[k], opened)
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
                        _renewed(x, P, error_level[e])
                        again = _innovation(k, x, P, z[e], r[e], turn_rate_now[e], levers[k], bias, work, gain)
                        for a in range(3):
                            opened[a] = max(gain[0][a] ** 2, OFF_M**2) if again > SURELY * gates[k] else 0.0
                            opened[3 + a] = 0.0
                        if again > SURELY * gates[k]:
                            _renewed(x, P, np.maximum(opened[:3], error_level[e]))
                    else:
                        _lifted(k, P, gain[0], alone)
                    again = _innovation(k, x, P, z[e], r[e], turn_rate_now[e], levers[k], bias, work, gain)
                    softer = max(again / gates[k], 1.0)
                    for a in range(3):
                        gain[2][a, a] = r[e, a] * softer * softer
                    _innovation(k, x, P, z[e], np.diag(gain[2]).copy(), turn_rate_now[e], levers[k], bias, work, gain)
                    hears = True
                    verdict[e] = REOPENED
            nis[e] = value
        row = e - first
        if keep:
            store_F[row] = F
            store_y[row, 0] = 1.0 if dt[e] > 0.0 else 0.0
            store_y[row, 1] = 1.0 - dt[e] * densities[mode[e], DECAY]
            store_y[row, 2] = 1.0 if hears else 0.0
            store_y[row, 24] = kept
            if hears:
                y, Z, _, _, inverse = gain
                _observation(work[0], Z, store_KH[row, 1])
                for a in range(3):
                    store_y[row, 3 + a] = inverse[a, 0] * y[0] + inverse[a, 1] * y[1] + inverse[a, 2] * y[2]
                    for b in range(3):
                        store_y[row, 6 + 3 * a + b] = inverse[a, b]
        if hears:
            _correct(x, P, work, gain, J)
            refused[k] = 0.0
            silent[k] = 0.0
            if keep:
                store_KH[row, 0] = work[1]
                for a in range(3):
                    for b in range(3):
                        store_y[row, 15 + 3 * a + b] = J[a, b]
        if keep and output[e] >= 0:
            store_P[wanted] = P
            wanted += 1
        if output[e] >= 0:
            _saved(x, P, outputs[output[e]])
    repairs: float = work[8][0]
    return repairs


@kernel
def _transposed_times(F: Matrix, scale: float, A: Matrix, out: Matrix) -> None:
    """F' A; ``scale`` is what remains of s_w."""
    n = A.shape[0]
    for i in range(n):
        if 3 <= i < 9 or i >= 12:
            f = scale if i == 15 else 1.0
            for j in range(n):
                out[i, j] = f * A[i, j]
        else:
            for j in range(n):
                out[i, j] = 0.0
    for i in range(12):
        for c in range(9):
            f = F[i, c]
            row = A[_MOVED[c]]
            for j in range(n):
                out[i, j] += f * row[j]


@kernel
def _product(A: Matrix, B: Matrix, out: Matrix) -> None:
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            out[i, j] = 0.0
        for k in range(n):
            f = A[i, k]
            for j in range(n):
                out[i, j] += f * B[k, j]


@kernel
def _linked(j: int, xy: Vector, P: Matrix, Ps: Matrix, rest: Matrix, links: Any, variances: Matrix) -> None:
    """Fill row ``j`` of ``variances``: how far the displacement from wanted stamp j to later ones may be wrong, along its direction.

    ``P`` is the filter's covariance, ``Ps`` the smoother's, ``rest`` is I - L P. Products over longer lags are made of shorter ones.
    """
    _, chains, ends, places, recipe, lags, wanted = links
    n = P.shape[0]
    size = chains.shape[1]
    here = j % size
    for i in range(n):
        for b in range(2):
            ends[here, i, b] = rest[i, 12 + b]
    for b in range(2):
        places[here, b] = xy[b]
        for c in range(2):
            places[here, 2 + 2 * b + c] = Ps[12 + b, 12 + c]
    newest = variances.shape[0] - 1
    for node in range(1, lags.size):
        if j + lags[node] <= newest:
            between = (j + lags[recipe[node, 0]]) % size
            _product(chains[recipe[node, 0], here], chains[recipe[node, 1], between], chains[node, here])
    for column in range(wanted.size):
        node = wanted[column]
        if j + lags[node] > newest:
            continue
        there = (j + lags[node]) % size
        east = places[there, 0] - xy[0]
        north = places[there, 1] - xy[1]
        length = max(sqrt(east * east + north * north), 1e-12)
        u = (east / length, north / length)
        variance = 0.0
        for b in range(2):
            for c in range(2):
                variance += u[b] * u[c] * (places[here, 2 + 2 * b + c] + places[there, 2 + 2 * b + c])
        for i in range(n):
            before = u[0] * P[12, i] + u[1] * P[13, i]
            after = 0.0
            for m in range(n):
                after += chains[node, here, i, m] * (u[0] * ends[there, m, 0] + u[1] * ends[there, m, 1])
            variance -= 2.0 * before * after
        variances[j, column] = max(variance, 0.0)


@kernel
def smooth_block(
    first: int,
    last: int,
    output: NDArray[np.int64],
    store: Any,
    adjoint: Vector,
    information: Matrix,
    outputs: Matrix,
    links: Any,
    displacement_variances: Matrix,
) -> None:
    """Smooth events ``last - 1`` down to ``first``.

    Parameters
    ----------
    store : of these events, as `filter_block` kept it.
    adjoint, information : l (n,) and L (n, n) of the state before event ``last``; become those before ``first``.
    outputs : holds the filter's states at the wanted stamps; they become the smoothed ones.
    links : what `_linked` remembers of later wanted stamps, see `tcpipe.fusion.error_state`.
    displacement_variances : filled by `_linked`.
    """
    n = information.shape[0]
    work, _ = workspace(n)
    _, _, d, x, _, shifted, _, turn, _ = work
    store_F, store_KH, store_y, store_P = store
    T = np.zeros((n, n))
    Ps = np.zeros((n, n))
    B = np.zeros((3, n))
    chain = links[0]  # (product of F and I - K H from here to the next wanted stamp)'
    wanted = 0
    for e in range(first, last):
        wanted += 1 if output[e] >= 0 else 0
    for e in range(last - 1, first - 1, -1):
        row = e - first
        if output[e] >= 0:
            wanted -= 1
            P = store_P[wanted]
            out = outputs[output[e]]
            for i in range(NX):
                x[i] = out[i]
            for i in range(NX, x.size):
                x[i] = out[30 + i - NX]
            for i in range(n):
                d[i] = 0.0
                for j in range(n):
                    d[i] -= P[i, j] * adjoint[j]
            _displaced(x, d, 1.0, True, shifted, turn)
            _product(information, P, T)
            _product(P, T, Ps)
            for i in range(n):
                for j in range(n):
                    T[i, j] = (1.0 if i == j else 0.0) - T[i, j]
            for i in range(n):
                for j in range(i + 1):
                    s = 0.5 * (P[i, j] - Ps[i, j] + P[j, i] - Ps[j, i])
                    Ps[i, j] = s
                    Ps[j, i] = s
            _saved(shifted, Ps, out)
            links[1][0, output[e] % links[1].shape[1]] = chain
            for i in range(n):
                for j in range(n):
                    chain[i, j] = 1.0 if i == j else 0.0
            _linked(output[e], shifted[18:20], P, Ps, T, links, displacement_variances)
        if store_y[row, 2] > 0.0:
            _before_update(store_KH[row, 0], store_KH[row, 1], store_y[row], adjoint, information, chain, B)
        if store_y[row, 0] > 0.0:
            F = store_F[row]
            scale = store_y[row, 1]
            for i in range(n):
                d[i] = adjoint[i]
            for i in range(12):
                s = d[i] if 3 <= i < 9 else 0.0
                for c in range(9):
                    s += F[i, c] * d[_MOVED[c]]
                adjoint[i] = s
            adjoint[15] = scale * d[15]
            _transposed_times(F, scale, information, T)
            for i in range(n):
                for j in range(n):
                    Ps[i, j] = T[j, i]
            _transposed_times(F, scale, Ps, information)
            _transposed_times(F, scale, chain, T)
            chain[:, :] = T
        kept = store_y[row, 24]
        for i in range(N, n if kept != 1.0 else N):
            adjoint[i] *= kept
            for j in range(n):
                information[i, j] *= kept
                information[j, i] *= kept
                chain[i, j] *= kept


@kernel
def _before_update(
    K: Matrix, H: Matrix, y: Vector, adjoint: Vector, information: Matrix, chain: Matrix, B: Matrix
) -> None:
    """Take l, L and the chain back over an update; K holds K', y what `filter_block` kept."""
    t = np.empty(3)
    n = information.shape[0]
    for j in range(n):  # J' from the left
        for A in (information, chain):
            for i in range(3):
                t[i] = y[15 + i] * A[0, j] + y[18 + i] * A[1, j] + y[21 + i] * A[2, j]
            for i in range(3):
                A[i, j] = t[i]
    for j in range(n):  # J from the right
        for i in range(3):
            t[i] = y[15 + i] * information[j, 0] + y[18 + i] * information[j, 1] + y[21 + i] * information[j, 2]
        for i in range(3):
            information[j, i] = t[i]
    for i in range(3):
        t[i] = y[15 + i] * adjoint[0] + y[18 + i] * adjoint[1] + y[21 + i] * adjoint[2]
    for i in range(3):
        adjoint[i] = t[i]
    for a in range(3):
        s = y[3 + a]
        for i in range(n):
            s += K[a, i] * adjoint[i]
        B[a, 0] = s
    for i in range(n):
        adjoint[i] -= H[0, i] * B[0, 0] + H[1, i] * B[1, 0] + H[2, i] * B[2, 0]
    for a in range(3):  # K' chain
        for j in range(n):
            B[a, j] = 0.0
        for i in range(n):
            f = K[a, i]
            for j in range(n):
                B[a, j] += f * chain[i, j]
    for i in range(n):
        for j in range(n):
            chain[i, j] -= H[0, i] * B[0, j] + H[1, i] * B[1, j] + H[2, i] * B[2, j]
    for a in range(3):  # K' L
        for j in range(n):
            B[a, j] = 0.0
        for i in range(n):
            f = K[a, i]
            for j in range(n):
                B[a, j] += f * information[i, j]
    half = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            s = y[6 + 3 * a + b]
            for j in range(n):
                s += B[a, j] * K[b, j]
            half[a, b] = 0.5 * s
    for j in range(n):
        b0 = B[0, j] - half[0, 0] * H[0, j] - half[0, 1] * H[1, j] - half[0, 2] * H[2, j]
        b1 = B[1, j] - half[1, 0] * H[0, j] - half[1, 1] * H[1, j] - half[1, 2] * H[2, j]
        b2 = B[2, j] - half[2, 0] * H[0, j] - half[2, 1] * H[1, j] - half[2, 2] * H[2, j]
        B[0, j] = b0
        B[1, j] = b1
        B[2, j] = b2
    for i in range(n):
        for j in range(i + 1):
            s = H[0, i] * B[0, j] + H[1, i] * B[1, j] + H[2, i] * B[2, j]
            s += B[0, i] * H[0, j] + B[1, i] * H[1, j] + B[2, i] * H[2, j]
            information[i, j] -= s
            information[j, i] = information[i, j]
