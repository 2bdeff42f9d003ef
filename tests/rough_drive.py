"""A drive over a known bumpy surface, and what its sensors would measure: truth for tests of the forward filter."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from unit.fusion.drive import make_drive, ns

from tcpipe.fusion.measurements import (
    DISPLACEMENT_LAGS_S,
    BodyVelocities,
    InertialMeasurements,
    InitialState,
    Measurements,
    Positions,
    Trajectory,
)
from tcpipe.geometry.rotation import quat_from_matrix, quat_from_rpy, rpy_from_matrix
from tcpipe.tables.facts import SectionFacts

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


@cache
def drive(seconds=120.0, seed=0):
    """Drive over the hills of `unit.fusion.drive`, at about 1 m/s with a halt a minute; ``seed`` chooses the first yaw."""
    made = make_drive(seconds + 0.003, start_yaw=float(seed), stand_s=0.9)
    rows = slice(None, None, 2)
    return Drive(
        stamp_ns=ns(made.t[rows]),
        position=made.position[rows],
        rotation=made.rotation[rows],
        velocity=made.velocity[rows],
        body_velocity=np.einsum("kji,kj->ki", made.rotation[rows], made.velocity[rows]),
        turn=made.rate[rows],
        force=made.force[rows],
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
        facts=SectionFacts({}, {}, {}),
    )
