"""The track's columns beside the pose: what wheels, command and power say at its stamps; and the table of refusals."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.fusion.measurements import BodyVelocities
from tcpipe.fusion.signals import hold_last, in_gap, median_period_ns, seconds
from tcpipe.fusion.trajectory import DISPLACEMENT_LAGS_S, Trajectory
from tcpipe.geometry.datum import geodetic_from_enu
from tcpipe.geometry.rotation import matrix_from_quat, rpy_from_matrix
from tcpipe.power.rails import power_at
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.power_rails import rails_of
from tcpipe.tables.arrays import rows_where
from tcpipe.tables.columns import floats, integers
from tcpipe.tables.levels import REJECTIONS, Streams

Arrays = dict[str, NDArray[np.float64]]


def pose_columns(found: Trajectory, datum_deg_m: tuple[float, float, float] | None) -> Arrays:
    """Return pose, twist and their deviations; longitude, latitude and height are NaN in a local frame."""
    rotation = matrix_from_quat(found.quat_xyzw)
    rpy = rpy_from_matrix(rotation)
    columns = {f"{name}_rad": rpy[:, k] for k, name in enumerate(("roll", "pitch", "yaw"))}
    for k, (axis, name) in enumerate(zip("xyz", ("east", "north", "up"), strict=True)):
        columns[f"{axis}_m"] = found.position_enu_m[:, k]
        columns[f"{axis}_std_m"] = found.position_std_m[:, k]
        columns[f"{name}_velocity_mps"] = found.velocity_enu_mps[:, k]
    unknown = np.full(found.stamp_ns.size, np.nan)
    place = (unknown,) * 3
    if datum_deg_m is not None:
        place = geodetic_from_enu(found.position_enu_m, datum_deg_m=datum_deg_m)
    columns |= dict(zip(("lon_deg", "lat_deg", "alt_m"), place, strict=True))
    columns["forward_velocity_mps"] = np.sum(rotation[:, :, 0] * found.velocity_enu_mps, axis=1)
    columns["yaw_rate_radps"] = found.angular_velocity_radps[:, 2]
    columns["yaw_std_rad"] = found.yaw_std_rad
    columns["forward_velocity_std_mps"] = found.forward_velocity_std_mps
    for k, lag_s in enumerate(DISPLACEMENT_LAGS_S):
        name = f"{lag_s:.0f}s" if lag_s >= 1 else f"{1e3 * lag_s:.0f}ms"
        columns[f"displacement_std_{name}_m"] = found.displacement_std_m[:, k]
    return columns


def wheel_column(wheels: BodyVelocities | None, at_ns: NDArray[np.int64], *, max_gap_ns: int) -> NDArray[np.float64]:
    """Return the wheels' forward velocity, interpolated; NaN in gaps."""
    if wheels is None:
        return np.full(at_ns.size, np.nan)
    zero = int(wheels.stamp_ns[0])
    between = np.interp(seconds(at_ns, zero), seconds(wheels.stamp_ns, zero), wheels.velocity_mps[:, 0])
    longest = max(max_gap_ns, 3 * median_period_ns(wheels.stamp_ns))
    return np.where(in_gap(wheels.stamp_ns, at_ns, at_ns, longest_ns=longest), np.nan, between)


def command_columns(streams: Streams, epoch: int, at_ns: NDArray[np.int64]) -> Arrays:
    """Return the last command at each stamp; NaN before the first and without commands."""
    table = streams.tables.get("command")
    names = {"commanded_velocity_mps": "forward_velocity_mps", "commanded_yaw_rate_radps": "yaw_rate_radps"}
    if table is None:
        return {name: np.full(at_ns.size, np.nan) for name in names}
    table = rows_where(table, "epoch", epoch)
    stamp_ns = integers(table, "stamp_ns")
    return {name: hold_last(stamp_ns, floats(table, source), at_ns) for name, source in names.items()}


def power_columns(streams: Streams, epoch: int, at_ns: NDArray[np.int64], *, max_gap_ns: int) -> Arrays:
    """Return voltage, current and power at each stamp; NaN in power gaps and without power."""
    values = power_at(rails_of(streams, epoch), at_ns, max_gap_ns=max_gap_ns)
    return dict(zip(("voltage_volt", "current_amp", "power_watt"), values, strict=True))


def rejections_table(inputs: FusionInputs, found: list[Trajectory]) -> pa.Table:
    """Return every refused measurement in order of time: by the gate, and those without a usable value."""
    parts = [trajectory.rejections for trajectory in found]
    invalid = [(role, np.concatenate(stamps)) for role, stamps in sorted(inputs.invalid_ns.items())]
    size = sum(stamps.size for _, stamps in invalid)
    unknown = np.full(size, np.nan)
    columns = {
        "stamp_ns": [p.stamp_ns for p in parts] + [stamps for _, stamps in invalid],
        "role": [p.role for p in parts] + [np.full(stamps.size, role) for role, stamps in invalid],
        "reason": [p.reason for p in parts] + [np.full(size, "invalid")],
        "normalized_innovation_squared": [p.normalized_innovation_squared for p in parts] + [unknown],
        "threshold": [p.threshold for p in parts] + [unknown],
    }
    joined = {name: np.concatenate(values) for name, values in columns.items()}
    order = np.lexsort((joined["role"], joined["stamp_ns"]))
    return REJECTIONS.table(**{name: values[order] for name, values in joined.items()})
