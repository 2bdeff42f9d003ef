"""Sensors that repeat one value to the last digit while the others show that the robot moves: a driver that died, a cable that is out."""

from __future__ import annotations

import numpy as np

from tcpipe.fusion.checks.distances import Distances
from tcpipe.fusion.checks.lags import Floats
from tcpipe.fusion.measurements import GNSS, IMU, Measurements

_FEWEST_ROWS = 20
_APART = 0.5
_FEWEST_WINDOWS = 2


def frozen_sensors(m: Measurements, found: Distances) -> dict[str, str]:
    """Return why by sensor; ``found`` tells how far the others went."""
    why = {}
    if m.gnss is not None and _one_value(m.gnss.position_enu_m) and _contradicted(GNSS, found):
        why[GNSS] = f"all of its {m.gnss.stamp_ns.size} fixes are the same place while the robot drives"
    for role, source in m.odometries().items():
        if _contradicted(role, found) and _one_value(source.velocity_mps):
            speed = source.velocity_mps[0, 0]
            why[role] = (
                f"its velocity is {speed:g} m/s on all of its {source.stamp_ns.size} messages, whatever the robot does"
            )
    if m.imu is not None and any(np.nanmax(chord, initial=0.0) > found.least_m for chord in found.chord_m.values()):
        for what, values in (
            ("angular velocity", m.imu.angular_velocity_radps),
            ("acceleration", m.imu.specific_force_mps2),
        ):
            if _one_value(values):
                why[IMU] = f"its {what} never changes while the robot drives"
    return why


def _one_value(values: Floats) -> bool:
    """Return whether all rows of (N, k) are the same to the last digit, and enough of them."""
    return values.shape[0] >= _FEWEST_ROWS and bool(
        np.array_equal(values, np.broadcast_to(values[0], values.shape), equal_nan=True)
    )


def _contradicted(role: str, found: Distances) -> bool:
    """Return whether another sensor goes clearly further, or less far, in some windows."""
    mine = found.chord_m.get(role)
    for name, chord in found.chord_m.items():
        if name != role and mine is not None:
            apart = np.abs(chord - mine) > np.maximum(found.least_m, _APART * np.fmax(chord, mine))
            if apart.sum() >= _FEWEST_WINDOWS:
                return True
    return False
