"""Datasets in a bucket: builds that appear whole, never a mixture; read by range through a cache that is proved."""

import json
import shutil

import numpy as np
import pytest
from object_gateway import in_environment
from storage_server import object_store
from stored_files import flip
from stored_files import read_files as files
from synthetic_store import add_run, lanes, segments, small_store

import tcpipe
from tcpipe.errors import StoreError, UsageError
from tcpipe.formats.place import open_place
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.diff import diff
from tcpipe.pipeline.explain import explain
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.report import report
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe
from tcpipe.store import open_store

URL = "s3://sets/by name/ds"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A store, a dataset in a directory, and the same in Parquet."""
    directory = tmp_path_factory.mktemp("made")
    store = small_store(directory)
    for kind in ("zarr", "parquet"):
        build_dataset(directory / kind, store=store.root, recipe=Recipe(), format=kind)
    return directory


@pytest.fixture
def bucket(tmp_path, monkeypatch):
    """A bucket ``sets`` in a directory, what was fetched of it, and an empty cache."""
    root = tmp_path / "served" / "sets"
    root.mkdir(parents=True)
    with object_store(tmp_path / "served") as (environment, fetched):
        in_environment(monkeypatch, environment, tmp_path / "cache")
        yield root, fetched


def put(made, bucket, kind="zarr"):
    shutil.copytree(made / kind, bucket[0] / "by name" / "ds")


def test_a_dataset_that_is_built_into_a_bucket_is_the_same_as_on_disk(made, bucket):
    built = build_dataset(URL, store=made / "store", recipe=Recipe())
    assert (built.status, built.path) == ("done", URL)
    (build,) = folders(bucket)
    assert files(build) == files(made / "zarr")
    before = files(bucket[0])
    again = build_dataset(f"{URL}/", store=made / "store", recipe=Recipe())
    assert again.status == "unchanged"
    assert "nothing to do" in str(again)
    assert files(bucket[0]) == before


def test_from_a_store_in_a_bucket_the_same_dataset_is_built(made, bucket, tmp_path):
    shutil.copytree(made / "store", bucket[0] / "st")
    build_dataset(tmp_path / "ds", store="s3://sets/st", recipe=Recipe())
    assert files(tmp_path / "ds") == files(made / "zarr")


def test_what_lies_there_and_is_no_dataset_is_left_alone(made, bucket):
    (bucket[0] / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match=r"s3://sets: contains notes.txt and no dataset.json; it is not changed"):
        build_dataset("s3://sets", store=made / "store", recipe=Recipe())
    assert files(bucket[0]) == {"notes.txt": b"mine"}
    shutil.copytree(made / "store", bucket[0] / "st")
    with pytest.raises(UsageError, match=r"s3://sets/st: contains blobs and no dataset.json; it is not changed"):
        build_dataset("s3://sets/st", store=made / "store", recipe=Recipe())


def folders(bucket, name="by name/ds"):
    """The folders of the builds at a URL, by number."""
    numbered = {int(path.name.split(".")[1]): path for path in (bucket[0] / name).glob("current.*.json")}
    return [bucket[0] / name / json.loads(numbered[number].read_text())["folder"] for number in sorted(numbered)]


def test_a_second_night_builds_there_and_readers_see_it_while_an_earlier_one_finishes(made, tmp_path, bucket):
    store = open_store(shutil.copytree(made / "store", tmp_path / "store"))
    build_dataset(URL, store=store.root, recipe=Recipe())
    earlier = tcpipe.open_dataset(URL)
    add_run(store, "dry", segments("dry", *lanes(1.0, -10.0, 10.0)))
    second = build_dataset(URL, store=store.root, recipe=Recipe())
    assert second.status == "done"
    build_dataset(tmp_path / "ds", store=store.root, recipe=Recipe())
    first, newest = folders(bucket)
    assert files(newest) == files(tmp_path / "ds")
    assert tcpipe.open_dataset(URL).card == tcpipe.open_dataset(tmp_path / "ds").card != earlier.card
    assert len(earlier["train"].patches) == len(earlier["train"]), "read after the second was there"
    assert verify(URL).problems == ()
    assert len(diff(f"{URL}/builds/{first.name}", URL).causes) > 0, "the folder of a build is a dataset itself"


def test_verify_names_what_is_of_no_build_and_a_damaged_pointer(made, bucket):
    build_dataset(URL, store=made / "store", recipe=Recipe())
    build_dataset(URL, store=made / "store", recipe=Recipe(), seed=7, force=True)
    there, (first, newest) = bucket[0] / "by name" / "ds", folders(bucket)
    for name in ("current.json", f"builds/{newest.name}/data", "builds/data", f"builds/{'f' * 16}/data"):
        (there / name).parent.mkdir(exist_ok=True)
        (there / name).touch()
    strange = {f"{URL}/{name}: is no file of this dataset" for name in ("current.json", "builds/data")}
    strange.add(f"{URL}/builds/{newest.name}/data: is no file of this dataset")
    assert set(verify(URL).problems) == strange, "the last one may be of a build that goes on"
    (pointer,) = there.glob("current.2.*.json")
    pointer.write_bytes(pointer.read_bytes()[:-9])
    assert f"{URL}/{pointer.name}: is no file of this dataset" in verify(URL).problems
    assert tcpipe.open_dataset(URL).card.inputs == json.loads((first / "dataset.json").read_text())["inputs"]


@pytest.mark.parametrize("kind", ["zarr", "parquet"])
def test_batches_from_a_bucket_are_those_from_disk_and_are_fetched_once(made, bucket, kind):
    put(made, bucket, kind)
    here, there = tcpipe.open_dataset(made / kind)["train"], tcpipe.open_dataset(URL)["train"]
    assert np.array_equal(here.labels, there.labels)
    opened = len(bucket[1])
    for from_disk in (True, False):
        for mine, theirs in zip(
            here.batches(32, shuffle=True, from_disk=from_disk),
            there.batches(32, shuffle=True, from_disk=from_disk),
            strict=True,
        ):
            assert np.array_equal(mine[0], theirs[0])
            assert np.array_equal(mine[1], theirs[1])
    fetched = len(bucket[1])
    assert fetched > opened
    again = tcpipe.open_dataset(URL)["train"]
    assert np.array_equal(again.patches, here.patches)
    assert {name.rpartition("/")[2] for name in bucket[1][fetched:]} <= {"dataset.json", "report.html"}


def test_what_is_altered_in_the_bucket_is_no_patch(made, bucket):
    put(made, bucket)
    for path in (bucket[0] / "by name" / "ds" / "patches.zarr" / "height" / "c").rglob("0"):
        if path.is_file():
            flip(path, 0.1)
    with pytest.raises(tcpipe.errors.DatasetError, match=r"height/c/0/0/0: its sha256 is .*build the dataset again"):
        tcpipe.open_dataset(URL)["train"].patches  # noqa: B018
    checked = verify(URL)
    assert checked.path == URL
    assert any("height/c/0/0/0" in problem for problem in checked.problems)


def test_commands_look_at_a_dataset_in_a_bucket(made, bucket):
    put(made, bucket)
    assert verify(URL).problems == ()
    (bucket[0] / "by name" / "ds" / "stray").touch()
    assert verify(URL).problems == (f"{URL}/stray: is no file of this dataset",)
    assert inspect(URL, recipe=Recipe()).samples == inspect(made / "zarr", recipe=Recipe()).samples
    assert inspect(URL, recipe=Recipe()).path == URL
    assert diff(made / "zarr", URL).same
    sample = tcpipe.open_dataset(URL)["train"].samples["sample_id"][0].as_py()
    assert explain(sample, dataset=URL, store=made / "store") == explain(
        sample, dataset=made / "zarr", store=made / "store"
    )
    page = bucket[0] / "by name" / "ds" / "report.html"
    page.unlink()
    (written,) = report(URL)
    assert (written.path, written.changed) == (f"{URL}/report.html", True)
    assert b"<title>" in page.read_bytes()


def test_a_url_without_a_card_is_told_in_one_line(made, bucket):
    with pytest.raises(UsageError, match=r"s3://sets/gone: there is no dataset, model or cost map here"):
        tcpipe.open_dataset("s3://sets/gone")
    with pytest.raises(StoreError, match=r"s3://nosuch/ds: .*there is no such bucket"):
        build_dataset("s3://nosuch/ds", store=made / "store", recipe=Recipe())


def test_names_in_a_card_do_not_lead_outside(made, bucket):
    put(made, bucket)
    card = bucket[0] / "by name" / "ds" / "dataset.json"
    told = json.loads(card.read_text())
    told["checksums"]["../evil"] = told["checksums"]["samples.parquet"]
    shutil.copy(card.with_name("samples.parquet"), bucket[0] / "by name" / "evil")
    card.write_text(json.dumps(told))
    with pytest.raises(StoreError, match=r"names '../evil'"):
        tcpipe.open_dataset(URL)
    assert open_place(URL).read("dataset.json") == card.read_bytes()
