"""verify, explain, overlay, preflight, audit and diff as a user runs them, from a simulated log on."""

import json
import re
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
from installed_command import plain_lines, tcpipe
from mcap.reader import make_reader
from pyproj import Geod
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from stored_files import manifest as manifest_path
from stored_files import only_run

GEOD = Geod(ellps="WGS84")


@pytest.fixture(scope="module")
def work(tmp_path_factory, tiny_site):
    here = tmp_path_factory.mktemp("trust")
    shutil.copytree(tiny_site.directory, here / "site")
    layers = [
        item for name in ("height", "ortho", "terrain", "classes") for item in (f"--{name}", tiny_site.rasters[name])
    ]
    for arguments in (
        ("ingest", *(here / "site" / "logs").iterdir()),
        ("add-map", "site", *layers),
        ("build-dataset",),
    ):
        done = tcpipe(*arguments, "--quiet", cwd=here)
        # so small a site is one block, and that is told: nothing tests
        assert (done.returncode, done.stderr[:34]) == (
            (3, "tcpipe: warning: test: no samples ") if arguments == ("build-dataset",) else (0, "")
        )
    return here


@pytest.fixture(scope="module")
def ids(work):
    return pq.read_table(work / "dataset" / "samples.parquet")["sample_id"].to_pylist()


def test_verify_names_what_is_wrong_one_line_each_and_fails(work):
    path = work / "dataset" / "samples.parquet"
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + b"!")
    (work / "dataset" / "mine.txt").touch()
    try:
        done, as_json = tcpipe("verify", "dataset", cwd=work), tcpipe("verify", "dataset", "--json", cwd=work)
    finally:
        path.write_bytes(whole)
        (work / "dataset" / "mine.txt").unlink()
    assert (done.returncode, as_json.returncode) == (1, 1)
    problems = json.loads(as_json.stdout)["problems"]
    assert len(problems) == 2
    head, *lines = done.stdout.splitlines()
    assert head.endswith(": 2 problems")
    assert lines[:2] == problems
    assert any(line.startswith("dataset/samples.parquet: its sha256 is") for line in problems)
    assert "dataset/mine.txt: is no file of this dataset" in problems


def test_a_sample_is_traced_to_its_log(work, ids):
    done = tcpipe("explain", ids[0], "--dataset", "dataset", "--store", "tcpipe-store", "--quiet", cwd=work)
    assert done.returncode == 0, done.stdout
    lines = done.stdout.splitlines()
    assert {"labels", "log", "stamps", "messages", "map", "recipe", "versions"} <= {
        line.split()[0] for line in lines[1:]
    }
    found = json.loads(tcpipe("explain", ids[-1], "--json", "--quiet", cwd=work).stdout)
    facts, gnss = found["facts"], found["facts"]["messages"]["gnss"]
    assert facts["sample"]["start_ns"] <= gnss["first_ns"] <= gnss["last_ns"] < facts["sample"]["end_ns"]
    assert facts["run"]["log"]["paths"][0].endswith(".mcap")


def test_an_overlay_lies_on_its_logs_clock_and_on_its_segments(work):
    run = only_run(work / "tcpipe-store").run_id
    (log,) = (work / "site" / "logs").glob("*.mcap")
    done = tcpipe("overlay", run, "over.mcap", cwd=work)
    assert done.returncode == 0, done.stderr
    whole = (work / "over.mcap").read_bytes()
    assert tcpipe("overlay", run, "over.mcap", "--store", "tcpipe-store", "--json", cwd=work).returncode == 0
    assert (work / "over.mcap").read_bytes() == whole, "it is not the same again"
    read = messages_of(work / "over.mcap", "/tcpipe/fix", "/tcpipe/segment", "/tcpipe/segments")
    segments = [message for _, message in read["/tcpipe/segment"]]
    table = only_run(work / "tcpipe-store").segments()
    assert [message.segment_id for message in segments] == table["segment_id"].to_pylist()
    assert [message.energy_joule for message in segments] == table["energy_joule"].to_pylist()
    # A segment is a chord of one metre, and the track passes its start when the message says so.
    ((_, drawn),) = read["/tcpipe/segments"]
    lines = {
        of["properties"]["segment_id"]: of["geometry"]["coordinates"]
        for of in json.loads(drawn.geojson)["features"]
        if "segment_id" in of["properties"]
    }
    fixes = np.array([(at, fix.longitude, fix.latitude) for at, fix in read["/tcpipe/fix"]])
    for begin, message in read["/tcpipe/segment"]:
        (lon, lat), end = lines[message.segment_id]
        assert GEOD.line_length(*zip((lon, lat), end, strict=True)) == pytest.approx(1.0, abs=0.001)
        assert message.power_watt == pytest.approx(message.energy_joule / message.duration_s)
        near = [np.interp(begin, fixes[:, 0], fixes[:, at]) for at in (1, 2)]
        assert GEOD.inv(lon, lat, *near)[2] < 0.02
    # What was measured at a stamp is played when the recorder received what was measured then.
    (recorded,) = messages_of(log, "/a200_0000/sensors/gps_0/fix").values()
    delays_ns = np.array([[at, at - stamp_ns(fix)] for at, fix in recorded])
    ours_ns = np.array([[at, at - stamp_ns(fix)] for at, fix in read["/tcpipe/fix"]])
    apart_ns = ours_ns[:, 1] - np.interp(ours_ns[:, 0], *delays_ns.T)
    assert np.abs(apart_ns).max() < 0.05e9
    plain_lines(tcpipe("overlay", run, log, cwd=work), 2)  # a recording is never replaced
    assert "exists and is not an overlay" in tcpipe("overlay", run, log, cwd=work).stderr
    made_of_itself = tcpipe("ingest", "over.mcap", "--store", "another", cwd=work)
    assert made_of_itself.returncode == 1
    assert "tcpipe made it from another log" in made_of_itself.stderr + made_of_itself.stdout


def test_a_preflight_promises_what_ingesting_gives(work):
    (log,) = (work / "site" / "logs").glob("*.mcap")
    manifest = json.loads(manifest_path(only_run(work / "tcpipe-store")).read_text())
    done = tcpipe("preflight", log, "--json", "--quiet", cwd=work)
    found = json.loads(done.stdout)
    promise, label = found["expected_yield"], manifest["info"]["report"]["facts"]["label"]
    assert done.returncode == 3  # half a minute is too short for a prediction
    assert "log-too-short" in {finding["code"] for finding in found["findings"]}
    assert promise["segments"] == manifest["counts"]["segments"] == 10
    assert promise["segments_per_hour"] == pytest.approx(36000 / promise["span_s"])
    assert promise["distance_by_reason_m"] == pytest.approx(manifest["distance_by_reason_m"])
    assert promise["relative_std_median"] == pytest.approx(label["relative_std_median"])
    ignored = ["/a200_0000/sensors/gps_0/fix", "/a200_0000/platform/mcu/status/power"]
    # Without fixes and power nothing could be trained on, and it says so before the day in the field.
    (work / "blind.toml").write_text(f"[read]\nignore_topics = {json.dumps(ignored)}\n")
    blind = json.loads(tcpipe("preflight", log, "--json", "-q", "--recipe", "blind.toml", cwd=work).stdout)
    assert {"no-gnss", "no-power"} <= {finding["code"] for finding in blind["findings"]}
    assert blind["exit_code"] == 3
    assert blind["expected_yield"]["relative_std_median"]["energy"] is None
    (work / "blind.toml").unlink()


def test_an_audit_holds_a_track_against_what_is_withheld_from_it(work):
    (log,) = (work / "site" / "logs").glob("*.mcap")
    done = tcpipe("audit", log, "--json", "--quiet", cwd=work)
    found = json.loads(done.stdout)
    assert (done.returncode, done.stderr) == (0, "")
    (fixes,) = found["scores"]
    assert fixes["median_error_m"] < 0.1
    assert (fixes["window_s"], fixes["windows"], fixes["within_2_sigma"]) == (10.0, 1, 1.0)
    assert any(line.startswith("gnss, 30 s: covers ") and "40 s are needed" in line for line in found["skipped"])
    # The same from the store, and as text.
    run = only_run(work / "tcpipe-store")
    by_name = tcpipe("audit", run.name, "--store", "tcpipe-store", "--json", cwd=work)
    assert json.loads(by_name.stdout)["scores"] == found["scores"]
    text = tcpipe("audit", log, "-q", "--robot", "husky", cwd=work).stdout
    assert re.search(r"^ *10 s +1 +\d+ +0\.\d{3} .* 100% .*$", text, re.MULTILINE)
    assert not list(work.glob("*audit*"))


def test_an_audit_of_a_run_without_anything_to_compare(work):
    (log,) = (work / "site" / "logs").glob("*.mcap")
    (work / "fixes.toml").write_text("[read.topics]\nwheel_odometry = []\nvisual_odometry = []\n")
    said = plain_lines(tcpipe("audit", log, "--recipe", "fixes.toml", "-q", cwd=work), 2)
    (work / "fixes.toml").unlink()
    assert "nothing can be withheld and compared" in said
    assert "gnss, no other sensor measures motion" in said
    assert "tcpipe audit RUN --store tcpipe-store" in plain_lines(tcpipe("audit", "tcpipe-store", "-q", cwd=work), 2)


def messages_of(path, *topics):
    """The log times and messages of topics, all without any, by mcap's reader and what the file says of its types."""
    store, found = get_typestore(Stores.EMPTY), {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(topics or None):
            for name, fields in get_types_from_msg(schema.data.decode(), schema.name).items():
                if name not in store.types:
                    store.register({name: fields})
            found.setdefault(channel.topic, []).append(
                (message.log_time, store.deserialize_cdr(message.data, schema.name))
            )
    return found


def stamp_ns(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def test_diff_names_cause_and_effect(work):
    same = tcpipe("diff", "dataset", "dataset", cwd=work)
    assert (same.returncode, len(same.stdout.splitlines())) == (0, 1)
    done = tcpipe("build-dataset", "other", "--holdout", "sample", "--jobs", "2", "--quiet", cwd=work)
    assert done.returncode == 0, done.stderr
    other = tcpipe("diff", "dataset", "other", cwd=work)
    assert other.returncode == 1
    assert "recipe: split.holdout block → sample" in other.stdout.splitlines()
    found = json.loads(tcpipe("diff", "dataset", "other", "--json", cwd=work).stdout)
    assert (found["same"], found["causes"]) == (False, ["recipe: split.holdout block → sample"])
    assert found["samples"]["other patches"] == 0
