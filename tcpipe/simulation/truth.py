"""The truth: the exact motion and power of a drive, at every step of the simulation, and the true cost of a metre."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import pyarrow as pa

from tcpipe.arrays import AnyArray, Bytes, Floats, Ints
from tcpipe.compiled import compile_kernel
from tcpipe.geometry.rotation import normalize, rpy_from_quat

_COMPONENTS = {
    "enu_m": ("east_m", "north_m", "up_m"),
    "quat_xyzw": ("quat_x", "quat_y", "quat_z", "quat_w"),
    "velocity_enu_mps": ("velocity_east_mps", "velocity_north_mps", "velocity_up_mps"),
    "angular_velocity_radps": ("angular_velocity_x_radps", "angular_velocity_y_radps", "angular_velocity_z_radps"),
}


@dataclass(frozen=True)
class Truth:
    """One drive at 200 Hz; all arrays have one row a step, and base_link is on the ground.

    The local plane is ENU at the site's origin; ``quat_xyzw``: enu_from_base_link; velocities are of base_link.
    """

    stamp_ns: Ints
    x_map_m: Floats
    y_map_m: Floats
    lon_deg: Floats
    lat_deg: Floats
    alt_m: Floats  # above the ellipsoid
    enu_m: Floats
    quat_xyzw: Floats
    velocity_enu_mps: Floats
    angular_velocity_radps: Floats  # in base_link, shape (N, 3)
    forward_velocity_mps: Floats  # along base_link's x, on the surface
    wheel_velocity_mps: Floats
    slip: Floats
    slope_rad: Floats  # along base_link's x, positive uphill
    terrain_class: Bytes
    command_velocity_mps: Floats
    command_yaw_rate_radps: Floats
    voltage_volt: Floats
    current_amp: Floats  # propulsion, both drivers, drawn positive
    right_share: Floats  # of the current, drawn by the right driver
    power_watt: Floats
    energy_joule: Floats  # since the start
    distance_m: Floats  # horizontal way since the start

    def at(self, stamp_ns: Ints) -> Truth:
        """Return the truth at other times, linear between steps; beyond the ends it is held."""
        position = np.interp(stamp_ns, self.stamp_ns, np.arange(self.stamp_ns.size))
        low = np.minimum(position.astype(np.int64), self.stamp_ns.size - 2)
        part = position - low

        def between(values: Floats) -> Floats:
            weight = part if values.ndim == 1 else part[:, None]
            return np.asarray(values[low] + weight * (values[low + 1] - values[low]))

        new = {
            f.name: between(getattr(self, f.name))
            for f in fields(self)
            if f.name not in ("stamp_ns", "terrain_class", "quat_xyzw")
        }
        first, second = self.quat_xyzw[low], self.quat_xyzw[low + 1]
        second = np.where(np.sum(first * second, axis=1, keepdims=True) < 0, -second, second)
        quat = normalize(first + part[:, None] * (second - first))
        return Truth(
            stamp_ns=stamp_ns,
            terrain_class=self.terrain_class[np.round(position).astype(np.int64)],
            quat_xyzw=quat,
            **new,
        )

    def table(self) -> pa.Table:
        """Return one row a step, with a column for each component, and roll, pitch, yaw added."""
        flat = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _COMPONENTS}
        for name, columns in _COMPONENTS.items():
            flat |= dict(zip(columns, getattr(self, name).T, strict=True))
        flat |= dict(zip(("roll_rad", "pitch_rad", "yaw_rad"), rpy_from_quat(self.quat_xyzw).T, strict=True))
        return pa.table({name: np.ascontiguousarray(values) for name, values in flat.items()})

    @classmethod
    def from_table(cls, table: pa.Table) -> Truth:
        """Return the truth that `table` made."""

        def column(name: str) -> AnyArray:
            return np.asarray(table.column(name).to_numpy())

        many = {name: np.stack([column(c) for c in columns], axis=-1) for name, columns in _COMPONENTS.items()}
        return cls(**many, **{f.name: column(f.name) for f in fields(cls) if f.name not in _COMPONENTS})


@dataclass(frozen=True, slots=True)
class TrueCost:
    """The cost of the true metre that begins at given times; NaN where the drive ends before a metre is driven."""

    end_ns: Floats
    duration_s: Floats
    energy_joule: Floats
    power_watt: Floats
    velocity_mps: Floats
    arc_length_m: Floats


def compute_true_cost(truth: Truth, start_ns: Ints, chord_m: float = 1.0) -> TrueCost:
    """Return the cost of the metre that begins at the robot's true position at ``start_ns``, shape (N,).

    It ends at the first crossing of the horizontal distance ``chord_m`` from there, with linear motion within a step.
    """
    seconds = (truth.stamp_ns - truth.stamp_ns[0]) * 1e-9
    start = (np.asarray(start_ns, dtype=np.int64) - truth.stamp_ns[0]) * 1e-9
    end = _find_crossing(seconds, np.ascontiguousarray(truth.enu_m[:, :2]), start, chord_m)
    duration = end - start
    energy = np.interp(end, seconds, truth.energy_joule) - np.interp(start, seconds, truth.energy_joule)
    arc = np.interp(end, seconds, truth.distance_m) - np.interp(start, seconds, truth.distance_m)
    return TrueCost(truth.stamp_ns[0] + end * 1e9, duration, energy, energy / duration, chord_m / duration, arc)


@compile_kernel
def _find_crossing(seconds: Floats, xy_m: Floats, start_s: Floats, chord_m: float) -> Floats:
    """Return when the distance from the place at each start first reaches the chord [s]; NaN if never."""
    end = np.full(start_s.size, np.nan)
    last = seconds.size - 1
    for k in range(start_s.size):
        if not (seconds[0] <= start_s[k] <= seconds[last]):
            continue
        i = min(np.searchsorted(seconds, start_s[k], side="right") - 1, last - 1)
        part = (start_s[k] - seconds[i]) / (seconds[i + 1] - seconds[i])
        x0 = xy_m[i, 0] + part * (xy_m[i + 1, 0] - xy_m[i, 0])
        y0 = xy_m[i, 1] + part * (xy_m[i + 1, 1] - xy_m[i, 1])
        for j in range(i + 1, last + 1):
            bx, by = xy_m[j, 0] - x0, xy_m[j, 1] - y0
            if bx * bx + by * by < chord_m * chord_m:
                continue
            dx, dy = xy_m[j, 0] - xy_m[j - 1, 0], xy_m[j, 1] - xy_m[j - 1, 1]
            ax, ay = bx - dx, by - dy
            a, b, c = dx * dx + dy * dy, ax * dx + ay * dy, ax * ax + ay * ay - chord_m * chord_m
            u = (-b + np.sqrt(b * b - a * c)) / a
            end[k] = seconds[j - 1] + u * (seconds[j] - seconds[j - 1])
            break
    return end
