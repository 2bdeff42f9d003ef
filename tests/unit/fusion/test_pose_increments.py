"""Along whose axes a twist is, told by the poses beside it: drives written down by formula."""

import numpy as np
import pytest

from tcpipe.fusion.pose_increments import along_pose_axes, in_child_axes
from tcpipe.fusion.preparation import body_velocities
from tcpipe.geometry.rotation import quat_from_rpy

SPEED, RATE = 1.5, 0.3
T = np.arange(0.0, 60.0, 0.1)
STAMP_NS = (T * 1e9).astype(np.int64)


def circle(rate=RATE, start_rad=0.4):
    """A robot that only drives forward: yaw, places, and velocities along the axes of the pose's frame."""
    yaw = start_rad + rate * T
    along = SPEED * np.column_stack((np.cos(yaw), np.sin(yaw), np.zeros(T.size)))
    if not rate:
        return yaw, along * T[:, None], along
    radius = SPEED / rate
    place = radius * np.column_stack((np.sin(yaw), -np.cos(yaw), np.zeros(T.size)))
    return yaw, place, along


def quats(yaw):
    return quat_from_rpy(np.zeros(T.size), np.zeros(T.size), yaw)


def test_a_velocity_that_turns_round_with_the_path_is_along_the_poses_axes_and_turned():
    yaw, place, along = circle()
    assert along_pose_axes(STAMP_NS, along, place, quats(yaw))
    assert in_child_axes(along, quats(yaw)) == pytest.approx(np.tile([SPEED, 0.0, 0.0], (T.size, 1)), abs=1e-9)


@pytest.mark.parametrize("scale", [0.7, 1.0, 1.4])
def test_a_velocity_of_another_scale_is_turned_as_well(scale):
    yaw, place, along = circle()
    assert along_pose_axes(STAMP_NS, scale * along, place, quats(yaw))


def test_a_velocity_along_the_robots_axes_is_left():
    yaw, place, _ = circle()
    assert not along_pose_axes(STAMP_NS, np.tile([SPEED, 0.0, 0.0], (T.size, 1)), place, quats(yaw))


def test_straight_along_the_first_axis_both_are_the_same_and_nothing_is_turned():
    yaw, place, along = circle(rate=0.0, start_rad=0.0)
    assert not along_pose_axes(STAMP_NS, along, place, quats(yaw))


def test_an_odometry_without_poses_or_with_one_axis_is_left():
    yaw, place, along = circle()
    assert not along_pose_axes(STAMP_NS, along, np.full_like(place, np.nan), quats(yaw))
    along[:, 1] = np.nan
    assert not along_pose_axes(STAMP_NS, along, place, quats(yaw))


def test_such_an_odometry_is_prepared_as_driving_forward_and_it_is_said():
    yaw, place, along = circle()
    unknown = np.full(T.size, np.nan)
    columns = dict.fromkeys(("yaw_rate_var", *(f"velocity_var_{axis}_m2ps2" for axis in "xyz")), unknown)
    columns |= {f"angular_velocity_{axis}_radps": unknown for axis in "xy"}
    columns |= {"angular_velocity_z_radps": np.full(T.size, RATE)}
    columns |= {f"velocity_{axis}_mps": along[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"{axis}_m": place[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"quat_{c}": quats(yaw)[:, k] for k, c in enumerate("xyzw")}
    made, prepared = body_velocities(
        STAMP_NS, columns, xyz_m=(0, 0, 0), quat_xyzw=(0, 0, 0, 1), default_std_mps=0.05, only_forward=True
    )
    assert made.velocity_mps[:, 0] == pytest.approx(np.full(T.size, SPEED))
    assert "along the axes of its pose's frame" in prepared.remarks[0]
