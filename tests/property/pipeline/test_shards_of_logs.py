"""Shares of a batch: each log is in one of them, wherever the folder is mounted, and whatever other logs there are."""

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from tcpipe.pipeline.log_sources import LogSource, select_shard

PLACES = st.lists(st.text("ab/0_", min_size=1, max_size=12), unique=True, max_size=30)


def sources(places, folder="/data"):
    return [LogSource((Path(folder, place),), (), place=place) for place in places]


@given(PLACES, st.integers(1, 12), st.text("ab/0_", min_size=13, max_size=20))
def test_shares_are_disjoint_together_whole_and_do_not_depend_on_other_logs(places, count, another):
    shares = [select_shard(sources(places), (index, count)) for index in range(1, count + 1)]
    assert sorted(log.place for share in shares for log in share) == sorted(places)
    for index, share in enumerate(shares, start=1):
        more = select_shard(sources([another, *places], folder="/mnt/elsewhere"), (index, count))
        assert [log.place for log in more if log.place != another] == [log.place for log in share]


def test_a_share_is_a_fair_part():
    logs = sources([f"run_{number}.mcap" for number in range(400)])
    assert all(25 <= len(select_shard(logs, (index, 8))) <= 75 for index in range(1, 9))
