"""Stores and datasets of data models 1.0, 1.4, 2.0 and 2.1, kept as they were written (tests/data/make_kept_store.py)."""

import json
import re
import shutil
import tarfile
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import shapely
from object_gateway import in_environment
from storage_server import object_store

import tcpipe
from tcpipe.errors import DatasetError, UsageError
from tcpipe.formats.maps.map_files import open_map
from tcpipe.formats.place import DirectoryPlace
from tcpipe.formats.seals import write_sealed
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.explain import explain
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.migrate import migrate
from tcpipe.pipeline.report import report
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store
from tcpipe.tables.levels import DATA_MODEL_VERSION, SAMPLES

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(params=["1.0", "1.4"])
def untouched(tmp_path, request):
    """As it was written."""
    with tarfile.open(DATA / f"store-{request.param}.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path


@pytest.fixture(scope="module")
def migrated(tmp_path_factory):
    """That of 1.0, its store brought to this layout."""
    directory = tmp_path_factory.mktemp("migrated")
    with tarfile.open(DATA / "store-1.0.tar.xz") as archive:
        archive.extractall(directory, filter="data")
    assert migrate(directory / "store").exit_code == 0
    return directory


@pytest.fixture
def kept(migrated, tmp_path):
    return shutil.copytree(migrated, tmp_path / "kept")


@pytest.mark.parametrize("name", ["store", "zarr", "parquet"])
def test_all_is_as_it_was_written(kept, name):
    found = verify(kept / name)
    assert found.problems == ()


def test_both_formats_give_the_same_patches_and_labels(kept):
    zarr, parquet = (tcpipe.open_dataset(kept / name) for name in ("zarr", "parquet"))
    assert {name: len(split) for name, split in zarr.items()} == {"train": 8, "test": 2, "unseen": 0, "buffer": 0}
    for name in ("train", "test"):
        assert zarr[name].channels == ("ortho", "terrain", "height")
        np.testing.assert_array_equal(zarr[name].patches, parquet[name].patches)
        np.testing.assert_array_equal(zarr[name].labels, parquet[name].labels)


def test_a_dataset_is_built_of_it(kept):
    assert tuple(open_map(Store(kept / "store").map_path("site")).layers) == ("height", "ortho", "terrain")
    build_dataset(kept / "new", store=kept / "store", recipe=Recipe(), holdout="sample")
    old, new = (tcpipe.open_dataset(kept / name)["train"] for name in ("zarr", "new"))
    assert new.column("sample_id").tolist() == old.column("sample_id").tolist()
    np.testing.assert_allclose(new.patches, old.patches, atol=0.01)  # a rounded grey, a step of half a millimetre
    np.testing.assert_array_equal(new.labels, old.labels)
    sample_id = str(old.column("sample_id")[0])
    assert explain(sample_id, dataset=kept / "zarr", store=kept / "store").facts.sample["sample_id"] == sample_id


def test_columns_added_since_are_null_in_runs_and_datasets(kept):
    build_dataset(kept / "new", store=kept / "store", recipe=Recipe(), holdout="sample")
    later = [column.name for column in SAMPLES.columns if column.since]
    assert {"turn_rad", "energy_above_standing_joule"} <= set(later)
    for name in ("zarr", "parquet", "new"):
        train = tcpipe.open_dataset(kept / name)["train"]
        assert train.samples.column_names == SAMPLES.names()
        for column in later:
            if (name, column) == ("new", "geometry"):  # comes from the patches
                assert set(shapely.get_type_id(shapely.from_wkb(train.column(column)))) == {shapely.GeometryType.POINT}
            else:
                assert np.isnan(train.column(column).astype(float)).all(), column
    assert verify(kept / "new").problems == ()
    with pytest.raises(DatasetError, match="no sample has power_above_standing_watt: its robot hardly stood"):
        tcpipe.open_dataset(kept / "zarr", label="above_standing")


@pytest.mark.parametrize("version", ["2.0", "2.1"])
def test_what_data_model_2_wrote_is_read_as_it_is(tmp_path, version):
    with tarfile.open(DATA / f"store-{version}.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    before = contents(tmp_path)
    found = migrate(tmp_path / "store")
    assert (found.migrated, found.problems, found.exit_code) == ((), (), 0)
    for name in ("store", "zarr", "parquet"):
        assert verify(tmp_path / name).problems == ()
    assert contents(tmp_path) == before
    copied = [str(migrate(tmp_path / "store", tmp_path / "copy")) for _ in range(2)]
    files = len(contents(tmp_path / "copy")) - 1  # but store.json
    assert copied[0].endswith(
        f"0 documents brought to data model {DATA_MODEL_VERSION}, 3 left as they are; {files} files copied"
    )
    assert copied[1].endswith("copy: nothing to do: 3 documents are current")
    (run,) = open_store(tmp_path / "store").runs()
    segments = run.segments()
    assert segments.num_rows > 0
    assert segments.column("geometry").null_count == (segments.num_rows if version == "2.0" else 0)
    train = tcpipe.open_dataset(tmp_path / "zarr")["train"]
    assert (set(train.column("geometry")) == {None}) == (version == "2.0")


def contents(directory):
    return {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", ["zarr", "parquet"])
def test_a_card_is_migrated_once_and_nothing_else_changes(untouched, name):
    before = contents(untouched / name)
    first = migrate(untouched / name)
    assert (first.migrated, first.exit_code) == ((str(untouched / name / "dataset.json"),), 0)
    after = contents(untouched / name)
    assert {path.name for path in after if after[path] != before.get(path)} == {"dataset.json"}
    old, new = (json.loads(files[untouched / name / "dataset.json"]) for files in (before, after))
    assert {key for key in new if new[key] != old[key]} == {"data_model_version", "document_sha256"}
    assert verify(untouched / name).problems == ()
    again = migrate(untouched / name)
    assert (again.migrated, again.exit_code) == ((), 0)
    assert "nothing to do" in str(again)
    assert contents(untouched / name) == after


def test_a_map_alone_is_current(untouched):
    before = contents(untouched / "store" / "maps")
    assert migrate(untouched / "store" / "maps" / "site.zarr").migrated == ()
    assert contents(untouched / "store" / "maps") == before


def names(store, before=()):
    """Names of the files of a store that were not there before, without the digits of hashes."""
    return {
        re.sub(r"[0-9a-f]{8,}", "#", str(path.relative_to(store))) for path in contents(store) if path not in before
    }


def test_a_store_is_asked_to_be_migrated_and_its_tables_stay_where_they_are(untouched):
    store = untouched / "store"
    before = contents(store)
    for ask in (open_store, verify, report, partial(inspect, recipe=Recipe())):
        with pytest.raises(UsageError, match=r"is a store of an earlier data model.*tcpipe migrate"):
            ask(store)
    assert contents(store) == before
    found = migrate(store)
    assert (len(found.migrated), found.problems, found.exit_code) == (3, (), 0)
    after = contents(store)
    assert {path.name for path in before if path not in after} == {"run.json", "manifest.json", "checksums.json"}
    assert {name for name in names(store, before) if not name.startswith("records/")} == {
        "store.json", "runs/tiny-#/run-1.json", "runs/tiny-#/#/manifest-1.json", "maps/site-1.json",
    }  # fmt: skip
    assert all(before[path] == data for path, data in after.items() if path in before)
    assert verify(store).problems == ()
    again = migrate(store)
    assert (again.migrated, again.exit_code) == ((), 0)
    assert str(again).endswith("nothing to do: 3 documents are current")
    assert contents(store) == after
    (run,) = Store(store).runs()
    assert run.manifest.data_model_version == DATA_MODEL_VERSION
    assert Store(store).claim_run("another name", Store(store).run_json(run.run_id).source.sha256) == run.run_id


class _Killed(BaseException):
    pass


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_migration_that_is_killed_at_any_step_is_gone_on_with(untouched, tmp_path, monkeypatch, elsewhere):
    whole, half = (shutil.copytree(untouched / "store", tmp_path / name) for name in ("whole", "half"))
    target = tmp_path / "target" if elsewhere else None
    migrate(whole)
    left = [0]

    def step():
        if not left[0]:
            raise _Killed
        left[0] -= 1

    for name in ("put", "put_new", "delete"):
        monkeypatch.setattr(DirectoryPlace, name, _after(step, getattr(DirectoryPlace, name)))
    for steps in range(200):
        left[0] = steps
        with suppress(_Killed):
            migrate(half, target)
            break
    assert steps >= 5
    got = target or half
    assert {str(path.relative_to(got)): data for path, data in contents(got).items()} == {
        str(path.relative_to(whole)): data for path, data in contents(whole).items()
    }


def _after(step, act):
    def acts(*args, **how):
        step()
        return act(*args, **how)

    return acts


def test_what_is_damaged_or_not_known_is_left_and_named(untouched):
    (manifest,) = (untouched / "store" / "runs").glob("*/*/manifest.json")
    text = manifest.read_text()
    manifest.write_text(text.replace('"husky"', '"jackal"', 1))
    damaged = migrate(untouched / "store")
    assert (len(damaged.migrated), damaged.exit_code) == (2, 3)
    assert "not as it was written" in damaged.problems[0]
    write_sealed(manifest, {**json.loads(text), "data_model_version": "3.0"})
    newer = contents(untouched / "store")
    assert (
        "of data model 3.0, this version knows 1.0, 1.1, 1.2, 1.3, 1.4, 2.0, 2.1"
        in migrate(untouched / "store").problems[0]
    )
    assert contents(untouched / "store") == newer
    with pytest.raises(UsageError, match="is no store, map"):
        migrate(untouched / "site")


def test_a_store_is_brought_into_a_bucket(untouched, tmp_path, monkeypatch):
    (tmp_path / "served" / "tests").mkdir(parents=True)
    before = contents(untouched / "store")
    with object_store(tmp_path / "served") as (environment, _):
        in_environment(monkeypatch, environment, tmp_path / "cache")
        found = migrate(untouched / "store", "s3://tests/my store")
        assert (len(found.migrated), found.exit_code) == (3, 0)
        assert contents(untouched / "store") == before
        assert verify("s3://tests/my store").problems == ()
        assert "nothing to do" in str(migrate("s3://tests/my store"))
        migrate("s3://tests/my store", untouched / "back")
    migrate(untouched / "store")
    assert {path.relative_to(untouched / "back"): data for path, data in contents(untouched / "back").items()} == {
        path.relative_to(untouched / "store"): data for path, data in contents(untouched / "store").items()
    }
