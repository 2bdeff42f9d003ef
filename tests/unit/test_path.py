"""Cutting analytic paths: straight, curved, and both."""

import numpy as np
import pytest
from made_tracks import stamps

from tcpipe.geometry.polyline import fit_polyline
from tcpipe.path import cut_by_chord


def drive(course_rad, speed_mps=0.8, period_s=0.05):
    """Return the path of a course that is given every millisecond, sampled at 20 Hz: a fine sum, exact to 1e-9 m."""
    fine = 0.001
    velocity = speed_mps * np.column_stack((np.cos(course_rad), np.sin(course_rad), 0 * course_rad))
    position = np.vstack((np.zeros(3), np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * fine, axis=0)))
    step = round(period_s / fine)
    return fit_polyline(stamps(len(position[::step])), position[::step], velocity[::step])


def test_a_straight_line_is_cut_without_gaps():
    path = drive(np.full(12_501, 0.7))  # 10.0 m
    cut = cut_by_chord(path, chord_m=1.0, max_arc_to_chord=1.02)
    assert len(cut.start_ns) in (9, 10)
    assert cut.start_ns[0] == path.stamp_ns[0]
    assert (cut.start_ns[1:] == cut.end_ns[:-1]).all()
    assert np.diff(cut.start_ns) * 1e-9 == pytest.approx(1.25, abs=2e-9)
    assert len(cut.curved_ns) == 0


@pytest.mark.parametrize(("radius_m", "straight"), [(1.4, False), (1.6, True)])
def test_a_circle_is_kept_from_a_radius_of_one_and_a_half_metres(radius_m, straight):
    t = np.arange(0, 20, 0.001)
    path = drive(0.8 * t / radius_m)
    cut = cut_by_chord(path, chord_m=1.0, max_arc_to_chord=1.02)
    assert (len(cut.start_ns) > 0) == straight
    metres = {name: length for name, (length, _) in cut.ledger(path).items()}
    assert sum(metres.values()) == pytest.approx(path.length_m[-1], rel=1e-12)
    if not straight:
        assert metres["leftover"] < 1.1
        assert metres["curved"] > 14


def test_straight_metres_behind_a_bend_are_recovered():
    t = np.arange(0, 14, 0.001)
    course = np.clip((t - 6.0) * 1.6, 0, np.pi / 2)  # a quarter circle of 0.5 m radius, 0.79 m long, after 4.8 m
    path = drive(course)
    cut = cut_by_chord(path, chord_m=1.0, max_arc_to_chord=1.02)
    metres = {name: length for name, (length, _) in cut.ledger(path).items()}
    assert len(cut.start_ns) == 5 + 5  # the fifth has only the first 0.2 m of the bend
    assert metres["curved"] < 0.5
    assert metres["leftover"] < 1.0
    assert cut.start_ns[5] > cut.end_ns[4]
    assert cut.start_ns[5] in path.stamp_ns


def test_the_three_kinds_tile_the_section():
    rng = np.random.default_rng(5)
    course = np.cumsum(np.repeat(rng.normal(0, 1.2, 60), 500)) * 0.001
    path = drive(course)
    cut = cut_by_chord(path, chord_m=1.0, max_arc_to_chord=1.02)
    spans = np.vstack((np.column_stack((cut.start_ns, cut.end_ns)), cut.curved_ns, cut.leftover_ns))
    spans = spans[np.argsort(spans[:, 0])]
    assert spans[0, 0] == path.stamp_ns[0]
    assert spans[-1, 1] == path.stamp_ns[-1]
    assert (spans[1:, 0] == spans[:-1, 1]).all()
    assert len(cut.curved_ns) > 0
    assert len(cut.start_ns) > 0
    assert sum(length for length, _ in cut.ledger(path).values()) == pytest.approx(path.length_m[-1], rel=1e-12)


def test_a_section_shorter_than_a_chord_is_leftover():
    path = drive(np.zeros(1_001))
    cut = cut_by_chord(path, chord_m=1.0, max_arc_to_chord=1.02)
    assert len(cut.start_ns) == 0
    assert cut.ledger(path)["leftover"][0] == pytest.approx(0.8)


def test_a_path_of_whole_chords_leaves_nothing_and_a_straight_one_is_as_long_as_its_chord():
    t = np.arange(0.0, 5.0)
    path = fit_polyline((t * 1e9).astype(np.int64), np.outer(0.25 * t, [1, 0, 0]), np.tile([0.25, 0.0, 0.0], (5, 1)))
    cut = cut_by_chord(path, chord_m=0.5, max_arc_to_chord=1.0)
    assert (cut.start_ns.tolist(), cut.end_ns.tolist()) == ([0, 2_000_000_000], [2_000_000_000, 4_000_000_000])
    assert len(cut.leftover_ns) == 0
    assert cut.ledger(path)["kept"] == pytest.approx((1.0, 4.0))


def test_curved_pieces_that_follow_one_another_are_one():
    t = np.arange(0, 28, 0.001)
    bends = np.clip((t - 6.0) * 1.6, 0, np.pi / 2) + np.clip((t - 16.0) * 1.6, 0, np.pi)
    cut = cut_by_chord(drive(bends), chord_m=1.0, max_arc_to_chord=1.02)
    assert len(cut.curved_ns) > 1
    assert (cut.curved_ns[1:, 0] > cut.curved_ns[:-1, 1]).all()
