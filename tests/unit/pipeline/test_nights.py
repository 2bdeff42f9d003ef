"""Ingest night after night: logs that are still copied, known trouble, files that change, and what it costs to do nothing."""

import errno
import os
import shutil

import pytest
from tcpipe.formats.run_documents import LogOrigin, RunJson
from wheel_drives import START_NS, ask_status, drive_at, wheel_drive

import tcpipe.pipeline.ingest_run as ingestion
from tcpipe.errors import UsageError
from tcpipe.formats.logs.writing import MessageStream, write_bag, write_rosbag2
from tcpipe.pipeline import ingest as ingest_module
from tcpipe.pipeline import plan as plan_module
from tcpipe.pipeline.calls import LogWriter
from tcpipe.pipeline.ingest import ingest, run_ingest
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.options import IngestOptions
from tcpipe.pipeline.problems import acknowledge
from tcpipe.pipeline.prune import prune
from tcpipe.pipeline.status import find_status
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
def test_a_half_copied_log_is_superseded_when_it_is_complete_and_counts_when_it_is_back(tmp_path, night, name):
    whole, log, first = drive_at(tmp_path / "whole.mcap"), tmp_path / "logs" / "run.mcap", tmp_path / "logs" / name
    copy_part(whole, first, 0.6)
    half = (
        night()[0][name].run.run_id
        if name == "run.mcap"
        else ingest([first], store=tmp_path / "store").results[0].run.run_id
    )
    first.unlink()
    shutil.copy(whole, log)
    found, code = night()
    assert (code, found["run.mcap"].status) == (0, "done")
    assert found["run.mcap"].notes == (
        f"run {half}, made from this path before, is superseded: this log contains its content",
    )
    assert half not in counted(tmp_path)
    assert inspect(tmp_path / "store", recipe=Recipe()).superseded == {half: found["run.mcap"].run.run_id}
    assert night()[0]["run.mcap"].notes == ()  # said once
    for place in ("run.mcap", "elsewhere.mcap"):  # back where it was, then under another name
        copy_part(whole, tmp_path / "logs" / place, 0.6)
        assert f"run {half} counts again: its log is available again" in night()[0][place].notes
        assert half in counted(tmp_path)
        (tmp_path / "logs" / place).unlink()
        shutil.copy(whole, log)
        night()
        assert half not in counted(tmp_path)


def test_a_half_copied_log_that_lies_elsewhere_too_still_counts(tmp_path, night):
    whole, log = drive_at(tmp_path / "whole.mcap"), tmp_path / "logs" / "run.mcap"
    copy_part(whole, log, 0.6)
    shutil.copy(log, tmp_path / "logs" / "twin.mcap")
    half = night()[0]["run.mcap"].run.run_id
    shutil.copy(whole, log)
    (note,) = night()[0]["run.mcap"].notes
    assert note.endswith(f"stays: its log is at {tmp_path}/logs/twin.mcap")
    assert half in counted(tmp_path)


@pytest.mark.parametrize(
    ("later", "why"),
    [
        ({"seed": 1, "start_ns": START_NS + 10**12}, "its content differs"),
        ({"seed": 1}, "its content differs"),  # no battery behind the clock: each drive begins at one instant
        ({"rows": 700}, "this log contains 47% of it"),
    ],
)
def test_a_name_used_again_and_a_log_that_lost_something_supersede_nothing(tmp_path, night, later, why):
    log = drive_at(tmp_path / "logs" / "latest.mcap")
    before = night()[0]["latest.mcap"].run.run_id
    drive_at(log, **later)
    found, code = night()
    assert (code, found["latest.mcap"].notes) == (0, (f"run {before}, made from this path before, stays: {why}",))
    assert {before, found["latest.mcap"].run.run_id} <= counted(tmp_path)


# --- logs that are still written ------------------------------------------------------------------------------------


def test_a_young_log_waits_and_is_no_failure(tmp_path, night):
    log = tmp_path / "logs" / "other.mcap"
    found, code = night(min_age_s=3600.0)
    assert (found["other.mcap"].status, code) == ("waiting", 0)
    assert not (tmp_path / "store").exists()
    os.utime(log, ns=(0, 10**18))
    assert night(min_age_s=3600.0)[0]["other.mcap"].status == "done"
    assert night(min_age_s=1e12)[0]["other.mcap"].status == "unchanged"  # what is there does not wait


def test_a_log_that_changes_while_it_is_looked_at_waits_also_where_it_cannot_be_read_yet(tmp_path, night, monkeypatch):
    log = tmp_path / "logs" / "other.mcap"

    def growing(*_, **__):
        with log.open("ab") as file:
            file.write(b"more")
        raise ValueError("half a message")

    monkeypatch.setattr(ingestion, "_read", growing)
    found, code = night()
    assert (found["other.mcap"].status, code) == ("waiting", 0)
    monkeypatch.undo()
    assert night()[0]["other.mcap"].status == "damaged"  # nothing of it was remembered as a failure


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

    monkeypatch.setattr(ingestion, "_fuse_and_label", failing)
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
    checked = verify(tmp_path / "store")
    assert checked.problems == ()
    assert checked.read["commits"] == len(list((tmp_path / "store" / "log").iterdir()))


# --- the memory of logs ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("broken", ["a digit", "half", "[]", "nothing", "gone"])
def test_a_commit_that_is_not_as_it_was_written_is_a_problem_and_nothing_is_lost_for_good(tmp_path, night, broken):
    run_id = night()[0]["other.mcap"].run.run_id
    store = Store(tmp_path / "store")
    number = store.state().runs[run_id, next(iter(store.state().runs))[1]].commit
    commit = tmp_path / "store" / "log" / f"{number:010}.json"
    whole = commit.read_bytes()
    sha256 = run_id.rsplit("-", 1)[1].encode()
    contents = {"a digit": whole.replace(sha256, b"0" * 8), "half": whole[:40], "[]": b"[]", "nothing": b""}
    commit.write_bytes(contents[broken]) if broken in contents else commit.unlink()
    found = ask_status(store.root, min_age_s=0.0)
    assert (found.exit_code, [of.code for of in found.problems]) == (
        3,
        ["commit-missing" if broken == "gone" else "commit-damaged"],
    )
    assert any(str(commit) in line for line in verify(store.root).problems)
    assert [night()[0]["other.mcap"].status for _ in range(2)] == ["done", "unchanged"], "its manifest is found"
    assert counted(tmp_path) == {run_id}
    assert ask_status(store.root, min_age_s=0.0).exit_code == 3, "what else it held nobody knows"
    acknowledge([str(commit)], store=store.root)
    assert ask_status(store.root, min_age_s=0.0).exit_code == 0


def test_what_is_there_already_needs_no_worker_and_no_reader(tmp_path, night, monkeypatch):
    (tmp_path / "logs" / "junk.bag").write_bytes(JUNK)
    drive_at(tmp_path / "logs" / "second.mcap")
    night()

    def refused(*_, **__):
        raise AssertionError

    monkeypatch.setattr("tcpipe.execution.ProcessPoolExecutor", refused)
    monkeypatch.setattr(ingestion, "open_logs", refused)
    found, code = night(jobs=8)
    assert code == 0
    assert [result.status for result in found.values()] == ["failed", "unchanged", "unchanged"]


class _Killed(BaseException):
    pass


def test_after_a_kill_between_manifest_and_commit_the_run_is_found_and_not_fused_again(tmp_path, night, monkeypatch):
    real = LogWriter.commit

    def killed(self, kind, entries):
        if kind == "ingested":
            raise _Killed
        real(self, kind, entries)

    with monkeypatch.context() as patch:
        patch.setattr(LogWriter, "commit", killed)
        with pytest.raises(_Killed):
            night()
    assert counted(tmp_path) == set()
    assert any("no commit names it" in line for line in verify(tmp_path / "store").problems)
    monkeypatch.setattr(ingestion, "_fuse_and_label", lambda *_: pytest.fail("it is fused again"))
    assert night()[0]["other.mcap"].status == "done"
    assert len(counted(tmp_path)) == 1
    assert verify(tmp_path / "store").problems == ()


def test_what_an_ingest_under_another_recipe_replaces_can_be_pruned(tmp_path, night):
    night()
    other = Recipe(label=LabelConfig(velocity="fused"))
    ingest([tmp_path / "logs"], store=tmp_path / "store", recipe=other)
    assert (
        prune(store=tmp_path / "store", recipe=Recipe()).removed == ()
    )  # the first recipe's results are the older ones
    (old,) = prune(store=tmp_path / "store", recipe=other).removed
    assert old.what == "old recipe"
    assert verify(tmp_path / "store").problems == ()


def test_a_run_that_is_pruned_while_it_is_ingested_is_not_committed_but_made_by_the_next_call(
    tmp_path, night, monkeypatch
):
    """Its files may be about to go; so may those of its other recipes, which a call commits again with their tags."""
    store, other, real = tmp_path / "store", Recipe(label=LabelConfig(velocity="fused")), ingest_module._make_entries
    night()
    ingest([tmp_path / "logs"], store=store, recipe=other)

    def meanwhile(log, task, of):
        assert of.rows
        monkeypatch.setattr(ingest_module, "_make_entries", real)
        assert len(prune(store=store, recipe=other).removed) == 1
        return real(log, task, of)

    monkeypatch.setattr(ingest_module, "_make_entries", meanwhile)
    (result,) = ingest([tmp_path / "logs" / "other.mcap"], store=store, recipe=Recipe(), force=True).results
    assert result.status == "failed"
    assert result.problems[0].startswith(f"{result.log}: 'tcpipe prune' removed run other-")
    assert result.problems[0].endswith(" at the same time; run the command again")
    assert len(Store(store).state().runs) == 1
    assert night()[0]["other.mcap"].status == "done"
    assert len(Store(store).runs()) == 2
    assert verify(store).problems == ()


def test_a_superseded_run_that_is_pruned_while_its_log_is_back_is_made_by_the_next_call(tmp_path, night, monkeypatch):
    whole, log, store = drive_at(tmp_path / "whole.mcap"), tmp_path / "logs" / "run.mcap", tmp_path / "store"
    copy_part(whole, log, 0.6)
    half = night()[0]["run.mcap"].run.run_id
    shutil.copy(whole, log)
    night()
    copy_part(whole, tmp_path / "logs" / "back.mcap", 0.6)
    real, other = ingest_module._make_entries, Recipe(label=LabelConfig(velocity="fused"))

    def meanwhile(log, task, of):
        monkeypatch.setattr(ingest_module, "_make_entries", real)
        assert [each.what for each in prune(store=store).removed] == ["superseded run"]
        return real(log, task, of)

    def ingest_again():
        (result,) = ingest([tmp_path / "logs" / "back.mcap"], store=store, recipe=other).results
        return result

    monkeypatch.setattr(ingest_module, "_make_entries", meanwhile)
    result = ingest_again()
    assert (result.status, Store(store).state().find_rows(half)) == ("failed", [])
    result = ingest_again()
    assert (result.status, result.run.run_id in counted(tmp_path)) == ("damaged", True)
    assert verify(store).problems == ()


def test_of_two_calls_that_ingest_one_recording_under_two_names_the_first_commit_wins(tmp_path, night, monkeypatch):
    shutil.copy(drive_at(tmp_path / "elsewhere" / "first.mcap", seed=7), tmp_path / "logs" / "second.mcap")
    real = ingest_module._make_entries

    def meanwhile(log, task, of):
        if of.result.log.endswith("second.mcap") and of.rows:
            monkeypatch.setattr(ingest_module, "_make_entries", real)
            ingest([tmp_path / "elsewhere"], store=tmp_path / "store", recipe=Recipe())
        return real(log, task, of)

    monkeypatch.setattr(ingest_module, "_make_entries", meanwhile)
    found, code = night()
    assert (found["second.mcap"].status, code) == ("unchanged", 0)
    assert found["second.mcap"].same_as == str(tmp_path / "elsewhere" / "first.mcap")
    found, code = night()
    assert (found["second.mcap"].status, code) == ("unchanged", 0)
    assert str(found["second.mcap"].run.run_id).startswith("first-")


def test_a_night_asks_a_bucket_the_same_however_many_runs_there_are(tmp_path, served):
    """Beyond one request for each commit that no snapshot has yet."""
    store, logs, counts = "s3://tests/store", tmp_path / "logs", {"new log": [], "nothing new": [], "status": []}
    for number in range(4):
        drive_at(logs / f"{number}.mcap", seed=number, start_ns=START_NS + number * 10**13)
        calls = {"new log": run_ingest, "nothing new": run_ingest, "status": find_status}
        for what, call in calls.items():
            commits = Store(store).state().number
            served.requests = 0
            assert call(IngestOptions([logs], store=store, recipe=Recipe())).exit_code == 0
            counts[what].append(served.requests - commits)
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
    (known,) = [Store(tmp_path / "store").run_json(run_id) for run_id in counted(tmp_path)]
    assert known.source.paths == (result.log,)
    annexed.unlink()
    with pytest.raises(UsageError, match=rf"run\.mcap: is a link to {annexed}, which is not there"):
        ingest([tmp_path / "logs" / "run.mcap"], store=tmp_path / "store", recipe=Recipe())


def test_two_recordings_of_one_name_whose_hashes_begin_alike_are_two_runs(tmp_path):
    store, names = Store(tmp_path), []
    hashes = ["abcdef01" + digit * 56 for digit in "012"] + ["abcdef01" + "0" * 55 + "9"]
    for sha256 in hashes:
        names.append(store.name_run("latest", sha256))
        store.write_run_json(names[-1], RunJson(LogOrigin(("/latest.bag",), sha256)))
    assert names == ["latest-abcdef01", "latest-abcdef011111", "latest-abcdef012222", "latest-abcdef010000"]
    for sha256, name in zip(hashes, names, strict=True):
        assert store.name_run("latest", sha256) == name


def test_a_run_json_that_is_not_as_it_was_written_costs_no_other_log_and_is_made_again(tmp_path, night):
    run_id = night(tags={"weather": "dry"})[0]["other.mcap"].run.run_id
    path = tmp_path / "store" / "runs" / run_id / "run-1.json"
    whole = path.read_bytes()
    path.write_bytes(whole[:-9])
    (tmp_path / "logs" / "junk.mcap").write_bytes(JUNK)
    found, _ = night()
    assert [found[name].status for name in ("other.mcap", "junk.mcap")] == ["done", "failed"]
    assert path.with_name("run-2.json").read_bytes() == whole, "its tags are those of the manifest, which is whole"
    assert night()[0]["other.mcap"].status == "unchanged"


def test_a_part_of_a_split_recording_takes_static_transforms_from_the_part_before(tmp_path):
    first, second = tmp_path / "logs" / "run_0.bag", tmp_path / "logs" / "run_1.bag"
    first.parent.mkdir()
    (stream,) = wheel_drive(rows=1000)
    write_bag(first, [stream, MessageStream("/tf_static", "tf2_msgs/msg/TFMessage", stream.log_time_ns[:1])])
    write_bag(second, wheel_drive(seed=1, start_ns=int(stream.log_time_ns[-1]) + 10**7))
    summary = ingest([tmp_path / "logs"], store=tmp_path / "store", recipe=Recipe())
    assert [result.status for result in summary.results] == ["done", "done"]
    known = [Store(tmp_path / "store").run_json(result.run.run_id).notes for result in summary.results]
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


def test_a_log_that_was_lost_is_written_again_from_the_runs(tmp_path, night):
    run_id = night()[0]["other.mcap"].run.run_id
    shutil.rmtree(tmp_path / "store" / "log")
    found = night()[0]["other.mcap"]
    assert (found.run.run_id, found.status) == (run_id, "done")
    assert counted(tmp_path) == {run_id}
