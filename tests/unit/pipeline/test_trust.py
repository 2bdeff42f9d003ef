"""Datasets and stores that are verified, explained and compared: damage of every kind is found, and causes are named."""

import json
import shutil

import numpy as np
import pytest
from synthetic_store import add_run, box, lanes, region_file, segments, small_store

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError, UsageError
from tcpipe.pipeline.build import build_dataset
from tcpipe.pipeline.diff import diff
from tcpipe.pipeline.explain import explain
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe, SampleConfig
from tcpipe.store import Store


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    directory = tmp_path_factory.mktemp("trust")
    store = small_store(directory)
    region = region_file(directory / "region.geojson", box(-20, -20, 5, 20))
    for name in ("zarr", "parquet"):
        build_dataset(directory / name, store=store.root, split=region, recipe=Recipe(), file_format=name)
    return directory


@pytest.fixture
def copy(made, tmp_path):
    return lambda name: shutil.copytree(made / name, tmp_path / name)


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def files(directory, *, but=()):
    return sorted(path for path in directory.rglob("*") if path.is_file() and path.name not in but)


@pytest.mark.parametrize("name", ["zarr", "parquet"])
def test_what_is_whole_verifies(made, name):
    found = verify(made / name)
    assert found.problems == ()
    assert (found.kind, found.read["samples"], found.read["patches"]) == ("dataset", 448, 448)
    assert "all as it was written" in str(found)


def test_a_store_its_runs_and_its_map_verify(made):
    found = verify(made / "store")
    assert (found.problems, found.kind, found.read["runs"], found.read["maps"]) == ((), "store", 2, 1)
    assert verify(made / "store" / "runs" / "north").kind == "run"
    assert verify(made / "store" / "maps" / "site.zarr").kind == "map"


@pytest.mark.parametrize("name", ["zarr", "parquet"])
def test_a_changed_byte_in_any_file_of_a_dataset_is_found(copy, name):
    directory = copy(name)
    for path in files(directory, but=("dataset.json", "report.html")):
        whole = path.read_bytes()
        flip(path)
        assert any(str(path) in problem for problem in verify(directory).problems), path
        path.write_bytes(whole)
    assert verify(directory).problems == ()


@pytest.mark.parametrize("key", ["samples", "splits", "terrain", "label_statistics_of_train", "folds_of_train"])
def test_a_card_that_says_something_else_is_found(copy, key):
    directory = copy("zarr")
    card = json.loads((directory / "dataset.json").read_text())
    card[key] = 7
    (directory / "dataset.json").write_text(json.dumps(card))
    assert any(key in problem for problem in verify(directory).problems)


def test_files_that_went_or_came_are_found(copy):
    directory = copy("zarr")
    (directory / "overview.png").unlink()
    (directory / "notes.txt").write_text("mine")
    assert [problem.split(": ")[1] for problem in verify(directory).problems[:2]] == [
        "is gone",
        "is no file of this dataset",
    ]


def test_a_changed_byte_in_any_table_of_a_run_is_found(copy):
    store = copy("store")
    for path in files(store / "runs"):
        if path.suffix == ".parquet":
            whole = path.read_bytes()
            flip(path)
            assert verify(store).problems, path
            path.write_bytes(whole)
    assert verify(store).problems == ()


def test_damage_of_a_map_is_found_and_hides_nothing_else(copy):
    store = copy("store")
    layers = store / "maps" / "site.zarr"
    flip(files(layers / "height" / "c")[0])
    shutil.rmtree(layers / "ortho" / "c")
    shutil.rmtree(store / "runs" / "north" / next((store / "runs" / "north").glob("*/manifest.json")).parent.name)
    problems = verify(store).problems
    for words in ("height, rows 0", "ortho covers 0.000000%", "north: holds no finished ingestion"):
        assert any(words in problem for problem in problems), words


def test_a_manifest_that_counts_otherwise_is_found(copy):
    store = copy("store")
    path = next((store / "runs" / "south").glob("*/manifest.json"))
    manifest = json.loads(path.read_text())
    manifest["counts"]["segments"] += 1
    manifest["ledger_m"]["kept"] += 1.0
    path.write_text(json.dumps(manifest))
    problems = verify(store).problems
    assert any("224 rows, its manifest says 225" in problem for problem in problems)
    assert any("the ledger keeps 225.000 m" in problem for problem in problems)


def test_what_is_none_of_these_is_said(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(UsageError, match="give"):
            verify(path)


@pytest.mark.parametrize("name", ["zarr", "parquet"])
def test_a_sample_is_explained_and_comes_out_the_same(made, name):
    for part in ("train", "unseen"):
        samples = open_dataset(made / name)[part].samples
        for row in (0, len(samples) // 2):
            sample_id = samples["sample_id"][row].as_py()
            found = explain(sample_id, dataset=made / name, store=made / "store")
            assert found.differences == ()
            text = str(found)
            assert f"split {part}" in text
            assert f"/logs/{samples['run_id'][row].as_py()}.mcap" in text
            assert "tiles (column, row) (0, 0)" in text
            assert "equal, bit for bit" in text


def test_a_pixel_or_a_label_that_is_not_the_stores_is_found(copy, made, tmp_path):
    store = Store(copy("store"))
    shutil.rmtree(store.runs_path / "north")
    start, end = lanes(1.0 + 2.0 * np.arange(8), -14.0, 14.0)
    table = segments("north", start, end, start_ns=int(1e18 + 1e12))
    power = table.column("power_watt").to_numpy() + 1.0
    moved = table.set_column(table.column_names.index("power_watt"), table.schema.field("power_watt"), [power])
    add_run(store, "north", moved)
    sample = next(
        row for row in open_dataset(made / "zarr")["train"].samples["sample_id"].to_pylist() if "north" in row
    )
    found = explain(sample, dataset=made / "zarr", store=store.root)
    assert len(found.differences) == 1
    assert found.differences[0].startswith("power_watt: ")


def test_an_unknown_sample_and_an_unknown_run_are_said(made, copy):
    with pytest.raises(DatasetError, match="did you mean north-"):
        explain("north", dataset=made / "zarr", store=made / "store")
    with pytest.raises(DatasetError, match="an id of it is"):
        explain("x", dataset=made / "zarr", store=made / "store")
    store = copy("store")
    shutil.rmtree(store / "runs" / "north")
    sample = next(
        row for row in open_dataset(made / "zarr")["train"].samples["sample_id"].to_pylist() if "north" in row
    )
    with pytest.raises(DatasetError, match="is not in this store"):
        explain(sample, dataset=made / "zarr", store=store)


def test_two_formats_hold_the_same_samples(made):
    found = diff(made / "zarr", made / "parquet")
    assert found.causes == ("format: zarr → parquet",)
    assert (found.samples["in both"], found.samples["other patches"], found.moved) == (448, 0, {})
    assert diff(made / "zarr", made / "zarr").same


def test_causes_and_effects_are_named(made, copy, tmp_path):
    store = Store(copy("store"))
    start, end = lanes((18.0,), -14.0, 14.0)
    add_run(store, "later", segments("later", start, end, start_ns=int(2e18)))
    recipe = Recipe(sample=SampleConfig(patch_m=0.8))
    build_dataset(tmp_path / "b", store=store.root, recipe=recipe, holdout="sample")
    found = diff(made / "zarr", tmp_path / "b")
    assert found.causes == (
        "recipe: sample.patch_m 1.0 → 0.8",
        "recipe: split.holdout block → sample",
        "log: added later.mcap (run later, 28 samples)",
        "region: removed",
    )
    assert found.samples == {
        "only in a": 0,
        "only in b": 28,
        "in both": 448,
        "other labels": 0,
        "other patches": 448,
    }
    assert found.moved["unseen to train"] + found.moved["unseen to test"] == 112
    assert not found.same
    lines = str(found)
    assert "28 only in b" in lines


def test_the_shift_of_labels_is_that_of_scipy(made, copy, tmp_path):
    from scipy.stats import ks_2samp

    store = Store(copy("store"))
    start, end = lanes((18.0,), -14.0, 14.0)
    add_run(store, "later", segments("later", start, end + 0.0, start_ns=int(2e18)))
    build_dataset(tmp_path / "b", store=store.root, recipe=Recipe())
    found = diff(made / "zarr", tmp_path / "b")
    a, b = (
        np.concatenate([part.samples["power_watt"].to_numpy() for part in open_dataset(path).values()])
        for path in (made / "zarr", tmp_path / "b")
    )
    assert found.labels["power_watt"]["largest_gap"] == pytest.approx(ks_2samp(a, b).statistic)
    assert found.labels["power_watt"]["mean_b"] == pytest.approx(b.mean())
