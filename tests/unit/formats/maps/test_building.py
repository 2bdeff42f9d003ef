"""Rasters of every convention on one grid, against closed forms; and rasters that cannot be placed, refused in one line."""

from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
import rasterio.shutil
from map_worlds import World, write_tif
from rasterio import Affine
from rasterio.control import GroundControlPoint

from tcpipe.errors import MapError
from tcpipe.formats.maps.building import MoreLayers, build_map
from tcpipe.formats.maps.map_files import open_map

WORLD = World("EPSG:32633", 560_000.0, 5_215_000.0, side_m=40.0)
LEFT, TOP = WORLD.x_m - 20.0, WORLD.y_m + 20.0
NORTH_UP = Affine(0.1, 0.0, LEFT, 0.0, -0.1, TOP)


def plane(x, y):
    return 500.0 + 0.2 * (x - WORLD.x_m) + 0.1 * (y - WORLD.y_m)


@pytest.fixture(scope="module")
def height(tmp_path_factory):
    """A raster of the plane."""
    return write_tif(tmp_path_factory.mktemp("h") / "h.tif", raster_of(plane, NORTH_UP), WORLD.crs, NORTH_UP)


def raster_of(function, affine, rows=400, cols=400, dtype=np.float32):
    """Values at pixel centres of an affine of corners, with a band axis."""
    j, i = np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5)
    x, y = affine.a * j + affine.b * i + affine.c, affine.d * j + affine.e * i + affine.f
    return np.asarray(function(x, y)).astype(dtype)[None]


def built(tmp_path, **options):
    summary = build_map(tmp_path / "m.zarr", name="m", **options)
    return summary, open_map(tmp_path / "m.zarr")


def heights(source):
    grid = source.grid
    return source.height_reference_m + source.read("height", 0, grid.rows, 0, grid.cols).astype(float)


def centres(grid):
    j, i = np.meshgrid(np.arange(grid.cols, dtype=float), np.arange(grid.rows, dtype=float))
    return np.moveaxis(grid.xy_from_px(np.stack([j, i], -1)), -1, 0)


def check_plane(source, tolerance_m=1e-4):
    found = heights(source)
    present = np.isfinite(found)
    assert present.mean() > 0.5
    assert np.abs(found - plane(*centres(source.grid)))[present].max() < tolerance_m
    return present


def test_a_map_like_its_raster_keeps_every_number(tmp_path):
    values = raster_of(plane, NORTH_UP)
    values[0, 7, 9] = np.nan
    write_tif(tmp_path / "h.tif", values, WORLD.crs, NORTH_UP)
    summary, source = built(tmp_path, height=tmp_path / "h.tif")
    assert source.grid.crs == "EPSG:32633"
    assert (source.grid.rows, source.grid.cols, source.grid.pixel_size_m) == (400, 400, 0.1)
    assert source.grid.bounds_m == pytest.approx((LEFT, TOP - 40.0, LEFT + 40.0, TOP))
    np.testing.assert_allclose(heights(source), values[0].astype(float), atol=1e-5)
    assert summary.covered == {"height": 1.0 - 1.0 / 160_000.0}
    assert (summary.height_min_m, summary.height_max_m) == (np.nanmin(values), np.nanmax(values))


CONVENTIONS = {
    "south up": (Affine(0.1, 0.0, LEFT, 0.0, 0.1, TOP - 40.0), {}),
    "rotated": (Affine(0.08, 0.06, LEFT, 0.06, -0.08, TOP), {}),
    "flat pixels": (Affine(0.1, 0.0, LEFT, 0.0, -0.2, TOP), {"rows": 200}),
    "mirrored": (Affine(-0.1, 0.0, LEFT + 40.0, 0.0, -0.1, TOP), {}),
    "pixel is point": (NORTH_UP, {}),
}


@pytest.mark.parametrize("name", CONVENTIONS)
def test_pixel_conventions_show_the_same_ground(tmp_path, name):
    affine, size = CONVENTIONS[name]
    point = name == "pixel is point"  # half a pixel off pixel is area
    write_tif(tmp_path / "h.tif", raster_of(plane, affine, **size), WORLD.crs, affine, point=point)
    _, source = built(tmp_path, height=tmp_path / "h.tif")
    check_plane(source)


@pytest.mark.parametrize("crs", ["EPSG:32634", "EPSG:31256", "EPSG:4326", "EPSG:3857", "EPSG:2263"])
def test_a_raster_in_another_crs_lands_on_the_same_ground(tmp_path, crs):
    """The grid is asked for in UTM 33N; the raster is in another zone, a national grid, degrees, Web Mercator, or feet."""
    to_crs = pyproj.Transformer.from_crs(WORLD.crs, crs, always_xy=True)
    x, y = to_crs.transform(
        WORLD.x_m + np.array([-20.0, 20.0, 20.0, -20.0]), WORLD.y_m + np.array([-20, -20, 20, 20.0])
    )
    affine = Affine((max(x) - min(x)) / 400, 0.0, min(x), 0.0, -(max(y) - min(y)) / 400, max(y))

    def there(u, v):
        return plane(*to_crs.transform(u, v, direction="INVERSE"))

    path = write_tif(tmp_path / "h.tif", raster_of(there, affine), crs, affine)
    if crs == "EPSG:2263":  # in feet: which unit its heights are in has to be said
        with rasterio.open(path, "r+") as dataset:
            dataset.units = ("m",)
    summary, source = built(tmp_path, height=path, crs=WORLD.crs)
    assert source.grid.crs == WORLD.crs
    check_plane(source, 1e-3)
    rough = {"datum-shift-rough", "datum-shift-unknown"} & {of.code for of in summary.findings}
    assert bool(rough) == (crs in {"EPSG:31256", "EPSG:2263"})


@pytest.mark.parametrize("west_deg", [179.9999, -180.0001])
def test_a_raster_across_the_antimeridian_is_whole(tmp_path, west_deg):
    """In degrees, 21 m wide; heights rise by 1 m a pixel of 1e-6 degrees from one side to the other."""
    affine = Affine(1e-6, 0.0, west_deg, 0.0, -1e-6, -16.5)
    values = np.tile(np.arange(200, dtype=np.float32), (1, 200, 1))
    write_tif(tmp_path / "h.tif", values, "EPSG:4326", affine)
    summary, source = built(tmp_path, height=tmp_path / "h.tif")
    assert summary.covered["height"] > 0.9
    x, y = centres(source.grid)
    lon, _ = pyproj.Transformer.from_crs(source.grid.crs, "EPSG:4326", always_xy=True).transform(x, y)
    wanted = ((lon - west_deg + 180.0) % 360.0 - 180.0) / 1e-6 - 0.5
    found = heights(source)
    assert np.nanmax(np.abs(found - wanted)) < 0.01


def test_heights_that_are_none_are_told_from_metres(tmp_path):
    values = raster_of(plane, NORTH_UP)
    values[0, :9] = -9999.0
    path = write_tif(tmp_path / "h.tif", values, WORLD.crs, NORTH_UP)
    with pytest.raises(MapError, match=r"if -9999 is no data: rio calc .* --co nodata=-9999"):
        built(tmp_path, height=path)


@pytest.mark.parametrize("driver", ["HFA", "COG"])
def test_a_raster_may_be_of_these_kinds_whatever_its_name(tmp_path, driver):
    path = write_tif(tmp_path / "h.tif", raster_of(plane, NORTH_UP), WORLD.crs, NORTH_UP)
    rasterio.shutil.copy(path, tmp_path / "copy.x", driver=driver)
    _, source = built(tmp_path, height=tmp_path / "copy.x")
    assert check_plane(source).all()


def test_a_finer_layer_is_averaged_and_classes_take_the_majority(tmp_path):
    rng = np.random.default_rng(0)
    fine = Affine(0.1, 0.0, LEFT, 0.0, -0.1, TOP)
    height, grey = rng.normal(100.0, 1.0, (400, 400)), rng.integers(0, 256, (3, 400, 400)).astype(np.uint8)
    terrain = rng.integers(4, 8, (400, 400)).astype(np.uint8)
    write_tif(tmp_path / "h.tif", height[None], WORLD.crs, fine)
    write_tif(tmp_path / "o.tif", grey, WORLD.crs, fine)
    write_tif(tmp_path / "t.tif", terrain[None], WORLD.crs, fine)
    layers = {"height": tmp_path / "h.tif", "ortho": tmp_path / "o.tif", "terrain": tmp_path / "t.tif"}
    _, source = built(tmp_path, **layers, pixel_size_m=0.5)

    def cells(values):
        return values.reshape(80, 5, 80, 5).swapaxes(1, 2).reshape(80, 80, 25)

    np.testing.assert_allclose(heights(source), cells(height).mean(-1), atol=1e-5)
    luma = cells(np.tensordot((0.299, 0.587, 0.114), grey.astype(float), 1)).mean(-1)
    np.testing.assert_allclose(source.read("ortho", 0, 80, 0, 80), luma, atol=0.501)
    votes = np.stack([(cells(terrain) == k).sum(-1) for k in range(8)], -1)
    np.testing.assert_array_equal(source.read("terrain", 0, 80, 0, 80), votes.argmax(-1))


def test_units_scale_and_offset_become_metres(tmp_path):
    centimetres = np.rint(raster_of(plane, NORTH_UP, dtype=np.float64) * 100.0 - 40_000.0).astype(np.int16)
    path = write_tif(tmp_path / "h.tif", centimetres, WORLD.crs, NORTH_UP, nodata=-9999)
    with rasterio.open(path, "r+") as dataset:
        dataset.scales, dataset.offsets, dataset.units = (1.0,), (40_000.0,), ("cm",)
    _, source = built(tmp_path, height=path)
    assert check_plane(source, 0.0051).all()


def test_feet_of_a_vertical_crs_become_metres(tmp_path):
    feet = raster_of(plane, NORTH_UP) / np.float32(0.3048)
    path = write_tif(tmp_path / "h.tif", feet, "EPSG:32633+8228", NORTH_UP)  # NAVD88 height in feet
    _, source = built(tmp_path, height=path)
    assert source.grid.crs == WORLD.crs
    check_plane(source, 2e-4)


def test_heights_beside_a_crs_in_feet_must_say_their_unit(tmp_path):
    """US survey feet east and north (New York), nothing about up: metres or feet would be 20° of slope apart."""
    affine = (3.0, 0.0, 980_000.0, 0.0, -3.0, 200_000.0)
    path = write_tif(tmp_path / "h.tif", np.full((1, 40, 40), 30.0, np.float32), "EPSG:2263", affine)
    with pytest.raises(MapError, match=r"CRS is in US survey foot.*rio edit-info .*--units ft"):
        built(tmp_path, height=path)
    with rasterio.open(path, "r+") as dataset:
        dataset.units = ("us-ft",)
    _, source = built(tmp_path, height=path)
    assert source.grid.crs == "EPSG:26918"
    assert np.nanmax(heights(source)) == pytest.approx(30.0 * 1200.0 / 3937.0, abs=1e-3)


def test_every_way_of_saying_nodata_is_heard(tmp_path, height):
    base = np.full((3, 400, 400), 200, np.uint8)
    base[:, 50:100, :] = 0
    write_tif(tmp_path / "tag.tif", base, WORLD.crs, NORTH_UP, nodata=0)
    alpha = np.where(base[:1] == 0, 0, 255).astype(np.uint8)
    write_tif(tmp_path / "alpha.tif", np.vstack([base, alpha]), WORLD.crs, NORTH_UP, photometric="RGB", alpha="YES")
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        write_tif(tmp_path / "mask.tif", base, WORLD.crs, NORTH_UP)
        with rasterio.open(tmp_path / "mask.tif", "r+") as dataset:
            dataset.write_mask(alpha[0])
    write_tif(tmp_path / "black.tif", base, WORLD.crs, NORTH_UP)
    for name, value in (("tag", 0), ("alpha", 0), ("mask", 0), ("black", 1)):
        _, source = built(tmp_path, height=height, ortho=tmp_path / f"{name}.tif")
        found = source.read("ortho", 0, 400, 0, 400)
        assert (found[50:100] == value).all(), name
        assert (found[:50] == 200).all(), name


def test_sixteen_bits_grey_and_palettes_become_grey(tmp_path, height):
    wide = np.full((1, 400, 400), 65535 * 100 // 255, np.uint16)
    write_tif(tmp_path / "wide.tif", wide, WORLD.crs, NORTH_UP)
    index = np.tile(np.array([1, 2], np.uint8), (1, 400, 200))
    write_tif(tmp_path / "palette.tif", index, WORLD.crs, NORTH_UP)
    with rasterio.open(tmp_path / "palette.tif", "r+") as dataset:
        dataset.write_colormap(1, {1: (255, 0, 0, 255), 2: (0, 255, 0, 255)})
    _, source = built(tmp_path, height=height, ortho=tmp_path / "wide.tif")
    assert (source.read("ortho", 0, 400, 0, 400) == 100).all()
    _, source = built(tmp_path, height=height, ortho=tmp_path / "palette.tif")
    assert source.read("ortho", 0, 1, 0, 4).tolist() == [[76, 150, 76, 150]]


def test_class_values_are_mapped_and_unnamed_ones_are_nodata_and_said(tmp_path, height):
    values = np.full((1, 400, 400), 40, np.uint16)
    values[0, :100], values[0, 100:110] = 1000, 77
    write_tif(tmp_path / "t.tif", values, WORLD.crs, NORTH_UP)
    (tmp_path / "c.csv").write_text("value,id,name,traversable\n40,2,meadow,yes\n1000,1,water,no\n41,2,meadow,yes\n")
    paths = {"height": height, "terrain": tmp_path / "t.tif"}
    summary, source = built(tmp_path, **paths, classes=tmp_path / "c.csv")
    found = source.read("terrain", 0, 400, 0, 1)[:, 0]
    assert found.tolist() == [1] * 100 + [0] * 10 + [2] * 290
    assert summary.class_share == {"water": 100 / 390, "meadow": 290 / 390}
    assert source.classes.count == 2
    (unnamed,) = [of for of in summary.findings if of.code == "class-values-unnamed"]
    assert (unnamed.names["values"], unnamed.numbers) == ("77", {"pixel_count": 4000, "value_count": 1})
    with pytest.raises(MapError, match=r"none of its values 40, 77, 1000 is in the class table"):
        built(tmp_path, **paths)


ATTRIBUTES = """<PAMDataset><PAMRasterBand band="1"><CategoryNames>{categories}</CategoryNames>{table}</PAMRasterBand></PAMDataset>"""
TABLE = """<GDALRasterAttributeTable tableType="thematic">
<FieldDefn index="0"><Name>Value</Name><Type>0</Type><Usage>5</Usage></FieldDefn>
<FieldDefn index="1"><Name>Count</Name><Type>0</Type><Usage>1</Usage></FieldDefn>
<FieldDefn index="2"><Name>Class_Name</Name><Type>2</Type><Usage>0</Usage></FieldDefn>
<FieldDefn index="3"><Name>Remark</Name><Type>2</Type><Usage>0</Usage></FieldDefn>
{rows}</GDALRasterAttributeTable>"""


def named_raster(directory, names, *, as_categories=False, name="t.tif"):
    """Values 0 to 49 in columns of eight pixels, and a file beside that names some, as GDAL keeps them."""
    values = np.repeat(np.arange(50, dtype=np.uint8), 8)[None, None, :].repeat(400, axis=1)
    path = write_tif(directory / name, values, WORLD.crs, NORTH_UP)
    entries = "".join(f"<Category>{names.get(value, '')}</Category>" for value in range(50)) if as_categories else ""
    rows = "".join(
        f'<Row index="{n}"><F>{value}</F><F>9</F><F>{text}</F><F>x{n}</F></Row>'
        for n, (value, text) in enumerate(names.items())
    )
    table = "" if as_categories else TABLE.format(rows=rows)
    path.with_name(f"{name}.aux.xml").write_text(ATTRIBUTES.format(categories=entries, table=table))
    return path


@pytest.mark.parametrize("as_categories", [False, True])
def test_a_rasters_own_class_names_say_what_its_values_mean(tmp_path, as_categories, height):
    """Value 4 is named mud: the name rules, not the number."""
    names = {4: "Mud", 10: "GRASS", 11: "paved_road", 12: "water"}
    path = named_raster(tmp_path, names, as_categories=as_categories)
    summary, source = built(tmp_path, height=height, terrain=path)
    found = source.read("terrain", 5, 6, 0, 400)[0, 4::8]
    wanted = np.zeros(50, np.uint8)
    wanted[[4, 10, 11]] = 5, 4, 7
    assert found.tolist() == wanted.tolist()
    assert source.facts.classes_from == "names"
    (unnamed,) = [of for of in summary.findings if of.code == "class-values-unnamed"]
    assert unnamed.names["values"] == "0, 1, 2 …"


def test_names_that_the_class_table_lacks_are_not_guessed(tmp_path, height):
    path = named_raster(tmp_path, {4: "Wiese", 5: "Wasser"})
    with pytest.raises(
        MapError, match=r"none of its class names \(Wiese, Wasser\) is in the class table \(obstacle, .*--classes"
    ):
        built(tmp_path, height=height, terrain=path)
    (tmp_path / "c.csv").write_text("value,id,name,traversable\n4,1,meadow,yes\n")
    _, source = built(tmp_path, height=height, terrain=path, classes=tmp_path / "c.csv")
    assert source.read("terrain", 5, 6, 36, 37).tolist() == [[1]]
    assert source.facts.classes_from == "file"


def test_palette_indices_are_class_values_and_what_is_transparent_is_nodata(tmp_path, height):
    index = np.repeat(np.array([4, 5, 6, 7], np.uint8), 100)[None, None, :].repeat(400, axis=1)
    write_tif(tmp_path / "p.tif", index, WORLD.crs, NORTH_UP)
    opacity = {4: 255, 5: 255, 6: 0, 7: 255}
    colours = "".join(f'<Entry c1="9" c2="{n}" c3="9" c4="{opacity.get(n, 0)}"/>' for n in range(8))
    rasterio.shutil.copy(tmp_path / "p.tif", tmp_path / "p.vrt", driver="VRT")
    document = (tmp_path / "p.vrt").read_text().replace("<ColorInterp>Gray", "<ColorInterp>Palette")
    document = document.replace("<SimpleSource>", f"<ColorTable>{colours}</ColorTable><SimpleSource>")
    (tmp_path / "p.vrt").write_text(document)
    rasterio.shutil.copy(
        tmp_path / "p.vrt", tmp_path / "p.img", driver="HFA"
    )  # keeps opacity, which a GeoTIFF does not
    _, source = built(tmp_path, height=height, terrain=tmp_path / "p.img")
    assert source.read("terrain", 9, 10, 0, 400)[0, 50::100].tolist() == [4, 5, 0, 7]


def bad_rasters(directory: Path):
    """Every generated raster that must be refused: role, path, what the line must say."""
    good = raster_of(plane, NORTH_UP)

    def write(name, values=good, crs=WORLD.crs, affine=NORTH_UP, **options):
        return write_tif(directory / name, values, crs, affine, **options)

    text = directory / "text.tif"
    text.write_text("not a raster")
    whole = write("whole.tif", compress="deflate").read_bytes()
    cut = directory / "cut.tif"
    cut.write_bytes(whole[: len(whole) // 2])
    gcps = [GroundControlPoint(r, c, WORLD.x_m + c, WORLD.y_m - r) for r, c in ((0, 0), (0, 9), (9, 0), (9, 9))]
    with rasterio.open(
        directory / "gcps.tif",
        "w",
        driver="GTiff",
        height=9,
        width=9,
        count=1,
        dtype="float32",
        gcps=gcps,
        crs=WORLD.crs,
    ) as dataset:
        dataset.write(np.zeros((1, 9, 9), np.float32))
    moon = "+proj=eqc +a=1737400 +b=1737400 +units=m"
    world = Affine(0.5, 0.0, -180.0, 0.0, -0.5, 90.0)
    return [
        ("height", directory / "nothing.tif", "no such file"),
        ("height", text, "not a raster"),
        ("height", cut, "damaged|not a raster"),
        ("height", write("plain.tif", crs=None), "no CRS.*--crs"),
        ("height", directory / "gcps.tif", "ground control points"),
        ("height", write("moon.tif", crs=moon), "another body"),
        ("height", write("globe.tif", np.zeros((1, 360, 720), np.float32), "EPSG:4326", world), "too large"),
        ("height", write("nodata.tif", np.full_like(good, -9.0), nodata=-9.0), "every pixel is nodata"),
        ("height", write("nan.tif", np.full_like(good, np.nan)), "every pixel is nodata"),
        ("height", write("rgb.tif", np.zeros((3, 9, 9), np.uint8)), "3 bands.*expected one"),
        ("height", write("complex.tif", np.zeros((1, 9, 9), np.complex64)), "complex numbers.*rio calc"),
        ("height", write("cm.tif", good * 100.0), "not metres"),
        ("ortho", write("float.tif"), "float32, expected 8-bit or 16-bit"),
        ("ortho", write("five.tif", np.zeros((5, 9, 9), np.uint8)), "5 bands"),
        (
            "ortho",
            write("away.tif", np.ones((3, 9, 9), np.uint8), affine=Affine(1, 0, 5e5, 0, -1, 5e6)),
            "no data anywhere",
        ),
        ("terrain", write("real.tif"), "expected whole numbers"),
        ("terrain", write("empty.tif", np.zeros((1, 400, 400), np.uint8), nodata=0), "no data anywhere"),
    ]


def test_what_cannot_be_placed_is_refused_in_one_line_and_leaves_nothing(tmp_path):
    good = write_tif(tmp_path / "good.tif", raster_of(plane, NORTH_UP), WORLD.crs, NORTH_UP)
    (tmp_path / "out").mkdir()
    for role, path, wanted in bad_rasters(tmp_path):
        with pytest.raises(MapError, match=wanted) as caught:
            build_map(tmp_path / "out" / "m.zarr", name="m", **{"height": good, role: path})
        assert len(caught.value.problems) == 1, path
        assert str(path) in caught.value.problems[0]
        assert "\n" not in caught.value.problems[0]
        assert not list((tmp_path / "out").iterdir()), path


def test_a_wanted_crs_must_be_metric(tmp_path):
    write_tif(tmp_path / "h.tif", raster_of(plane, NORTH_UP), None, NORTH_UP)
    for crs, wanted in (("EPSG:3857", "not metric"), ("EPSG:4326", "not metric"), ("nonsense", "not a CRS")):
        with pytest.raises(MapError, match=wanted):
            built(tmp_path, height=tmp_path / "h.tif", crs=crs)
    _, source = built(tmp_path, height=tmp_path / "h.tif", crs="EPSG:32633")
    check_plane(source)


def colours_at(x, y):
    """Red rises to the east, green to the north, blue is the same everywhere."""
    return 1.0 + 6.0 * (x - LEFT), 1.0 + 6.0 * (y - TOP + 40.0), np.full_like(x, 200.0)


ORTHOS = {
    "north up": NORTH_UP,
    "rotated": Affine(0.016, 0.012, LEFT + 2.0, 0.012, -0.016, TOP - 14.0),
}


@pytest.mark.parametrize(("name", "files"), [("north up", 1), ("north up", 2), ("rotated", 2)])
def test_an_orthophoto_has_a_small_picture_in_colour(tmp_path, height, name, files):
    affine = ORTHOS[name]
    size = 400 if name == "north up" else 1000
    bands = np.concatenate([raster_of(lambda x, y, n=n: colours_at(x, y)[n], affine, size, size) for n in range(3)])
    split = np.array_split(np.arange(size), files)
    ortho = [
        write_tif(
            tmp_path / f"{part[0]}.tif",
            np.rint(bands[:, part]).astype(np.uint8),
            WORLD.crs,
            affine @ Affine.translation(0, part[0]),
            photometric="RGB",
        )
        for part in split
    ]
    _, source = built(tmp_path, height=height, ortho=ortho, pixel_size_m=0.04)
    picture = source.read_picture()
    assert max(picture.shape) <= 900
    side_m = 40.0 / picture.shape[0]
    i, j = np.indices(picture.shape[:2])
    expected = np.stack(colours_at(LEFT + (j + 0.5) * side_m, TOP - (i + 0.5) * side_m), axis=-1)
    there = (picture != 255).all(axis=2)
    assert there.mean() > 0.2
    assert np.abs(picture - expected)[there].max() <= 1.5
    assert set(source.layers) == {"height", "ortho"}


def test_a_grey_orthophoto_has_no_colours(tmp_path, height):
    grey = write_tif(tmp_path / "g.tif", np.full((1, 400, 400), 90, np.uint8), WORLD.crs, NORTH_UP)
    _, source = built(tmp_path, height=height, ortho=grey)
    assert source.read_picture() is None
    with pytest.raises(MapError, match="has no colours, expected red, green, blue for --ortho-bands rgb"):
        built(tmp_path, height=height, ortho=grey, more=MoreLayers(ortho_bands="rgb"))
