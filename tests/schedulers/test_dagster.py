"""The Dagster definitions, executed: a log is found, becomes a run, a dataset and a model, with metadata and checks.

`make test-dagster` runs it in an environment of its own.
"""

import importlib.util
import json
import os
import shutil
import sys
from pathlib import Path

import pytest

from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.maps import add_map
from tcpipe.simulation import Faults, make_tiny, simulate

dg = pytest.importorskip("dagster", reason="dagster is not installed (make test-dagster)")

DEFINITIONS = Path(__file__).parents[2] / "pipelines" / "dagster" / "definitions.py"


@pytest.fixture
def site(simulated: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(simulated, tmp_path / "site"))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("site")
    made = simulate(place, scenario=make_tiny(Faults.every()))
    add_map("site", **made.rasters, store=place / "store")
    os.utime(place / "logs" / "tiny.mcap", ns=(10**18, 10**18))
    return place


@pytest.fixture
def module(site: Path, monkeypatch: pytest.MonkeyPatch):
    where = {"LOGS": "logs", "STORE": "store", "DATASET": "dataset", "MODEL": "model"}
    for name, place in where.items():
        monkeypatch.setenv(f"TCPIPE_{name}", str(site / place))
    monkeypatch.delenv("TCPIPE_SPLIT", raising=False)
    monkeypatch.delenv("TCPIPE_RECIPE", raising=False)
    spec = importlib.util.spec_from_file_location("definitions", DEFINITIONS)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def defs(module) -> dg.Definitions:
    return module.defs


def found(defs, instance, cursor=None):
    """Return what the sensor asks for, and what partitions it makes."""
    return defs.resolve_sensor_def("new_logs")(dg.build_sensor_context(instance=instance, cursor=cursor))


def data_version(materialization):
    return materialization.tags["dagster/data_version"]


@pytest.fixture
def command(module, tmp_path, monkeypatch):
    """A function that puts a program in place of ``tcpipe``."""

    def replace(program):
        path = tmp_path / "program.py"
        path.write_text(program)
        monkeypatch.setattr(module, "_COMMAND", [sys.executable, str(path)])

    return replace


def ingest_one(defs, instance, name="tiny.mcap"):
    """Run the job of one log; return it with the events of its steps."""
    instance.add_dynamic_partitions("logs", [name])
    job = defs.resolve_job_def("one_log")
    return job.execute_in_process(instance=instance, partition_key=name, raise_on_error=False)


def test_a_new_log_is_found_and_becomes_a_dataset_with_metadata_and_checks(defs, site):
    with dg.DagsterInstance.ephemeral() as instance:
        tick = found(defs, instance)
        (request,) = tick.run_requests
        (wanted,) = tick.dynamic_partitions_requests
        assert (request.partition_key, wanted.partition_keys) == ("tiny.mcap", ["tiny.mcap"])
        instance.add_dynamic_partitions("logs", ["tiny.mcap"])
        assert not found(defs, instance).dynamic_partitions_requests
        assert [again.partition_key for again in found(defs, instance).run_requests] == ["tiny.mcap"]

        done = defs.resolve_job_def("one_log").execute_in_process(instance=instance, partition_key="tiny.mcap")
        made = {
            event.step_key: event.step_materialization_data.materialization.metadata
            for event in done.get_asset_materialization_events()
        }
        assert done.success
        assert not found(defs, instance).run_requests, "it is in the store"
        (materialized,) = done.asset_materializations_for_node("run")
        assert {"dagster/data_version", "dagster/code_version"} <= set(materialized.tags)
        assert made["run"]["segments"].value > 5
        assert made["run"]["driven_m"].value == pytest.approx(14.5, abs=0.5)
        checks = {check.check_name: check for check in done.get_asset_check_evaluations()}
        assert checks["as_written"].passed
        assert checks["usable"].passed
        grades = {name: checks["usable"].metadata[name].value for name in ("position", "time", "energy")}
        # Nothing confirms the energy of fewer than twenty segments.
        assert grades == {"position": "usable", "time": "usable", "energy": "usable with care"}

        built = dg.materialize(
            [defs.resolve_assets_def("dataset"), defs.resolve_assets_def("run").to_source_asset()],
            instance=instance,
            selection="dataset",
        )
        assert built.success
        metadata = built.asset_materializations_for_node("dataset")[0].metadata
        again = dg.materialize([defs.resolve_assets_def("dataset")], instance=instance, selection="dataset")
        first, second = (of.asset_materializations_for_node("dataset")[0] for of in (built, again))
        assert data_version(first) == data_version(second), "nothing has changed"
        assert metadata["samples"].value == made["run"]["segments"].value
        assert "accelerating" in metadata["distance_breakdown"].value
        assert metadata["map"].value.startswith("![map](data:image/png;base64,")
        assert {c.check_name: c.passed for c in built.get_asset_check_evaluations()} == {
            "as_written": True,
            "as_requested": False,
            "held_out": True,
        }


def test_a_log_that_is_still_written_is_not_asked_for(defs, site):
    young = site / "logs" / "young.mcap"
    young.write_bytes(b"half")
    try:
        with dg.DagsterInstance.ephemeral() as instance:
            assert [request.partition_key for request in found(defs, instance).run_requests] == ["tiny.mcap"]
            os.utime(young, ns=(10**18, 10**18))
            assert len(found(defs, instance).run_requests) == 2
    finally:
        young.unlink()


def test_what_cannot_be_read_fails_with_the_commands_own_words(defs, site):
    (site / "logs" / "junk.mcap").write_bytes(b"junk")
    try:
        with dg.DagsterInstance.ephemeral() as instance:
            instance.add_dynamic_partitions("logs", ["junk.mcap", "gone.mcap"])
            job = defs.resolve_job_def("one_log")
            failed = job.execute_in_process(instance=instance, partition_key="junk.mcap", raise_on_error=False)
            assert not failed.success
            (event,) = [event for event in failed.all_events if event.is_step_failure]
            assert "junk.mcap" in event.step_failure_data.user_failure_data.description
            assert not [event for event in failed.all_events if event.is_step_up_for_retry], (
                "what it contains does not pass"
            )
    finally:
        (site / "logs" / "junk.mcap").unlink()


def test_ten_thousand_logs_are_asked_for_a_hundred_at_a_time(defs, site, tmp_path, monkeypatch):
    (logs := tmp_path / "many").mkdir()
    for number in range(250):
        (logs / f"{number:03}.mcap").touch()
        os.utime(logs / f"{number:03}.mcap", ns=(10**18, 10**18))
    monkeypatch.setenv("TCPIPE_LOGS", str(logs))
    with dg.DagsterInstance.ephemeral() as instance:
        asked, cursor = [], None
        for _ in range(4):
            tick = found(defs, instance, cursor)
            for wanted in tick.dynamic_partitions_requests:
                instance.add_dynamic_partitions("logs", list(wanted.partition_keys))
            asked.append([request.partition_key for request in tick.run_requests])
            cursor = tick.cursor
    places = [f"{number:03}.mcap" for number in range(250)]
    assert asked == [places[:100], places[100:200], places[200:] + places[:50], places[50:150]]


def test_a_log_that_a_run_works_on_is_not_requested_again(defs, site):
    with dg.DagsterInstance.ephemeral() as instance:
        (request,) = found(defs, instance).run_requests
        instance.create_run_for_job(defs.resolve_job_def("one_log"), tags={"dagster/partition": request.partition_key})
        assert not found(defs, instance).run_requests


@pytest.mark.parametrize(
    ("printed", "ended"),
    [
        ((1, {"kind": "failure", "transient": False}), ("the reason", "once")),
        ((1, {"kind": "failure", "transient": True}), ("the reason", "again")),
        ((2, {"kind": "failure", "transient": False}), ("the reason", "once")),
        ((1, {"status": "failed", "problems": ["no GNSS"], "notes": [], "transient": False}), ("no GNSS", "once")),
        ((1, {"status": "failed", "problems": ["full"], "notes": [], "transient": True}), ("full", "again")),
        ((0, {"status": "waiting", "problems": [], "notes": ["young"], "transient": False}), ("young", "again")),
        ((137, None), ("the reason", "again")),
    ],
)
def test_only_a_failure_that_may_pass_is_retried(module, command, monkeypatch, printed, ended):
    monkeypatch.setattr(dg.RetryPolicy, "calculate_delay", lambda *_: 0)
    exit_code, answer = printed
    text = "" if answer is None else json.dumps(answer if "kind" in answer else {"results": [answer]})
    command(f"import sys\nprint('tcpipe: the reason', file=sys.stderr)\nprint({text!r})\nsys.exit({exit_code})")
    with dg.DagsterInstance.ephemeral() as instance:
        done = ingest_one(module.defs, instance)
    assert not done.success
    is_retried = any(event.is_step_up_for_retry for event in done.all_events)
    (event,) = [event for event in done.all_events if event.is_step_failure]
    assert (event.step_failure_data.user_failure_data.description, "again" if is_retried else "once") == ended


def test_no_model_is_trained_on_a_dataset_that_is_not_as_written(module, site, monkeypatch):
    ingest([site / "logs"], store=site / "store")
    run_command = module._run_command
    monkeypatch.setattr(dg.RetryPolicy, "calculate_delay", lambda *_: 0)

    for problems, trained in ((["one byte differs"], set()), ([], {"model"})):

        def answer(log, command, *arguments, problems=problems, **how):
            if command == "train":
                return module.Answer({"model": "boosting"}, [])
            answer = run_command(log, command, *arguments, **how)
            return module.Answer({**answer.result, "problems": problems}, []) if command == "verify" else answer

        monkeypatch.setattr(module, "_run_command", answer)
        with dg.DagsterInstance.ephemeral() as instance:
            job = module.defs.resolve_job_def("nightly")
            done = job.execute_in_process(instance=instance, raise_on_error=False)
        made = {event.step_key for event in done.get_asset_materialization_events()}
        assert (done.success, made - {"dataset"}) == (bool(trained), trained)


def test_the_definitions_can_be_loaded(defs):
    dg.Definitions.validate_loadable(defs)
    assert {spec.key.to_user_string() for spec in defs.resolve_all_asset_specs()} == {"run", "dataset", "model"}
