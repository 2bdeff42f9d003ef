"""Logs behind a URL: read by range or copied, as any other, refused in one line."""

import os
import resource

import pytest
from random_messages import assert_same, expected_columns, random_messages, write_mcap, write_rosbag2
from storage_server import FORBIDDEN

from tcpipe.errors import LogError
from tcpipe.formats.logs.log_file import open_log
from tcpipe.pipeline.inspect import inspect
from tcpipe.recipe import Recipe

MESSAGES = random_messages(1, count=10, types=("std_msgs/msg/ColorRGBA",))


@pytest.fixture
def bucket(tmp_path, served):
    """A bucket with a log, a bag directory and what is neither, over HTTP; what was fetched of it."""
    root = tmp_path / "served" / "drives"
    (root / "field").mkdir(parents=True)
    write_mcap(root / "field" / "my run.mcap", MESSAGES)
    os.utime(root / "field" / "my run.mcap", (1_600_000_000, 1_600_000_000))
    write_rosbag2(root / "field" / "bag", MESSAGES)
    (root / "field" / "video.mp4").write_bytes(bytes(1000))
    (root / "junk.bag").write_bytes(b"nonsense")
    return root, served


def test_a_prefix_is_a_bag_directory(bucket):
    with open_log("s3://drives/field/bag/") as log:
        assert log.container == "rosbag2"
        assert_same(log.table("/ColorRGBA"), expected_columns(MESSAGES, "/ColorRGBA"))


def test_only_what_belongs_to_a_log_is_copied(bucket):
    found = inspect("s3://drives", recipe=Recipe())
    assert [entry.path for entry in found.logs] == [
        "s3://drives/field/bag",
        "s3://drives/field/my run.mcap",
        "s3://drives/junk.bag",
    ]
    assert found.logs[2].problems[0].startswith("s3://drives/junk.bag: not a log")
    assert set(bucket[1]) == {"field/bag/bag.db3", "field/bag/metadata.yaml", "field/my run.mcap", "junk.bag"}


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("{file}/nowhere.mcap", ""),
        ("{file}/no/such/directory/run.mcap", ""),
        ("s3://drives/nowhere.mcap", ""),
        ("s3://drives/no/such/directory/run.mcap", ""),
        (f"s3://{FORBIDDEN}/run.mcap", ": it cannot be read (the store requires credentials; set AWS_"),
        ("gopher://host/run.mcap", ": it cannot be read"),
        ("s3://", ": it cannot be read"),
        ("s3:///run.mcap", ": it cannot be read"),
    ],
)
def test_what_is_not_there_is_refused_in_one_line(bucket, url, said):
    url = url.format(file=bucket[0].as_uri())
    with pytest.raises(LogError) as refused:
        open_log(url)
    (problem,) = refused.value.problems
    assert url.rpartition("//")[2] + said in problem
    assert "\n" not in problem


def test_a_log_is_inspected_where_nothing_beside_it_can_be_read(bucket):
    with pytest.raises(LogError, match=f"^s3://{FORBIDDEN}/run.mcap: it cannot be read"):
        inspect(f"s3://{FORBIDDEN}/run.mcap", recipe=Recipe())
    assert inspect("s3://drives/field/my run.mcap", recipe=Recipe()).path == "s3://drives/field/my run.mcap"


def test_a_copy_that_does_not_fit_is_told_in_one_line(bucket):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, before[1]))
    try:
        with pytest.raises(LogError, match="no room for a copy here; TMPDIR"):
            open_log("s3://drives/field/bag")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_an_endpoint_that_is_no_address_is_refused(monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "localhost:9000")
    with pytest.raises(LogError, match="AWS_ENDPOINT_URL is 'localhost:9000', expected http://host"):
        open_log("s3://bucket/run.mcap")
