"""Chains of static transforms, against rotations worked out with scipy."""

import numpy as np
from scipy.spatial.transform import Rotation

from tcpipe.logs.extrinsics import Transforms, build_static_tree, find_base_link_from, is_base

YAW_90 = Rotation.from_euler("z", 90, degrees=True)
ROLL_180 = Rotation.from_euler("x", 180, degrees=True)


def logged(*edges: tuple[str, str, tuple[float, float, float], Rotation]) -> Transforms:
    parents, children, positions, rotations = zip(*edges, strict=True)
    return Transforms(parents, children, np.array(positions), np.array([r.as_quat() for r in rotations]))


def matrix(position: tuple[float, float, float], rotation: Rotation) -> np.ndarray:
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = rotation.as_matrix(), position
    return found


def test_a_chain_down_to_a_sensor_and_up_over_a_footprint() -> None:
    tree = build_static_tree(
        [
            logged(
                ("/base_footprint", "base_link", (0.0, 0.0, 0.14), Rotation.identity()),
                ("base_link", "top_plate", (0.1, 0.2, 0.3), YAW_90),
                ("top_plate", "imu_link", (1.0, 0.0, 0.0), ROLL_180),
            )
        ]
    )
    expected = matrix((0.1, 0.2, 0.3), YAW_90) @ matrix((1.0, 0.0, 0.0), ROLL_180)
    pose = find_base_link_from("/imu_link", tree)
    assert pose is not None
    np.testing.assert_allclose(pose.xyz_m, expected[:3, 3], atol=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(pose.quat_xyzw).as_matrix(), expected[:3, :3], atol=1e-12)
    footprint = find_base_link_from("base_footprint", tree)
    assert footprint is not None
    np.testing.assert_allclose(footprint.xyz_m, [0, 0, -0.14], atol=1e-12)


def test_base_link_below_the_sensor_and_quaternions_that_are_not_unit() -> None:
    transforms = logged(("camera", "base_link", (0.5, 0.0, -1.0), YAW_90))
    tree = build_static_tree(
        [Transforms(transforms.parent, transforms.child, transforms.xyz_m, 3 * transforms.quat_xyzw)]
    )
    expected = np.linalg.inv(matrix((0.5, 0.0, -1.0), YAW_90))
    pose = find_base_link_from("camera", tree)
    assert pose is not None
    np.testing.assert_allclose(pose.xyz_m, expected[:3, 3], atol=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(pose.quat_xyzw).as_matrix(), expected[:3, :3], atol=1e-12)


def test_transforms_that_move_place_nothing_but_latched_ones_do() -> None:
    latched = logged(*[("base_link", "gps", (0.1, 0.0, 1.0), YAW_90)] * 5)
    moving = logged(
        *[("odom", "base_link", (0.1 * i, 0.0, 0.0), YAW_90) for i in range(5)], ("odom", "beacon", (0, 0, 0), YAW_90)
    )
    tree = build_static_tree([latched, moving])
    assert find_base_link_from("gps", tree) is not None
    assert find_base_link_from("beacon", tree) is None
    assert find_base_link_from("odom", tree) is None


def test_unknown_frames_loops_and_broken_rotations() -> None:
    tree = build_static_tree(
        [
            logged(("a", "b", (1, 0, 0), YAW_90), ("b", "a", (0, 0, 0), YAW_90), ("b", "c", (0, 0, 0), YAW_90)),
            Transforms(["base_link"], ["a"], np.zeros((1, 3)), np.zeros((1, 4))),
            Transforms(["base_link"], ["b"], np.full((1, 3), np.nan), np.array([[0.0, 0.0, 0.0, 1.0]])),
        ]
    )
    assert find_base_link_from("c", tree) is None
    assert find_base_link_from("elsewhere", tree) is None


def test_a_prefix_keeps_two_robots_apart() -> None:
    tree = build_static_tree(
        [
            logged(
                ("world", "a/base_link", (5.0, 0.0, 0.0), YAW_90),
                ("world", "b/base_link", (7.0, 0.0, 0.0), YAW_90),
                ("b/base_link", "b/imu", (0.3, 0.0, 0.0), Rotation.identity()),
            )
        ]
    )
    pose = find_base_link_from("b/imu", tree)
    assert pose is not None
    np.testing.assert_allclose(pose.xyz_m, [0.3, 0, 0], atol=1e-12)
    assert is_base("b/base_link")
    assert is_base("/base_footprint")
    assert not is_base("my_base_link_2")
