"""Which quality bits a labelled segment carries: what a user may want to know of it."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.cost.quality import low_power_rate, near, slipping, voltage_outside
from tcpipe.fusion.measurements import GNSS
from tcpipe.geometry.piecewise_linear import interpolate, mean_between
from tcpipe.motion.pieces import piece_of_rows
from tcpipe.power.rails import Rail
from tcpipe.tables.arrays import numbers
from tcpipe.tables.bits import DropReason, Quality
from tcpipe.tables.columns import floats, integers
from tcpipe.tables.levels import Streams, TrackInfo

Flags = dict[Quality, NDArray[np.bool_]]


def power_flags(cut: pa.Table, rails: list[Rail], *, range_volt: tuple[float, float] | None) -> Flags:
    """Return the flags that the power samples of one epoch give its segments.

    Parameters
    ----------
    range_volt : [V], of the robot's profile; None flags nothing.
    """
    spans = integers(cut, "start_ns"), integers(cut, "end_ns")
    return {
        Quality.LOW_POWER_RATE: np.full(cut.num_rows, low_power_rate(rails)),
        Quality.VOLTAGE_OUT_OF_RANGE: voltage_outside(rails, *spans, range_volt=range_volt),
    }


def motion_flags(
    cut: pa.Table, rows: pa.Table, info: TrackInfo, *, arc_to_chord: float, max_position_std_m: float
) -> Flags:
    """Return the flags that the gated rows of one epoch give its segments.

    Parameters
    ----------
    info : the gated track's; it knows which command is full speed.
    arc_to_chord : a segment more curved than this is flagged.
    max_position_std_m : [m], a segment with an end less certain than this is flagged.
    """
    stamp_ns, start_ns, end_ns = integers(rows, "stamp_ns"), integers(cut, "start_ns"), integers(cut, "end_ns")
    chord_m = floats(cut, "chord_m")
    wheel_mps = mean_between(stamp_ns, floats(rows, "wheel_velocity_mps"), start_ns, end_ns)
    driven_m = np.concatenate(([0.0], np.cumsum(np.hypot(*(np.diff(floats(rows, f"{axis}_m")) for axis in "xy")))))
    start_m, end_m = (interpolate(stamp_ns, driven_m, at_ns) for at_ns in (start_ns, end_ns))
    gate, commanded_mps = info.report.facts.gate, floats(cut, "commanded_velocity_mps")
    full_speed_mps = gate.full_speed_mps if gate else None
    return {
        Quality.NEAR_GAP: near(driven_m[_gap_edges(rows, info.rate_hz)], start_m, end_m, within_m=float(chord_m[0])),
        Quality.HIGH_SLIP: slipping(wheel_mps, floats(cut, "fused_velocity_mps")),
        Quality.WEAK_GNSS: floats(cut, "position_std_m") > max_position_std_m,
        Quality.CURVED: floats(cut, "arc_length_m") > arc_to_chord * chord_m,
        Quality.NO_COMMAND: np.isnan(commanded_mps),
        Quality.NOT_AT_LIMIT: np.abs(commanded_mps) < (full_speed_mps or 0.0),
        Quality.SENSORS_DISAGREE: _disputed(cut, info),
    }


def _disputed(cut: pa.Table, info: TrackInfo) -> NDArray[np.bool_]:
    """Return the segments of one epoch that touch a time in which a sensor disagrees with the track undecided, or fixes were off it."""
    start_ns, end_ns, epoch = integers(cut, "start_ns"), integers(cut, "end_ns"), integers(cut, "epoch")
    facts = info.report.facts
    times = [(e.epoch, e.start_ns, e.end_ns) for e in (facts.audit.disagreements if facts.audit else ()) if not e.alone]
    for stretch in facts.fuse.stretches if facts.fuse else ():
        times += [(stretch.epoch, r.start_ns, r.end_ns) for r in stretch.reopenings if r.role == GNSS]
    disputed = np.zeros(cut.num_rows, dtype=np.bool_)
    for of_epoch, first_ns, last_ns in times:
        disputed |= (epoch == of_epoch) & (start_ns <= last_ns) & (end_ns >= first_ns)
    return disputed


def _gap_edges(rows: pa.Table, rate_hz: float) -> NDArray[np.bool_]:
    """Return the rows that are in a gap, or beside a hole."""
    piece = piece_of_rows(integers(rows, "stamp_ns"), integers(rows, "epoch"), period_ns=1e9 / rate_hz)
    hole = np.diff(piece) != 0
    edge: NDArray[np.bool_] = (numbers(rows["dropped_by"]) & np.uint32(DropReason.GAP)) != 0
    edge[:-1] |= hole
    edge[1:] |= hole
    return edge


def clock_doubtful(streams: Streams, info: TrackInfo) -> bool:
    """Return whether a clock of the run stepped or is noted as off, or motion or power had to be stamped with the time of the recorder.

    What an IMU's little offset costs is in the positions' deviations.
    Commands are left out: they mostly have no stamp of their own, and a label does not depend on theirs.
    """
    recorder = any(s.time_source == "log" for role, s in streams.sensors.items() if role != "command")
    clocks = info.report.facts.clock_offsets
    off = clocks is not None and any(
        (offset.noted or offset.drifts) and not (role == "imu" and clocks.heading_offset_s)
        for role, offset in clocks.offsets.items()
    )
    return recorder or off or streams.report.facts.epochs > 1
