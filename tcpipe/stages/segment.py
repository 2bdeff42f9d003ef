"""MaskedTrack to Segments: cut every steady section by chord, and account for every metre of the track."""

from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from tcpipe.geometry.datum import geodetic_from_enu
from tcpipe.geometry.piecewise_linear import interpolate, mean_between
from tcpipe.geometry.polyline import Polyline, fit_polyline
from tcpipe.motion.distance_breakdown import (
    compute_interval_duration_s,
    compute_interval_length_m,
    find_interval_reason,
    find_kept_spans,
    find_losses,
    sum_by_reason,
)
from tcpipe.motion.row_sections import number_pieces
from tcpipe.path import Cut, cut_by_chord
from tcpipe.recipe import SegmentConfig
from tcpipe.tables.bits import DropReason, Loss, flag_name
from tcpipe.tables.columns import stack_floats, to_floats, to_integers, to_numbers
from tcpipe.tables.facts import SegmentFacts
from tcpipe.tables.findings import Finding, Subject, make_finding, read_threshold
from tcpipe.tables.levels import SEGMENTS, MaskedTrack, Segments, TrackInfo, add_findings

ENTRIES = ("kept", *(flag_name(bit) for bit in (*DropReason, Loss.CURVED, Loss.LEFTOVER)))
"""Names of the entries of the distance breakdown, in order."""


def segment_track(masked: MaskedTrack, config: SegmentConfig) -> Segments:
    """Return the segments of the track's steady sections, and the distance breakdown, whose sum is the odometer."""
    table, info = masked.table, masked.info
    stamp_ns, epoch = to_integers(table, "stamp_ns"), to_integers(table, "clock_epoch")
    position_m = stack_floats(table, "x_m", "y_m", "z_m")
    velocity_mps = stack_floats(table, "east_velocity_mps", "north_velocity_mps", "up_velocity_mps")
    piece = number_pieces(stamp_ns, epoch, period_ns=1e9 / info.rate_hz)
    dropped_by = to_numbers(table["dropped_by"])
    reason = find_interval_reason(dropped_by, piece)
    metres = dict.fromkeys(ENTRIES, 0.0) | sum_by_reason(
        reason, compute_interval_length_m(stamp_ns, position_m, velocity_mps, piece)
    )
    seconds = dict.fromkeys(ENTRIES, 0.0) | sum_by_reason(reason, compute_interval_duration_s(stamp_ns, epoch))
    tables = [SEGMENTS.empty()]
    spans = find_kept_spans(dropped_by, piece)
    for first, last in spans:
        rows = slice(first, last + 1)
        path = fit_polyline(stamp_ns[rows], position_m[rows], velocity_mps[rows])
        cut = cut_by_chord(path, chord_m=config.chord_m, max_arc_to_chord=config.max_arc_to_chord)
        for entry, (length_m, duration_s) in cut.ledger(path).items():
            metres[entry] += length_m
            seconds[entry] += duration_s
        if len(cut.start_ns):
            tables.append(_make_segments(table.slice(first, last + 1 - first), path, cut, info))
    segments = pa.concat_tables(tables).combine_chunks()
    facts = SegmentFacts(segments.num_rows, len(spans), odometer_m=sum(metres.values()), duration_by_reason_s=seconds)
    findings = [] if segments.num_rows else [_make_no_segments(metres, info.run_id)]
    findings += find_losses(metres, Subject("run", info.run_id))
    return Segments(segments, add_findings(info, findings, replace(info.report.facts, segment=facts)), metres)


def _make_segments(rows: pa.Table, path: Polyline, cut: Cut, info: TrackInfo) -> pa.Table:
    """Return the segments of one section."""
    start_m, end_m = path.position_at(cut.start_ns), path.position_at(cut.end_ns)
    step_m, count = end_m - start_m, len(cut.start_ns)
    columns: dict[str, Any] = {
        "segment_id": [f"{info.run_id}-{stamp}" for stamp in cut.start_ns],
        "run_id": [info.run_id] * count,
        "robot": [info.robot] * count,
        "clock_epoch": np.full(count, to_integers(rows, "clock_epoch")[0]),
        "start_ns": cut.start_ns,
        "end_ns": cut.end_ns,
        "chord_m": np.hypot(step_m[:, 0], step_m[:, 1]),
        "arc_length_m": path.length_at(cut.end_ns) - path.length_at(cut.start_ns),
        "course_rad": np.arctan2(step_m[:, 1], step_m[:, 0]),
    }
    for end, position_m in (("start", start_m), ("end", end_m)):
        columns |= {f"{end}_{axis}_m": position_m[:, i] for i, axis in enumerate("xyz")}
        lon, lat = np.full((2, len(position_m)), np.nan)
        if info.datum is not None:
            lon, lat, _ = geodetic_from_enu(
                position_m, datum_deg_m=(info.datum.lon_deg, info.datum.lat_deg, info.datum.alt_m)
            )
        columns |= {f"{end}_lon_deg": lon, f"{end}_lat_deg": lat}
    for name, source in (("fused", "forward"), ("commanded", "commanded")):
        signal = to_floats(rows, f"{source}_velocity_mps")
        columns[f"{name}_velocity_mps"] = mean_between(path.stamp_ns, signal, cut.start_ns, cut.end_ns)
    # DRMS: independent of the direction of the error
    std_m = np.hypot(to_floats(rows, "x_std_m"), to_floats(rows, "y_std_m"))
    ends_m = [interpolate(path.stamp_ns, std_m, at_ns) for at_ns in (cut.start_ns, cut.end_ns)]
    return SEGMENTS.table(**columns, position_std_m=np.maximum(*ends_m))


def _make_no_segments(metres: dict[str, float], run_id: str) -> Finding:
    """Return the finding that a run has no segment, with the largest loss."""
    driven_m, reason = sum(metres.values()), max(metres, key=lambda entry: metres[entry])
    if driven_m < read_threshold("no-segments", "min_driven_m"):
        return make_finding("robot-did-not-move", Subject("run", run_id), driven_m=driven_m)
    lost_m = metres[reason]
    return make_finding(
        "no-segments", Subject("run", run_id), names={"reason": reason}, driven_m=driven_m, lost_m=lost_m
    )
