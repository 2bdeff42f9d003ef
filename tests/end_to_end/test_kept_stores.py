"""Stores and datasets of data models 2.0 and 2.1, kept as they were written (tests/data/make_kept_store.py)."""

import json
import os
import re
import shutil
import tarfile
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import shapely
from changed_drives import make
from installed_command import run_script
from object_gateway import in_environment
from storage_server import object_store

import tcpipe
from tcpipe.errors import DatasetError, StoreError, UsageError
from tcpipe.formats.integrity import seal_document, write_sealed
from tcpipe.formats.json_files import to_json
from tcpipe.formats.logs.writing import write_mcap
from tcpipe.formats.maps.map_files import open_map
from tcpipe.formats.place import Place
from tcpipe.pipeline import migrate as migrating
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.explain import explain
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.migrate import migrate
from tcpipe.pipeline.report import report
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store
from tcpipe.tables.levels import DATA_MODEL_VERSION, SAMPLES
from tcpipe.tables.options import EARLIER_DOCUMENT_KEYS

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(params=["2.0", "2.1"])
def untouched(tmp_path, request):
    """As it was written."""
    with tarfile.open(DATA / f"store-{request.param}.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path


@pytest.fixture(scope="module")
def migrated(tmp_path_factory):
    """That of 2.0, its store and datasets brought to this data model."""
    directory = tmp_path_factory.mktemp("migrated")
    with tarfile.open(DATA / "store-2.0.tar.xz") as archive:
        archive.extractall(directory, filter="data")
    for name in ("store", "zarr", "parquet"):
        assert migrate(directory / name).exit_code == 0
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
    assert tuple(open_map(Store(kept / "store").map_files("site")[0]).layers) == ("height", "ortho", "terrain")
    build_dataset(kept / "new", store=kept / "store", recipe=Recipe(), holdout="sample")
    old, new = (tcpipe.open_dataset(kept / name)["train"] for name in ("zarr", "new"))
    assert new.column("sample_id").tolist() == old.column("sample_id").tolist()
    np.testing.assert_allclose(new.patches, old.patches, atol=0.01)  # a rounded grey, a step of half a millimetre
    np.testing.assert_array_equal(new.labels, old.labels)
    sample_id = str(old.column("sample_id")[0])
    assert explain(sample_id, dataset=kept / "zarr", store=kept / "store").facts.sample["sample_id"] == sample_id
    # A column added since is null in datasets of before.
    for name in ("zarr", "parquet", "new"):
        train = tcpipe.open_dataset(kept / name)["train"]
        assert train.samples.column_names == SAMPLES.names()
        shapes = {None} if name != "new" else {shapely.GeometryType.POINT}  # comes from the patches
        found = train.column("geometry")
        assert (set(found) if name != "new" else set(shapely.get_type_id(shapely.from_wkb(found)))) == shapes
    assert verify(kept / "new").problems == ()


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
    changed = {key for key in {*old, *new} if new.get(key) != old.get(key)}
    assert changed <= {
        "data_model_version", "document_sha256", "warnings", "problems", "findings", "runs", "split", "maps", "verdict",
        "recipe", "removal", "ledger_m", "distance_by_reason_m", "doubtful", "flagged_samples",
    }  # fmt: skip
    assert new["distance_by_reason_m"] == {
        EARLIER_DOCUMENT_KEYS.get(key, key): of for key, of in old["ledger_m"].items()
    }
    assert new["recipe"]["mask"]["stationary_velocity_mps"] == old["recipe"]["gate"]["standing_velocity_mps"]
    assert old["split"].items() <= {**new["recipe"]["split"], **new["split"]}.items(), "nothing is lost with it"
    assert verify(untouched / name).problems == ()
    again = migrate(untouched / name)
    assert (again.migrated, again.exit_code) == ((), 0)
    assert "nothing to do" in str(again)
    assert contents(untouched / name) == after


def test_a_dataset_that_0_8_wrote_into_a_bucket_is_migrated_there_and_read(untouched, monkeypatch):
    ours = untouched / "served" / "sets" / "ds"
    shutil.copytree(untouched / "zarr", ours)
    with object_store(untouched / "served") as (environment, _):
        in_environment(monkeypatch, environment, untouched / "cache")
        with pytest.raises(DatasetError, match=r"run .tcpipe migrate. on it"):
            tcpipe.open_dataset("s3://sets/ds")
        assert migrate("s3://sets/ds").migrated == ("s3://sets/ds/dataset.json",)
        assert migrate("s3://sets/ds").migrated == ()
        migrate(untouched / "zarr")
        assert contents(ours).keys() == {
            ours / of.relative_to(untouched / "zarr") for of in contents(untouched / "zarr")
        }
        ours_read, theirs = (tcpipe.open_dataset(path)["train"] for path in ("s3://sets/ds", untouched / "zarr"))
        assert np.array_equal(ours_read.patches, theirs.patches)
        assert verify("s3://sets/ds").problems == ()


@pytest.mark.parametrize("untouched", ["2.0"], indirect=True)
def test_the_upgrade_notes_work_as_they_are_written(untouched):
    """Of a store that 0.8 wrote, whose own log is gone, and a new log away from its map."""
    page = (DATA.parents[1] / "CHANGELOG.md").read_text()
    (script,) = re.findall(r"^### Upgrade.*?^```bash\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (untouched / "store").rename(untouched / "tcpipe-store")
    (untouched / "zarr").rename(untouched / "dataset")
    (untouched / "logs").mkdir()
    write_mcap(untouched / "logs" / "run.mcap", make().messages)
    around = shapely.box(17.59, 46.99, 17.61, 47.0)
    (untouched / "region.geojson").write_text(shapely.to_geojson(around))
    printed = run_script(script, cwd=untouched, env=dict(os.environ))
    assert "no such" not in printed
    assert "see tcpipe" not in printed
    assert "code: tcpipe_version 0." in printed
    old, new = (tcpipe.open_dataset(untouched / name) for name in ("dataset", "dataset-1.0"))
    assert sum(map(len, old.values())) == sum(map(len, new.values())) == 10
    assert len(open_store(untouched / "tcpipe-store").runs()) == 2


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
        with pytest.raises(UsageError, match=r"is a store of data model 2\..*tcpipe migrate"):
            ask(store)
    assert contents(store) == before
    found = migrate(store)
    assert (len(found.migrated), found.problems, found.exit_code) == (2, (), 0)
    after = contents(store)
    assert not any("records" in path.parts for path in after)
    assert {path.name for path in before if after.get(path, before[path]) != before[path]} - {"runs.parquet"} == {
        "store.json", "run-1.json", "manifest-1.json",
    }  # fmt: skip
    assert names(store, before) - {"index/runs.parquet"} == {"log/#.json"}
    assert verify(store).problems == ()
    again = migrate(store)
    assert (again.migrated, again.exit_code) == ((), 0)
    assert str(again).endswith("nothing to do: 2 documents are current")
    assert contents(store) == after
    (run,) = Store(store).runs()
    assert run.manifest.data_model_version == DATA_MODEL_VERSION
    state = Store(store).state()
    assert (len(state.seen), len(state.datasets), len(state.calls)) == (1, 2, 3)
    assert state.find_run(run.facts.log.source.sha256) == run.run_id
    assert run.facts.log.outline


WARNED = ("imu: 0.1 s late", "gnss: no placement")


def test_sentences_of_manifests_and_cards_become_findings():
    manifest = {
        "data_model_version": "2.1", "run_id": "a", "warnings": list(WARNED), "damage": ["cut"],
        "info": {"findings": {"warnings": [], "facts": {"n": 1}}, "datum": None}, "counts": {"segments": 3, "gnss_messages": 9},
        "recipe": {},
    }  # fmt: skip
    brought = migrating._bring_document(manifest, "manifest-1.json")
    assert (brought["data_model_version"], brought["info"]["report"]["facts"]) == (DATA_MODEL_VERSION, {"n": 1})
    assert [
        (of["code"], of["subject"]["name"], of["names"]["text"]) for of in brought["info"]["report"]["findings"]
    ] == [("earlier-warning", "a", line) for line in WARNED]
    assert brought["verdict"]["position"] == "usable", "a note changes no verdict"
    assert [of["names"]["text"] for of in brought["damage"]] == ["cut"]
    assert brought["counts"] == {"segments": 3, "messages": {"gnss": 9}}
    assert migrating._bring_document(brought, "manifest-1.json") is brought
    card = {
        "data_model_version": "2.1", "name": "d", "problems": [WARNED[0]], "warnings": [WARNED[1]], "findings": [{"example": "x"}],
        "runs": [{"run_id": "a", "warnings": list(WARNED)}], "maps": [{"name": "m", "warnings": []}], "recipe": {},
        "split": {"holdout": "block", "buffer_m": 1.4, "audit": []},
    }  # fmt: skip
    brought = migrating._bring_document(card, "dataset.json")
    assert [of["names"]["text"] for of in brought["findings"]] == list(WARNED)
    assert brought["split"] == {"buffer_m": 1.4, "audit": []}, "the recipe has the rules"
    assert ([len(of["findings"]) for of in brought["runs"]], brought["maps"]) == ([2], [{"name": "m", "findings": []}])
    with pytest.raises(StoreError, match=r"of data model 4\.0, this version knows 2\.0, 2\.1, 3\.0; left as it is"):
        migrating._bring_document({"data_model_version": "4.0"}, "dataset.json")


def test_what_is_remembered_becomes_commits(untouched):
    store, place = untouched / "store", Store(untouched / "store").place
    trouble = {"content": "c", "lines": ["cut"], "log": ["/logs/b.bag"], "run_id": None, "kind": "failed"}
    records = {
        "failed/k": {**trouble, "version": "0.9.0"},
        "accepted/a": trouble,
        "superseded/2": {"run_id": "a", "by": None, "number": 1},
        "superseded/1": {"run_id": "a", "by": "b", "number": 0},
        "superseded/3": {"run_id": "c", "by": "b", "number": 0},
        "replaced/1": {"out": "/out", "inputs": "1"},
        "datasets/1": {"out": "/out", "inputs": "1", "runs": []},
    }
    for name, record in records.items():
        place.put(f"records/{name}.json", to_json(seal_document(record)).encode())
    place.put("records/logs/x/y.json", b"damaged")
    found = migrate(store)
    assert (len(found.problems), found.exit_code) == (1, 3)
    state = Store(store).state()
    assert (list(state.failed), list(state.acknowledged)) == (["k"], ["log-failed c "])
    assert state.superseded == {"c": "b"}
    assert "/out" not in {out for out, _ in state.datasets}


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

    for name in ("put", "put_new", "put_files", "delete"):
        monkeypatch.setattr(Place, name, _after(step, getattr(Place, name)))
    for steps in range(200):
        left[0] = steps
        with suppress(_Killed):
            migrate(half, target)
            break
    assert steps >= 4
    got = target or half
    assert settled(got) == settled(whole)
    rows, others = ([*Store(place).state().runs.values()] for place in (got, whole))
    assert [replace(row, commit=0) for row in rows] == [replace(row, commit=0) for row in others]
    assert verify(got).problems == ()


def test_each_file_that_is_copied_is_checked_by_its_digest(untouched, tmp_path):
    store, target = untouched / "store", tmp_path / "target"
    migrate(store, target)
    (there,) = target.glob("runs/*/*/*/track.parquet")
    whole = there.read_bytes()
    there.write_bytes(whole[:-1] + b"?")
    assert migrate(store, target).copied == 3, "the folder with the changed file"
    assert there.read_bytes() == whole
    (table,) = store.glob("maps/site/*/site.png")
    table.write_bytes(table.read_bytes()[:-1] + b"?")
    found = migrate(store, tmp_path / "other")
    assert (found.exit_code, len(found.problems)) == (3, 1)
    assert re.search(r"site\.png: its sha256 is .*; not copied", found.problems[0])
    assert not list((tmp_path / "other").glob("maps/**/*.*"))


def settled(store):
    """What a store holds but for when and by whom it was committed."""
    return {
        str(path.relative_to(store)): data
        for path, data in contents(store).items()
        if not {"log", "index", "records"} & set(path.relative_to(store).parts)
    }


def _after(step, act):
    def acts(*args, **how):
        step()
        return act(*args, **how)

    return acts


def test_what_is_damaged_or_not_known_is_left_and_named(untouched):
    (manifest,) = (untouched / "store" / "runs").glob("*/*/manifest-1.json")
    text = manifest.read_text()
    manifest.write_text(text.replace('"husky"', '"jackal"', 1))
    damaged = migrate(untouched / "store")
    assert (len(damaged.migrated), damaged.exit_code) == (1, 3)
    assert "has changed since it was written" in damaged.problems[0]
    write_sealed(untouched / "store" / "store.json", {"data_model_version": "4.0"})
    with pytest.raises(UsageError, match=r"is of data model 4\.0, this version knows 2\.0, 2\.1, 3\.0"):
        migrate(untouched / "store")
    with pytest.raises(UsageError, match="is no store, map"):
        migrate(untouched / "site")


def test_what_a_killed_migration_left_goes_with_the_next_one_and_empty_folders_are_no_problem(untouched):
    store = untouched / "store"
    migrate(store)
    (store / ".tmp-new-01234567").mkdir()
    (store / "records" / "calls").mkdir(parents=True)
    assert migrate(store).exit_code == 0
    assert not list(store.glob(".tmp-*"))
    assert verify(store).problems == ()


def test_a_store_is_brought_into_a_bucket(untouched, tmp_path, monkeypatch):
    (tmp_path / "served" / "tests").mkdir(parents=True)
    before = contents(untouched / "store")
    with object_store(tmp_path / "served") as (environment, _):
        in_environment(monkeypatch, environment, tmp_path / "cache")
        found = migrate(untouched / "store", "s3://tests/my store")
        assert (len(found.migrated), found.exit_code) == (2, 0)
        assert contents(untouched / "store") == before
        assert verify("s3://tests/my store").problems == ()
        assert "nothing to do" in str(migrate("s3://tests/my store"))
        migrate("s3://tests/my store", untouched / "back")
        assert Store(untouched / "back").state() == Store("s3://tests/my store").state()
    migrate(untouched / "store")
    assert settled(untouched / "back") == settled(untouched / "store")
    assert verify(untouched / "back").problems == ()
