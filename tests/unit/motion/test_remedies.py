"""What drives lose most of: findings for large losses of one, sums for many."""

import pytest

from tcpipe.motion.distance_breakdown import find_largest_losses, find_losses, make_loss_code
from tcpipe.tables.bits import DropReason, Loss, flag_name
from tcpipe.tables.catalogue import read_catalogue
from tcpipe.tables.findings import Subject

RUN = Subject("run", "r")


@pytest.mark.parametrize("reason", [*DropReason, *Loss])
def test_the_catalogue_knows_every_reason(reason):
    assert make_loss_code(flag_name(reason)) in read_catalogue()


def test_losses_of_more_than_a_twentieth_are_findings_the_largest_first():
    found = find_losses({"kept": 60.0, "gap": 10.0, "turning_in_place": 25.0, "curved": 5.0}, RUN)
    assert [(of.code, of.subject) for of in found] == [("lost-turning-in-place", RUN), ("lost-gap", RUN)]
    assert found[0].numbers == {"lost_m": 25.0, "lost_fraction": 0.25}
    assert {of.severity for of in found} == {"note"}


def test_a_robot_that_does_not_move_loses_nothing():
    assert find_losses({"kept": 0.0, "standing": 4.9}, RUN) == []


def test_losses_of_several_runs_add_up():
    losses = find_largest_losses([{"kept": 50.0, "gap": 30.0, "standing": 0.01}, {"kept": 10.0, "gap": 10.0}])
    assert [(of.reason, of.metres, of.runs) for of in losses] == [("gap", 40.0, 2)]
    assert losses[0].share == pytest.approx(40.0 / 100.01)
    assert find_largest_losses([]) == ()
