"""Status lists the state and problems of every log: each state once, as ingest left it."""

import os
import shutil
from dataclasses import replace

import pytest
from click.testing import CliRunner
from synthetic_store import add_run, lanes, segments
from wheel_drives import START_NS, ask_status, drive_at

from tcpipe import __version__
from tcpipe.cli import cli
from tcpipe.errors import UsageError
from tcpipe.formats.runs import Output
from tcpipe.pipeline import ingest as ingest_module
from tcpipe.pipeline import ingest_run as ingest_run_module
from tcpipe.pipeline import plan as plan_module
from tcpipe.pipeline.calls import record_call
from tcpipe.pipeline.ingest import CallOptions, ingest
from tcpipe.pipeline.problems import acknowledge, forget_tables
from tcpipe.recipe import ReadConfig, Recipe
from tcpipe.store import Store, open_store
from tcpipe.tables.levels import RESULTS_VERSION

OLD_NS = 10**18


@pytest.fixture(scope="module")
def first_night(tmp_path_factory):
    """A folder of four logs, long written, and the store of its first night."""
    root = tmp_path_factory.mktemp("status")
    drive_at(root / "logs" / "whole.mcap")
    drive_at(root / "logs" / "second.mcap", seed=1, start_ns=START_NS + 10**13)
    (root / "logs" / "cut.mcap").write_bytes(
        drive_at(root / "third.mcap", seed=2, start_ns=START_NS + 10**14).read_bytes()[:-4000]
    )
    (root / "logs" / "junk.bag").write_bytes(b"junk" * 100)
    for path in (root / "logs").iterdir():
        os.utime(path, ns=(OLD_NS, OLD_NS))
    assert ingest([root / "logs"], store=root / "store", recipe=Recipe()).exit_code == 3
    return root


@pytest.fixture
def night(first_night, tmp_path):
    shutil.copytree(first_night, tmp_path / "n", symlinks=True, copy_function=shutil.copy2)
    return tmp_path / "n"


def where(root, *logs, **how):
    return ask_status(root / "store", *(logs or [root / "logs"]), **how)


def states(found):
    return {group.state: sorted(name.rsplit("/", 1)[-1] for name in group.logs) for group in found.groups}


def test_what_ingest_did_is_what_status_says_and_the_calls_are_remembered(first_night):
    found = where(first_night)
    assert states(found) == {
        "done": ["second.mcap", "whole.mcap"],
        "partial": ["cut.mcap"],
        "failed_permanent": ["junk.bag"],
    }
    assert (found.exit_code, found.problems) == (3, ())
    (call,) = found.history
    assert (call.command, call.counts, call.exit_code) == ("ingest", {"done": 2, "damaged": 1, "failed": 1}, 3)
    assert call.works_on == (str(first_night / "logs"),)
    assert call.wall_s > 0.0
    assert call.cpu_s > 0.0
    assert call.end > call.begin


def test_the_first_line_says_what_to_do_now(first_night, night, tmp_path):
    found = where(first_night)
    assert str(found).splitlines()[0] == found.to_do_now
    assert found.to_do_now == "to do now: look at 1 log (partial), or acknowledge it"
    assert where(night).to_do_now == "to do now: tcpipe ingest (4 logs)"
    drive_at(tmp_path / "logs" / "only.mcap")
    os.utime(tmp_path / "logs" / "only.mcap", ns=(OLD_NS, OLD_NS))
    ingest([tmp_path / "logs"], store=tmp_path / "store", recipe=Recipe())
    assert where(tmp_path).to_do_now == "nothing to do"
    (tmp_path / "logs" / "only.mcap").unlink()
    gone = ask_status(tmp_path / "store")
    assert gone.to_do_now.startswith(f"to do now: {tmp_path / 'logs'}: contains no readable log. ")
    assert gone.to_do_now.endswith("[log-missing]")


def test_an_output_whose_last_call_failed_is_a_problem_until_a_call_for_it_ends_well(night):
    store = Store(night / "store")
    ingest([night / "logs"], store=store.root, recipe=Recipe())
    for run_id in [str(night / "logs" / "junk.bag"), *(row.run_id for row in store.scan().list_rows() if row.damage)]:
        acknowledge([run_id], store=store.root)

    def end(code, message, at):
        output = Output(where="/out", exit_code=code, message=message, at=at)
        store.put(store.scan(), "outputs", "0" * 16, output)
        return [of for of in where(night).problems if of.code == "output-failed"], where(night).exit_code

    assert end(0, "", "2026-11-01T00:00:00") == ([], 0)
    (finding,), code = end(1, "the disk is full\nmore", "2026-11-02T00:00:00")
    assert (code, finding.subject.name, finding.names["message"]) == (3, "/out", "the disk is full")
    assert end(0, "", "2026-11-03T00:00:00") == ([], 0)


def test_without_logs_it_looks_where_ingest_was_told_to(first_night, tmp_path):
    assert ask_status(first_night / "store").counts == where(first_night).counts
    add_run(store := open_store(tmp_path / "store", create=True), "a", segments("a", *lanes(0.0, 0.0, 5.0)))
    with pytest.raises(UsageError, match="no earlier call of ingest is known; give the logs"):
        ask_status(store.root)
    with pytest.raises(UsageError, match="there is no store here; run 'tcpipe ingest' first"):
        ask_status(tmp_path / "none")


def test_a_log_that_is_gone_is_trouble_only_where_the_latest_call_was_given_it(first_night, tmp_path):
    stick = drive_at(tmp_path / "stick" / "one.mcap", seed=3)
    ingest([stick], store=tmp_path / "store", recipe=Recipe())
    stick.unlink()
    found = ask_status(tmp_path / "store")
    assert (found.exit_code, [of.code for of in found.problems], found.gone) == (3, ["log-missing"], ())
    shutil.copytree(first_night / "logs", tmp_path / "logs", ignore=lambda *_: {"cut.mcap", "junk.bag"})
    ingest([tmp_path / "logs"], store=tmp_path / "store", recipe=Recipe())
    found = ask_status(tmp_path / "store")
    assert (found.exit_code, found.problems, found.counts) == (0, (), {"done": 2})
    assert f"of earlier calls: {stick}: there is no such file or directory" in str(found)
    assert ask_status(tmp_path / "store", stick).exit_code == 3
    acknowledge([str(stick)], store=tmp_path / "store")
    assert ask_status(tmp_path / "store", stick).exit_code == 0


def test_new_changed_growing_passing_and_accepted_logs_are_told_apart(night):
    logs, store = night / "logs", night / "store"
    # The copy lies elsewhere: its logs were never seen there, until the second night.
    assert states(where(night)) == {"pending": ["cut.mcap", "junk.bag", "second.mcap", "whole.mcap"]}
    again = {
        result.log: result.run.run_id for result in ingest([logs], store=store, recipe=Recipe()).results if result.run
    }
    found_run = again[str(logs / "cut.mcap")]
    assert where(night).counts == {"done": 2, "partial": 1, "failed_permanent": 1}
    acknowledge([str(logs / "junk.bag")], store=store)
    acknowledge([found_run], store=store)
    drive_at(logs / "growing.mcap", seed=4)
    drive_at(logs / "passing.mcap", seed=5)  # however young it is: it was old enough when it failed
    drive_at(logs / "new.mcap", seed=5)
    os.utime(logs / "new.mcap", ns=(OLD_NS, OLD_NS))
    shutil.copy(logs / "second.mcap", logs / "whole.mcap")
    os.utime(logs / "whole.mcap", ns=(OLD_NS, OLD_NS + 1))
    line = f"{logs / 'passing.mcap'}: No space left on device (28)"
    with record_call(Store(store), "ingest", [str(logs)], CallOptions()) as call:
        call.result = {"exit_code": 3, "failed": {str(logs / "passing.mcap"): line}}
    found = where(night)
    assert found.counts == {"done": 2, "quarantined": 1, "growing": 1, "pending": 2, "failed_transient": 1}
    told = {(group.state, group.cause): group.logs for group in found.groups}
    assert told["pending", ""] == (str(logs / "new.mcap"),)
    assert told["pending", "its content has changed"] == (str(logs / "whole.mcap"),)
    assert told["failed_transient", "No space left on device (28)"] == (str(logs / "passing.mcap"),)
    assert told["done", "damaged, acknowledged"] == (str(logs / "cut.mcap"),)
    assert found.exit_code == 3  # the disk is full
    assert "2 pending" in str(found)


def test_a_run_of_another_recipe_or_superseded_is_told_so(first_night):
    other = replace(Recipe(), read=ReadConfig(ignore_topics=["/none"]))
    found = where(first_night, recipe=other)
    (group,) = [group for group in found.groups if group.state == "outdated"]
    assert group.cause.startswith("made under another recipe (")
    assert len(group.logs) == 3


def test_a_failure_that_was_acknowledged_is_tried_again_under_another_recipe_and_says_why(
    first_night, tmp_path, monkeypatch
):
    logs, store = tmp_path / "logs", tmp_path / "store"
    shutil.copytree(first_night / "store", store)
    logs.mkdir()
    shutil.copy2(first_night / "logs" / "junk.bag", logs)
    other = replace(Recipe(), read=ReadConfig(ignore_topics=["/none"]))

    def told(recipe, **how):
        (group,) = where(tmp_path, recipe=recipe, **how).groups
        return group.state, group.cause

    assert told(Recipe()) == ("pending", "")
    ingest([logs], store=store, recipe=Recipe())
    why = "failed under another recipe, for another robot or with other message definitions"
    assert told(other) == ("pending", f"{why}; to be tried again")
    acknowledge([str(logs / "junk.bag")], store=store)
    assert told(Recipe())[0] == "quarantined"
    assert told(other) == ("pending", f"{why}, acknowledged; to be tried again")
    assert told(Recipe(), retry_failed=True) == ("pending", "failed before, acknowledged; to be tried again")
    again = ingest([logs], store=store, recipe=other)
    assert [(of.status, of.acknowledged) for of in again.results] == [("failed", True)]
    assert again.exit_code == 0
    assert told(other)[0] == "quarantined"
    monkeypatch.setattr(plan_module, "__version__", "9.9.9")
    assert told(other) == ("pending", f"failed with tcpipe {__version__}, acknowledged; to be tried again")


@pytest.mark.parametrize("how", ["pruned", "acknowledged"])
def test_a_run_whose_tables_were_given_up_is_superseded(first_night, tmp_path, how):
    root = shutil.copytree(first_night / "store", tmp_path / "store", copy_function=shutil.copy2)
    store, log = Store(root), str(first_night / "logs" / "whole.mcap")
    (row,) = [row for row in store.scan().list_rows() if row.run_id.startswith("whole-")]
    shutil.rmtree(root / "blobs" / row.blob)
    acknowledge([row.run_id], store=root) if how == "acknowledged" else forget_tables(store, store.scan(), row)
    found = ask_status(root, first_night / "logs")
    (group,) = [group for group in found.groups if group.state == "superseded"]
    assert (group.cause, group.logs) == ("its run was pruned; --force ingests it again", (log,))
    assert found.problems == ()


def test_a_store_that_is_not_there_is_named_as_it_was_given(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = CliRunner().invoke(cli, ["status", "nosuch"])
    assert str(told.exception) == "nosuch: no store here and none at tcpipe-store; name one with --store"


def test_a_drive_without_a_segment_is_news_once_and_can_be_accepted(tmp_path):
    drive_at(tmp_path / "logs" / "drive.mcap")

    def run(*words):
        return CliRunner().invoke(cli, words, standalone_mode=False)

    os.utime(tmp_path / "logs" / "drive.mcap", ns=(OLD_NS, OLD_NS))
    (tmp_path / "tcpipe.toml").write_text("[segment]\nchord_m = 900.0\n")  # no drive here is as long
    how = ["--store", str(tmp_path / "store"), "--recipe", str(tmp_path / "tcpipe.toml")]
    ingest_it = ["ingest", str(tmp_path / "logs"), *how]
    first = run(*ingest_it)
    assert first.return_value == 3, first.output
    assert any(line.startswith("empty ") for line in first.output.splitlines())
    (why,) = [line for line in first.output.splitlines() if line.endswith("[no-segments]")]
    assert why.strip().startswith("error: no segments from ")
    for label in ("position", "time", "energy"):
        assert f"verdict: {label} · not usable" in first.output
    again = run(*ingest_it)
    assert again.return_value == 0
    assert "(empty, known)" in again.output
    hint = "1 log known as damaged or empty; 'tcpipe acknowledge RUN' after you have checked it"
    assert hint in again.output.splitlines()
    shown = run("status", *how)
    assert (shown.return_value, "1 empty" in shown.output) == (3, True)
    assert "1 of 1 runs: No segments [no-segments]" in shown.output
    (run_id,) = [row.run_id for row in Store(tmp_path / "store").scan().list_rows()]
    acknowledged = run("acknowledge", run_id, *how[:2])
    assert "[no-segments]" in acknowledged.output
    shown = run("status", *how)
    assert (shown.return_value, "done, empty, acknowledged" in shown.output) == (0, True)
    assert run(*ingest_it).return_value == 0


# --- versions -------------------------------------------------------------------------------------------------------


def raise_version(monkeypatch):
    for module in (plan_module, ingest_module, ingest_run_module):
        monkeypatch.setattr(module, "RESULTS_VERSION", RESULTS_VERSION + 1)


def test_a_version_with_other_results_makes_all_runs_again_and_says_how_many(night, monkeypatch, caplog):
    logs, store = night / "logs", night / "store"
    ingest([logs], store=store, recipe=Recipe())
    raise_version(monkeypatch)
    found = where(night)
    assert found.counts == {"outdated": 3, "failed_permanent": 1}
    assert {group.cause for group in found.groups if group.state == "outdated"} == {
        f"made with version {RESULTS_VERSION} of the results, which now are version {RESULTS_VERSION + 1}"
    }
    caplog.clear()
    summary = ingest([logs], store=store, recipe=Recipe())
    (line,) = [line for line in caplog.messages if "gives other results" in line]
    assert f"tcpipe {__version__} gives other results (version {RESULTS_VERSION + 1}): 3 runs are made again" in line
    assert sorted(result.status for result in summary.results) == ["damaged", "done", "done", "failed"]
    assert {run.facts.results_version for run in Store(store).runs()} == {RESULTS_VERSION + 1}
    caplog.clear()
    ingest([logs], store=store, recipe=Recipe())
    assert caplog.messages == []


def test_a_version_with_the_same_results_makes_no_run_again_but_tries_failed_and_damaged_logs(
    night, monkeypatch, caplog
):
    logs, store = night / "logs", night / "store"
    ingest([logs], store=store, recipe=Recipe())
    monkeypatch.setattr(plan_module, "__version__", "9.9.9")
    found = where(night)
    assert found.counts == {"done": 2, "outdated": 1, "pending": 1}
    told = {name.rsplit("/", 1)[-1]: group.cause for group in found.groups for name in group.logs}
    assert told["cut.mcap"] == f"its damaged log was read by tcpipe {__version__}"
    assert told["junk.bag"] == f"failed with tcpipe {__version__}; to be tried again"
    monkeypatch.setattr(ingest_run_module, "__version__", "9.9.9")
    monkeypatch.setattr(ingest_module, "__version__", "9.9.9")
    summary = ingest([logs], store=store, recipe=Recipe())
    assert sorted(result.status for result in summary.results) == ["damaged", "failed", "unchanged", "unchanged"]
    assert where(night).counts == {"done": 2, "partial": 1, "failed_permanent": 1}
    assert caplog.messages == []
