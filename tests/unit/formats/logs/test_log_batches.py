"""Piece by piece: the pieces are the tables, in order, none larger than asked."""

import pyarrow as pa
import pytest
from random_messages import (
    ROS1,
    ROS2,
    TYPES,
    random_messages,
    table_bytes,
    write_bag,
    write_mcap,
    write_rosbag2,
)

from tcpipe.formats.logs import chunk_reading
from tcpipe.formats.logs.log_file import open_log

LIMIT_BYTES = 40_000
WRITERS = {
    "mcap": lambda path, messages: write_mcap(path / "a.mcap", messages, chunk_bytes=4096),
    "mcap unchunked": lambda path, messages: write_mcap(path / "a.mcap", messages, use_chunking=False),
    "bag": lambda path, messages: write_bag(path / "a.bag", messages),
    "db3": lambda path, messages: write_rosbag2(path / "a", messages),
}


def made(kind, *, ragged=True, count=80, types=TYPES):
    return random_messages(1, count=count, ragged=ragged, types=types, store=ROS1 if kind == "bag" else ROS2)


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("ragged", [False, True])
def test_the_pieces_are_the_tables(tmp_path, kind, ragged):
    path = WRITERS[kind](tmp_path, made(kind, ragged=ragged))
    with open_log(path) as log:
        whole = log.tables(log.topics)
        pieces = list(log.batches(log.topics, batch_bytes=LIMIT_BYTES))
        assert log.damage == []
    assert len(pieces) > 3
    assert set(pieces[-1]) == set(whole)
    for name, table in whole.items():
        parts = [piece[name] for piece in pieces if name in piece]
        assert table_bytes(pa.concat_tables(parts)) == table_bytes(table)
    assert max(sum(table.nbytes for table in piece.values()) for piece in pieces) < 2 * LIMIT_BYTES


def test_rows_swapped_nearby_are_sorted_and_rows_far_behind_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(chunk_reading, "GROUP_BYTES", 4096)
    messages = random_messages(2, count=3000, types=("std_msgs/msg/ColorRGBA",))
    swapped = [message for pair in zip(messages[1::2], messages[::2], strict=True) for message in pair]
    with open_log(write_mcap(tmp_path / "near.mcap", swapped, chunk_bytes=2048)) as log:
        parts = [piece["/ColorRGBA"] for piece in log.batches(["/ColorRGBA"], batch_bytes=20_000)]
        assert log.damage == []
    stamps = pa.concat_tables(parts)["log_time_ns"].to_pylist()
    assert len(parts) > 5
    assert stamps == [message.log_time_ns for message in messages]
    late = [*messages[10:], *messages[:10]]
    with open_log(write_mcap(tmp_path / "far.mcap", late, chunk_bytes=2048)) as log:
        parts = [piece["/ColorRGBA"] for piece in log.batches(["/ColorRGBA"], batch_bytes=20_000)]
        (finding,) = log.findings
    assert sum(part.num_rows for part in parts) == len(messages)
    assert (finding.code, finding.severity) == ("messages-unordered", "note")
    assert finding.numbers["places_count"] == 10
