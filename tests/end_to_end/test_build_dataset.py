"""A dataset from a store with an analytic map: both formats hold what the world says, and other libraries read the same samples."""

import hashlib
import json

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pyproj
import pytest
import shapely
from synthetic_store import WORLD, box, lonlat, region_file, small_store

from tcpipe.dataset import open_dataset
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import DatasetConfig, Recipe
from tcpipe.tables.levels import DATA_MODEL_VERSION

REGION = box(-20, -20, 5, 20)
SPLITS = ("train", "test", "unseen", "buffer")
RECIPE = Recipe(dataset=DatasetConfig(name="hills", licence="CC-BY-4.0", creator="somebody"))

not_ours = pytest.mark.filterwarnings("ignore")
"""mlcroissant and the libraries under it warn of each other."""

UNLISTED = ("dataset.json", "report.html")  # a card cannot name itself, nor a page that is drawn from it


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    directory = tmp_path_factory.mktemp("build")
    store = small_store(directory)
    region = region_file(directory / "region.geojson", REGION)
    for name in ("zarr", "parquet"):
        build_dataset(directory / name, store=store.root, split=region, recipe=RECIPE, format=name)
    return directory, store, region


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


def test_rows_are_shuffled_and_labels_belong_to_their_place(built, samples):
    start, _ = ends_xy(samples)
    np.testing.assert_allclose(samples["power_watt"].to_numpy(), 150 + start[:, 0] - WORLD.x_m, atol=1e-6)
    x = start[:, 0]
    assert abs(np.corrcoef(x[:-1], x[1:])[0, 1]) < 0.2  # along a path it would be near 1


def test_both_formats_hold_the_same_rows_in_the_same_order(built, samples):
    zarr, parquet = (open_dataset(built[0] / name) for name in ("zarr", "parquet"))
    assert pq.read_table(built[0] / "parquet" / "samples.parquet").equals(samples)
    for name in SPLITS:
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

    directory, store, region = built
    monkeypatch.setattr(dataset_sampling, "_BATCH_ROWS", 150)
    build_dataset(tmp_path / "again", store=store.root, split=region, recipe=RECIPE, jobs=2)
    assert files(tmp_path / "again") == files(directory / "zarr")


@not_ours
@pytest.mark.parametrize("name", ["zarr", "parquet"])
def test_mlcroissant_finds_nothing_wrong_and_reads_every_sample(built, samples, name):
    mlc = pytest.importorskip("mlcroissant", reason="mlcroissant is not installed")
    dataset = mlc.Dataset(jsonld=str(built[0] / name / "croissant.json"))
    assert dataset.metadata.ctx.issues.errors == set()
    recommended = {problem.split('"')[1].rsplit("/", 1)[1] for problem in dataset.metadata.ctx.issues.warnings}
    assert recommended == {"citeAs", "datePublished"}  # what the recipe does not know
    rows = list(dataset.records(record_set="samples"))
    assert [row["samples/sample_id"].decode() for row in rows] == samples["sample_id"].to_pylist()
    assert [row["samples/split"].decode() for row in rows] == samples["split"].to_pylist()
    for column in ("power_watt", "velocity_mps", "start_ns", "terrain_class", "quality"):
        assert [row[f"samples/{column}"] for row in rows] == samples[column].to_pylist(), column


def test_the_croissant_document_says_where_patches_are_and_how_large(built):
    document = json.loads((built[0] / "parquet" / "croissant.json").read_text())
    assert (document["license"], document["creator"]["name"]) == ("CC-BY-4.0", "somebody")
    assert document["version"].startswith(f"{DATA_MODEL_VERSION}.0+")
    samples, patches = document["recordSet"]
    assert [field["name"] for field in patches["field"]] == ["sample_id", "split", "ortho", "terrain", "height"]
    assert {field.get("arrayShape") for field in patches["field"][2:]} == {"1600"}
    assert samples["key"] == {"@id": "samples/sample_id"}
    assert len(json.loads((built[0] / "zarr" / "croissant.json").read_text())["recordSet"]) == 1


def test_every_file_of_samples_tells_where_its_rows_lie(built, samples):
    ends = np.array([samples[f"{end}_{axis}_deg"].to_numpy() for end in ("start", "end") for axis in ("lon", "lat")])
    middle_deg = ends.reshape(2, 2, -1).mean(axis=0).T
    points = shapely.from_wkb(samples["geometry"].to_pylist())
    lonlat_deg = np.column_stack([shapely.get_x(points), shapely.get_y(points)])
    np.testing.assert_allclose(lonlat_deg, middle_deg, rtol=0, atol=1e-7)  # a centimetre
    for path in (built[0] / "zarr" / "samples.parquet", *sorted((built[0] / "parquet" / "data").glob("*.parquet"))):
        geo = json.loads(pq.read_schema(path).metadata[b"geo"])
        column = geo["columns"][geo["primary_column"]]
        assert (geo["version"], column["encoding"], column["geometry_types"]) == ("1.1.0", "WKB", ["Point"])
        there = shapely.from_wkb(pq.read_table(path, columns=["geometry"])["geometry"].to_pylist())
        assert column["bbox"] == shapely.total_bounds(there).tolist()
