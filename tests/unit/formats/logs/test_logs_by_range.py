"""Logs in a bucket: what is fetched of them is counted; they are the same recording wherever they lie."""

import shutil

import numpy as np
import pytest
from mcap.writer import CompressionType
from random_messages import (
    ROS1,
    ROS2,
    Message,
    assert_same,
    expected_columns,
    random_messages,
    table_bytes,
    write_bag,
    write_mcap,
)
from rosbags.rosbag1 import Writer as BagWriter
from wheel_drives import drive_at

from tcpipe.errors import LogError
from tcpipe.formats.logs.log_file import open_log
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.inspect import inspect
from tcpipe.recipe import Recipe
from tcpipe.store import Store

TOPIC, CAMERA = "/ColorRGBA", "/camera"
COUNT, EACH = 40, 200_000
"""Images of a camera, and bytes of each: 8 MB."""


def with_camera(store):
    """Return messages of two small topics, and images that no compression shortens, each a chunk."""
    small = random_messages(
        1, count=COUNT, types=("std_msgs/msg/ColorRGBA", "std_msgs/msg/UInt8MultiArray"), store=store
    )
    rng = np.random.default_rng(3)
    images = [
        Message(CAMERA, "std_msgs/msg/UInt8MultiArray", 1_700_000_000_000_000_000 + index, rng.bytes(EACH), None)
        for index in range(COUNT)
    ]
    return [*small, *images]


def write(path, kind):
    """Write a log of some 8 MB, of which some 30 kB are of ``TOPIC``, in chunks of their own; return the messages."""
    if kind.startswith("bag"):
        messages = with_camera(ROS1)
        codec = BagWriter.CompressionFormat.LZ4 if kind == "bag lz4" else None
        write_bag(path, messages, codec, chunk_bytes=30_000)
        return messages, ROS1
    messages = with_camera(ROS2)
    compression = {"mcap zstd": CompressionType.ZSTD, "mcap": CompressionType.NONE}.get(kind, CompressionType.NONE)
    write_mcap(path, messages, compression=compression, chunk_bytes=30_000, enable_crcs=kind != "mcap without CRC")
    return messages, ROS2


@pytest.fixture
def drives(tmp_path, served):
    """A bucket ``drives`` in a directory, and what was fetched of it."""
    bucket = tmp_path / "served" / "drives"
    bucket.mkdir()
    return bucket, served


@pytest.mark.parametrize("kind", ["mcap zstd", "mcap", "mcap without CRC", "bag", "bag lz4"])
def test_only_the_index_and_the_chunks_that_are_wanted_are_fetched(drives, kind):
    bucket, fetched = drives
    name = f"run.{kind[:4].strip()}"
    messages, store = write(bucket / name, kind)
    with open_log(f"s3://drives/{name}") as log:
        size = log.size_bytes
        assert log.topics[CAMERA].message_count == COUNT
        opened_bytes = fetched.sent_bytes
        assert opened_bytes < 0.02 * size  # of 8 MB: 64 kB of its end are fetched at once
        assert_same(log.table(TOPIC), expected_columns(messages, TOPIC, store))
        assert not log.damage
        assert fetched.sent_bytes < 0.2 * size  # heads are looked at, 8 kB each: of a chunk of a megabyte 1 %
        assert log.path.stat().st_blocks == 0


def test_a_recording_is_one_run_wherever_it_lies(drives, tmp_path):
    bucket, _fetched = drives
    here = drive_at(tmp_path / "here" / "run.mcap")
    shutil.copy(here, bucket / "run.mcap")
    for first, then in (("s3://drives/run.mcap", here), (here, "s3://drives/run.mcap")):
        store = Store(tmp_path / f"store of {first != here}")
        (made,) = ingest([first], store=store.root, recipe=Recipe()).results
        (again,) = ingest([then], store=store.root, recipe=Recipe()).results
        assert (made.status, again.status) == ("done", "unchanged")
        assert again.run.run_id == made.run.run_id
        assert again.same_as == str(first)
        (run,) = store.find_runs(made.run.run_id)
        assert run.facts.log.sha256_of == ("log" if first == here else "index")
        assert made.run.run_id == f"run-{run.facts.log.sha256[:8]}"
        assert (again.run.driven_m, again.run.segments) == (made.run.driven_m, made.run.segments)
    assert len(inspect(store.root, recipe=Recipe()).runs) == 1


@pytest.mark.parametrize("kind", ["cut", "chunkless"])
def test_a_log_without_an_index_is_fetched_as_a_whole_and_hashed(drives, tmp_path, kind):
    bucket, _ = drives
    messages = random_messages(1, count=50, types=("std_msgs/msg/ColorRGBA",))
    path = write_mcap(bucket / "run.mcap", messages, use_chunking=kind != "chunkless", chunk_bytes=500)
    if kind == "cut":
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    with open_log("s3://drives/run.mcap") as there, open_log(path) as here:
        assert table_bytes(there.table(TOPIC)) == table_bytes(here.table(TOPIC))
        assert there.sha256() == here.sha256()
        assert there.outline == here.outline == ""
        assert not there.is_known_by_outline


def test_a_connection_that_breaks_is_made_again_and_named_where_it_breaks_for_good(drives, monkeypatch):
    monkeypatch.setenv("TCPIPE_RETRY_MINUTES", "0.01")
    bucket, fetched = drives
    messages, store = write(bucket / "run.mcap", "mcap zstd")
    with open_log("s3://drives/run.mcap") as log:
        fetched.cuts = 2
        assert_same(log.table(TOPIC), expected_columns(messages, TOPIC, store))
    fetched.cuts = 1000
    with pytest.raises(LogError, match=r"s3://drives/run.mcap: it cannot be read \(") as broken:
        open_log("s3://drives/run.mcap")
    assert len(broken.value.problems) == 1
    fetched.cuts = 0


def test_an_object_that_is_written_anew_while_it_is_read_is_refused(drives):
    bucket, _ = drives
    write(bucket / "run.mcap", "mcap zstd")
    with open_log("s3://drives/run.mcap") as log:
        (bucket / "run.mcap").write_bytes((bucket / "run.mcap").read_bytes()[:-1] + b"x")
        with pytest.raises(LogError, match=r"s3://drives/run.mcap: changed while it was read"):
            log.table(TOPIC)
