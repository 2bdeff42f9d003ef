"""What a person reads of the audit: one finding for each sensor and thing, and why a run has no segments."""

import numpy as np
import pytest
from suggested_recipes import proposed

from tcpipe.fusion.checks.audit import Tally
from tcpipe.fusion.measurements import BodyVelocities, Measurements
from tcpipe.stages.fuse_findings import make_audit_findings
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_sections import Fused
from tcpipe.tables.facts import Disagreement, StretchFacts
from tcpipe.tables.levels import STREAMS, Streams

SECOND_NS = 1_000_000_000


def off(begin_s, end_s, size, *, sensor="gnss", what="position", alone=False):
    return Disagreement(begin_s * SECOND_NS, end_s * SECOND_NS, sensor, what, size, "m", 0.02, alone)


NOBODY = FusionInputs(None), Streams({}, {}, "husky")


def fused(*found, tallies=()):
    return Fused(
        facts=[StretchFacts({}, {}, {}, 0, start_ns=100 * SECOND_NS)], disagreements=list(found), tallies=list(tallies)
    )


def test_nothing_is_said_where_nobody_disagrees():
    told = make_audit_findings(fused(), *NOBODY)
    assert told.findings == ()
    assert (told.facts.disagreements, told.facts.undecided) == ((), ())


def test_a_finding_holds_sensor_what_window_size_and_what_was_expected():
    told = make_audit_findings(fused(off(110, 130, 0.2), off(160, 220, 0.49), off(150, 155, 9.0, alone=True)), *NOBODY)
    shared, lone = told.findings
    assert (shared.code, shared.subject.name, shared.action) == ("position-disagrees", "gnss", "inflated")
    assert shared.numbers == {"off_m": 0.49, "expected_std_m": 0.02, "event_count": 2, "total_s": 80.0}
    assert shared.span_s == (60.0, 120.0)
    assert (lone.code, lone.severity, lone.action) == ("position-disagrees", "note", "kept")
    assert (lone.numbers["off_m"], lone.span_s) == (9.0, (50.0, 55.0))
    assert len(told.facts.disagreements) == 3


def test_a_run_that_no_third_decides_says_why_it_has_no_segments():
    told = make_audit_findings(fused(tallies=[Tally("wheel_odometry", "displacement", 20, 15, 0)]), *NOBODY)
    assert told.facts.undecided == ("wheel_odometry",)
    (finding,) = told.findings
    assert (finding.code, finding.subject.name) == ("disagreement-undecided", "wheel_odometry")
    assert (finding.severity, finding.names) == ("error", {"quantity": "displacement"})
    assert proposed(finding) == {"read": {"topics": {"wheel_odometry": []}}}


def wheels_alone(speed_mps):
    """Wheels of one speed that nothing else is held against, and a command of 1 m/s."""
    stamp_ns = np.arange(0, 100 * SECOND_NS, SECOND_NS // 10, dtype=np.int64)
    velocity = np.column_stack((np.full(stamp_ns.size, speed_mps), np.full((stamp_ns.size, 2), np.nan)))
    nothing = np.full(stamp_ns.size, np.nan)
    wheels = BodyVelocities(stamp_ns, velocity, velocity, nothing, nothing)
    command = STREAMS["command"].table(
        stamp_ns=stamp_ns, log_time_ns=stamp_ns, epoch=np.zeros(stamp_ns.size, np.int16),
        forward_velocity_mps=np.ones(stamp_ns.size), yaw_rate_radps=np.zeros(stamp_ns.size),
    )  # fmt: skip
    return FusionInputs(None, {0: Measurements(wheels=wheels)}), Streams({"command": command}, {}, "husky")


def test_wheels_faster_than_any_command_bear_no_segment_where_nothing_else_tells_how_long_a_metre_is():
    assert make_audit_findings(fused(), *wheels_alone(0.9)).facts.undecided == ()
    told = make_audit_findings(fused(), *wheels_alone(1.25))
    assert told.facts.undecided == ("wheel_odometry",)
    (finding,) = told.findings
    assert (finding.code, finding.numbers) == ("faster-than-commanded", {"speed_ratio": pytest.approx(1.25)})
    assert proposed(finding) == {"read": {"odometry_scale": {"wheel_odometry": 0.8}}}
    assert proposed(finding, alternative=1) == {"read": {"topics": {"command": []}}}
