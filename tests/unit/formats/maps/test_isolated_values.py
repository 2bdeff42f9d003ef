"""Holes and collars without a tag, and orthophotos in a corner of their range, are reported."""

import numpy as np
import pytest
import rasterio
from map_worlds import write_tif
from rasterio import Affine
from shared_data import shared_data

from tcpipe.formats.maps.building import build_map
from tcpipe.formats.maps.map_files import open_map
from tcpipe.tables.findings import select_findings

PX, COUNT = 0.1, 300
AFFINE = Affine(PX, 0.0, 500_000.0, 0.0, -PX, 5_200_000.0)
X, Y = np.meshgrid(np.arange(COUNT) * PX, np.arange(COUNT) * PX)
HEIGHT = 312.0 + 0.2 * X - 0.1 * Y + 0.3 * np.sin(X / 1.7) * np.cos(Y / 1.3)
GREY = 130.0 + 90.0 * np.sin(X / 2.1) * np.sin(Y / 1.9)
HOLE = np.hypot(X - 14.0, Y - 11.0) < 2.0
COLLAR = 0.3 * X + Y > 33.0


def write(path, values, dtype=np.float32, **options):
    bands = values if values.ndim == 3 else values[None]
    return write_tif(path, bands.astype(dtype), "EPSG:32633", AFFINE, **options)


def add(tmp_path, **layers):
    """Build a map of the rasters; return it, and its findings of the two kinds."""
    facts = build_map(tmp_path / "m.zarr", name="m", **layers)
    return open_map(tmp_path / "m.zarr"), select_findings(facts.findings, "value-isolated", "ortho-range-narrow")


def read(source, layer):
    return source.read(layer, 0, source.grid.rows, 0, source.grid.cols)


PLACES = {"hole": HOLE, "collar": COLLAR}


@pytest.mark.parametrize(
    ("value", "nodata", "place"),
    [(0.0, None, "hole"), (-1.0, -9999.0, "hole"), (-99.0, None, "collar"), (0.0, -9999.0, "collar")],
)
def test_a_height_far_below_all_others_is_reported_and_a_tag_makes_it_no_data(tmp_path, value, nodata, place):
    place = PLACES[place]
    path = write(tmp_path / "h.tif", np.where(place, value, HEIGHT), nodata=nodata)
    _, (finding,) = add(tmp_path, height=path)
    assert finding.severity == "warning"
    assert finding.names["value"] == f"{value:g}"
    assert finding.numbers["pixel_fraction"] == pytest.approx(place.mean(), rel=1e-3)
    path = write(tmp_path / "tagged.tif", np.where(place, value, HEIGHT), nodata=value)
    source, left = add(tmp_path, height=path)
    assert not left
    assert np.array_equal(np.isnan(read(source, "height")), place)


def test_a_hole_with_smeared_edges_is_reported(tmp_path):
    soft = np.clip((2.2 - np.hypot(X - 14.0, Y - 11.0)) / 0.2, 0.0, 1.0)
    _, findings = add(tmp_path, height=write(tmp_path / "h.tif", HEIGHT * (1.0 - soft)))
    assert len(findings) == 1


@pytest.mark.parametrize(
    "height",
    {
        "sound": HEIGHT,
        "lake": np.maximum(HEIGHT, 313.0),
        "lake below a bank of 1 m": np.where(HEIGHT < 313.0, 312.0, HEIGHT),
        "clipped plain": np.maximum(HEIGHT - 313.0, 0.0),
        "metres as integers": np.rint(HEIGHT),
        "flat": np.zeros_like(HEIGHT),
        "pits of one pixel": np.where((X * 10 % 50 < 1) & (Y * 10 % 50 < 1), HEIGHT - 20.0, HEIGHT),
    }.items(),
    ids=lambda item: item[0],
)
def test_lakes_plains_and_pits_are_not_reported(tmp_path, height):
    assert not add(tmp_path, height=write(tmp_path / "h.tif", height[1]))[1]


def photo(tmp_path, values, dtype=np.uint8, **options):
    """Return a height raster, and an orthophoto of three bands."""
    height = write(tmp_path / "h.tif", HEIGHT)
    return {
        "height": height,
        "ortho": write(tmp_path / "o.tif", np.stack([values] * 3), dtype, photometric="RGB", **options),
    }


def test_bits_in_use_are_the_range_of_an_orthophoto(tmp_path):
    source, findings = add(tmp_path, **photo(tmp_path, GREY / 255.0 * 4095.0, np.uint16, nbits=12))
    assert not findings
    assert np.abs(read(source, "ortho") - GREY).max() < 1.1
    good = {"height": shared_data("reports/maps/good_height.tif"), "ortho": shared_data("reports/maps/good_ortho.tif")}
    eight = read(add(tmp_path, **good)[0], "ortho").astype(int)
    twelve = read(add(tmp_path, **good | {"ortho": shared_data("reports/maps/ortho_12bit.tif")})[0], "ortho")
    assert np.abs(twelve - eight)[(eight > 0) & (twelve > 0)].max() <= 1


@pytest.mark.parametrize(("highest", "nodata"), [(4095.0, None), (10_000.0, 65535), (900.0, None)])
def test_few_grey_levels_are_reported(tmp_path, highest, nodata):
    values = np.where(HOLE & (nodata is not None), 65535.0, GREY / 255.0 * highest)
    _, (finding,) = add(tmp_path, **photo(tmp_path, values, np.uint16, nodata=nodata))
    assert finding.code == "ortho-range-narrow"
    assert finding.numbers["range_fraction"] < 0.25


@pytest.mark.parametrize(
    ("value", "dtype", "place"), [(0, np.uint8, "hole"), (255, np.uint8, "collar"), (65535, np.uint16, "hole")]
)
def test_black_and_white_areas_without_mask_are_reported_and_kept(tmp_path, value, dtype, place):
    full, place = float(np.iinfo(dtype).max), PLACES[place]
    source, (finding,) = add(tmp_path, **photo(tmp_path, np.where(place, value, GREY / 255.0 * full), dtype))
    assert finding.code == "value-isolated"
    assert finding.numbers["pixel_fraction"] == pytest.approx(place.mean(), rel=1e-3)
    assert (read(source, "ortho") > 0).all()


@pytest.mark.parametrize("grey", [GREY, np.clip(2.0 * GREY - 130.0, 0.0, 255.0)], ids=["sound", "saturated"])
def test_dark_and_bright_ground_is_not_reported(tmp_path, grey):
    assert not add(tmp_path, **photo(tmp_path, grey))[1]


def test_a_mask_is_enough(tmp_path):
    layers = photo(tmp_path, np.where(COLLAR, 0.0, GREY))
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(layers["ortho"], "r+") as dataset:
        dataset.write_mask(~COLLAR)
    assert not add(tmp_path, **layers)[1]
