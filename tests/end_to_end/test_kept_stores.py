"""A store and datasets of data model 1.0, kept as they were written (tests/data/make_store_1_0.py), are read as they are."""

import tarfile
from pathlib import Path

import numpy as np
import pytest

import tcpipe
from tcpipe.formats.maps.map_files import open_map
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.explain import explain
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe

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
    assert explain(sample_id, dataset=kept / "zarr", store=kept / "store").facts["sample"]["sample_id"] == sample_id
