"""Everything read: gaps, stamps and clock steps that were put in come out; memory does not grow with the log."""

import numpy as np
import pyarrow as pa
import pytest

from tcpipe.formats.log_file import open_log
from tcpipe.formats.log_writing import MessageStream, write_mcap
from tcpipe.pipeline import log_inspection
from tcpipe.pipeline.log_inspection import inspect_log
from tcpipe.recipe import Recipe

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 20_000_000


def stream(topic, header_ns, log_ns):
    columns = {
        "header.stamp.sec": (header_ns // 10**9).astype(np.int32),
        "header.stamp.nanosec": (header_ns % 10**9).astype(np.uint32),
    }
    return MessageStream(topic, "sensor_msgs/msg/Imu", log_ns, columns, {"header.frame_id": "imu"})


def inspected(path, streams, **options):
    write_mcap(path, streams)
    with open_log(path) as log:
        found = inspect_log(log, Recipe(), None, full=True, **options)
    return found, {topic["name"]: topic for topic in found["topics"]}


def test_faults_that_were_put_in_are_found(tmp_path):
    log_ns = START_NS + np.arange(3000) * PERIOD_NS
    log_ns[2000:] += 4_000_000_000
    faulty = log_ns - 3_000_000
    faulty[100] = 0
    faulty[200] = faulty[199]
    faulty[300] = faulty[299] - 1000
    stepped = log_ns.copy()
    stepped[1500:] += 7_000_000_000
    found, topics = inspected(
        tmp_path / "a.mcap", [stream("/faulty", faulty, log_ns), stream("/stepped", stepped, log_ns)]
    )
    one = topics["/faulty"]
    assert one["messages_read"] == one["messages"] == 3000
    assert one["gaps"] == 1
    assert one["longest_gap_s"] == pytest.approx(4.02)
    assert one["median_period_s"] == pytest.approx(0.02)
    assert (one["zero_stamps"], one["backward_stamps"], one["repeated_stamps"]) == (1, 2, 1)
    assert one["time"] == "header"
    assert one["header_minus_log_s"] == pytest.approx(-0.003)
    assert found["clock_epochs"] == 2
    (step,) = found["clock_steps"]
    assert step["step_s"] == pytest.approx(7.0)
    assert step["topics"] == ["/stepped"]
    assert step["log_time_ns"] == log_ns[1500]
    assert found["damage"] == []


def test_simulated_time_is_told_from_the_wall_clock(tmp_path):
    log_ns = START_NS + np.arange(500) * PERIOD_NS
    simulated = 5_000_000_000 + np.arange(500) * PERIOD_NS
    found, topics = inspected(tmp_path / "a.mcap", [stream("/imu", simulated, log_ns)])
    assert found["simulated_headers"] == ["/imu"]
    assert topics["/imu"]["time"] == "header" or "10 s" in topics["/imu"]["time_why"]
    found, _ = inspected(tmp_path / "b.mcap", [stream("/imu", simulated, simulated)])
    assert found["simulated_headers"] == []
    assert any("the log's own times are simulated" in line for line in found["warnings"])


def test_a_topic_of_many_messages_is_thinned_out_and_its_counts_stay_exact(monkeypatch):
    log_ns = START_NS + np.arange(10_000) * PERIOD_NS
    log_ns[6000:] += 3_000_000_000
    header_ns = log_ns.copy()
    header_ns[7000:] += 9_000_000_000
    table = pa.table(
        {"log_time_ns": log_ns, "header.stamp.sec": header_ns // 10**9, "header.stamp.nanosec": header_ns % 10**9}
    )
    whole = log_inspection._TopicStamps()
    whole.add(table)
    monkeypatch.setattr(log_inspection, "_MOST_ROWS", 1000)
    thinned = log_inspection._TopicStamps()
    for start in range(0, 10_000, 777):
        thinned.add(table[start : start + 777])
    assert len(thinned.times()[0]) <= 1000
    assert np.isin(thinned.times()[0], log_ns).all()
    exact, about = whole.facts(), thinned.facts()
    for name in ("messages_read", "longest_gap_s", "zero_stamps", "backward_stamps", "repeated_stamps", "gaps"):
        assert about[name] == exact[name], name
    assert about["median_period_s"] == pytest.approx(0.02)
