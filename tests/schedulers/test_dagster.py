"""The Dagster definitions, executed: a log is found, becomes a run, a dataset and a model, with metadata and checks.

`make test-dagster` runs it in an environment of its own.
"""

import os
import runpy
from pathlib import Path

import pytest

from tcpipe.pipeline.maps import add_map
from tcpipe.simulation import Faults, make_tiny, simulate

dg = pytest.importorskip("dagster", reason="dagster is not installed (make test-dagster)")

DEFINITIONS = Path(__file__).parents[2] / "pipelines" / "dagster" / "definitions.py"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("site")
    made = simulate(place, scenario=make_tiny(Faults.every()))
    add_map("site", **made.rasters, store=place / "store")
    os.utime(place / "logs" / "tiny.mcap", ns=(10**18, 10**18))
    return place


@pytest.fixture
def defs(site: Path, monkeypatch: pytest.MonkeyPatch) -> dg.Definitions:
    where = {"LOGS": "logs", "STORE": "store", "DATASET": "dataset", "MODEL": "model"}
    for name, place in where.items():
        monkeypatch.setenv(f"TCPIPE_{name}", str(site / place))
    monkeypatch.delenv("TCPIPE_SPLIT", raising=False)
    return runpy.run_path(str(DEFINITIONS))["defs"]


def found(defs, instance):
    """Return what the sensor asks for, and what partitions it makes."""
    return defs.resolve_sensor_def("new_logs")(dg.build_sensor_context(instance=instance))


def test_a_new_log_is_found_and_becomes_a_dataset_with_metadata_and_checks(defs, site):
    with dg.DagsterInstance.ephemeral() as instance:
        tick = found(defs, instance)
        (request,) = tick.run_requests
        (wanted,) = tick.dynamic_partitions_requests
        assert (request.partition_key, wanted.partition_keys) == ("tiny.mcap", ["tiny.mcap"])
        instance.add_dynamic_partitions("logs", ["tiny.mcap"])
        assert not found(defs, instance).dynamic_partitions_requests

        done = defs.resolve_job_def("one_log").execute_in_process(instance=instance, partition_key="tiny.mcap")
        made = {
            event.step_key: event.step_materialization_data.materialization.metadata
            for event in done.get_asset_materialization_events()
        }
        assert done.success
        assert made["run"]["segments"].value > 5
        assert made["run"]["driven_m"].value == pytest.approx(14.5, abs=0.5)
        checks = {check.check_name: check for check in done.get_asset_check_evaluations()}
        assert checks["as_written"].passed
        assert checks["usable"].passed
        assert {checks["usable"].metadata[name].value for name in ("position", "time", "energy")} == {"usable"}

        built = dg.materialize(
            [defs.resolve_assets_def("dataset"), defs.resolve_assets_def("run").to_source_asset()],
            instance=instance,
            selection="dataset",
        )
        assert built.success
        metadata = built.asset_materializations_for_node("dataset")[0].metadata
        assert metadata["samples"].value == made["run"]["segments"].value
        assert "accelerating" in metadata["where_every_metre_went"].value
        assert metadata["map"].value.startswith("![map](data:image/png;base64,")
        assert {c.check_name: c.passed for c in built.get_asset_check_evaluations()} == {
            "as_written": True,
            "as_asked_for": False,
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


def test_the_definitions_can_be_loaded(defs):
    dg.Definitions.validate_loadable(defs)
    assert {spec.key.to_user_string() for spec in defs.resolve_all_asset_specs()} == {"run", "dataset", "model"}
