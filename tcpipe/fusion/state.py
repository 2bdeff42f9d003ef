"""State of the error-state filter: layout, errors on its manifold, motion over a tick, and measurement models.

The state is the pose ``X = (R, p)`` of the robot in ENU, its velocity ``u`` in body axes, the biases of gyroscope and
accelerometer, and the parameters of `tcpipe.fusion.parameters`. Its error ``d`` is a vector::

    R = R̂ Exp(θ)    p = p̂ + R̂ ρ    every other entry: its estimate plus its error

Motion over a tick of T seconds, with the preintegrated rotation D, velocity v and displacement s of the IMU (biases
subtracted)::

    R⁺ = R D    p⁺ = p + R (u T + s) + g T² / 2    u⁺ = D' (u + R' g T + v)

so an unknown tilt does not shorten the path, and a constant body velocity stays constant while the robot turns. Without
a usable accelerometer ``u`` is constant.

Layout: ``x`` is flat, R row by row in 0:9; entry e of the errors (e >= 3) is entry e + 6 of ``x``.

References: A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable observer", IEEE TAC 62 (4), 2017;
M. Brossard, A. Barrau, S. Bonnabel, "A code for unscented Kalman filtering on manifolds (UKF-M)", ICRA 2020; C. Forster
et al., "On-manifold preintegration for real-time visual-inertial odometry", IEEE T-RO 33 (1), 2017.
"""

from __future__ import annotations

from enum import IntEnum
from math import atan2, cos, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel

GRAVITY_MPS2 = 9.80665  # standard gravity (CGPM 1901)

N, MOVING, NX = 45, 15, 51
"""Numbers of errors, of errors that motion changes (those before `Error.ARM`; others decay), and of state entries."""


class Error(IntEnum):
    """First index of each block of errors; from ``ARM`` on see `tcpipe.fusion.parameters.PARAMETERS`."""

    THETA, RHO, U, GYRO_BIAS, ACCELEROMETER_BIAS = 0, 3, 6, 9, 12
    ARM, FIX_LAG, FIX_ERROR, FIX_OFFSET = 15, 18, 19, 22
    WHEEL_SCALE, VISUAL_SCALE, SHARED_SCALE, TURN_SCALE, TURNING_CENTRE = 25, 26, 27, 28, 29
    MOUNT, VISUAL_MOUNT, WHEEL_LAG, VISUAL_LAG, WHEEL_SLIP, VISUAL_SLIP = 30, 33, 35, 36, 37, 38
    POSE_MOUNT, POSE_FRAME = 39, 42


class Kind(IntEnum):
    """Kinds of measurements.

    SIDEWAYS: sideways and upward velocity of the turning centre are about zero. STATIONARY: the velocity is zero.
    STATIONARY_RATE: the gyroscope's rate is its bias. LEVEL: roll and pitch are small. ATTITUDE: attitude of a pose.
    """

    WHEELS, SIDEWAYS, VISUAL, STATIONARY, STATIONARY_RATE, LEVEL, DOPPLER, FIX, ATTITUDE = range(9)


KINDS = len(Kind)
SIZES = (1, 2, 3, 3, 3, 2, 3, 3, 3)  # number of components of each kind of measurement


class Mode(IntEnum):
    """Source of motion over a tick: turn rate of wheels or course, of a camera, of a gyroscope, or a complete IMU."""

    FLAT_TURN, VISUAL_TURN, GYRO_TURN, INERTIAL = range(4)


Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@compile_kernel
def make_rotation(a: float, b: float, c: float, out: Vector) -> None:
    """Fill ``out`` with the rotation matrix, row by row, of a rotation vector (Solà 2017, eq. 77)."""
    t2 = a * a + b * b + c * c
    if t2 < 1e-8:
        f, g = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0
    else:
        t = sqrt(t2)
        f, g = sin(t) / t, (1.0 - cos(t)) / t2
    out[0] = 1.0 - g * (b * b + c * c)
    out[1] = g * a * b - f * c
    out[2] = g * a * c + f * b
    out[3] = g * a * b + f * c
    out[4] = 1.0 - g * (a * a + c * c)
    out[5] = g * b * c - f * a
    out[6] = g * a * c - f * b
    out[7] = g * b * c + f * a
    out[8] = 1.0 - g * (a * a + b * b)


@compile_kernel
def multiply_rotations(left: Vector, right: Vector, out: Vector) -> None:
    """Fill the first 9 of ``out`` with the product of two rotation matrices."""
    for i in range(0, 9, 3):
        for j in range(3):
            out[i + j] = left[i] * right[j] + left[i + 1] * right[3 + j] + left[i + 2] * right[6 + j]


@compile_kernel
def displace_state(x: Vector, d: Vector, sign: float, out: Vector, turn: Vector) -> None:
    """Fill ``out`` with the state ``x`` displaced by ``sign * d``; ``turn`` is a work array of 9."""
    make_rotation(sign * d[0], sign * d[1], sign * d[2], turn)
    multiply_rotations(x, turn, out)
    for i in range(3):
        moved = x[3 * i] * d[Error.RHO] + x[3 * i + 1] * d[Error.RHO + 1] + x[3 * i + 2] * d[Error.RHO + 2]
        out[9 + i] = x[9 + i] + sign * moved
    for e in range(Error.U, N):
        out[e + 6] = x[e + 6] + sign * d[e]


@compile_kernel
def compute_rotation_error(y: Vector, x: Vector, out: Vector) -> None:
    """Fill ``out[:3]`` with the rotation vector from ``x`` to ``y``; both begin with a rotation matrix of 9 entries."""
    a = b = c = 0.0
    trace = -1.0
    for k in range(3):  # antisymmetric part and trace of Rx' Ry
        a += x[3 * k + 2] * y[3 * k + 1] - x[3 * k + 1] * y[3 * k + 2]
        b += x[3 * k] * y[3 * k + 2] - x[3 * k + 2] * y[3 * k]
        c += x[3 * k + 1] * y[3 * k] - x[3 * k] * y[3 * k + 1]
        trace += x[3 * k] * y[3 * k] + x[3 * k + 1] * y[3 * k + 1] + x[3 * k + 2] * y[3 * k + 2]
    sine2 = 0.25 * (a * a + b * b + c * c)
    if sine2 < 1e-8 and trace > 0.0:
        f = 0.5 * (1.0 + sine2 / 6.0)
    else:
        sine = max(sqrt(sine2), 1e-12)
        f = 0.5 * atan2(sine, 0.5 * trace) / sine
    out[0], out[1], out[2] = f * a, f * b, f * c


@compile_kernel
def compute_moving_error(y: Vector, x: Vector, out: Vector) -> None:
    """Fill the first `MOVING` of ``out`` with the error of ``y`` relative to ``x``."""
    compute_rotation_error(y, x, out)
    for j in range(3):
        out[Error.RHO + j] = x[j] * (y[9] - x[9]) + x[3 + j] * (y[10] - x[10]) + x[6 + j] * (y[11] - x[11])
    for e in range(Error.U, MOVING):
        out[e] = y[e + 6] - x[e + 6]


@compile_kernel
def move_state(x: Vector, mode: int, T: float, turned: Vector, gained: Vector, out: Vector, turn: Vector) -> None:
    """Fill ``out`` with the state after a tick of T seconds.

    ``turned``: rotation matrix over the tick by the gyroscope, or the rotation vector by an odometry; ``gained``:
    velocity and displacement by the accelerometer, shape (6,). Both contain the biases and the scale.
    """
    if mode >= Mode.GYRO_TURN:
        s = 0.5 * x[Error.TURN_SCALE + 6]  # half of the antisymmetric part is the rotation vector of a small turn
        c0 = T * x[Error.GYRO_BIAS + 6] + s * (turned[7] - turned[5])
        c1 = T * x[Error.GYRO_BIAS + 7] + s * (turned[2] - turned[6])
        c2 = T * x[Error.GYRO_BIAS + 8] + s * (turned[3] - turned[1])
        make_rotation(-c0, -c1, -c2, out)
        multiply_rotations(turned, out, turn)
    else:
        s = 1.0 - x[Error.TURN_SCALE + 6]
        make_rotation(s * turned[0], s * turned[1], s * turned[2], turn)
    u0, u1, u2 = x[Error.U + 6], x[Error.U + 7], x[Error.U + 8]
    s0, s1, s2 = u0 * T, u1 * T, u2 * T
    fall = 0.0
    if mode == Mode.INERTIAL:
        h = 0.5 * T
        a0, a1, a2 = x[Error.ACCELEROMETER_BIAS + 6], x[Error.ACCELEROMETER_BIAS + 7], x[Error.ACCELEROMETER_BIAS + 8]
        b0, b1, b2 = x[Error.GYRO_BIAS + 6], x[Error.GYRO_BIAS + 7], x[Error.GYRO_BIAS + 8]
        v0, v1, v2 = gained[0], gained[1], gained[2]
        s0 += gained[3] - h * T * a0
        s1 += gained[4] - h * T * a1
        s2 += gained[5] - h * T * a2
        # The forces were rotated with a rate that still contains its bias.
        v0, v1, v2 = v0 - h * (b1 * v2 - b2 * v1), v1 - h * (b2 * v0 - b0 * v2), v2 - h * (b0 * v1 - b1 * v0)
        u0 += v0 - T * (a0 + GRAVITY_MPS2 * x[6])
        u1 += v1 - T * (a1 + GRAVITY_MPS2 * x[7])
        u2 += v2 - T * (a2 + GRAVITY_MPS2 * x[8])
        fall = 0.5 * GRAVITY_MPS2 * T * T
        for j in range(3):
            out[Error.U + 6 + j] = turn[j] * u0 + turn[3 + j] * u1 + turn[6 + j] * u2
    else:  # constant body velocity: the path has half of the turn
        out[Error.U + 6], out[Error.U + 7], out[Error.U + 8] = u0, u1, u2
        m0 = s0 + turn[0] * s0 + turn[1] * s1 + turn[2] * s2
        m1 = s1 + turn[3] * s0 + turn[4] * s1 + turn[5] * s2
        m2 = s2 + turn[6] * s0 + turn[7] * s1 + turn[8] * s2
        s0, s1, s2 = 0.5 * m0, 0.5 * m1, 0.5 * m2
    for i in range(3):
        out[9 + i] = x[9 + i] + x[3 * i] * s0 + x[3 * i + 1] * s1 + x[3 * i + 2] * s2
    out[11] -= fall
    multiply_rotations(x, turn, out)
    for e in range(Error.GYRO_BIAS, N):
        out[e + 6] = x[e + 6]


@compile_kernel
def _predict_attitude(x: Vector, w0: float, w1: float, w2: float, t: float, measured: Vector, out: Vector) -> None:
    """Fill ``out`` with the rotation from a measured attitude to that of a state t seconds later at angular rate w."""
    one, other, turn = np.empty(9), np.empty(9), np.empty(9)
    make_rotation(t * w0, t * w1, t * w2, turn)
    multiply_rotations(x, turn, one)
    make_rotation(x[Error.MOUNT + 6], x[Error.MOUNT + 7], x[Error.MOUNT + 8], turn)
    multiply_rotations(one, turn, other)
    make_rotation(x[Error.POSE_MOUNT + 6], x[Error.POSE_MOUNT + 7], x[Error.POSE_MOUNT + 8], turn)
    multiply_rotations(other, turn, one)
    make_rotation(x[Error.POSE_FRAME + 6], x[Error.POSE_FRAME + 7], x[Error.POSE_FRAME + 8], turn)
    multiply_rotations(turn, one, other)
    make_rotation(measured[0], measured[1], measured[2], one)
    compute_rotation_error(other, one, out)


@compile_kernel
def predict_measurement(
    kind: int, x: Vector, rate: Vector, has_gyro: bool, acceleration: Vector, tau: float, lever: Vector, out: Vector
) -> None:  # fmt: skip
    """Fill ``out`` with the measurement of a state by a sensor.

    ``rate``: angular velocity at the tick, bias or scale not removed; ``acceleration``: time derivative of ``u``;
    ``tau``: time of the measurement after the tick [s]; ``lever``: lever arm of an odometry [m]. For a pose, ``lever``
    is its measured attitude as a rotation vector, and the prediction is the rotation from it.
    """
    if kind == Kind.STATIONARY:
        out[0], out[1], out[2] = x[Error.U + 6], x[Error.U + 7], x[Error.U + 8]
        return
    if kind == Kind.STATIONARY_RATE:
        out[0], out[1], out[2] = x[Error.GYRO_BIAS + 6], x[Error.GYRO_BIAS + 7], x[Error.GYRO_BIAS + 8]
        return
    if kind == Kind.LEVEL:
        out[0], out[1] = x[6], x[7]
        return
    m0, m1, m2 = x[Error.MOUNT + 6], x[Error.MOUNT + 7], x[Error.MOUNT + 8]
    if has_gyro:
        w0, w1, w2 = (
            rate[0] - x[Error.GYRO_BIAS + 6],
            rate[1] - x[Error.GYRO_BIAS + 7],
            rate[2] - x[Error.GYRO_BIAS + 8],
        )
    else:  # with a lever arm, the noise of the rate would act as a scale
        w0, w1, w2 = rate[0], rate[1], rate[2]
    if kind == Kind.ATTITUDE:
        _predict_attitude(x, w0, w1, w2, tau - x[Error.FIX_LAG + 6], lever, out)
        return
    if kind >= Kind.DOPPLER:  # lever arm in the axes of the IMU, which are the state's
        a0, a1, a2 = x[Error.ARM + 6], x[Error.ARM + 7], x[Error.ARM + 8]
        a0, a1, a2 = a0 + m1 * a2 - m2 * a1, a1 + m2 * a0 - m0 * a2, a2 + m0 * a1 - m1 * a0
        t = tau - x[Error.FIX_LAG + 6]
        v0 = x[Error.U + 6] + t * acceleration[0] + w1 * a2 - w2 * a1
        v1 = x[Error.U + 7] + t * acceleration[1] + w2 * a0 - w0 * a2
        v2 = x[Error.U + 8] + t * acceleration[2] + w0 * a1 - w1 * a0
        if kind == Kind.DOPPLER:
            for i in range(3):
                out[i] = x[3 * i] * v0 + x[3 * i + 1] * v1 + x[3 * i + 2] * v2
            return
        a0 += t * (v0 - 0.5 * t * acceleration[0])
        a1 += t * (v1 - 0.5 * t * acceleration[1])
        a2 += t * (v2 - 0.5 * t * acceleration[2])
        for i in range(3):
            out[i] = x[9 + i] + x[3 * i] * a0 + x[3 * i + 1] * a1 + x[3 * i + 2] * a2
            out[i] += x[Error.FIX_ERROR + 6 + i] + x[Error.FIX_OFFSET + 6 + i]
        return
    t = tau
    if kind == Kind.WHEELS:
        t -= x[Error.WHEEL_LAG + 6]
    elif kind == Kind.VISUAL:
        t -= x[Error.VISUAL_LAG + 6]
    u0, u1, u2 = (
        x[Error.U + 6] + t * acceleration[0],
        x[Error.U + 7] + t * acceleration[1],
        x[Error.U + 8] + t * acceleration[2],
    )
    # Rotate from the axes of the IMU to those of the robot.
    v0, v1, v2 = u0 - m1 * u2 + m2 * u1, u1 - m2 * u0 + m0 * u2, u2 - m0 * u1 + m1 * u0
    w0, w1, w2 = w0 - m1 * w2 + m2 * w1, w1 - m2 * w0 + m0 * w2, w2 - m0 * w1 + m1 * w0
    v0 += w1 * lever[2] - w2 * lever[1]
    v1 += w2 * lever[0] - w0 * lever[2]
    v2 += w0 * lever[1] - w1 * lever[0]
    if kind == Kind.SIDEWAYS:
        out[0], out[1] = v1 + w2 * x[Error.TURNING_CENTRE + 6], v2
    elif kind == Kind.WHEELS:
        out[0] = v0 * (1.0 + x[Error.WHEEL_SCALE + 6] + x[Error.WHEEL_SLIP + 6] + x[Error.SHARED_SCALE + 6])
    else:
        c1, c2 = x[Error.VISUAL_MOUNT + 6], x[Error.VISUAL_MOUNT + 7]
        s = 1.0 + x[Error.VISUAL_SCALE + 6] + x[Error.VISUAL_SLIP + 6] + x[Error.SHARED_SCALE + 6]
        out[0], out[1], out[2] = s * (v0 - c1 * v2 + c2 * v1), s * (v1 - c2 * v0), s * (v2 + c1 * v0)
