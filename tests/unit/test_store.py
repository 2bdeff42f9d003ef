"""The store, on disk and in a bucket: what readers see of writers that are killed, race, replace or copy by halves."""

import os
import shutil
from pathlib import Path

import pytest
from object_gateway import open_bucket
from storage_server import READ_ONLY
from stored_files import table
from synthetic_store import add_run, change_run, lanes, segments, supersede, tag_run

from tcpipe.errors import MapError, StoreError, UsageError
from tcpipe.formats.documents import scan
from tcpipe.formats.place import Place
from tcpipe.recipe import ReadConfig, Recipe
from tcpipe.store import Store, check_map_name, choose_maps, is_store, name_run, open_store

RUN = "north"


@pytest.fixture(params=["directory", "bucket", "gateway"])
def root(request, tmp_path, monkeypatch):
    """Where a store is to be."""
    if request.param == "directory":
        return tmp_path / "store"
    url = open_bucket(request.param, request, monkeypatch, tmp_path)
    return f"{url}/a store"


def put(store: Store, length_m: float = 10.0, name: str = RUN, **how: object) -> None:
    add_run(store, name, segments(name, *lanes(0.0, 0.0, length_m)), **how)


def counted(store: Store) -> list[int]:
    """Segments of each run, as a reader finds them."""
    return [run.segments().num_rows for run in store.runs()]


def test_a_run_that_is_written_again_replaces_the_one_before_and_recipes_live_side_by_side(root):
    store, other = open_store(root, create=True), Recipe(read=ReadConfig(ignore_topics=["/none"]))
    put(store)
    put(store, 12.0)
    assert counted(store) == [12]
    put(store, 8.0, recipe=other)
    assert sorted(counted(store)) == [8, 12]
    both = store.find_runs(RUN)
    assert [run.name for run in both] == [f"{RUN}/{recipe_id}" for recipe_id in sorted(run.recipe_id for run in both)]
    for run in both:
        assert [found.name for found in store.find_runs(run.name)] == [run.name]
        assert run.manifest.recipe_id == run.recipe_id
    assert store.find_runs(f"{RUN}/nosuch") == store.find_runs("nosuch") == []


def test_tags_are_added_to_those_of_a_log_and_outlive_its_runs(root):
    store = open_store(root, create=True)
    put(store, sha256="f" * 64)
    for tags in ({"driver": "Eva"}, {"weather": "wet"}, {"driver": "Eva"}):
        tag_run(store, RUN, tags)
    wanted = {"driver": "Eva", "weather": "wet"}
    assert len(store.place.list("tags")) == 2, "tags that a log has are not written"
    put(store, 12.0, sha256="f" * 64)
    (run,) = store.runs()
    assert run.facts.tags == run.manifest.tags == wanted
    put(store, 9.0, sha256="f" * 64, recipe=Recipe(read=ReadConfig(ignore_topics=["/none"])))
    assert [run.facts.tags for run in store.runs()] == [wanted, wanted]
    assert b"Eva" not in store.place.read(run.document), "no fact is written twice"


def remove_payload(store, blob):
    if store.place.path is not None:
        shutil.rmtree(store.root / "blobs" / blob)
    for entry in store.place.entries(f"blobs/{blob}"):
        store.place.delete(entry.name)


def test_runs_that_are_superseded_without_payload_or_of_another_data_model_do_not_count(root):
    store = open_store(root, create=True)
    for name in ("a", "b", "c", "d"):
        put(store, name=name)
    supersede(store, "b", "a")
    change_run(store, "c", data_model_version="3.0")
    (blob,) = [row.blob for row in store.scan().list_rows("d")]
    remove_payload(store, blob)
    assert [run.run_id for run in store.runs()] == ["a"]
    assert [row.run_id for row in store.scan().list_rows()] == ["a", "b", "c", "d"]
    assert [run.run_id for run in store.find_runs("b")] == ["b"], "its tables can be looked at"
    with pytest.raises(StoreError, match=rf"run d: its tables are not in .*{Path(root).name}; ingest its log again"):
        store.find_runs("d")


@pytest.mark.parametrize("how", ["cut", "gone", "empty"])
def test_a_table_that_is_not_as_it_was_written_is_named_and_not_used(tmp_path, how):
    store = open_store(tmp_path / "store", create=True)
    put(store)
    (run,) = store.runs()
    path = table(run, "track")
    whole = path.read_bytes()
    path.unlink() if how == "gone" else path.write_bytes(b"" if how == "empty" else whole[:-10])
    wrong = {
        "cut": rf"\({len(whole) - 10} bytes, expected {len(whole)}\)",
        "gone": "is missing",
        "empty": r"\(0 bytes, ",
    }
    with pytest.raises(StoreError, match=rf"track\.parquet: .*{wrong[how]}") as caught:
        run.track()
    assert str(path) in caught.value.problems[0]
    assert store.prove([run])[RUN].startswith(f"{path}: ")
    path.write_bytes(whole)
    assert store.prove([run]) == {}


def test_tables_that_were_compared_are_compared_again_only_when_they_are_written_again(tmp_path, monkeypatch):
    monkeypatch.setenv("TCPIPE_CACHE", str(tmp_path / "cache"))
    store = open_store(tmp_path / "store", create=True)
    for name in ("a", "b", "c"):
        put(store, name=name)
    hashed = set()
    real = Place.read_range
    monkeypatch.setattr(Place, "read_range", lambda place, *rest: (hashed.add(rest[0]), real(place, *rest))[1])

    def compare():
        hashed.clear()
        return store.prove(store.runs()), sum(name.endswith("segments.parquet") for name in hashed)

    assert compare() == ({}, 3)
    assert compare() == ({}, 0)
    path = table(store.runs()[1], "segments")
    data = path.read_bytes()
    os.utime(path, ns=(0, 0))
    assert compare() == ({}, 1)
    path.write_bytes(data[:-9] + b"x" + data[-8:])
    for _ in range(2):
        damaged, count = compare()
        assert (list(damaged), count) == (["b"], 1)


def test_a_store_is_moved_by_copying_its_files_and_two_are_put_together_in_the_same_way(root, tmp_path):
    stores = [open_store(root, create=True), open_store(tmp_path / "second", create=True)]
    for store, name in zip(stores, ("a", "b"), strict=True):
        put(store, name=name)
        for entry in store.place.entries():
            path = tmp_path / "moved" / entry.name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(store.place.read(entry.name))
    assert counted(open_store(tmp_path / "moved")) == [10, 10]


# --- where there is no store ----------------------------------------------------------------------------------------


def test_a_place_is_a_store_as_soon_as_a_document_is_there(root):
    store = open_store(root, create=True)
    assert not is_store(root)
    store.place.put("tags/notes.txt", b"")
    store.place.put("index.parquet", b"")
    assert not is_store(root)
    with pytest.raises(UsageError, match=r"a?.?store: there is no store here; run 'tcpipe ingest' first, or name "):
        open_store(root)
    put(store)
    assert is_store(root)
    assert open_store(root) == store


def test_a_store_of_1_x_is_refused_in_one_line(root):
    Store(root).place.put("store.json", b"{}")
    for create in (False, True):
        with pytest.raises(UsageError) as caught:
            open_store(root, create=create)
        assert caught.value.problems == (f"{root}: made by tcpipe 1.x: ingest the logs again, into a new store",)


@pytest.mark.parametrize("url", ["https://example.org/store", "ftp://example.org/store"])
def test_a_url_of_no_bucket_is_refused(url):
    assert not is_store(url)
    with pytest.raises(UsageError, match=r"no place for a store; expected a directory, s3://bucket/name, gs:// or az:"):
        open_store(url, create=True)


def test_a_file_is_no_store(tmp_path):
    (tmp_path / "store").write_bytes(b"")
    with pytest.raises(UsageError, match="store: is a file, expected a directory for the store"):
        open_store(tmp_path / "store", create=True)


def test_a_bucket_that_cannot_be_written_says_so_where_something_is_written(tmp_path, served):
    (tmp_path / "served" / READ_ONLY).mkdir(parents=True)
    with pytest.raises(StoreError, match=r"s3://read-only/x/.*it cannot be written \(the credentials do not"):
        put(open_store("s3://read-only/x", create=True))
    with pytest.raises(UsageError, match="s3://read-only/x: there is no store here"):
        open_store("s3://read-only/x")
    with pytest.raises(StoreError, match="s3://nosuch"):
        open_store("s3://nosuch/x", create=True)


# --- files in a bucket, maps and names ------------------------------------------------------------------------------


def add_map(store, text, *, before=lambda: None):
    with store.new_map("site") as (directory, put_map):
        directory.mkdir()
        (directory / "tile").write_text(text)
        before()
        put_map(store.scan())


def read_tile(store, record):
    path, fetched = store.map_at(record)
    return (fetched.fetch_file(path / "tile") if fetched else path / "tile").read_bytes()


def test_a_map_that_a_reader_has_found_stays_where_it_is_when_another_takes_its_place(root):
    store = open_store(root, create=True)
    add_map(store, "old")
    old = store.scan().maps["site"]
    add_map(store, "new")
    assert [read_tile(store, record) for record in (old, store.scan().maps["site"])] == [b"old", b"new"]
    assert list(store.scan().maps) == ["site"]
    with pytest.raises(MapError, match="no map 'other' in the store; there are site"):
        choose_maps(store, store.scan(), ["other"])


@pytest.mark.parametrize("name", ["", ".", "../up", "a/b", "-x", "Ä"])
def test_a_name_that_is_no_name_of_a_map_is_refused(name):
    with pytest.raises(StoreError, match="expected letters, digits"):
        check_map_name(name)


def test_two_logs_of_one_name_whose_hashes_begin_alike_are_two_runs(tmp_path):
    store, names = Store(tmp_path), []
    hashes = ["abcdef01" + digit * 56 for digit in "012"] + ["abcdef01" + "0" * 55 + "9"]
    for sha256 in hashes:
        names.append(name_run(store.scan(), "latest", sha256))
        put(store, name=names[-1], sha256=sha256)
    assert names == ["latest-abcdef01", "latest-abcdef011111", "latest-abcdef012222", "latest-abcdef010000"]
    for sha256, name in zip(hashes, names, strict=True):
        assert name_run(scan(store.place), "renamed", sha256) == name
