"""Readings as the fusion needs them: an IMU in SI units, an odometry at the scale of the recipe, a velocity over ground."""

from __future__ import annotations

from dataclasses import replace
from math import pi

from tcpipe.logs.extrinsics import is_base
from tcpipe.logs.messages import GNSS_VELOCITY, Readings
from tcpipe.recipe.suggestions import suggest
from tcpipe.tables.findings import make_finding

STANDARD_GRAVITY_MPS2 = 9.80665

_FACTORS = {
    "si": (1.0, 1.0),
    "deg": (pi / 180.0, 1.0),
    "g": (1.0, STANDARD_GRAVITY_MPS2),
    "deg_g": (pi / 180.0, STANDARD_GRAVITY_MPS2),
}


def convert_imu_to_si(readings: Readings, units: str) -> Readings:
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


_LENGTHS = {"velocity_": 1, "velocity_var_": 2, "x_m": 1, "y_m": 1, "z_m": 1}
"""Columns of an odometry, or how they begin, that hold lengths, and to which power."""


def scale_odometry(readings: Readings, factor: float) -> Readings:
    """Return an odometry's readings with all lengths times ``factor``, variances included; turns stay."""
    columns = dict(readings.columns)
    for name, values in readings.columns.items():
        powers = [power for prefix, power in _LENGTHS.items() if name.startswith(prefix)]
        if powers:
            columns[name] = values * factor ** max(powers)
    return replace(readings, columns=columns)


def select_ground_velocity(readings: Readings, frame: str, topic: str) -> Readings:
    """Return a receiver's velocities, none with a finding where their frame is the body's: whose axes they have is not known."""
    if not is_base(frame):
        return readings
    remedies = suggest("use", {"read.topics": {"gnss_velocity": [topic]}})
    found = make_finding("velocity-not-over-ground", GNSS_VELOCITY, names={"frame": frame}, remedies=remedies)
    none = slice(0, 0)
    return replace(
        readings,
        row=readings.row[none],
        log_time_ns=readings.log_time_ns[none],
        header_ns=None if readings.header_ns is None else readings.header_ns[none],
        columns={name: values[none] for name, values in readings.columns.items()},
        findings=(*readings.findings, found),
    )
