"""Every interval has one reason, and the sum is the odometer."""

import numpy as np
import pytest
from made_tracks import stamps

from tcpipe.motion.distance_breakdown import (
    compute_interval_duration_s,
    compute_interval_length_m,
    compute_unexplained_m,
    find_interval_reason,
    find_kept_spans,
    find_largest_losses,
    find_losses,
    make_loss_code,
    sum_by_reason,
)
from tcpipe.tables.bits import DropReason, Loss, flag_name
from tcpipe.tables.findings import Subject, read_catalogue

G, S, A = (int(bit) for bit in (DropReason.GAP, DropReason.STATIONARY, DropReason.ACCELERATING))


def test_sections_are_runs_of_two_kept_rows_inside_a_piece():
    dropped = np.array([0, 0, S, 0, S, 0, 0, 0], dtype=np.uint32)
    piece = np.array([0, 0, 0, 0, 0, 0, 0, 1])
    assert find_kept_spans(dropped, piece).tolist() == [[0, 1], [5, 6]]


def test_reason_is_the_first_of_both_ends_and_a_hole_is_a_gap():
    dropped = np.array([0, 0, A, A | S, 0, 0], dtype=np.uint32)
    piece = np.array([0, 0, 0, 0, 0, 1])
    assert find_interval_reason(dropped, piece).tolist() == [0, A, S, S, G]


def test_a_hole_counts_as_its_straight_line_and_no_metre_twice():
    stamp_ns = stamps(6)
    stamp_ns[3:] += 1_000_000_000
    x = np.array([0.0, 0.05, 0.10, 3.10, 3.15, 3.20])
    position = np.column_stack((x, 0 * x, 0 * x))
    velocity = np.tile([1.0, 0.0, 0.0], (6, 1))
    piece = np.array([0, 0, 0, 1, 1, 1])
    length = compute_interval_length_m(stamp_ns, position, velocity, piece)
    assert length == pytest.approx([0.05, 0.05, 3.0, 0.05, 0.05])
    sums = sum_by_reason(find_interval_reason(np.array([0, 0, 0, S, S, 0], dtype=np.uint32), piece), length)
    assert sums["gap"] == pytest.approx(3.0)
    assert sums["stationary"] == pytest.approx(0.1)
    assert set(sums) == {str(bit.name).lower() for bit in DropReason}


def test_seconds_are_those_inside_an_epoch_whichever_way_its_clock_steps():
    got = compute_interval_duration_s(stamps(4), np.array([0, 0, 1, 0]))
    assert got == pytest.approx([0.05, 0.0, 0.0])


VELOCITY = np.array([[1.0, 2.0, 9.0], [3.0, 4.0, 9.0], [3.0, 4.0, 9.0]])


def test_what_the_velocity_does_not_explain_is_horizontal_and_inside_a_piece():
    position = np.array([[0.0, 0.0, 0.0], [0.2, 0.5, 7.0], [9.0, 9.0, 9.0]])
    got = compute_unexplained_m(stamps(3), position, VELOCITY, np.array([0, 0, 1]))
    assert got == pytest.approx([np.hypot(0.2 - 0.1, 0.5 - 0.15), 0.0])
    assert compute_unexplained_m(stamps(3), position[:, [1, 0, 2]], VELOCITY[:, [1, 0, 2]], np.zeros(3))[
        0
    ] == pytest.approx(got[0])


@pytest.mark.parametrize(("step_m", "counted_m"), [(1.0, 1.0), (1.01, 0.0)])
def test_a_step_of_a_metre_is_no_jump_yet(step_m, counted_m):
    position = np.array([[0.0, 0.0, 0.0], [step_m, 0.0, 0.0]])
    got = compute_interval_length_m(stamps(2), position, np.zeros((2, 3)), np.zeros(2, np.int64))
    assert got == pytest.approx([counted_m])


def test_a_hole_is_measured_on_the_map_and_every_step_by_itself():
    position = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.15, 0.0, 0.0], [3.15, 4.0, 7.0]])
    piece = np.array([0, 0, 0, 1])
    got = compute_interval_length_m(stamps(4), position, np.tile([1.5, 0.0, 0.0], (4, 1)), piece)
    assert got == pytest.approx([0.05, 0.1, 5.0], rel=0.01)


RUN = Subject("run", "r")


def test_the_catalogue_knows_every_reason():
    assert {make_loss_code(flag_name(reason)) for reason in (*DropReason, *Loss)} <= set(read_catalogue())


def test_losses_of_more_than_a_twentieth_are_findings_the_largest_first():
    found = find_losses({"kept": 60.0, "gap": 10.0, "turning_in_place": 25.0, "curved": 5.0}, RUN)
    assert [(of.code, of.subject) for of in found] == [("lost-turning-in-place", RUN), ("lost-gap", RUN)]
    assert found[0].numbers == {"lost_m": 25.0, "lost_fraction": 0.25}
    assert {of.severity for of in found} == {"note"}


def test_a_robot_that_does_not_move_loses_nothing():
    assert find_losses({"kept": 0.0, "stationary": 4.9}, RUN) == []


def test_losses_of_several_runs_add_up():
    losses = find_largest_losses([{"kept": 50.0, "gap": 30.0, "stationary": 0.01}, {"kept": 10.0, "gap": 10.0}])
    assert [(of.reason, of.metres, of.runs) for of in losses] == [("gap", 40.0, 2)]
    assert losses[0].share == pytest.approx(40.0 / 100.01)
    assert find_largest_losses([]) == ()
