"""A dataset of the runs that carry given tags."""

import shutil

import numpy as np
import pytest
from synthetic_store import add_run, change_run, lanes, open_world, segments

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError, StoreError
from tcpipe.formats.place import Place
from tcpipe.formats.recipe_toml import make_recipe_id
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.inspect import inspect
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store
from tcpipe.tables.findings import Remedy, Subject, select_findings


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Three runs: two in dry weather, one of them driven by Eva; one in wet weather."""
    store = open_world(tmp_path_factory.mktemp("chosen"))
    tags = {"a": {"weather": "dry"}, "b": {"weather": "wet"}, "c": {"weather": "dry", "driver": "Eva"}}
    for number, (run_id, own) in enumerate(tags.items()):
        add_run(store, run_id, segments(run_id, *lanes(np.array([3.0 * number]), -10.0, 10.0)), tags=own)
    return store


@pytest.fixture
def store(made, tmp_path):
    return Store(shutil.copytree(made.root, tmp_path / "store", copy_function=shutil.copy2))


def runs(store, tmp_path, **tags):
    build_dataset(tmp_path / "out", store=store.root, recipe=Recipe(), tag=tags, force=True)
    return [run.run_id for run in open_dataset(tmp_path / "out").card.runs]


def test_a_run_needs_all_of_the_tags(store, tmp_path):
    assert runs(store, tmp_path) == ["a", "b", "c"]
    assert runs(store, tmp_path, weather="dry") == ["a", "c"]
    assert runs(store, tmp_path, weather="dry", driver="Eva") == ["c"]


def test_a_tag_that_no_run_has_is_answered_with_those_there_are(store, tmp_path):
    with pytest.raises(DatasetError) as caught:
        build_dataset(tmp_path / "out", store=store.root, recipe=Recipe(), tag={"weather": "snow"})
    (line,) = caught.value.problems
    assert "no run is tagged weather=snow" in line
    assert "driver=Eva, weather=dry, weather=wet" in line
    assert not (tmp_path / "out").exists()


def make_outdated(store, *run_ids):
    """Have runs look as if an earlier version of tcpipe had made them."""
    for run_id in run_ids:
        change_run(store, run_id, data_model_version="0.9")


def test_runs_of_another_data_model_are_named(store, tmp_path):
    make_outdated(store, "a")
    assert runs(store, tmp_path) == ["b", "c"]
    (left_out,) = select_findings(open_dataset(tmp_path / "out").card.findings, "run-ingested-otherwise")
    assert (left_out.subject, left_out.names) == (Subject("run", "a"), {"what": "data_model", "has": "0.9"})
    assert left_out.remedies == (Remedy("ingest", command="tcpipe ingest /logs/a.mcap"),)
    found = inspect(store.root, recipe=Recipe())
    assert found.outdated == {f"a/{make_recipe_id(Recipe(), 'husky')}": "0.9"}


def test_a_dry_run_counts_and_a_build_is_remembered(store, tmp_path):
    planned = build_dataset(tmp_path / "out", store=store.root, recipe=Recipe(), dry_run=True)
    assert (planned.status, planned.segments, planned.exit_code) == ("planned", 60, 0)
    assert "at most 60 samples" in str(planned)
    assert not (tmp_path / "out").exists()
    made = build_dataset(tmp_path / "out", store=store.root, recipe=Recipe())
    (record,) = store.scan().outputs.values()
    assert record.where == str(tmp_path / "out")
    assert [run_id for run_id, _ in record.runs] == ["a", "b", "c"]
    assert build_dataset(tmp_path / "out", store=store.root, recipe=Recipe(), dry_run=True).status == "unchanged"
    before = store.scan()
    build_dataset(tmp_path / "out", store=store.root, recipe=Recipe())
    after = store.scan()
    assert {kind for (kind, _), name in after.names.items() if name not in before.names.values()} == {"calls"}
    assert [call.counts for _, call in before.calls if call.exit_code is not None] == [
        {"runs": 3, "samples": made.card.samples}
    ]


def test_a_dataset_of_a_store_that_cannot_be_written_says_that_it_is_not_known_there(
    store, tmp_path, caplog, monkeypatch
):
    put = Place.put

    def refuse(place, name, data):
        if place.root == store.root:
            raise StoreError(f"{name}: read-only")
        put(place, name, data)

    monkeypatch.setattr(Place, "put", refuse)
    build_dataset(tmp_path / "out", store=store.root, recipe=Recipe())
    assert len(open_dataset(tmp_path / "out").card.runs) == 3
    assert "read-only; so 'tcpipe status' and 'tcpipe prune' do not know this dataset" in caplog.text


def test_a_build_with_nothing_new_asks_a_bucket_the_same_however_many_runs_there_are(store, tmp_path, served):
    store.root.rename(tmp_path / "served" / "tests" / "store")
    counts = []
    there = open_store("s3://tests/store")
    for number in range(3):
        add_run(there, f"d{number}", segments(f"d{number}", *lanes(9.0 + 3.0 * number, -10.0, 10.0)))
        build_dataset(tmp_path / "out", store=there.root, recipe=Recipe())
        served.requests = 0
        assert build_dataset(tmp_path / "out", store=there.root, recipe=Recipe()).status == "unchanged"
        counts.append(served.requests)
    assert len(set(counts)) == 1, counts
