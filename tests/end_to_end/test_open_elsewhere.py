"""A dataset opened by other libraries, where they are installed: each sees the same samples, in the same order, with the same split."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from synthetic_store import box, region_file, small_store

from tcpipe.dataset import open_dataset
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import DatasetConfig, Recipe
from tcpipe.store import open_store
from tcpipe.tables.levels import DATA_MODEL_VERSION

not_ours = pytest.mark.filterwarnings("ignore")
"""mlcroissant and the libraries under it warn of each other."""

SPLITS = ("train", "test", "unseen", "buffer")


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    directory = tmp_path_factory.mktemp("elsewhere")
    store = small_store(directory)
    region = region_file(directory / "region.geojson", box(-20, -20, 5, 20))
    recipe = Recipe(dataset=DatasetConfig(name="hills", licence="CC-BY-4.0", creator="somebody"))
    for name in ("zarr", "parquet"):
        build_dataset(directory / name, store=store.root, split=region, recipe=recipe, file_format=name)
    return directory


@pytest.fixture(scope="module")
def samples(built):
    return pq.read_table(built / "zarr" / "samples.parquet")


def shards(built, split):
    return str(built / "parquet" / "data" / f"{split}-*.parquet")


@not_ours
@pytest.mark.parametrize("name", ["zarr", "parquet"])
def test_mlcroissant_finds_nothing_wrong_and_reads_every_sample(built, samples, name):
    mlc = pytest.importorskip("mlcroissant", reason="mlcroissant is not installed")
    dataset = mlc.Dataset(jsonld=str(built / name / "croissant.json"))
    assert dataset.metadata.ctx.issues.errors == set()
    recommended = {problem.split('"')[1].rsplit("/", 1)[1] for problem in dataset.metadata.ctx.issues.warnings}
    assert recommended == {"citeAs", "datePublished"}  # what the recipe does not know
    rows = list(dataset.records(record_set="samples"))
    assert [row["samples/sample_id"].decode() for row in rows] == samples["sample_id"].to_pylist()
    assert [row["samples/split"].decode() for row in rows] == samples["split"].to_pylist()
    for column in ("power_watt", "velocity_mps", "start_ns", "terrain_class", "quality"):
        assert [row[f"samples/{column}"] for row in rows] == samples[column].to_pylist(), column


@not_ours
def test_mlcroissant_reads_every_patch_of_the_shards(built):
    mlc = pytest.importorskip("mlcroissant", reason="mlcroissant is not installed")
    dataset = mlc.Dataset(jsonld=str(built / "parquet" / "croissant.json"))
    rows = {row["patches/sample_id"].decode(): row for row in dataset.records(record_set="patches")}
    mine = open_dataset(built / "parquet")
    assert len(rows) == sum(len(part) for part in mine.values())
    for split, part in mine.items():
        layers = part.layers(np.arange(len(part)))
        for number, sample_id in enumerate(part.samples["sample_id"].to_pylist()):
            assert rows[sample_id]["patches/split"].decode() == split
            for layer, pixels in layers.items():
                assert np.array_equal(rows[sample_id][f"patches/{layer}"], pixels[number].reshape(-1))


def test_the_croissant_document_says_where_patches_are_and_how_large(built):
    document = json.loads((built / "parquet" / "croissant.json").read_text())
    assert (document["license"], document["creator"]["name"]) == ("CC-BY-4.0", "somebody")
    assert document["version"].startswith(f"{DATA_MODEL_VERSION}.0+")
    samples, patches = document["recordSet"]
    assert [field["name"] for field in patches["field"]] == ["sample_id", "split", "ortho", "terrain", "height"]
    assert {field.get("arrayShape") for field in patches["field"][2:]} == {"1600"}
    assert samples["key"] == {"@id": "samples/sample_id"}
    assert len(json.loads((built / "zarr" / "croissant.json").read_text())["recordSet"]) == 1


def test_hugging_face_datasets_reads_the_shards_as_they_are(built, samples, tmp_path):
    datasets = pytest.importorskip("datasets", reason="datasets is not installed")
    files = {split: shards(built, split) for split in SPLITS}
    found = datasets.load_dataset("parquet", data_files=files, cache_dir=str(tmp_path))
    for split, part in open_dataset(built / "zarr").items():
        assert found[split]["sample_id"][:] == part.samples["sample_id"].to_pylist()
        heights = np.array(found[split].with_format("numpy")["height"][:])
        assert np.array_equal(heights.reshape(-1, 40, 40), part.layers(np.arange(len(part)))["height"])


def test_duckdb_reads_the_shards_as_they_are(built, samples):
    duckdb = pytest.importorskip("duckdb", reason="duckdb is not installed")
    for split, part in open_dataset(built / "zarr").items():
        rows = duckdb.sql(f"SELECT sample_id, split, power_watt, terrain FROM '{shards(built, split)}'").fetchall()  # noqa: S608
        assert [row[0] for row in rows] == part.samples["sample_id"].to_pylist()
        assert {row[1] for row in rows} == {split}
        assert [row[2] for row in rows] == part.samples["power_watt"].to_pylist()
        terrain = part.layers(np.arange(len(part)))["terrain"]
        assert np.array_equal(np.array([row[3] for row in rows]), terrain.reshape(len(rows), -1))


def test_polars_and_xarray_see_one_order(built, samples):
    import polars as pl
    import xarray

    assert (
        pl.read_parquet(built / "zarr" / "samples.parquet")["sample_id"].to_list() == samples["sample_id"].to_pylist()
    )
    patches = xarray.open_zarr(built / "zarr" / "patches.zarr")
    assert patches.sample_id.values.tolist() == samples["sample_id"].to_pylist()
    train = samples["split"].to_numpy() == np.array("train")
    shard = pl.read_parquet(shards(built, "train"))
    decoded = shard["height"].to_numpy().reshape(-1, 40, 40) * 0.0005
    np.testing.assert_allclose(patches.height.values[train], decoded, atol=1e-6)


def test_every_file_of_samples_tells_where_its_rows_lie(built, samples):
    ends = np.array([samples[f"{end}_{axis}_deg"].to_numpy() for end in ("start", "end") for axis in ("lon", "lat")])
    middle_deg = ends.reshape(2, 2, -1).mean(axis=0).T
    points = shapely.from_wkb(samples["geometry"].to_pylist())
    lonlat_deg = np.column_stack([shapely.get_x(points), shapely.get_y(points)])
    np.testing.assert_allclose(lonlat_deg, middle_deg, rtol=0, atol=1e-7)  # a centimetre
    for path in (built / "zarr" / "samples.parquet", *sorted((built / "parquet" / "data").glob("*.parquet"))):
        geo = json.loads(pq.read_schema(path).metadata[b"geo"])
        column = geo["columns"][geo["primary_column"]]
        assert (geo["version"], column["encoding"], column["geometry_types"]) == ("1.1.0", "WKB", ["Point"])
        there = shapely.from_wkb(pq.read_table(path, columns=["geometry"])["geometry"].to_pylist())
        assert column["bbox"] == shapely.total_bounds(there).tolist()


def test_geopandas_reads_samples_and_segments(built, samples):
    geopandas = pytest.importorskip("geopandas", reason="geopandas is not installed")
    points = geopandas.read_parquet(built / "zarr" / "samples.parquet")
    assert points.crs.to_string() == "OGC:CRS84"
    assert points.geometry.geom_type.unique().tolist() == ["Point"]
    (path, *_) = (run.file("segments.parquet") for run in open_store(built / "store").runs())
    lines = geopandas.read_parquet(path)
    assert lines.geometry.geom_type.unique().tolist() == ["LineString"]
    metres = lines.geometry.to_crs(lines.estimate_utm_crs()).length
    np.testing.assert_allclose(metres, lines["chord_m"], rtol=1e-3)  # the scale of a UTM zone
