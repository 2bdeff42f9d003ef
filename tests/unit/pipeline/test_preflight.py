"""Topics, rates and losses of preflight, by hand; tests/end_to_end compares its promise with an ingest."""

from tcpipe.pipeline.preflight import ExpectedYield, RoleTopic, find_missing, find_slow
from tcpipe.recipe import ReadConfig
from tcpipe.tables.facts import EnergyBudget


def promise(segments=50, budget=None):
    return ExpectedYield(60.0, 70.0, segments, 3000.0, 100.0, 3100.0, {"kept": 50.0, "gap": 20.0}, {}, budget)


def test_what_is_slow_or_absent_for_most_of_the_time_is_found():
    topics = (RoleTopic("imu", "/imu", 20.0, 50.0, 1.0), RoleTopic("gnss", "/fix", 5.0, 1.0, 0.4))
    slow, silent = find_slow((*topics, RoleTopic("command", "/cmd_vel", 10.0, None, 0.1)), promise(), 60.0)
    assert (slow.code, slow.subject.name, slow.names["topic"]) == ("rate-too-low", "imu", "/imu")
    assert slow.numbers == {"rate_hz": 20.0, "wanted_hz": 50.0}
    assert (silent.code, silent.subject.name, silent.numbers) == ("topic-incomplete", "gnss", {"present_fraction": 0.4})
    budget = EnergyBudget(
        50, 300.0, total=0.05, position=0.01, rate=0.048, current=0.0, voltage=0.0, at_20_hz=0.012, common=0.0
    )
    (ruled,) = find_slow((), promise(budget=budget), 60.0)
    assert (ruled.code, ruled.numbers["at_20_hz_fraction"]) == ("power-rate-dominates", 0.012)
    assert [of.code for of in find_slow((), promise(segments=0), 20.0)] == ["log-too-short"]


def test_a_role_that_the_recipe_does_without_is_not_missed_unless_no_sample_is_left():
    def missing(roles, read):
        return [of.subject.name for of in find_missing(roles, read)]

    without = ReadConfig(topics={"wheel_odometry": [], "power": []})
    assert missing({"pose", "imu"}, without) == ["power", "command"]
    assert missing({"imu"}, ReadConfig()) == ["gnss", "power", "wheel_odometry", "command"]


def test_a_missing_role_is_no_note_before_it_is_too_late_to_record_one():
    severities = {of.code: of.severity for of in find_missing(set(), ReadConfig())}
    assert severities == {
        "no-gnss": "error", "no-imu": "warning", "no-wheel-odometry": "warning", "no-power": "error", "no-command": "warning"
    }  # fmt: skip
