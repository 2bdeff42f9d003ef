"""Logs of every container, written by other people's writers, read back column by column."""

import os
import shutil
import sqlite3
import subprocess
import sys
from dataclasses import replace

import pytest
from mcap.writer import CompressionType, IndexType
from random_messages import (
    ROS1,
    ROS2,
    TYPES,
    assert_same,
    expected_columns,
    random_messages,
    write_bag,
    write_mcap,
    write_rosbag2,
)
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from tcpipe.errors import LogError
from tcpipe.formats.logs.log_file import find_logs, open_log

UNPRIVILEGED = [] if os.geteuid() else ["setpriv", "--bounding-set=-dac_override,-dac_read_search"]
"""Prefix of a command that takes root's right to read every file."""
MCAP_OPTIONS = {
    "zstd": {},
    "lz4": {"compression": CompressionType.LZ4},
    "none": {"compression": CompressionType.NONE},
    "none without CRC": {"compression": CompressionType.NONE, "enable_crcs": False},
    "unchunked": {"use_chunking": False},
    "unchunked without summary": {"use_chunking": False, "use_statistics": False, "use_summary_offsets": False},
    "no message index": {"index_types": IndexType.CHUNK | IndexType.METADATA},
    "nothing repeated": {"repeat_channels": False, "repeat_schemas": False, "use_statistics": False},
}
BAG_COMPRESSIONS = (None, BagWriter.CompressionFormat.BZ2, BagWriter.CompressionFormat.LZ4)


def assert_log(path, messages, store):
    with open_log(path) as log:
        tables = log.tables(log.topics)
        assert log.damage == []
        for name, topic in log.topics.items():
            ours = [message for message in messages if message.topic == name]
            assert topic.message_count == tables[name].num_rows == len(ours)
            assert topic.type_name == ours[0].type_name
            assert tables[name]["log_time_ns"].to_pylist() == [message.log_time_ns for message in ours]
            assert_same(tables[name], expected_columns(messages, name, store))
        assert set(tables) == {message.topic for message in messages}
        return log


@pytest.mark.parametrize("ragged", [False, True], ids=["one shape", "many shapes"])
@pytest.mark.parametrize("options", MCAP_OPTIONS.values(), ids=MCAP_OPTIONS)
def test_mcap_of_every_kind(tmp_path, options, ragged):
    messages = random_messages(1, count=20, ragged=ragged)
    log = assert_log(write_mcap(tmp_path / "run.mcap", messages, **options), messages, ROS2)
    assert log.container == "mcap"


def test_mcap_of_ros1_messages(tmp_path):
    messages = random_messages(2, count=20, store=ROS1)
    assert_log(write_mcap(tmp_path / "run.mcap", messages, store=ROS1), messages, ROS1)


def test_publish_time_is_kept(tmp_path):
    messages = random_messages(3, count=5, types=("std_msgs/msg/ColorRGBA",))
    with open_log(write_mcap(tmp_path / "run.mcap", messages)) as log:
        table = log.table("/ColorRGBA")
    assert table["publish_time_ns"].to_pylist() == [message.log_time_ns - 5 for message in messages]


@pytest.mark.parametrize("ragged", [False, True], ids=["one shape", "many shapes"])
@pytest.mark.parametrize("compression", BAG_COMPRESSIONS)
def test_bag_of_every_compression(tmp_path, compression, ragged):
    messages = random_messages(4, count=20, ragged=ragged, store=ROS1)
    log = assert_log(write_bag(tmp_path / "run.bag", messages, compression), messages, ROS1)
    assert log.container == "bag"


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize("mode", [None, "FILE", "MESSAGE"])
def test_rosbag2_directories(tmp_path, storage, mode):
    messages = random_messages(5, count=20)
    compression = getattr(CompressionMode, mode) if mode else None
    bag = write_rosbag2(tmp_path / "run", messages, storage, compression)
    assert assert_log(bag, messages, ROS2).container == "rosbag2"
    for database in bag.glob("*.db3"):
        assert_log(database, messages, ROS2)


def test_split_files_are_one_log(tmp_path):
    messages = random_messages(7, count=30, types=TYPES[:3])
    half = len(messages) // 2
    bag = tmp_path / "drive"
    bag.mkdir()
    for index, part in enumerate((messages[:half], messages[half:])):
        source = write_rosbag2(tmp_path / f"part{index}", part)
        shutil.copy(next(source.glob("*.db3")), bag / f"drive_{index}.db3")
    assert find_logs(tmp_path / "drive") == [bag]
    with open_log(bag) as log:
        table = log.table("/Imu")
    assert table["log_time_ns"].to_pylist() == [m.log_time_ns for m in messages if m.topic == "/Imu"]
    assert_same(table, expected_columns(messages, "/Imu"))


@pytest.mark.skipif(bool(UNPRIVILEGED) and not shutil.which("setpriv"), reason="root reads everything without setpriv")
def test_a_directory_that_cannot_be_read_costs_only_itself(tmp_path):
    log = write_mcap(tmp_path / "a.mcap", random_messages(1, count=2, types=TYPES[:1]))
    closed = tmp_path / "closed"
    for path in (closed, tmp_path / "lost+found"):
        path.mkdir()
        write_mcap(path / "b.mcap", [])
        path.chmod(0o000)
    seen = "from pathlib import Path; from tcpipe.formats.logs.log_file import find_logs, open_log"
    script = f"{seen}; logs = find_logs(Path({str(tmp_path)!r})); print(*logs, sep='|'); open_log(logs[1])"
    done = subprocess.run([*UNPRIVILEGED, sys.executable, "-c", script], capture_output=True, text=True, check=False)
    for path in (closed, tmp_path / "lost+found"):
        path.chmod(0o700)
    assert done.stdout.strip() == f"{log}|{closed}", done.stderr
    assert f"LogError: {closed}: it cannot be read (Permission denied)" in done.stderr


def test_a_folder_of_several_drives_is_no_bag(tmp_path):
    for name in ("a_0.mcap", "a_1.mcap", "b.mcap"):
        write_mcap(tmp_path / name, random_messages(1, count=2, types=TYPES[:1]))
    with pytest.raises(
        LogError, match=r"not named as parts of one \(a_0\.mcap, a_1\.mcap, b\.mcap\); give one of them"
    ):
        open_log(tmp_path)
    (tmp_path / "b.mcap").unlink()
    with open_log(tmp_path) as log:
        assert [topic.message_count for topic in log.topics.values()] == [4]


def test_a_definition_the_log_lacks_comes_from_the_bundled_ones(tmp_path):
    messages = random_messages(10, count=10, types=("sensor_msgs/msg/Imu", "std_msgs/msg/ColorRGBA"))
    assert_log(write_mcap(tmp_path / "run.mcap", messages, define=False), messages, ROS2)


def test_an_unknown_type_costs_only_its_own_topic(tmp_path, monkeypatch):
    messages = random_messages(11, count=10, types=("sensor_msgs/msg/Imu", "std_msgs/msg/ColorRGBA"))
    renamed = [m if m.topic == "/Imu" else replace(m, type_name="acme_msgs/msg/Secret") for m in messages]
    with monkeypatch.context() as patch:
        patch.setitem(ROS2.fielddefs, "acme_msgs/msg/Secret", ROS2.fielddefs["std_msgs/msg/ColorRGBA"])
        path = write_mcap(tmp_path / "run.mcap", renamed, define=False)
    with open_log(path) as log:
        tables = log.tables(log.topics)
        assert list(tables) == ["/Imu"]
        (finding,) = log.findings
        assert (finding.subject.name, finding.numbers["lost_messages_count"]) == ("/ColorRGBA", 10)
        assert "acme_msgs/msg/Secret" in finding.names["reason"]
        with pytest.raises(LogError, match="/ColorRGBA cannot be read: type acme_msgs/msg/Secret is unknown"):
            log.table("/ColorRGBA")
    definitions = tmp_path / "acme_msgs" / "msg"
    definitions.mkdir(parents=True)
    (definitions / "Secret.msg").write_text("float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n")
    with open_log(path, message_definitions=tmp_path) as log:
        assert_same(log.table("/ColorRGBA"), expected_columns(messages, "/ColorRGBA"))


def test_a_topic_that_changes_its_type_keeps_the_larger_part(tmp_path):
    first = random_messages(13, count=10, types=("std_msgs/msg/ColorRGBA",))
    second = random_messages(14, count=4, types=("sensor_msgs/msg/Imu",))
    bag = tmp_path / "run"
    bag.mkdir()
    shutil.copy(write_mcap(tmp_path / "a.mcap", first), bag / "run_0.mcap")
    renamed = [replace(m, topic="/ColorRGBA") for m in second]
    shutil.copy(write_mcap(tmp_path / "b.mcap", renamed), bag / "run_1.mcap")
    with open_log(bag) as log:
        assert_same(log.table("/ColorRGBA"), expected_columns(first, "/ColorRGBA"))
        (changed,) = [finding for finding in log.findings if finding.subject.name == "/ColorRGBA"]
    assert changed.numbers["lost_messages_count"] == 4
    assert "changes its type to sensor_msgs/msg/Imu" in changed.names["reason"]


def test_rows_are_in_the_order_of_log_time(tmp_path):
    messages = random_messages(15, count=30, types=("std_msgs/msg/ColorRGBA",))
    shuffled = messages[10:] + messages[:10]
    with open_log(write_mcap(tmp_path / "run.mcap", shuffled, chunk_bytes=256)) as log:
        assert_same(log.table("/ColorRGBA"), expected_columns(messages, "/ColorRGBA"))


def test_find_logs_searches_downward_and_takes_a_bag_directory_as_one(tmp_path):
    messages = random_messages(18, count=3, types=TYPES[:1])
    (tmp_path / "b").mkdir()
    (tmp_path / ".hidden").mkdir()
    write_rosbag2(tmp_path / "b" / "bag", messages, StoragePlugin.MCAP)
    write_mcap(tmp_path / "b" / "run_2.mcap", messages)
    write_mcap(tmp_path / "a.mcap", messages)
    write_mcap(tmp_path / ".hidden" / "no.mcap", messages)
    write_mcap(tmp_path / ".no.mcap", messages)
    (tmp_path / "notes.txt").write_text("no log")
    names = [str(path.relative_to(tmp_path)) for path in find_logs(tmp_path)]
    assert names == ["a.mcap", "b/bag", "b/run_2.mcap"]


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("empty.mcap", b"", "it is empty (0 bytes)"),
        ("archive.bag", b"PK\x03\x04rest", "it is a zip archive"),
        ("old.bag", b"#ROSBAG V1.2\nrest", "it is a ROS bag of version 1.2 (rosbag fix converts it)"),
        ("words.bag", b"just words in a file", "it is 20 bytes that begin with b'just wor'"),
        ("zeros.db3", bytes(64), "it begins with zeros"),
    ],
)
def test_what_is_no_log_is_refused_in_one_line(tmp_path, name, content, said):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(LogError) as refused:
        open_log(path)
    wanted = "expected an .mcap, a .bag (2.0), a .db3, a ROS 2 bag directory, a .ulg, ArduPilot's .bin or tables that the recipe maps"
    assert [problem.split(";")[0] for problem in refused.value.problems] == [f"{path}: not a log: {said}"]
    assert wanted in str(refused.value)


def test_directories_that_are_no_bag_are_refused(tmp_path):
    with pytest.raises(LogError, match="no log in this directory"):
        find_logs(tmp_path)
    with pytest.raises(LogError, match=r"not a ROS 2 bag: metadata\.yaml is missing, and no \.db3"):
        open_log(tmp_path)
    (tmp_path / "metadata.yaml").write_text("something: else\n")
    with pytest.raises(LogError, match=r"not a ROS 2 bag: metadata\.yaml is broken, and no \.db3"):
        open_log(tmp_path)
    with pytest.raises(LogError, match="no such file"):
        open_log(tmp_path / "nowhere.mcap")


def test_a_topic_that_is_not_there_is_named_with_those_that_are(tmp_path):
    path = write_mcap(tmp_path / "run.mcap", random_messages(19, count=3, types=TYPES[:1]))
    with open_log(path) as log, pytest.raises(LogError, match="there is no topic /nope; it has /Imu"):
        log.table("/nope")


def test_a_file_of_a_bag_that_is_missing_or_broken_costs_only_itself(tmp_path):
    messages = random_messages(20, count=20, types=TYPES[:2])
    bag = write_rosbag2(tmp_path / "run", messages)
    metadata = (bag / "metadata.yaml").read_text()
    name = next(bag.glob("*.db3")).name
    (bag / "metadata.yaml").write_text(metadata.replace(f"- {name}", f"- {name}\n  - run_1.db3\n  - run_2.db3", 1))
    (bag / "run_2.db3").write_bytes(b"")
    with open_log(bag) as log:
        assert_same(log.table("/Imu"), expected_columns(messages, "/Imu"))
        assert any("run_1.db3" in line and "missing" in line for line in log.damage)
        assert any("run_2.db3" in line and "is empty" in line for line in log.damage)


def test_a_renamed_file_of_a_bag_is_no_damage_unless_messages_are_missing(tmp_path):
    messages = random_messages(22, count=20, types=TYPES[:2])
    bag = write_rosbag2(tmp_path / "run", messages)
    next(bag.glob("*.db3")).rename(bag / "mine.db3")
    with open_log(bag) as log:
        assert_same(log.table("/Imu"), expected_columns(messages, "/Imu"))
        assert log.damage == []
        assert (log.findings[0].code, log.findings[0].subject.name) == ("file-unlisted", "run/mine.db3")
    counted = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(counted.replace("message_count: 20", "message_count: 21"))
    with open_log(bag) as log:
        assert log.damage


def test_an_open_db3_with_a_journal_is_read_whole(tmp_path):
    messages = random_messages(21, count=20, types=TYPES[:1])
    bag = write_rosbag2(tmp_path / "run", messages)
    path = next(bag.glob("*.db3"))
    writer = sqlite3.connect(path)
    writer.execute("PRAGMA journal_mode=WAL")
    writer.execute("PRAGMA wal_autocheckpoint=0")
    extra = messages[-1].log_time_ns + 1
    writer.execute(
        "INSERT INTO messages(topic_id, timestamp, data) SELECT id, ?, ? FROM topics", (extra, messages[0].payload)
    )
    writer.commit()
    with open_log(path) as log:
        assert log.table("/Imu").num_rows == len(messages) + 1
    writer.close()
