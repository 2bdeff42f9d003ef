"""Class tables as CSV and TOML."""

import json

import numpy as np
import pytest
import rasterio
from map_worlds import write_tif
from rasterio import Affine

from tcpipe.errors import MapError, RegionError
from tcpipe.formats.geojson import MAX_VALUES, read_regions
from tcpipe.formats.maps.building import build_map, read_class_scheme
from tcpipe.terrain.classes import PAPER_CLASSES, PAPER_SCHEME

CSV = "value,id,name,traversable\n11,1,water,no\n40,2,grass,yes\n41,2,grass,true\n"
TOML = """
[[class]]
value = 11
id = 1
name = "water"
traversable = false

[[class]]
value = [40, 41]
id = 2
name = "grass"
traversable = true
"""


def write(tmp_path, text, name="c.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_csv_and_toml_say_the_same(tmp_path):
    csv = read_class_scheme(write(tmp_path, CSV))
    assert read_class_scheme(write(tmp_path, TOML, "c.toml")) == csv
    assert read_class_scheme(write(tmp_path, "\ufeff" + CSV.replace(",", ", "), "bom.csv")) == csv
    assert csv.id_by_value == {11: 1, 40: 2, 41: 2}
    assert [(c.id, c.name, c.traversable) for c in csv.table.classes] == [(1, "water", False), (2, "grass", True)]


def test_every_wrong_line_is_named(tmp_path):
    text = "value,id,name,traversable\nx,1,a,yes\n2,0,b,yes\n3,3,c,maybe\n4,4,,yes\n5,5,e,yes\n5,6,f,yes\n7,5,g,yes\n"
    with pytest.raises(MapError) as caught:
        read_class_scheme(write(tmp_path, text))
    lines = caught.value.problems
    assert [line.split("line ")[1].split(":")[0] for line in lines] == ["2", "3", "4", "5", "7", "8"]
    assert "value 'x' is not an integer" in lines[0]
    assert "from 1 to 255" in lines[1]
    assert "neither true nor false" in lines[2]
    assert "name is missing" in lines[3]
    assert "value 5 already has id 5" in lines[4]
    assert "id 5 was" in lines[5]


@pytest.mark.parametrize(
    ("name", "text", "wanted"),
    [
        ("c.csv", "value;id;name;traversable\n1;1;a;yes\n", "columns value,id,name,traversable are missing"),
        ("c.csv", "value,id,name,traversable\n", "no classes"),
        ("c.csv", "", "missing"),
        ("c.toml", "[[class", "cannot be read"),
        ("c.toml", "a = 1", "no classes"),
        (
            "c.toml",
            "[[class]]\nvalue = 1\nid = 1\nname = 'a'\ntraversable = true\ncolour = 3",
            "'colour' is not a column",
        ),
    ],
)
def test_what_is_no_class_table(tmp_path, name, text, wanted):
    with pytest.raises(MapError, match=wanted):
        read_class_scheme(write(tmp_path, text, name))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MapError, match=r"c\.csv: the class table cannot be read"):
        read_class_scheme(tmp_path / "c.csv")


def test_the_papers_classes():
    assert PAPER_CLASSES.count == 7
    assert PAPER_CLASSES.traversable().nonzero()[0].tolist() == [4, 5, 6, 7]
    assert PAPER_CLASSES.names()[[0, 4, 5, 6, 7, 8]].tolist() == ["", "grass", "mud", "unpaved road", "paved road", ""]
    values = np.array([[-3, 0, 1, 7], [8, 255, 4, 4]], np.int16)
    valid = np.array([[True, True, True, True], [True, True, True, False]])
    assert PAPER_SCHEME.ids(values, valid).tolist() == [[0, 0, 1, 7], [0, 0, 4, 0]]


def test_toml_that_would_take_for_ever_is_refused(tmp_path):
    for name, text, told in (
        ("dots", "a" + ".a" * 900_000, "dots, at most 1000"),
        ("deep", "a = " + "[" * 100_000, "nested too deep"),
    ):
        path = tmp_path / f"{name}.toml"
        path.write_text(text)
        with pytest.raises(MapError, match=told):
            read_class_scheme(path)


SMALL = Affine(1.0, 0.0, 560_000.0, 0.0, -1.0, 5_215_000.0)
SQUARE = [[15.79, 47.08], [15.8, 47.08], [15.8, 47.09], [15.79, 47.09], [15.79, 47.08]]


def sparse(path, rows, cols, pixel_size_m):
    """A raster of any size in a few kilobytes."""
    profile = {"driver": "GTiff", "height": rows, "width": cols, "count": 1, "dtype": "float32", "crs": "EPSG:32633"}
    affine = Affine(pixel_size_m, 0.0, 5e5, 0.0, -pixel_size_m, 5e6)
    tiling = {"tiled": True, "blockxsize": 4096, "blockysize": 4096, "sparse_ok": True, "BIGTIFF": "YES"}
    with rasterio.open(path, "w", **profile, **tiling, transform=affine):
        return path


@pytest.mark.parametrize(
    ("rows", "cols", "pixel_size_m"), [(100_000, 100_000, 0.05), (16, 300_000, 0.05), (99_999, 99_999, 1e-9)]
)
def test_a_map_of_too_many_pixels_is_refused_before_one_is_read(tmp_path, rows, cols, pixel_size_m):
    path = sparse(tmp_path / "h.tif", rows, cols, pixel_size_m)
    with pytest.raises(
        MapError, match=r"h.tif: the map would have .* pixels of .*at most 4.3e\+09 in all and 262144 a side"
    ) as caught:
        build_map(tmp_path / "m.zarr", name="m", height=path)
    assert len(caught.value.problems) == 1


def test_a_layer_so_fine_that_the_map_would_be_huge_is_refused(tmp_path):
    height = write_tif(tmp_path / "h.tif", np.ones((1, 100, 100), np.float32), "EPSG:32633", SMALL)
    fine = Affine(1e-7, 0.0, 560_000.0, 0.0, -1e-7, 5_215_000.0)
    ortho = write_tif(tmp_path / "o.tif", np.ones((1, 9, 9), np.uint8), "EPSG:32633", fine)
    with pytest.raises(MapError, match="the map would have"):
        build_map(tmp_path / "m.zarr", name="m", height=height, ortho=ortho)


def test_a_map_that_is_mostly_empty_is_made_of_what_it_has(tmp_path):
    path = sparse(tmp_path / "h.tif", 9000, 9000, 0.05)
    with rasterio.open(path, "r+") as dataset:
        dataset.nodata = -9.0
        dataset.write(np.full((10, 10), 300.0, np.float32), 1, window=((8500, 8510), (8500, 8510)))
        for corner in (0, 4096):  # what GDAL has not written is zero without a nodata tag
            dataset.write(np.full((1, 1), -9.0, np.float32), 1, window=((corner, corner + 1), (corner, corner + 1)))
    summary = build_map(tmp_path / "m.zarr", name="m", height=path)
    assert summary.covered["height"] == 100 / 9000**2
    assert len(list((tmp_path / "m.zarr/height/c").rglob("*/*"))) == 1


def polygon(ring):
    return json.dumps({"type": "Polygon", "coordinates": [ring]})


WRONG = {
    "many": ("[" * (MAX_VALUES + 1), "1500001 positions, rings and objects, at most 1500000; simplify it"),
    "nested": ('{"type":' + "[" * 200_000, "not JSON"),
    "deep": ('{"a":' * 100_000 + "1" + "}" * 100_000, "not JSON|expected an object with a 'type'"),
    "hollow": ('{"type": "GeometryCollection", "coordinates": [1]}', "key 'geometries' not found"),
    "slices": (polygon([{"a": 1}, {"a": 1}]), "type must be array"),
    "infinite": (polygon([*SQUARE[:4], [float("inf"), 1.0], SQUARE[0]]), "Infinity is not a number"),
    "nan": (polygon([*SQUARE[:4], [float("nan"), 1.0], SQUARE[0]]), "NaN is not a number"),
    "huge": (polygon([[1e308, 1e308], *SQUARE[1:4], [1e308, 1e308]]), "no lon/lat degrees"),
    "long": ('{"type": "' + "x" * 10**6 + '"}', "xxx…, expected"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_region_beyond_the_bounds_is_refused_in_one_short_line(tmp_path, name):
    text, wanted = WRONG[name]
    path = tmp_path / "r.geojson"
    path.write_text(text)
    with pytest.raises(RegionError, match=wanted) as caught:
        read_regions(path)
    (line,) = caught.value.problems
    assert len(line) < 1000


def test_a_region_file_too_large_is_not_read(tmp_path):
    path = tmp_path / "r.geojson"
    with path.open("wb") as stream:
        stream.truncate(10**12)
    with pytest.raises(RegionError, match="1000000 MB of GeoJSON, at most 50"):
        read_regions(path)


def test_thousands_of_polygons_on_one_place_are_told_without_holding_each_against_each(tmp_path):
    height = write_tif(tmp_path / "h.tif", np.ones((1, 100, 100), np.float32), "EPSG:32633", SMALL)
    corners = rasterio.warp.transform_geom("EPSG:32633", "EPSG:4326", {"type": "Polygon", "coordinates": [[
        [560_000.0, 5_214_900.0], [560_100.0, 5_214_900.0], [560_100.0, 5_215_000.0], [560_000.0, 5_215_000.0], [560_000.0, 5_214_900.0]
    ]]})  # fmt: skip
    features = [{"type": "Feature", "properties": {"class": 4 + n % 2}, "geometry": corners} for n in range(3000)]
    (tmp_path / "t.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    summary = build_map(tmp_path / "m.zarr", name="m", height=height, terrain=tmp_path / "t.geojson")
    (overlap,) = [of for of in summary.findings if of.code == "polygons-overlap"]
    assert overlap.numbers["overlap_m2"] > 1e6


TABLES = {
    "large.csv": ("value,id,name,traversable\n" + "1,1,x,yes\n" * 300_000, "a class table of 3.0 MB, at most 2"),
    "wrong.csv": ("value,id,name,traversable\n" + "1,x,x,x\n" * 50_000, r"… and 99980 more"),
    "number.csv": (
        "value,id,name,traversable\n9223372036854775808,1,x,yes\n",
        "value '9223372036854775808' is not an integer",
    ),
    "deep.toml": ("a = " + "[" * 100_000, "the class table cannot be read"),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_class_table_beyond_the_bounds_is_refused_in_a_few_lines(tmp_path, name):
    text, wanted = TABLES[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(MapError, match=wanted) as caught:
        read_class_scheme(tmp_path / name)
    assert len(caught.value.problems) <= 21
