"""Rows of runs: the log has what the documents say, and the index, for other tools, what the log has; tcpipe never reads it."""

import os
from dataclasses import replace

import numpy as np
import polars as pl
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from synthetic_store import add_run, commit_run, lanes, segments, supersede
from tcpipe.formats.commits import Entries, LogSnapshot

import tcpipe.store as stores
from tcpipe.errors import StoreError
from tcpipe.formats import stored_runs
from tcpipe.pipeline.calls import open_log
from tcpipe.pipeline.dataset.runs import choose_runs
from tcpipe.recipe import Recipe
from tcpipe.store import Store


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path / "store")
    for number, run_id in enumerate(("a", "b", "c")):
        table = segments(run_id, *lanes(np.array([3.0 * number]), -10.0, 10.0), start_ns=10**18 + number * 10**13)
        add_run(store, run_id, table, tags={"weather": "dry"} if number else {})
    store.write_index(store.state())
    return store


@pytest.fixture
def read(monkeypatch):
    """The documents that are read, as they are read."""
    paths = []

    def heard(real):
        return lambda place, *rest, **how: (paths.append(place.where(rest[0])), real(place, *rest, **how))[1]

    for module in (stores, stored_runs):
        monkeypatch.setattr(module, "read_as_at", heard(module.read_as_at))
    stored_runs._read_manifest.cache_clear()
    return paths


def test_the_log_says_what_the_documents_say(store):
    for run in store.ingestions().finished:
        made = run.manifest
        assert (run.facts.robot, run.facts.tags, run.facts.segments) == (made.robot, made.tags, 20)
        assert run.facts.driven_m == pytest.approx(sum(made.distance_by_reason_m.values()))
        assert run.facts.log.source == store.run_json(run.run_id).source
        stamps = run.table("segments").column("start_ns").to_pylist()
        assert (run.facts.start_ns, run.facts.end_ns) == (min(stamps), max(stamps) + 1_200_000_000)


def test_no_document_is_read_to_choose_runs(store, read):
    assert [run.run_id for run in store.ingestions().finished] == ["a", "b", "c"]
    assert read == []
    store.tag_run("b", {"weather": "wet"})
    commit_run(store, "b")
    assert {path.partition("/runs/")[2][0] for path in read} == {"b"}
    assert store.ingestions().finished[1].facts.tags == {"weather": "wet"}


def test_whatever_lies_in_the_index_decides_nothing(store):
    right = store.ingestions()
    for path in (store.root / "index").iterdir():
        path.write_bytes(b"PAR1 and then nothing")
    assert store.ingestions() == right
    assert [run.run_id for run in choose_runs(store, Recipe(), robot=None, tags={}).runs] == ["a", "b", "c"]


def test_files_that_were_proved_are_proved_again_when_they_are_written_again(store, monkeypatch):
    def chosen():
        found = choose_runs(store, Recipe(), robot=None, tags={})
        return [run.run_id for run in found.runs], found.damaged

    hashed = []
    real = stores.RunDirectory.file

    def read(run, name):
        if name == "segments.parquet":
            hashed.append(run.run_id)
        return real(run, name)

    monkeypatch.setattr(stores.RunDirectory, "file", read)
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


def test_a_name_that_is_no_text_is_in_the_log_and_with_escapes_in_the_index(store):
    odd, readable = "/logs/a\udcff.mcap", "/logs/a\\udcff.mcap"
    known = store.run_json("a")
    store.write_run_json("a", replace(known, source=replace(known.source, paths=(odd,))))
    commit_run(store, "a")
    log = open_log(store)
    for number in range(70):  # so many that a snapshot is written
        log.commit("seen", Entries(seen=(LogSnapshot((odd,), ((number, 20),), "f" * 64),)))
    assert log.state.snapshot
    for state in (log.state, store.state()):
        assert next(iter(state.runs.values())).log.source.paths == (odd,)
        assert state.seen[odd][0].log == (odd,)
    store.write_index(log.state)
    assert pl.read_parquet(store.root / "index" / "runs.parquet")["log"][0]["source"]["paths"] == [readable]


def test_a_store_that_cannot_be_written_is_read_all_the_same(store, monkeypatch):
    def refused(*_, **__):
        raise StoreError("read-only")

    for verb in ("put", "put_new", "delete"):
        monkeypatch.setattr(type(store.place), verb, refused)
    store.write_index(store.state())
    assert len(store.ingestions().finished) == 3
    assert len(choose_runs(store, Recipe(), robot=None, tags={}).runs) == 3


def test_the_index_has_the_runs_of_its_state(store):
    path = store.root / "index" / "runs.parquet"
    add_run(store, "d", segments("d", *lanes(np.array([9.0]), -10.0, 10.0)))
    store.tag_run("a", {"weather": "wet", "crop": "rye"})
    commit_run(store, "a")
    supersede(store, "c", "b")
    key = next(key for key in store.state().runs if key[0] == "b")
    open_log(store).commit("pruned", Entries(removed=(key,)))
    store.write_index(store.state())
    rows = pq.read_table(path).to_pylist(maps_as_pydicts="strict")
    facts = store.state().runs
    assert [(row["run_id"], row["recipe_id"]) for row in rows] == sorted(facts)
    for row, known in zip(rows, (facts[key] for key in sorted(facts)), strict=True):
        plain = {name: getattr(known, name) for name in ("robot", "segments", "driven_m", "start_ns", "superseded_by")}
        assert row == row | plain | {"tags": dict(known.tags), "damage": [entry.code for entry in known.damage]}
        assert row["log"]["source"]["sha256"] == known.log.source.sha256
    assert rows[0]["tags"] == {"crop": "rye", "weather": "wet"}


COUNTED = [("a", 20), ("b", 20)]
"""Segments by run, where run c is superseded."""


@pytest.fixture
def superseded(store, monkeypatch):
    supersede(store, "c", "b")
    store.write_index(store.state())
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
