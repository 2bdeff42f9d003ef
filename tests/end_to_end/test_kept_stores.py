"""A store and datasets of data model 1.0, kept as they were written (tests/data/make_store_1_0.py), are read as they are, and migrated."""

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest

import tcpipe
from tcpipe.errors import DatasetError, UsageError
from tcpipe.formats.maps.map_files import open_map
from tcpipe.formats.seals import write_sealed
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.explain import explain
from tcpipe.pipeline.migrate import migrate
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe
from tcpipe.tables.levels import DATA_MODEL_VERSION, SAMPLES

KEPT = Path(__file__).parents[1] / "data" / "store-1.0.tar.xz"


@pytest.fixture
def kept(tmp_path):
    with tarfile.open(KEPT) as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path


@pytest.mark.parametrize("name", ["store", "zarr", "parquet"])
def test_all_is_as_it_was_written(kept, name):
    found = verify(kept / name)
    assert found.problems == ()


def test_both_formats_give_the_same_patches_and_labels(kept):
    zarr, parquet = (tcpipe.open_dataset(kept / name) for name in ("zarr", "parquet"))
    assert {name: len(split) for name, split in zarr.items()} == {"train": 8, "test": 2, "unseen": 0, "buffer": 0}
    for name in ("train", "test"):
        assert zarr[name].channels == ("ortho", "terrain", "height")
        np.testing.assert_array_equal(zarr[name].patches, parquet[name].patches)
        np.testing.assert_array_equal(zarr[name].labels, parquet[name].labels)


def test_a_dataset_is_built_of_it(kept):
    assert tuple(open_map(kept / "store" / "maps" / "site.zarr").layers) == ("height", "ortho", "terrain")
    build_dataset(kept / "new", store=kept / "store", recipe=Recipe(), holdout="sample")
    old, new = (tcpipe.open_dataset(kept / name)["train"] for name in ("zarr", "new"))
    assert new.column("sample_id").tolist() == old.column("sample_id").tolist()
    np.testing.assert_allclose(new.patches, old.patches, atol=0.01)  # a rounded grey, a step of half a millimetre
    np.testing.assert_array_equal(new.labels, old.labels)
    sample_id = str(old.column("sample_id")[0])
    assert explain(sample_id, dataset=kept / "zarr", store=kept / "store").facts.sample["sample_id"] == sample_id


def test_columns_added_since_are_null_in_runs_and_datasets(kept):
    build_dataset(kept / "new", store=kept / "store", recipe=Recipe(), holdout="sample")
    later = [column.name for column in SAMPLES.columns if column.since]
    assert {"turn_rad", "energy_above_standing_joule"} <= set(later)
    for name in ("zarr", "parquet", "new"):
        train = tcpipe.open_dataset(kept / name)["train"]
        assert train.samples.column_names == SAMPLES.names()
        for column in later:
            assert np.isnan(train.column(column).astype(float)).all()
    assert verify(kept / "new").problems == ()
    with pytest.raises(DatasetError, match="no sample has power_above_standing_watt: its robot hardly stood"):
        tcpipe.open_dataset(kept / "zarr", label="above_standing")


def contents(directory):
    return {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("name", "document"), [("store", "manifest.json"), ("zarr", "dataset.json"), ("parquet", "dataset.json")]
)
def test_one_document_is_migrated_once_and_nothing_else_changes(kept, name, document):
    before = contents(kept / name)
    first = migrate(kept / name)
    (changed,) = first.migrated
    assert (changed.name, first.exit_code) == (document, 0)
    assert f"migrated: {changed}" in str(first)
    after = contents(kept / name)
    assert {path for path in after if after[path] != before.get(path)} == {changed}
    assert after.keys() == before.keys()
    old, new = (json.loads(files[changed]) for files in (before, after))
    assert {key for key in new if new[key] != old[key]} == {"data_model_version", "document_sha256"}
    assert (old["data_model_version"], new["data_model_version"]) == ("1.0", DATA_MODEL_VERSION)
    assert verify(kept / name).problems == ()
    again = migrate(kept / name)
    assert (again.migrated, again.exit_code) == ((), 0)
    assert "nothing to do" in str(again)
    assert contents(kept / name) == after


def test_a_map_of_1_0_is_current(kept):
    before = contents(kept / "store" / "maps")
    assert migrate(kept / "store" / "maps" / "site.zarr").migrated == ()
    assert contents(kept / "store" / "maps") == before


def test_a_migration_that_was_killed_goes_on(kept):
    """What a killed writer leaves is a temporary beside a document that is still of 1.0; the store is read either way."""
    (manifest,) = (kept / "store" / "runs").glob("*/*/manifest.json")
    other = manifest.parents[1] / "00000000"
    other.mkdir()
    for path in manifest.parent.iterdir():
        (other / path.name).write_bytes(path.read_bytes())
    found = json.loads(manifest.read_text())
    write_sealed(other / "manifest.json", {**found, "recipe_id": "00000000", "data_model_version": DATA_MODEL_VERSION})
    half = migrate(kept / "store")
    assert half.migrated == (manifest,)
    assert half.current == 2  # the other manifest, and the map


def test_what_is_damaged_or_not_known_is_left_and_named(kept):
    (manifest,) = (kept / "store" / "runs").glob("*/*/manifest.json")
    text = manifest.read_text()
    manifest.write_text(text.replace('"husky"', '"jackal"', 1))
    damaged = migrate(kept / "store")
    assert (damaged.migrated, damaged.exit_code) == ((), 3)  # its map is current
    assert "not as it was written" in damaged.problems[0]
    write_sealed(manifest, {**json.loads(text), "data_model_version": "3.0"})
    newer = contents(kept / "store")
    assert "of data model 3.0, this version knows 1.0, 1.1, 1.2, 1.3, 1.4" in migrate(kept / "store").problems[0]
    assert contents(kept / "store") == newer
    with pytest.raises(UsageError, match="is no store, map"):
        migrate(kept / "site")
