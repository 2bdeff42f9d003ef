"""Logs of every kind and state, through the installed command."""

import json
import os
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
from installed_command import plain_lines, tcpipe, told
from mcap.writer import Writer
from storage_server import FORBIDDEN, object_store
from stored_files import only_run
from wheel_drives import START_NS, drive_at, wheel_drive

from tcpipe.formats.logs.writing import write_mcap, write_rosbag2
from tcpipe.stages import mask


@pytest.mark.parametrize(("content", "store"), [(b"nonsense", "tcpipe-store"), (b"#ROSBAG V2.0\n", "deep/down/store")])
def test_what_cannot_be_ingested_is_known_to_fail_from_then_on(tmp_path, content, store):
    (tmp_path / "a.bag").write_bytes(content)
    done = tcpipe("ingest", "a.bag", "--store", store, cwd=tmp_path)
    plain_lines(done, 1)
    assert done.stdout.splitlines()[1] == f"new store: {store}"
    assert done.stdout.splitlines()[-1] == f"1 log failed; no run was added to {store}"
    found = told(tcpipe("ingest", "a.bag", "--store", store, "--json", cwd=tmp_path))
    assert (found["store"], found["exit_code"], found["results"][0]["known"]) == (store, 0, True)
    plain_lines(tcpipe("ingest", "a.bag", "--store", store, "--retry-failed", cwd=tmp_path), 1)
    done = tcpipe("acknowledge", "a.bag", "--store", store, "--json", cwd=tmp_path)
    assert (done.returncode, len(json.loads(done.stdout)["acknowledged"])) == (0, 1)


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
    assert f"topics with data that cannot be decoded: /pose: its messages are encoded as {encoding}; cdr and" in said


def test_the_good_are_done_and_the_bad_are_named(tmp_path):
    drive_at(tmp_path / "good" / "run.mcap")
    (tmp_path / "empty").mkdir()
    bad = ["empty", "gone.mcap", "s3://bucket-that-is-none/x.mcap"]
    environment = {"AWS_SKIP_SIGNATURE": "true", "AWS_ENDPOINT_URL": "http://127.0.0.1:9", "AWS_ALLOW_HTTP": "true"}
    done = tcpipe("ingest", bad[0], "good", bad[1], "--json", cwd=tmp_path)
    assert "empty: no log in this directory" in plain_lines(done, 3, most=2)
    assert "gone.mcap: there is no such file" in done.stderr
    assert [(result["log"], result["status"]) for result in told(done)["results"]] == [
        ("empty", "failed"),
        ("gone.mcap", "failed"),
        (str(tmp_path / "good" / "run.mcap"), "done"),
    ]
    plain_lines(tcpipe("ingest", *bad[:2], "--store", "none", cwd=tmp_path), 2, most=2)
    plain_lines(tcpipe("ingest", bad[2], "--store", "none", cwd=tmp_path, env=environment), 1, most=1)  # it may pass
    assert not (tmp_path / "none").exists()


def test_each_log_is_told_as_it_ends(tmp_path, monkeypatch):
    """The line of the first log is printed before the second one is cut."""
    for seed, name in enumerate("ab"):
        drive_at(tmp_path / f"{name}.mcap", seed=seed)
    mask_track, printed = mask.mask_track, {}

    def look(track, *how, **more):
        printed[track.info.run_id[0]] = os.pread(1, 100_000, 0).decode()
        return mask_track(track, *how, **more)

    monkeypatch.setattr(mask, "mask_track", look)
    done = tcpipe("ingest", "a.mcap", "b.mcap", "--json", "--quiet", "--jobs", "1", cwd=tmp_path)
    first, *_ = lines = done.stdout.splitlines(keepends=True)
    assert (printed["a"], printed["b"]) == ("", first)
    assert [json.loads(line)["kind"] for line in lines] == ["log", "log", "summary"]


def test_shares_of_a_folder_and_parts_of_a_bag(tmp_path):
    for number in range(2):
        drive_at(tmp_path / "logs" / f"run{number}.mcap", seed=number)
    write_rosbag2(tmp_path / "logs" / "bag", wheel_drive(seed=5), storage="sqlite3")
    shutil.copy(tmp_path / "logs" / "run0.mcap", tmp_path / "logs" / "bag" / "bag_1.mcap")
    shares = [tcpipe("ingest", "logs", "--shard", f"{index}/2", "--json", cwd=tmp_path) for index in (1, 2)]
    assert [share.returncode for share in shares] == [0, 0]
    logs = [
        {result["log"].rsplit("/", 1)[1]: result["status"] for result in told(share)["results"]} for share in shares
    ]
    assert logs[0].keys().isdisjoint(logs[1])
    assert logs[0] | logs[1] == dict.fromkeys(["bag", "run0.mcap", "run1.mcap"], "done")
    part = tcpipe("ingest", "logs/bag/bag_1.mcap", cwd=tmp_path)
    assert f"is one of the 2 parts of the ROS 2 bag {tmp_path / 'logs' / 'bag'}" in plain_lines(part, 2, most=1)


def test_logs_in_object_storage(tmp_path):
    bucket = tmp_path / "store" / "drives"
    bucket.mkdir(parents=True)
    write_mcap(bucket / "run.mcap", wheel_drive(seed=5))
    (bucket / "junk.bag").write_bytes(b"nonsense")
    (bucket / "notes.txt").write_text("none of a log")
    with object_store(tmp_path / "store") as (environment, fetched):
        first = tcpipe("ingest", "s3://drives", cwd=tmp_path, env=environment)
        assert "s3://drives/junk.bag: not a log" in plain_lines(first, 3)
        assert "1 done, 1 failed" in first.stdout
        assert only_run(tmp_path / "tcpipe-store").facts.log.paths == ("s3://drives/run.mcap",)
        assert set(fetched) == {"junk.bag", "run.mcap"}
        requests = len(fetched)
        again = tcpipe("ingest", "s3://drives/run.mcap", cwd=tmp_path, env=environment)
        assert "nothing to do: 1 of 1" in again.stdout
        assert len(fetched) == requests  # what is known is not fetched again
        denied = tcpipe("inspect", f"s3://{FORBIDDEN}/run.mcap", cwd=tmp_path, env=environment)
        assert "requires credentials; set AWS_" in plain_lines(denied, 1, most=1)


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
    ("command", "directory", "code", "said"),
    [
        ("inspect", "broken", 1, "its definition cannot be parsed"),
        ("ingest", "none", 1, "no .msg or .idl file below it"),
        ("preflight", "nowhere", 2, "no such directory"),
        ("audit", "none", 1, "no .msg or .idl file below it"),
        ("inspect", "a.mcap", 2, "is a file"),
    ],
)
def test_definitions_that_cannot_be_used_are_refused(undefined, command, directory, code, said):
    assert said in plain_lines(tcpipe(command, "a.mcap", "--msgdef", directory, cwd=undefined), code)


def test_export_says_what_it_did_and_that_nothing_is_left_to_do(tmp_path):
    write_mcap(tmp_path / "run.mcap", wheel_drive(seed=5))
    first = tcpipe("export", "run.mcap", "/wheel/odom", "out", cwd=tmp_path)
    assert (first.returncode, "1500 messages  /wheel/odom" in first.stdout) == (0, True)
    again = tcpipe("export", "run.mcap", "--topics", "/wheel/odom", "out", cwd=tmp_path)
    assert (again.returncode, again.stdout) == (0, "nothing to do: 1 of 1 topics of run.mcap are in out already\n")
    as_json = json.loads(tcpipe("export", "run.mcap", "out", "--json", cwd=tmp_path).stdout)
    assert (as_json["status"], as_json["exit_code"], as_json["topics"][0]["messages"]) == ("unchanged", 0, 1500)
    refused = tcpipe("export", "run.mcap", "out", "--topics", "/a,/b", "--json", cwd=tmp_path)
    assert len(json.loads(refused.stdout)["problems"]) == 2


def test_fixes_of_no_ground_robot_make_no_run_and_no_promise(tmp_path):
    """RTK of up to 30 m/s with power gives no labels, unless the recipe or the robot allows the speed."""
    at_s = np.arange(0.0, 120.0, 0.1)
    way_m = np.cumsum(0.1 * np.minimum(0.5 * at_s, 30.0))
    rows = "".join(
        f"{1.7e9 + t:.1f},{47.0 + way / 111_200:.9f},15.0,400.0,0.02\n" for t, way in zip(at_s, way_m, strict=True)
    )
    (tmp_path / "log").mkdir()
    (tmp_path / "log" / "gnss.csv").write_text(f"t,lat,lon,alt,std\n{rows}")
    (tmp_path / "log" / "power.csv").write_text("t,v,i\n" + "".join(f"{1.7e9 + t:.1f},24.0,5.0\n" for t in at_s))
    tables = """
[read.extrinsics]
gnss = { xyz_m = [0.0, 0.0, 0.0] }
[tables.gnss]
file = "gnss.csv"
columns = { latitude = "lat", longitude = "lon", altitude = "alt", east_std = "std", north_std = "std", up_std = "std" }
[tables.power]
file = "power.csv"
columns = { voltage = "v", current = "i" }
"""
    (tmp_path / "fast.toml").write_text(tables)
    (tmp_path / "recipe.toml").write_text(tables + "[mask]\nmax_plausible_mps = 50.0\n")
    (tmp_path / "robot.toml").write_text(tables + "[robots.racer]\nmax_plausible_mps = 50.0\n")
    refused = tcpipe("ingest", "log", "--recipe", "fast.toml", "--robot", "generic", cwd=tmp_path)
    assert refused.returncode == 1
    assert "[track-too-fast]" in refused.stderr + refused.stdout
    assert "mask.max_plausible_mps" in refused.stderr + refused.stdout
    promise = tcpipe("preflight", "log", "--recipe", "fast.toml", "--robot", "generic", cwd=tmp_path)
    assert (promise.returncode, "promises" in promise.stdout) == (1, False)
    assert "[track-too-fast]" in promise.stdout
    for recipe, robot in (("recipe", "generic"), ("robot", "racer")):
        done = tcpipe("ingest", "log", "--recipe", f"{recipe}.toml", "--robot", robot, "--store", recipe, cwd=tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr
