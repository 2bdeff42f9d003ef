r"""Prediction of the error-state unscented filter; state and errors: `tcpipe.fusion.state_kernel`.

Process, over an interval dt with the mean angular velocity w and specific force a of the IMU::

    R⁺ = R exp((w - b_g) dt)    v⁺ = v + (R exp((w - b_g) dt/2) (a - b_a) - g e_z) dt    p⁺ = p + v dt + ½ (v⁺ - v) dt

Without a usable accelerometer the body velocity is kept instead (v⁺ = R⁺ R' v), without a gyroscope the turn rate of an odometry
takes its place; both with more noise. A log without any gyroscope has no b_g: the three hold the scale errors of that turn rate,
w (1 - b_g). The wheels' scale may decay towards one (slip comes and goes).
"""

from __future__ import annotations

from math import sqrt
from typing import Any

from tcpipe.compiled import compile_kernel
from tcpipe.fusion.state_kernel import (
    CENTRE_WEIGHT,
    DECAY,
    GRAVITY_MPS2,
    GROUND,
    GYRO_TURN,
    INERTIAL,
    MOVED,
    SCALED,
    SLIDING,
    TURNING,
    Matrix,
    N,
    Vector,
    compute_error,
    compute_rotation,
    displace_state,
    factorize_covariance,
)


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
