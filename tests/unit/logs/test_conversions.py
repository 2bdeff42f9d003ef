"""Inertial readings in other units become SI, variances with their squares."""

import numpy as np
import pytest

from tcpipe.logs.messages import Readings, convert_imu_to_si

NAMES = (
    "angular_velocity_z_radps",
    "angular_velocity_var",
    "linear_acceleration_x_mps2",
    "linear_acceleration_var",
    "quat_w",
)


@pytest.mark.parametrize(
    ("units", "wanted"),
    [
        ("si", (1.0, 1.0, 1.0, 1.0, 1.0)),
        ("deg", (0.0174532925, 0.000304617419, 1.0, 1.0, 1.0)),
        ("g", (1.0, 1.0, 9.80665, 96.1703842, 1.0)),
        ("deg_g", (0.0174532925, 0.000304617419, 9.80665, 96.1703842, 1.0)),
    ],
)
def test_units(units, wanted):
    row = np.arange(2)
    readings = Readings(row, row, None, {name: np.ones(2) for name in NAMES})
    found = convert_imu_to_si(readings, units)
    assert [found.columns[name][1] for name in NAMES] == pytest.approx(wanted)
    assert found.row is row
