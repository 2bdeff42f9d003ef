"""What a person reads of the audit: one line for each sensor and thing, and why a run has no segments."""

from tcpipe.fusion.checks.audit import Tally
from tcpipe.stages.fuse_audit import audit_findings
from tcpipe.stages.fuse_stretches import Fused
from tcpipe.tables.findings import Disagreement, StretchFacts

SECOND_NS = 1_000_000_000


def off(begin_s, end_s, size, *, sensor="gnss", what="position", alone=False):
    return Disagreement(begin_s * SECOND_NS, end_s * SECOND_NS, sensor, what, size, "m", 0.02, alone)


def fused(*found, tallies=()):
    return Fused(
        facts=[StretchFacts({}, {}, {}, 0, start_ns=100 * SECOND_NS)], disagreements=list(found), tallies=list(tallies)
    )


def test_nothing_is_said_where_nobody_disagrees():
    told = audit_findings(fused())
    assert told.warnings == ()
    assert (told.facts.disagreements, told.facts.undecided) == ((), ())


def test_a_line_holds_sensor_what_window_size_and_what_was_expected():
    told = audit_findings(fused(off(110, 130, 0.2), off(160, 220, 0.49), off(150, 155, 9.0, alone=True)))
    shared, lone = told.warnings
    assert shared == (
        "gnss: its position is off the track 2 times, 80 s in all; most from 60 to 120 s of the run by 0.49 m, "
        "expected 0.02 m (1 sigma); deviations are raised there, and segments carry sensors_disagree"
    )
    assert lone.endswith(
        "from 50 to 55 s of the run by 9 m, expected 0.02 m (1 sigma); two other sensors contradict it, so the track is believed"
    )
    assert len(told.facts.disagreements) == 3


def test_a_run_that_no_third_decides_says_why_it_has_no_segments():
    told = audit_findings(fused(tallies=[Tally("wheel_odometry", "displacement", 20, 15, 0)]))
    assert told.facts.undecided == ("wheel_odometry",)
    (line,) = told.warnings
    assert line.startswith("displacement by wheel_odometry: in most of the way the track is not what this sensor says")
    assert "no segments" in line
    assert "ignore_topics" in line
