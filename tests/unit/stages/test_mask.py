"""Rows that the mask drops and keeps, of drives given by formula."""

from dataclasses import replace

import numpy as np
import pytest
from made_tracks import make_track, stamps, straight_track, with_columns

from tcpipe.errors import FusionError
from tcpipe.recipe import MaskConfig, SegmentConfig, TimeWindow
from tcpipe.stages.mask import mask_track
from tcpipe.stages.segment import segment_track
from tcpipe.tables.bits import DropReason
from tcpipe.tables.facts import FuseFacts, SectionFacts
from tcpipe.tables.findings import StageReport, select_findings

T = np.arange(0, 60, 0.05)


def gate(track, *, config=None, limit_mps=1.0):
    return mask_track(track, config or MaskConfig(), max_velocity_mps=limit_mps, chord_m=1.0)


def rows_of(masked, reason):
    return (masked.table["dropped_by"].to_numpy() & np.uint32(reason)) != 0


def start_and_stop(top=0.9, rate=1.0):
    return np.clip(np.minimum(rate * (T - 5), rate * (50 - T)), 0, top)


def codes_of(masked):
    return [finding.code for finding in masked.info.report.findings]


def test_a_terrain_slowdown_under_a_constant_command_is_kept():
    speed = 0.9 - 0.6 * np.exp(-(((T - 30) / 1.0) ** 2))  # |dv/dt| up to 0.5 m/s²
    masked = gate(straight_track(speed, commanded_mps=np.ones(len(T))))
    assert (masked.table["dropped_by"].to_numpy() == 0).all()
    without = gate(straight_track(speed))
    assert rows_of(without, DropReason.ACCELERATING)[(T > 29) & (T < 31)].any()


def test_start_and_stop_with_commands():
    commanded = np.where((T >= 5) & (T < 49.1), 1.0, 0.0)
    masked = gate(straight_track(start_and_stop(), commanded_mps=commanded))
    accelerating = rows_of(masked, DropReason.ACCELERATING)
    kept = masked.table["dropped_by"].to_numpy() == 0
    assert T[accelerating & (T < 20)].max() == pytest.approx(7.0)
    assert kept[(T > 7.05) & (T < 49.0)].all()
    assert not kept[(T < 7) | (T > 49.1)].any()
    assert rows_of(masked, DropReason.STATIONARY)[(T < 5) | (T > 50.1)].all()


def test_driving_after_the_commands_fell_silent_is_masked_as_without_commands():
    speed = np.clip(
        0.95 - (T - 30.2), 0.45, 0.95
    )  # another source slows the robot down, while the last command is held
    masked = gate(straight_track(speed, commanded_mps=np.where(T < 31, 1.0, np.nan)))
    accelerating = rows_of(masked, DropReason.ACCELERATING)
    assert accelerating[(T > 30.2) & (T < 30.7)].all()
    assert not accelerating[(T < 29.5) | (T > 31.5)].any()
    assert not rows_of(masked, DropReason.BELOW_FULL_SPEED).any()
    (finding,) = masked.info.report.findings
    assert (finding.code, finding.severity) == ("command-silent", "note")
    assert finding.numbers["silent_s"] == pytest.approx(29.0, abs=0.1)
    assert finding.numbers["moving_s"] == pytest.approx(60.0, abs=0.1)


def test_start_and_stop_without_commands():
    masked = gate(straight_track(start_and_stop()))
    kept = masked.table["dropped_by"].to_numpy() == 0
    assert kept[(T > 6.5) & (T < 48.5)].all()
    assert not kept[(T < 5.9) | (T > 49.2)].any()
    assert codes_of(masked) == ["no-command"]


@pytest.mark.parametrize(("share", "limit"), [(0.7, 0.7), (0.3, 1.0)])
def test_the_top_command_of_a_run_is_its_limit_where_most_is_driven_at_it(share, limit):
    commanded = np.where(60 * share > T, 0.7, 0.35)
    masked = gate(straight_track(commanded - 0.1, commanded_mps=commanded))
    assert masked.info.report.facts.mask.max_velocity_mps == pytest.approx(limit)
    below = rows_of(masked, DropReason.BELOW_FULL_SPEED)
    assert below[60 * share + 1 < T].all()
    assert below[60 * share - 1 > T].all() == (limit == 1.0)
    (finding,) = masked.info.report.findings
    assert finding.code == ("limit-from-commands" if limit == 0.7 else "driven-below-limit")
    assert finding.numbers["top_mps"] == pytest.approx(0.7)
    assert finding.numbers.get("held_fraction", 0.7) == pytest.approx(0.7, abs=0.01)


def test_below_the_limit_unless_it_is_unknown_or_allowed():
    speed, commanded = np.full(len(T), 0.6), np.full(len(T), 0.7)
    track = straight_track(speed, commanded_mps=commanded)
    assert rows_of(gate(track, config=MaskConfig(max_velocity_mps=1.0)), DropReason.BELOW_FULL_SPEED).all()
    allowed = gate(track, config=MaskConfig(require_full_speed=False, max_velocity_mps=1.0, full_speed_fraction=0.9))
    assert not rows_of(allowed, DropReason.BELOW_FULL_SPEED).any()
    assert allowed.info.report.facts.mask.full_speed_mps == pytest.approx(0.9), "labels are flagged below it"
    unknown = gate(track, limit_mps=None)
    assert not rows_of(unknown, DropReason.BELOW_FULL_SPEED).any()
    assert unknown.info.report.facts.mask.full_speed_mps is None
    (finding,) = unknown.info.report.findings
    assert (finding.code, finding.remedies[0].recipe) == ("max-velocity-unknown", {"mask": {"max_velocity_mps": 0.7}})
    assert not rows_of(gate(track, config=MaskConfig(max_velocity_mps=0.7)), DropReason.BELOW_FULL_SPEED).any()
    assert gate(track).info.report.findings[0].numbers["held_fraction"] == 1.0


def test_reversing_is_dropped_unless_kept():
    position = np.column_stack((-0.5 * T, 0 * T, 0 * T))
    velocity = np.tile([-0.5, 0.0, 0.0], (len(T), 1))
    track = make_track(position, velocity, forward_mps=np.full(len(T), -0.5))
    assert rows_of(gate(track), DropReason.REVERSING).all()
    assert (gate(track, config=MaskConfig(keep_reversing=True)).table["dropped_by"].to_numpy() == 0).all()


def test_a_power_gap_is_a_gap_and_a_run_without_power_is_none():
    power = np.where((T > 20) & (T < 22), np.nan, 150.0)
    assert rows_of(gate(straight_track(np.full(len(T), 0.9), power_watt=power)), DropReason.GAP).tolist() == (
        np.isnan(power).tolist()
    )
    assert not rows_of(gate(straight_track(np.full(len(T), 0.9))), DropReason.GAP).any()
    rare = gate(straight_track(np.full(len(T), 0.9), power_watt=np.where(T > 50, 150.0, np.nan)))
    (finding,) = select_findings(rare.info.report.findings, "power-gaps")
    assert finding.numbers["lost_fraction"] == pytest.approx(0.83, abs=0.01)


def test_a_sensor_that_starts_and_stops_within_seconds_has_no_gaps():
    power = np.where((T > 4.7) & (T[-1] - 3.0 > T), 150.0, np.nan)
    masked = gate(straight_track(np.full(len(T), 0.9), power_watt=power))
    assert not select_findings(masked.info.report.findings, "power-gaps")
    assert rows_of(masked, DropReason.GAP).tolist() == np.isnan(power).tolist()


def test_a_jump_is_a_gap_and_not_driven():
    """Fixes that move to another place by 1000 km: rows beside it are a gap, and the ledger holds what was driven."""
    track = straight_track(np.full(len(T), 0.9))
    position = np.column_stack([track.table[f"{axis}_m"].to_numpy() for axis in "xyz"])
    position[600:, 1] += 1e6
    velocity = np.tile([0.9, 0.0, 0.0], (len(T), 1))
    masked = gate(make_track(position, velocity))
    assert np.flatnonzero(rows_of(masked, DropReason.GAP)).tolist() == [599, 600]
    assert masked.info.report.facts.mask.gap_rows == {
        "without_power": 0,
        "uncertain": 0,
        "jumps": 2,
        "implausible": 0,
    }
    (finding,) = select_findings(masked.info.report.findings, "position-jumps")
    assert finding.numbers == {"jump_m": pytest.approx(1e6), "jump_count": 1}
    assert finding.span_s[0] == pytest.approx(599 * 0.05)
    segments = segment_track(masked, SegmentConfig())
    assert sum(segments.distance_by_reason_m.values()) == pytest.approx(0.9 * T[-1], rel=1e-6)
    assert segments.table.num_rows == 52


def test_relative_not_absolute_position_error_makes_a_gap():
    speed = np.full(len(T), 0.9)
    far_off = gate(straight_track(speed, std_m=2.0, velocity_std_mps=0.005))
    assert not rows_of(far_off, DropReason.GAP).any()
    unsure = gate(straight_track(speed, std_m=2.0, velocity_std_mps=0.12))
    assert rows_of(unsure, DropReason.GAP).all()
    (finding,) = select_findings(unsure.info.report.findings, "distance-uncertain")
    assert finding.numbers == {"lost_fraction": 1.0, "chord_m": 1.0, "max_std_m": 0.1}


def test_an_error_of_scale_that_a_run_has_in_common_makes_no_gap():
    track = straight_track(np.full(200, 0.9), std_m=2.0, velocity_std_mps=np.hypot(0.12 * 0.9, 0.005))
    assert rows_of(gate(track), DropReason.GAP).all()
    stamp_ns = track.table["stamp_ns"].to_numpy()
    ends = {"start_ns": int(stamp_ns[0]), "end_ns": int(stamp_ns[-1])}
    section = SectionFacts({}, {}, {}, common_scale_std=0.12, **ends)
    facts = replace(track.info.report.facts, fuse=FuseFacts(200, (), {}, {}, {}, {}, 0.0, (section,)))
    known = gate(replace(track, info=replace(track.info, report=StageReport((), facts))))
    assert not rows_of(known, DropReason.GAP).any()


def test_an_empty_track_and_one_row():
    for count in (0, 1):
        nothing = np.zeros((count, 3))
        assert gate(make_track(nothing, nothing, stamp_ns=stamps(count))).table.num_rows == count


def test_a_track_faster_than_plausible_bears_no_segment_there():
    speed = np.where((T > 20) & (T < 30), 40.0, 0.9)
    masked = gate(straight_track(speed))
    segments = segment_track(masked, SegmentConfig())
    assert segments.table.num_rows > 30
    spans_s = (segments.table["end_ns"].to_numpy() - segments.table["start_ns"].to_numpy()) * 1e-9
    assert (segments.table["chord_m"].to_numpy() / spans_s).max() < 2.0
    assert masked.info.report.facts.mask.gap_rows["implausible"] == pytest.approx(200, abs=3)
    (finding,) = select_findings(masked.info.report.findings, "track-too-fast")
    assert (finding.severity, finding.numbers["limit_mps"]) == ("warning", 15.0)
    assert finding.numbers["fast_s"] == pytest.approx(10.0, abs=0.2)
    assert not rows_of(gate(straight_track(speed), config=MaskConfig(max_plausible_mps=50.0)), DropReason.GAP)[450]


def test_a_run_that_is_mostly_faster_than_plausible_is_refused():
    track = straight_track(np.where(T > 20, 1873.0, 0.9))
    with pytest.raises(FusionError) as error:
        gate(track)
    (finding,) = error.value.findings
    assert (finding.code, finding.severity, finding.action) == ("track-too-fast", "error", "rejected")
    assert finding.numbers["limit_mps"] == 15.0
    robot = {"max_velocity_mps": 1.0, "chord_m": 1.0}
    assert mask_track(track, MaskConfig(), **robot, max_plausible_mps=1e4).table.num_rows == T.size
    with pytest.raises(FusionError) as error:  # the recipe's goes first
        mask_track(track, MaskConfig(max_plausible_mps=20.0), **robot, max_plausible_mps=1e4)
    assert error.value.findings[0].numbers["limit_mps"] == 20.0


@pytest.mark.parametrize(("limit_m", "first_s"), [(0.5, 30.0), (1.0, 60.0), (None, 60.0)])
def test_metres_with_an_uncertain_position_have_a_reason_of_their_own(limit_m, first_s):
    track = straight_track(np.full(T.size, 0.5))
    std_m = np.where(T < 30.0, 0.3, 0.4)  # DRMS of two equal axes: 0.42 and 0.57 m
    track = replace(track, table=with_columns(track.table, x_std_m=std_m, y_std_m=std_m))
    masked = gate(track, config=MaskConfig(max_position_std_m=limit_m))
    assert (rows_of(masked, DropReason.POSITION_UNCERTAIN) == (first_s <= T)).all()
    lost = segment_track(masked, SegmentConfig()).distance_by_reason_m
    assert lost["position_uncertain"] == pytest.approx(0.5 * (60.0 - first_s), abs=0.06)
    assert sum(lost.values()) == pytest.approx(30.0, abs=0.05)


def windows(*given):
    return MaskConfig(windows=[TimeWindow(*of) for of in given])


def test_time_windows_keep_and_drop_metres_with_a_reason_of_their_own():
    track = straight_track(np.full(T.size, 0.5))
    run, utc = (
        track.info.run_id,
        (np.datetime64(int(track.table["stamp_ns"][0].as_py()), "ns") + np.timedelta64(40, "s")),
    )
    masked = gate(
        track, config=windows((run, "keep", 10.0, 50.0), ("*", "drop", 20.0, 30), ("*", "drop", str(utc)[:19], None))
    )
    t = (track.table["stamp_ns"].to_numpy() - track.table["stamp_ns"][0].as_py()) / 1e9
    wanted = (t < 10) | ((t >= 20) & (t < 30)) | (t >= 40)
    assert (rows_of(masked, DropReason.TIME_WINDOW) == wanted).all()
    lost = segment_track(masked, SegmentConfig()).distance_by_reason_m
    assert lost["time_window"] == pytest.approx(0.5 * wanted.sum() * 0.05, abs=0.2)
    assert lost["kept"] + lost["leftover"] + lost["time_window"] == pytest.approx(30.0, abs=0.05)


def test_a_window_goes_before_every_other_reason_and_others_runs_do_not_count():
    standing = straight_track(np.zeros(T.size))
    masked = gate(standing, config=windows(("*", "drop", None, 20)))
    assert masked.table["dropped_by"].to_pylist()[:400] == [int(DropReason.TIME_WINDOW)] * 400
    assert rows_of(masked, DropReason.STATIONARY)[401:].all()
    other = gate(standing, config=windows(("another*", "keep", 0, 1)))
    assert not rows_of(other, DropReason.TIME_WINDOW).any()
    assert "time-window-empty" in codes_of(gate(standing, config=windows(("*", "drop", 900, 950))))
