"""A small dataset of the analytic map, built once."""

import pytest
from synthetic_store import box, region_file, small_store

from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    here = tmp_path_factory.mktemp("learning")
    region = region_file(here / "region.geojson", box(-18, -18, 6, 18))
    build_dataset(here / "dataset", store=small_store(here).root, split=region, recipe=Recipe())
    return here / "dataset"
