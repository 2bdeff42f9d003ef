"""Tracks written down by formula: the stages' input without any log or filter."""

import numpy as np
import pyarrow as pa

from tcpipe.tables.levels import POWER, REJECTIONS, TRACK, Datum, Streams, Track, TrackInfo

ZERO_NS = 1_700_000_000_000_000_000
STEP_NS = 50_000_000


def stamps(count, *, step_ns=STEP_NS, start_ns=ZERO_NS):
    return start_ns + np.arange(count, dtype=np.int64) * step_ns


def make_track(
    position_m,
    velocity_mps,
    *,
    stamp_ns=None,
    clock_epoch=None,
    forward_mps=None,
    yaw_rate_radps=None,
    wheel_mps=None,
    commanded_mps=None,
    power_watt=None,
    std_m=0.01,
    velocity_std_mps=0.004,
    datum=None,
    estimator="smoother",
):
    """Return a track of rows at 20 Hz; position and velocity (N, 3) in ENU, forward velocity by default the length of the velocity."""
    n = len(position_m)
    nothing = np.full(n, np.nan)
    forward = np.linalg.norm(velocity_mps, axis=1) if forward_mps is None else forward_mps
    table = TRACK.table(
        stamp_ns=stamps(n) if stamp_ns is None else stamp_ns,
        clock_epoch=np.zeros(n, dtype=np.int16) if clock_epoch is None else clock_epoch,
        **{f"{axis}_m": position_m[:, i] for i, axis in enumerate("xyz")},
        lon_deg=nothing,
        lat_deg=nothing,
        alt_m=nothing,
        roll_rad=np.zeros(n),
        pitch_rad=np.zeros(n),
        yaw_rad=np.arctan2(velocity_mps[:, 1], velocity_mps[:, 0]),
        **{f"{name}_velocity_mps": velocity_mps[:, i] for i, name in enumerate(("east", "north", "up"))},
        forward_velocity_mps=forward,
        yaw_rate_radps=np.zeros(n) if yaw_rate_radps is None else yaw_rate_radps,
        **{f"{axis}_std_m": np.broadcast_to(np.asarray(std_m, float), n) for axis in "xyz"},
        yaw_std_rad=np.full(n, 0.01),
        forward_velocity_std_mps=np.broadcast_to(np.asarray(velocity_std_mps, float), n),
        **{f"displacement_std_{lag}_m": nothing for lag in ("500ms", "1s", "2s", "4s", "8s", "16s")},
        wheel_velocity_mps=nothing if wheel_mps is None else wheel_mps,
        commanded_velocity_mps=nothing if commanded_mps is None else commanded_mps,
        commanded_yaw_rate_radps=nothing,
        voltage_volt=nothing,
        current_amp=nothing,
        power_watt=nothing if power_watt is None else power_watt,
    )
    info = TrackInfo("run-0123abcd", "husky", datum, 20.0, estimator)
    return Track(table, REJECTIONS.empty(), info)


def with_columns(table, **values):
    """Return a table with other values in some of its columns."""
    for name, of in values.items():
        field = table.schema.field(name)
        table = table.set_column(table.schema.get_field_index(name), field, pa.array(np.asarray(of), field.type))
    return table


def straight_track(speed_mps, *, course_rad=0.0, slope_rad=0.0, **options):
    """Return a track along one line; ``speed_mps`` (N,) is the speed along the slope at each row, integrated exactly as a straight line."""
    along = np.concatenate(([0.0], np.cumsum(0.5 * (speed_mps[1:] + speed_mps[:-1]) * STEP_NS * 1e-9)))
    direction = np.array(
        [np.cos(course_rad) * np.cos(slope_rad), np.sin(course_rad) * np.cos(slope_rad), np.sin(slope_rad)]
    )
    options.setdefault("forward_mps", speed_mps)
    return make_track(along[:, None] * direction, speed_mps[:, None] * direction, **options)


def power_streams(rails, *, averaged=False, clock_epoch=0, sensors=None, robot="husky"):
    """Return streams with power alone; ``rails`` maps a name to (stamp_ns, volt, amp), NaN where a row lacks one."""
    parts = [
        (name, np.asarray(stamp), np.asarray(volt, float), np.asarray(amp, float))
        for name, (stamp, volt, amp) in rails.items()
    ]
    stamp_ns = np.concatenate([part[1] for part in parts])
    table = POWER.table(
        stamp_ns=stamp_ns,
        log_time_ns=stamp_ns,
        clock_epoch=np.full(len(stamp_ns), clock_epoch, dtype=np.int16),
        rail=[name for name, stamp, _, _ in parts for _ in stamp],
        voltage_volt=np.concatenate([part[2] for part in parts]),
        current_amp=np.concatenate([part[3] for part in parts]),
    )
    return Streams({"power": table}, sensors or {}, robot, power_averaged=averaged)


GRAZ = Datum(15.46, 47.07, 420.0)
