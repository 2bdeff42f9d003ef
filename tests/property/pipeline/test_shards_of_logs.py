"""Shares of a batch: each log is in one of them, wherever the folder is mounted, and stays there when other logs are added."""

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from tcpipe.pipeline.log_sources import LogSource, group_possible_duplicates, select_shard

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


@given(st.lists(st.sampled_from([b"", b"x", b"y", b"x" * 5000, b"y" + b"x" * 4999]), max_size=8))
def test_what_is_the_same_is_always_alike(tmp_path_factory, contents):
    folder, found = tmp_path_factory.mktemp("alike"), list[LogSource]()
    for number, data in enumerate(contents):
        (path := folder / f"{number}.mcap").write_bytes(data)
        found.append(LogSource((path,), ((len(data), 0),)))
    groups = group_possible_duplicates(found)
    assert sorted(at for group in groups for at in group) == list(range(len(contents)))
    for at, data in enumerate(contents):
        (group,) = (group for group in groups if at in group)
        assert {other for other, same in enumerate(contents) if same == data} <= set(group)
        assert {len(contents[other]) for other in group} == {len(data)}
