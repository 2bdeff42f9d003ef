"""Parts of a split ROS 1 recording: messages of the first part alone."""

import shutil

import numpy as np
import pytest
from wheel_drives import START_NS

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.log_joining import open_logs
from tcpipe.formats.logs.writing import MessageStream, write_bag

STRING = "std_msgs/msg/String"


def part(path, *, start_s, static=False):
    stamps = START_NS + start_s * 10**9 + np.arange(10, dtype=np.int64) * 10**9
    streams = [MessageStream("/chatter", STRING, stamps)]
    write_bag(path, [*streams, MessageStream("/tf_static", STRING, stamps[:1])] if static else streams)
    return path


def static_of(path):
    """Return where static transforms are taken from, and that everything else is the log's own."""
    with open_logs([path]) as log, open_log(path) as alone:
        assert log.sha256() == alone.sha256()
        tables = log.tables([name for name in log.topics if name in ("/chatter", "/tf_static")])
        assert tables["/chatter"].equals(alone.table("/chatter"))
        more = [finding.code for finding in log.findings if finding not in alone.findings]
        is_borrowed = "/tf_static" in tables and "/tf_static" not in alone.topics
        assert more == ["static-transforms-borrowed"] * is_borrowed
        return tables["/tf_static"]["log_time_ns"].to_pylist() if "/tf_static" in tables else None


@pytest.mark.parametrize("name", ["drive_{}.bag", "drive_2026-01-01-00-00-{}0_{}.bag"])
def test_a_later_part_takes_them_from_the_first_of_its_own_recording(tmp_path, name):
    parts = [part(tmp_path / name.format(n, n), start_s=10 * n, static=n == 0) for n in range(3)]
    shutil.copy(parts[0], tmp_path / "other_0.bag")
    part(tmp_path / "other_1.bag", start_s=500)  # a drive of its own, as users number them
    part(tmp_path / "gone_1.bag", start_s=10)
    assert [static_of(path) for path in parts] == [[START_NS]] * 3
    assert [static_of(tmp_path / other) for other in ("other_1.bag", "gone_1.bag")] == [None, None]
