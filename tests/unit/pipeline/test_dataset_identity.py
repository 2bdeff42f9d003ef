"""A dataset is built again exactly when a fresh one would be another: every key that rules it, one by one."""

import shutil

import numpy as np
import pytest
from recipe_values import keys, with_value
from stored_files import read_files
from synthetic_store import add_run, lanes, open_world, segments

from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe

OTHER = {
    "robot": "husky",
    "sample.patch_m": 2.0,
    "sample.patch_px": 20,
    "sample.min_valid_fraction": 0.5,
    "sample.max_position_std_m": 0.05,
    "sample.align": True,
    "split.holdout": "sample",
    "split.holdout_tag": "season",
    "split.test_fraction": 0.4,
    "split.block_m": 4.0,
    "split.buffer_m": 0.5,
    "split.folds": 3,
    "split.seed": 1,
    "covariates.time_column": "when",
    "covariates.time_unit": "ms",
    "covariates.max_age_s": 60.0,
    "dataset.name": "another",
    "dataset.description": "another",
    "dataset.licence": "CC0-1.0",
    "dataset.creator": "another",
    "dataset.compression": "lz4",
}


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """A store with a map and a run, and the dataset of the default recipe."""
    directory = tmp_path_factory.mktemp("identity")
    store = open_world(directory)
    add_run(store, "a", segments("a", *lanes(np.array([-3.0, 3.0]), -8.0, 8.0)))
    build_dataset(directory / "usual", store=store.root, recipe=Recipe())
    return directory, store


def test_every_key_of_a_dataset_is_tried():
    assert set(OTHER) == {
        key for key in keys() if key == "robot" or key.startswith(("sample.", "split.", "covariates.", "dataset."))
    }


def test_another_value_of_any_key_is_another_dataset(places):
    directory, store = places

    def plan(recipe):
        return build_dataset(directory / "usual", store=store.root, recipe=recipe, force=True, dry_run=True).status

    assert plan(Recipe()) == "unchanged"
    assert {key: plan(with_value(Recipe(), key, of)) for key, of in OTHER.items()} == dict.fromkeys(OTHER, "planned")


@pytest.mark.parametrize("key", ["sample.patch_px", "split.holdout", "dataset.name"])
def test_what_is_built_over_another_is_what_is_built_anew(places, tmp_path, key):
    directory, store = places
    recipe = with_value(Recipe(), key, OTHER[key])
    shutil.copytree(directory / "usual", tmp_path / "over")
    build_dataset(tmp_path / "over", store=store.root, recipe=recipe, force=True)
    build_dataset(tmp_path / "anew", store=store.root, recipe=recipe)
    assert read_files(tmp_path / "over") == read_files(tmp_path / "anew") != read_files(directory / "usual")
