"""Class numbers that nothing names: said by add-map and in the verdict."""

import numpy as np
import pytest
import rasterio
from made_tracks import with_columns
from map_worlds import write_tif
from synthetic_store import WORLD, add_run, lanes, open_store, segments, track_at, winding

from tcpipe.errors import DatasetError, MapError
from tcpipe.formats.maps.building import build_map
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.maps import add_map
from tcpipe.recipe import Recipe
from tcpipe.tables.findings import select_findings


def write_rasters(directory, values=None):
    """Write the world's rasters, with the paper's ids replaced by the values of a legend, if any."""
    paths = WORLD.write(directory, pixel_size_m=0.1)
    if values:
        with rasterio.open(paths["terrain"], "r+") as dataset:
            ids = dataset.read(1)
            dataset.write(np.select([ids == key for key in values], list(values.values()), 0).astype(np.uint8), 1)
    return paths


def add_drive(store):
    xy = winding()
    east, north = np.gradient(xy, 0.05, axis=0).T
    track = with_columns(
        track_at(xy, xy),
        stamp_ns=np.arange(len(xy)) * 50_000_000,
        x_m=xy[:, 0],
        y_m=xy[:, 1],
        east_velocity_mps=east,
        north_velocity_mps=north,
    )
    add_run(store, "a", segments("a", *lanes([0.0, 3.0], -14.0, 14.0)), track=track)


@pytest.fixture
def store(tmp_path):
    return open_store(tmp_path / "store", create=True)


def test_numbers_without_a_table_are_named_until_a_table_is_given(tmp_path, store):
    """On this site 7 is lawn, 4 is gravel and 6 is a pond's edge."""
    paths = write_rasters(tmp_path, {4: 7, 5: 6, 6: 4, 7: 7})
    added = add_map("site", store=store.root, **paths)
    assert len(select_findings(added.map.findings, "classes-assumed")) == 1
    assert "4 as grass, 6 as unpaved road, 7 as paved road: assumed, no class table is given" in str(added)
    add_drive(store)
    built = build_dataset(tmp_path / "out", store=store.root, recipe=Recipe())
    assert built.card.verdict.position == "usable with care"
    assert "classes-assumed" in {reason.code for reason in built.card.verdict.reasons}
    table = tmp_path / "classes.csv"
    table.write_text("value,id,name,traversable\n4,1,gravel,yes\n6,2,edge,yes\n7,3,lawn,yes\n")
    named = add_map("site", store=store.root, **paths, classes=table, force=True)
    assert not select_findings(named.map.findings, "classes-assumed")
    built = build_dataset(tmp_path / "out", store=store.root, recipe=Recipe(), force=True)
    assert built.card.verdict.position == "usable"
    assert set(built.card.terrain["train"]) <= {"gravel", "edge", "lawn"}


def test_ground_that_was_driven_but_is_not_traversable_is_said_with_its_value(tmp_path, store):
    """The site's grass, driven for the most part, has the value 2, which the paper calls a tree."""
    add_map("site", store=store.root, **write_rasters(tmp_path, {4: 2, 5: 5, 6: 6, 7: 7}))
    add_drive(store)
    built = build_dataset(tmp_path / "out", store=store.root, recipe=Recipe())
    (driven,) = select_findings(built.findings, "driven-not-traversable")
    assert (driven.subject.name, driven.names["values"]) == ("tree", "2")
    assert driven.numbers["driven_fraction"] > 0.3


def test_an_error_that_nothing_is_left_names_the_value(tmp_path, store):
    add_map("site", store=store.root, **write_rasters(tmp_path, {4: 3, 5: 3, 6: 3, 7: 3}))
    add_drive(store)
    with pytest.raises(DatasetError, match=r"vegetation: .* driven on it; not traversable; read from value 3"):
        build_dataset(tmp_path / "out", store=store.root, recipe=Recipe())


def test_values_that_are_no_class_are_named(tmp_path):
    paths = write_rasters(tmp_path, {4: 41, 5: 52, 6: 63, 7: 74})
    with pytest.raises(MapError, match=r"none of its values 41, 52, 63, 74 is in the class table"):
        build_map(tmp_path / "m.zarr", name="m", height=paths["height"], terrain=paths["terrain"])


@pytest.mark.parametrize(("given", "is_assumed"), [("grass", False), ("4", True)])
def test_drawn_terrain_is_assumed_only_by_number(tmp_path, given, is_assumed):
    height = write_tif(
        tmp_path / "h.tif", np.ones((1, 50, 50), np.float32), "EPSG:32633", rasterio.Affine(1, 0, 5e5, 0, -1, 5.2e6)
    )
    ring = "[[14.9,46.9],[15.1,46.9],[15.1,47.1],[14.9,47.1],[14.9,46.9]]"
    (tmp_path / "t.geojson").write_text(
        '{"type":"Feature","properties":{"class":"'
        + given
        + '"},"geometry":{"type":"Polygon","coordinates":['
        + ring
        + "]}}"
    )
    facts = build_map(tmp_path / "m.zarr", name="m", height=height, terrain=tmp_path / "t.geojson")
    assert bool(select_findings(facts.findings, "classes-assumed")) == is_assumed
