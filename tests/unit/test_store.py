"""The protocol of the store, on disk and in a bucket: what readers see of writers that are killed, race, replace or copy by halves."""

import os
import shutil
import tempfile
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from object_gateway import open_bucket
from storage_server import OVERWRITING, READ_ONLY
from stored_files import manifest, table
from synthetic_store import add_run, commit_run, lanes, segments

from tcpipe.errors import StoreError, UsageError
from tcpipe.formats.place import Place
from tcpipe.pipeline.inspect import inspect
from tcpipe.pipeline.report import report
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store
from tcpipe.tables.findings import Subject, make_finding

RUN = "north"


@pytest.fixture(params=["directory", "bucket", "gateway"])
def root(request, tmp_path, monkeypatch):
    """Where a store is to be."""
    if request.param == "directory":
        return tmp_path / "store"
    url = open_bucket(request.param, request, monkeypatch, tmp_path)
    return f"{url}/a store"


def put(store: Store, length_m: float = 10.0, **how: object) -> None:
    add_run(store, RUN, segments(RUN, *lanes(0.0, 0.0, length_m)), **how)


def contents(store: Store) -> dict[str, bytes | None]:
    """What is there, but for when and by whom it was committed."""
    return {
        entry.name: store.place.read(entry.name) for entry in store.place.entries() if not entry.name.startswith("log/")
    }


def counted(store: Store) -> list[int]:
    """Segments of each run, as a reader finds them."""
    return [run.segments().num_rows for run in store.runs()]


class _Killed(BaseException):
    pass


def test_killed_at_any_step_a_reader_finds_the_generation_before_and_the_next_call_completes(root, monkeypatch):
    left = [0]

    def step():
        if not left[0]:
            raise _Killed
        left[0] -= 1

    def killing(act):
        def acts(*args, **how):
            step()
            found = act(*args, **how)
            step()
            return found

        return acts

    undisturbed, store = (open_store(f"{root}-{name}", create=True) for name in "ab")
    for each in (undisturbed, store):
        put(each)
    put(undisturbed, 12.0)
    with monkeypatch.context() as patch:
        for name in ("put", "put_new", "put_files", "delete"):
            patch.setattr(Place, name, killing(getattr(Place, name)))
        for steps in range(100):
            left[0] = steps
            with suppress(_Killed):
                put(store, 12.0)
                break
            assert counted(store) in ([10], [12])
    assert steps > 3
    assert counted(store) == [12]
    assert contents(store) == contents(undisturbed)
    assert [replace(row, commit=0) for row in store.state().runs.values()] == [
        replace(row, commit=0) for row in undisturbed.state().runs.values()
    ]
    assert verify(store.root).problems == ()


def test_of_two_who_make_a_run_the_first_wins_and_what_replaces_it_is_a_new_number(root):
    store = open_store(root, create=True)
    put(store)
    (first,) = store.runs()
    tables = {"track": first.track().table, "segments": first.segments(), "rejections": first.rejections()}

    class _Level:
        def __init__(self, table: object, rejections: object = None) -> None:
            self.table, self.rejections = table, rejections

    def write(file: str, *, force: bool = False) -> object:
        made = replace(first.manifest, damage=(make_finding("file-cut", Subject("file", file)),), checksums={})
        levels = {"track": _Level(None, tables["rejections"]), "masked": _Level(tables["track"])}
        made = store.write_run(made, **levels, labelled=_Level(tables["segments"]), settled=lambda _: not force)
        return [of.subject.name for of in made.damage]

    assert write("mine") == []
    assert write("mine", force=True) == ["mine"]
    assert write("mine", force=True) == ["mine"]
    assert store.runs()[0].manifest.damage == (), "no commit names the new one yet"
    commit_run(store, RUN)
    assert store.runs()[0].place.files() == ["manifest-1.json", "manifest-2.json"]
    assert [of.subject.name for of in store.runs()[0].manifest.damage] == ["mine"]


def test_tags_of_two_writers_are_both_kept(root, monkeypatch):
    store = open_store(root, create=True)
    put(store)
    place = type(store.place)
    put_new = place.put_new

    def later(self, name, data):
        monkeypatch.setattr(place, "put_new", put_new)
        assert store.tag_run(RUN, {"driver": "Eva"})
        return put_new(self, name, data)

    monkeypatch.setattr(place, "put_new", later)
    assert store.tag_run(RUN, {"weather": "wet"})
    assert not store.tag_run(RUN, {"driver": "Eva"})
    wanted = {"driver": "Eva", "weather": "wet"}
    commit_run(store, RUN)
    assert store.run_json(RUN).tags == store.runs()[0].manifest.tags == wanted


def test_what_a_copier_left_by_halves_is_named_and_not_used(tmp_path):
    store = open_store(tmp_path / "store", create=True)
    put(store)
    (run,) = store.runs()
    path = table(run, "track")
    whole = path.read_bytes()
    path.write_bytes(whole[:-10])
    assert store.runs() == []
    assert f"track.parquet: has {len(whole) - 10} bytes, expected {len(whole)}" in next(
        iter(store.ingestions().damaged.values())
    )
    path.unlink()
    assert "track.parquet: is missing" in next(iter(store.ingestions().damaged.values()))
    path.write_bytes(whole)
    manifest(run).unlink()
    (line,) = inspect(store.root, recipe=Recipe()).damaged_runs.values()
    assert line.endswith("manifest-1.json: is missing; ingest the log again")
    (store.root / "store.json").unlink()
    with pytest.raises(UsageError, match="an incomplete copy of a store"):
        open_store(store.root)


def test_a_store_is_moved_by_copying_its_files(root, tmp_path):
    store = open_store(root, create=True)
    put(store)
    for entry in store.place.entries():
        path = tmp_path / "moved" / entry.name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(store.place.read(entry.name))
    assert counted(Store(tmp_path / "moved")) == [10]
    assert verify(tmp_path / "moved").problems == ()


def test_what_a_killed_call_left_on_this_machine_goes_when_a_store_is_opened(tmp_path, monkeypatch, served):
    (tmp_path / f"tcpipe-{os.getuid()}-0123abcd" / "new").mkdir(parents=True)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    open_store("s3://tests/store", create=True)
    assert not list(tmp_path.glob("tcpipe-*"))


def test_a_store_of_another_data_model_is_refused_in_one_line(tmp_path, monkeypatch):
    with monkeypatch.context() as later:
        later.setattr("tcpipe.formats.run_documents.DATA_MODEL_VERSION", "3.0")
        open_store(tmp_path / "store", create=True)
    for ask in (open_store, verify, report, partial(inspect, recipe=Recipe())):
        with pytest.raises(UsageError) as caught:
            ask(tmp_path / "store")
        expected = f"{tmp_path / 'store'}: made by tcpipe 1.x (data model 3.0), expected 4.0: ingest the logs again"
        assert caught.value.problems == (expected,)


def test_a_bucket_that_keeps_no_two_writers_apart_or_cannot_be_written_is_refused(tmp_path, served):
    for name in (OVERWRITING, READ_ONLY):
        (tmp_path / "served" / name).mkdir(parents=True)
    overwrites = r"s3://overwriting/x: this object store overwrites what is there"
    with pytest.raises(StoreError, match=overwrites):
        open_store("s3://overwriting/x", create=True)
    with pytest.raises(StoreError, match=overwrites):
        open_store("s3://overwriting/x", create=True).check_writable()
    with pytest.raises(
        StoreError, match=r"s3://read-only/x/store.json: it cannot be written \(the credentials .*; name another"
    ):
        open_store("s3://read-only/x", create=True)
    with pytest.raises(UsageError, match="s3://read-only/x: there is no store here"):
        open_store("s3://read-only/x")


def test_a_table_in_a_bucket_is_fetched_once_and_proved(tmp_path, served):
    store = open_store("s3://tests/store", create=True)
    put(store)
    for _ in range(2):
        assert counted(store) == [10]
    assert sum(name.endswith("segments.parquet") for name in served) == 1
    for copy in filter(Path.is_file, (tmp_path / "cache").rglob("*")):
        copy.write_bytes(b"x" * copy.stat().st_size)
    assert counted(store) == [10], "what is damaged here is fetched anew"
    (path,) = (tmp_path / "served").rglob("segments.parquet")
    path.write_bytes(b"x" * path.stat().st_size)
    shutil.rmtree(tmp_path / "cache")
    with pytest.raises(StoreError, match=r"s3://tests/store/runs/north/.*/segments.parquet: its sha256 is"):
        store.runs()[0].segments()
    assert any("segments.parquet: its sha256 is" in problem for problem in verify("s3://tests/store").problems)


def test_a_map_whose_answer_is_lost_is_there_and_one_that_another_adds_first_stays(served):
    store = open_store("s3://tests/store", create=True)

    def add(text):
        with store.new_map("site") as directory:
            directory.mkdir()
            (directory / "tile").write_text(text)
            served.lost = 3

    add("mine")
    assert store.maps() == ["site"]
    with pytest.raises(StoreError, match="another process has written it meanwhile"):
        add("another's")


@pytest.mark.parametrize("name", ["store.json", "manifest-1.json", "run-1.json", "track.parquet"])
def test_a_file_of_no_bytes_is_named_and_nothing_is_made_of_it(tmp_path, name):
    store = open_store(tmp_path / "store", create=True)
    put(store)
    next(store.root.rglob(name)).write_bytes(b"")
    assert any(name in problem for problem in verify(store.root).problems)
    if name == "store.json":
        with pytest.raises(StoreError, match=r"store\.json: "):
            open_store(store.root)
    elif name != "run-1.json":
        assert store.runs() == []
        put(store)
        assert counted(store) == [10]


def test_paths_lead_to_runs_and_recipes(root):
    store = open_store(root, create=True)
    put(store)
    (run,) = store.runs()
    for path in (f"{root}/runs/{RUN}", run.where):
        found = verify(path if "://" in str(path) else Path(path))
        assert (found.kind, found.problems) == ("run", ())


def test_the_map_of_a_document_stays_where_it_is_when_another_takes_its_place(root):
    store = open_store(root, create=True)

    def add(text, after):
        with store.new_map("site", after=after) as directory:
            directory.mkdir()
            (directory / "tile").write_text(text)

    add("old", 0)
    old = store.map_document("site")
    add("new", 1)
    for (path, fetched), text in ((store.map_at(old), b"old"), (store.map_files("site"), b"new")):
        assert (fetched.fetch_file(path / "tile") if fetched else path / "tile").read_bytes() == text
