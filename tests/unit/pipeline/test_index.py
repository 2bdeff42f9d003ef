"""The index of a store: it says what the documents say, costs one look at each file, and is never believed against them."""

import os
from dataclasses import replace

import numpy as np
import polars as pl
import pyarrow.dataset as ds
import pytest
from synthetic_store import add_run, lanes, segments

import tcpipe.store as stores
from tcpipe.formats import index_files, stored_runs
from tcpipe.formats.record_files import Sighting
from tcpipe.pipeline.dataset.runs import choose_runs
from tcpipe.recipe import Recipe
from tcpipe.store import Store

LOG = "logs/" + "a" * 32


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path / "store")
    for number, run_id in enumerate(("a", "b", "c")):
        table = segments(run_id, *lanes(np.array([3.0 * number]), -10.0, 10.0), start_ns=10**18 + number * 10**13)
        add_run(store, run_id, table, tags={"weather": "dry"} if number else {})
    store.keep_index(store.ingestions())
    return store


@pytest.fixture
def read(monkeypatch):
    """The documents that are read, as they are read."""
    paths = []

    def heard(real):
        return lambda place, *rest, **how: (paths.append(place.where(rest[0])), real(place, *rest, **how))[1]

    for module, name in ((stores, "read_sealed_at"), (stores, "read_as_at"), (stored_runs, "read_as_at")):
        monkeypatch.setattr(module, name, heard(getattr(module, name)))
    stored_runs._manifest.cache_clear()
    return paths


def test_the_index_says_what_the_documents_say(store):
    fresh = Store(store.root).ingestions()
    assert not fresh.stale
    for run in fresh.finished:
        made = run.manifest
        assert (run.facts.robot, run.facts.tags, run.facts.segments) == (made.robot, made.tags, 20)
        assert run.facts.driven_m == pytest.approx(sum(made.ledger_m.values()))
        assert run.facts.log.source == store.run_json(run.run_id).source
        stamps = run.table("segments").column("start_ns").to_pylist()
        assert (run.facts.start_ns, run.facts.end_ns) == (min(stamps), max(stamps) + 1_200_000_000)
    assert index_files.read_runs(store.index_place) == fresh.rows


def test_no_document_is_read_again_until_it_is_written_again(store, read):
    assert [run.run_id for run in store.ingestions().finished] == ["a", "b", "c"]
    assert read == []
    store.tag_run("b", {"weather": "wet"})
    read.clear()
    found = store.ingestions()
    assert {path.partition("/runs/")[2][0] for path in read} == {"b"}
    assert found.stale
    assert found.rows["b", found.finished[1].recipe_id].tags == {"weather": "wet"}


@pytest.mark.parametrize("what", [b"", b"PAR1 and then nothing", None])
def test_a_broken_index_is_made_again_and_a_wrong_one_is_not_believed(store, what):
    path, right = store.root / "index" / "runs.parquet", store.ingestions()
    if what is None:  # of another store, copied over
        rows = {key: replace(row, state="1-2-3", robot="other") for key, row in right.rows.items()}
        index_files.write_runs(store.index_place, rows.values())
    else:
        path.write_bytes(what)
    found = store.ingestions()
    assert (found.stale, found.rows) == (True, right.rows)
    store.keep_index(found)
    assert not store.ingestions().stale


def test_a_changed_byte_anywhere_in_the_index_changes_nothing(store):
    path, right, rng = store.root / "index" / "runs.parquet", store.ingestions().rows, np.random.default_rng(0)
    whole = path.read_bytes()
    for at in rng.integers(0, len(whole), 40):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ (1 << int(rng.integers(8)))]) + whole[at + 1 :])
        assert store.ingestions().rows == right, at


def test_a_manifest_that_is_changed_under_the_index_is_told(store):
    (path,) = store.root.glob("runs/b/*/manifest-1.json")
    path.write_text(path.read_text().replace('"husky"', '"other"'))
    found = store.ingestions()
    assert [run.run_id for run in found.finished] == ["a", "c"]
    assert "is not as it was written" in found.damaged["b", path.parent.name]


def test_two_writers_lose_nothing_but_time(store):
    ours = store.ingestions()
    add_run(store, "d", segments("d", *lanes(np.array([20.0]), -10.0, 10.0), start_ns=2 * 10**18))
    store.keep_index(store.ingestions())  # another process, later than our look and earlier than our writing
    store.keep_index(replace(ours, stale=True))
    assert [run.run_id for run in store.ingestions().finished] == ["a", "b", "c", "d"]


def test_files_that_were_proved_are_proved_again_when_they_are_written_again(store, monkeypatch):
    def chosen():
        found = choose_runs(store, Recipe(), robot=None, tags={})
        return [run.run_id for run in found.runs], found.damaged

    hashed = []
    real = stores.RunDirectory.prove
    monkeypatch.setattr(
        stores.RunDirectory, "prove", lambda run, *names: (hashed.append(run.run_id), real(run, *names))
    )
    assert chosen() == (["a", "b", "c"], ())
    assert hashed == ["a", "b", "c"]
    assert chosen() == (["a", "b", "c"], ())
    assert len(hashed) == 3
    (path,) = store.root.glob("runs/b/*/*/segments.parquet")
    data = path.read_bytes()
    os.utime(path, ns=(0, 0))
    assert chosen() == (["a", "b", "c"], ())
    path.write_bytes(data[:-9] + b"x" + data[-8:])
    runs, damaged = chosen()
    assert (runs, len(hashed)) == (["a", "c"], 5)
    assert [(of.code, of.subject.name) for of in damaged] == [("run-damaged", "b")]


def test_logs_that_were_seen_are_read_once_and_damage_is_named(store, caplog):
    sighting = Sighting(("/logs/a.mcap",), ((10, 20),), "f" * 64)
    store.remember(f"{LOG}/one", sighting)
    assert store.seen_logs() == {LOG: [sighting]}
    assert [row.sighting for row in index_files.read_logs(store.index_place).values()] == [sighting]
    path = store.root / "records" / f"{LOG}/one.json"
    path.write_text(path.read_text().replace("f" * 64, "e" * 64))
    assert store.seen_logs() == {}
    assert f"{path}: is not as it was written" in caplog.text


def test_a_name_that_is_no_text_is_in_the_index_and_is_read_from_its_document(store):
    odd, readable = "/logs/a\udcff.mcap", "/logs/a\\udcff.mcap"
    known = store.run_json("a")
    store.write_run_json("a", replace(known, source=replace(known.source, paths=(odd,))))
    store.remember(f"{LOG}/one", Sighting((odd,), ((10, 20),), "f" * 64))
    for _ in range(2):
        found = store.ingestions()
        store.keep_index(found)
        assert found.finished[0].facts.log.source.paths == (odd,)
        assert store.seen_logs()[LOG][0].log == (odd,)
        assert next(iter(index_files.read_runs(store.index_place).values())).log.source.paths == (readable,)
    assert not found.stale


def test_a_store_that_cannot_be_written_is_read_all_the_same(store, monkeypatch):
    monkeypatch.setattr(
        index_files, "write_table", lambda *_: (_ for _ in ()).throw(index_files.StoreError("read-only"))
    )
    (store.root / "index" / "runs.parquet").unlink()
    found = store.ingestions()
    store.keep_index(found)
    assert len(found.finished) == 3
    assert len(choose_runs(store, Recipe(), robot=None, tags={}).runs) == 3


COUNTED = [("a", 20), ("b", 20)]
"""Segments by run, where run c is superseded."""


@pytest.fixture
def superseded(store, monkeypatch):
    store.supersede("c", "b")
    store.keep_index(store.ingestions())
    monkeypatch.chdir(store.root)
    return store


def test_polars_and_arrow_read_the_segments_of_all_runs_by_one_line(superseded):
    files = pl.read_parquet("index/runs.parquet").filter(pl.col("superseded_by").is_null())["segments_file"].to_list()
    for lines in (pl.scan_parquet(files), pl.concat(map(pl.scan_parquet, files), how="diagonal")):
        assert lines.group_by("run_id").agg(pl.len()).sort("run_id").collect().rows() == COUNTED
    assert ds.dataset(files).to_table(columns=["power_watt"]).num_rows == 40
    earlier = pl.read_parquet(files[0]).drop("geometry")
    earlier.write_parquet("earlier.parquet")
    mixed = pl.concat(map(pl.scan_parquet, ["earlier.parquet", *files[1:]]), how="diagonal").collect()
    assert mixed["geometry"].null_count() == earlier.height == 20


def test_duckdb_reads_the_segments_of_all_runs_by_one_line(superseded):
    duckdb = pytest.importorskip("duckdb", reason="duckdb is not installed")
    with duckdb.connect() as of:
        of.sql(
            "SET VARIABLE files = (SELECT list(segments_file) FROM 'index/runs.parquet' WHERE superseded_by IS NULL)"
        )
        every = "FROM read_parquet(getvariable('files'), union_by_name=true)"
        assert of.sql(f"SELECT run_id, count(*) {every} GROUP BY ALL ORDER BY ALL").fetchall() == COUNTED
        assert of.sql(f"SELECT DISTINCT typeof(geometry) {every}").fetchall() == [("GEOMETRY('OGC:CRS84')",)]
