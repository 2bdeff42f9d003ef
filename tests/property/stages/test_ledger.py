"""Every metre and every joule of random drives is accounted for: kept and lost add up to what was driven and drawn."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_tracks import make_track, power_streams, stamps

from tcpipe.recipe import LabelConfig, MaskConfig, SegmentConfig
from tcpipe.robots import Robot
from tcpipe.stages.label import label_segments
from tcpipe.stages.mask import mask_track
from tcpipe.stages.segment import segment_track
from tcpipe.tables.columns import to_floats

REASONS = [
    *("kept", "gap", "stationary", "stuck", "turning_in_place", "reversing", "accelerating", "below_full_speed"),
    *("time_window", "position_uncertain", "curved", "leftover"),
]
FINE = 50
"""Steps of the truth to one row of the track."""


@st.composite
def drives(draw):
    """Return a track with stops, turns, reversing, commands, holes, a clock set back and a jump, and its true horizontal length [m]."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    seconds, fine_s = draw(st.integers(5, 60)), 0.05 / FINE
    t = np.arange(seconds * 20 * FINE + 1) * fine_s
    knots = np.arange(0.0, seconds + 4.0, draw(st.sampled_from([1.5, 4.0, 15.0])))
    speed = np.clip(np.interp(t, knots, rng.uniform(-0.5, 1.4, len(knots))), draw(st.sampled_from([-0.3, 0.0])), 1.0)
    turn = np.interp(t, knots, rng.uniform(-1.0, 1.0, len(knots))) * draw(st.sampled_from([0.0, 0.2, 1.0]))
    slope = 0.3 * np.sin(t / 5.0)
    course = np.concatenate(([0.0], np.cumsum(0.5 * (turn[1:] + turn[:-1]) * fine_s)))
    velocity = speed[:, None] * np.column_stack(
        (np.cos(course) * np.cos(slope), np.sin(course) * np.cos(slope), np.sin(slope))
    )
    position = np.concatenate((np.zeros((1, 3)), np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * fine_s, axis=0)))
    kept = np.sort(rng.permutation(len(t[::FINE]))[: draw(st.integers(len(t[::FINE]) // 2, len(t[::FINE])))])
    kept = np.arange(len(t[::FINE])) if draw(st.booleans()) else kept
    clock_epoch = (kept > draw(st.integers(0, 2 * len(t[::FINE])))).astype(np.int16)
    rows = kept * FINE
    way = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(position[:, :2], axis=0).T))))
    straight = np.hypot(*np.diff(position[rows, :2], axis=0).T)
    whole = (np.diff(kept) == 1) & (np.diff(clock_epoch) == 0)
    true_m = np.where(whole, np.diff(way[rows]), straight).sum()
    if draw(st.booleans()) and whole.any():  # fixes that move elsewhere: nobody drove that
        position[rows[draw(st.sampled_from(np.flatnonzero(whole).tolist())) + 1] :] += (300.0, -40.0, 5.0)
    track = make_track(
        position[rows],
        velocity[rows],
        stamp_ns=stamps(len(t[::FINE]))[kept] - 30 * 10**9 * clock_epoch.astype(np.int64),
        clock_epoch=clock_epoch,
        forward_mps=speed[rows],
        yaw_rate_radps=turn[rows],
        wheel_mps=speed[rows] if draw(st.booleans()) else None,
        commanded_mps=np.where(rng.random(len(rows)) < 0.95, 1.0, 0.4) if draw(st.booleans()) else None,
        power_watt=np.full(len(rows), 144.0),
    )
    return track, true_m


def labelled(track):
    masked = mask_track(track, MaskConfig(), max_velocity_mps=1.0, chord_m=1.0)
    stamp_ns = masked.table["stamp_ns"].to_numpy()
    t_ns = np.arange(stamp_ns.min() - 10**9, stamp_ns.max() + 10**9, 40_000_000)
    power = power_streams({"drive": (t_ns, np.full(len(t_ns), 24.0), np.full(len(t_ns), 6.0))})
    found = label_segments(segment_track(masked, SegmentConfig()), masked, power, LabelConfig(), robot=Robot())
    return masked, found, 144.0 * (t_ns[-1] - t_ns[0]) * 1e-9


def check_segments(masked, table):
    """No segment holds a dropped row, a hole or a step of the clock, and each has the chord that was asked for."""
    stamp_ns, clock_epoch, dropped = (masked[name].to_numpy() for name in ("stamp_ns", "clock_epoch", "dropped_by"))
    for start, end, its_epoch in zip(
        *(table[name].to_pylist() for name in ("start_ns", "end_ns", "clock_epoch")), strict=True
    ):
        inside = (clock_epoch == its_epoch) & (stamp_ns > start - 50_000_000) & (stamp_ns < end + 50_000_000)
        assert not dropped[inside].any()
        assert (np.diff(stamp_ns[inside]) == 50_000_000).all()
    step = [to_floats(table, f"end_{axis}_m") - to_floats(table, f"start_{axis}_m") for axis in "xy"]
    assert np.hypot(*step) == pytest.approx(np.ones(table.num_rows), abs=1e-6)


@settings(max_examples=25, deadline=None)
@given(st.lists(drives(), min_size=1, max_size=3))
def test_kept_and_lost_are_what_was_driven_and_drawn(given_drives):
    ledgers_m, driven_m = [], []
    for track, true_m in given_drives:
        masked, found, drawn_joule = labelled(track)
        check_segments(masked.table, found.table)
        entries, cut = found.distance_by_reason_m, found.info.report.facts.segment
        assert list(entries) == REASONS
        assert min(entries.values()) >= 0.0
        assert sum(entries.values()) == pytest.approx(true_m, rel=1e-3, abs=1e-3)
        assert entries["kept"] == pytest.approx(to_floats(found.table, "arc_length_m").sum(), rel=1e-9, abs=1e-9)
        facts = found.info.report.facts.label
        assert facts.distance_m == cut.odometer_m == pytest.approx(sum(entries.values()), rel=1e-12)
        intervals_ns, steps = (np.diff(track.table[name].to_numpy()) for name in ("stamp_ns", "clock_epoch"))
        assert sum(cut.duration_by_reason_s.values()) == pytest.approx(intervals_ns[steps == 0].sum() * 1e-9, rel=1e-9)
        if not track.table["clock_epoch"].to_numpy().any():  # power is of the first clock_epoch alone
            assert sum(facts.energy_by_entry_joule.values()) == pytest.approx(drawn_joule, rel=1e-3)
        ledgers_m.append(entries)
        driven_m.append(true_m)
    summed = {name: sum(ledger[name] for ledger in ledgers_m) for name in ledgers_m[0]}
    assert sum(summed.values()) == pytest.approx(sum(driven_m), rel=1e-3, abs=1e-3)
