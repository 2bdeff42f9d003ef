"""Class tables as CSV and TOML."""

import numpy as np
import pytest
import rasterio
from rasterio import Affine

from tcpipe.errors import MapError
from tcpipe.formats.maps.building import build_map, read_class_scheme

CSV_HEAD = "value,id,name,traversable\n"
CSV = CSV_HEAD + "11,1,water,no\n40,2,grass,yes\n41,2,grass,true\n"
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
    text = CSV_HEAD + "x,1,a,yes\n2,0,b,yes\n3,3,c,maybe\n4,4,,yes\n5,5,e,yes\n5,6,f,yes\n7,5,g,yes\n"
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
        ("c.csv", CSV_HEAD, "no classes"),
        ("c.csv", "", "missing"),
        ("c.toml", "[[class", "cannot be read"),
        ("c.toml", "a = 1", "no classes"),
        ("c.toml", "a" + ".a" * 900_000, "dots, at most 1000"),
        ("c.toml", "a = " + "[" * 100_000, "the class table cannot be read.*nested too deep"),
        ("c.csv", CSV_HEAD + "1,1,x,yes\n" * 300_000, "a class table of 3.0 MB, at most 2"),
        ("c.csv", CSV_HEAD + "1,x,x,x\n" * 50_000, r"… and 99980 more"),
        ("c.csv", CSV_HEAD + "9223372036854775808,1,x,yes\n", "value '9223372036854775808' is not an integer"),
        ("c.csv", None, r"c\.csv: the class table cannot be read"),
        (
            "c.toml",
            "[[class]]\nvalue = 1\nid = 1\nname = 'a'\ntraversable = true\ncolour = 3",
            "'colour' is not a column",
        ),
    ],
    ids=lambda of: str(of)[:20],
)
def test_what_is_no_class_table_is_refused_in_a_few_lines(tmp_path, name, text, wanted):
    with pytest.raises(MapError, match=wanted) as caught:
        read_class_scheme(write(tmp_path, text, name) if text is not None else tmp_path / name)
    assert len(caught.value.problems) <= 21


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


def test_a_map_that_is_mostly_empty_is_made_of_what_it_has(tmp_path):
    path = sparse(tmp_path / "h.tif", 5000, 5000, 0.05)
    with rasterio.open(path, "r+") as dataset:
        dataset.nodata = -9.0
        dataset.write(np.full((10, 10), 300.0, np.float32), 1, window=((4500, 4510), (4500, 4510)))
        for corner in (0, 4096):  # what GDAL has not written is zero without a nodata tag
            dataset.write(np.full((1, 1), -9.0, np.float32), 1, window=((corner, corner + 1), (corner, corner + 1)))
    summary = build_map(tmp_path / "m.zarr", name="m", height=path)
    assert summary.covered["height"] == 100 / 5000**2
    assert len(list((tmp_path / "m.zarr/height/c").rglob("*/*"))) == 1
