"""Everything read: gaps, stamps and clock steps that were put in come out."""

import numpy as np
import pytest

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.writing import MessageStream, write_mcap
from tcpipe.pipeline.log_inspection import inspect_log
from tcpipe.recipe import Recipe
from tcpipe.tables.findings import select_findings

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
    return found, {topic.name: topic for topic in found.topics}


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
    stamps = one.stamps
    assert stamps.messages_read == one.messages == 3000
    assert stamps.gaps == 1
    assert stamps.longest_gap_s == pytest.approx(4.02)
    kinds = ("zero_stamps", "backward_stamps", "repeated_stamps", "duplicates")
    assert [getattr(stamps, kind) for kind in kinds] == [1, 1, 0, 1]
    assert topics["/stepped"].stamps.longest_gap_s == pytest.approx(4.02)  # the step of its header is none
    assert one.time == "header"
    assert one.header_minus_log_s == pytest.approx(-0.003)
    (step,) = found.clock_steps
    assert step.step_s == pytest.approx(7.0)
    assert step.topics == ("/stepped",)
    assert step.log_time_ns == log_ns[1500]
    assert found.damage == ()


def test_simulated_time_is_told_from_the_wall_clock(tmp_path):
    log_ns = START_NS + np.arange(500) * PERIOD_NS
    simulated = 5_000_000_000 + np.arange(500) * PERIOD_NS
    found, topics = inspected(tmp_path / "a.mcap", [stream("/imu", simulated, log_ns)])
    assert topics["/imu"].simulated_time
    assert topics["/imu"].time == "header" or topics["/imu"].time_why == "header-differs-from-log-time"
    found, topics = inspected(tmp_path / "b.mcap", [stream("/imu", simulated, simulated)])
    assert not topics["/imu"].simulated_time
    assert "simulated-time" in {of.code for of in found.findings}


def test_exact_duplicates_are_told_from_repeated_stamps(tmp_path):
    log_ns = np.repeat(START_NS + np.arange(1000) * PERIOD_NS, 2)
    header_ns = log_ns - 3_000_000
    log_ns[1::2] += 1_000_000
    found, topics = inspected(tmp_path / "a.mcap", [stream("/twice", header_ns, log_ns)])
    assert (topics["/twice"].stamps.duplicates, topics["/twice"].stamps.repeated_stamps) == (1000, 0)
    assert topics["/twice"].time == "header"
    other = stream("/other", header_ns, log_ns)
    other.columns["angular_velocity.x"] = np.arange(2000.0)
    found, topics = inspected(tmp_path / "b.mcap", [other])
    assert (topics["/other"].stamps.duplicates, topics["/other"].stamps.repeated_stamps) == (0, 1000)
    assert topics["/other"].time == "log"
    assert found.damage == ()


def test_a_recorder_that_stalls_is_no_gap_and_another_clock_is_told(tmp_path):
    header_ns = START_NS + np.arange(2000) * PERIOD_NS
    log_ns = header_ns + 3_000_000
    log_ns[1000:1200] = log_ns[1200]  # written in a burst
    found, topics = inspected(
        tmp_path / "a.mcap",
        [
            stream("/stalled", header_ns, log_ns),
            stream("/b", header_ns, header_ns),
            stream("/c", header_ns - 60 * 10**9, header_ns),
        ],
    )
    assert topics["/stalled"].stamps.gaps == 0
    assert topics["/c"].moved_s == (pytest.approx(60.0, abs=0.01),)
    assert topics["/b"].moved_s == ()
    assert found.clock_steps == ()


def battery_log(path, rate_hz):
    """Ten seconds of a power topic at a rate."""
    log_ns = START_NS + (np.arange(10 * rate_hz + 1) * 1e9 / rate_hz).astype(np.int64)
    columns = {"battery_voltage": np.full(len(log_ns), 25.0), "left_driver_current": np.full(len(log_ns), 4.0)}
    write_mcap(path, [MessageStream("/status", "husky_msgs/msg/HuskyStatus", log_ns, columns, {})])
    return path


@pytest.mark.parametrize(("rate_hz", "said"), [(1, True), (20, False)])
def test_power_that_is_too_slow_for_a_metre_is_said_with_what_sets_its_rate(tmp_path, rate_hz, said):
    with open_log(battery_log(tmp_path / "a.mcap", rate_hz)) as log:
        found = inspect_log(log, Recipe(), None, full=False)
    slow = select_findings(found.findings, "power-too-slow")
    assert len(slow) == said
    for of in slow:
        assert of.numbers == {"rate_hz": 1.0, "wanted_hz": 10.0}
        assert of.names["topic"] == "/status"
        assert "diagnostic_frequency of husky_base" in of.names["setting"]


def test_a_voltage_of_its_own_may_be_slow(tmp_path):
    streams = [
        MessageStream(
            f"/battery/{name}", "std_msgs/msg/Float32", START_NS + np.arange(0, 10**10, step_ns), {"data": value}
        )
        for name, step_ns, value in (("voltage", 10**9, np.full(10, 25.0)), ("current", 10**9 // 20, np.full(200, 4.0)))
    ]
    found, topics = inspected(tmp_path / "a.mcap", streams)
    assert topics["/battery/voltage"].role == topics["/battery/current"].role == "power"
    assert not select_findings(found.findings, "power-too-slow")
