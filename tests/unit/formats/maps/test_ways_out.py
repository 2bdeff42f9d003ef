"""Rasters and polygons that are refused come with a command that the installation has; those that can be read are read."""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from map_worlds import World, write_tif
from raster_commands import run_rio
from rasterio import Affine
from rasterio.control import GroundControlPoint
from rasterio.features import shapes
from rasterio.warp import transform_geom

from tcpipe.errors import MapError, RegionError
from tcpipe.formats.geojson import read_regions
from tcpipe.formats.maps.building import build_map
from tcpipe.formats.maps.map_files import open_map
from tcpipe.terrain.layers import PAPER_SCHEME

WORLD = World("EPSG:32633", 560_000.0, 5_215_000.0, side_m=20.0)
TOP_LEFT = Affine(0.2, 0.0, WORLD.x_m - 10.0, 0.0, -0.2, WORLD.y_m + 10.0)


@pytest.fixture
def site(tmp_path):
    return WORLD.write(tmp_path, 0.2)


def build(directory, **files):
    build_map(directory / "m.zarr", name="m", **{"agreed": PAPER_SCHEME, **files})
    return open_map(directory / "m.zarr")


def refuse(directory, **files) -> str:
    with pytest.raises(MapError) as caught:
        build(directory, **files)
    (problem,) = caught.value.problems
    return problem


def read_layer(source, layer):
    return source.read(layer, 0, source.grid.rows, 0, source.grid.cols)


def read_heights(source):
    return read_layer(source, "height") + np.float64(source.height_reference_m)


def find_code(source, code):
    return next((finding for finding in source.facts.findings if finding.code == code), None)


@pytest.mark.parametrize("name", ["WGS 84 / UTM zone 33N", "site grid"])
def test_a_local_crs_is_replaced_by_the_crs_option(tmp_path, site, name):
    local = f'LOCAL_CS["{name}",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
    expected = read_layer(build(tmp_path, height=site["height"], terrain=site["terrain"]), "terrain")
    with rasterio.open(site["terrain"]) as dataset:
        terrain = write_tif(tmp_path / "local.tif", dataset.read(), local, dataset.transform)
    assert "--crs EPSG:n" in refuse(tmp_path, height=site["height"], terrain=terrain)
    source = build(tmp_path, height=site["height"], terrain=terrain, crs=WORLD.crs)
    np.testing.assert_array_equal(read_layer(source, "terrain"), expected)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_whole_class_numbers_may_be_floats(tmp_path, site, dtype):
    expected = read_layer(build(tmp_path, height=site["height"], terrain=site["terrain"]), "terrain")
    with rasterio.open(site["terrain"]) as dataset:
        values = dataset.read().astype(dtype)
    values[0, 3, 4] = np.nan
    terrain = write_tif(tmp_path / "f.tif", values, WORLD.crs, TOP_LEFT)
    found = read_layer(build(tmp_path, height=site["height"], terrain=terrain), "terrain")
    assert found[3, 4] == 0
    assert (found != expected).sum() == 1
    values[0, 5, 6] = 4.5
    write_tif(terrain, values, WORLD.crs, TOP_LEFT)
    assert "has the value 4.5, expected whole numbers" in refuse(tmp_path, height=site["height"], terrain=terrain)


@pytest.mark.parametrize(
    ("tag", "second"), [(-9999.0, -32767.0), (-3.4028234663852886e38, -9999.0), (None, 1e20), (float("nan"), -9999.0)]
)
def test_two_values_for_no_data_become_one(tmp_path, site, tag, second):
    with rasterio.open(site["height"]) as dataset:
        heights = dataset.read()
    holes = np.zeros(heights.shape, bool)
    holes[0, 10:20, 10:20] = True
    values = np.where(holes, np.float32(second), heights)
    if tag is not None:
        holes[0, 40:50, 40:50] = True
        values[0, 40:50, 40:50] = tag
    write_tif(tmp_path / "two.tif", values, WORLD.crs, TOP_LEFT, nodata=tag)
    run_rio(refuse(tmp_path, height=tmp_path / "two.tif"), tmp_path, in_tif="two.tif")
    found = read_heights(build(tmp_path, height=tmp_path / "out.tif"))
    np.testing.assert_array_equal(np.isnan(found), holes[0])
    np.testing.assert_allclose(found[~holes[0]], heights[~holes], atol=1e-4)


@pytest.mark.parametrize("dtype", ["complex_int16", "complex64"])
def test_complex_numbers_are_one_line_with_a_command(tmp_path, dtype):
    values = np.full((1, 30, 30), 601.0 + 2.0j, np.complex64)
    options = {"driver": "GTiff", "height": 30, "width": 30, "count": 1, "crs": WORLD.crs, "transform": TOP_LEFT}
    with rasterio.open(tmp_path / "c.tif", "w", dtype=dtype, **options) as dataset:
        dataset.write(values)
    run_rio(refuse(tmp_path, height=tmp_path / "c.tif"), tmp_path, in_tif="c.tif")
    assert np.unique(read_heights(build(tmp_path, height=tmp_path / "out.tif"))).tolist() == [601.0]


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        ("ftUS", 1200 / 3937),
        ("US Survey Feet", 1200 / 3937),
        ("international foot", 0.3048),
        ("millimeters", 0.001),
        ("Metre", 1.0),
    ],
)
def test_units_of_heights_by_any_of_their_names(tmp_path, site, unit, metres):
    expected = read_heights(build(tmp_path, height=site["height"])) * metres
    with rasterio.open(site["height"], "r+") as dataset:
        dataset.units = (unit,)
    np.testing.assert_allclose(read_heights(build(tmp_path, height=site["height"])), expected, rtol=1e-6)


def test_an_unknown_unit_is_named_by_a_command(tmp_path, site):
    with rasterio.open(site["height"], "r+") as dataset:
        dataset.units = ("above sea",)
    problem = refuse(tmp_path, height=site["height"])
    run_rio(problem.replace(" m (or", " dm (or"), tmp_path)
    assert read_heights(build(tmp_path, height=site["height"])).mean() == pytest.approx(61.2, abs=1.0)


@pytest.mark.parametrize("connectivity", [4, 8])
def test_polygons_of_a_raster_are_repaired_and_counted(tmp_path, site, connectivity):
    """Cells that touch at corners make rings that touch themselves."""
    ids = np.random.default_rng(3).choice(np.array([4, 5, 7], np.uint8), (20, 20))
    cell = Affine(1.0, 0.0, WORLD.x_m - 10.0, 0.0, -1.0, WORLD.y_m + 10.0)
    features = [
        {
            "type": "Feature",
            "properties": {"class": PAPER_SCHEME.table.name(int(value))},
            "geometry": transform_geom(WORLD.crs, "EPSG:4326", shape),
        }
        for shape, value in shapes(ids, connectivity=connectivity, transform=cell)
    ]
    (tmp_path / "t.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    source = build(tmp_path, height=site["height"], terrain=tmp_path / "t.geojson")
    inside = (np.arange(100) % 5 > 0) & (np.arange(100) % 5 < 4)  # a ring's corners round off in degrees
    found = read_layer(source, "terrain")[np.ix_(inside, inside)]
    np.testing.assert_array_equal(found, ids.repeat(5, 0).repeat(5, 1)[np.ix_(inside, inside)])
    changed = find_code(source, "polygons-changed")
    assert (changed is not None) == (connectivity == 8)
    assert changed is None or (changed.numbers["repaired_count"] > 0 and changed.severity == "note")


def test_rows_without_geometry_or_class_are_skipped_and_counted(tmp_path, site):
    x, y = WORLD.x_m, WORLD.y_m
    square = {
        "type": "Polygon",
        "coordinates": [[[x - 9, y - 9], [x + 9, y - 9], [x + 9, y + 9], [x - 9, y + 9], [x - 9, y - 9]]],
    }
    square = transform_geom(WORLD.crs, "EPSG:4326", square)
    rows = [
        ("grass", square),
        ("mud", None),
        ("mud", {"type": "Polygon", "coordinates": []}),
        (None, square),
        ("", square),
    ]
    features = [{"type": "Feature", "properties": {"class": name}, "geometry": shape} for name, shape in rows]
    terrain = tmp_path / "t.geojson"
    terrain.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    source = build(tmp_path, height=site["height"], terrain=terrain)
    assert source.facts.class_share == {"grass": 1.0}
    assert find_code(source, "polygons-changed").numbers == {"repaired_count": 0.0, "skipped_count": 4.0}
    terrain.write_text(json.dumps({"type": "FeatureCollection", "features": features[1:3]}))
    assert "no polygon in it" in refuse(tmp_path, height=site["height"], terrain=terrain)


@pytest.mark.parametrize("corners", [[(0, 0), (79, 0), (79, 78), (0, 78)], [(10, 40), (24, 40), (24, 50), (10, 50)]])
def test_a_region_wider_than_a_site_is_refused_and_the_maps_outline_is_one(tmp_path, site, corners):
    geometry = {"type": "Polygon", "coordinates": [[*corners, corners[0]]]}
    region = tmp_path / "region.geojson"
    region.write_text(json.dumps({"type": "Feature", "properties": {}, "geometry": geometry}))
    with pytest.raises(RegionError, match=r"regions are \d+ x \d+ km, expected at most 1000.*\(rio bounds height.tif"):
        read_regions(region)
    rio = Path(sys.executable).with_name("rio")
    said = subprocess.run([rio, *shlex.split("bounds height.tif")], cwd=tmp_path, check=True, capture_output=True)
    region.write_bytes(said.stdout)
    assert read_regions(region).train_test.area > 0.0


def test_a_raster_of_control_points_is_rectified(tmp_path):
    corners = [(0, 0), (0, 50), (50, 0), (50, 50)]
    points = [GroundControlPoint(row, col, WORLD.x_m + 0.2 * col, WORLD.y_m - 0.2 * row) for row, col in corners]
    options = {"driver": "GTiff", "height": 50, "width": 50, "count": 1, "dtype": "float32"}
    with rasterio.open(tmp_path / "gcps.tif", "w", gcps=points, crs=WORLD.crs, **options) as dataset:
        dataset.write(np.full((1, 50, 50), 300.0, np.float32))
    run_rio(refuse(tmp_path, height=tmp_path / "gcps.tif"), tmp_path, in_tif="gcps.tif", **{"EPSG:n": WORLD.crs})
    source = build(tmp_path, height=tmp_path / "out.tif")
    assert source.grid.bounds_m == pytest.approx((WORLD.x_m, WORLD.y_m - 10.0, WORLD.x_m + 10.0, WORLD.y_m), abs=0.2)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_raster_without_a_place_gets_one(tmp_path):
    write_tif(tmp_path / "FILE", np.full((1, 50, 50), 300.0, np.float32), None, Affine.identity())
    problem = refuse(tmp_path, height=tmp_path / "FILE").replace("EPSG:n", WORLD.crs)
    for word, value in (("x_min", WORLD.x_m), ("y_max", WORLD.y_m), ("pixel", 0.2)):
        problem = problem.replace(word, str(value))
    run_rio(problem, tmp_path)
    assert build(tmp_path, height=tmp_path / "FILE").grid.x_min_m == WORLD.x_m


@pytest.mark.parametrize("what", ["CRS", "type", "pixels"])
def test_tiles_that_differ_are_made_alike(tmp_path, what):
    affines = [TOP_LEFT, Affine(0.2, 0.0, WORLD.x_m, 0.0, -0.2, WORLD.y_m + 10.0), TOP_LEFT]
    affines[2] = Affine(0.2, 0.0, WORLD.x_m - 10.0, 0.0, -0.2, WORLD.y_m)
    options = [{"crs": WORLD.crs, "dtype": "float32"}] * 3
    if what == "CRS":
        options[2] = {"crs": "EPSG:25833", "dtype": "float32"}
    elif what == "type":
        options[2] = {"crs": WORLD.crs, "dtype": "int16"}
    else:
        affines[2] = Affine(0.2, 0.0, WORLD.x_m - 9.93, 0.0, -0.2, WORLD.y_m)
    folder = tmp_path / "tiles"
    folder.mkdir()
    for name, affine, option in zip("abc", affines, options, strict=True):
        write_tif(folder / f"{name}.tif", np.full((1, 50, 50), 300, option["dtype"]), option["crs"], affine)
    tiles = sorted(folder.glob("*.tif"))
    problem = refuse(tmp_path, height=tiles)
    run_rio(problem, folder, in_tif="c.tif", **{"EPSG:n": WORLD.crs, "T": "float32"})
    made = folder / ("joined.tif" if what == "pixels" else "out.tif")
    found = read_heights(build(tmp_path, height=[made] if what == "pixels" else [*tiles[:2], made]))
    assert np.unique(found[np.isfinite(found)]).tolist() == [300.0]
    assert 0.2 < np.isnan(found).mean() < 0.3
