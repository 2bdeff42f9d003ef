"""Datasets and stores that are verified, explained and compared: damage of every kind is found, and causes are named."""

import json
import os
import shutil
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from made_tracks import with_columns
from stored_files import flip, manifest
from synthetic_store import add_run, box, lanes, make_fixes, region_file, segments, small_store, tag_run

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError, UsageError
from tcpipe.formats import documents
from tcpipe.formats import place as places
from tcpipe.formats.integrity import compute_checksum, find_broken_seal, seal_page, write_sealed
from tcpipe.formats.json_files import to_plain
from tcpipe.formats.runs import Output
from tcpipe.pipeline.calls import record_call
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.diff import diff
from tcpipe.pipeline.explain import explain
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.report import report
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe, SampleConfig
from tcpipe.store import Store
from tcpipe.tables.levels import DATA_MODEL_VERSION


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    directory = tmp_path_factory.mktemp("trust")
    store = small_store(directory)
    region = region_file(directory / "region.geojson", box(-20, -20, 5, 20))
    for name in ("zarr", "parquet"):
        build_dataset(directory / name, store=store.root, split=region, recipe=Recipe(), format=name)
    return directory


@pytest.fixture
def copy(made, tmp_path):
    documents._DECODED.clear()  # as another process
    return lambda name: shutil.copytree(made / name, tmp_path / name)


def files(directory):
    return sorted(path for path in directory.rglob("*") if path.is_file())


def test_a_store_its_runs_and_its_map_verify(made):
    found = verify(made / "store")
    assert (found.problems, found.kind, found.read["runs"], found.read["maps"]) == ((), "store", 2, 1)
    store = Store(made / "store")
    for name in ("north", store.find_runs("north")[0].name):
        found = verify(name, store=store.root)
        assert (found.problems, found.kind, found.read["runs"]) == ((), "run", 1)
    with pytest.raises(UsageError, match="nosuch"):
        verify("nosuch", store=store.root)
    assert verify(store.map_at(store.scan().maps["site"])[0]).kind == "map"


def dress(store):
    """Add what `ingest` and `report` also leave in a store: streams, tags, pages."""
    add_run(store, "streamed", segments("streamed", *lanes(0.0, -14.0, 14.0)), streams=make_fixes((0, 10**9)))
    tag_run(store, "streamed", {"weather": "wet"})
    (store.root / "report.html").write_text(seal_page("<p>all runs</p>"))
    for run in store.runs():
        (run.folder.path / "report.html").write_text(seal_page("<p>\nwhat was driven\n</p>"))


SEALED = ("dataset.json", "report.html")


def test_a_changed_byte_anywhere_in_a_store_is_found_and_its_file_is_named(copy):
    """Those in a dataset: tests/property/test_dataset_damage.py."""
    directory, rng = copy("store"), np.random.default_rng(0)
    dress(Store(directory))
    (directory / "index.parquet").unlink(missing_ok=True)
    listed = [path for path in files(directory) if path.name not in SEALED]
    whole = {path: path.read_bytes() for path in files(directory)}
    for place in (0.0, *rng.random(2), 1.0):  # all that are listed at once, then each sealed one alone
        for path in listed:
            flip(path, place, bit=int(rng.integers(8)))
        problems = verify(directory).problems
        assert [path for path in listed if not any(str(path) in problem for problem in problems)] == []
        for path in listed:
            path.write_bytes(whole[path])
    for path in set(whole) - set(listed):
        for place in (0.0, *rng.random(4), 1.0):
            flip(path, place, bit=int(rng.integers(8)))
            problems = find_broken_seal(path.read_bytes(), path) if place else "".join(verify(directory).problems)
            assert str(path) in (problems or ""), (path, place)
            path.write_bytes(whole[path])
    assert verify(directory).problems == ()


@pytest.mark.parametrize(("key", "value"), [("samples", 7), ("splits", {"train": 7}), ("runs", [])])
def test_a_card_that_counts_otherwise_is_found(copy, key, value):
    directory = copy("zarr")
    card = json.loads((directory / "dataset.json").read_text())
    write_sealed(directory / "dataset.json", {**card, key: value})
    told = f"{directory / 'dataset.json'}: {key} has {7 if value else 0} samples, but samples.parquet has 448"
    assert verify(directory).problems == (told,)


def test_a_manifest_that_counts_otherwise_is_found(copy):
    store = Store(copy("store"))
    (run,) = store.find_runs("south")
    made = run.manifest
    store.put_run(store.scan(), replace(made, counts=replace(made.counts, segments=made.counts.segments + 1)))
    (problem,) = verify(store.root).problems
    assert problem.endswith("segments is 225, but segments.parquet has 224 rows")


def test_strange_files_in_a_store_are_named_and_what_a_killed_command_left_behind(copy):
    root = copy("store")
    store = Store(root)
    layers, run = store.map_at(store.scan().maps["site"])[0], store.find_runs("south")[0].folder.path
    strange = [root / "notes.txt", root / "maps" / "notes.json", run / "notes.txt", layers / "height" / "notes.txt"]
    strange += [root / "blobs" / "mine", root / "elsewhere"]
    desktop = [root / ".DS_Store", run / "Thumbs.db", root / "runs" / ".directory"]
    for path in (*strange, *desktop):
        path.write_text("mine")
    left = [root / "blobs" / "0123456789abcdef", root / ".tmp-new-01234567"]
    for path in left:
        path.mkdir()
    found = verify(root)
    assert {*found.problems} == {
        *(f"{path}: is no file of this store" for path in strange),
        *(f"{path}: was left by a killed command; 'tcpipe prune' removes it" for path in left),
    }
    assert {note.partition(": ")[0] for note in found.notes} == {*map(str, desktop)}


def test_payload_that_a_running_call_has_not_named_yet_is_no_problem(copy):
    store = Store(copy("store"))
    (store.root / "blobs" / "0123456789abcdef").mkdir()
    with record_call(store, "ingest", ["/logs"]):
        assert verify(store.root).problems == ()
    assert len(verify(store.root).problems) == 1


def test_what_is_none_of_these_is_said(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(UsageError, match=r"give|name its store"):
            verify(path)


def find_sample(made, run_id):
    """Return the first sample of a run that trains."""
    train = open_dataset(made / "zarr")["train"].samples["sample_id"].to_pylist()
    return next(name for name in train if name.startswith(run_id))


def test_an_unknown_sample_and_an_unknown_run_are_said(made, copy):
    for name, said in (("north", "did you mean north-"), ("x", "an example is")):
        with pytest.raises(DatasetError, match=said):
            explain(name, dataset=made / "zarr", store=made / "store")
    store = Store(copy("store"))
    manifest(store.find_runs("north")[0]).unlink()
    with pytest.raises(DatasetError, match="is not in this store"):
        explain(find_sample(made, "north"), dataset=made / "zarr", store=store.root)


ASK = {
    "open": open_dataset,
    "inspect": lambda path: inspect(path, recipe=Recipe()),
    "report": report,
    "explain": lambda path: explain("x", dataset=path, store=path.parent),
}


@pytest.mark.parametrize("ask", ASK)
@pytest.mark.parametrize(
    ("card", "said"),
    [
        (
            {"kind": "tcpipe dataset", "data_model_version": "7.0"},
            rf"d: made by another version of tcpipe \(data model 7.0\), expected {DATA_MODEL_VERSION}: ingest the logs again",
        ),
        ({"kind": "shopping list"}, "dataset.json: not the card of a tcpipe dataset"),
    ],
)
def test_a_dataset_of_another_version_is_told_so_by_whoever_reads_it(tmp_path, ask, card, said):
    Store(tmp_path).put(Store(tmp_path).scan(), "outputs", "0" * 16, Output(where="/d"))
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "dataset.json").write_text(json.dumps(card))
    with pytest.raises(DatasetError, match=said):
        ASK[ask](tmp_path / "d")


def test_causes_and_effects_are_named(made, copy, tmp_path):
    store = Store(copy("store"))
    add_run(store, "later", segments("later", *lanes((18.0,), -14.0, 14.0), start_ns=int(2e18)))
    recipe = Recipe(sample=SampleConfig(patch_m=0.8))
    build_dataset(tmp_path / "b", store=store.root, recipe=recipe, holdout="sample")
    found = diff(made / "zarr", tmp_path / "b")
    assert found.causes == (
        "recipe: sample.patch_m 1.0 → 0.8",
        "recipe: split.holdout block → sample",
        "run: added later",
        "region: removed",
    )
    assert found.samples == {
        "only in a": 0,
        "only in b": 28,
        "in both": 448,
        "other labels": 0,
        "other columns": 448,
        "other patches": 448,
        "other fold": found.samples["other fold"],
    }
    assert found.samples["other fold"] > 112
    assert found.moved["unseen to train"] + found.moved["unseen to test"] == 112
    assert not found.same
    lines = str(found)
    assert "28 only in b" in lines


def test_the_changes_of_labels_are_those_of_the_samples_in_both(made, copy):
    other = copy("zarr")
    table = pq.read_table(other / "samples.parquet")
    energy = table.column("energy_joule").to_numpy().copy()
    energy[:3] += (1.0, -4.0, 2.0)
    pq.write_table(with_columns(table, energy_joule=energy), other / "samples.parquet")
    card = json.loads((other / "dataset.json").read_text())
    card["checksums"]["samples.parquet"] = to_plain(compute_checksum(other / "samples.parquet"))
    write_sealed(other / "dataset.json", card)
    found = diff(made / "zarr", other).changes
    largest = {"largest": pytest.approx(4.0), "largest_in_std": pytest.approx(4.0)}
    assert found["energy_joule"] == {"samples": len(energy), "median": 0.0, **largest}
    assert set(found) == {
        f"{name}_{unit}"
        for name, unit in (("power", "watt"), ("velocity", "mps"), ("duration", "s"), ("energy", "joule"))
        for name in (name, f"{name}_std")
    }
    assert {of["largest"] for name, of in found.items() if name != "energy_joule"} == {0.0}


@pytest.mark.parametrize("name", ["zarr", "parquet"])
def test_a_shard_of_another_build_is_refused_though_its_own_checksums_agree(copy, made, name, tmp_path):
    """A folder that was copied in part over an older build trained a model without a word."""
    region = region_file(tmp_path / "region.geojson", box(-20, -20, 5, 20))
    other = replace(Recipe(), split=replace(Recipe().split, seed=7), sample=replace(Recipe().sample, patch_m=4.5))
    build_dataset(tmp_path / "other", store=made / "store", split=region, recipe=other, format=name)
    half = copy(name)
    shard = "patches.zarr/height/c/0/0/0" if name == "zarr" else "data/train-00000-of-00001.parquet"
    shutil.copyfile(tmp_path / "other" / shard, half / shard)
    with pytest.raises(DatasetError, match=rf"{shard}: .*not of the build of .*dataset.json; copy the whole"):
        open_dataset(half)
    shutil.copyfile(made / name / shard, half / shard)
    assert len(open_dataset(half)["train"].patches)


def test_a_digest_is_found_once_until_the_file_changes(copy, monkeypatch, tmp_path):
    monkeypatch.setenv("TCPIPE_CACHE", str(tmp_path / "cache"))
    dataset, hashed = copy("zarr"), []
    whole = places._compute_digest
    monkeypatch.setattr(places, "_compute_digest", lambda place, name: hashed.append(name) or whole(place, name))

    def hashed_shards():
        return sorted(name for name in hashed if "/c/" in name)

    open_dataset(dataset)
    shards = hashed_shards()
    layers = [f"patches.zarr/{layer}/c/0/0/0" for layer in ("height", "ortho", "terrain")]
    assert shards == sorted([*layers, "patches.zarr/sample_id/c/0"])
    for _ in range(2):
        open_dataset(dataset)
    assert hashed_shards() == shards
    path = dataset / shards[0]
    seen = path.stat()
    flip(path)
    os.utime(path, ns=(seen.st_atime_ns, seen.st_mtime_ns))
    with pytest.raises(DatasetError, match="its sha256 is"):
        open_dataset(dataset)
    for memo in (tmp_path / "cache").rglob("*"):
        if memo.is_file():
            memo.write_text("")
    flip(path)
    assert open_dataset(dataset)


def test_without_a_cache_every_opening_hashes_and_none_fails(copy, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("TCPIPE_CACHE", str(tmp_path / "file" / "below"))
    assert open_dataset(copy("zarr"))
