"""Maps on disk open in xarray as they are, and what is no map says so."""

import json
import shutil

import numpy as np
import pyproj
import pytest
import xarray
from map_worlds import World
from stored_files import flip

from tcpipe.errors import MapError
from tcpipe.formats.integrity import compute_checksums, write_checksums
from tcpipe.formats.maps.building import build_map
from tcpipe.formats.maps.map_facts import MapFacts, MapInputs
from tcpipe.formats.maps.map_files import SHARD_PX, MapWriter, open_map
from tcpipe.formats.place import open_place
from tcpipe.formats.published_outputs import fetch_files
from tcpipe.terrain.layers import PAPER_SCHEME, make_paper_layers
from tcpipe.terrain.target_grid import MapGrid

FACTS = MapFacts(
    sources={},
    covered={},
    height_min_m=0.0,
    height_max_m=0.0,
    class_share={},
    classes_from="default",
    inputs=MapInputs(),
)
WORLD = World("EPSG:31256", -68_000.0, 215_000.0, side_m=20.0)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    directory = tmp_path_factory.mktemp("map")
    build_map(directory / "m.zarr", name="garden", **WORLD.write(directory, 0.1))
    return directory / "m.zarr"


def test_xarray_decodes_metres_grey_and_classes_with_coordinates(path):
    with xarray.open_zarr(path) as found:
        x, y = np.meshgrid(found.x, found.y)
        np.testing.assert_allclose(found.height, WORLD.height(x, y), atol=1e-4)
        np.testing.assert_allclose(255.0 * found.ortho, WORLD.grey(x, y), atol=0.51)
        np.testing.assert_array_equal(found.terrain, WORLD.terrain(x, y))
        assert pyproj.CRS(found.spatial_ref.attrs["crs_wkt"]) == pyproj.CRS(WORLD.crs)
        assert found.attrs["proj:code"] == WORLD.crs
        assert found.height.attrs["units"] == "m"
        assert found.terrain.attrs["flag_meanings"].split()[3:] == ["grass", "mud", "unpaved_road", "paved_road"]
        assert found.height.attrs["grid_mapping"] == "spatial_ref"


def test_overviews_are_maps_of_the_same_ground(path):
    source = open_map(path)
    assert source.factors == (1, 2, 4, 8)
    fine = source.height_reference_m + source.read("height", 0, 200, 0, 200).astype(float)
    classes = source.read("terrain", 0, 200, 0, 200)
    for factor in (2, 8):
        level = source.at(factor)
        count = 200 // factor
        assert (level.grid.rows, level.grid.pixel_size_m, level.layers) == (count, factor * 0.1, source.layers)
        cells = fine.reshape(count, factor, count, factor).mean(axis=(1, 3))
        found = level.height_reference_m + level.read("height", 0, count, 0, count).astype(float)
        np.testing.assert_allclose(found, cells, atol=2e-6)
        votes = [(classes == k).reshape(count, factor, count, factor).sum(axis=(1, 3)) for k in range(8)]
        np.testing.assert_array_equal(level.read("terrain", 0, count, 0, count), np.argmax(votes, axis=0))
        with xarray.open_zarr(path, group=f"overviews/{factor}") as decoded:
            np.testing.assert_allclose(decoded.height, cells, atol=2e-6)
            np.testing.assert_allclose(decoded.x, level.grid.xy_from_px(np.stack([np.arange(count)] * 2, 1))[:, 0])
            assert pyproj.CRS(decoded.spatial_ref.attrs["crs_wkt"]) == pyproj.CRS(WORLD.crs)


@pytest.fixture(scope="module")
def wide(tmp_path_factory):
    """A map of 25 tiles in four shards, and its heights."""
    path = tmp_path_factory.mktemp("wide") / "m.zarr"
    grid = MapGrid("EPSG:32633", 500_000.0, 5_200_000.0, 0.03, 2100, 2100)
    rng = np.random.default_rng(0)
    height, ids = rng.normal(600.0, 1.0, (2100, 2100)), rng.integers(1, 8, (2100, 2100)).astype(np.uint8)
    layers = make_paper_layers(("height", "terrain"), PAPER_SCHEME.table)
    writer = MapWriter(path, name="m", grid=grid, scheme=PAPER_SCHEME, layers=layers)
    for row in (0, SHARD_PX):
        for col in (0, SHARD_PX):
            for layer, values in (("height", height), ("terrain", ids)):
                writer.write(layer, row, col, values[row : row + SHARD_PX, col : col + SHARD_PX])
    writer.finish(FACTS, layers)
    write_checksums(path)
    return path, height


def test_overviews_across_shards_have_no_seam(wide):
    path, height = wide
    for factor in (2, 32):
        level, side = open_map(path).at(factor), 2100 // factor
        cells = height[: side * factor, : side * factor].reshape(side, factor, side, factor).mean(axis=(1, 3))
        found = level.height_reference_m + level.read("height", 0, side, 0, side).astype(float)
        np.testing.assert_allclose(found, cells, atol=1e-5)
        assert (level.read("terrain", 0, side, 0, side) > 0).all()


def test_of_a_map_in_a_bucket_the_tiles_that_are_read_are_fetched(wide, tmp_path, served):
    path, files = wide[0], tmp_path / "served" / "tests" / "m.zarr"
    shutil.copytree(path, files)
    checksums = {f"m.zarr/{name}": of for name, of in compute_checksums(path).items()}
    root, shards = fetch_files(open_place("s3://tests"), checksums, by_range=lambda name: "/c/" in name)
    here, there = open_map(path), open_map(root / "m.zarr", shards)
    opened, requests = served.sent_bytes, len(served)
    for layer in here.layers:  # of one tile
        np.testing.assert_array_equal(there.read(layer, 10, 500, 600, 1000), here.read(layer, 10, 500, 600, 1000))
    there.expect([(0, 1)])
    assert set(served[requests:]) == {f"m.zarr/{layer}/c/0/0" for layer in here.layers}
    assert len(served) - requests == 2 * len(here.layers)  # the index of a shard, and its tile
    whole = sum((files / layer / "c" / "0" / "0").stat().st_size for layer in here.layers)
    assert served.sent_bytes - opened < 0.1 * whole
    (files / "height" / "c" / "1" / "1").unlink()
    with pytest.raises(MapError, match=r"height, rows 2050 to 2090.*cannot be read.*is missing"):
        there.read("height", 2050, 2090, 2050, 2090)


def test_what_is_no_map_says_so(path, tmp_path):
    with pytest.raises(MapError, match=r"not a map, it has no zarr\.json"):
        open_map(tmp_path / "absent.zarr")
    with pytest.raises(MapError, match="not a map"):
        open_map(tmp_path)
    (tmp_path / "zarr.json").write_text(json.dumps({"zarr_format": 3, "node_type": "group", "attributes": {}}))
    with pytest.raises(MapError, match="not a map of this version"):
        open_map(tmp_path)


@pytest.mark.parametrize("layer", ["height", "ortho", "terrain"])
def test_one_flipped_byte_is_an_error_not_a_number(path, tmp_path, layer):
    copy = tmp_path / "copy.zarr"
    shutil.copytree(path, copy)
    shard = next(p for p in (copy / layer / "c").rglob("*") if p.is_file())
    flip(shard, 1 / 3)
    with pytest.raises(MapError, match=rf"{layer}, rows 0 to 200.*cannot be read"):
        open_map(copy).read(layer, 0, 200, 0, 200)


def test_a_layer_that_is_gone_is_named(path, tmp_path):
    copy = tmp_path / "copy.zarr"
    shutil.copytree(path, copy)
    shutil.rmtree(copy / "ortho")
    with pytest.raises(MapError, match=r"ortho/zarr.json: is missing.*add the map again"):
        open_map(copy)
    shutil.rmtree(copy)
    shutil.copytree(path, copy)
    shutil.rmtree(copy / "overviews" / "4")
    with pytest.raises(MapError, match=r"overviews/4/height/zarr.json: is missing, and 6 more.*add the map again"):
        open_map(copy)


def test_tiles_are_windows_and_hold_no_data_beyond_the_map(path):
    source = open_map(path)
    for level in (source, source.at(2)):
        for layer in level.layers:
            tile = np.full((level.tile_px, level.tile_px), 7, np.float32 if layer == "height" else np.uint8)
            level.read_tile(layer, 0, 0, tile)
            part = level.read(layer, 0, level.grid.rows, 0, level.grid.cols)
            np.testing.assert_array_equal(tile[: part.shape[0], : part.shape[1]], part)
            beyond = np.concatenate([tile[part.shape[0] :].ravel(), tile[:, part.shape[1] :].ravel()])
            assert np.isnan(beyond).all() if layer == "height" else not beyond.any()


@pytest.mark.parametrize(
    ("key", "value", "wanted"),
    [
        ("grid.rows", 10**9, "pixels"),
        ("grid.rows", -5, "pixels"),
        ("grid.cols", "wide", "expected a whole number"),
        ("tile_px", 0, "tiles and overviews"),
        ("factors", [1, 0], "tiles and overviews"),
    ],
)
def test_sizes_that_no_map_has_are_refused_before_a_tile_is_read(path, tmp_path, key, value, wanted):
    copy = tmp_path / "copy.zarr"
    shutil.copytree(path, copy)
    group = json.loads((copy / "zarr.json").read_text())
    kept, _, name = ("tcpipe_map." + key).rpartition(".")
    within = group["attributes"]
    for part in kept.split("."):
        within = within[part]
    within[name] = value
    (copy / "zarr.json").write_text(json.dumps(group))
    with pytest.raises(MapError, match=wanted):
        open_map(copy, proved=False)
