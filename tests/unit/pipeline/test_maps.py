"""Adding maps to a store: once, again, otherwise, and with classes that all maps of a store share."""

import hashlib
import resource
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import rasterio
from map_worlds import World, write_tif
from rasterio import Affine
from stored_files import map_path, read_files

from tcpipe.errors import MapError, StoreError, UsageError
from tcpipe.formats.maps.map_files import open_map
from tcpipe.pipeline.maps import add_map
from tcpipe.pipeline.verify import verify
from tcpipe.store import Store

WORLD = World("EPSG:32633", 560_000.0, 5_215_000.0, side_m=12.0)
CLASSES = "value,id,name,traversable\n4,1,meadow,yes\n5,2,bog,yes\n6,3,gravel,yes\n7,3,gravel,yes\n"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return WORLD.write(tmp_path_factory.mktemp("site"), 0.2)


@pytest.fixture
def store(tmp_path):
    return tmp_path / "store"


def classes_file(tmp_path, text=CLASSES, name="c.csv"):
    (tmp_path / name).write_text(text)
    return tmp_path / name


def read_content(store):
    """All files of a store but the records of calls."""
    return {name: data for name, data in read_files(store).items() if not name.startswith("calls/")}


def refused(store, name, error=MapError, **given):
    """The lines that a call ends with, which leaves the store as it was; in a store that is there, it is recorded."""
    before = read_content(store)
    with pytest.raises(error) as caught:
        add_map(name, store=store, **given)
    assert read_content(store) == before
    if before:
        _, call = Store(store).scan().calls[0]
        assert (call.command, call.exit_code, call.message) == (
            "add-map",
            error.exit_code,
            "\n".join(caught.value.problems),
        )
    return caught.value.problems


def other_height(directory):
    corner = Affine(0.2, 0, 560_000, 0, -0.2, 5_215_000)
    return write_tif(directory / "h2.tif", np.ones((1, 60, 60), np.float32), WORLD.crs, corner)


def map_of(store, name="m"):
    return open_map(map_path(store, name))


def picture_of(store):
    opened = Store(store)
    return Path(opened.place.where(opened.scan().maps["m"].picture))


def test_a_second_identical_call_does_nothing_and_says_so_wherever_the_files_are(site, store, tmp_path):
    first = add_map("m", store=store, **site)
    assert first.status == "done"
    before = read_content(store)
    again = add_map("m", store=store, **site)
    assert again.status == "unchanged"
    assert "nothing to do" in str(again)
    assert (again.map, read_content(store)) == (first.map, before)
    (tmp_path / "copy.tif").write_bytes(site["height"].read_bytes())
    assert add_map("m", store=store, **site | {"height": tmp_path / "copy.tif"}).status == "unchanged"


def test_what_differs_is_named_and_needs_force(site, store, tmp_path):
    add_map("m", store=store, **site)
    line = refused(store, "m", height=site["height"], ortho=site["ortho"], crs="EPSG:32633")[0]
    assert "--terrain was given then, but is not now" in line
    assert "--crs is EPSG:32633, was not given" in line
    assert "--force" in line
    other = other_height(tmp_path)
    assert "height has another content (h2.tif)" in refused(store, "m", **{**site, "height": other})[0]
    assert add_map("m", store=store, height=other, force=True).status == "done"
    assert list(map_of(store).layers) == ["height"]


def test_what_lies_beside_a_raster_belongs_to_it(site, store, tmp_path):
    """A mask or an overview beside a raster changes what it says."""
    height = tmp_path / "h.tif"
    height.write_bytes(site["height"].read_bytes())
    add_map("m", store=store, height=height)
    statistics = "<PAMDataset><PAMRasterBand band='1'><NoDataValue>612</NoDataValue></PAMRasterBand></PAMDataset>"
    (tmp_path / "h.tif.aux.xml").write_text(statistics)
    assert "height has another content (h.tif.aux.xml)" in refused(store, "m", height=height)[0]


def test_the_first_map_with_classes_sets_the_stores_table(site, store, tmp_path):
    add_map("bare", store=store, height=site["height"])
    table = classes_file(tmp_path)
    add_map("one", store=store, height=site["height"], terrain=site["terrain"], classes=table)
    add_map("two", store=store, height=site["height"], terrain=site["terrain"])  # takes the store's, with its values
    one, two = map_of(store, "one"), map_of(store, "two")
    assert one.classes == two.classes
    assert [entry.name for entry in two.classes.classes] == ["meadow", "bog", "gravel"]
    np.testing.assert_array_equal(one.read("terrain", 0, 60, 0, 60), two.read("terrain", 0, 60, 0, 60))
    other_values = classes_file(tmp_path, CLASSES.replace("\n5,", "\n50,"), "v.csv")
    add_map("three", store=store, height=site["height"], terrain=site["terrain"], classes=other_values)
    assert map_of(store, "three").classes == one.classes


def test_classes_that_are_not_the_stores_are_refused_one_line_a_difference(site, store, tmp_path):
    add_map("one", store=store, **site, classes=classes_file(tmp_path))
    wrong = classes_file(tmp_path, CLASSES.replace("2,bog,yes", "2,bog,no") + "9,9,water,no\n", "w.csv")
    problems = refused(store, "two", **site, classes=wrong)
    assert "not the one of the store's other maps" in problems[0]
    assert [line.partition(": ")[2] for line in problems[1:]] == [
        "id 2 is bog (not traversable), but bog (traversable) in the other",
        "id 9 is water (not traversable), but nothing in the other",
    ]


def test_the_only_map_may_be_replaced_with_other_classes(site, store, tmp_path):
    add_map("one", store=store, **site)
    add_map("one", store=store, **site, classes=classes_file(tmp_path), force=True)
    assert map_of(store, "one").classes.count == 3


def test_a_map_that_cannot_be_read_is_replaced_by_force_and_asked_for_nothing(site, store, caplog):
    add_map("old", store=store, **site)
    (map_path(store, "old") / "zarr.json").write_text("{}")
    assert "--force" in refused(store, "old", **site)[-1]
    add_map("new", store=store, **site)
    assert "old cannot be read" in caplog.text
    assert add_map("old", store=store, **site, force=True).status == "done"


def test_a_disk_that_takes_no_more_leaves_the_store_as_it_was(site, store):
    """A limit on the size of files stands for a full disk: the write itself fails."""
    add_map("m", store=store, height=site["height"])
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        problems = refused(store, "m", StoreError, **site, force=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert problems == (f"{store / 'blobs/m.zarr'}: cannot be written (File too large)",)


def test_everything_wrong_with_the_files_is_said_at_once(site, store, tmp_path):
    problems = refused(
        store, "m", UsageError, height=tmp_path / "no.tif", terrain=site["terrain"], classes=tmp_path / "no.csv"
    )
    assert [line.rpartition("/")[2] for line in problems] == [
        "no.tif: there is no such file",
        "no.csv: there is no such file",
    ]


def test_a_quick_look_shows_the_orthophoto_and_is_restored(site, store):
    add_map("m", store=store, **site)
    picture = matplotlib.image.imread(picture_of(store))[..., :3]
    source = map_of(store)
    assert picture == pytest.approx(source.read("ortho", 0, 60, 0, 60)[..., None].repeat(3, axis=2) / 255.0, abs=0.005)
    before = picture_of(store).read_bytes()
    picture_of(store).unlink()
    assert [line.rpartition(": ")[2] for line in verify(store).problems] == ["is missing"]
    assert add_map("m", store=store, **site, force=True).status == "done"
    assert picture_of(store).read_bytes() == before
    assert verify(store).problems == ()


def test_a_quick_look_without_photo_is_a_relief_lit_from_the_north_west_and_small(store, tmp_path):
    """Light falls along (-1/2, 1/2, 1/√2) east, north, up; a bank of 45° facing west has the normal (-1, 0, 1)/√2."""
    height = np.zeros((1, 2000, 900), np.float32)
    height[0, :200] = np.nan
    height[0, 1000:] = np.arange(900) * 0.2
    path = write_tif(tmp_path / "h.tif", height, WORLD.crs, Affine(0.2, 0, 560_000, 0, -0.2, 5_215_000))
    add_map("m", store=store, height=path)
    picture = matplotlib.image.imread(picture_of(store))[..., 0]
    assert picture.shape == (500, 225)
    assert (picture[:49] == 1.0).all()
    assert picture[150, 50] == pytest.approx(np.sqrt(0.5), abs=0.01)
    assert picture[400, 50] == pytest.approx((0.5 + np.sqrt(0.5)) / np.sqrt(2.0), abs=0.01)


def halves(site, directory):
    """West and east half of the site's height, each in a folder of its own under one name, and the map that they make."""
    with rasterio.open(site["height"]) as dataset:
        values, affine = dataset.read(), dataset.transform
    for name, first in (("east", 30), ("west", 0)):
        (directory / name).mkdir()
        at = Affine(0.2, 0, affine.c + 0.2 * first, 0, -0.2, affine.f)
        write_tif(directory / name / "dem.tif", values[:, :, first : first + 30], WORLD.crs, at)


def test_tiles_come_as_patterns_and_each_is_known_by_its_content(site, store, tmp_path):
    halves(site, tmp_path)
    added = add_map("m", store=store, height=str(tmp_path / "*/dem.tif"))
    add_map("whole", store=store, height=site["height"])
    tiled, whole = map_of(store), map_of(store, "whole")
    np.testing.assert_array_equal(tiled.read("height", 0, 60, 0, 60), whole.read("height", 0, 60, 0, 60))
    files = [tmp_path / "east/dem.tif", tmp_path / "west/dem.tif"]
    hashes = [hashlib.sha256(path.read_bytes()).hexdigest() for path in files]
    assert tiled.facts.inputs.files["height"] == dict(zip(("east/dem.tif", "west/dem.tif"), hashes, strict=True))
    assert "from dem.tif … dem.tif (2 files): 6" in str(added)
    assert add_map("m", store=store, height=files).status == "unchanged"
    assert "the files of height come in another order" in refused(store, "m", height=files[::-1])[0]
    assert "height has another content" in refused(store, "m", height=files[0])[0]


def test_what_names_no_file_is_said(site, store, tmp_path):
    given = {"height": [tmp_path, "https://x.org/dem.tif", "/vsicurl/x.tif"], "ortho": str(tmp_path / "*.jpg")}
    assert refused(store, "m", UsageError, **given) == (
        f"{tmp_path}: is a directory, expected its files: '{tmp_path}/*.tif'",
        "https://x.org/dem.tif: is an address, expected a file on this machine: rio convert https://x.org/dem.tif local.tif",
        "/vsicurl/x.tif: is an address, expected a file on this machine: rio convert /vsicurl/x.tif local.tif",
        f"{tmp_path}/*.jpg: no file matches",
    )
