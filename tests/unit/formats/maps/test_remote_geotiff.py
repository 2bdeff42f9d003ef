"""A window of a GeoTIFF on a server: the pixels that rasterio reads of the whole file, and one line for whatever a server does."""

import errno
import io

import numpy as np
import pytest
import rasterio
import shapely
from open_data_server import serve_open_data
from pyproj import Transformer
from rasterio import Affine
from rasterio.enums import ColorInterp
from rasterio.windows import Window

from tcpipe.errors import MapError, StoreError
from tcpipe.formats import https
from tcpipe.formats.https import HttpsClient
from tcpipe.formats.maps import remote_geotiff
from tcpipe.formats.maps.remote_geotiff import open_window

SIDE, LEFT, TOP = 1200, 2_600_000.0, 1_201_000.0
RNG = np.random.default_rng(7)
HEIGHT = (500 + np.cumsum(RNG.normal(size=(1, SIDE, SIDE)), axis=2)).astype(np.float32)
HEIGHT[0, :40, :50] = -9999.0
COLOUR = RNG.integers(0, 255, (3, SIDE, SIDE)).astype(np.uint8)
BOX = (600, 700, 300, 400)
"""Column, row, width and height of the area that is wanted."""


def area(col, row, width, height):
    """That part of the raster as longitude and latitude [deg], 0.2 px smaller on each side."""
    to_lonlat = Transformer.from_crs(2056, 4326, always_xy=True)
    corners = shapely.box(col + 0.2, row + 0.2, col + width - 0.2, row + height - 0.2)
    return shapely.transform(
        corners, lambda px: np.stack(to_lonlat.transform(LEFT + px[:, 0] / 2, TOP - px[:, 1] / 2), axis=-1)
    )


def write(path, values, *, mask=None, driver="GTiff", **profile):
    bands, rows, cols = values.shape
    plain = path.with_name("plain.tif") if driver == "COG" else path
    shape = {"count": bands, "height": rows, "width": cols, "dtype": values.dtype}
    shape |= {"crs": "EPSG:2056", "transform": Affine(0.5, 0, LEFT, 0, -0.5, TOP)} | (
        {} if driver == "COG" else profile
    )
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(plain, "w", driver="GTiff", **shape) as out:
        out.write(values)
        if mask is not None:
            out.write_mask(mask)
        if "alpha" not in profile and bands == 1:
            out.scales, out.offsets, out.units = (0.5,), (100.0,), ("m",)
    if driver == "COG":
        rasterio.shutil.copy(plain, path, driver="COG", **profile)
    return path.read_bytes()


LAYOUTS = {
    "tiles": (HEIGHT, {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "lzw", "nodata": -9999.0}),
    "strips": (HEIGHT, {"compress": "deflate", "predictor": 3}),
    "raw": (HEIGHT, {"blockysize": 1}),
    "bigtiff": (HEIGHT, {"tiled": True, "BIGTIFF": "YES", "compress": "zstd"}),
    "big endian": (HEIGHT, {"tiled": True, "ENDIANNESS": "BIG"}),
    "cog": (HEIGHT, {"driver": "COG", "blocksize": 512, "compress": "lzw"}),
    "bands apart": (COLOUR, {"tiled": True, "interleave": "band"}),
    "rgb": (COLOUR, {"tiled": True, "interleave": "pixel", "compress": "deflate", "photometric": "RGB"}),
    "jpeg with a mask": (COLOUR, {"driver": "COG", "blocksize": 256, "compress": "jpeg"}),
    "holes": (HEIGHT, {"tiled": True, "SPARSE_OK": True, "nodata": 0.0}),
}


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with serve_open_data(tmp_path_factory.mktemp("server")) as known:
        yield known


@pytest.fixture(autouse=True)
def fresh(server, monkeypatch, tmp_path):
    server.requests.clear()
    server.faults.clear()
    for name, value in (server.env | {"TCPIPE_CACHE": str(tmp_path / "cache")}).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(https, "_PAUSES_S", (0.0, 0.0, None))


@pytest.fixture
def put(server, tmp_path):
    def put(name="tiles", layout="tiles"):
        values, profile = LAYOUTS[layout]
        if layout == "holes":
            values = np.where(np.arange(SIDE) % 512 < 256, HEIGHT, np.float32(0.0))
        mask = None
        if "mask" in layout:
            mask = np.full((SIDE, SIDE), 255, np.uint8)
            mask[720:800] = 0
        (tmp_path / "written").mkdir(exist_ok=True)
        return server.put(f"/{name}.tif", write(tmp_path / "written" / "a.tif", values, mask=mask, **profile))

    return put


def client(server, *hosts, most_bytes=10**9):
    return HttpsClient([server.host, *hosts], most_bytes=most_bytes)


def cut(of, url, path, *, box=BOX, crs="EPSG:2056"):
    with open_window(of, url, area(*box), crs=crs) as window:
        window.copy(path)
        return window


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_window_has_the_pixels_that_rasterio_reads_of_the_whole_file(server, put, tmp_path, layout):
    window = cut(client(server), put(layout=layout), tmp_path / "window.tif")
    with rasterio.open(tmp_path / "written" / "a.tif") as whole, rasterio.open(tmp_path / "window.tif") as part:
        wanted = Window(*BOX)
        assert np.array_equal(part.read(), whole.read(window=wanted))
        assert np.array_equal(part.dataset_mask() > 0, whole.dataset_mask(window=wanted) > 0)
        assert part.transform == Affine(0.5, 0, LEFT + 0.5 * BOX[0], 0, -0.5, TOP - 0.5 * BOX[1])
        for name in ("crs", "nodata", "dtypes", "scales", "offsets", "colorinterp"):
            assert getattr(part, name) == getattr(whole, name), name
        assert [unit or "" for unit in part.units] == [unit or "" for unit in whole.units]
        if layout == "jpeg with a mask":
            assert 0 < (part.dataset_mask() == 0).mean() < 1
    total = (tmp_path / "written" / "a.tif").stat().st_size
    fetched = sum(int(of[6:].split("-")[1]) - int(of[6:].split("-")[0]) + 1 for _, of in server.requests)
    assert window.to_read_bytes <= fetched
    assert fetched < 0.6 * total or total < 10**6 or layout == "raw"
    assert window.resolution == "0.5 metre"


def test_a_window_ends_where_the_raster_ends_and_is_none_beside_it(server, put, tmp_path):
    url = put()
    cut(client(server), url, tmp_path / "corner.tif", box=(SIDE - 30, -20, 100, 50))
    with rasterio.open(tmp_path / "corner.tif") as part:
        assert np.array_equal(part.read(), HEIGHT[:, :30, -30:])
    for nowhere, crs in ((area(2 * SIDE, 0, 50, 50), None), (shapely.box(-150.0, -40.0, -149.99, -39.99), "EPSG:2056")):
        with open_window(client(server), url, nowhere, crs=crs) as window:
            assert window is None


def test_nothing_but_the_head_is_read_before_the_pixels_are_wanted(server, put):
    url = put(layout="cog")
    with open_window(client(server), url, area(*BOX), crs=None) as window:
        assert [of for _, of in server.requests] == ["bytes=0-65535"]
        assert 100_000 < window.to_read_bytes < 3_000_000


PLACED = {"driver": "GTiff", "dtype": "uint8", "crs": "EPSG:2056", "transform": Affine(0.5, 0, LEFT, 0, -0.5, TOP)}


def test_a_palette_and_alpha_are_kept(server, tmp_path):
    index, path = COLOUR[0] % 4, tmp_path / "whole.tif"
    with rasterio.open(path, "w", count=1, height=SIDE, width=SIDE, **PLACED) as out:
        out.write_colormap(1, {0: (1, 2, 3, 255), 3: (9, 8, 7, 255)})
        out.write(index, 1)
    cut(client(server), server.put("/palette.tif", path.read_bytes()), tmp_path / "part.tif")
    with rasterio.open(tmp_path / "part.tif") as part:
        assert part.colormap(1)[3] == (9, 8, 7, 255)
        assert np.array_equal(part.read(1), index[700:1100, 600:900])
    with rasterio.open(path, "w", count=4, height=SIDE, width=SIDE, photometric="RGB", alpha="YES", **PLACED) as out:
        out.write(np.concatenate([COLOUR, COLOUR[:1]]))
    cut(client(server), server.put("/alpha.tif", path.read_bytes()), tmp_path / "part.tif")
    with rasterio.open(tmp_path / "part.tif") as part:
        assert part.colorinterp[3] == ColorInterp.alpha
        assert np.array_equal(part.read(4), COLOUR[0, 700:1100, 600:900])


def test_what_was_read_once_comes_from_the_cache(server, put, tmp_path):
    url = put(layout="cog")
    cut(client(server), url, tmp_path / "first.tif")
    server.requests.clear()
    cut(client(server), url, tmp_path / "second.tif")
    assert [of for _, of in server.requests] == ["bytes=0-65535"]
    assert (tmp_path / "second.tif").read_bytes() == (tmp_path / "first.tif").read_bytes()
    server.put("/tiles.tif", server.files["/tiles.tif"] + b"newer")
    server.requests.clear()
    cut(client(server), url, tmp_path / "third.tif")
    assert len(server.requests) > 1


def test_without_a_version_nothing_is_cached(server, put, tmp_path):
    url = put()
    server.faults["/tiles.tif"] = "unversioned"
    for _ in range(2):
        server.requests.clear()
        cut(client(server), url, tmp_path / "part.tif")
        assert len(server.requests) > 1
    assert not (tmp_path / "cache").exists()


def refuse(server, url, path, match, **how):
    with pytest.raises(MapError, match=match) as caught:
        cut(how.pop("of", client(server)), url, path, **how)
    assert len(caught.value.problems) == 1
    assert not path.exists() or path.stat().st_size  # a caller removes it
    return caught.value.problems[0]


@pytest.mark.parametrize(
    ("fault", "match"),
    [
        ("whole", "its server ignores ranges and sends the whole file; download it"),
        (404, r"tiles.tif: cannot be read \(HTTP Error 404: Not Found\)"),
        (401, "HTTP Error 401: Unauthorized"),
        (503, "cannot be read .HTTP Error 503: Service Unavailable."),
        ("cut", "ended after 32768 of 65536 bytes"),
        ("http://localhost/x.tif", "http://localhost/x.tif: expected an https:// URL"),
        ("https://other.example/x.tif", r"is on other.example, which the catalogue's entry does not name \(localhost:"),
        ("file:///etc/passwd", "file:///etc/passwd: expected an https:// URL"),
        ("https://127.0.0.1/x.tif", "is on 127.0.0.1, which the catalogue's entry does not name"),
        ("https://localhost@169.254.169.254/x", "does not name"),
        ([None, "changing"], r"asked for bytes \d+ to \d+, got \d+ .* run the command again"),
        ([None, "cut", "cut", "cut"], r"ended after \d+ of \d+ bytes"),
        ([None, 404], "HTTP Error 404"),
        ("https://[/x", "cannot be read .*Invalid IPv6 URL"),
    ],
)
def test_whatever_a_server_does_is_one_line(server, put, tmp_path, fault, match):
    url = put()
    server.faults["/tiles.tif"] = fault
    line = refuse(server, url, tmp_path / "part.tif", match)
    assert "https://" in line or "://" in str(fault)


def test_a_moment_of_trouble_is_passed_over_and_a_redirect_on_the_list_is_followed(server, put, tmp_path):
    url = put()
    server.faults["/tiles.tif"] = [503, "cut", None, 500]
    cut(client(server), url, tmp_path / "part.tif")
    server.put("/moved.tif", b"")
    server.faults["/moved.tif"] = url
    cut(client(server), server.url + "/moved.tif", tmp_path / "moved.tif")
    assert (tmp_path / "moved.tif").read_bytes() == (tmp_path / "part.tif").read_bytes()
    server.faults["/moved.tif"] = server.url + "/moved.tif"
    refuse(server, server.url + "/moved.tif", tmp_path / "x.tif", "HTTP Error 302")


def test_slow_servers_are_left(server, put, tmp_path, monkeypatch):
    url = put()
    server.faults["/tiles.tif"] = "slow"
    monkeypatch.setattr(https, "_REQUEST_S", 0.1)
    refuse(server, url, tmp_path / "part.tif", r"\d+ bytes in 0.1 s")
    monkeypatch.setattr(https, "_SILENT_S", 0.001)
    refuse(server, url, tmp_path / "part.tif", "timed out")


def test_a_certificate_that_nobody_vouches_for_is_refused_and_nothing_is_asked(server, put, tmp_path, monkeypatch):
    url = put()
    monkeypatch.delenv("SSL_CERT_FILE")
    refuse(server, url, tmp_path / "part.tif", "certificate verify failed")
    address = url.replace("localhost", "127.0.0.1")
    monkeypatch.setenv("SSL_CERT_FILE", server.env["SSL_CERT_FILE"])
    refuse(server, address, tmp_path / "part.tif", "certificate", of=client(server, f"127.0.0.1:{server.port}"))
    assert server.requests == []


def test_sizes_are_bounded(server, put, tmp_path, monkeypatch):
    url = put()
    refuse(
        server,
        url,
        tmp_path / "part.tif",
        "would be .* of 0.2 MB a command are left; name fewer runs",
        of=client(server, most_bytes=200_000),
    )
    monkeypatch.setattr(remote_geotiff, "_MOST_PIXELS", 1000)
    refuse(server, url, tmp_path / "part.tif", "300 x 400 pixels of 1 bands around the track, at most 1e")


def test_what_is_no_raster_or_is_elsewhere_is_refused(server, put, tmp_path):
    refuse(
        server,
        put(),
        tmp_path / "part.tif",
        "its CRS is 'CH1903.*the catalogue says EPSG:25832, which is elsewhere",
        crs="EPSG:25832",
    )
    head = server.files["/tiles.tif"]
    for name, content in (
        ("/page.tif", b"<html>" * 20_000),
        ("/short.tif", head[:300]),
        ("/empty.tif", b"II*\0"),
        ("/cut.tif", head[:70_000]),
    ):
        refuse(
            server, server.put(name, content), tmp_path / "part.tif", "not a GeoTIFF, or damaged|run the command again"
        )
    refuse(
        server,
        server.put("/vrt.tif", b'<VRTDataset rasterXSize="1" rasterYSize="1"/>' + b" " * 70_000),
        tmp_path / "x.tif",
        "not a GeoTIFF",
    )
    path = tmp_path / "nowhere.tif"
    with rasterio.open(
        path, "w", driver="GTiff", count=1, height=8, width=8, dtype="uint8", transform=Affine(1, 0, 5, 0, -1, 5)
    ):
        pass
    refuse(server, server.put("/nowhere.tif", path.read_bytes()), tmp_path / "part.tif", "has no georeference")


def test_a_raster_that_declares_huge_sizes_costs_little(server, tmp_path):
    path = tmp_path / "huge.tif"
    profile = {"tiled": True, "blockxsize": 512, "blockysize": 512, "SPARSE_OK": True, "BIGTIFF": "YES"}
    with rasterio.open(path, "w", count=1, height=400_000, width=400_000, **PLACED, **profile) as out:
        out.write(np.ones((1, 512, 512), np.uint8), window=Window(512, 512, 512, 512))
    cut(client(server, most_bytes=20_000_000), server.put("/huge.tif", path.read_bytes()), tmp_path / "part.tif")
    with rasterio.open(tmp_path / "part.tif") as part:
        assert part.read(1)[: 1024 - BOX[1]].mean() == 1.0


def test_a_full_disk_is_one_line(server, put, tmp_path, monkeypatch):
    class Full(io.BytesIO):
        def write(self, data):
            if self.tell() > 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            return super().write(data)

    monkeypatch.setattr(remote_geotiff.tempfile, "TemporaryFile", Full)
    with pytest.raises((StoreError, OSError), match="No space left"):
        cut(client(server), put(layout="cog"), tmp_path / "part.tif")
    assert not list(tmp_path.glob("cache/*/*"))
