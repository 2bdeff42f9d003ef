"""Power of joints, from efforts and velocities (sensor_msgs/JointState): the sum of torque times speed, and of a stated loss.

Each joint draws p = torque * speed + r * torque². Where the torque is the motor current's (times the torque constant, at the shaft whose
speed is measured) and r the motor's resistance over the squared constant, that is the motor's electrical power, with what gears and
bearings take. Of a torque that is measured behind the gear it is not. Electronics, and the idle power of drives, never are part of it.

A joint that brakes gives back -p where p is negative. Unless the source states that this is recovered, it counts as 0: a brake resistor or
the drive takes it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.robots import PowerSource

Columns = Mapping[str, NDArray[Any]]
Floats = NDArray[np.float64]

NAMES, SPEED, TORQUE = "name[]", "velocity", "effort"
"""Columns of such messages."""


@dataclass(frozen=True, slots=True)
class JointMotion:
    """Torques [N m] and speeds [rad/s] of some joints, shape (N, J); NaN where a message lacks a joint or its value."""

    names: tuple[str, ...]
    torque_nm: Floats
    speed_radps: Floats


def select_joints(columns: Columns, source: PowerSource) -> JointMotion:
    """Return the joints of a source, which messages may hold in any order; ``columns`` are those of messages that have all three fields."""
    layouts = _find_layouts(columns[NAMES])
    joints = sorted({name for layout in layouts for name in layout if name and re.fullmatch(source.joints, name)})
    values = np.full((2, len(columns[NAMES]), len(joints)), np.nan)
    for value, field in zip(values, (TORQUE, SPEED), strict=True):
        for layout, rows in layouts.items():
            for at, name in enumerate(layout[: columns[field].shape[1]]):
                if name in joints:
                    value[rows, joints.index(name)] = columns[field][rows, at]
    return JointMotion(tuple(joints), source.torque_scale * values[0], source.speed_scale * values[1])


def _find_layouts(names: NDArray[np.str_]) -> dict[tuple[str, ...], NDArray[np.int64]]:
    """Return the rows of at least one message, shape (N, k), by their lists of names."""
    first = np.flatnonzero(np.concatenate(([True], (names[1:] != names[:-1]).any(axis=1))))
    found: dict[tuple[str, ...], list[NDArray[np.int64]]] = {}
    for rows in np.split(np.arange(len(names)), first[1:]):
        found.setdefault(tuple(names[rows[0]].tolist()), []).append(rows)
    return {layout: np.concatenate(parts) for layout, parts in found.items()}


@dataclass(frozen=True, slots=True)
class JointPower:
    """Power that joints draw [W], shape (N,), and the shares of its sum that are the loss, and that are given back but do not count."""

    names: tuple[str, ...]
    watt: Floats
    loss_fraction: float
    returned_fraction: float


def compute_joint_power(motion: JointMotion, source: PowerSource, *, sign: int) -> JointPower:
    """Return the power of joints, with torques times ``sign``; NaN in rows that lack one."""
    loss = source.loss_watt_per_nm2 * motion.torque_nm**2
    joint = sign * motion.torque_nm * motion.speed_radps + loss
    drawn = joint if source.recovered else np.where(joint < 0.0, 0.0, joint)
    watt = drawn.sum(axis=1)
    known = np.isfinite(watt)
    total = float(watt[known].sum())
    lost, returned = float(loss[known].sum()), float((drawn - joint)[known].sum())
    return JointPower(motion.names, watt, *((lost / total, returned / total) if total > 0.0 else (0.0, 0.0)))
