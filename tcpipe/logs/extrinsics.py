"""Extrinsics of sensors: chains of static transforms from a sensor's frame to base_link.

Conventions: REP-105 (base_link; base_footprint is its projection on the ground), tf2_msgs/TFMessage (``transform`` is
parent_from_child). A transform counts as static when all its messages agree, so that a latched /tf of ROS 1 serves as
well.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tcpipe.arrays import Floats
from tcpipe.geometry.rotation import invert, multiply, normalize, rotate

_SAME_M = 1e-6
_SAME_QUAT = 1e-9
_BASES = ("base_link", "base_footprint")


@dataclass(frozen=True, slots=True)
class Pose:
    """a_from_b: position [m] of b's origin in a, and rotation b to a."""

    xyz_m: Floats
    quat_xyzw: Floats


IDENTITY = Pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


@dataclass(frozen=True, slots=True)
class Transforms:
    """Transforms as logged, (N,): parent and child frame, position (N, 3) [m], rotation child to parent (N, 4)."""

    parent: Sequence[str]
    child: Sequence[str]
    xyz_m: Floats
    quat_xyzw: Floats


Tree = dict[str, dict[str, Pose]]
"""Poses by frame and neighbouring frame: ``tree[a][b]`` is a_from_b."""


def build_static_tree(transforms: Sequence[Transforms]) -> Tree:
    """Return the tree of transforms that never change; invalid transforms are left out."""
    first: dict[tuple[str, str], Pose] = {}
    moving: set[tuple[str, str]] = set()
    for logged in transforms:
        quats = normalize(logged.quat_xyzw)
        for parent, child, xyz_m, quat_xyzw in zip(logged.parent, logged.child, logged.xyz_m, quats, strict=True):
            edge = (parent.strip("/"), child.strip("/"))
            if not np.isfinite(xyz_m.sum() + quat_xyzw.sum()):
                continue
            known = first.setdefault(edge, Pose(xyz_m, quat_xyzw))
            if np.abs(known.xyz_m - xyz_m).max() > _SAME_M or 1 - abs(known.quat_xyzw @ quat_xyzw) > _SAME_QUAT:
                moving.add(edge)
    tree: Tree = {}
    for (parent, child), pose in first.items():
        if (parent, child) not in moving:
            tree.setdefault(parent, {})[child] = pose
            parent_from_child = invert(pose.quat_xyzw)
            tree.setdefault(child, {})[parent] = Pose(-rotate(parent_from_child, pose.xyz_m), parent_from_child)
    return tree


def is_base(frame: str) -> bool:
    """Whether a frame is the robot's base: base_link or base_footprint, with or without a robot's prefix."""
    return frame.strip("/").rsplit("/", 1)[-1] in _BASES


def find_base_link_from(frame: str, tree: Tree) -> Pose | None:
    """Return base_link_from_frame by the shortest chain of static transforms, or None if no chain leads to a base.

    base_link goes before base_footprint, and a base with the frame's own prefix before another's; base_footprint stands
    for base_link only where no base_link is connected.
    """
    start = frame.strip("/")
    from_start: dict[str, Pose] = {start: IDENTITY}
    queue = deque([start])
    while queue:
        here = queue.popleft()
        for neighbour in sorted(tree.get(here, {})):
            if neighbour not in from_start:
                a_from_b, b_from_c = tree[neighbour][here], from_start[here]
                xyz_m = a_from_b.xyz_m + rotate(a_from_b.quat_xyzw, b_from_c.xyz_m)
                from_start[neighbour] = Pose(xyz_m, multiply(a_from_b.quat_xyzw, b_from_c.quat_xyzw))
                queue.append(neighbour)
    prefix = start.rpartition("/")[0]
    bases = [found for found in from_start if is_base(found)]
    if not bases:
        return None
    best = min(bases, key=lambda base: (_BASES.index(base.rsplit("/", 1)[-1]), base.rpartition("/")[0] != prefix, base))
    return from_start[best]
