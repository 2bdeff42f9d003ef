"""A dataset of the runs that carry given tags."""

import numpy as np
import pytest
from synthetic_store import add_run, add_world, lanes, segments

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError
from tcpipe.pipeline.build import build_dataset
from tcpipe.recipe import Recipe
from tcpipe.store import Store


@pytest.fixture
def store(tmp_path):
    """Three runs: two in dry weather, one of them driven by Eva; one in wet weather."""
    store = Store(tmp_path / "store")
    store.root.mkdir()
    add_world(store, tmp_path / "rasters")
    tags = {"a": {"weather": "dry"}, "b": {"weather": "wet"}, "c": {"weather": "dry", "driver": "Eva"}}
    for number, (run_id, own) in enumerate(tags.items()):
        add_run(store, run_id, segments(run_id, *lanes(np.array([3.0 * number]), -10.0, 10.0)))
        store.tag_run(run_id, own)
    return store


def runs(store, tmp_path, **tags):
    build_dataset(tmp_path / "out", store=store.root, recipe=Recipe(), tags=tags)
    return [run["run_id"] for run in open_dataset(tmp_path / "out").card["runs"]]


def test_a_run_needs_all_of_the_tags(store, tmp_path):
    assert runs(store, tmp_path) == ["a", "b", "c"]
    assert runs(store, tmp_path, weather="dry") == ["a", "c"]
    assert runs(store, tmp_path, weather="dry", driver="Eva") == ["c"]


def test_a_tag_that_no_run_has_is_answered_with_those_there_are(store, tmp_path):
    with pytest.raises(DatasetError) as caught:
        build_dataset(tmp_path / "out", store=store.root, recipe=Recipe(), tags={"weather": "snow"})
    (line,) = caught.value.problems
    assert "no run is tagged weather=snow" in line
    assert "driver=Eva, weather=dry, weather=wet" in line
    assert not (tmp_path / "out").exists()
