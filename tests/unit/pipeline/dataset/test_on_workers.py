"""Datasets that workers elsewhere sample and write, by tasks of pickle: the bytes of this machine, and what a killed build did is done."""

import pickle
import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from stored_files import read_files as files
from synthetic_store import add_run, lanes, open_world, segments

from tcpipe import execution
from tcpipe.errors import StoreError
from tcpipe.execution import Outcome
from tcpipe.formats import dataset_files
from tcpipe.pipeline.dataset import build as build_module
from tcpipe.pipeline.dataset import content, sampling
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.prune import prune
from tcpipe.recipe import Recipe
from tcpipe.store import open_store

ROWS = 600
BATCH_ROWS, BATCHES = 100, 6
SHARD_ROWS, SHARDS = 256, 3


@pytest.fixture(scope="module", autouse=True)
def many_tasks():
    """Batches and shards that are small, no page, and a cluster that takes tasks and gives results as bytes."""

    def sent(what):
        return pickle.loads(pickle.dumps(what))  # noqa: S301  our own

    def elsewhere(function, tasks, _):
        for index, task in tasks:
            yield Outcome(index, sent(sent(function)(sent(task))))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampling, "_BATCH_ROWS", BATCH_ROWS)
        patch.setattr(dataset_files, "SHARD_ROWS", SHARD_ROWS)
        patch.setattr(execution, "_run_elsewhere", elsewhere)
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory, many_tasks):
    """A store of 600 segments, and the datasets that this machine makes of it."""
    directory = tmp_path_factory.mktemp("made")
    store = open_world(directory)
    add_run(store, "a", segments("a", *lanes(np.linspace(-14.0, 14.0, 30), -10.0, 10.0)))
    for kind in ("zarr", "parquet"):
        built = build_dataset(directory / kind, store=store.root, recipe=Recipe(), file_format=kind)
        assert built.card.samples == ROWS
    return directory


@pytest.fixture
def store(made, tmp_path):
    shutil.copytree(made / "store", tmp_path / "store")
    return open_store(tmp_path / "store")


def build(store, out, **keywords):
    return build_dataset(out, store=store, recipe=Recipe(), cluster="tcp://nowhere:1", **keywords)


@pytest.mark.parametrize("kind", ["zarr", "parquet"])
def test_workers_make_the_bytes_of_this_machine_and_leave_no_spool(made, store, tmp_path, kind):
    build(store.root, tmp_path / "far", file_format=kind)
    assert files(tmp_path / "far") == files(made / kind)
    shards = [name for name in files(made / kind) if name.endswith("/0/0") or name.startswith("data/")]
    assert len(shards) == (3 * SHARDS if kind == "zarr" else SHARDS)
    assert not (store.root / "spool").exists()


def test_workers_of_a_store_in_a_bucket_make_them_too(made, tmp_path, served):
    shutil.copytree(made / "store", tmp_path / "served" / "bucket" / "store")
    build("s3://bucket/store", tmp_path / "far")
    assert files(tmp_path / "far") == files(made / "zarr")
    assert not [path for path in (tmp_path / "served").rglob("spool/**/*") if path.is_file()]


class _Killed(BaseException):
    pass


def killed(store, out, module, *, after):
    """Have a build end when it has got so many tasks of a module done."""
    done = []

    def sound(outcome):
        if len(done) == after:
            raise _Killed
        done.append(outcome)
        return outcome.result

    with pytest.MonkeyPatch.context() as patch, suppress(_Killed):
        patch.setattr(module, "unwrap_result", sound)
        build(store, out)
        pytest.fail("it was not killed")
    assert not out.exists()


def test_a_killed_build_goes_on_and_what_is_half_written_does_not_count(made, store, tmp_path, monkeypatch):
    sampled, sample = [], sampling.sample_on_maps
    monkeypatch.setattr(sampling, "sample_on_maps", lambda *of, **how: (sampled.append(1), sample(*of, **how))[1])
    killed(store.root, tmp_path / "out", sampling, after=3)
    (spool,) = (store.root / "spool").iterdir()
    batches = sorted((spool / "pixels").iterdir())
    assert len(batches) == len(sampled) == 4
    for path, size in zip(batches, (0, 5, batches[2].stat().st_size - 1), strict=False):
        path.write_bytes(path.read_bytes()[:size])
    killed(store.root, tmp_path / "out", content, after=1)
    assert len(sampled) == 4 + 3 + (BATCHES - 4)
    assert len([path for path in (spool / "files").rglob("*") if path.is_file()]) == 2 * 3, "two shards of three layers"
    assert prune(store=store.root, recipe=Recipe(), dry_run=True).removed == (), "it may be going on"
    found = prune(store=store.root, recipe=Recipe(), dry_run=True, min_age_s=0.0).removed
    assert {of.what for of in found} == {"left by a killed call"}
    assert {Path(of.path) for of in found} == {path for path in spool.rglob("*") if path.is_file()}
    build(store.root, tmp_path / "out")
    assert len(sampled) == BATCHES + 3, "nothing is sampled that was there"
    assert files(tmp_path / "out") == files(made / "zarr")
    assert not (store.root / "spool").exists()


def test_who_ends_second_on_one_spool_is_told(store, tmp_path, monkeypatch):
    def first(*of, **how):
        shutil.rmtree(store.root / "spool")
        return write(*of, **how)

    write = build_module.write_patches
    monkeypatch.setattr(build_module, "write_patches", first)
    with pytest.raises(StoreError, match=r"another build of the same dataset was first .* run the same command again"):
        build(store.root, tmp_path / "out")
    monkeypatch.undo()
    assert build(store.root, tmp_path / "out").card.samples == ROWS
