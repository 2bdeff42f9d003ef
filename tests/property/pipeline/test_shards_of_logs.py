"""Shares of a batch: each log is in one of them, wherever the folder is mounted, and stays there when other logs are added."""

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from tcpipe.pipeline.log_sources import LogSource, select_shard

PLACES = st.lists(st.text("ab/0_", min_size=1, max_size=12), unique=True, max_size=30)


def sources(places, folder="/data"):
    return [LogSource((Path(folder, place),), (), place=place) for place in places]


@given(PLACES, st.integers(1, 12))
def test_shares_are_disjoint_and_together_whole_and_no_other_log_moves_one(places, count):
    shares = [select_shard(sources(places), (index, count)) for index in range(1, count + 1)]
    assert sorted(at for share in shares for at in share) == list(range(len(places)))
    for index, share in enumerate(shares, start=1):
        assert select_shard(sources(places, folder="/mnt/elsewhere"), (index, count)) == share
        more = select_shard(sources(["A", *places]), (index, count))
        assert [at - 1 for at in more if at] == share
