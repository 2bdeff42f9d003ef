"""GDAL opens no file for a user's raster but those of its folder."""

import shlex
import socket

import numpy as np
import pytest
import rasterio
from map_worlds import open_heights, write_tif
from rasterio import Affine

from tcpipe.errors import MapError
from tcpipe.formats.maps.geotiff import list_raster_files, read_tile

PLACE = Affine(1.0, 0.0, 560_000.0, 0.0, -1.0, 5_215_000.0)
HEIGHTS = np.arange(64 * 64, dtype=np.float32).reshape(1, 64, 64) / 64
VRT = (
    '<VRTDataset rasterXSize="64" rasterYSize="64"><SRS>EPSG:32633</SRS><GeoTransform>560000, 1, 0, 5215000, 0, -1</GeoTransform>'
    '<VRTRasterBand dataType="Float32" band="1"><SimpleSource><SourceFilename relativeToVRT="{}">{}</SourceFilename>'
    "<SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
)


@pytest.fixture
def folders(tmp_path):
    """A folder with a raster, and a secret raster elsewhere."""
    site, secret = tmp_path / "site", tmp_path / "secret.tif"
    site.mkdir()
    for path in (site / "h.tif", secret):
        write_tif(path, HEIGHTS, "EPSG:32633", PLACE)
    return site, secret


@pytest.fixture
def address():
    """Yield the address of a server; assert that it got no request."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"http://127.0.0.1:{server.getsockname()[1]}/x.tif"
        server.settimeout(0)
        with pytest.raises(BlockingIOError):
            server.accept()


def read(path):
    with open_heights([path]) as raster:
        return raster.read(0, raster.georeference.rows, 0, raster.georeference.cols)


def hostile(site, secret, address):
    """Names of files, their content, and what is said of them."""
    refused = r"is a GDAL virtual raster \(VRT\).*write it out as a GeoTIFF: rio convert .*{}"
    for name in ("all.vrt", "called.tif", "a b.vrt"):
        yield name, VRT.format(1, "h.tif"), refused.format(name)
    yield "absolute.tif", VRT.format(0, secret), refused.format("absolute.tif")
    yield "network.vrt", VRT.format(0, f"/vsicurl/{address}"), refused.format("network.vrt")
    yield "spaced.vrt", f"\ufeff\n <?xml version='1.0'?>\n<!-- x -->{VRT.format(0, secret)}", refused.format("spaced")
    yield "cut.vrt", VRT.format(1, "h.tif")[:-9], refused.format("cut.vrt")
    yield (
        "hang.tif",
        "<!---->" * 38 + "<?",
        r"is XML, not a raster that is read.*\(rio convert \S*/hang.tif \S*/hang-copy.tif\)",
    )
    yield "wms.tif", f"<GDAL_WMS><Service><ServerUrl>{address}</ServerUrl></Service></GDAL_WMS>", "is XML"
    yield "grid.tif", "ncols 2\nnrows 2\n", "an ASCII grid"
    yield (
        "text.tif",
        "root:x:0:0",
        "is something else, not a raster that is read; expected GeoTIFF, JPEG 2000 or ERDAS Imagine$",
    )
    yield "empty.tif", "", "is empty"
    yield "polyglot.tif", f"EHFA_HEADER_TAG {VRT.format(0, secret)}", "virtual raster"


def test_whatever_reaches_elsewhere_is_refused_in_one_line_and_nobody_is_called(folders, address, capfd):
    site, secret = folders
    for name, content, wanted in hostile(site, secret, address):
        path = site / name
        path.write_text(content)
        with pytest.raises(MapError, match=wanted) as caught:
            read(path)
        assert len(caught.value.problems) == 1, name
        assert f"{site}/" in caught.value.problems[0], name
        with pytest.raises(MapError, match=wanted):
            list_raster_files(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(("name", "target"), [("all of it.vrt", "all of it.tif"), ("all.tif", "all-copy.tif")])
def test_the_line_on_a_virtual_raster_has_the_command_that_converts_it(folders, name, target):
    site, _ = folders
    (site / name).write_text(VRT.format(1, "h.tif"))
    with pytest.raises(MapError) as caught:
        read(site / name)
    (line,) = caught.value.problems
    assert line.startswith(f"{site / name}: ")
    assert shlex.split(line.rpartition("GeoTIFF: ")[2]) == ["rio", "convert", str(site / name), str(site / target)]


def beside(site, secret, address):
    """Files beside a raster that send GDAL elsewhere."""
    away = '<PAMDataset><Metadata domain="{}"><MDI key="{}">{}</MDI></Metadata></PAMDataset>'
    yield "h.tif.aux.xml", away.format("OVERVIEWS", "OVERVIEW_FILE", secret), "names another file for its overviews"
    yield (
        "h.tif.aux.xml",
        away.format("overviews", "overview&#95;file", address),
        "names another file for its overviews",
    )
    for name in ("h.tif.msk", "h.tif.OVR"):
        yield (
            name,
            VRT.format(0, secret),
            rf"{name}: is a GDAL virtual raster.*: rio convert \S*/h.tif \S*/h-copy.tif",
        )
    yield (
        "h.tif.msk",
        f"<GDAL_WMS><ServerUrl>{address}</ServerUrl></GDAL_WMS>",
        r"h.tif.msk: is XML.*\(rio convert \S*/h.tif",
    )
    yield "h.aux", f"EHFA_HEADER_TAG\0{VRT.format(0, secret)}", "damaged"


def test_what_lies_beside_a_raster_does_not_reach_elsewhere(folders, address, capfd):
    site, secret = folders
    for name, content, wanted in beside(site, secret, address):
        (site / name).write_text(content)
        with pytest.raises(MapError, match=wanted):
            read(site / "h.tif")
        (site / name).unlink()
    assert capfd.readouterr().err == ""
    with rasterio.open(site / "h.tif", "r+") as dataset:
        dataset.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=str(secret))
    with pytest.raises(MapError, match="names another file for its overviews"):
        read(site / "h.tif")


def test_a_raster_keeps_its_tags_masks_and_overviews(folders):
    site, _ = folders
    with rasterio.open(site / "h.tif", "r+") as dataset:
        dataset.update_tags(AREA="x", ns="MINE")
    with rasterio.Env(TIFF_USE_OVR=True), rasterio.open(site / "h.tif", "r+") as dataset:
        dataset.build_overviews([2])
    mask = np.full((64, 64), 255, np.uint8)
    mask[:8] = 0
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False), rasterio.open(site / "h.tif", "r+") as dataset:
        dataset.write_mask(mask)
    values, valid = read(site / "h.tif")
    np.testing.assert_array_equal(values, HEIGHTS[0])
    np.testing.assert_array_equal(valid, mask > 0)
    assert [path.name for path in list_raster_files(site / "h.tif")] == ["h.tif", "h.tif.msk", "h.tif.ovr"]


def test_a_raster_in_one_huge_block_is_refused(tmp_path):
    """Sparse, 40 MB of blocks' places: 9000 x 9000 doubles in one strip would be decoded at once."""
    profile = {"driver": "GTiff", "width": 9000, "height": 9000, "count": 1, "dtype": "float64", "blockysize": 9000}
    with rasterio.open(
        tmp_path / "h.tif", "w", **profile, crs="EPSG:32633", transform=PLACE, sparse_ok=True, compress="deflate"
    ):
        pass
    with pytest.raises(MapError, match="stored in blocks of 648 MB, at most 256"):
        read_tile(tmp_path / "h.tif", "height", "metres")
