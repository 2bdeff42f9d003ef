"""The error-state unscented filter and smoother written out in plain numpy and scipy, for comparison with the kernel."""

import numpy as np
from scipy.spatial.transform import Rotation

from tcpipe.fusion import state_kernel as kernel

N = 17

RNG = np.random.default_rng(5)
X = np.concatenate((Rotation.from_euler("ZYX", [1.0, 0.2, -0.3]).as_matrix().ravel(), 0.1 * RNG.normal(size=14)))
ROOT = RNG.normal(size=(17, 17))
P = 0.01 * ROOT @ ROOT.T + 0.01 * np.eye(17)
RATE, FORCE, LEVER = np.array([0.3, -0.2, 0.8]), np.array([0.5, 0.3, 9.7]), np.array([0.3, 0.1, 0.5])


def plus(x, d):
    y = x.copy()
    y[:9] = (x[:9].reshape(3, 3) @ Rotation.from_rotvec(d[:3]).as_matrix()).ravel()
    y[9:] = x[9:] + d[3:]
    return y


def minus(y, x):
    turn = Rotation.from_matrix(x[:9].reshape(3, 3).T @ y[:9].reshape(3, 3)).as_rotvec()
    return np.concatenate((turn, y[9:] - x[9:]))


def move(x, w, a, dt, mode, q):  # noqa: PLR0917
    R, v = x[:9].reshape(3, 3), x[15:18]
    w = w - x[9:12] if mode >= kernel.GYRO_TURN else w * (1 - q[19] * x[9:12])
    half = Rotation.from_rotvec(w * dt / 2).as_matrix()
    later = R @ Rotation.from_rotvec(w * dt).as_matrix()
    fall = np.array([0, 0, kernel.GRAVITY_MPS2])
    faster = v + dt * (R @ half @ (a - x[12:15]) - fall) if mode == kernel.INERTIAL else later @ R.T @ v
    y = x.copy()
    y[:9], y[15:18], y[18:21] = later.ravel(), faster, x[18:21] + dt / 2 * (v + faster)
    y[21] *= 1 - dt * q[17]
    return y


def expect(kind, x, w, lever):
    R = x[:9].reshape(3, 3)
    body = R.T @ x[15:18] + np.cross(w - x[9:12], lever)
    return {
        kernel.GNSS_POSITION: x[18:21] + R @ lever + (x[23:26] if x.size > 23 else 0.0),
        kernel.WHEEL_VELOCITY: body * [1 + x[21], 1, 1],
        kernel.VISUAL_VELOCITY: body * (1 + x[22]),
        kernel.GNSS_VELOCITY: x[15:18] + R @ np.cross(w - x[9:12], lever),
        kernel.STANDING: x[15:18],
        kernel.STANDING_RATE: x[9:12],
        kernel.SIDEWAYS: np.array([body[1], body[2], 0]),
        kernel.LEVEL: np.array([R[2, 0], R[2, 1], 0]),
    }[kind]


def sigma(P):
    n = P.shape[0]
    root = np.sqrt(n) * np.linalg.cholesky(P)
    mean_weight = np.concatenate(([0.0], np.full(2 * n, 0.5 / n)))
    return np.vstack((np.zeros(n), root.T, -root.T)), mean_weight, np.concatenate(([2.0], mean_weight[1:]))


def predict(x, P, q, velocity_density, dt, w, a, mode):  # noqa: PLR0917
    """Return x⁻, P⁻ and the cross covariance."""
    d, wm, wc = sigma(P)
    centre = move(x, w, a, dt, mode, q)
    D = np.array([minus(move(plus(x, e), w, a, dt, mode, q), centre) for e in d])
    mean = wm @ D
    return (
        plus(centre, mean),
        (D - mean).T * wc @ (D - mean)
        + np.pad(stray(x, centre, q, velocity_density, w, mode) * dt, (0, P.shape[0] - N)),
        d.T * wc @ (D - mean),
    )


def stray(x, centre, q, velocity_density, w, mode):  # noqa: PLR0917
    """Return the noise density of the error."""
    inertial = mode == kernel.INERTIAL
    noise = np.diag(q[:N])
    noise[9:12, 9:12] = 0.0
    turned = q[:3] + q[18] * np.square(w) + q[20] * np.linalg.norm(x[15:18]) * np.array([1, 1, 0])
    later, body = centre[:9].reshape(3, 3), x[:9].reshape(3, 3).T @ x[15:18]
    spread = np.zeros((N, 6))
    spread[:3, :3] = np.eye(3)
    spread[9:12, 3:] = np.eye(3) if inertial else later
    if not inertial:  # what is kept in the body turns with it
        spread[9:12, :3] = later @ np.cross(np.eye(3), body).T
    noise[:3, :3] = 0.0
    slides = (
        [velocity_density] * 3
        if inertial
        else [velocity_density, q[10] + q[9] * velocity_density, q[11] + q[9] * velocity_density]
    )
    return noise + spread @ np.diag(np.concatenate((turned, slides))) @ spread.T


def update(kind, x, P, z, r, w, lever):  # noqa: PLR0917
    """Return x, P and the innovation's squared length."""
    d, wm, wc = sigma(P)
    Z = np.array([expect(kind, plus(x, e), w, lever) for e in d])
    mean = wm @ Z
    S = (Z - mean).T * wc @ (Z - mean) + np.diag(r)
    cross = d.T * wc @ (Z - mean)
    K = cross @ np.linalg.inv(S)
    y = z - mean
    J = reset(K @ y)
    return plus(x, K @ y), J @ (P - K @ S @ K.T) @ J.T, y @ np.linalg.inv(S) @ y


def reset(correction):
    """Return what an error becomes in the axes that a correction has turned: d log(exp(-t) exp(t + e)) / d e, by differences."""
    J, step = np.eye(correction.size), 1e-5
    centre = Rotation.from_rotvec(correction[:3])
    for k in range(3):
        ahead, behind = (Rotation.from_rotvec(correction[:3] + s * step * np.eye(3)[k]) for s in (1, -1))
        J[:3, k] = ((centre.inv() * ahead).as_rotvec() - (centre.inv() * behind).as_rotvec()) / (2 * step)
    return J


def filter_and_smooth(timeline, densities, levers, x, P, *, kept, noise):
    """Return filtered and smoothed states and covariances at every event of a timeline without refusals, and the smoother's gains.

    ``kept`` and ``noise`` are what remains of the fixes' error and what comes to it, where the state holds it.
    """
    before, after, resets = [], [], []
    for e in range(timeline.stamp_ns.size):
        C = P
        if timeline.dt_s[e] > 0:
            mode = timeline.mode[e]
            turn, force = timeline.turn_rate_radps[e], timeline.force_mps2[e]
            x, P, C = predict(x, P, densities[mode], timeline.shake_m2ps3[e], timeline.dt_s[e], turn, force, mode)
        fade = np.diag(np.where(np.arange(P.shape[0]) < N, 1.0, kept[e]))
        x = np.concatenate((x[:23], kept[e] * x[23:]))
        P, C = fade @ P @ fade + np.diag(np.pad(noise[e][: P.shape[0] - N], (N, 0))), C @ fade
        before.append((x, P, C))
        x_before = x
        kind = int(timeline.kind[e])
        if kind != kernel.PREDICT:
            now = timeline.turn_rate_now_radps[e]
            x, P, _ = update(kind, x, P, timeline.value[e], timeline.variance[e], now, levers[kind])
        after.append((x, P))
        resets.append(reset(minus(x, x_before)))
    smoothed, gains = [after[-1]], []
    for e in range(len(after) - 2, -1, -1):
        x_minus, P_minus, C = before[e + 1]
        G = C @ np.linalg.inv(P_minus)
        x_s, P_s = smoothed[0]
        back = np.linalg.inv(resets[e + 1])  # into the axes before the update
        gains.insert(0, G @ back)
        P_s = back @ P_s @ back.T
        smoothed.insert(0, (plus(after[e][0], G @ minus(x_s, x_minus)), after[e][1] + G @ (P_s - P_minus) @ G.T))
    return after, smoothed, gains


def displacement_variance(smoothed, gains, first, last):
    """Return the variance of the horizontal displacement between two events, along it."""
    link = np.linalg.multi_dot([*gains[first:last], smoothed[last][1]])[12:14, 12:14]
    joint = smoothed[first][1][12:14, 12:14] + smoothed[last][1][12:14, 12:14] - link - link.T
    along = smoothed[last][0][18:20] - smoothed[first][0][18:20]
    return along @ joint @ along / (along @ along)
