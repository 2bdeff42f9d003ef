"""How much of a drive a topic covers: silences between the pieces that hold it are not covered."""

from dataclasses import replace

import pytest

from tcpipe.logs.topics import Topic, compute_silence_ns, find_short_topics, format_coverage

S = 1_000_000_000


@pytest.mark.parametrize(
    ("spans_s", "count", "silent_s"),
    [
        ([(0, 10), (10, 20), (50, 60)], 1000, 30),
        ([(50, 60), (0, 20), (10, 15)], 1000, 30),  # in any order, one inside another
        ([(0, 10), (14, 20)], 1000, 0),  # a short pause
        ([(0, 1), (30, 31), (60, 61)], 3, 0),  # one message in 20 s: its period
        ([(0, 60)], 1000, 0),
        ([], 0, 0),
    ],
)
def test_silences_are_summed_where_they_are_no_period(spans_s, count, silent_s):
    assert compute_silence_ns([(first * S, last * S) for first, last in spans_s], count) == silent_s * S


def test_a_topic_that_paused_for_most_of_the_drive_covers_little():
    whole = Topic("/odom", "nav_msgs/msg/Odometry", 600, 0, 60 * S, "cdr", "")
    paused = replace(whole, name="/wheel/odom", message_count=200, silent_ns=40 * S)
    assert find_short_topics([whole, paused], [whole, paused]) == {"/wheel/odom"}
    assert format_coverage(paused) == "200 messages over 60.0 s, silent for 40.0 s of them"
    assert find_short_topics([replace(paused, silent_ns=20 * S)], [whole]) == frozenset()
