"""Which stamp rules, where a clock steps, and in what order messages were measured."""

import numpy as np
import pytest

from tcpipe.logs.clocks import TopicTimeline, TopicTimes, settle_clocks

S = 1_000_000_000
START = 1_700_000_000 * S


def log_times(rate_hz: float = 20.0, duration_s: float = 60.0) -> np.ndarray:
    return START + np.round(np.arange(0, duration_s, 1 / rate_hz) * S).astype(np.int64)


def times(log: np.ndarray, header: np.ndarray | None, **options) -> TopicTimes:
    content = options.pop("content", np.arange(len(log), dtype=np.float64)[:, None])
    return TopicTimes(log, header, tuple(content.T), **options)


def settle(**topics: TopicTimes):
    found = settle_clocks(topics)
    return found.timelines, found.steps


def one(topic: TopicTimes) -> tuple[TopicTimeline, int]:
    found, steps = settle(topic=topic)
    return found["topic"], len(steps)


def test_a_header_that_follows_rules_to_the_nanosecond() -> None:
    log = log_times()
    header = log - 12_345_678
    found, steps = one(times(log, header))
    assert found.source == "header"
    assert steps == 0
    np.testing.assert_array_equal(found.stamp_ns, header)
    np.testing.assert_array_equal(found.row, np.arange(len(log)))
    assert found.offset_s == -0.012345678
    assert found.dropped == found.notes == {}


FOLLOWS = "header-follows-log-time"
HEADERS = {
    "none": (lambda _: None, "log", "no-header"),
    "unset": (np.zeros_like, "log", "header-unset"),
    "of a clock of its own": (lambda log: START + (log - START) * 2, "log", "header-differs-from-log-time"),
    "whole seconds of new content": (lambda log: log // S * S, "log", "header-repeats"),
    "step of 0.4 s": (lambda log: log + np.where(log >= START + 30 * S, 400_000_000, 0), "header", FOLLOWS),
    "drift of 1.5 s in a minute": (lambda log: log + (log - START) // 40, "header", FOLLOWS),
    "delay that comes back": (
        lambda log: log - np.where((log >= START + 20 * S) & (log < START + 26 * S), 800_000_000, 0),
        "header",
        FOLLOWS,
    ),
}


@pytest.mark.parametrize("name", HEADERS)
def test_headers_without_a_lasting_step_rule_or_leave_the_log_time(name: str) -> None:
    log, (make, source, why) = log_times(), HEADERS[name]
    found, steps = one(times(log, make(log)))
    assert (found.source, found.why, steps) == (source, why, 0)
    np.testing.assert_array_equal(found.stamp_ns, (log if source == "log" else make(log))[found.row])


def test_simulated_time_is_kept_and_topics_without_a_header_join_it() -> None:
    log = log_times()
    simulated = log - START + 47_600_000_000
    found, steps = settle(odom=times(log, simulated), imu=times(log, simulated - 5_000_000), command=times(log, None))
    assert steps == []
    assert (found["odom"].stamp_ns[0], found["odom"].source) == (47_600_000_000, "header")
    assert found["command"].source == "log"
    assert abs(found["command"].stamp_ns - simulated).max() < 5_000_001  # on the headers' clock, to within their delays
    assert found["command"].moved_s[0] < -1e9
    assert found["odom"].moved_s == (0.0,)


def test_one_receiver_on_gps_time_is_brought_to_the_clock_of_the_others() -> None:
    log = log_times()
    found, _ = settle(gnss=times(log, log + 18 * S), imu=times(log, log - 3_000_000), odom=times(log, log - 1_000_000))
    assert found["gnss"].source == "header"
    assert abs(found["gnss"].moved_s[0] + 18.0) < 0.01
    assert abs(found["gnss"].stamp_ns - log).max() <= 3_000_000
    assert found["imu"].moved_s == found["odom"].moved_s == (0.0,)


def test_a_lasting_step_opens_an_epoch_for_every_topic() -> None:
    log, slow = log_times(), log_times(rate_hz=1.0)
    at = START + 30 * S
    found, steps = settle(
        imu=times(log, log + np.where(log >= at, 2 * S, 0)),
        gnss=times(slow, slow + np.where(slow >= at, 2 * S, 0)),
        command=times(log, None),
    )
    assert len(steps) == 1
    assert steps[0].step_s == 2.0
    assert steps[0].topics == ("gnss", "imu")
    for name, rows in (("imu", log), ("gnss", slow), ("command", log)):
        np.testing.assert_array_equal(found[name].clock_epoch, (rows >= at).astype(int))


def test_a_stalled_recorder_is_no_step() -> None:
    header = log_times(rate_hz=200.0)
    log = header.copy()
    for begin, length in ((10, 3), (40, 8)):  # nothing is written for so long, then all of it within 10 ms
        stalled = (header >= START + begin * S) & (header < START + (begin + length) * S)
        log[stalled] = START + (begin + length) * S + np.linspace(0, 1e7, stalled.sum()).astype(np.int64)
    log = np.maximum.accumulate(log)
    found, steps = one(times(log, header))
    assert (steps, found.source, found.dropped) == (0, "header", {})
    np.testing.assert_array_equal(found.stamp_ns, header)


def set_back(log: np.ndarray, seconds: float) -> np.ndarray:
    """Log times in order, of a log whose host set its clock at half a minute."""
    return np.sort(np.where(log < START + 30 * S, log, log - round(seconds * S)))


def test_a_host_that_sets_its_clock_back_opens_an_epoch_for_all_and_loses_what_is_passed_twice() -> None:
    fast, slow = set_back(log_times(rate_hz=100.0), 3.0), set_back(log_times(), 3.0)
    found, steps = settle(imu=times(fast, fast), odometry=times(slow, slow), command=times(slow, None))
    (step,) = steps
    assert step.topics == ()
    assert step.step_s == pytest.approx(-3.0, abs=0.1)
    for name, log in (("imu", fast), ("odometry", slow), ("command", slow)):
        timeline = found[name]
        np.testing.assert_array_equal(timeline.stamp_ns, log[timeline.row])
        before = timeline.stamp_ns[timeline.clock_epoch == 0], timeline.stamp_ns[timeline.clock_epoch == 1]
        assert START + 26 * S - S // 10 <= before[0].max() < START + 27 * S
        assert START + 30 * S <= before[1].min() < START + 31 * S + S // 10
        assert timeline.dropped == {"clock_set_back": len(log) - len(timeline.row)}


def test_one_topic_at_twice_its_rate_and_drivers_that_catch_up_are_no_step() -> None:
    fast, slow = log_times(rate_hz=100.0), log_times()
    twice = np.sort(np.concatenate((fast, fast[1000:1300] + S // 300)))
    assert settle(imu=times(twice, twice), odometry=times(slow, slow), visual=times(slow, slow))[1] == []

    def stalled(log: np.ndarray) -> np.ndarray:
        late = (log >= START + 20 * S) & (log < START + 24 * S)
        return np.where(late, log + (START + 24 * S - log) // 2, log)

    assert settle(imu=times(stalled(fast), stalled(fast)), odometry=times(stalled(slow), stalled(slow)))[1] == []


def test_single_wrong_stamps_are_replaced_and_counted() -> None:
    log = log_times()
    header = log - 1_000_000
    header[100] += 86_400 * S  # a day ahead
    header[200] += 3 * S  # measured after it was received
    header[300] = 0
    found, steps = one(times(log, header))
    assert steps == 0
    assert found.notes == {"stamps_replaced": 3}
    assert len(found.row) == len(log)
    np.testing.assert_array_equal(found.stamp_ns, log - 1_000_000)


def test_messages_late_by_less_than_a_second_are_sorted_others_dropped() -> None:
    log = log_times()
    header = log.copy()
    header[100] -= 725_000_000
    header[200] -= 4 * S
    found, _ = one(times(log, header))
    assert found.notes == {"sorted": 1}
    assert found.dropped == {"late": 1}
    assert np.all(np.diff(found.stamp_ns) > 0)
    assert 100 in found.row
    assert 200 not in found.row


def test_exact_duplicates_and_repeated_stamps_are_told_apart() -> None:
    log = log_times()
    header, content = log.copy(), np.arange(len(log), dtype=np.float64)[:, None]
    header[101], content[101] = header[100], content[100]
    header[201] = header[200]
    content[300] = content[301] = np.nan
    header[301] = header[300]
    found, _ = one(times(log, header, content=content))
    assert found.dropped == {"duplicates": 2, "repeated_stamps": 1}
    assert len(found.row) == len(log) - 3
    assert {101, 201, 301}.isdisjoint(found.row)


def test_the_recipe_chooses_the_clock_and_shifts_it() -> None:
    log = log_times()
    header = log - 5 * S
    header[7] = 0
    found, _ = settle(a=times(log, header, prefer="log", offset_ns=250_000_000), b=times(log, header, prefer="header"))
    assert found["a"].source == "log"
    np.testing.assert_array_equal(found["b"].stamp_ns, np.delete(header, 7))
    assert found["b"].dropped == {"unset_stamps": 1}
    # The log-time topic joins the others' clock, 5 s behind, before its own offset is added.
    np.testing.assert_array_equal(found["a"].stamp_ns, log - 5 * S + 250_000_000)


@pytest.mark.parametrize("rate", [0.34, 3.0])
def test_in_a_simulation_the_headers_rule_at_whatever_rate_it_runs(rate):
    """Two minutes of the log are 41 s, or 360 s, of the simulation, which pauses for 20 s of the log; no epoch begins."""
    log = log_times(duration_s=120.0)
    wall_s = (log - START) / S
    running_s = wall_s - np.clip(wall_s - 60.0, 0.0, 20.0)
    simulated = np.round((5.0 + rate * running_s) * S).astype(np.int64)
    unset = np.where(np.arange(len(log)) < 4, 0, simulated)
    found, steps = settle(
        odom=times(log, simulated), imu=times(log + 1_000_000, unset), wall=times(log, log), command=times(log, None)
    )
    assert steps == []
    assert [found[name].source for name in ("odom", "imu", "wall", "command")] == ["header", "header", "log", "log"]
    np.testing.assert_array_equal(found["odom"].stamp_ns, np.unique(simulated))
    for name in ("wall", "command"):
        assert len(found[name].row) == len(log)
        assert (
            abs(found[name].stamp_ns - simulated).max() <= rate * 0.05 * S + 1
        )  # what the clock did within one period
    assert found["imu"].notes["stamps_replaced"] == 4
    assert abs(found["imu"].stamp_ns[:4] - simulated[:4]).max() < 0.01 * S


def test_a_clock_topic_makes_late_times_simulated_too():
    log = log_times(duration_s=120.0)
    slow = log - (log - START) // 2
    topics = {"odom": times(log, slow)}
    assert settle_clocks(topics).timelines["odom"].source == "log"
    found = settle_clocks(topics, clock_published=True)
    assert found.timelines["odom"].source == "header"
    (simulated,) = found.simulated.find_simulated_time()
    assert simulated.numbers == {"rate_fraction": pytest.approx(0.5, rel=1e-3)}


def test_a_simulation_that_is_reset_or_a_board_that_counts_from_its_start_is_no_clock_of_the_log():
    log = log_times()
    again = 10 * S + (log - START) % (30 * S)
    assert settle_clocks({"odom": times(log, again)}).simulated is None
    uptime = 10 * S + (log - START)
    assert settle_clocks({"imu": times(log, uptime), "gnss": times(log, log)}).simulated is None
