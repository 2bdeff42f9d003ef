"""Logs of every kind and state, through the installed command."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from installed_command import plain_lines, tcpipe
from mcap.writer import Writer
from storage_server import FORBIDDEN, object_store

from tcpipe.formats.log_writing import MessageStream, write_mcap, write_rosbag2

ODOMETRY = "nav_msgs/msg/Odometry"
START_NS = 1_700_000_000_000_000_000


def drive(*, simulated: bool = False) -> list[MessageStream]:
    """Half a minute straight ahead, by the wheels alone."""
    log_ns = START_NS + np.arange(1500) * 20_000_000
    header_ns = log_ns - START_NS + 5 * 10**9 if simulated else log_ns
    columns = {
        "header.stamp.sec": (header_ns // 10**9).astype(np.int32),
        "header.stamp.nanosec": (header_ns % 10**9).astype(np.uint32),
        "pose.pose.position.x": np.arange(1500) * 0.02,
        "pose.pose.orientation.w": np.ones(1500),
        "twist.twist.linear.x": np.ones(1500),
    }
    texts = {"header.frame_id": "odom", "child_frame_id": "base_link"}
    return [MessageStream("/wheel/odom", ODOMETRY, log_ns, columns, texts)]


def run_json(store: Path) -> dict:
    (path,) = store.glob("runs/*/run.json")
    return json.loads(path.read_text())


@pytest.mark.parametrize(("content", "store"), [(b"nonsense", "tcpipe-store"), (b"#ROSBAG V2.0\n", "deep/down/store")])
def test_what_cannot_be_ingested_leaves_no_store(tmp_path, content, store):
    (tmp_path / "a.bag").write_bytes(content)
    done = tcpipe("ingest", "a.bag", "--store", store, cwd=tmp_path)
    plain_lines(done, 1)
    assert done.stdout.splitlines()[-1] == f"no run came into {store}: 1 of 1 logs failed"
    assert [path.name for path in tmp_path.iterdir()] == ["a.bag"]
    told = json.loads(tcpipe("ingest", "a.bag", "--store", store, "--json", cwd=tmp_path).stdout)
    assert (told["store"], told["exit_code"], told["results"][0]["status"]) == (None, 1, "failed")
    (tmp_path / store).mkdir(parents=True)
    plain_lines(tcpipe("ingest", "a.bag", "--store", store, cwd=tmp_path), 1)
    assert (tmp_path / store).is_dir()


def test_what_has_no_checksum_and_which_clock_is_simulated_is_said(tmp_path):
    write_rosbag2(tmp_path / "run", drive(simulated=True), storage="sqlite3")
    assert tcpipe("ingest", "run", cwd=tmp_path).returncode == 0
    found = run_json(tmp_path / "tcpipe-store")
    assert found["damage"] == []
    assert ["unchecked: a .db3 carries no checksum" in line for line in found["remarks"]] == [True]
    assert any("its headers count simulated time" in line for line in found["findings"]["warnings"])


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_why_a_log_of_another_encoding_is_refused_is_said(tmp_path, encoding):
    with (tmp_path / "run.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("foxglove.PoseInFrame", f"{encoding}schema", b"{}")
        channel = writer.register_channel("/pose", encoding, schema)
        writer.add_message(channel, START_NS, b"{}", START_NS)
        writer.finish()
    said = plain_lines(tcpipe("ingest", "run.mcap", cwd=tmp_path), 1)
    assert (
        f"topics that hold data which cannot be decoded: /pose: its messages are encoded as {encoding}; cdr and" in said
    )


def test_what_plays_no_role_is_said_and_kept(tmp_path):
    (stream,) = drive()
    columns = {name: values[:20] for name, values in stream.columns.items()}
    few = MessageStream("/odom", ODOMETRY, stream.log_time_ns[:20], columns, stream.constants)
    write_mcap(tmp_path / "run.mcap", [stream, few])
    done = tcpipe("ingest", "run.mcap", cwd=tmp_path)
    line = (
        "wheel_odometry: left out: /odom (20 messages over 0.4 s; "
        "it covers little of what /wheel/odom covers (1500 messages over 30.0 s))"
    )
    assert line in " ".join((done.stdout + done.stderr).split())
    (manifest,) = (tmp_path / "tcpipe-store").glob("runs/*/*/manifest.json")
    assert line in json.loads(manifest.read_text())["warnings"]


def test_logs_in_object_storage(tmp_path):
    bucket = tmp_path / "store" / "drives"
    bucket.mkdir(parents=True)
    write_mcap(bucket / "run.mcap", drive())
    (bucket / "junk.bag").write_bytes(b"nonsense")
    (bucket / "notes.txt").write_text("none of a log")
    with object_store(tmp_path / "store") as (environment, fetched):
        first = tcpipe("ingest", "s3://drives", cwd=tmp_path, env=environment)
        assert "s3://drives/junk.bag: not a log" in plain_lines(first, 3)
        assert "1 done, 1 failed" in first.stdout
        assert run_json(tmp_path / "tcpipe-store")["source"]["paths"] == ["s3://drives/run.mcap"]
        assert sorted(fetched) == ["junk.bag", "run.mcap"]
        again = tcpipe("ingest", "s3://drives/run.mcap", cwd=tmp_path, env=environment)
        assert "nothing to do: 1 of 1" in again.stdout
        assert sorted(fetched) == ["junk.bag", "run.mcap"]  # what is known is not fetched again
        denied = tcpipe("inspect", f"s3://{FORBIDDEN}/run.mcap", cwd=tmp_path, env=environment)
        assert "wants credentials; set AWS_" in plain_lines(denied, 1, most=1)


@pytest.fixture
def undefined(tmp_path):
    """A log of a type that neither it nor tcpipe defines."""
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="test")
        channel = writer.register_channel("/x", "cdr", writer.register_schema("acme_msgs/msg/Thing", "ros2msg", b""))
        writer.add_message(channel, 1, b"\0\1\0\0\0\0\x20\x41", 1)
        writer.finish()
    (tmp_path / "msgs" / "acme_msgs" / "msg").mkdir(parents=True)
    (tmp_path / "msgs" / "acme_msgs" / "msg" / "Thing.msg").write_text("float32 height  # [m]\n")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "Thing.msg").write_text("float32 {\n")
    (tmp_path / "none").mkdir()
    return tmp_path


def test_definitions_that_a_log_lacks_can_be_given(undefined):
    assert "give its .msg files" in tcpipe("inspect", "--full", "a.mcap", cwd=undefined).stdout
    assert tcpipe("inspect", "--full", "a.mcap", "--msgdef", "msgs", cwd=undefined).returncode == 0
    exported = tcpipe("export", "a.mcap", "out", "--msgdef", "msgs", "--json", cwd=undefined)
    (topic,) = json.loads(exported.stdout)["topics"]
    table = pq.read_table(undefined / topic["path"])
    assert table["height"].to_pylist() == [10.0]
    assert json.loads(table.schema.metadata[b"tcpipe"])["definition_from"] == "given"


@pytest.mark.parametrize(
    ("directory", "code", "said"),
    [
        ("broken", 1, "its definition cannot be parsed"),
        ("none", 1, "no .msg or .idl file below it"),
        ("nowhere", 2, "does not exist"),
        ("a.mcap", 2, "is a file"),
    ],
)
def test_definitions_that_cannot_be_used_are_refused(undefined, directory, code, said):
    assert said in plain_lines(tcpipe("inspect", "a.mcap", "--msgdef", directory, cwd=undefined), code)


def test_export_says_what_it_did_and_that_nothing_is_left_to_do(tmp_path):
    write_mcap(tmp_path / "run.mcap", drive())
    first = tcpipe("export", "run.mcap", "/wheel/odom", "out", cwd=tmp_path)
    assert (first.returncode, "1500 messages  /wheel/odom" in first.stdout) == (0, True)
    again = tcpipe("export", "run.mcap", "--topics", "/wheel/odom", "out", cwd=tmp_path)
    assert (again.returncode, again.stdout) == (0, "nothing to do: 1 of 1 topics of run.mcap are in out already\n")
    as_json = json.loads(tcpipe("export", "run.mcap", "out", "--json", cwd=tmp_path).stdout)
    assert (as_json["status"], as_json["exit_code"], as_json["topics"][0]["messages"]) == ("unchanged", 0, 1500)
    refused = tcpipe("export", "run.mcap", "out", "--topics", "/a,/b", "--json", cwd=tmp_path)
    assert len(json.loads(refused.stdout)["problems"]) == 2
