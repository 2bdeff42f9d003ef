"""Motion, measurements and their Jacobians on SE(3), written out in numpy and scipy: what the compiled kernels are compared with.

The robot is at X = (R, p), its velocity u in the axes of its IMU; errors: R = R̂ Exp(θ), p = p̂ + R̂ ρ, all others are added.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tcpipe.fusion import state
from tcpipe.fusion.state import Error, Kind, Mode

G = np.array([0.0, 0.0, 9.80665])
EYE = np.eye(3)


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def exp(v):
    return Rotation.from_rotvec(v).as_matrix()


def right_jacobian(v):
    """Exp(v + d) = Exp(v) Exp(J d), Solà 2017, eq. 143."""
    t = np.linalg.norm(v)
    if t < 1e-9:
        return EYE
    K = skew(v)
    return EYE - (1 - np.cos(t)) / t**2 * K + (t - np.sin(t)) / t**3 * K @ K


def part(x, place, count=3):
    return x[place + 6 : place + 6 + count]


def split(x):
    return x[:9].reshape(3, 3), x[9:12], part(x, Error.U)


def plus(x, d):
    R, p, _ = split(x)
    y = x.copy()
    y[:9], y[9:12] = (R @ exp(d[:3])).ravel(), p + R @ d[3:6]
    y[12:] += d[6:]
    return y


def minus(y, x):
    R, p, _ = split(x)
    turn = Rotation.from_matrix(R.T @ y[:9].reshape(3, 3)).as_rotvec()
    return np.concatenate((turn, R.T @ (y[9:12] - p), y[12:] - x[12:]))


@dataclass
class Tick:
    """Motion over a tick: how it is known, T, the turn D or the rotation vector r, velocity v and displacement s of the forces."""

    mode: int
    T: float
    turned: np.ndarray
    gained: np.ndarray


def correct_gyro(x, tick):
    """Return the rotation vector by which bias and scale turn a tick of the gyroscope, and that of a scale of 1, shapes (3,)."""
    turned = tick.turned.reshape(3, 3)
    small = 0.5 * np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
    return -tick.T * part(x, Error.GYRO_BIAS) - x[Error.TURN_SCALE + 6] * small, small


def move(x, tick):
    """Return the state after a tick."""
    T, (R, p, u) = tick.T, split(x)
    bg, ba, kappa = part(x, Error.GYRO_BIAS), part(x, Error.ACCELEROMETER_BIAS), x[Error.TURN_SCALE + 6]
    by_gyro = tick.mode >= Mode.GYRO_TURN
    D = tick.turned.reshape(3, 3) @ exp(correct_gyro(x, tick)[0]) if by_gyro else exp((1 - kappa) * tick.turned[:3])
    y = x.copy()
    if tick.mode == Mode.INERTIAL:
        v, s = tick.gained[:3] - 0.5 * T * np.cross(bg, tick.gained[:3]), tick.gained[3:]
        y[9:12] = p + R @ (u * T + s - 0.5 * T**2 * ba) - 0.5 * T**2 * G
        y[12:15] = D.T @ (u + v - T * ba - T * R.T @ G)
    else:
        y[9:12] = p + R @ (EYE + D) @ u * T / 2
    y[:9] = (R @ D).ravel()
    return y


def differentiate_motion(x, tick):
    """Return the Jacobian of the errors after a tick for those before, (45, 45)."""
    T, (R, _, u), F = tick.T, split(x), np.eye(state.N)
    th, rho, vel, bg, ba = (slice(k, k + 3) for k in range(0, 15, 3))
    b, a = part(x, Error.GYRO_BIAS), part(x, Error.ACCELEROMETER_BIAS)
    D = R.T @ move(x, tick)[:9].reshape(3, 3)
    # D = D̂ Exp(ψ)
    turn = np.zeros((3, state.N))
    if tick.mode >= Mode.GYRO_TURN:
        correction, small = correct_gyro(x, tick)
        turn[:, bg] = -T * right_jacobian(correction)
        turn[:, Error.TURN_SCALE] = -right_jacobian(correction) @ small
    else:
        turn[:, Error.TURN_SCALE] = -tick.turned[:3]
    F[th] = turn
    F[th, th] = D.T
    F[rho] = 0.0
    F[rho, rho] = D.T
    if tick.mode == Mode.INERTIAL:
        q = u * T + tick.gained[3:] - 0.5 * T**2 * a
        F[rho, th], F[rho, vel], F[rho, ba] = -D.T @ skew(q), T * D.T, -0.5 * T**2 * D.T
        w = u + tick.gained[:3] - 0.5 * T * np.cross(b, tick.gained[:3]) - T * a - T * R.T @ G
        F[vel] = skew(D.T @ w) @ turn
        F[vel, th] = -T * D.T @ skew(R.T @ G)
        F[vel, vel], F[vel, ba] = D.T, -T * D.T
        F[vel, bg] += 0.5 * T * D.T @ skew(tick.gained[:3])
    else:
        q = (EYE + D) @ u * T / 2
        F[rho] = -0.5 * T * skew(u) @ turn
        F[rho, th], F[rho, rho] = -D.T @ skew(q), D.T
        F[rho, vel] = 0.5 * T * (EYE + D.T)
    return F


@dataclass
class Look:
    """What surrounds a measurement: rate of the gyroscope or of odometry, acceleration, time after the tick, place of the sensor."""

    rate: np.ndarray
    has_gyro: bool
    acceleration: np.ndarray
    tau: float
    lever: np.ndarray


def compute_attitude(x, look):
    """Return the attitude that a pose shows, in three parts: frame and robot, its turn since the tick, mountings."""
    w = look.rate - (part(x, Error.GYRO_BIAS) if look.has_gyro else 0.0)
    turn = exp((look.tau - x[Error.FIX_LAG + 6]) * w)
    return (
        exp(part(x, Error.POSE_FRAME)) @ split(x)[0],
        turn,
        exp(part(x, Error.MOUNT)) @ exp(part(x, Error.POSE_MOUNT)),
    )


def expect(kind, x, look):
    """Return what a sensor measures; of an attitude the rotation from ``look.lever``."""
    R, p, u = split(x)
    m, w = part(x, Error.MOUNT), look.rate - (part(x, Error.GYRO_BIAS) if look.has_gyro else 0.0)
    if kind == Kind.ATTITUDE:
        frame, turn, mounted = compute_attitude(x, look)
        return Rotation.from_matrix(exp(look.lever).T @ frame @ turn @ mounted).as_rotvec()
    if kind in {Kind.DOPPLER, Kind.FIX}:
        arm, t = (EYE + skew(m)) @ part(x, Error.ARM), look.tau - x[Error.FIX_LAG + 6]
        if kind == Kind.DOPPLER:
            return R @ (u + t * look.acceleration + np.cross(w, arm))
        moved = arm + t * (u + np.cross(w, arm)) + 0.5 * t**2 * look.acceleration
        return p + R @ moved + part(x, Error.FIX_ERROR) + part(x, Error.FIX_OFFSET)
    lag = {Kind.WHEELS: x[Error.WHEEL_LAG + 6], Kind.VISUAL: x[Error.VISUAL_LAG + 6]}.get(kind, 0.0)
    w = (EYE - skew(m)) @ w
    v = (EYE - skew(m)) @ (u + (look.tau - lag) * look.acceleration) + np.cross(w, look.lever)
    shared = x[Error.SHARED_SCALE + 6]
    c = np.append(0.0, part(x, Error.VISUAL_MOUNT, 2))
    return {
        Kind.WHEELS: (1 + shared + x[Error.WHEEL_SCALE + 6] + x[Error.WHEEL_SLIP + 6]) * v[:1],
        Kind.VISUAL: (1 + shared + x[Error.VISUAL_SCALE + 6] + x[Error.VISUAL_SLIP + 6]) * (EYE - skew(c)) @ v,
        Kind.SIDEWAYS: np.array([v[1] + w[2] * x[Error.TURNING_CENTRE + 6], v[2]]),
        Kind.STATIONARY: u,
        Kind.STATIONARY_RATE: part(x, Error.GYRO_BIAS),
        Kind.LEVEL: R[2, :2],
    }[kind]


def differentiate_attitude(x, look):
    """Return the Jacobian of an attitude for the errors, (3, 45)."""
    H, (_, turn, mounted) = np.zeros((3, state.N)), compute_attitude(x, look)
    m, c, f = (part(x, place) for place in (Error.MOUNT, Error.POSE_MOUNT, Error.POSE_FRAME))
    t, w = look.tau - x[Error.FIX_LAG + 6], look.rate - (part(x, Error.GYRO_BIAS) if look.has_gyro else 0.0)
    late = mounted.T @ right_jacobian(t * w)
    H[:, :3], H[:, Error.FIX_LAG] = (turn @ mounted).T, -late @ w
    H[:, Error.GYRO_BIAS : Error.GYRO_BIAS + 3] = -t * float(look.has_gyro) * late
    H[:, Error.MOUNT : Error.MOUNT + 3] = exp(c).T @ right_jacobian(m)
    H[:, Error.POSE_MOUNT : Error.POSE_MOUNT + 3] = right_jacobian(c)
    H[:, Error.POSE_FRAME : Error.POSE_FRAME + 3] = (split(x)[0] @ turn @ mounted).T @ right_jacobian(f)
    return np.linalg.inv(right_jacobian(expect(Kind.ATTITUDE, x, look))) @ H


def differentiate_measurement(kind, x, look):
    """Return the Jacobian of a measurement for the errors, (size, 45)."""
    return differentiate_attitude(x, look) if kind == Kind.ATTITUDE else differentiate_other(kind, x, look)


def differentiate_other(kind, x, look):
    """Return the same of what is no attitude."""
    R, _, u = split(x)
    H = np.zeros((3, state.N))
    th, rho, vel, bg = (slice(k, k + 3) for k in (Error.THETA, Error.RHO, Error.U, Error.GYRO_BIAS))
    arms, mount = slice(Error.ARM, Error.ARM + 3), slice(Error.MOUNT, Error.MOUNT + 3)
    m, w = part(x, Error.MOUNT), look.rate - (part(x, Error.GYRO_BIAS) if look.has_gyro else 0.0)
    gyro = float(look.has_gyro)
    if kind in {Kind.DOPPLER, Kind.FIX}:
        stated, t = part(x, Error.ARM), look.tau - x[Error.FIX_LAG + 6]
        arm = (EYE + skew(m)) @ stated
        v = u + t * look.acceleration + np.cross(w, arm)
        if kind == Kind.DOPPLER:
            q, by_arm, by_u, by_t = v, skew(w), EYE, look.acceleration
        else:
            q, by_arm, by_u, by_t = arm + t * v - 0.5 * t**2 * look.acceleration, EYE + t * skew(w), t * EYE, v
        H[:, th], H[:, vel] = -R @ skew(q), R @ by_u
        H[:, bg] = gyro * R @ by_u @ skew(arm)
        H[:, arms], H[:, mount] = R @ by_arm @ (EYE + skew(m)), -R @ by_arm @ skew(stated)
        H[:, Error.FIX_LAG] = -R @ by_t
        if kind == Kind.FIX:
            H[:, rho] = R
            H[:, Error.FIX_ERROR : Error.FIX_ERROR + 3] = H[:, Error.FIX_OFFSET : Error.FIX_OFFSET + 3] = EYE
        return H
    if kind in {Kind.STATIONARY, Kind.STATIONARY_RATE}:
        H[:, vel if kind == Kind.STATIONARY else bg] = EYE
        return H
    if kind == Kind.LEVEL:  # the lowest row of R Exp(θ)
        H[:, th] = skew(R[2])
        return H[:2]
    place = {Kind.WHEELS: Error.WHEEL_LAG, Kind.VISUAL: Error.VISUAL_LAG}.get(kind)
    t = look.tau - (x[place + 6] if place else 0.0)
    at, turn = u + t * look.acceleration, EYE - skew(m)
    v = turn @ at + np.cross(turn @ w, look.lever)
    V = np.zeros((3, state.N))  # of v
    V[:, vel], V[:, bg] = turn, gyro * skew(look.lever) @ turn
    V[:, mount] = skew(at) - skew(look.lever) @ skew(w)
    if place:
        V[:, place] = -turn @ look.acceleration
    if kind == Kind.SIDEWAYS:
        H = V[1:].copy()
        centre = x[Error.TURNING_CENTRE + 6]
        H[0, Error.TURNING_CENTRE] = (turn @ w)[2]
        H[0, bg] -= gyro * centre * turn[2]
        H[0, mount] += centre * skew(w)[2]
        return H
    by_wheels = [Error.WHEEL_SCALE, Error.WHEEL_SLIP, Error.SHARED_SCALE]
    scales = by_wheels if kind == Kind.WHEELS else [Error.VISUAL_SCALE, Error.VISUAL_SLIP, Error.SHARED_SCALE]
    scale = 1 + sum(x[place + 6] for place in scales)
    look_axes = EYE if kind == Kind.WHEELS else EYE - skew(np.append(0.0, part(x, Error.VISUAL_MOUNT, 2)))
    H = scale * look_axes @ V
    H[:, scales] = (look_axes @ v)[:, None]
    if kind == Kind.WHEELS:
        return H[:1]
    H[:, Error.VISUAL_MOUNT : Error.VISUAL_MOUNT + 2] = scale * skew(v)[:, 1:]
    return H
