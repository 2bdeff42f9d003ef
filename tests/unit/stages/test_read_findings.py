"""Findings of reading about topics, by hand."""

import numpy as np
import pytest

from tcpipe.logs.clocks import AlignedClocks, SimulatedClock, TopicTimeline
from tcpipe.logs.messages import Readings
from tcpipe.logs.roles import PlayedRole, RoleAssignment
from tcpipe.power.readings import PowerReadings
from tcpipe.stages.read import make_read_report
from tcpipe.stages.read_sources import TopicReadings
from tcpipe.tables.facts import ClockStep
from tcpipe.tables.findings import Subject, make_finding
from tcpipe.tables.levels import Sensor

COUNT = 200
SENSOR = Sensor("/fix", "sensor_msgs/msg/NavSatFix", "gps", "the only one", placed_by="tf_static")


def timeline(**said):
    stamp_ns = np.arange(COUNT, dtype=np.int64) * 100_000_000
    told = {"row": np.arange(COUNT), "stamp_ns": stamp_ns, "clock_epoch": np.zeros(COUNT, np.int16), "source": "header"}
    return TopicTimeline(**{**told, "why": "header-follows-log-time", "offset_s": 0.5, **said})


def source(*, role="gnss", header=True, **said):
    row = np.arange(COUNT)
    found = Readings(**{"row": row, "log_time_ns": row, "header_ns": row if header else None, "columns": {}, **said})
    return TopicReadings("/fix", role, SENSOR.type_name, COUNT, {}, found)


def read(topic=None, clock=None, *, steps=(), power=None, findings=(), timelines=None, simulated=None):
    roles = {"gnss": PlayedRole("gnss", ("/fix",), SENSOR.type_name, "the only one")}
    assignment = RoleAssignment("husky", "its topics", roles, {"/other": "it is slower"}, findings=findings)
    clocks = AlignedClocks({"/fix": clock or timeline()} if timelines is None else timelines, list(steps), simulated)
    return make_read_report(
        assignment,
        [topic or source()],
        clocks,
        power=power or PowerReadings(),
        sensors={"gnss": SENSOR},
        offset_s={"gnss": 0.25},
    )


def codes(report):
    return [of.code for of in report.findings]


@pytest.mark.parametrize(("lost", "said"), [(2, False), (3, True)])
def test_unused_messages_are_told_beyond_one_in_a_hundred_whoever_dropped_them(lost, said):
    found = read(source(dropped={"not_gga": 150, "no_fix": lost - 1}), timeline(dropped={"repeated": 1})).findings
    assert (len(found) == 1) == said
    if said:
        assert (found[0].code, found[0].subject) == ("messages-unused", Subject("role", "gnss"))
        assert found[0].names == {"topic": "/fix", "reasons": "no_fix, repeated"}
        counts = {"no_fix_count": 2.0, "repeated_count": 1.0}
        assert found[0].numbers == {"unused_fraction": 3 / 200, "messages_count": 200.0, **counts}


def test_a_topic_whose_time_is_the_recorders_says_why_if_it_has_stamps():
    by_log = timeline(source="log", why="header-repeats")
    (found,) = read(source(), by_log).findings
    assert (found.code, found.severity, found.names["reason"]) == ("log-time-used", "warning", "header-repeats")
    assert read(source(header=False), by_log).findings == ()
    assert read(source(), timeline(source="log", why="recipe")).findings[0].severity == "note"


def test_stamps_that_were_replaced_or_moved_are_told():
    replaced, moved = read(source(), timeline(notes={"stamps_replaced": 4}, moved_s=(0.0, -0.5))).findings
    assert (replaced.code, replaced.numbers) == ("stamps-replaced", {"stamps_count": 4.0})
    assert (moved.code, moved.numbers) == ("topic-clock-offset", {"moved_s": -0.5, "clock_epoch": 1.0})
    assert read(source(), timeline(notes={"stamps_replaced": 0})).findings == ()


def test_the_years_between_a_simulation_and_the_wall_clock_are_no_delay_to_be_set():
    stamp_ns = np.array([10**9, 10**10])
    clock = SimulatedClock(stamp_ns, stamp_ns, frozenset({"/odom"}))
    by_log = {"source": "log", "why": "no-header"}
    (found,) = read(source(header=False), timeline(**by_log, moved_s=(-1.7e9,)), simulated=clock).findings
    assert (found.code, found.names["reason"]) == ("log-time-used", "no-header")
    assert read(source(header=False), timeline(**by_log, moved_s=(0.0,)), simulated=clock).findings == ()


def test_a_topic_without_a_timeline_plays_no_part_but_says_what_it_lacks():
    odd = make_finding("geoid-separation-missing", Subject("role", "gnss"))
    found = read(source(findings=(odd,), dropped={"no_fix": COUNT}), timelines={})
    assert codes(found) == ["geoid-separation-missing", "messages-unused"]
    assert found.facts.roles["gnss"] == {}


def test_steps_of_the_clock_divide_epochs_and_each_warning_comes_once():
    step = ClockStep(3_000_000_000, -2.5, ("/fix", "/imu"))
    missing = make_finding("no-imu", Subject("role", "imu"))
    found = read(steps=[step, step], findings=(missing, missing))
    assert codes(found) == ["no-imu", "clock-step"]
    assert found.findings[1].numbers == {"step_s": -2.5, "at_s": 3.0}
    assert found.findings[1].span_s == (3.0, 3.0)
    assert found.findings[1].names == {"topics": "/fix, /imu"}
    assert (found.facts.epochs, found.facts.clock_steps) == (3, (step, step))
    assert read(steps=[step]).facts.epochs == 2


def test_a_rate_is_that_inside_epochs_and_unknown_of_one_row():
    stamp_ns = np.array([0, 100, 200, 5200, 5300]) * 1_000_000
    two = timeline(stamp_ns=stamp_ns, clock_epoch=np.array([0, 0, 0, 1, 1], np.int16))
    assert read(clock=two).facts.roles["gnss"]["/fix"].rate_hz == pytest.approx(10.0)
    single = timeline(stamp_ns=stamp_ns[:1], clock_epoch=np.zeros(1, np.int16), row=np.arange(1))
    assert read(clock=single).facts.roles["gnss"]["/fix"].rate_hz is None
