"""Odometry whose metre is not one: wheels of another radius than the driver thinks, a camera of another baseline."""

from __future__ import annotations

from dataclasses import replace

from tcpipe.logs.messages import Readings

_LENGTHS = {"velocity_": 1, "velocity_var_": 2, "x_m": 1, "y_m": 1, "z_m": 1}
"""Columns of an odometry, or how they begin, that hold lengths, and to which power."""


def scaled(readings: Readings, factor: float) -> Readings:
    """Return an odometry's readings with all lengths times ``factor``, variances included; turns stay."""
    columns = dict(readings.columns)
    for name, values in readings.columns.items():
        powers = [power for prefix, power in _LENGTHS.items() if name.startswith(prefix)]
        if powers:
            columns[name] = values * factor ** max(powers)
    return replace(readings, columns=columns)
