"""Quality bits of segments, to the metre and the nanosecond from which on they are given."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from made_tracks import stamps

from tcpipe.stages.label_motion import find_motion_flags, is_clock_doubtful
from tcpipe.tables.bits import DropReason, Quality
from tcpipe.tables.facts import (
    AuditFacts,
    ClockFacts,
    ClockOffset,
    Disagreement,
    FuseFacts,
    GateFacts,
    Reopening,
    StageFacts,
    StretchFacts,
)
from tcpipe.tables.findings import StageReport
from tcpipe.tables.levels import Sensor, Streams, TrackInfo

STAMPS = stamps(200)  # at 20 Hz and 1 m/s: five centimetres a row
GATED = GateFacts(200, 200, {}, {}, 1.0, 0.9)


def rows(*, dropped=(), late=None, reason=DropReason.GAP):
    stamp_ns = STAMPS.copy()
    if late is not None:
        stamp_ns[late:] += 1_000_000_000
    dropped_by = np.zeros(200, np.uint32)
    dropped_by[list(dropped)] = reason
    x_m = 0.05 * np.arange(200)
    return pa.table(
        {
            "stamp_ns": stamp_ns,
            "epoch": np.zeros(200, np.int16),
            "x_m": x_m,
            "y_m": np.zeros(200),
            "wheel_velocity_mps": np.ones(200),
            "dropped_by": dropped_by,
        }
    )


def cut(count=1, **said):
    columns = {
        "start_ns": STAMPS[[100]],
        "end_ns": STAMPS[[120]],
        "epoch": np.zeros(1, np.int16),
        "chord_m": [1.0],
        "arc_length_m": [1.0],
        "fused_velocity_mps": [1.0],
        "commanded_velocity_mps": [1.0],
        "position_std_m": [0.01],
    }
    return pa.table({name: np.repeat(np.asarray(value), count) for name, value in (columns | said).items()})


def info(**facts):
    return TrackInfo("run-0", "husky", None, 20.0, "smoother", StageReport((), StageFacts(**{"gate": GATED} | facts)))


def flags(segment, track=None, about=None):
    found = find_motion_flags(
        segment, rows() if track is None else track, about or info(), arc_to_chord=1.05, max_position_std_m=0.1
    )
    return {bit for bit, flagged in found.items() if flagged[0]}


def test_a_plain_segment_carries_no_bit():
    assert flags(cut()) == set()


@pytest.mark.parametrize(
    ("column", "below", "above", "bit"),
    [
        ("position_std_m", 0.1, 0.1001, Quality.WEAK_GNSS),
        ("arc_length_m", 1.05, 1.0501, Quality.CURVED),
        ("commanded_velocity_mps", 0.9, 0.8999, Quality.NOT_AT_LIMIT),
        ("commanded_velocity_mps", -0.9, -0.8999, Quality.NOT_AT_LIMIT),
        ("commanded_velocity_mps", 1.0, np.nan, Quality.NO_COMMAND),
        ("fused_velocity_mps", 0.81, 0.79, Quality.HIGH_SLIP),
    ],
)
def test_where_a_bit_begins(column, below, above, bit):
    assert flags(cut(**{column: [below]})) == set()
    assert flags(cut(**{column: [above]})) == {bit}


def test_a_curve_is_one_against_its_own_chord():
    assert flags(cut(arc_length_m=[2.1], chord_m=[2.0])) == set()
    assert flags(cut(arc_length_m=[2.2], chord_m=[2.0])) == {Quality.CURVED}


def test_without_a_known_limit_no_command_is_below_it():
    assert flags(cut(commanded_velocity_mps=[0.1]), about=info(gate=None)) == set()
    assert flags(cut(commanded_velocity_mps=[0.1]), about=info(gate=replace(GATED, full_speed_mps=None))) == set()


@pytest.mark.parametrize(("row", "near"), [(79, False), (80, True), (110, True), (140, True), (141, False)])
def test_a_gap_is_near_within_a_chord_of_either_end(row, near):
    """The segment goes from 5 m to 6 m, that is from row 100 to row 120; the path lengths are sums of five centimetres."""
    nudge = 1e-6  # a path length is a sum of floats: not to the last bit
    segment = cut(chord_m=[1.0 + nudge], arc_length_m=[1.0])
    assert (Quality.NEAR_GAP in flags(segment, rows(dropped=[row]))) == near
    others = sum(DropReason) - DropReason.GAP
    assert Quality.NEAR_GAP not in flags(segment, rows(dropped=[row], reason=others))


@pytest.mark.parametrize(("late", "near"), [(79, False), (80, True), (141, True), (142, False)])
def test_a_hole_counts_by_the_rows_on_both_of_its_sides(late, near):
    track = rows(late=late)
    stamp_ns = track["stamp_ns"].to_numpy()
    segment = cut(start_ns=stamp_ns[[100]], end_ns=stamp_ns[[120]], chord_m=[1.0 + 1e-6])
    assert (Quality.NEAR_GAP in flags(segment, track)) == near


def disagreement(start_ns, end_ns, *, alone=False, epoch=0):
    return AuditFacts((Disagreement(int(start_ns), int(end_ns), "gnss", "position", 1.0, "m", 0.1, alone, epoch),))


@pytest.mark.parametrize(
    ("before", "behind", "touches"), [(-50, 0, True), (-50, -1, False), (20e9, 30e9, False), (1e9, 2e9, True)]
)
def test_a_disagreement_counts_where_it_touches_a_segment(before, behind, touches):
    audit = disagreement(STAMPS[100] + int(before), STAMPS[100] + int(behind))
    assert (flags(cut(), about=info(audit=audit)) == {Quality.SENSORS_DISAGREE}) == touches


def test_a_disagreement_that_is_settled_or_of_another_epoch_is_none():
    span = STAMPS[100], STAMPS[120]
    assert flags(cut(), about=info(audit=disagreement(*span, alone=True))) == set()
    assert flags(cut(), about=info(audit=disagreement(*span, epoch=1))) == set()
    later = cut(epoch=np.ones(1, np.int16))
    assert flags(later, about=info(audit=disagreement(*span))) == set()
    assert flags(later, about=info(audit=disagreement(*span, epoch=1))) == {Quality.SENSORS_DISAGREE}
    assert flags(cut(), about=info(audit=disagreement(STAMPS[120] + 1, STAMPS[130]))) == set()


@pytest.mark.parametrize(("role", "disputed"), [("gnss", True), ("wheel_odometry", False)])
def test_fixes_that_were_off_dispute_a_segment(role, disputed):
    off = Reopening(role, int(STAMPS[110]), int(STAMPS[115]), 1.0)
    stretch = StretchFacts({}, {}, {}, 0, reopenings=(off,))
    fuse = FuseFacts(200, ("gnss",), {}, {}, {}, {}, 0.0, (stretch,))
    assert (flags(cut(), about=info(fuse=fuse)) == {Quality.SENSORS_DISAGREE}) == disputed


def streams(*, epochs=1, **time_sources):
    sensors = {role: Sensor(f"/{role}", "x/msg/Y", role, "why", time_source=at) for role, at in time_sources.items()}
    return Streams({}, sensors, "husky", report=StageReport((), StageFacts(epochs=epochs)))


def clocks(role, *, noted=False, drifts=False, heading_offset_s=None):
    offset = ClockOffset(0.1, 0.01, noted, None, None, drifts)
    return info(clock_offsets=ClockFacts(0, "gnss", (), {role: offset}, heading_offset_s=heading_offset_s))


def test_a_clock_is_doubtful_that_steps_or_is_the_recorders():
    assert not is_clock_doubtful(streams(gnss="header", command="log"), info())
    assert is_clock_doubtful(streams(gnss="log"), info())
    assert is_clock_doubtful(streams(epochs=2, gnss="header"), info())


def test_a_clock_is_doubtful_that_is_off_unless_the_heading_carries_it():
    good = streams(gnss="header")
    assert not is_clock_doubtful(good, clocks("imu"))
    assert is_clock_doubtful(good, clocks("imu", noted=True))
    assert is_clock_doubtful(good, clocks("imu", drifts=True))
    assert not is_clock_doubtful(good, clocks("imu", noted=True, heading_offset_s=0.01))
    assert is_clock_doubtful(good, clocks("gnss", noted=True, heading_offset_s=0.01))
