"""A dataset from a store with an analytic map: what is on disk is what the world says, in both formats, whatever the jobs."""

import hashlib
import json
import warnings

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pyproj
import pytest
import shapely
from synthetic_store import WORLD, box, lonlat, region_file, small_store

from tcpipe.dataset import open_dataset
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe

REGION = box(-20, -20, 5, 20)
UNLISTED = ("dataset.json", "report.html")  # a card cannot name itself, nor a page that is drawn from it


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    directory = tmp_path_factory.mktemp("build")
    store = small_store(directory)
    region = region_file(directory / "region.geojson", REGION)
    results = {
        name: build_dataset(directory / name, store=store.root, split=region, recipe=Recipe(), file_format=name)
        for name in ("zarr", "parquet")
    }
    return directory, store, region, results


@pytest.fixture(scope="module")
def samples(built):
    return pq.read_table(built[0] / "zarr" / "samples.parquet")


def files(directory):
    return {
        path.relative_to(directory).as_posix(): path.read_bytes() for path in directory.rglob("*") if path.is_file()
    }


def ends_xy(samples):
    """Ends of the chords in the map's CRS, by PROJ itself, shape (N, 2) each."""
    project = pyproj.Transformer.from_crs(4326, WORLD.crs, always_xy=True)
    return [
        np.column_stack(project.transform(*(samples[f"{end}_{axis}_deg"].to_numpy() for axis in ("lon", "lat"))))
        for end in ("start", "end")
    ]


def test_patches_show_the_world_at_their_own_pixel_centres(built, samples):
    start, end = ends_xy(samples)
    offset = (np.arange(40) + 0.5) / 40
    forward = end - start
    left = np.column_stack([-forward[:, 1], forward[:, 0]])
    along, across = np.meshgrid(offset, 0.5 - offset)  # column along travel, row 0 on the left
    xy = start[:, None, None] + along[..., None] * forward[:, None, None] + across[..., None] * left[:, None, None]
    x, y = xy[..., 0], xy[..., 1]
    import xarray

    patches = xarray.open_zarr(built[0] / "zarr" / "patches.zarr").load()
    assert patches.sample_id.values.tolist() == samples["sample_id"].to_pylist()
    height = patches.height.values + samples["height_min_m"].to_numpy()[:, None, None]
    assert np.abs(height - WORLD.height(x, y)).max() < 0.001 + WORLD.bilinear_bound_m(0.1)
    assert np.abs(patches.ortho.values * 255 - WORLD.grey(x, y)).max() < 1.5
    assert (patches.terrain.values == WORLD.terrain(x, y)).mean() > 0.98
    assert patches.terrain.attrs["flag_meanings"].split()[3:] == ["grass", "mud", "unpaved_road", "paved_road"]


def test_every_footprint_is_where_its_split_says(samples):
    start, end = ends_xy(samples)
    left = np.column_stack([start[:, 1] - end[:, 1], end[:, 0] - start[:, 0]]) / 2
    squares = shapely.polygons(np.stack([start + left, start - left, end - left, end + left], axis=1))
    region = shapely.Polygon(np.add(REGION, (WORLD.x_m, WORLD.y_m)))
    split = samples["split"].to_numpy()
    inside = np.isin(split, ("train", "test"))
    assert shapely.covers(region, squares[inside]).all()
    assert shapely.disjoint(region, squares[split == "unseen"]).all()
    distance = shapely.distance(region.boundary, squares)
    assert distance[split != "buffer"].min() >= np.sqrt(2) - 1e-3
    assert distance[split == "buffer"].max() < np.sqrt(2) + 1e-3
    assert {name: int((split == name).sum()) for name in np.unique(split)} == {
        "train": 221,
        "test": 51,
        "unseen": 112,
        "buffer": 64,
    }


def test_test_is_whole_blocks_near_a_fifth(samples):
    split = samples["split"].to_numpy()
    inside = np.isin(split, ("train", "test"))
    start, end = ends_xy(samples)
    blocks = np.floor((start + end)[inside] / 2 / 10.0).astype(int)
    test = split[inside] == "test"
    held = {tuple(block) for block in blocks[test]}
    assert held
    assert held.isdisjoint({tuple(block) for block in blocks[~test]})
    assert 0.1 < test.mean() < 0.3


def test_rows_are_shuffled_and_labels_belong_to_their_place(built, samples):
    start, _ = ends_xy(samples)
    np.testing.assert_allclose(samples["power_watt"].to_numpy(), 150 + start[:, 0] - WORLD.x_m, atol=1e-6)
    x = start[:, 0]
    assert abs(np.corrcoef(x[:-1], x[1:])[0, 1]) < 0.2  # along a path it would be near 1


def test_both_formats_hold_the_same_rows_in_the_same_order(built, samples):
    zarr, parquet = (open_dataset(built[0] / name) for name in ("zarr", "parquet"))
    assert pq.read_table(built[0] / "parquet" / "samples.parquet").equals(samples)
    for name in ("train", "test", "unseen", "buffer"):
        assert zarr[name].samples.equals(parquet[name].samples)
        np.testing.assert_array_equal(zarr[name].patches, parquet[name].patches)
        np.testing.assert_array_equal(zarr[name].labels, parquet[name].labels)
        shard = pl.read_parquet(built[0] / "parquet" / "data" / f"{name}-*.parquet")
        assert shard["sample_id"].to_list() == zarr[name].samples["sample_id"].to_pylist()
        assert shard["height"].dtype == pl.Array(pl.UInt16, 1600)
        layers = zarr[name].layers(np.arange(len(zarr[name])))
        np.testing.assert_array_equal(shard["terrain"].to_numpy(), layers["terrain"].reshape(-1, 1600))


def test_the_card_tells_the_truth(built, samples):
    directory = built[0] / "zarr"
    card = json.loads((directory / "dataset.json").read_text())
    on_disk = {name: data for name, data in files(directory).items() if name not in UNLISTED}
    assert {name: entry["sha256"] for name, entry in card["checksums"].items()} == {
        name: hashlib.sha256(data).hexdigest() for name, data in on_disk.items()
    }
    train = samples.filter(np.array(samples["split"].to_numpy() == "train"))
    power = train["power_watt"].to_numpy()
    statistics = card["label_statistics_of_train"]["power_watt"]
    assert (statistics["count"], statistics["max"]) == (221, power.max())
    assert statistics["mean"] == pytest.approx(power.mean())
    assert card["label"]["columns"] == ["power_watt", "velocity_mps"]
    assert sum(sum(counts.values()) for counts in card["terrain"].values()) == 448
    assert sum(card["distance_by_reason_m"].values()) == pytest.approx(448 + 2 * 2.5)
    assert card["distance_by_reason_m"]["split_buffer"] == pytest.approx(64)
    assert [run["run_id"] for run in card["runs"]] == ["north", "south"]
    assert card["runs"][0]["logs"] == ["north.mcap"]
    assert card["split"]["buffer_m"] == pytest.approx(np.sqrt(2))
    region = shapely.geometry.shape(card["split"]["region"]["train_test"])
    assert region.equals_exact(shapely.Polygon(lonlat(REGION)), 1e-12, normalize=True)


def test_croissant_names_every_file_and_column(built, samples):
    document = json.loads((built[0] / "zarr" / "croissant.json").read_text())
    assert document["conformsTo"] == "http://mlcommons.org/croissant/1.1"
    listed = {entry["contentUrl"]: entry["sha256"] for entry in document["distribution"]}
    on_disk = files(built[0] / "zarr")
    assert set(listed) == set(on_disk) - {*UNLISTED, "croissant.json"}
    assert listed["samples.parquet"] == hashlib.sha256(on_disk["samples.parquet"]).hexdigest()
    fields = {field["name"]: field for field in document["recordSet"][0]["field"]}
    assert list(fields) == [name for name in samples.column_names if name != "geometry"]  # it has no type for it
    assert fields["power_watt"]["dataType"] == "sc:Float"
    assert fields["power_watt"]["source"]["fileObject"]["@id"] == "samples.parquet"


def test_the_same_bytes_whatever_the_jobs_and_whatever_the_batches(built, tmp_path, monkeypatch):
    from tcpipe.pipeline.dataset import sampling as dataset_sampling

    directory, store, region, _ = built
    monkeypatch.setattr(dataset_sampling, "_BATCH_ROWS", 150)
    build_dataset(tmp_path / "again", store=store.root, split=region, recipe=Recipe(), jobs=2)
    assert files(tmp_path / "again") == files(directory / "zarr")


def test_a_second_identical_call_does_nothing_and_says_so(built):
    directory, store, region, results = built
    before = {path: path.stat().st_mtime_ns for path in (directory / "zarr").rglob("*")}
    again = build_dataset(directory / "zarr", store=store.root, split=region, recipe=Recipe())
    assert again.status == "unchanged"
    assert "nothing to do" in str(again)
    assert again.card.splits == results["zarr"].card.splits
    assert {path: path.stat().st_mtime_ns for path in (directory / "zarr").rglob("*")} == before


def test_xarray_opens_the_patches_without_a_warning(built):
    import xarray

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        patches = xarray.open_zarr(built[0] / "zarr" / "patches.zarr")
    assert dict(patches.sizes) == {"sample": 448, "row": 40, "column": 40}
    assert patches.height.attrs["units"] == "m"
    assert patches.height.encoding["scale_factor"] == 0.0005
