"""Datasets in a bucket: put there whole, card last, never a mixture; read by range through a cache that is proved."""

import json
import shutil

import numpy as np
import obstore
import pytest
from storage_server import object_store
from synthetic_store import small_store

import tcpipe
from tcpipe.errors import StoreError, UsageError
from tcpipe.formats.bucket import open_place
from tcpipe.formats.published import CLAIM, published
from tcpipe.learning.training import model_for
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.diff import diff
from tcpipe.pipeline.explain import explain
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.report import report
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe

URL = "s3://sets/by name/ds"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A store, a dataset in a directory, and the same in Parquet."""
    directory = tmp_path_factory.mktemp("made")
    store = small_store(directory)
    with pytest.MonkeyPatch.context() as patch:  # drawing the page is nine tenths of so small a build
        patch.setattr("tcpipe.pipeline.dataset.build.dataset_report", lambda *_: "<!doctype html>")
        for kind in ("zarr", "parquet"):
            build_dataset(directory / kind, store=store.root, recipe=Recipe(), file_format=kind)
        yield directory


@pytest.fixture
def bucket(tmp_path, monkeypatch):
    """A bucket ``sets`` in a directory, what was fetched of it, and an empty cache."""
    root = tmp_path / "served" / "sets"
    root.mkdir(parents=True)
    with object_store(tmp_path / "served") as (environment, fetched):
        for name in ("HTTP_PROXY", "http_proxy"):
            monkeypatch.delenv(name, raising=False)
        for name, value in {**environment, "TCPIPE_CACHE": str(tmp_path / "cache")}.items():
            monkeypatch.setenv(name, value)
        yield root, fetched


def put(made, bucket, kind="zarr"):
    shutil.copytree(made / kind, bucket[0] / "by name" / "ds")


def files(directory):
    return {
        path.relative_to(directory).as_posix(): path.read_bytes() for path in directory.rglob("*") if path.is_file()
    }


def test_a_dataset_that_is_built_into_a_bucket_is_the_same_as_on_disk(made, bucket):
    built = build_dataset(URL, store=made / "store", recipe=Recipe())
    assert (built.status, built.path) == ("done", URL)
    assert files(bucket[0] / "by name" / "ds") == files(made / "zarr")
    again = build_dataset(f"{URL}/", store=made / "store", recipe=Recipe())
    assert again.status == "unchanged"
    for dry_run in (True, False):
        with pytest.raises(UsageError, match="is there already; what lies in a bucket is not replaced"):
            build_dataset(URL, store=made / "store", recipe=Recipe(), seed=7, dry_run=dry_run)
    assert files(bucket[0] / "by name" / "ds") == files(made / "zarr")


def test_from_a_store_in_a_bucket_the_same_dataset_is_built(made, bucket, tmp_path):
    shutil.copytree(made / "store", bucket[0] / "st")
    build_dataset(tmp_path / "ds", store="s3://sets/st", recipe=Recipe())
    assert files(tmp_path / "ds") == files(made / "zarr")


def test_what_lies_there_and_is_no_dataset_is_left_alone(made, bucket):
    (bucket[0] / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match=r"s3://sets: holds notes.txt and no dataset.json; it is left alone"):
        build_dataset("s3://sets", store=made / "store", recipe=Recipe())
    assert files(bucket[0]) == {"notes.txt": b"mine"}


def test_what_a_killed_build_left_is_completed_by_the_same_and_refused_to_another(made, bucket):
    there = bucket[0] / "by name" / "ds"
    there.mkdir(parents=True)
    (there / CLAIM).write_bytes((made / "zarr" / "dataset.json").read_bytes())
    for path in sorted((made / "zarr").rglob("*.*"))[:5]:
        if path.is_file() and path.name != "dataset.json":
            (there / path.relative_to(made / "zarr")).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, there / path.relative_to(made / "zarr"))
    before = files(there)
    with pytest.raises(StoreError, match="another one writes something else there"):
        build_dataset(URL, store=made / "store", recipe=Recipe(), seed=7)
    assert files(there) == before
    with pytest.raises(UsageError, match="there is no dataset"):
        tcpipe.open_dataset(URL)
    assert build_dataset(URL, store=made / "store", recipe=Recipe()).status == "done"
    assert files(there) == files(made / "zarr")


def write(directory, text):
    (directory / "c.json").write_text(text)
    (directory / "data").write_text(text)


def test_who_comes_second_finds_it_done_and_mixes_nothing(bucket):
    def put_two():
        with published("s3://sets/x", "c.json") as mine:
            write(mine, "mine")
            with published("s3://sets/x", "c.json") as theirs:
                write(theirs, "theirs")

    with pytest.raises(StoreError, match="another one has written it meanwhile"):
        put_two()
    assert files(bucket[0] / "x") == {"c.json": b"theirs", "data": b"theirs"}


class _Killed(BaseException):
    pass


def test_killed_at_any_request_nobody_sees_half_and_the_next_call_completes(bucket, monkeypatch):
    place, left = bucket[0] / "x", [0]

    def killing(act):
        def acts(*args, **how):
            if not left[0]:
                raise _Killed
            left[0] -= 1
            return act(*args, **how)

        return acts

    for name in ("put", "delete"):
        monkeypatch.setattr(obstore, name, killing(getattr(obstore, name)))
    for steps in range(100):
        left[0] = steps
        try:
            with published("s3://sets/x", "c.json") as directory:
                write(directory, "mine")
            break
        except _Killed:
            assert not (place / "c.json").exists() or (place / "data").read_text() == "mine"
        except UsageError:  # it is there already, as a caller who looks first finds
            break
    assert steps >= 3
    assert files(place) == {"c.json": b"mine", "data": b"mine"}


def test_who_comes_second_with_the_same_finds_it_done(bucket):
    with published("s3://sets/x", "c.json") as mine:
        write(mine, "same")
        with published("s3://sets/x", "c.json") as theirs:
            write(theirs, "same")
    assert files(bucket[0] / "x") == {"c.json": b"same", "data": b"same"}


def test_the_claim_of_a_build_that_was_killed_at_its_end_goes_with_the_next(made, bucket):
    put(made, bucket)
    claim = bucket[0] / "by name" / "ds" / CLAIM
    claim.write_bytes(claim.with_name("dataset.json").read_bytes())
    assert build_dataset(URL, store=made / "store", recipe=Recipe()).status == "unchanged"
    assert not claim.exists()


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


def test_of_a_sample_only_its_chunks_are_fetched(made, bucket):
    put(made, bucket)
    split = tcpipe.open_dataset(URL)["train"]
    before = bucket[1].sent_bytes
    piece = split.view.stored.files.read(0, ["height"])
    shard = bucket[0] / "by name" / "ds" / "patches.zarr" / "height" / "c" / "0" / "0" / "0"
    assert piece["height"].shape[1:] == (40, 40)
    whole = shard.stat().st_size
    assert whole < bucket[1].sent_bytes - before < 1.9 * whole, "its digest once, then the piece"
    before = bucket[1].sent_bytes
    tcpipe.open_dataset(URL)["train"].view.stored.files.read(1, ["height"])
    assert bucket[1].sent_bytes - before < 0.9 * whole, "its ETag tells that it is as it was"


def test_what_the_cache_holds_is_proved_and_fetched_anew_where_it_was_altered(made, bucket, tmp_path):
    put(made, bucket)
    wanted = tcpipe.open_dataset(made / "zarr")["train"].patches
    assert np.array_equal(tcpipe.open_dataset(URL)["train"].patches, wanted)
    for path in (tmp_path / "cache").rglob("*"):
        if path.is_file():
            data = bytearray(path.read_bytes())
            data[len(data) // 2] ^= 0xFF
            path.unlink()
            path.write_bytes(data)
    assert np.array_equal(tcpipe.open_dataset(f"{URL}/")["train"].patches, wanted)


def test_what_is_altered_in_the_bucket_is_no_patch(made, bucket):
    put(made, bucket)
    for path in (bucket[0] / "by name" / "ds" / "patches.zarr" / "height" / "c").rglob("0"):
        if path.is_file():
            data = bytearray(path.read_bytes())
            data[100] ^= 0xFF
            path.write_bytes(data)
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
    assert model_for(URL) == "table"
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


def test_a_url_without_a_card_is_told_in_one_line(bucket):
    with pytest.raises(UsageError, match=r"s3://sets/gone: there is no dataset, model or cost map here"):
        tcpipe.open_dataset("s3://sets/gone")
    with pytest.raises(StoreError, match=r"s3://nosuch/ds: .*there is no such bucket"):
        build_dataset("s3://nosuch/ds", store=bucket[0], recipe=Recipe())


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
