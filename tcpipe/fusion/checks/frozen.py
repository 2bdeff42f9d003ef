"""Sensors that repeat one value to the last digit while the others show that the robot moves: a driver that died, a cable that is out."""

from __future__ import annotations

import numpy as np

from tcpipe.fusion.checks.distances import Distances
from tcpipe.fusion.checks.lags import Floats
from tcpipe.fusion.checks.refusals import SensorExclusion
from tcpipe.fusion.measurements import GNSS, IMU, Measurements

_FEWEST_ROWS = 20
_APART = 0.5
_FEWEST_WINDOWS = 2


def find_frozen_sensors(m: Measurements, found: Distances) -> dict[str, SensorExclusion]:
    """Return the refusals by sensor; ``found`` tells how far the others went."""
    refusals = {}
    if m.gnss is not None and _is_one_value(m.gnss.position_enu_m) and _is_contradicted(GNSS, found):
        refusals[GNSS] = refuse_frozen(GNSS, "position", m.gnss.stamp_ns.size)
    for role, source in m.odometries().items():
        if _is_contradicted(role, found) and _is_one_value(source.velocity_mps):
            refusals[role] = refuse_frozen(role, "velocity", source.stamp_ns.size)
    if m.imu is not None and any(np.nanmax(chord, initial=0.0) > found.least_m for chord in found.chord_m.values()):
        for what, values in (
            ("angular_velocity", m.imu.angular_velocity_radps),
            ("acceleration", m.imu.specific_force_mps2),
        ):
            if _is_one_value(values):
                refusals[IMU] = refuse_frozen(IMU, what, m.imu.stamp_ns.size)
    return refusals


def refuse_frozen(role: str, quantity: str, messages: int) -> SensorExclusion:
    """Return the refusal of a sensor that repeats one value."""
    return SensorExclusion(role, "frozen", {"quantity": quantity}, {"message_count": messages})


def _is_one_value(values: Floats) -> bool:
    """Return whether all rows of (N, k) are the same to the last digit, and enough of them."""
    return values.shape[0] >= _FEWEST_ROWS and bool(
        np.array_equal(values, np.broadcast_to(values[0], values.shape), equal_nan=True)
    )


def _is_contradicted(role: str, found: Distances) -> bool:
    """Return whether another sensor goes clearly further, or less far, in some windows."""
    mine = found.chord_m.get(role)
    for name, chord in found.chord_m.items():
        if name != role and mine is not None:
            apart = np.abs(chord - mine) > np.maximum(found.least_m, _APART * np.fmax(chord, mine))
            if apart.sum() >= _FEWEST_WINDOWS:
                return True
    return False
