"""Quality bits of segments, to the metre and the nanosecond from which on they are given."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from made_tracks import make_track, power_streams, stamps, straight_track

from tcpipe.recipe import LabelConfig, MaskConfig, SegmentConfig
from tcpipe.robots import Robot
from tcpipe.stages.label import label_segments
from tcpipe.stages.label_motion import find_motion_flags, is_clock_doubtful
from tcpipe.stages.mask import mask_track
from tcpipe.stages.segment import segment_track
from tcpipe.tables.bits import DropReason, Quality
from tcpipe.tables.columns import to_floats
from tcpipe.tables.facts import (
    ClockFacts,
    ClockOffset,
    ClockStep,
    FuseFacts,
    GateReset,
    MaskFacts,
    SectionFacts,
    StageFacts,
)
from tcpipe.tables.findings import StageReport
from tcpipe.tables.levels import IMU, Sensor, Streams, TrackInfo

STAMPS = stamps(200)  # at 20 Hz and 1 m/s: five centimetres a row
MASKED = MaskFacts(200, 200, {}, {}, 1.0, 0.9)


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
            "clock_epoch": np.zeros(200, np.int16),
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
        "clock_epoch": np.zeros(1, np.int16),
        "chord_m": [1.0],
        "arc_length_m": [1.0],
        "fused_velocity_mps": [1.0],
        "commanded_velocity_mps": [1.0],
        "position_std_m": [0.01],
    }
    return pa.table({name: np.repeat(np.asarray(value), count) for name, value in (columns | said).items()})


def info(**facts):
    return TrackInfo("run-0", "husky", None, 20.0, "smoother", StageReport((), StageFacts(**{"mask": MASKED} | facts)))


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
        ("commanded_velocity_mps", 0.9, 0.8999, Quality.BELOW_FULL_SPEED),
        ("commanded_velocity_mps", -0.9, -0.8999, Quality.BELOW_FULL_SPEED),
        ("commanded_velocity_mps", 1.0, np.nan, Quality.NO_COMMAND),
        ("fused_velocity_mps", 0.81, 0.79, Quality.HIGH_SLIP),
    ],
)
def test_where_a_bit_begins(column, below, above, bit):
    assert flags(cut(**{column: [below]})) == set()
    assert flags(cut(**{column: [above]})) == {bit}


def test_without_a_known_limit_no_command_is_below_it():
    assert flags(cut(commanded_velocity_mps=[0.1]), about=info(mask=None)) == set()
    assert flags(cut(commanded_velocity_mps=[0.1]), about=info(mask=replace(MASKED, full_speed_mps=None))) == set()


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


def disagreement(start_ns, end_ns, *, clock_epoch=0):
    reset = GateReset(int(start_ns), int(end_ns), 1.0)
    section = SectionFacts({}, {}, {}, clock_epoch=clock_epoch, gate_resets=(reset,))
    return FuseFacts(200, ("gnss",), {}, {}, {}, {}, 0.0, (section,))


@pytest.mark.parametrize(
    ("before", "behind", "touches"), [(-50, 0, True), (-50, -1, False), (20e9, 30e9, False), (1e9, 2e9, True)]
)
def test_a_disagreement_counts_where_it_touches_a_segment(before, behind, touches):
    fuse = disagreement(STAMPS[100] + int(before), STAMPS[100] + int(behind))
    assert (flags(cut(), about=info(fuse=fuse)) == {Quality.SENSORS_DISAGREE}) == touches


def test_a_disagreement_of_another_epoch_is_none():
    span = STAMPS[100], STAMPS[120]
    assert flags(cut(), about=info(fuse=disagreement(*span, clock_epoch=1))) == set()
    later = cut(clock_epoch=np.ones(1, np.int16))
    assert flags(later, about=info(fuse=disagreement(*span))) == set()
    assert flags(later, about=info(fuse=disagreement(*span, clock_epoch=1))) == {Quality.SENSORS_DISAGREE}
    assert flags(cut(), about=info(fuse=disagreement(STAMPS[120] + 1, STAMPS[130]))) == set()


def streams(*, steps=(), **time_sources):
    sensors = {role: Sensor(f"/{role}", "x/msg/Y", role, "why", time_source=at) for role, at in time_sources.items()}
    return Streams({}, sensors, "husky", report=StageReport((), StageFacts(epochs=len(steps) + 1, clock_steps=steps)))


def clocks(role, *, is_significant=False, is_wrong=False):
    offset = ClockOffset(0.1, 0.01, is_significant, is_wrong)
    return info(clock_offsets=(ClockFacts(0, "gnss", (), {role: offset}),))


def test_a_clock_is_doubtful_that_steps_or_is_the_recorders():
    assert not is_clock_doubtful(streams(gnss="header", command="log"), info())
    assert is_clock_doubtful(streams(gnss="log"), info())
    assert is_clock_doubtful(streams(steps=(ClockStep(0, 2.0, ("/fix",)),), gnss="header"), info())
    assert not is_clock_doubtful(streams(steps=(ClockStep(0, -3.0, ()),), gnss="header"), info())  # all of them step


def test_a_clock_is_doubtful_that_is_off_unless_it_was_corrected():
    good = streams(gnss="header")
    assert not is_clock_doubtful(good, clocks("imu"))
    assert is_clock_doubtful(good, clocks("imu", is_significant=True))
    assert not is_clock_doubtful(good, clocks("imu", is_significant=True, is_wrong=True))


T = np.arange(0, 30, 0.05)


def labelled(track, streams=None):
    masked = mask_track(track, MaskConfig(), max_velocity_mps=1.0, chord_m=1.0)
    segments = segment_track(masked, SegmentConfig())
    given = streams or Streams({}, {}, "husky")
    table = label_segments(segments, masked, given, LabelConfig(), robot=Robot()).table
    assert table.num_rows > 10
    return table


@pytest.mark.parametrize("side", [1, -1])
def test_a_circle_turns_by_its_radius_across_the_cut_of_the_yaw(side):
    angle = 0.8 * T / 4.0
    circle = 4.0 * np.column_stack((np.cos(angle), side * np.sin(angle), 0 * angle))
    velocity = 0.8 * np.column_stack((-np.sin(angle), side * np.cos(angle), 0 * angle))
    table = labelled(make_track(circle, velocity, yaw_rate_radps=np.full(len(T), side * 0.2)))
    duration_s = 2 * np.arcsin(1 / 8) * 4.0 / 0.8
    assert to_floats(table, "yaw_change_rad") == pytest.approx(side * 0.2 * duration_s, rel=1e-4)
    assert to_floats(table, "mean_abs_yaw_rate_radps") == pytest.approx(0.2)
    assert to_floats(table, "curvature_radpm") == pytest.approx(side / 4.0, rel=1e-4)
    assert np.isnan(to_floats(table, "yaw_change_std_rad")).all()
    assert table["vibration_mps2"].null_count == table.num_rows


def test_slip_is_of_the_wheels_and_unknown_without_them():
    speed = np.full(len(T), 0.8)
    table = labelled(straight_track(speed, wheel_mps=np.full(len(T), 1.0)))
    assert to_floats(table, "slip_fraction") == pytest.approx(0.2)
    assert to_floats(table, "slip_std_fraction") == pytest.approx(
        0.8 * to_floats(table, "velocity_std_mps") / to_floats(table, "velocity_mps")
    )
    assert labelled(straight_track(speed))["slip_fraction"].null_count > 10
    standing = labelled(straight_track(speed, wheel_mps=np.zeros(len(T))))
    assert standing["slip_fraction"].null_count == standing.num_rows


@pytest.mark.parametrize(("gravity", "known"), [(9.81, True), (1.0, False), (0.0, False)])
def test_an_accelerometer_in_another_unit_or_without_gravity_tells_no_vibration(gravity, known):
    n = 6000
    shake = np.random.default_rng(0).normal(0.0, 0.3, (n, 3)) + np.array([0.0, 0.0, gravity])
    stamp_ns = stamps(n, step_ns=5_000_000)
    given = {name: np.zeros(n) for name in IMU.names()}
    given |= {f"linear_acceleration_{axis}_mps2": shake[:, k] for k, axis in enumerate("xyz")}
    given |= {"stamp_ns": stamp_ns, "log_time_ns": stamp_ns, "clock_epoch": np.zeros(n, np.int16)}
    sensor = Sensor("/imu", "sensor_msgs/msg/Imu", "imu_link", "why")
    streams = Streams({"imu": IMU.table(**given)}, {"imu": sensor}, "husky")
    found = to_floats(labelled(straight_track(np.full(len(T), 0.8)), streams), "vibration_mps2")
    wanted = 0.3 * np.sqrt(3 * 14.4 / 100) if known else np.nan  # white noise passes the band as 14.4 Hz of 100
    assert np.median(found) == pytest.approx(wanted, rel=0.05, nan_ok=True)


def test_net_power_of_a_robot_that_stands_first():
    speed = np.where(T < 6, 0.0, np.minimum((T - 6) * 0.8, 0.8))
    watts = np.where(T < 6, 90.0, 240.0)
    stamp_ns = stamps(len(T))
    streams = power_streams({"pack": (stamp_ns, np.full(len(T), 24.0), watts / 24.0)})
    table = labelled(straight_track(speed, power_watt=watts), streams)
    assert to_floats(table, "idle_power_watt") == pytest.approx(90.0)
    assert to_floats(table, "net_power_watt") == pytest.approx(150.0)
    assert to_floats(table, "net_energy_joule") == pytest.approx(150.0 * 1.25)
    never = labelled(straight_track(np.full(len(T), 0.8), power_watt=watts), streams)
    assert never["net_energy_joule"].null_count == never.num_rows
    assert never["energy_joule"].null_count == 0
