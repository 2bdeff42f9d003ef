"""What GDAL would open for a user's raster: nothing but rasters that lie beside it or, of a VRT, at or below its folder."""

import socket

import numpy as np
import pytest
import rasterio
import rasterio.shutil
from map_worlds import write_tif
from rasterio import Affine
from rasterio.vrt import WarpedVRT

from tcpipe.errors import MapError
from tcpipe.formats.maps.geotiff import raster_files, read_tile
from tcpipe.formats.maps.mosaic import open_raster

PLACE = Affine(1.0, 0.0, 560_000.0, 0.0, -1.0, 5_215_000.0)
HEIGHTS = np.arange(64 * 64, dtype=np.float32).reshape(1, 64, 64) / 64
BODY = "<SRS>EPSG:32633</SRS><GeoTransform>560000, 1, 0, 5215000, 0, -1</GeoTransform>{}"
BAND = '<VRTRasterBand dataType="Float32" band="1"{}>{}</VRTRasterBand>'
SOURCE = '<SimpleSource><SourceFilename relativeToVRT="{}">{}</SourceFilename><SourceBand>1</SourceBand></SimpleSource>'


def vrt(body, dataset=""):
    return f'<VRTDataset rasterXSize="64" rasterYSize="64"{dataset}>{BODY.format(body)}</VRTDataset>'


def simple(name, relative=1):
    return vrt(BAND.format("", SOURCE.format(relative, name)))


@pytest.fixture
def folders(tmp_path):
    """A folder with a raster and one below it, and a raster elsewhere that nobody may see."""
    site, secret = tmp_path / "site", tmp_path / "secret.tif"
    (site / "tiles").mkdir(parents=True)
    for path in (site / "h.tif", site / "tiles/a.tif", secret):
        write_tif(path, HEIGHTS, "EPSG:32633", PLACE)
    return site, secret


@pytest.fixture
def address():
    """An address, and that nobody has called there."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"http://127.0.0.1:{server.getsockname()[1]}/x.tif"
        server.settimeout(0)
        with pytest.raises(BlockingIOError):
            server.accept()


def read(path):
    with open_raster([path], "height") as raster:
        return raster.read(0, raster.rows, 0, raster.cols)


def hostile(site, secret, address):
    """Names of files, their content, and what is said of them."""
    warped = f"<GDALWarpOptions><SourceDataset>{secret}</SourceDataset></GDALWarpOptions>"
    raw = f'<SourceFilename relativetoVRT="0">{secret}</SourceFilename><ImageOffset>0</ImageOffset>'
    code = "<PixelFunctionType>f</PixelFunctionType><PixelFunctionLanguage>Python</PixelFunctionLanguage>"
    overview = f"<Overview><SourceFilename>{secret}</SourceFilename></Overview>"
    options = '<OpenOptions><OOI key="ROOT_PATH">/</OOI></OpenOptions>'
    elsewhere = "is not at or below its own folder"
    (site / "link.tif").symlink_to(secret)
    (site / "vrt:").mkdir()
    (site / "vrt:" / "h.tif").write_bytes((site / "h.tif").read_bytes())
    yield "absolute.tif", simple(secret, 0), elsewhere
    yield "upward.vrt", simple("../secret.tif"), elsewhere
    yield "linked.vrt", simple("link.tif"), elsewhere
    yield "shouted.vrt", simple(secret, 0).replace("SourceFilename", "SOURCEFILENAME"), elsewhere
    yield "spaced.vrt", f"\ufeff\n <?xml version='1.0'?>\n<!-- x -->{simple(secret, 0)}", elsewhere
    yield (
        "warped.vrt",
        vrt(BAND.format(' subClass="VRTWarpedRasterBand"', "") + warped, ' subClass="VRTWarpedDataset"'),
        elsewhere,
    )
    yield (
        "overview.vrt",
        simple("h.tif").replace("</VRTR", f"{overview}</VRTR"),
        elsewhere,
    )
    yield (
        "mask.vrt",
        vrt(BAND.format("", "") + f"<MaskBand>{BAND.format('', SOURCE.format(0, secret))}</MaskBand>"),
        elsewhere,
    )
    yield "gone.vrt", simple("no.tif"), "is no file at or below its own folder"
    yield "network.vrt", simple(f"/vsicurl/{address}", 0), "is no file at or below"
    yield "connection.vrt", simple(f"vrt://{secret}", 0), "is no file at or below"
    yield "inline.vrt", simple(simple(secret, 0).replace("<", "&lt;"), 0), "is no file at or below"
    yield "nested.vrt", simple("absolute.tif"), elsewhere
    yield "itself.vrt", simple("itself.vrt"), "VRTs in VRTs"
    yield "raw.vrt", vrt(BAND.format(' subClass="VRTRawRasterBand"', raw)), "VRTRawRasterBand"
    yield "child.vrt", vrt(BAND.format("", f"<subClass>VRTRawRasterBand</subClass>{raw}")), "<subClass>"
    yield (
        "attribute.vrt",
        vrt(BAND.format("", f'<SimpleSource SourceFilename="{secret}"/>')),
        "SourceFilename= in <SimpleSource>",
    )
    yield "python.vrt", vrt(BAND.format(' subClass="VRTDerivedRasterBand"', code)), "<PixelFunctionLanguage>"
    yield (
        "options.vrt",
        simple("h.tif").replace("<SourceBand", f"{options}<SourceBand"),
        "Open",
    )
    yield "crs.vrt", simple("h.tif").replace("EPSG:32633", address), "with the CRS"
    yield (
        "entity.vrt",
        f'<!DOCTYPE VRTDataset [<!ENTITY s "{secret}">]>{simple("&s;", 0)}',
        "not a raster that is read|document type",
    )
    yield "deep.vrt", vrt("<Transformer>" * 99 + "</Transformer>" * 99), "nested more than 32 deep"
    yield "long.vrt", vrt("<F/>" * 2_000_001), "a VRT of 2000007 tags, at most 2000000"
    yield "cut.vrt", simple("h.tif")[:-9], "damaged"
    yield "wms.tif", f"<GDAL_WMS><Service><ServerUrl>{address}</ServerUrl></Service></GDAL_WMS>", r"XML \(GDAL_WMS\)"
    yield "grid.tif", "ncols 2\nnrows 2\n", "an ASCII grid"
    yield "text.tif", "root:x:0:0", "something else"
    yield "polyglot.tif", f"EHFA_HEADER_TAG {simple(secret, 0)}", "something else"


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
            raster_files(path)
    assert capfd.readouterr().err == ""


def beside(site, secret, address):
    """Files beside a raster that send GDAL elsewhere."""
    away = '<PAMDataset><Metadata domain="{}"><MDI key="{}">{}</MDI></Metadata></PAMDataset>'
    yield "h.tif.aux.xml", away.format("OVERVIEWS", "OVERVIEW_FILE", secret), "names another file for its overviews"
    yield (
        "h.tif.aux.xml",
        away.format("overviews", "overview&#95;file", address),
        "names another file for its overviews",
    )
    yield "h.tif.msk", simple(secret, 0), "mask or overview of h.tif; wanted a GeoTIFF, got a VRT"
    yield "h.tif.OVR", simple(secret, 0), "mask or overview of h.tif"
    yield "h.tif.msk", f"<GDAL_WMS><ServerUrl>{address}</ServerUrl></GDAL_WMS>", "GDAL_WMS"
    yield "h.aux", f"EHFA_HEADER_TAG\0{simple(secret, 0)}", "damaged"


def test_what_lies_beside_a_raster_does_not_reach_elsewhere(folders, address, capfd):
    site, secret = folders
    for name, content, wanted in beside(site, secret, address):
        (site / name).write_text(content)
        for path in (site / "h.tif", site / "over.vrt"):
            (site / "over.vrt").write_text(simple("h.tif"))
            with pytest.raises(MapError, match=wanted):
                read(path)
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
    assert [path.name for path in raster_files(site / "h.tif")] == ["h.tif", "h.tif.msk", "h.tif.ovr"]


def good(site):
    (site / "inner.vrt").write_text(simple("tiles/a.tif"))
    (site / "here.tif").symlink_to(site / "tiles/a.tif")
    yield simple("tiles/a.tif")
    yield simple(site / "tiles/a.tif", 0)
    yield simple("here.tif")
    yield simple("./tiles/../inner.vrt")
    yield f"<?xml version='1.0' encoding='utf-8'?>\n{simple('tiles/a.tif')}"
    yield simple("tiles/a.tif").replace(
        "<SRS>", '<Metadata domain="xml:XMP" format="xml"><x:xmpmeta xmlns:x="adobe"/></Metadata><SRS>'
    )
    yield (
        simple("tiles/a.tif")
        .replace("SimpleSource", "ComplexSource")
        .replace("<SourceBand", "<NODATA>-9</NODATA><SourceBand")
    )


def test_a_vrt_of_rasters_at_or_below_its_folder_is_one_raster(folders):
    site, _ = folders
    for content in good(site):
        (site / "all.vrt").write_text(content)
        values, valid = read(site / "all.vrt")
        np.testing.assert_array_equal(values, HEIGHTS[0])
        assert valid.all()
        names = [path.name for path in raster_files(site / "all.vrt")]
        assert (names[0], names[-1]) == ("all.vrt", "a.tif")
    assert read_tile(site / "all.vrt", "height").kind == "float32 (undefined)"


def test_a_vrt_that_warps_is_followed(folders):
    site, _ = folders
    with rasterio.open(site / "h.tif") as dataset, WarpedVRT(dataset, crs="EPSG:32634") as warped:
        wanted = warped.read(1)
        rasterio.shutil.copy(warped, site / "warped.vrt", driver="VRT")
    values, _ = read(site / "warped.vrt")
    np.testing.assert_array_equal(values, wanted)
    (site / "moved").mkdir()
    (site / "warped.vrt").rename(site / "moved/warped.vrt")
    with pytest.raises(MapError, match="at or below its own folder"):
        read(site / "moved/warped.vrt")


def test_a_mask_beside_a_vrt_is_not_lost_silently(folders):
    site, _ = folders
    (site / "all.vrt").write_text(simple("h.tif"))
    (site / "all.vrt.msk").write_bytes((site / "h.tif").read_bytes())
    with pytest.raises(MapError, match=r"all.vrt.msk: the mask beside a VRT is not followed"):
        read(site / "all.vrt")


def test_a_raster_in_one_huge_block_is_refused(tmp_path):
    """Sparse, 40 MB of blocks' places: 9000 x 9000 doubles in one strip would be decoded at once."""
    profile = {"driver": "GTiff", "width": 9000, "height": 9000, "count": 1, "dtype": "float64", "blockysize": 9000}
    with rasterio.open(
        tmp_path / "h.tif", "w", **profile, crs="EPSG:32633", transform=PLACE, sparse_ok=True, compress="deflate"
    ):
        pass
    with pytest.raises(MapError, match="kept in blocks of 648 MB, at most 256"):
        read_tile(tmp_path / "h.tif", "height")
