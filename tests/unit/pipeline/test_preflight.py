"""What preflight says of topics, rates and losses: by hand. That it promises what ingesting gives, tests/end_to_end shows."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.logs.topics import Topic
from tcpipe.motion.remedies import REMEDIES
from tcpipe.pipeline.preflight import Promise, RoleTopic, _hourly_std, _mend, _missing_roles, _unplaced, record_command
from tcpipe.recipe import ReadConfig
from tcpipe.tables.bits import DropReason, Loss, name_of
from tcpipe.tables.facts import EnergyBudget


def topic(name, type_name="std_msgs/msg/String", encoding="cdr"):
    return Topic(name, type_name, 10, 0, 10**9, encoding, "")


def test_the_command_records_what_is_read_and_a_simulations_clock():
    topics = [topic("/fix"), topic("/a b; rm"), topic("/camera"), topic("/clock", "rosgraph_msgs/msg/Clock")]
    told = record_command(topics, ["/fix", "/a b; rm", "/fix", "/gone"])
    assert told == "ros2 bag record -s mcap -o drive /fix '/a b; rm' /clock"
    assert record_command([topic("/fix", encoding="ros1")], ["/fix"]) == "rosbag record --lz4 -O drive /fix"
    assert record_command([topic("/fix", encoding="csv")], ["/fix"]) == ""
    assert record_command(topics, []) == ""


def test_sensors_that_nothing_places_want_transforms_recorded():
    lines = [
        "gnss: nothing places frame 'gps' of /fix, it is assumed",
        "imu: nothing places frame 'a' of /b",
        "imu: late",
    ]
    assert list(_unplaced(lines)) == [
        "gnss, imu: no /tf_static tells where they sit: record it, or say it (recipe key read.placement)"
    ]
    assert list(_unplaced(lines[2:])) == []


def promise(segments=50, budget=None):
    return Promise(60.0, 70.0, segments, 3000.0, 100.0, 3100.0, {"kept": 50.0, "gap": 20.0}, {}, budget)


def test_what_is_slow_or_absent_for_most_of_the_time_is_said():
    topics = (RoleTopic("imu", "/imu", 20.0, 50.0, 1.0), RoleTopic("gnss", "/fix", 5.0, 1.0, 0.4))
    slow, silent = _mend((*topics, RoleTopic("command", "/cmd_vel", 10.0, None, 0.1)), promise(), 60.0)
    assert slow == "imu: /imu comes at 20 Hz, 50 are wanted: raise the rate of its driver"
    assert silent.startswith("gnss: /fix is there for 40% of the log only")
    budget = EnergyBudget(50, 300.0, total=0.05, position=0.01, rate=0.048, current=0.0, voltage=0.0, at_20_hz=0.012)
    (line,) = _mend((), promise(budget=budget), 60.0)
    assert line == "power: its rate rules the error of E: 5.0% would be 1.2% at 20 Hz"
    assert [line[:7] for line in _mend((), promise(segments=0), 20.0)] == ["the log", "there i"]
    (line,) = _mend((), replace(promise(segments=0), ledger_m={"gap": 90.0, "standing": 1.0}), 60.0)
    assert "positions too uncertain" in line, "driving straighter would win nothing"


def test_a_role_that_the_recipe_does_without_is_not_missed_unless_no_sample_is_left():
    without = ReadConfig(topics={"wheel_odometry": [], "power": []})
    assert list(dict(_missing_roles({"pose", "imu"}, without))) == ["power", "command"]
    assert list(dict(_missing_roles({"imu"}, ReadConfig()))) == ["gnss", "wheel_odometry", "power", "command"]


def test_the_deviation_of_a_count_is_that_of_its_windows():
    # Windows of ten seconds that hold 10, 0, 10, 0, 10, 0: each deviates by 5.48, their sum by 13.4, and a minute is a sixtieth of an hour.
    start_s = np.concatenate([np.arange(10) + begin for begin in (0, 20, 40)])
    assert _hourly_std((start_s * 1e9).astype(np.int64), 60.0) == pytest.approx(60 * np.sqrt(6) * np.sqrt(30))
    assert _hourly_std(np.zeros(0, np.int64), 60.0) == 0.0
    assert _hourly_std(np.zeros(3, np.int64), 29.0) is None


def test_every_loss_has_a_remedy():
    assert set(REMEDIES) == {name_of(bit) for bit in (*DropReason, *Loss)}
