"""Maps from a catalogue of open data, by the command: the newest rasters around a track, and nothing of them when something fails."""

import json
import shutil

import numpy as np
import pyproj
import pytest
from installed_command import plain_lines, tcpipe
from map_worlds import write_tif
from open_data_server import serve_open_data
from rasterio import Affine
from synthetic_store import WORLD, add_run, driven, lanes, segments

from tcpipe.errors import UsageError
from tcpipe.formats import https
from tcpipe.formats.maps import open_data
from tcpipe.formats.maps.map_files import open_map
from tcpipe.formats.maps.open_data import find_catalogue
from tcpipe.store import open_store

PX, HALF = 0.25, 100.0
GEOTIFF = "image/tiff; application=geotiff; profile=cloud-optimized"


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with serve_open_data(tmp_path_factory.mktemp("server")) as known:
        yield known


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A store with one run of 8 m from west to east through the middle of the world."""
    store = open_store(tmp_path_factory.mktemp("stored") / "store", create=True)
    table = segments("drive", *lanes(0.0, -4.0, 4.0))
    add_run(store, "drive", table, track=driven(table))
    return store.root


def raster(tmp_path, x0, x1, *, raised_m=0.0, bands=1):
    """A raster from x0 to x1 and 100 m to the north and south of the middle [m]; heights are raised."""
    x, y = np.meshgrid(np.arange(x0 + PX / 2, x1, PX), np.arange(HALF - PX / 2, -HALF, -PX))
    height = (WORLD.height(x + WORLD.x_m, y + WORLD.y_m) + raised_m).astype(np.float32)[None]
    grey = np.rint(WORLD.grey(x + WORLD.x_m, y + WORLD.y_m)).astype(np.uint8)
    corner = Affine(PX, 0, WORLD.x_m + x0, 0, -PX, WORLD.y_m + HALF)
    values = height if bands == 1 else np.stack([grey] * 3)
    layout = {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate"}
    return write_tif(tmp_path / "raster.tif", values, WORLD.crs, corner, **layout).read_bytes()


def item(name, date, x0, x1, url, **asset):
    to_lonlat = pyproj.Transformer.from_crs(WORLD.crs, 4326, always_xy=True)
    corners = [(x0, -HALF), (x1, -HALF), (x1, HALF), (x0, HALF), (x0, -HALF)]
    ring = [to_lonlat.transform(WORLD.x_m + x, WORLD.y_m + y) for x, y in corners]
    about = {"href": url, "type": GEOTIFF, "gsd": PX, "proj:epsg": 32633} | asset
    return {
        "type": "Feature",
        "id": name,
        "properties": {"datetime": date},
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "assets": {f"{name}.tif": {of: value for of, value in about.items() if value is not None}},
        "links": [],
    }


@pytest.fixture
def site(server, stored, tmp_path, monkeypatch):
    """A catalogue of heights in two tiles, surveyed twice in the west, and one orthophoto; what it is asked with."""
    monkeypatch.setattr(https, "_PAUSES_S", (0.0, None))
    server.requests.clear()
    server.faults.clear()
    server.files.clear()
    put = server.put
    old_west = put("/f/old_west.tif", raster(tmp_path, -100, 0))
    old_east = put("/f/old_east.tif", raster(tmp_path, 0, 100))
    new_west = put("/f/new_west.tif", raster(tmp_path, -100, 0, raised_m=5.0))
    photo = put("/f/photo.tif", raster(tmp_path, -100, 100, bands=3))
    coarse = {"coarse.tif": {"href": server.url + "/f/none.tif", "type": GEOTIFF, "gsd": 2.0}}
    table = {"points.zip": {"href": server.url + "/f/none.zip", "type": "application/x.ascii-xyz+zip"}}
    west = item("old_west", "2019-05-01T00:00:00Z", -100, 0, old_west)
    west["assets"] = {**coarse, **table, **west["assets"]}
    first = [item("new_west", "2024-06-01T00:00:00Z", -100, 0, new_west, **{"file:checksum": "1220ab"}), west]
    second = [item("old_east", "2019-05-01T00:00:00Z", 0, 100, old_east, gsd=None, **{"proj:epsg": None})]
    second += [item("far", "2025-01-01T00:00:00Z", 5000, 5100, server.url + "/f/none.tif")]
    put(
        "/stac/collections/dem/items",
        {"features": first, "links": [{"rel": "next", "href": server.url + "/stac/more"}]},
    )
    put("/stac/more", {"features": second, "links": []})
    put("/stac/collections/ortho/items", {"features": [item("photo", None, -100, 100, photo)]})
    return Site(server, stored, tmp_path)


class Site:
    """A catalogue, a store, and commands that bring them together."""

    def __init__(self, server, stored, path):
        self.server, self.path, self.store = server, path, path / "store"
        self.stored = stored
        self.env = server.env | {"TCPIPE_CACHE": str(path / "cache")}
        self.entry = path / "catalogue.toml"
        self.write_entry()

    def write_entry(self, more=""):
        self.entry.write_text(
            f'stac = "{self.server.url}/stac"\nlicence = "CC0: https://example.org/licence"\n{more}\n'
            '[collections.dem]\nlayer = "height"\nvertical_datum = "LN02 (EPSG:5728)"\n[collections.ortho]\nlayer = "ortho"\n'
        )

    def run(self, *more, around=("--around", "drive")):
        if not self.store.exists():
            shutil.copytree(self.stored, self.store)
        given = ("add-map", "site", "--store", self.store, "--stac", self.entry, *around, "--margin", "15", *more)
        return tcpipe(*given, cwd=self.path, env=self.env)


def test_a_dry_run_says_what_would_be_taken_and_reads_no_pixel(site):
    done = site.run("--dry-run")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("height   2019-05-01, 0.25 metre, ")
    assert lines[0].endswith(f"{site.server.url}/f/old_east.tif (heights above LN02 (EPSG:5728))")
    assert lines[1].startswith("height   2024-06-01")
    assert "/f/new_west.tif" in lines[1]
    assert lines[2].startswith("ortho    no date, 0.25 metre")
    assert lines[3] == "licence: CC0: https://example.org/licence"
    assert lines[4].endswith("MB to read, less what is in the cache")
    assert "covers" not in done.stderr
    assert {name for name, of in site.server.requests if of} == {"/f/old_east.tif", "/f/new_west.tif", "/f/photo.tif"}
    assert "site" not in open_store(site.store).maps()
    assert site.run("--dry-run", "--json").returncode == 0  # and keeps its contract


def test_a_map_is_of_the_newest_heights_around_the_track(site):
    done = site.run("--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)["map"]
    assert said["crs"] == WORLD.crs
    west, south, east, north = said["bounds_m"]
    assert west == pytest.approx(WORLD.x_m - 4 - 15, abs=1.0)
    assert east == pytest.approx(WORLD.x_m + 4 + 15, abs=1.0)
    assert north - south == pytest.approx(30.0, abs=1.0)
    assert {(of["layer"], of["item"], of["date"][:4]) for of in said["origins"]} == {
        ("height", "new_west", "2024"),
        ("height", "old_east", "2019"),
        ("ortho", "photo", ""),
    }
    newest = next(of for of in said["origins"] if of["item"] == "new_west")
    assert newest["checksum"] == "1220ab"
    assert newest["vertical_datum"] == "LN02 (EPSG:5728)"
    assert len(said["inputs"]["files"]["height"]) == 2
    store = open_store(site.store)
    found = open_map(*store.map_files("site"))
    x = west + (np.arange(found.grid.cols) + 0.5) * PX
    y = north - (np.arange(found.grid.rows) + 0.5) * PX
    wanted = WORLD.height(*np.meshgrid(x, y)) + np.where(x < WORLD.x_m, 5.0, 0.0)
    assert np.abs(found.read("height", 0, len(y), 0, len(x)) - wanted + found.height_reference_m).max() < 1e-3
    inspected = tcpipe("inspect", store.map_files("site")[0], cwd=site.path)
    assert "2024-06-01, 0.25 metre" in inspected.stdout
    assert "licence: CC0" in inspected.stdout


@pytest.mark.parametrize("is_redacted", [False, True])
def test_the_licence_goes_with_every_card_of_a_dataset(site, is_redacted):
    assert site.run().returncode == 0
    done = tcpipe(
        "build-dataset", "built", "--store", site.store, *(["--redact"] if is_redacted else []), cwd=site.path
    )
    assert done.returncode == 0, done.stderr
    credit = "CC0: https://example.org/licence"
    hub, croissant, card = (
        (site.path / "built" / name).read_text() for name in ("README.md", "croissant.json", "dataset.json")
    )
    assert f"Open data in the layers height, ortho: {credit}" in hub
    assert json.loads(croissant)["creditText"] == f"height, ortho: {credit}"
    (made_of,) = json.loads(card)["maps"]
    urls = {of.get("url", "").rpartition("/")[2] for of in made_of["origins"]}
    assert urls == ({""} if is_redacted else {"old_east.tif", "new_west.tif", "photo.tif"})
    assert (site.server.url in hub + croissant + card) is not is_redacted


def test_the_same_call_again_reads_no_pixel_and_a_newer_survey_needs_force(site):
    assert site.run().returncode == 0
    site.server.requests.clear()
    again = site.run()
    assert "nothing to do" in again.stdout
    assert (
        sum(int(of.split("-")[1]) - int(of[6:].split("-")[0]) for _, of in site.server.requests if of) < 7 * 65_536
    )  # heads
    site.server.put(
        "/stac/more", {"features": [item("newer", "2026-01-01", -100, 100, site.server.url + "/f/whole.tif")]}
    )
    site.server.put("/f/whole.tif", raster(site.path, -100, 100))
    line = plain_lines(site.run(), 1)
    assert "made from something else" in line
    assert "--force" in line
    assert site.run("--force").returncode == 0
    assert [of.item for of in open_map(*open_store(site.store).map_files("site")).facts.origins] == ["newer", "photo"]


def test_a_failed_command_leaves_no_map_and_goes_on_from_the_cache(site):
    site.server.faults["/f/photo.tif"] = 404
    line = plain_lines(site.run(), 1, most=1)
    assert "/f/photo.tif: cannot be read (HTTP Error 404: Not Found)" in line
    assert open_store(site.store).maps() == []
    before = len(site.server.sent("/f/new_west.tif"))
    del site.server.faults["/f/photo.tif"]
    assert site.run().returncode == 0
    assert len(site.server.sent("/f/new_west.tif")) - before <= 2  # its head; its directory is at its end


def test_ground_without_data_is_told(site):
    site.server.put("/stac/more", {"features": []})
    done = site.run("--dry-run")
    assert "dem covers 50" in done.stderr
    assert "of the ground around the tracks" in done.stderr


def test_layers_of_ones_own_go_with_those_of_a_catalogue(site):
    own = site.path / "own.tif"
    own.write_bytes(site.server.files["/f/old_east.tif"])
    assert site.run("--collections", "ortho", "--height", own).returncode == 0
    found = open_map(*open_store(site.store).map_files("site"))
    assert set(found.layers) >= {"height", "ortho"}
    assert [of.layer for of in found.facts.origins] == ["ortho"]


def features(*items, **more):
    return {"features": list(items)} | more


def test_whatever_a_catalogue_replies_is_one_line_and_no_map(site, monkeypatch):
    here, dem = site.server.url, "/stac/collections/dem/items"
    good = item("new_west", "2024-06-01", -100, 100, here + "/f/new_west.tif")
    away = item("away", "2024-06-01", -100, 100, "https://elsewhere.example/x.tif?sig=SECRET")
    two = item("two", "2024-06-01", -100, 100, here + "/f/new_west.tif", gsd=None)
    two["assets"]["other.tif"] = two["assets"]["two.tif"]
    site.server.put("/f/far.tif", raster(site.path, 60, 100))
    monkeypatch.setattr(open_data, "_MOST_PAGES", 3)
    for reply, wanted in (
        (b"<html>", "expected GeoJSON of STAC items"),
        (b"[1]", "expected GeoJSON of STAC items"),
        ({"message": "no"}, r"expected GeoJSON of STAC items, got something else (KeyError: 'features')"),
        (features({"id": 1}), "expected GeoJSON of STAC items"),
        (features(good | {"geometry": None}), "expected GeoJSON of STAC items"),
        (features(), "no item with a GeoTIFF around the tracks; dem may not cover the site"),
        (features(good | {"assets": {}}), "no item with a GeoTIFF"),
        (features(good, links=[{"rel": "next", "href": dem}]), "more than 3 pages"),
        (features(good, links=[{"rel": "next", "href": "http://localhost/x"}]), "expected an https:// URL"),
        (features(good, links=[{"rel": "next", "href": "https://169.254.169.254/x"}]), "is on 169.254.169.254, which"),
        (
            features(away),
            "https://elsewhere.example/x.tif: is on elsewhere.example, which the catalogue's entry does not name",
        ),
        (features(two), "item two has the GeoTIFFs two.tif, other.tif, and does not tell which is finest (gsd)"),
        (
            features(item("crs", "2024", -100, 100, here + "/f/new_west.tif", **{"proj:epsg": 25832})),
            "which is elsewhere",
        ),
        (
            features(item("crs", "2024", -100, 100, here + "/f/new_west.tif", **{"proj:code": "EPSG:no"})),
            "is not a CRS",
        ),
        (features(item("photo", "2024", -100, 100, here + "/f/photo.tif")), "height has 3 bands"),
        (features(item("moved", "2024", -100, 100, here + "/f/far.tif")), "no raster has a pixel around the tracks"),
    ):
        site.server.put(dem, reply)
        line = plain_lines(site.run(), 1, most=1)
        assert wanted in line
        assert "SECRET" not in line
        assert open_store(site.store).maps() == []
    site.server.faults[dem] = 500
    assert "HTTP Error 500" in plain_lines(site.run(), 1, most=1)


def test_what_is_asked_wrongly_is_one_line(site):
    for more, around, wanted in (
        ((), (), "--around RUN"),
        ((), ("--around", "nobody"), "--around nobody: no finished run of that name"),
        (("--collections", "lidar"), None, "--collections lidar: not in the catalogue's entry (dem, ortho)"),
        (("--height", __file__), None, "--height and dem both give height"),
        (("--stac", "atlantis"), None, "--stac atlantis: not known (known: swisstopo)"),
        (("--stac", "https://unknown.example/stac"), None, "describe it in a TOML file"),
        (("--collections", "ortho"), None, "no height raster; give --height FILE"),
    ):
        done = site.run(*more, around=around if around is not None else ("--around", "drive"))
        assert wanted in plain_lines(done, 2, most=1)
    done = tcpipe("add-map", "x", "--height", "a.tif", "--dry-run", "--store", site.store, cwd=site.path)
    assert "--stac" in plain_lines(done, 2, most=1)
    for text, wanted in (
        ('licence = "x"\ncollections = {}\n', "stac is missing"),
        ("stac = ", "cannot be read as TOML"),
        (
            'stac = "https://x.example"\nlicence = "x"\n[collections.dem]\nlayer = "heigth"\n',
            'collections.dem.layer is "heigth"; expected one of height, ortho',
        ),
    ):
        site.entry.write_text(text)
        assert wanted in plain_lines(site.run(), 2, most=2)


def test_hosts_are_those_of_the_entry(site):
    site.write_entry('hosts = ["elsewhere.example"]')
    reply = features(item("x", "2024", -100, 100, "https://elsewhere.example:444/x.tif"))
    site.server.put("/stac/collections/dem/items", reply)
    assert "is on elsewhere.example:444, which" in plain_lines(site.run(), 1, most=1)


def test_the_catalogue_that_comes_with_tcpipe_is_known_by_name_and_url():
    found = find_catalogue("swisstopo")
    assert find_catalogue(found.stac + "/") == found
    assert {of.layer for of in found.collections.values()} == {"height", "ortho"}
    with pytest.raises(UsageError, match="swisstopo"):
        find_catalogue("swissto")
