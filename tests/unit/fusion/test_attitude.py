"""The attitude of a pose in the axes of the robot: stated or shown by the motion, in any frame, and with what is not measured left out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tcpipe.fusion.attitude import (
    STATED_MOUNTING_STD_RAD,
    UNSTATED_MOUNTING_STD_RAD,
    add_attitude,
    align_mounting,
)
from tcpipe.fusion.measurements import BodyVelocities, Positions

COUNT = 600
STAMP_NS = np.arange(COUNT, dtype=np.int64) * 100_000_000
TIME_S = STAMP_NS * 1e-9
YAW_RAD = 0.8 * np.sin(0.2 * TIME_S)
PITCH_RAD = 0.1 * np.sin(0.15 * TIME_S)
ROBOT = Rotation.from_euler("ZY", np.column_stack((YAW_RAD, PITCH_RAD)))
PLACE_M = np.cumsum(0.08 * ROBOT.apply([1.0, 0.0, 0.0]), axis=0)
SENSOR = Rotation.from_euler("xyz", [-np.pi / 2, 0.0, -np.pi / 2])
"""A camera: its z axis looks forward."""


def make_pose(sensor=SENSOR, *, noise_rad=0.0, grid_rad=0.0, mounting=None, flat=False, variance=np.nan):
    """Return a pose in a frame that is turned by ``grid_rad`` against ENU."""
    noise = Rotation.from_rotvec(noise_rad * np.random.default_rng(1).normal(size=(COUNT, 3)))
    robot = Rotation.from_euler("z", YAW_RAD[:, None]) if flat else ROBOT
    frame = Rotation.from_euler("z", -grid_rad)
    quat = (frame * robot * sensor * noise).as_quat()
    fixes = Positions(STAMP_NS, PLACE_M, np.full((COUNT, 3), 1e-4))
    mounting = tuple((sensor if mounting is None else mounting).as_quat())
    return add_attitude(fixes, frame.apply(PLACE_M)[:, :2], quat, np.full((COUNT, 3), variance), mounting)


def off_rad(pose, robot=ROBOT):
    return (robot.inv() * Rotation.from_quat(pose.quat_xyzw)).magnitude()


@pytest.mark.parametrize("grid_rad", [0.0, 0.03, -2.0])
def test_a_stated_mounting_and_the_grid_are_taken_out(grid_rad):
    pose = make_pose(grid_rad=grid_rad)
    assert off_rad(pose).max() < 1e-9
    assert pose.mounting_std_rad == STATED_MOUNTING_STD_RAD


def test_the_variance_is_the_stated_one_or_what_the_attitudes_show():
    assert np.sqrt(make_pose(variance=0.02**2).rotation_variance_rad2).mean() == pytest.approx(0.02, rel=0.01)
    assert np.sqrt(make_pose(noise_rad=0.05).rotation_variance_rad2).mean() == pytest.approx(0.05, rel=0.1)
    assert np.sqrt(make_pose(variance=1e-12, noise_rad=0.03).rotation_variance_rad2).mean() == pytest.approx(
        0.03, rel=0.1
    )


def test_a_pose_in_the_plane_has_no_roll_and_pitch():
    variance = make_pose(Rotation.identity(), flat=True).rotation_variance_rad2
    assert variance[:, :2].min() > 1.0
    assert variance[:, 2].max() < 0.02**2


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("sensor", [SENSOR, Rotation.from_euler("xyz", [0.1, -0.2, 3.0])], ids=["camera", "backwards"])
def test_an_unknown_mounting_is_that_of_a_robot_that_drives_forward(sensor, sign):
    one = np.ones(COUNT)
    odometry = BodyVelocities(STAMP_NS, sign * np.outer(one, [0.8, 0.0, 0.0]), np.ones((COUNT, 3)), 0 * one)
    pose = align_mounting(make_pose(sensor, noise_rad=0.01, mounting=Rotation.identity()), odometry, is_stated=False)
    forward = ROBOT if sign > 0 else ROBOT * Rotation.from_euler("z", np.pi)
    assert np.sqrt(np.mean(off_rad(pose, forward) ** 2)) < 0.04
    assert pose.mounting_std_rad == UNSTATED_MOUNTING_STD_RAD
    found = Rotation.from_quat(pose.mounting_xyzw)
    assert (found.inv() * (sensor if sign > 0 else Rotation.from_euler("z", np.pi) * sensor)).magnitude() < 0.04


def test_without_motion_an_unknown_mounting_stays_unknown():
    standing = replace(make_pose(), position_enu_m=np.zeros((COUNT, 3)))
    assert align_mounting(standing, None, is_stated=False).quat_xyzw is None


def test_few_attitudes_are_none():
    fixes = Positions(STAMP_NS, PLACE_M, np.full((COUNT, 3), 1e-4))
    quat = np.full((COUNT, 4), np.nan)
    quat[:5] = 0.5
    assert add_attitude(fixes, PLACE_M[:, :2], quat, np.full((COUNT, 3), np.nan), (0.0, 0.0, 0.0, 1.0)) is fixes


def test_a_stated_mounting_stays_unless_the_motion_contradicts_it():
    near, far = (Rotation.from_euler("z", angle) for angle in (0.1, 1.5))
    pose = make_pose(near, mounting=Rotation.identity())
    assert align_mounting(pose, None, is_stated=True) is pose
    assert off_rad(align_mounting(make_pose(far, mounting=Rotation.identity()), None, is_stated=True)).max() < 0.05
    standing = replace(pose, position_enu_m=np.zeros((COUNT, 3)))
    assert align_mounting(standing, None, is_stated=True) is standing
