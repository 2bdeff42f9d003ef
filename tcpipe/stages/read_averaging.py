"""Whether power is averaged over its messages' period: what its type knows, what the recipe says, or what the motion tells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.power.averaging import told_averaged
from tcpipe.power.readings import PowerReadings
from tcpipe.recipe import ReadConfig
from tcpipe.recipe.suggestions import suggest
from tcpipe.tables.arrays import rows_where
from tcpipe.tables.catalogue import Severity, threshold
from tcpipe.tables.columns import floats, integers
from tcpipe.tables.findings import Finding, Subject, make_finding


def with_averaging(
    power: PowerReadings, streams: Mapping[str, pa.Table], config: ReadConfig
) -> tuple[PowerReadings, tuple[Finding, ...]]:
    """Return the power with whether its values are means over their period, and the finding where that is assumed."""
    counts = any(rail.counter is not None for rails in power.rails.values() for rail in rails)
    if config.power_averaged != "auto" and not counts:
        return replace(power, averaged=config.power_averaged == "yes"), ()
    if not power.averaging_unknown or "power" not in streams:
        return power, ()
    table = rows_where(streams["power"], "epoch", 0)
    rail = rows_where(table, "rail", table["rail"][0].as_py())
    power_ns, watt = _power_at_current(rail)
    period_s = float(np.median(np.diff(power_ns))) / 1e9 if len(power_ns) > 1 else np.inf
    if period_s < threshold(_ASSUMED, "min_period_s"):
        return power, ()
    motion = next((streams[role] for role in ("wheel_odometry", "visual_odometry") if role in streams), None)
    told = None if motion is None else _by_motion(power_ns, watt, rows_where(motion, "epoch", 0))
    averaged = power.averaged if told is None else told
    power = replace(power, averaged=averaged)
    if told is None and period_s < threshold(_ASSUMED, "min_unobserved_period_s"):
        return power, ()
    severity: Severity | None = "warning" if told is None else None
    names = {"value": "mean" if averaged else "sample", "evidence": "nothing" if told is None else "motion"}
    remedies = [of for value in ("yes", "no") for of in suggest(value, {"read": {"power_averaged": value}})]
    power_role = Subject("role", "power")
    found = make_finding(_ASSUMED, power_role, severity=severity, names=names, remedies=remedies, period_s=period_s)
    return power, (found,)


_ASSUMED = "power-averaging-assumed"


def _power_at_current(rail: pa.Table) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the stamps [ns] of a rail's currents and its power there [W]: its voltage may come at other times."""
    stamp_ns, voltage, current = integers(rail, "stamp_ns"), floats(rail, "voltage_volt"), floats(rail, "current_amp")
    at_ns = (stamp_ns - stamp_ns[0]).astype(np.float64)
    of_voltage, of_current = np.isfinite(voltage), np.isfinite(current)
    if not of_voltage.any():
        return stamp_ns[:0], current[:0]
    return stamp_ns[of_current], current[of_current] * np.interp(
        at_ns[of_current], at_ns[of_voltage], voltage[of_voltage]
    )


def _by_motion(power_ns: NDArray[np.int64], watt: NDArray[np.float64], motion: pa.Table) -> bool | None:
    twist = np.column_stack([floats(motion, name) for name in ("velocity_x_mps", "angular_velocity_z_radps")])
    moving = np.isfinite(twist).all(axis=1)
    return told_averaged(power_ns, watt, integers(motion, "stamp_ns")[moving], *twist[moving].T)
