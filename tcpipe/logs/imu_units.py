"""Inertial units that do not speak SI: degrees per second, or acceleration in units of standard gravity (ISO 80000-3: 9.80665 m/s²)."""

from __future__ import annotations

from dataclasses import replace
from math import pi

from tcpipe.logs.messages import Readings

STANDARD_GRAVITY_MPS2 = 9.80665

_FACTORS = {
    "si": (1.0, 1.0),
    "deg": (pi / 180.0, 1.0),
    "g": (1.0, STANDARD_GRAVITY_MPS2),
    "deg_g": (pi / 180.0, STANDARD_GRAVITY_MPS2),
}


def imu_in_si(readings: Readings, units: str) -> Readings:
    """Return an IMU's readings in rad/s and m/s², variances included.

    Parameters
    ----------
    readings : columns of the role imu, in the units of the message.
    units : the recipe's ``imu_units``: si, deg (deg/s and m/s²), g (rad/s and g) or deg_g (deg/s and g).
    """
    rate, force = _FACTORS[units]
    columns = dict(readings.columns)
    for prefix, factor in (("angular_velocity_", rate), ("linear_acceleration_", force)):
        for name in [name for name in columns if name.startswith(prefix)]:
            columns[name] = columns[name] * (factor**2 if name.endswith("_var") else factor)
    return replace(readings, columns=columns)
