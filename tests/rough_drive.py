"""A drive over a known bumpy surface, and what its sensors would measure: truth for tests of the forward filter."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from tcpipe.fusion.measurements import (
    DISPLACEMENT_LAGS_S,
    BodyVelocities,
    InertialMeasurements,
    InitialState,
    Measurements,
    Positions,
    Trajectory,
)
from tcpipe.geometry.rotation import quat_from_matrix, quat_from_rpy, rotation_vector_from_quat, rpy_from_matrix
from tcpipe.tables.facts import StretchFacts

GRAVITY_MPS2 = 9.80665
RATE_HZ = 200
ANTENNA_M = (0.2, -0.1, 0.8)
CAMERA_M = (0.4, 0.06, 0.3)


@dataclass(frozen=True)
class Drive:
    """Truth at 200 Hz: base_link in ENU."""

    stamp_ns: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    body_velocity: np.ndarray
    turn: np.ndarray
    force: np.ndarray

    def at(self, stamp_ns):
        """Rows of these stamps, which are multiples of 5 ms."""
        return (np.asarray(stamp_ns) - self.stamp_ns[0]) // (1_000_000_000 // RATE_HZ)


def _surface(x, y):
    """Height, and its slopes east and north: hills to some 15 degrees and bumps of a robot's length."""
    z = 2.0 * np.sin(x / 9.0) * np.cos(y / 11.0) + 0.02 * np.sin(x / 0.5) * np.sin(y / 0.6)
    dx = 2.0 / 9.0 * np.cos(x / 9.0) * np.cos(y / 11.0) + 0.04 * np.cos(x / 0.5) * np.sin(y / 0.6)
    dy = -2.0 / 11.0 * np.sin(x / 9.0) * np.sin(y / 11.0) + 0.02 / 0.6 * np.sin(x / 0.5) * np.cos(y / 0.6)
    return z, dx, dy


def _frame(heading, dx, dy):
    up = np.stack((-dx, -dy, np.ones_like(dx)), -1)
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    ahead = np.stack((np.cos(heading), np.sin(heading), dx * np.cos(heading) + dy * np.sin(heading)), -1)
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    return np.stack((ahead, np.cross(up, ahead), up), -1)


@cache
def drive(seconds=120.0, seed=0):
    """Speeds up, weaves at about 1 m/s, slows down twice a minute."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, 4)
    n = int(seconds * RATE_HZ) + 1
    t = np.arange(2 * n - 1) / (2 * RATE_HZ)  # half steps, for the midpoint rule
    speed = np.clip(t / 3.0, 0.0, 1.0) * (0.8 + 0.3 * np.sin(2 * np.pi * t / 30.0 + phase[0]))
    heading = (
        phase[3]
        + 0.9 * np.sin(2 * np.pi * t / 25.0 + phase[1])
        + 0.25 * np.sin(2 * np.pi * t / 4.0 + phase[2])
        + 0.02 * t
    )
    heading -= heading[0] - phase[3]
    xy = np.zeros((n, 2))
    ahead = np.column_stack((np.cos(heading), np.sin(heading))).tolist()
    x = y = 0.0
    for k in range(n - 1):
        at_x, at_y = x, y
        for half, share in ((2 * k, 0.5), (2 * k + 1, 1.0)):
            _, dx, dy = _surface(at_x, at_y)
            east, north = ahead[half]
            step = speed[half] * share / RATE_HZ / math.hypot(1.0, dx * east + dy * north)
            at_x, at_y = x + step * east, y + step * north
        x, y = xy[k + 1] = at_x, at_y
    z, dx, dy = _surface(xy[:, 0], xy[:, 1])
    rotation = _frame(heading[::2], dx, dy)
    velocity = speed[::2, None] * rotation[:, :, 0]
    acceleration = np.gradient(velocity, 1 / RATE_HZ, axis=0)
    between = np.einsum("kji,kjl->kil", rotation[:-1], rotation[1:])
    steps = rotation_vector_from_quat(quat_from_matrix(between)) * RATE_HZ
    turn = np.concatenate((steps[:1], (steps[1:] + steps[:-1]) / 2, steps[-1:]))
    return Drive(
        stamp_ns=1_700_000_000_000_000_000 + np.arange(n, dtype=np.int64) * (1_000_000_000 // RATE_HZ),
        position=np.column_stack((xy, z)),
        rotation=rotation,
        velocity=velocity,
        body_velocity=np.einsum("kji,kj->ki", rotation, velocity),
        turn=turn,
        force=np.einsum("kji,kj->ki", rotation, acceleration + np.array([0, 0, GRAVITY_MPS2])),
    )


def measured(truth, seed=0, *, gnss_std=0.015):
    """IMU 200 Hz (gyroscope bias known to 1 mrad/s), wheels 50 Hz with slip to 4 %, camera 25 Hz, RTK 10 Hz."""
    rng = np.random.default_rng(seed + 1000)

    def rows(hz, delay=0):
        return np.arange(delay, truth.stamp_ns.size, RATE_HZ // hz)

    n = truth.stamp_ns.size
    force = truth.force + rng.normal(0, 0.3, (n, 3)) + [0.03, -0.03, 0.02]
    tilt = rpy_from_matrix(truth.rotation)
    wander = 0.006 * np.sin(np.linspace(0, 20, n))[:, None]
    quat = quat_from_rpy(tilt[:, 0] + wander[:, 0], tilt[:, 1] - wander[:, 0], tilt[:, 2] + 1.0)
    imu = InertialMeasurements(
        stamp_ns=truth.stamp_ns,
        angular_velocity_radps=truth.turn + rng.normal(0, 0.005, (n, 3)) + rng.normal(0, 1e-3, 3),
        specific_force_mps2=force,
        quat_xyzw=quat,
        gyro_std_radps=0.005,
        accelerometer_std_mps2=0.3,
    )
    at = rows(50)
    slip = 1.0 + 0.02 + 0.02 * np.sin(np.arange(at.size) / 400)
    wheels = BodyVelocities(
        stamp_ns=truth.stamp_ns[at],
        velocity_mps=np.column_stack(
            (truth.body_velocity[at, 0] * slip + rng.normal(0, 0.02, at.size), np.full((at.size, 2), np.nan))
        ),
        variance_m2ps2=np.column_stack((np.full(at.size, 0.05**2), np.full((at.size, 2), np.nan))),
        yaw_rate_radps=truth.turn[at, 2] * 0.8,
    )
    at = rows(25, 3)
    seen = truth.body_velocity[at] + np.cross(truth.turn[at], CAMERA_M)
    visual = BodyVelocities(
        stamp_ns=truth.stamp_ns[at],
        velocity_mps=seen + rng.normal(0, 0.05, (at.size, 3)),
        variance_m2ps2=np.full((at.size, 3), 0.05**2),
        yaw_rate_radps=truth.turn[at, 2] + rng.normal(0, 0.02, at.size),
        lever_arm_m=CAMERA_M,
    )
    at = rows(10, 7)
    gnss = Positions(
        stamp_ns=truth.stamp_ns[at],
        position_enu_m=truth.position[at]
        + truth.rotation[at] @ ANTENNA_M
        + rng.normal(0, 1, (at.size, 3)) * [gnss_std, gnss_std, 2 * gnss_std],
        variance_m2=np.tile(np.square([gnss_std, gnss_std, 2 * gnss_std]), (at.size, 1)),
        lever_arm_m=ANTENNA_M,
    )
    return Measurements(gnss=gnss, imu=imu, wheels=wheels, visual=visual)


def initial(truth, *, yaw_error=0.03):
    """Start within 3 cm and 2 degrees of the truth."""
    rpy = rpy_from_matrix(truth.rotation[0]) + np.array([0.01, -0.01, yaw_error])
    return InitialState(
        position_enu_m=truth.position[0] + [0.02, -0.02, 0.02],
        position_std_m=np.full(3, 0.03),
        quat_xyzw=quat_from_rpy(*rpy),
        tilt_std_rad=0.02,
        yaw_std_rad=0.05,
        velocity_enu_mps=truth.velocity[0],
    )


def true_track(truth):
    """A track that is the truth, 20 rows a second, and claims a centimetre and a centimetre a second."""
    rows = np.arange(0, truth.stamp_ns.size, RATE_HZ // 20)
    return Trajectory(
        stamp_ns=truth.stamp_ns[rows],
        position_enu_m=truth.position[rows],
        quat_xyzw=quat_from_matrix(truth.rotation[rows]),
        velocity_enu_mps=truth.velocity[rows],
        angular_velocity_radps=truth.turn[rows],
        position_std_m=np.full((rows.size, 3), 0.01),
        yaw_std_rad=np.full(rows.size, 0.005),
        forward_velocity_std_mps=np.full(rows.size, 0.01),
        rejections={},
        displacement_std_m=np.full((rows.size, 1), 0.01) * DISPLACEMENT_LAGS_S,
        facts=StretchFacts({}, {}, {}),
    )
