"""Rasters whose CRS states its own datum shift (TOWGS84, bound CRS) are placed as GDAL places them."""

import numpy as np
import pytest
import rasterio
from map_worlds import World, write_tif
from rasterio import Affine
from rasterio.warp import transform

from tcpipe.errors import MapError
from tcpipe.formats.maps.building import build_map
from tcpipe.formats.maps.geotiff import write_geotiff
from tcpipe.formats.maps.map_files import open_map
from tcpipe.tables.findings import Subject
from tcpipe.terrain.projection import find_utm_crs, format_crs, parse_crs
from tcpipe.terrain.tiles import find_map_projection

WORLD = World("EPSG:32633", 560_000.0, 5_215_000.0, side_m=20.0)
SHIFTS = {
    "DHDN": "+proj=tmerc +lon_0=15 +x_0=5500000 +ellps=bessel +towgs84=598.1,73.7,418.2,0.202,0.045,-2.455,6.7",
    "MGI Austria": "+proj=tmerc +lon_0=16.3333333 +x_0=750000 +y_0=-5000000 +ellps=bessel "
    "+towgs84=577.326,90.129,463.919,5.137,1.474,5.297,2.4232",
    "three parameters": "+proj=utm +zone=33 +ellps=intl +towgs84=-87,-98,-121",
    "an ellipsoid of its own": "+proj=utm +zone=33 +a=6377000 +rf=298.5 +towgs84=120,-30,60,0.5,-1.2,2.3,-4.5",
    "heights": "+proj=utm +zone=33 +ellps=intl +towgs84=-87,-98,-121 +vunits=m",
}


def plane(x, y):
    return 500.0 + 0.2 * (x - WORLD.x_m) + 0.1 * (y - WORLD.y_m)


def write_plane(path, crs, pixel_m=0.25):
    """Write a plane of the world's CRS in another one, placed by GDAL; return its path."""
    crs = rasterio.crs.CRS.from_user_input(crs)
    (x,), (y,) = transform(WORLD.crs, crs, [WORLD.x_m], [WORLD.y_m])
    affine = Affine(pixel_m, 0.0, x - 10.0, 0.0, -pixel_m, y + 10.0)
    rows, cols = np.mgrid[:80, :80]
    at = affine.c + pixel_m * (cols.ravel() + 0.5), affine.f - pixel_m * (rows.ravel() + 0.5)
    values = plane(*np.array(transform(crs, WORLD.crs, *at)[:2])).reshape(1, 80, 80).astype(np.float32)
    return write_tif(path, values, crs, affine)


def find_worst_height_m(source):
    """Return the largest error of a map's heights at places that are given in longitude and latitude [m]."""
    x, y = np.meshgrid(WORLD.x_m + np.linspace(-6.0, 6.0, 9), WORLD.y_m + np.linspace(-6.0, 6.0, 9))
    lonlat = np.stack(transform(WORLD.crs, "EPSG:4326", x.ravel(), y.ravel()), axis=1)
    xy_m = find_map_projection(source, "EPSG:4326").forward(lonlat)
    col, row = np.rint(source.grid.px_from_xy(xy_m)).astype(int).T
    grid = source.grid
    centre = grid.xy_from_px(np.stack([col, row], 1).astype(float))
    heights = source.height_reference_m + source.read("height", 0, grid.rows, 0, grid.cols)[row, col]
    expected = plane(x.ravel(), y.ravel()) + (centre - xy_m) @ (0.2, 0.1)  # at the pixel's centre; axes differ by 1 %
    return np.abs(heights - expected).max()


@pytest.mark.parametrize(("name", "crs"), [*((name, None) for name in SHIFTS), ("DHDN", "EPSG:32633")])
def test_a_raster_with_a_datum_shift_lies_where_gdal_places_it(tmp_path, name, crs):
    height = write_plane(tmp_path / "h.tif", SHIFTS[name])
    facts = build_map(tmp_path / "m.zarr", name="m", height=height, crs=crs)
    source = open_map(tmp_path / "m.zarr")
    assert find_worst_height_m(source) < 0.02
    projection = find_map_projection(source, "EPSG:4326")
    findings = facts.findings if crs else projection.find_rough_shift(Subject("map", "m"))
    assert [finding.code for finding in findings] == ["datum-shift-stated"]


def test_a_shift_is_kept_by_text_and_by_exported_files(tmp_path):
    crs = parse_crs(SHIFTS["DHDN"], where="here")
    assert parse_crs(format_crs(crs), where="there") == crs
    vertical = 'VERT_CS["h",VERT_DATUM["h",2005],UNIT["metre",1],AXIS["Up",UP]]'
    horizontal = rasterio.crs.CRS.from_user_input(SHIFTS["DHDN"]).to_wkt()
    assert (
        parse_crs(f'COMPD_CS["both",{horizontal},{vertical}]', where="there").coordinate_operation.towgs84[0] == 598.1
    )
    build_map(tmp_path / "m.zarr", name="m", height=write_plane(tmp_path / "h.tif", SHIFTS["DHDN"]))
    grid = open_map(tmp_path / "m.zarr").grid
    out = tmp_path / "out.tif"
    write_geotiff(out, lambda a, b: np.zeros((1, b - a, grid.cols), np.float32), grid, dtype="float32")
    with rasterio.open(out) as written, rasterio.open(tmp_path / "h.tif") as given:
        places = [transform(of.crs, WORLD.crs, [of.bounds.left], [of.bounds.top]) for of in (written, given)]
    np.testing.assert_allclose(*places, atol=1e-3)


def test_degrees_with_a_shift_go_to_a_utm_zone_of_wgs84():
    crs = parse_crs("+proj=longlat +ellps=bessel +towgs84=598.1,73.7,418.2,0.202,0.045,-2.455,6.7", where="here")
    assert find_utm_crs(crs, (15.8, 47.1)).to_authority() == ("EPSG", "32633")


@pytest.mark.parametrize(
    ("shifted", "plain"),
    [
        ("+proj=utm +zone=33 +ellps=GRS80 +towgs84=0,0,0,0,0,0,0", "+proj=utm +zone=33 +ellps=GRS80"),
        ("+proj=utm +zone=33 +ellps=WGS84 +towgs84=0,0,0", "+proj=utm +zone=33 +ellps=WGS84"),
        ("+proj=utm +zone=33 +ellps=bessel +nadgrids=@null", "+proj=utm +zone=33 +ellps=bessel"),
    ],
)
def test_a_zero_shift_changes_no_map(shifted, plain):
    found, expected = (parse_crs(text, where="here") for text in (shifted, plain))
    assert not found.is_bound
    assert find_utm_crs(found, (560_000.0, 5_215_000.0)) == find_utm_crs(expected, (560_000.0, 5_215_000.0))


def test_a_known_crs_keeps_the_datum_of_its_authority():
    text = rasterio.crs.CRS.from_epsg(25832).to_wkt()
    text = text.replace('"7019"]]', '"7019"]],TOWGS84[0,0,0,0,0,0,0]', 1)
    assert format_crs(parse_crs(text, where="here")) == "EPSG:25832"


def test_a_shift_in_a_grid_file_is_refused_with_the_command_that_applies_it():
    with pytest.raises(MapError, match=r"grid file 'shift.gsb'.*rio warp in.tif out.tif --dst-crs EPSG:n"):
        parse_crs("+proj=utm +zone=33 +ellps=bessel +nadgrids=shift.gsb", where="h.tif")
