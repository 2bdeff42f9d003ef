"""A dataset from several maps: every sample lies on exactly one of them, and shows the ground that is there."""

import numpy as np
import pyproj
import pytest
from map_worlds import write_tif
from rasterio import Affine
from stored_files import map_path
from synthetic_store import WORLD, add_run, lanes, segments

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError, MapError
from tcpipe.formats.dataset_files import read_card, read_samples
from tcpipe.formats.maps.building import build_map
from tcpipe.formats.maps.map_files import open_map
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe
from tcpipe.report.pictures import compute_joint_bounds_m, draw_maps
from tcpipe.store import open_store


def put_map(store, directory, name, first_m, last_m, *, layers=("height", "ortho", "terrain"), crs=None):
    """A map of the world between two eastings [m from its middle]."""
    directory = directory / name
    directory.mkdir()
    x, y = WORLD.centres(0.1)
    columns = slice(round((first_m + 20.0) / 0.1), round((last_m + 20.0) / 0.1))
    x, y = x[:, columns], y[:, columns]
    affine = Affine(0.1, 0.0, WORLD.x_m + first_m, 0.0, -0.1, WORLD.y_m + 20.0)
    values = {
        "height": WORLD.height(x, y).astype(np.float32),
        "ortho": np.rint(WORLD.grey(x, y)).astype(np.uint8),
        "terrain": WORLD.terrain(x, y).astype(np.uint8),
    }
    paths = {layer: write_tif(directory / f"{layer}.tif", values[layer][None], WORLD.crs, affine) for layer in layers}
    with store.new_map(name) as (path, put):
        build_map(path, name=name, crs=crs, **paths)
        put(store.scan())


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Lanes across two overlapping maps, the eastern one in a national CRS on another datum."""
    directory = tmp_path_factory.mktemp("maps")
    store = open_store(directory / "store", create=True)
    put_map(store, directory, "west", -20.0, 4.0)
    put_map(store, directory, "east", -4.0, 20.0, crs="EPSG:31256")
    put_map(store, directory, "bare", -20.0, 20.0, layers=("height",))
    start, end = lanes(np.arange(-14.0, 14.0, 4.0), -15.0, 15.0)
    add_run(store, "a", segments("a", start, end))
    return store


def build(store, out, names, **keywords):
    return build_dataset(out, store=store.root, map=names, recipe=Recipe(), **keywords)


@pytest.mark.parametrize("order", [("west", "east"), ("east", "west")])
def test_every_sample_lies_on_the_first_map_that_has_it_and_shows_the_world(store, tmp_path, order):
    result = build(store, tmp_path / "out", order)
    assert result.card.samples > 180
    samples = read_samples(tmp_path / "out")
    names, ids = np.array(samples["map"].to_pylist()), samples["sample_id"].to_pylist()
    assert len(set(ids)) == len(ids)
    to_map = pyproj.Transformer.from_crs(4326, WORLD.crs, always_xy=True)
    ends = [to_map.transform(samples[f"{e}_lon_deg"], samples[f"{e}_lat_deg"]) for e in ("start", "end")]
    (x0, y0), (x1, y1) = (np.array(end) for end in ends)
    middle = (x0 + x1) / 2.0 - WORLD.x_m
    assert (names[middle < -5.0] == "west").all()
    assert (names[middle > 5.0] == "east").all()
    assert (names[np.abs(middle) < 3.0] == order[0]).all()

    split = {name: open_dataset(tmp_path / "out")[name] for name in ("train", "test")}
    along, left = np.meshgrid((np.arange(40) + 0.5) / 40, 0.5 - (np.arange(40) + 0.5) / 40)
    for name, part in split.items():
        chosen = np.array(samples["split"].to_pylist()) == name
        dx, dy = (x1 - x0)[chosen, None, None], (y1 - y0)[chosen, None, None]
        x = x0[chosen, None, None] + along * dx - left * dy
        y = y0[chosen, None, None] + along * dy + left * dx
        height = WORLD.height(x, y)
        wanted = np.clip(height - height.min(axis=(1, 2), keepdims=True), 0.0, 1.0)
        assert np.abs(part.patches[..., 2] - wanted).max() < 0.003 + 4.0 * WORLD.bilinear_bound_m(0.1)
        assert np.abs(part.patches[..., 0] - WORLD.grey(x, y) / 255.0).max() < 0.01
    counts = {name: int((names == name).sum()) for name in order}
    assert min(counts.values()) > 60


@pytest.mark.parametrize("order", [("west", "east"), ("east", "west")])
def test_the_page_shows_all_maps_in_their_places(store, order):
    """Grey of the world at places of either map alone, in the CRS of the first; white outside both."""
    sources = [open_map(map_path(store.root, name)) for name in order]
    picture = draw_maps(sources)
    crs = sources[0].grid.crs
    x_min, y_min, x_max, y_max = compute_joint_bounds_m([(each.grid.crs, each.grid.bounds_m) for each in sources])
    xy = np.array([(x, y) for x in (-15.0, -8.0, 0.0, 8.0, 15.0) for y in (-12.0, 3.0, 14.0)])
    x, y = pyproj.Transformer.from_crs(WORLD.crs, crs, always_xy=True).transform(
        WORLD.x_m + xy[:, 0], WORLD.y_m + xy[:, 1]
    )
    cols = ((x - x_min) / (x_max - x_min) * picture.shape[1]).astype(int)
    rows = ((y_max - y) / (y_max - y_min) * picture.shape[0]).astype(int)
    wanted = WORLD.grey(WORLD.x_m + xy[:, 0], WORLD.y_m + xy[:, 1])
    found = picture[rows, cols].astype(float)
    assert (np.ptp(found, axis=1) == 0.0).all()  # as red as green as blue
    assert np.abs(found[:, 0] - wanted).max() < 12.0
    assert max(picture.shape) <= 901


def test_the_same_bytes_however_the_segments_are_cut_into_batches(store, tmp_path, monkeypatch):
    monkeypatch.setattr("tcpipe.pipeline.dataset.sampling._BATCH_ROWS", 37)
    build(store, tmp_path / "cut", ("west", "east"))
    monkeypatch.undo()
    build(store, tmp_path / "whole", ("west", "east"))
    assert read_card(tmp_path / "cut").checksums == read_card(tmp_path / "whole").checksums


def test_what_cannot_be_built_from_is_said_in_one_line(store, tmp_path):
    with pytest.raises(MapError, match="map bare: has height, but map west has height, ortho, terrain"):
        build(store, tmp_path / "out", ("west", "bare"))
    with pytest.raises(DatasetError, match="no map 'moon' in the store; there are bare, east, west"):
        build(store, tmp_path / "out", ("west", "moon"))
    with pytest.raises(DatasetError, match=r"3 maps in the store .*name one with --map, or several"):
        build(store, tmp_path / "out", None)
    assert not (tmp_path / "out").exists()
