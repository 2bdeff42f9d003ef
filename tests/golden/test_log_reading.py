"""Logs that other projects publish, field by field as rosbags deserialises them; damaged logs, message by message as their clean twin."""

import hashlib
import json
import tarfile
from collections import Counter

import pytest
from random_messages import assert_same, plain_row, table_bytes
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from shared_data import shared_data

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.mcap_file import McapPart

PEERS = (
    "peers/rosbags-rs/tests/test_bags/test_bag_mcap",
    "peers/rosbags-rs/tests/test_bags/test_bag_sqlite3",
    "peers/rosbag.js/fixtures/example.bag",
    "peers/rosbag.js/fixtures/example-bz2.bag",
    "peers/rosbag.js/fixtures/example-lz4.bag",
    "peers/rosbag.js/fixtures/example-unsorted-chunks.bag",
    "peers/rosbag.js/fixtures/no-messages.bag",
    "peers/ros_amr_interop/rosbag_demo.bag",
    "peers/rosbag2/ros2bag/test/resources/empty_bag",
    "peers/rosbag2/rosbag2_py/test/resources/mcap/wbag",
    "peers/rosbag2/rosbag2_py/test/resources/sqlite3/wbag",
    "peers/rosbag2/rosbag2_tests/resources/mcap/cdr_test",
    "peers/rosbag2/rosbag2_tests/resources/sqlite3/cdr_test",
    "robot_localization/test2.bag",
)
HUSKY_MESSAGES = 16_806


def rosbags_rows(path):
    """Every message as rosbags deserialises it, as plain values by topic, in the order of log time."""
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        rows = {}
        for connection, stamp, raw in reader.messages():
            value = reader.deserialize(raw, connection.msgtype)
            rows.setdefault(connection.topic, []).append(
                (stamp, plain_row(value, connection.msgtype, reader.typestore))
            )
        return {topic: sorted(found, key=lambda row: row[0]) for topic, found in rows.items()}


@pytest.mark.parametrize("name", PEERS)
def test_every_field_is_what_rosbags_reads(name):
    path = shared_data(name)
    expected = rosbags_rows(path)
    with open_log(path) as log:
        tables = log.tables(log.topics)
        assert log.damage == []
    assert {topic for topic, table in tables.items() if table.num_rows} == expected.keys()
    for topic, rows in expected.items():
        assert tables[topic]["log_time_ns"].to_pylist() == [stamp for stamp, _ in rows]
        names = list(rows[0][1])
        assert_same(tables[topic], {name: [row[name] for _, row in rows] for name in names})


def test_compressed_and_split_bags_of_old_recorders():
    base = shared_data("peers/rosbag2_old/rosbag2_tests/resources/reindex_test_bags")
    counts = {}
    for name in ("multiple_files", "file_compression", "message_compression"):
        with open_log(base / name) as log:
            counts[name] = sum(table.num_rows for table in log.tables(log.topics).values())
            assert counts[name] == sum(topic.message_count for topic in log.topics.values())
            assert {finding.code for finding in log.findings} <= {"file-unlisted", "no-checksum"}
    assert counts == {"multiple_files": 52, "file_compression": 775, "message_compression": 1127}


def test_every_mcap_layout_of_the_conformance_suite(tmp_path):
    with tarfile.open(shared_data("peers/mcap-conformance.tar.xz")) as tar:
        tar.extractall(tmp_path, filter="data")
    files = sorted(tmp_path.rglob("*.mcap"))
    assert len(files) == 416
    for path in files:
        records = [(r["type"], dict(r["fields"])) for r in json.loads(path.with_suffix(".json").read_text())["records"]]
        wanted = [
            (int(m["channel_id"]), int(m["log_time"]), int(m["publish_time"]), bytes(map(int, m["data"])))
            for kind, m in records
            if kind == "Message"
        ]
        part = McapPart(path, path.name)
        found = [
            (block.channel, log, publish, bytes(block.buffer[at : at + length]))
            for block in part.blocks(frozenset(part.channels))
            for at, length, log, publish in zip(
                block.offsets, block.lengths, block.log_time_ns, block.publish_time_ns, strict=True
            )
        ]
        part.close()
        assert found == wanted, path.name
        assert {c.name for c in part.channels.values()} == {c["topic"] for kind, c in records if kind == "Channel"}
        assert sum(channel.message_count or 0 for channel in part.channels.values()) == len(wanted)
        assert not part.damage


@pytest.fixture(scope="module")
def husky_directories(tmp_path_factory):
    archive = shared_data("damaged/husky_test1_rosbag2_dirs.tar.xz")
    directory = tmp_path_factory.mktemp("husky")
    with tarfile.open(archive) as tar:
        tar.extractall(directory, filter="data")
    return directory


def without_sequence(tables):
    """ROS 1 headers count messages in ``seq``, which ROS 2 has not."""
    return {
        name: table.drop_columns([c for c in table.column_names if c == "header.seq"]) for name, table in tables.items()
    }


def test_one_drive_in_four_containers_gives_identical_tables(husky_directories):
    paths = [
        shared_data("robot_localization/test1.bag"),
        shared_data("damaged/husky_test1_crc_zstd.mcap"),
        husky_directories / "husky_test1_ros2_sqlite3",
        husky_directories / "husky_test1_ros2_mcap",
        husky_directories / "husky_test1_ros2_nometadata" / "husky_test1_ros2_sqlite3.db3",
    ]
    digests = []
    for path in paths:
        with open_log(path) as log:
            tables = without_sequence(log.tables(sorted(log.topics)))
            assert log.damage == []
        assert sum(table.num_rows for table in tables.values()) == HUSKY_MESSAGES
        digests.append({name: hashlib.sha256(table_bytes(table)).hexdigest() for name, table in tables.items()})
    assert all(digest == digests[0] for digest in digests)


def message_set(path):
    """Every message of a log, one hashable line each."""
    with open_log(path) as log:
        tables = without_sequence(log.tables(sorted(log.topics)))
        damage = log.findings
    lines = Counter(f"{name} {row}" for name, table in tables.items() for row in table.to_pylist())
    return lines, damage


@pytest.fixture(scope="module")
def clean_messages():
    return message_set(shared_data("damaged/husky_test1_crc_zstd.mcap"))[0]


@pytest.mark.parametrize(
    ("name", "count", "lost"),
    [
        ("damaged/husky_test1_crc_zstd_byteflip.mcap", 14_407, 2_399),
        ("damaged/husky_test1_truncated.mcap", 9_585, None),
        ("damaged/husky_test1.bag.active", 16_806, None),
        ("damaged/husky_test1_truncated60.bag", 8_788, None),
        ("damaged/husky_test1_byteflip.bag", 15_043, 1_763),
        ("husky_test1_ros2_truncdb3", 10_058, 6_748),
        ("husky_test1_ros2_nometadata", 16_806, None),
    ],
)
def test_every_intact_message_of_a_damaged_log_is_read_and_no_other(
    name, count, lost, clean_messages, husky_directories
):
    path = husky_directories / name
    found, damage = message_set(path if path.exists() else shared_data(name))
    assert found.total() == count
    assert found - clean_messages == Counter()
    assert damage
    assert lost is None or lost in [finding.numbers.get("lost_messages_count") for finding in damage]
    if lost is not None:
        assert count + lost == HUSKY_MESSAGES
