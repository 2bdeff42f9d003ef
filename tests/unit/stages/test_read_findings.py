"""What reading says of topics, by hand."""

import numpy as np
import pytest

from tcpipe.logs.clocks import ON_SIMULATED_CLOCK, Settled, Timeline
from tcpipe.logs.messages import Readings
from tcpipe.logs.roles import PlayedRole, RoleAssignment
from tcpipe.power.readings import PowerReadings
from tcpipe.stages.read_findings import read_findings
from tcpipe.stages.read_sources import TopicReadings
from tcpipe.tables.facts import ClockStep, PowerSign
from tcpipe.tables.levels import Sensor

COUNT = 200
SENSOR = Sensor("/fix", "sensor_msgs/msg/NavSatFix", "gps", "the only one", placed_by="tf_static")


def timeline(**said):
    stamp_ns = np.arange(COUNT, dtype=np.int64) * 100_000_000
    told = {"row": np.arange(COUNT), "stamp_ns": stamp_ns, "epoch": np.zeros(COUNT, np.int16), "source": "header"}
    return Timeline(**{**told, "why": "its stamps are good", "offset_s": 0.5, **said})


def source(*, role="gnss", header=True, **said):
    row = np.arange(COUNT)
    found = Readings(**{"row": row, "log_time_ns": row, "header_ns": row if header else None, "columns": {}, **said})
    return TopicReadings("/fix", role, SENSOR.type_name, COUNT, {}, found)


def read(topic=None, clock=None, *, steps=(), power=None, warnings=(), timelines=None):
    roles = {"gnss": PlayedRole("gnss", ("/fix",), SENSOR.type_name, "the only one")}
    assignment = RoleAssignment("husky", "its topics", roles, {"/other": "it is slower"}, warnings=warnings)
    clocks = Settled({"/fix": clock or timeline()} if timelines is None else timelines, list(steps))
    return read_findings(
        assignment,
        [topic or source()],
        clocks,
        power=power or PowerReadings(),
        sensors={"gnss": SENSOR},
        offset_s={"gnss": 0.25},
    )


def test_facts_of_a_plain_topic():
    found = read()
    assert found.warnings == ()
    facts = found.facts
    assert (facts.robot.name, facts.left_out, facts.epochs) == ("husky", {"/other": "it is slower"}, 1)
    assert (facts.time_offset_s, facts.power) == ({"gnss": 0.25}, None)
    role = facts.roles["gnss"]
    assert (role.why, role.frame, role.placed_by) == ("the only one", "gps", "tf_static")
    topic = role.topics["/fix"]
    assert (topic.type, topic.messages, topic.rows) == (SENSOR.type_name, COUNT, COUNT)
    assert topic.rate_hz == pytest.approx(10.0)
    assert (topic.time.source, topic.time.offset_s) == ("header", 0.5)


@pytest.mark.parametrize(("lost", "said"), [(2, False), (3, True)])
def test_unused_messages_are_told_beyond_one_in_a_hundred_whoever_dropped_them(lost, said):
    lines = read(source(dropped={"not_gga": 150, "no_fix": lost - 1}), timeline(dropped={"repeated": 1})).warnings
    assert (len(lines) == 1) == said
    if said:
        assert lines[0] == "gnss: /fix: 3 of 200 messages are not used (no_fix 2, repeated 1)"


def test_fixes_of_which_none_is_used_place_no_track():
    nothing = source(dropped={"no_fix": COUNT}, row=np.arange(0))
    assert read(nothing).warnings[0].endswith(": the track lies in a local frame and cannot be placed on a map")
    assert "local frame" not in read(source(dropped={"no_fix": COUNT})).warnings[0]
    for role in ("command", "imu"):
        assert "local frame" not in read(source(role=role, dropped={"invalid": COUNT}, row=np.arange(0))).warnings[0]


def test_a_topic_whose_time_is_the_recorders_says_why_if_it_has_stamps():
    by_log = timeline(source="log", why="its header stamps stand still")
    assert read(source(), by_log).warnings == ("gnss: /fix: log time rules, since its header stamps stand still",)
    assert read(source(header=False), by_log).warnings == ()


def test_stamps_that_were_replaced_or_moved_are_told():
    replaced, moved = read(source(), timeline(notes={"stamps_replaced": 4}, moved_s=(0.0, -0.5))).warnings
    assert replaced == "gnss: /fix: 4 header stamps are unset or wrong and were taken from the log time"
    assert moved.startswith(
        "gnss: /fix: its clock is not the other topics': its stamps were moved by -0.500 s in epoch 1"
    )
    assert read(source(), timeline(notes={"stamps_replaced": 0})).warnings == ()


def test_the_years_between_a_simulation_and_the_wall_clock_are_no_delay_to_be_set():
    why = f"it has no stamps; {ON_SIMULATED_CLOCK}"
    (line,) = read(source(header=False), timeline(source="log", why=why, moved_s=(-1.7e9,))).warnings
    assert line == f"gnss: /fix: log time rules, since {why}"
    assert read(source(header=False), timeline(source="log", why=why, moved_s=(0.0,))).warnings == ()


def test_a_topic_without_a_timeline_plays_no_part_but_says_what_it_lacks():
    found = read(source(warnings=("it is odd",), dropped={"no_fix": COUNT}), timelines={})
    assert found.warnings[0] == "gnss: /fix: it is odd"
    assert len(found.warnings) == 2
    assert found.facts.roles["gnss"].topics == {}


def test_steps_of_the_clock_divide_epochs_and_each_warning_comes_once():
    step = ClockStep(1000, -2.5, ("/fix", "/imu"))
    found = read(steps=[step, step], warnings=("no camera", "no camera"))
    assert len(found.warnings) == 2
    assert found.warnings[0] == "no camera"
    assert "steps by -2.500 s at log time 1000 ns on /fix, /imu: a new epoch begins there" in found.warnings[1]
    assert (found.facts.epochs, found.facts.clock_steps) == (3, (step, step))
    assert read(steps=[step]).facts.epochs == 2


def test_a_rate_is_that_inside_epochs_and_unknown_of_one_row():
    stamp_ns = np.array([0, 100, 200, 5200, 5300]) * 1_000_000
    two = timeline(stamp_ns=stamp_ns, epoch=np.array([0, 0, 0, 1, 1], np.int16))
    assert read(clock=two).facts.roles["gnss"].topics["/fix"].rate_hz == pytest.approx(10.0)
    single = timeline(stamp_ns=stamp_ns[:1], epoch=np.zeros(1, np.int16), row=np.arange(1))
    assert read(clock=single).facts.roles["gnss"].topics["/fix"].rate_hz is None


POWER = PowerReadings(averaged=True, warnings=("power: odd",), current_sign="drawn", includes=("computers",))


def test_notes_that_count_nothing_are_left_out_and_powers_are_told():
    found = read(source(notes={"zero": 0, "set_aside": 3}), power=POWER)
    assert found.facts.roles["gnss"].topics["/fix"].notes == {"set_aside": 3}
    assert found.facts.power == PowerSign("drawn", averaged=True, includes=("computers",))
    assert found.warnings == ("power: odd",)
