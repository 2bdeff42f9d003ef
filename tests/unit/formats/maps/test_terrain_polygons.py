"""Terrain drawn as polygons, against point-in-polygon in lon/lat; and drawings that cannot be used, refused in one line."""

import json
import re

import numpy as np
import pyproj
import pytest
import shapely
from map_worlds import World, write_tif
from rasterio import Affine

from tcpipe.errors import MapError
from tcpipe.formats.maps.building import build_map
from tcpipe.formats.maps.map_files import open_map

WORLD = World("EPSG:32633", 560_000.0, 5_215_000.0, side_m=40.0)
TO_LONLAT = pyproj.Transformer.from_crs(WORLD.crs, "EPSG:4326", always_xy=True)


def ring(*points_m):
    """A closed ring of lon, lat from metres around the world's middle."""
    x, y = np.array([*points_m, points_m[0]], float).T
    return [list(map(float, point)) for point in zip(*TO_LONLAT.transform(WORLD.x_m + x, WORLD.y_m + y), strict=True)]


FIELD = [ring((-30, -30), (30, -30), (30, 30), (-30, 30)), ring((5, 5), (5, 12), (12, 12), (12, 5))]
ROAD = [ring((-25.013, -4.007), (25.031, 6.019), (25, 9.043), (-25, -1.017))]  # no pixel centre lies on an edge
PUDDLE = [ring((2.013, 3.007), (4.021, 1.019), (6.033, 4.041))]


def feature(coordinates, kind="Polygon", **properties):
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def collection(tmp_path, *features, name="t.geojson", **more):
    document = {"type": "FeatureCollection", "features": list(features), **more}
    (tmp_path / name).write_text(json.dumps(document))
    return tmp_path / name


@pytest.fixture(scope="module")
def height(tmp_path_factory):
    affine = Affine(0.1, 0.0, WORLD.x_m - 20.0, 0.0, -0.1, WORLD.y_m + 20.0)
    return write_tif(tmp_path_factory.mktemp("h") / "h.tif", np.ones((1, 400, 400), np.float32), WORLD.crs, affine)


def build(tmp_path, height, terrain, **options):
    summary = build_map(tmp_path / "m.zarr", name="m", height=height, terrain=terrain, **options)
    return summary, open_map(tmp_path / "m.zarr").read("terrain", 0, 400, 0, 400)


def refused(tmp_path, height, terrain):
    with pytest.raises(MapError) as caught:
        build(tmp_path, height, terrain)
    assert not (tmp_path / "m.zarr").exists()
    assert all("\n" not in problem for problem in caught.value.problems)
    return caught.value.problems


def drawn(*polygons_and_ids):
    """Class ids at the map's pixel centres, by shapely in lon/lat; the last polygon wins."""
    offset = (np.arange(400) + 0.5) * 0.1 - 20.0
    x, y = np.meshgrid(WORLD.x_m + offset, WORLD.y_m - offset)
    points = shapely.points(*TO_LONLAT.transform(x, y))
    ids = np.zeros((400, 400), np.uint8)
    for coordinates, class_id in polygons_and_ids:
        ids[shapely.contains(shapely.Polygon(coordinates[0], coordinates[1:]), points)] = class_id
    return ids


def test_pixels_take_the_class_their_centre_lies_in_and_later_ones_lie_on_top(tmp_path, height):
    path = collection(
        tmp_path,
        feature(FIELD, **{"class": "grass", "fid": 1}),
        feature([ROAD], "MultiPolygon", **{"class": "Paved_Road"}),
        feature(PUDDLE, Class="5"),
    )
    summary, found = build(tmp_path, height, path)
    wanted = drawn((FIELD, 4), (ROAD, 7), (PUDDLE, 5))
    assert sorted(np.unique(wanted)) == [0, 4, 5, 7]
    np.testing.assert_array_equal(found, wanted)
    assert summary.covered["terrain"] == pytest.approx((wanted > 0).mean(), abs=1e-4)
    (overlap,) = [of for of in summary.findings if of.code == "polygons-overlap"]
    assert overlap.names == {"above": "paved road", "below": "grass"}
    assert 1.0 < overlap.numbers["overlap_m2"] < 2000.0


def test_numbers_are_values_of_the_table_first_and_ids_else(tmp_path, height):
    (tmp_path / "c.csv").write_text("value,id,name,traversable\n40,2,meadow,yes\n2,1,water,no\n")
    path = collection(
        tmp_path, feature(FIELD, **{"class": 40}), feature(PUDDLE, **{"class": 2}), feature(ROAD, **{"class": 1.0})
    )
    _, found = build(tmp_path, height, path, classes=tmp_path / "c.csv")
    wanted = drawn((FIELD, 2), (PUDDLE, 1), (ROAD, 1))
    np.testing.assert_array_equal(found, wanted)


def test_every_feature_without_a_class_of_the_table_is_named(tmp_path, height):
    path = collection(
        tmp_path,
        feature(FIELD, **{"class": "lava"}),
        feature(ROAD, terrain="grass", fid=3),
        feature(PUDDLE, **{"class": True}),
        feature(ROAD, **{"class": "mud"}),
    )
    first, third = refused(tmp_path, height, path)
    assert "feature 0: class 'lava' is not in the class table (obstacle, tree, vegetation, grass, " in first
    assert "feature 2: class True is not in the class table" in third
    path = collection(tmp_path, feature(ROAD, terrain="grass", fid=3))
    (only,) = refused(tmp_path, height, path)
    assert "feature 0: has no property 'class' that names its terrain (its properties: fid, terrain)" in only


def test_drawings_that_cannot_be_placed_are_refused_in_one_line(tmp_path, height):
    """One case that the reader of polygons refuses; the others: test_geojson.py."""
    far = [[[10.0, 50.0], [10.1, 50.0], [10.1, 50.1], [10.0, 50.0]]]
    north = [[[10.0, 95.0], [10.1, 95.0], [10.1, 95.1], [10.0, 95.0]]]
    for drawing, wanted in ((far, r"they are around 10.05.*the map covers 15.7"), (north, "axes look swapped")):
        path = collection(tmp_path, feature(drawing, **{"class": "mud"}))
        (problem,) = refused(tmp_path, height, path)
        assert str(path) in problem
        assert re.search(wanted, problem)


def test_polygons_beyond_the_map_do_not_matter(tmp_path, height):
    far = [[[-179.0, -80.0], [-178.0, -80.0], [-178.0, -79.0], [-179.0, -80.0]]]
    path = collection(tmp_path, feature(far, **{"class": "tree"}), feature(ROAD, **{"class": "mud"}))
    _, found = build(tmp_path, height, path)
    np.testing.assert_array_equal(found, drawn((ROAD, 5)))


def test_other_vector_files_are_told_what_to_do(tmp_path, height):
    (tmp_path / "t.gpkg").write_bytes(b"SQLite format 3")
    assert "terrain may also be polygons, exported as .geojson" in refused(tmp_path, height, tmp_path / "t.gpkg")[0]
