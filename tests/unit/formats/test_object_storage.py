"""Logs behind a URL: copied, read as any other, refused in one line."""

import os

import pytest
from random_messages import assert_same, expected_columns, random_messages, write_mcap, write_rosbag2

from tcpipe.errors import LogError
from tcpipe.formats.log_file import open_log
from tcpipe.formats.object_storage import is_url, staged

pytest.importorskip("obstore", reason="obstore is not installed")

MESSAGES = random_messages(1, count=10, types=("std_msgs/msg/ColorRGBA",))


def test_what_is_a_url():
    assert is_url("s3://bucket/run.mcap")
    assert is_url("file:///tmp/run.mcap")
    assert not is_url("drives/run.mcap")
    assert not is_url("C:\\run.mcap")


def test_a_log_behind_a_url_is_read_as_any_other(tmp_path):
    path = write_mcap(tmp_path / "run.mcap", MESSAGES)
    with open_log(path.as_uri()) as log:
        copy = log.path
        assert_same(log.table("/ColorRGBA"), expected_columns(MESSAGES, "/ColorRGBA"))
        assert copy != path
        assert copy.name == "run.mcap"
    assert not copy.exists()


def test_a_prefix_is_a_bag_directory(tmp_path):
    (tmp_path / "drives").mkdir()
    bag = write_rosbag2(tmp_path / "drives" / "bag", MESSAGES)
    with open_log(bag.as_uri()) as log:
        assert log.container == "rosbag2"
        assert_same(log.table("/ColorRGBA"), expected_columns(MESSAGES, "/ColorRGBA"))


def test_names_and_times_are_kept(tmp_path):
    path = write_mcap(tmp_path / "run.mcap", MESSAGES)
    os.utime(path, (1_600_000_000, 1_600_000_000))
    (tmp_path / "here").mkdir()
    copy = staged(path.as_uri(), tmp_path / "here")
    assert copy == tmp_path / "here" / "run.mcap"
    assert copy.stat().st_mtime == 1_600_000_000
    assert copy.read_bytes() == path.read_bytes()


@pytest.mark.parametrize("name", ["nowhere.mcap", "no/such/directory/run.mcap"])
def test_what_is_not_there_is_refused_in_one_line(tmp_path, name):
    with pytest.raises(LogError) as refused:
        open_log(f"{tmp_path.as_uri()}/{name}")
    (problem,) = refused.value.problems
    assert name in problem
    assert "\n" not in problem


def test_a_scheme_that_nobody_knows_is_refused(tmp_path):
    with pytest.raises(LogError, match=r"gopher://host/run\.mcap: it cannot be read"):
        open_log("gopher://host/run.mcap")
