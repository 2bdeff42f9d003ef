"""A drive over analytic hills with its truth, and measurements of it with every fault on request: independent of tcpipe.simulation."""

import math
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from tcpipe.fusion.densities import fit_noise
from tcpipe.fusion.measurements import BodyVelocities, InertialMeasurements, Measurements, Positions
from tcpipe.fusion.pair_residuals import find_residuals

ZERO_NS = 1_700_000_000_000_000_000
DT = 0.0025
LEVER = (0.12, -0.08, 0.55)


def height(x, y):
    return 4.0 * np.sin(x / 18.0) + 3.0 * np.cos(y / 14.0) + 0.15 * np.sin(x / 2.1 + y / 3.3)


def _slope(x, y):
    small = 0.15 * np.cos(x / 2.1 + y / 3.3)
    return 4.0 / 18.0 * np.cos(x / 18.0) + small / 2.1, -3.0 / 14.0 * np.sin(y / 14.0) + small / 3.3


def _attitude(x, y, yaw):
    zx, zy = _slope(x, y)
    up = np.stack((-zx, -zy, np.ones_like(zx)), -1)
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    ahead = np.stack((np.cos(yaw), np.sin(yaw), zx * np.cos(yaw) + zy * np.sin(yaw)), -1)
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    return np.stack((ahead, np.cross(up, ahead), up), -1)


@dataclass
class Drive:
    """Truth on a 400 Hz grid: t [s], position [m], rotation enu_from_base_link, velocity, body rate, specific force."""

    t: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    rate: np.ndarray
    force: np.ndarray
    forward: np.ndarray
    slerp: Slerp = field(init=False)

    def __post_init__(self):
        self.slerp = Slerp(self.t, Rotation.from_matrix(self.rotation))

    def at(self, values, t):
        return np.stack([np.interp(t, self.t, values[:, k]) for k in range(values.shape[1])], -1)


@cache
def make_drive(seconds=180.0, *, start_yaw=0.7, stand_s=4.0, reverse_s=0.0, turns=1.0):
    t = np.arange(0, seconds, DT)
    n = t.size
    speed = np.where((t > stand_s) & (t < seconds - 3), 1.0, 0.0)
    for stop in np.arange(60, seconds - 20, 60):
        speed[(t > stop) & (t < stop + 5)] = 0.0
    speed[(t > stand_s) & (t < stand_s + reverse_s)] = -0.7
    yaw_rate = turns * (0.25 * np.sin(t / 7.0) + 0.15 * np.sin(t / 2.3)) * (np.abs(speed) > 0)
    spins = (t % 60 > 1.5) & (t % 60 < 3.5) & (t > 60)
    yaw_rate[spins & (speed == 0)] = 0.8 * turns
    window = np.hanning(int(0.8 / DT))
    window /= window.sum()
    speed, yaw_rate = (
        np.convolve(np.pad(s, window.size, mode="edge"), window, "same")[window.size : -window.size]
        for s in (speed, yaw_rate)
    )
    speed *= 1 - 0.15 * np.sin(t / 11.0) ** 2
    yaw = start_yaw + np.concatenate(([0], np.cumsum(0.5 * (yaw_rate[1:] + yaw_rate[:-1]) * DT)))
    xy = np.zeros((n, 2))
    middle = 0.5 * (yaw[:-1] + yaw[1:])  # midpoint rule
    way_m = (0.5 * (speed[:-1] + speed[1:]) * DT).tolist()
    x = y = 0.0
    for k, (east, north) in enumerate(np.column_stack((np.cos(middle), np.sin(middle))).tolist()):
        zx, zy = _slope(x, y)
        step = way_m[k] / math.hypot(1.0, zx * east + zy * north)
        x, y = xy[k + 1] = x + step * east, y + step * north
    position = np.column_stack((xy, height(*xy.T)))
    rotation = _attitude(*xy.T, yaw)
    velocity = np.gradient(position, DT, axis=0, edge_order=2)
    forward = np.einsum("ni,ni->n", rotation[:, :, 0], velocity)
    rate = np.zeros((n, 3))
    turn = Rotation.from_matrix(rotation)
    rate[1:-1] = (turn[:-2].inv() * turn[2:]).as_rotvec() / (2 * DT)
    acceleration = np.gradient(velocity, DT, axis=0)
    force = np.einsum("nji,nj->ni", rotation, acceleration + np.array([0, 0, 9.80665]))
    return Drive(t, position, rotation, velocity, rate, force, forward)


def ns(t):
    return ZERO_NS + np.rint(np.asarray(t) * 1e9).astype(np.int64)


def measure(
    drive,
    seed=0,
    *,
    gnss_std=0.015,
    gnss_hz=10.0,
    gnss_outliers=0.02,
    gnss_outages=(),
    gnss_kept_s=0.0,
    slip=0.12,
    visual_scale=1.02,
    imu_hz=200.0,
    wheels=True,
    visual=True,
    imu=True,
    gnss=True,
):
    """Return Measurements of a drive; every fault that the figures ask for is on by default."""
    rng = np.random.default_rng(seed)
    span = drive.t[-1]

    def stamps(hz):
        t = np.arange(rng.uniform(0, 1 / hz), span - DT, 1 / hz)
        return t + rng.uniform(-0.02, 0.02, t.size) / hz

    found = {}
    if gnss:
        t = stamps(gnss_hz)
        for a, b in gnss_outages:
            t = t[(t < a) | (t > b)]
        std = gnss_std * np.array([1, 1, 1.6])
        antenna = drive.at(drive.position, t) + drive.slerp(t).apply(LEVER) + rng.normal(size=(t.size, 3)) * std
        if gnss_kept_s:  # 0.3 of the variance lasts
            antenna += np.sqrt(0.3) * std * make_lasting_errors(t, gnss_kept_s, seed)
        wild = rng.random(t.size) < gnss_outliers
        antenna[wild] += rng.normal(size=(wild.sum(), 3)) * 1.5
        found["gnss"] = Positions(ns(t), antenna, np.tile(std**2, (t.size, 1)), LEVER)
    rate = drive.rate
    if wheels:
        t = stamps(50.0)
        s = 1 + slip * (0.5 + 0.5 * np.sin(t / 9.0)) * np.clip(np.sin(t / 23.0), 0, 1)
        v = np.interp(t, drive.t, drive.forward) * s
        v += rng.normal(size=t.size) * 0.03 * (np.abs(v) > 0.01)
        wild = rng.random(t.size) < 0.005
        v[wild] += rng.normal(size=wild.sum())
        nothing = np.full(t.size, np.nan)
        yaw_rate = 0.8 * np.interp(t, drive.t, rate[:, 2]) + rng.normal(size=t.size) * 0.02
        found["wheels"] = BodyVelocities(
            ns(t),
            np.column_stack((v, nothing, nothing)),
            np.column_stack((np.full(t.size, 0.03**2), nothing, nothing)),
            yaw_rate,
        )
    if visual:
        t = stamps(30.0)
        lever = np.array([0.3, 0.0, 0.4])
        v = np.einsum("nji,nj->ni", drive.slerp(t).as_matrix(), drive.at(drive.velocity, t))
        v = (v + np.cross(drive.at(rate, t), lever)) * visual_scale + rng.normal(size=(t.size, 3)) * 0.03
        wild = rng.random(t.size) < 0.01
        v[wild] += rng.normal(size=(wild.sum(), 3)) * 0.7
        nothing = np.full(t.size, np.nan)
        found["visual"] = BodyVelocities(ns(t), v, np.full((t.size, 3), 0.03**2), nothing, tuple(lever))
    if imu:
        t = stamps(imu_hz)
        walk = np.cumsum(rng.normal(size=(t.size, 3)), axis=0) * np.sqrt(1 / imu_hz)
        gyro = drive.at(rate, t) + [0.006, -0.004, 0.008] + 2e-5 * walk + rng.normal(size=(t.size, 3)) * 0.002
        force = drive.at(drive.force, t) + [0.05, -0.04, 0.06] + 2e-4 * walk + rng.normal(size=(t.size, 3)) * 0.08
        found["imu"] = InertialMeasurements(ns(t), gyro, force, np.full((t.size, 4), np.nan), 0.003, 0.10)
    return Measurements(**found)


def make_lasting_errors(t, time_s, seed):
    """Return Gauss-Markov errors of variance 1 with a correlation time at times [s], shape (N, 3)."""
    found = np.random.default_rng((seed, 7)).normal(size=(t.size, 3))
    kept = np.exp(-np.diff(t) / time_s)
    for k, share in enumerate(kept):
        found[k + 1] = share * found[k] + np.sqrt(1 - share**2) * found[k + 1]
    return found


def errors(drive, trajectory, *, after_s=0.0):
    """Return root mean square errors and the NEES of position, yaw and forward velocity."""
    t = (trajectory.stamp_ns - ZERO_NS) * 1e-9
    chosen = (t >= after_s) & (t <= drive.t[-1])
    t = t[chosen]
    position = trajectory.position_enu_m[chosen] - drive.at(drive.position, t)
    estimated = Rotation.from_quat(trajectory.quat_xyzw[chosen])
    true = drive.slerp(t)
    yaw = (true.inv() * estimated).as_rotvec()[:, 2]
    forward = np.einsum("ni,ni->n", estimated.as_matrix()[:, :, 0], trajectory.velocity_enu_mps[chosen])
    forward -= np.interp(t, drive.t, drive.forward)
    rate = trajectory.angular_velocity_radps[chosen] - drive.at(drive.rate, t)
    return {
        "xy": np.sqrt(np.mean(np.sum(position[:, :2] ** 2, 1))),
        "z": np.sqrt(np.mean(position[:, 2] ** 2)),
        "yaw_deg": np.degrees(np.sqrt(np.mean(yaw**2))),
        "forward": np.sqrt(np.mean(forward**2)),
        "yaw_rate": np.sqrt(np.mean(rate[:, 2] ** 2)),
        "nees_position": np.mean(position**2 / trajectory.position_std_m[chosen] ** 2),
        "nees_yaw": np.mean(yaw**2 / trajectory.yaw_std_rad[chosen] ** 2),
        "nees_forward": np.mean(forward**2 / trajectory.forward_velocity_std_mps[chosen] ** 2),
        "max_xy": np.max(np.hypot(*position[:, :2].T)),
    }


def integral(stamp_ns, values):
    """Return the integral from the first sample to each, by trapezia."""
    return np.concatenate(([0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(stamp_ns) * 1e-9)))


def estimate_noise(measurements):
    """Return the noise of each sensor of a section, by the residuals of all pairs."""
    return fit_noise(measurements, find_residuals(measurements))
