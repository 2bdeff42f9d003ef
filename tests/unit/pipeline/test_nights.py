"""Ingest night after night: logs that are still copied, known trouble, files that change, and what it costs to do nothing."""

import errno
import os
import shutil

import pytest
from wheel_drives import START_NS, ask_status, drive_at, wheel_drive

import tcpipe.pipeline.ingest_run as ingestion
from tcpipe.errors import UsageError
from tcpipe.formats import documents
from tcpipe.formats.logs.writing import MessageStream, write_bag, write_rosbag2
from tcpipe.pipeline import plan as plan_module
from tcpipe.pipeline.ingest import ingest, run_ingest
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.options import IngestOptions
from tcpipe.pipeline.problems import acknowledge
from tcpipe.pipeline.status import find_log_states
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import LabelConfig, Recipe
from tcpipe.store import Store

JUNK = b"junk" * 100


@pytest.fixture
def night(tmp_path):
    """Ingest the folder ``logs`` into one store; return status, news and notes by name, and the exit code."""

    def run(**how):
        summary = ingest([tmp_path / "logs"], store=tmp_path / "store", recipe=Recipe(), **how)
        return {result.log.rsplit("/", 1)[-1]: result for result in summary.results}, summary.exit_code

    drive_at(tmp_path / "logs" / "other.mcap", seed=99, start_ns=START_NS + 10**13)
    return run


def counted(tmp_path):
    """Return the runs that a dataset would be made from."""
    return {run.run_id for run in Store(tmp_path / "store").runs()}


# --- half-copied logs -----------------------------------------------------------------------------------------------


def copy_part(whole, to, share):
    data = whole.read_bytes()
    to.write_bytes(data[: int(len(data) * share)])


@pytest.mark.parametrize("name", ["run.mcap", "run.mcap.active"])
def test_a_half_copied_log_is_superseded_as_soon_as_the_whole_one_is_there(tmp_path, night, name):
    whole, log, first = drive_at(tmp_path / "whole.mcap"), tmp_path / "logs" / "run.mcap", tmp_path / "logs" / name
    copy_part(whole, first, 0.6)
    half = (
        night()[0][name].run.run_id
        if name == "run.mcap"
        else ingest([first], store=tmp_path / "store").results[0].run.run_id
    )
    assert half in counted(tmp_path)
    first.unlink()
    shutil.copy(whole, log)
    found, code = night()
    assert (code, found["run.mcap"].status) == (0, "done")
    assert found["run.mcap"].notes == (f"run {half} is superseded: this log begins in the same way and is longer",)
    assert half not in counted(tmp_path)
    assert inspect(tmp_path / "store", recipe=Recipe()).superseded == {half: found["run.mcap"].run.run_id}
    assert night()[0]["run.mcap"].notes == ()  # said once
    copy_part(whole, tmp_path / "logs" / "elsewhere.mcap", 0.6)
    assert night()[0]["elsewhere.mcap"].status == "unchanged"
    assert half not in counted(tmp_path)
    assert ask_status(tmp_path / "store").counts == {"done": 2, "superseded": 1}


# --- logs that are still written ------------------------------------------------------------------------------------


def test_a_young_log_waits_and_is_no_failure(tmp_path, night):
    log = tmp_path / "logs" / "other.mcap"
    found, code = night(min_age=3600.0)
    assert (found["other.mcap"].status, code) == ("waiting", 0)
    assert not (tmp_path / "store").exists()
    os.utime(log, ns=(0, 10**18))
    assert night(min_age=3600.0)[0]["other.mcap"].status == "done"
    assert night(min_age=1e12)[0]["other.mcap"].status == "unchanged"  # what is there does not wait


# --- known trouble --------------------------------------------------------------------------------------------------


def told(night, name, **how):
    found, code = night(**how)
    return found[name].status, found[name].known, code


def test_a_failure_is_news_once_until_something_is_another(tmp_path, night, monkeypatch):
    junk = tmp_path / "logs" / "junk.bag"
    junk.write_bytes(JUNK)
    once, again = ("failed", False, 3), ("failed", True, 0)
    assert [told(night, "junk.bag") for _ in range(3)] == [once, again, again]
    assert told(night, "junk.bag", retry_failed=True) == once
    assert told(night, "junk.bag", robot="jackal") == once
    assert told(night, "junk.bag") == again
    junk.write_bytes(JUNK + b"!")
    assert [told(night, "junk.bag") for _ in range(2)] == [once, again]
    monkeypatch.setattr(plan_module, "__version__", "9.9.9")
    assert [told(night, "junk.bag") for _ in range(2)] == [once, again]
    (tmp_path / "tcpipe.toml").write_text("[segment]\nchord_m = 2.0\n")
    summaries = [ingest([junk], store=tmp_path / "store", recipe=tmp_path / "tcpipe.toml") for _ in range(2)]
    assert [summary.exit_code for summary in summaries] == [1, 0]
    drive_at(tmp_path / "logs" / "junk.bag")
    assert told(night, "junk.bag") == ("done", False, 0)


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left on device"), MemoryError(), BlockingIOError(errno.EAGAIN, "locked")]
)
def test_what_may_pass_is_tried_again(night, monkeypatch, error):
    def failing(*_, **__):
        raise error

    monkeypatch.setattr(ingestion, "run_stages", failing)
    assert [told(night, "other.mcap") for _ in range(2)] == [("failed", False, 1)] * 2
    monkeypatch.undo()
    assert told(night, "other.mcap") == ("done", False, 0)


def test_damage_is_news_once_and_accepted_trouble_is_counted_apart(tmp_path, night):
    junk, cut = tmp_path / "logs" / "junk.bag", tmp_path / "logs" / "cut.mcap"
    junk.write_bytes(JUNK)
    copy_part(drive_at(tmp_path / "whole.mcap"), cut, 0.6)
    found, code = night()
    assert (found["cut.mcap"].is_new_problem, code) == (True, 3)
    assert (told(night, "cut.mcap"), told(night, "cut.mcap", force=True)) == (
        ("unchanged", True, 0),
        ("damaged", True, 3),  # junk.bag was tried again
    )
    run_id = found["cut.mcap"].run.run_id
    with pytest.raises(UsageError) as caught:
        acknowledge([run_id, "nosuch", found["other.mcap"].run.run_id], store=tmp_path / "store")
    assert [line.split(":")[0] for line in caught.value.problems] == ["nosuch", found["other.mcap"].run.run_id]
    assert f"known problems: {junk}, {run_id}" in caught.value.problems[0]
    assert not found["cut.mcap"].acknowledged
    done = acknowledge([run_id, str(junk)], store=tmp_path / "store")
    assert [problem.name for problem in done.acknowledged] == [run_id, str(junk)]
    second = acknowledge(["junk.bag"], store=tmp_path / "store")
    assert (second.acknowledged, [problem.name for problem in second.before]) == ((), [str(junk)])
    found, code = night(retry_failed=True, force=True)
    assert (code, found["cut.mcap"].acknowledged, found["junk.bag"].acknowledged) == (0, True, True)
    copy_part(tmp_path / "whole.mcap", cut, 0.5)
    assert night()[1] == 3  # that is another damage
    assert verify(tmp_path / "store").problems == ()


# --- the memory of logs ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("broken", ["a digit", "half", "[]", "nothing", "gone"])
def test_a_manifest_that_is_not_as_it_was_written_is_a_problem_and_its_log_is_ingested_again(tmp_path, night, broken):
    run_id = night(tag={"weather": "dry"})[0]["other.mcap"].run.run_id
    store = Store(tmp_path / "store")
    (name,) = [name for (kind, _), name in store.scan().names.items() if kind == "runs"]
    path = store.root / name
    whole = path.read_bytes()
    contents = {"a digit": whole.replace(b"1", b"2", 1), "half": whole[:40], "[]": b"[]", "nothing": b""}
    path.write_bytes(contents[broken]) if broken in contents else path.unlink()
    documents._DECODED.clear()  # as a later call would find it
    found = ask_status(store.root, min_age=0.0)
    assert [of.code for of in found.problems] == ([] if broken == "gone" else ["document-damaged"])
    assert (found.exit_code, found.counts) == (0 if broken == "gone" else 3, {"pending": 1})
    (tmp_path / "logs" / "junk.mcap").write_bytes(JUNK)
    assert [night()[0]["other.mcap"].status for _ in range(2)] == ["done", "unchanged"]
    assert counted(tmp_path) == {run_id}
    assert [run.facts.tags for run in store.runs()] == [{"weather": "dry"}]
    assert ask_status(store.root, min_age=0.0).problems == (), "a new manifest has taken its place"


def test_a_document_that_is_damaged_and_that_no_call_writes_again_is_acknowledged(tmp_path, night):
    night(tag={"weather": "dry"})
    store = Store(tmp_path / "store")
    (file,) = store.place.list("tags")
    (store.root / "tags" / file).write_bytes(b"")
    documents._DECODED.clear()  # as a later call would find it
    night()
    found = ask_status(store.root, min_age=0.0)
    assert (found.exit_code, [of.subject.name for of in found.problems]) == (3, [f"tags/{file}"])
    assert [run.facts.tags for run in store.runs()] == [{}]
    acknowledge([f"tags/{file}"], store=store.root)
    assert ask_status(store.root, min_age=0.0).exit_code == 0
    night(tag={"weather": "wet"})
    assert [run.facts.tags for run in store.runs()] == [{"weather": "wet"}]


def test_runs_of_two_recipes_live_side_by_side_and_share_their_streams(tmp_path, night, monkeypatch):
    night(tag={"soil": "dry"})
    other = Recipe(label=LabelConfig(velocity="fused"))
    monkeypatch.setattr(ingestion, "_read", lambda *_: pytest.fail("the log is read again"))
    ingest([tmp_path / "logs"], store=tmp_path / "store", recipe=other)
    first, second = Store(tmp_path / "store").runs()
    assert first.run_id == second.run_id
    assert first.facts.blob != second.facts.blob
    assert first.facts.streams_blob == second.facts.streams_blob
    assert [run.facts.tags for run in (first, second)] == [{"soil": "dry"}] * 2
    for recipe in (Recipe(), other):
        assert {
            result.status for result in ingest([tmp_path / "logs"], store=tmp_path / "store", recipe=recipe).results
        } == {"unchanged"}


def test_a_night_asks_a_bucket_the_same_however_many_runs_there_are(tmp_path, served):
    """Beyond one request for each document that the index does not have yet."""
    store, logs, counts = "s3://tests/store", tmp_path / "logs", {"new log": [], "nothing new": [], "status": []}
    for number in range(4):
        drive_at(logs / f"{number}.mcap", seed=number, start_ns=START_NS + number * 10**13)
        calls = {"new log": run_ingest, "nothing new": run_ingest, "status": find_log_states}
        for what, call in calls.items():
            documents._DECODED.clear()  # as another process
            before, served.requests = len(served), 0
            assert call(IngestOptions([logs], store=store, recipe=Recipe())).exit_code == 0
            read = sum(name.endswith(".json") for name in served[before:])
            counts[what].append(served.requests - read)
    assert {what: len(set(of[1:])) for what, of in counts.items()} == dict.fromkeys(counts, 1), counts


# --- names ----------------------------------------------------------------------------------------------------------


def test_a_link_is_called_what_the_user_calls_it(tmp_path):
    """git-annex: the file lies under the name of its hash."""
    annexed = drive_at(tmp_path / ".git" / "annex" / "SHA256E-s123--abc.mcap")
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "run.mcap").symlink_to(annexed)
    summary = ingest([tmp_path / "logs", annexed], store=tmp_path / "store", recipe=Recipe())
    (result,) = summary.results
    assert result.log == str(tmp_path / "logs" / "run.mcap")
    assert result.run.run_id.startswith("run-")
    (known,) = Store(tmp_path / "store").runs()
    assert known.facts.log.paths == (result.log,)
    annexed.unlink()
    with pytest.raises(UsageError, match=rf"run\.mcap: is a link to {annexed}, which is not there"):
        ingest([tmp_path / "logs" / "run.mcap"], store=tmp_path / "store", recipe=Recipe())


def test_a_part_of_a_split_recording_takes_static_transforms_from_the_part_before(tmp_path):
    first, second = tmp_path / "logs" / "run_0.bag", tmp_path / "logs" / "run_1.bag"
    first.parent.mkdir()
    (stream,) = wheel_drive(rows=1000)
    write_bag(first, [stream, MessageStream("/tf_static", "tf2_msgs/msg/TFMessage", stream.log_time_ns[:1])])
    write_bag(second, wheel_drive(seed=1, start_ns=int(stream.log_time_ns[-1]) + 10**7))
    summary = ingest([tmp_path / "logs"], store=tmp_path / "store", recipe=Recipe())
    assert [result.status for result in summary.results] == ["done", "done"]
    store = Store(tmp_path / "store")
    known = [store.find_runs(result.run.run_id)[0].manifest.notes for result in summary.results]
    assert [[of.names["earlier"] for of in notes if "earlier" in of.names] for notes in known] == [[], ["run_0.bag"]]


def test_damage_that_leaves_no_message_is_the_cause_and_no_sensor_is_missing(tmp_path):
    write_rosbag2(tmp_path / "run", wheel_drive(rows=1000))
    path = tmp_path / "cut.db3"
    path.write_bytes((tmp_path / "run" / "run.db3").read_bytes()[:28672])
    (result,) = ingest([path], store=tmp_path / "store", recipe=Recipe()).results
    assert result.status == "failed"
    assert [of.code for of in result.causes] == ["log-failed", "file-cut", "database-damaged"]
    inspected = inspect(path, recipe=Recipe())
    assert inspected.problems == ("the log is damaged, and no message can be read",)
    assert {of.code for of in inspected.findings} == {"log-damaged"}
