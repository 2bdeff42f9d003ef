"""Withhold a sensor in windows, fuse the rest, and compare the track with what was withheld."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import FusionError
from tcpipe.fusion.measurements import DOPPLER, FIXES, GNSS, VISUAL, WHEELS, BodyVelocities, Measurements, Positions
from tcpipe.fusion.withheld import (
    CHORDS_S,
    END_S,
    LEAST_WINDOW_M,
    Comparison,
    TrackRows,
    compare_chords,
    compare_fixes,
    integrate_between,
    place_windows,
)
from tcpipe.geometry.datum import enu_from_geodetic, geodetic_from_enu
from tcpipe.progress import step
from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse import fuse_run
from tcpipe.stages.fuse_inputs import FusionInputs, find_longest_epoch, prepare_inputs, prepare_pose
from tcpipe.tables.arrays import number_column, select_rows
from tcpipe.tables.columns import FloatColumns, to_integers
from tcpipe.tables.levels import Streams, Track

Ints = NDArray[np.int64]

WINDOWS_S = (10.0, 30.0, 60.0)
"""Lengths of the windows without a sensor [s]."""


@dataclass(frozen=True, slots=True)
class WithheldComparisons:
    """Every comparison of a run; why others are missing; without fixes the track's length over that of each odometry."""

    comparisons: tuple[Comparison, ...]
    skipped: tuple[tuple[str, str], ...]
    """Role and reason."""
    length_ratios: dict[str, float]


@dataclass(frozen=True, slots=True)
class _Run:
    """A run, its measurements, and the clock epoch that is judged."""

    run_id: str
    streams: Streams
    config: FuseConfig
    inputs: FusionInputs
    epoch: int

    @property
    def measurements(self) -> Measurements:
        return self.inputs.measurements[self.epoch]

    def fuse(self, streams: Streams) -> Track:
        return fuse_run(streams, self.config, run_id=self.run_id)


def compare_withheld(streams: Streams, config: FuseConfig, *, run_id: str) -> WithheldComparisons:
    """Withhold fixes, wheels and camera in turn in windows of each length, and compare them with the track of the rest.

    All windows of a length are withheld together, so that a sensor and a length cost one fusion.

    Raises `FusionError`: no sensor measures motion.
    """
    streams, _ = prepare_pose(streams)
    inputs = prepare_inputs(streams, config)
    if not inputs.measurements:
        raise FusionError(f"{run_id}: no sensor measures motion")
    run = _Run(run_id, streams, config, inputs, find_longest_epoch(inputs))
    comparisons, skipped = list[Comparison](), list[tuple[str, str]]()
    motion = [role for role in (GNSS, WHEELS, VISUAL) if role in run.measurements.sensors()]
    if len(motion) == 1:
        skipped.append((motion[0], "no other sensor measures motion"))
    for role in motion if len(motion) > 1 else ():
        stamp_ns = run.measurements.sensors()[role].stamp_ns
        span_s = float(stamp_ns[-1] - stamp_ns[0]) * 1e-9
        for length_s in WINDOWS_S:
            windows_ns = int(stamp_ns[0]) + np.round(place_windows(span_s, length_s) * 1e9).astype(np.int64)
            if not windows_ns.size:
                needed_s = length_s + 2.0 * END_S
                skipped.append((role, f"{length_s:.0f} s: covers {span_s:.0f} s, {needed_s:.0f} s are needed"))
                break
            try:
                comparisons += _compare_role(run, role, length_s, windows_ns)
            except FusionError as error:
                skipped.append((role, f"{length_s:.0f} s: {error.problems[0]}"))
    ratios = {} if GNSS in motion else _compare_lengths(run)
    return WithheldComparisons(tuple(comparisons), tuple(skipped), ratios)


_OTHER_ARM = {"lever-arm-unknown", "lever-arm-contradicted"}
"""Findings of an antenna that is elsewhere than stated."""


def _compare_role(run: _Run, role: str, length_s: float, windows_ns: Ints) -> Iterator[Comparison]:
    step(f"fusing without {role} for {len(windows_ns)} x {length_s:.0f} s")
    track = run.fuse(withhold(run.streams, role, run.epoch, windows_ns))
    facts = track.info.report.facts
    if role == GNSS and facts.sensor_checks is not None and not facts.sensor_checks.excluded.keys().isdisjoint(FIXES):
        raise FusionError("tcpipe excludes the other fixes of the run")
    rows = _select_rows(track, run.epoch)
    moving = np.array([rows.measure_length_m(*window) >= LEAST_WINDOW_M for window in windows_ns])
    if not moving.any():
        raise FusionError("the rest has no track in the windows, or the robot is stationary there")
    numbers, sensor = np.flatnonzero(moving), run.measurements.sensors()[role]
    if isinstance(sensor, Positions):
        sensor = _move_origin(sensor, run.inputs, track)
        arm_m, arm_std_m = np.asarray(run.streams.sensors[GNSS].xyz_m), np.zeros(3)
        if facts.fuse and any(finding.code in _OTHER_ARM for finding in track.info.report.findings):
            arm = facts.fuse.longest.parameters["antenna"]
            arm_m, arm_std_m = arm_m + arm.value, np.asarray(arm.std)
        yield compare_fixes(sensor, rows, windows_ns, numbers, arm_m=arm_m, arm_std_m=arm_std_m, window_s=length_s)
    elif isinstance(sensor, BodyVelocities):
        for chord_s in CHORDS_S:
            found = compare_chords(role, sensor, rows, windows_ns, numbers, chord_s=chord_s, window_s=length_s)
            if found.window.size:
                yield found


def withhold(streams: Streams, role: str, epoch: int, windows_ns: Ints) -> Streams:
    """Return the streams without a sensor in windows [ns], shape (N, 2), of a clock epoch; a receiver loses its velocity with its fixes."""

    def keep(table: pa.Table) -> pa.Table:
        stamp_ns = to_integers(table, "stamp_ns")
        inside = np.searchsorted(windows_ns[:, 0], stamp_ns, "right") > np.searchsorted(windows_ns[:, 1], stamp_ns)
        return table.filter(number_column(~(inside & (to_integers(table, "clock_epoch") == epoch))))

    without = (*FIXES, DOPPLER) if role == GNSS else (role,)
    return replace(
        streams, tables={name: keep(table) if name in without else table for name, table in streams.tables.items()}
    )


def _move_origin(fixes: Positions, inputs: FusionInputs, track: Track) -> Positions:
    """Return the fixes in the track's own plane: its origin is the first fixes, of which some may be withheld."""
    datum = track.info.datum
    if datum is None or inputs.datum_deg_m is None:
        raise FusionError("the track of the rest has only local coordinates")
    places = geodetic_from_enu(fixes.position_enu_m, datum_deg_m=inputs.datum_deg_m)
    moved = enu_from_geodetic(*places, datum_deg_m=(datum.lon_deg, datum.lat_deg, datum.alt_m))
    return replace(fixes, position_enu_m=moved)


def _compare_lengths(run: _Run) -> dict[str, float]:
    """Return the horizontal length of the track over the distance that each odometry measures, by role."""
    rows = _select_rows(run.fuse(run.streams), run.epoch)
    if rows.stamp_ns.size == 0:
        return {}
    length_m = rows.measure_length_m(int(rows.stamp_ns[0]), int(rows.stamp_ns[-1]) + 1)
    ratios = {}
    for role, odometry in run.measurements.odometries().items():
        speed = np.abs(odometry.velocity_mps[:, 0])
        odometer_m = float(integrate_between(odometry.stamp_ns, speed, rows.stamp_ns[:1], rows.stamp_ns[-1:])[0])
        if odometer_m > LEAST_WINDOW_M:
            ratios[role] = length_m / odometer_m
    return ratios


def _select_rows(track: Track, epoch: int) -> TrackRows:
    table = select_rows(track.table, "clock_epoch", epoch)
    return TrackRows(to_integers(table, "stamp_ns"), FloatColumns(table), track.info.rate_hz)
