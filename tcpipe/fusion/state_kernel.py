"""State, errors and factors of the error-state unscented filter, and the layout of its events and noise.

The state lives on a manifold, its error in a vector space of 17 dimensions (Solà 2017, section 4; Hertzberg et al. 2013)::

    x  = (R, b_g, b_a, v, p, s_w, s_v)      R = enu_from_base_link in SO(3), v and p in ENU, biases in base_link axes
    dx = (th, db_g, db_a, dv, dp, ds_w, ds_v)
    x ⊞ dx = (R exp(th), b_g + db_g, …)     y ⊟ x = (log(Rx' Ry), …)

Sigma points x ⊞ ±√n L_i with α = 1, κ = 0, β = 2, so that the centre has weight 0 in the mean and 2 in the covariance and no weight is
negative (Wan & van der Merwe 2000). Errors of columns that do not touch R or b_g move linearly; their sigma points are summed in closed
form, which is the same number. Every update draws fresh sigma points.

Layout: ``x`` is flat, length 23: R row-major 0:9, b_g 9:12, b_a 12:15, v 15:18, p 18:21, s_w 21, s_v 22. ``dx``: th 0:3, b_g 3:6, b_a 6:9,
v 9:12, p 12:15, s_w 15, s_v 16. Cholesky factors are upper, P = U'U, so that their rows are sigma points and every inner loop
runs along memory.

References: E. A. Wan, R. van der Merwe, "The unscented Kalman filter for nonlinear estimation", AS-SPCC 2000; J. Solà, "Quaternion
kinematics for the error-state Kalman filter", arXiv 1711.02508, 2017; C. Hertzberg et al., "Integrating generic sensor fusion algorithms
with sound state representations through encapsulation of manifolds", Information Fusion 14 (1), 2013.

Prediction: the process, over an interval dt with the mean angular velocity w and specific force a of the IMU::

    R⁺ = R exp((w - b_g) dt)    v⁺ = v + (R exp((w - b_g) dt/2) (a - b_a) - g e_z) dt    p⁺ = p + v dt + ½ (v⁺ - v) dt

Without a usable accelerometer the body velocity is kept instead (v⁺ = R⁺ R' v), without a gyroscope the turn rate of an odometry
takes its place; both with more noise. A log without any gyroscope has no b_g: the three hold the scale errors of that turn rate,
w (1 - b_g). The wheels' scale may decay towards one (slip comes and goes).
"""

from __future__ import annotations

from math import atan2, cos, sin, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel

N = 17
NX = 23
SAVED = 33
GRAVITY_MPS2 = 9.80665  # standard gravity (CGPM 1901)
CENTRE_WEIGHT = 2.0

KINDS = 9
PREDICT, GNSS_POSITION, WHEEL_VELOCITY, VISUAL_VELOCITY, STANDING, STANDING_RATE, SIDEWAYS, LEVEL, GNSS_VELOCITY = (
    range(KINDS)
)
"""Kinds of events. SIDEWAYS: y and z of the body velocity are about zero; LEVEL: roll and pitch are small."""

FLAT_TURN, VISUAL_TURN, GYRO_TURN, INERTIAL = range(4)
"""Process modes: the source of the turn rate. All but INERTIAL keep the body velocity."""

MOVED = (0, 1, 2, 9, 10, 11, 12, 13, 14)
"""Errors that others move into: th, v, p. All others stay what they are, but s_w, which may decay."""

SLIDING, DECAY, TURNING, SCALED, GROUND = 9, *range(N, N + 4)
"""Places in a row of process noise beside the densities, see `predict`."""

NOT_A_MEASUREMENT, ACCEPTED, REFUSED, REOPENED = range(4)
"""Verdicts of the gate."""

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@compile_kernel
def compute_rotation(x: float, y: float, z: float, out: Vector) -> None:
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


@compile_kernel
def compute_error(y: Vector, x: Vector, out: Vector) -> None:
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


@compile_kernel
def displace_state(x: Vector, d: Vector, sign: float, rotate: bool, out: Vector, turn: Vector) -> None:  # noqa: FBT001
    """State x ⊞ sign d; ``rotate`` is False where d has no rotation."""
    if rotate:
        compute_rotation(sign * d[0], sign * d[1], sign * d[2], turn)
        for i in range(0, 9, 3):
            for j in range(3):
                out[i + j] = x[i] * turn[j] + x[i + 1] * turn[3 + j] + x[i + 2] * turn[6 + j]
    else:
        for i in range(9):
            out[i] = x[i]
    for i in range(3, d.size):
        out[i + 6] = x[i + 6] + sign * d[i]


@compile_kernel
def _factorize(P: Matrix, U: Matrix) -> bool:
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


@compile_kernel
def factorize_covariance(P: Matrix, U: Matrix, tally: Vector) -> None:
    """`_factorize`, with P lifted a little where rounding has spoiled it; how often is counted."""
    lift = 1e-12
    while not _factorize(P, U):
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


@compile_kernel
def copy_values(values: Matrix, out: Matrix) -> None:
    """Fill ``out``; a slice that is assigned makes numba compile the words of an error for it, in seconds."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            out[i, j] = values[i, j]


@compile_kernel
def save_state(x: Vector, P: Matrix, out: Vector) -> None:
    """State, then variances of p (3), yaw and forward velocity, then of s_w and s_v, then the fixes' error, shape (33,)."""
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


@compile_kernel
def allocate_workspace(n: int) -> Any:
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


@compile_kernel
def _propagate_state(
    x: Vector, w: Vector, a: Vector, dt: float, mode: int, q: Vector, out: Vector, turn: Vector
) -> None:
    """State after dt; see the module's equations. q as in `predict`."""
    h = 0.5 * dt
    if mode >= GYRO_TURN:
        compute_rotation(h * (w[0] - x[9]), h * (w[1] - x[10]), h * (w[2] - x[11]), turn)
    else:
        s = q[SCALED]
        compute_rotation(h * w[0] * (1.0 - s * x[9]), h * w[1] * (1.0 - s * x[10]), h * w[2] * (1.0 - s * x[11]), turn)
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


@compile_kernel
def _add_stray_noise(
    P: Matrix, x: Vector, centre: Vector, q: Vector, q_v: float, dt: float, w: Vector, mode: int
) -> None:
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


@compile_kernel
def predict(
    x: Vector, P: Matrix, q: Vector, q_v: float, dt: float, w: Vector, a: Vector, mode: int, F: Matrix, work: Any
) -> None:
    """Advance x and P by dt.

    q holds 17 noise densities [unit²/s]; that of v is ``q_v`` in all directions, or where the body velocity is kept ``q_v`` forward, and
    sideways and upward its own and SLIDING times ``q_v``. Then come the rate at which s_w decays (DECAY), how much the noise of the turn
    grows with its square (TURNING), whether b_g are scale errors (SCALED, 0 or 1), and by how much roll and pitch stray on a metre of
    ground [rad²/m] (GROUND). F, shape (12, 9), becomes the part of the first 12 errors that depends on those in `MOVED`; a F of no rows is
    left alone.
    """
    U, D, d, moved, middle, shifted, centre, turn, tally = work
    n = P.shape[0]
    gamma, wi = sqrt(n), 0.5 / n
    factorize_covariance(P, U, tally)
    _propagate_state(x, w, a, dt, mode, q, centre, turn)
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
                displace_state(x, d, 1.0 - 2.0 * side, i < 3, shifted, turn)
                _propagate_state(shifted, w, a, dt, mode, q, moved, turn)
                compute_error(moved, centre, D[side])
            for j in range(n):
                mean[j] += wi * (D[0, j] + D[1, j])
            for r in range(n):
                e = wi * D[0, r]
                g = wi * D[1, r]
                for j in range(n):
                    P[r, j] += e * D[0, j] + g * D[1, j]
            if F.shape[0] > 0:
                for c in range(9):
                    F[i, c] = 0.5 / gamma * (D[0, MOVED[c]] - D[1, MOVED[c]])
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
            P[i, j] += (CENTRE_WEIGHT - 1.0) * mean[i] * mean[j]
        if i >= 3 and not 9 <= i < 12 and i < N:
            P[i, i] += q[i] * dt
    _add_stray_noise(P, x, centre, q, q_v, dt, w, mode)
    if F.shape[0] > 0:
        _complete_transition(x, middle, centre, dt, mode, U, F)
    displace_state(centre, mean, 1.0, True, x, turn)


@compile_kernel
def _complete_transition(x: Vector, middle: Vector, centre: Vector, dt: float, mode: int, U: Matrix, F: Matrix) -> None:
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
