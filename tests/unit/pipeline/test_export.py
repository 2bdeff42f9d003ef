"""Topics as Parquet: units and definitions in the metadata, nothing done twice, nothing of another log overwritten."""

import json

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.writer import Writer
from random_messages import ROS1, Message, random_messages, write_mcap

from tcpipe.errors import LogError, UsageError
from tcpipe.pipeline.export import export
from tcpipe.pipeline.ingest_run import tag_log
from tcpipe.store import Store

TYPES = ("sensor_msgs/msg/Imu", "sensor_msgs/msg/BatteryState", "nav_msgs/msg/Path")


def renamed(messages, *topics):
    return [Message(topic, m.type_name, m.log_time_ns, m.payload, m.value) for m in messages for topic in topics]


def described(path):
    return json.loads(pq.read_schema(path).metadata[b"tcpipe"])


@pytest.fixture
def log(tmp_path):
    return write_mcap(tmp_path / "a.mcap", random_messages(1, count=20, types=TYPES))


def test_the_definition_stands_in_the_file(tmp_path, log):
    files = {of.topic: of.path for of in export(log, tmp_path / "out").topics}
    about = described(files["/Imu"])
    assert (about["topic"], about["type"], about["definition_from"]) == ("/Imu", "sensor_msgs/msg/Imu", "log")
    assert "float64[9] angular_velocity_covariance" in about["definition"]


@pytest.mark.parametrize("how", [{"store": ROS1}, {}])
def test_a_definition_that_the_log_lacks_is_told_all_the_same(tmp_path, how):
    messages = random_messages(2, count=5, types=("sensor_msgs/msg/BatteryState",), **how)
    path = write_mcap(tmp_path / "a.mcap", messages, define=False, **how)
    (of,) = export(path, tmp_path / "out").topics
    about = described(of.path)
    assert about["definition_from"] == "bundled"
    assert "float32 voltage" in about["definition"]


@pytest.mark.parametrize("kind", ["dataset", "map", "model", "cost map", "store"])
def test_nothing_is_written_between_files_that_are_counted(tmp_path, log, kind):
    out = tmp_path / "out"
    out.mkdir()
    if kind == "store":
        tag_log(Store(out), Store(out).scan(), "0" * 64, {"load": "12"})
    else:
        (out / f"{'zarr' if kind == 'map' else kind.replace(' ', '-')}.json").write_text("{}")
    before = [*out.rglob("*")]
    with pytest.raises(UsageError, match=f"out: is a {kind}; give another directory"):
        export(log, out)
    assert [*out.rglob("*")] == before


def test_a_second_call_finds_everything_done(tmp_path, log):
    out = tmp_path / "out"
    first = export(log, out)
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in out.iterdir()}
    assert export(log, out).status == "unchanged"
    assert export(log, out, topics=["/Imu"]).status == "unchanged"
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in out.iterdir()} == before
    lost = first.topics[0].path
    lost.unlink()
    again = export(log, out)
    assert (again.status, again.topics) == ("done", first.topics)
    assert lost.read_bytes() == before[lost][1]


def test_topics_are_added_to_what_is_there(tmp_path, log):
    out = tmp_path / "out"
    assert [of.topic for of in export(log, out, topics=["/Imu"]).topics] == ["/Imu"]
    assert [of.topic for of in export(log, out, topics=["/Path, /BatteryState"]).topics] == ["/Path", "/BatteryState"]
    assert export(log, out).status == "unchanged"


def test_a_log_that_has_changed_is_exported_again(tmp_path, log):
    export(log, tmp_path / "out")
    write_mcap(log, random_messages(2, count=30, types=TYPES))
    again = export(log, tmp_path / "out")
    assert (again.status, {of.messages for of in again.topics}) == ("done", {30})


def test_files_of_another_log_are_not_overwritten(tmp_path, log):
    export(log, tmp_path / "out", topics=["/Imu"])
    other = write_mcap(tmp_path / "b.mcap", random_messages(2, count=30, types=TYPES))
    with pytest.raises(UsageError, match=r"contains topics of .*a\.mcap; give another directory"):
        export(other, tmp_path / "out")


def test_files_that_are_none_of_an_export_are_not_overwritten(tmp_path, log):
    out = tmp_path / "out"
    out.mkdir()
    pq.write_table(pa.table({"mine": [1]}), out / "Imu.parquet")
    (out / "Path.parquet").write_text("notes")
    with pytest.raises(UsageError) as refused:
        export(log, out)
    assert [line.split(": ")[0] for line in refused.value.problems] == [
        str(out / "Imu.parquet"),
        str(out / "Path.parquet"),
    ]
    assert pq.read_table(out / "Imu.parquet").column_names == ["mine"]
    export(log, tmp_path / "other")
    (tmp_path / "other" / "export.json").unlink()  # as a call that was interrupted leaves it
    assert export(log, tmp_path / "other").status == "done"


def of_one_message(path, type_name, definition, payload):
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(type_name, "ros2msg", definition.encode())
        writer.add_message(writer.register_channel("/x", "cdr", schema), 1, payload, 1)
        writer.finish()
    return path


def test_topics_of_which_none_can_be_read_are_an_error(tmp_path):
    path = of_one_message(tmp_path / "a.mcap", "acme_msgs/msg/Thing", "", b"\0\1\0\0")
    with pytest.raises(LogError, match="no topic can be read") as refused:
        export(path, tmp_path / "out")
    assert "type acme_msgs/msg/Thing is unknown" in refused.value.findings[0].names["reason"]
    assert not (tmp_path / "out").exists()


def test_names_that_make_one_file_name_get_files_of_their_own(tmp_path):
    messages = random_messages(5, count=5, types=("std_msgs/msg/ColorRGBA",))
    path = write_mcap(tmp_path / "a.mcap", renamed(messages, "/a/b", "a/b", "/A_b", "/" + 300 * "x", "/.x"))
    files = {of.topic: of.path.name for of in export(path, tmp_path / "out").topics}
    names = ["A_b.parquet", "_x.parquet", "a_b-2.parquet", "a_b-3.parquet", 200 * "x" + ".parquet"]
    assert sorted(files.values()) == names
    alone = export(path, tmp_path / "other", topics=["a/b"]).topics
    assert [of.path.name for of in alone] == [files["a/b"]]
