"""What every segment of one epoch costs, how wrong that may be, and from what."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.cost.labels import AboveStanding, Labels, above_standing, labels
from tcpipe.fusion.trajectory import DISPLACEMENT_LAGS_S
from tcpipe.geometry.piecewise_linear import interpolate, mean_between
from tcpipe.motion.pieces import piece_of_rows, spans_where
from tcpipe.motion.uncertainty import along_std_m, between_durations_m, displacement_std_m
from tcpipe.power.energy import Rule, energy_joule
from tcpipe.power.noise import energy_noise
from tcpipe.power.rails import Rail, power_watt
from tcpipe.power.standing import StandingPower
from tcpipe.tables.arrays import numbers
from tcpipe.tables.bits import DropReason
from tcpipe.tables.columns import floats, integers
from tcpipe.tables.levels import GATED_TRACK, TrackInfo

_DISPLACEMENTS = [c.name for c in GATED_TRACK.columns if c.name.startswith("displacement_std_")]
_BETTER_HZ = 20.0


def segment_costs(
    cut: pa.Table, rows: pa.Table, rails: list[Rail], info: TrackInfo, *, rule: Rule, standing: StandingPower
) -> tuple[Labels, AboveStanding, dict[str, NDArray[np.float64]]]:
    """Return the labels of one epoch's segments, those above standing, and the variances of their energies by cause [J²].

    The causes are those of `tcpipe.cost.budget`.

    Parameters
    ----------
    rows : the gated track's rows of that epoch.
    """
    start_ns, end_ns, stamp_ns = integers(cut, "start_ns"), integers(cut, "end_ns"), integers(rows, "stamp_ns")
    spans = start_ns, end_ns, _still_ns(rows, info.rate_hz)
    noise = energy_noise(rails, *spans)
    better = energy_noise(rails, *spans, rate_hz=_BETTER_HZ)
    ground_mps = np.hypot(floats(rows, "east_velocity_mps"), floats(rows, "north_velocity_mps"))
    end_watt, noise_joule = power_watt(rails, end_ns), noise.std_joule()
    cost = labels(
        chord_m=floats(cut, "chord_m"),
        duration_s=(end_ns - start_ns).astype(np.float64) * 1e-9,
        energy_joule=energy_joule(rails, start_ns, end_ns, rule=rule),
        end_velocity_mps=interpolate(stamp_ns, ground_mps, end_ns),
        end_power_watt=end_watt,
        displacement_std_m=_displacement_std_m(cut, rows, smoothed=info.estimator == "smoother"),
        energy_noise_joule=noise_joule,
    )
    above = above_standing(
        cost,
        standing_watt=standing.watt,
        standing_std_watt=standing.std_watt,
        end_power_watt=end_watt,
        energy_noise_joule=noise_joule,
    )
    position = (end_watt * cost.duration_std_s) ** 2
    causes = {"position": position, "rate": noise.rate, "current": noise.current, "voltage": noise.voltage}
    return cost, above, {**causes, "at_20_hz": position + np.minimum(better.std_joule(), noise_joule) ** 2}


def _displacement_std_m(cut: pa.Table, rows: pa.Table, *, smoothed: bool) -> NDArray[np.float64]:
    """Return the error of each segment's displacement [m], shape (M,): as the smoother tells it, else as the rows' deviations allow."""
    start_ns, end_ns, stamp_ns = integers(cut, "start_ns"), integers(cut, "end_ns"), integers(rows, "stamp_ns")
    duration_s = (end_ns - start_ns).astype(np.float64) * 1e-9
    told_m = np.column_stack([interpolate(stamp_ns, floats(rows, name), start_ns) for name in _DISPLACEMENTS])
    told = between_durations_m(duration_s, told_s=DISPLACEMENT_LAGS_S, told_std_m=told_m)
    start_std_m, end_std_m = (
        along_std_m(
            interpolate(stamp_ns, floats(rows, "x_std_m"), at_ns),
            interpolate(stamp_ns, floats(rows, "y_std_m"), at_ns),
            floats(cut, "course_rad"),
        )
        for at_ns in (start_ns, end_ns)
    )
    modelled = displacement_std_m(
        velocity_std_mps=mean_between(stamp_ns, floats(rows, "forward_velocity_std_mps"), start_ns, end_ns),
        duration_s=duration_s,
        start_std_m=start_std_m,
        end_std_m=end_std_m,
        smoothed=smoothed,
    )
    return np.where(np.isnan(told), modelled, told)


def _still_ns(rows: pa.Table, rate_hz: float) -> NDArray[np.int64]:
    """Return begin and end [ns] of every stretch in which the robot stands, shape (S, 2)."""
    stamp_ns = integers(rows, "stamp_ns")
    piece = piece_of_rows(stamp_ns, integers(rows, "epoch"), period_ns=1e9 / rate_hz)
    standing = (numbers(rows["dropped_by"]) & np.uint32(DropReason.STANDING)) != 0
    return stamp_ns[spans_where(standing, piece)]
