"""What is one error of all segments of a run (gain and zero of the power sensor, the scale of a lone odometry), and what confirms them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.cost.labels import SensorError
from tcpipe.fusion.measurements import GNSS, VISUAL, WHEELS
from tcpipe.motion.uncertainty import find_common_scale_std
from tcpipe.power.rails import Rail, Rule, integrate_energy
from tcpipe.recipe import LabelConfig
from tcpipe.robots import GAIN_STD_FRACTION, OFFSET_STD_AMP
from tcpipe.tables.arrays import select_rows
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.facts import PowerSign, StageFacts
from tcpipe.tables.levels import Streams

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PowerPrior:
    """Standard deviations of a power sensor's gain, as a fraction, and of the zero of each rail's current [A]."""

    gain_fraction: float
    offset_amp: float


def find_power_prior(power: PowerSign | None, config: LabelConfig) -> PowerPrior:
    """Return what is known of the power sensor: by the recipe, else by the kind of source."""
    gain = config.power_gain_std_fraction, power.gain_std_fraction if power else None, GAIN_STD_FRACTION
    offset = config.power_offset_std_amp, power.offset_std_amp if power else None, OFFSET_STD_AMP
    return PowerPrior(*(next(value for value in values if value is not None) for values in (gain, offset)))


def make_sensor_error(cut: pa.Table, rails: list[Rail], prior: PowerPrior, *, rule: Rule) -> SensorError:
    """Return what the power sensor's errors change of one epoch's segments: the zeros of several rails are independent, gains are not."""
    spans = to_integers(cut, "start_ns"), to_integers(cut, "end_ns")
    offsets = [
        integrate_energy(
            [replace(rail, current_amp=np.full_like(rail.current_amp, prior.offset_amp))], *spans, rule=rule
        )
        for rail in rails
    ]
    return SensorError(prior.gain_fraction, np.linalg.norm(offsets, axis=0) if offsets else np.nan)


def compute_common_displacement_std_m(cut: pa.Table, facts: StageFacts) -> Floats:
    """Return the part of each segment's displacement error that its section has in common [m], shape (M,)."""
    scale_std = find_common_scale_std(facts.fuse, to_integers(cut, "start_ns"), to_integers(cut, "clock_epoch"))
    return scale_std * to_floats(cut, "chord_m")


_MOTION = {GNSS: ("gnss", "pose"), WHEELS: ("wheel_odometry",), VISUAL: ("visual_odometry",)}
"""Tables of each independent sensor of motion."""


def count_confirming_sensors(cut: pa.Table, streams: Streams, facts: StageFacts) -> NDArray[np.int32]:
    """Return how many sensors measured motion in each segment of one epoch, were fused, and do not disagree with the track, shape (M,)."""
    start_ns, end_ns = to_integers(cut, "start_ns"), to_integers(cut, "end_ns")
    epoch = int(to_integers(cut, "clock_epoch")[0])
    count = np.zeros(cut.num_rows, dtype=np.int32)
    for sensor, tables in _MOTION.items():
        stamps = [
            to_integers(select_rows(streams.tables[name], "clock_epoch", epoch), "stamp_ns")
            for name in tables
            if name in streams.tables
        ]
        stamp_ns = np.sort(np.concatenate([*stamps, np.empty(0, np.int64)]))
        confirms = np.searchsorted(stamp_ns, end_ns, side="right") > np.searchsorted(stamp_ns, start_ns, side="left")
        fused = [
            (section.start_ns, section.end_ns)
            for section in (facts.fuse.stretches if facts.fuse else ())
            if section.clock_epoch == epoch and sensor in section.sensors
        ]
        disputed = [
            (span.start_ns, span.end_ns)
            for span in (facts.audit.disagreements if facts.audit else ())
            if span.clock_epoch == epoch and span.sensor == sensor and span.what != "turn"
        ]
        count += confirms & _touches(fused, start_ns, end_ns) & ~_touches(disputed, start_ns, end_ns)
    return count


def _touches(spans: list[tuple[int, int]], start_ns: NDArray[np.int64], end_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the segments that touch any of the spans, shape (M,)."""
    touched = np.zeros(len(start_ns), dtype=np.bool_)
    for first_ns, last_ns in spans:
        touched |= (start_ns <= last_ns) & (end_ns >= first_ns)
    return touched
