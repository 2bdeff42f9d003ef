"""Documents of a store: which of them count, what damage does to them, and the index that caches them."""

import hashlib
import random
import shutil
import subprocess
import sys
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from object_gateway import open_bucket

from tcpipe.errors import StoreError
from tcpipe.formats import documents
from tcpipe.formats.documents import (
    INDEX,
    KINDS,
    Name,
    State,
    find_strange_files,
    make_key,
    parse_name,
    put_document,
    read_record,
    scan,
)
from tcpipe.formats.place import Place
from tcpipe.formats.runs import Call, LogFailure, Output, Tags


@pytest.fixture(params=["directory", "bucket"])
def place(request, tmp_path, monkeypatch):
    monkeypatch.setenv("TCPIPE_CACHE", str(tmp_path / "cache"))
    if request.param == "directory":
        return Place(tmp_path / "store")
    url = open_bucket(request.param, request, monkeypatch, tmp_path)
    return Place(f"{url}/store")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.setenv("TCPIPE_CACHE", str(tmp_path / "cache"))
    return Place(tmp_path / "store")


KEY = make_key("a log")


def tags(**values):
    return Tags("a log", values)


def put(place, state, record, key=KEY):
    return put_document(place, state, "tags", key, record)


def put_many(place, count, state=None):
    """Write the tags of so many logs."""
    state = scan(place) if state is None else state
    for number in range(count):
        put_document(place, state, "tags", make_key(f"log {number}"), Tags(f"log {number}", {"number": str(number)}))
    return state


def scan_anew(place):
    """Return the state as another process would find it: nothing is remembered."""
    documents._DECODED.clear()
    return scan(place)


def describe(state):
    """Return all that a state says, but not how many documents were read for it."""
    return replace(state, read=0, replaced=sorted(state.replaced), damaged=sorted(state.damaged))


# --- names ----------------------------------------------------------------------------------------------------------


def test_the_name_of_a_document_has_kind_key_number_and_the_digest_of_its_bytes(place):
    state = scan(place)
    assert state.is_new
    names = [put(place, state, tags(soil=soil)) for soil in ("dry", "wet")]
    for number, name in enumerate(names, 1):
        data = place.read(name)
        assert name == f"tags/{KEY}.{number}.{hashlib.sha256(data).hexdigest()[:16]}.json"
        assert str(parse_name("tags", name.removeprefix("tags/"))) == name
    assert not scan_anew(place).is_new


@pytest.mark.parametrize(
    "file", ["", "notes.txt", f"{KEY}.1.json", f"{KEY}.x.{KEY}.json", f"{KEY}.1.{KEY[:-1]}.json", f"{KEY}.1.{KEY}.tmp"]
)
def test_a_file_of_another_form_of_name_is_no_document(here, file):
    assert parse_name("tags", file) is None
    before = put_many(here, 1)
    if file:
        here.put(f"tags/{file}", b"{}")
        assert [*find_strange_files(here)] == [f"tags/{file}"]
    assert describe(scan_anew(here)) == describe(before)


# --- which document counts ------------------------------------------------------------------------------------------


def test_the_highest_number_counts_and_a_writer_takes_one_more(place):
    state = scan(place)
    for soil in ("dry", "wet"):
        put(place, state, tags(soil=soil))
    late = State()  # of a writer that has seen nothing
    assert parse_name("tags", put(place, late, tags(soil="old")).removeprefix("tags/")).number == 1
    found = scan_anew(place)
    assert found.find_tags("a log") == {"soil": "wet"}
    assert found.highest["tags", KEY] == 2
    assert len(found.replaced) == 2
    put(place, found, tags(soil="snow"))
    assert scan_anew(place).find_tags("a log") == found.find_tags("a log") == {"soil": "snow"}


def test_bytes_that_differ_from_their_digest_are_no_document_and_the_one_before_counts(place):
    state = scan(place)
    names = [put(place, state, tags(soil=soil)) for soil in ("dry", "wet", "snow")]
    for name in names[1:]:
        place.put(name, place.read(name)[:-9])
    found = scan_anew(place)
    assert found.find_tags("a log") == {"soil": "dry"}
    assert sorted(found.damaged) == sorted(names[1:])
    assert [(of.finding.code, of.finding.subject.name) for of in found.problems] == [
        ("document-damaged", name) for name in sorted(names[1:])
    ]
    with pytest.raises(StoreError, match=r"is missing or has changed since it was written; 'tcpipe verify' lists all"):
        read_record(place, names[2], Tags)
    put(place, found, tags(soil="mud"))
    assert scan_anew(place).find_tags("a log") == {"soil": "mud"}, "its number is above those that are damaged"


RECORDS = {
    "tags": [Tags("a", {"soil": soil}) for soil in ("dry", "wet")],
    "failed": [LogFailure("c", ("/logs/b.bag",), ("cut",), version) for version in ("1", "2")],
    "outputs": [Output(where="/out", exit_code=code) for code in (0, 1)],
    "calls": [Call(command="ingest", version="1", exit_code=code) for code in (None, 0)],
}
WRITES = st.lists(
    st.tuples(st.sampled_from([*RECORDS]), st.integers(0, 2), st.integers(1, 3), st.integers(0, 1)), max_size=12
)


@settings(max_examples=50)
@given(writes=WRITES, damaged=st.sets(st.integers(0, 11)), seed=st.integers(0, 2**16))
def test_a_state_is_a_function_of_the_documents_in_whatever_order_they_are_written_and_listed(
    tmp_path_factory, writes, damaged, seed
):
    """Also of documents that arrive twice, as two copies of a store that are put together have them."""
    files = {}
    for turn, (kind, key, number, value) in enumerate(writes):
        data = documents.to_json(RECORDS[kind][value]).encode()
        name = Name(kind, make_key(key), number, hashlib.sha256(data).hexdigest()[:16])
        files[str(name)] = data[:-1] if turn in damaged else data
    states, chance = [], random.Random(seed)  # noqa: S311  no secret
    for _ in range(2):
        place = Place(tmp_path_factory.mktemp("store"))
        for name, data in chance.sample([*files.items(), *files.items()], 2 * len(files)):
            place.put(name, data)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Place, "list", shuffle(Place.list, chance))
            states += [scan_anew(place), scan(place)]
        shutil.rmtree(place.root, ignore_errors=True)
    assert all(describe(state) == describe(states[0]) for state in states)
    for kind, key in states[0].names:
        whole = [name for name, data in files.items() if name.startswith(f"{kind}/{key}.") and is_whole(name, data)]
        assert states[0].names[kind, key] == min(whole, key=lambda name: (-int(name.split(".")[1]), name))


def shuffle(real, chance):
    def list_shuffled(place, folder=""):
        return chance.sample(names := [*real(place, folder)], len(names))

    return list_shuffled


def is_whole(name, data):
    return hashlib.sha256(data).hexdigest()[:16] == name.split(".")[2]


# --- a process that scans again -------------------------------------------------------------------------------------


def test_a_process_that_scans_again_reads_what_others_have_written_meanwhile_and_nothing_else(here, monkeypatch):
    put_many(here, 3)
    scan(here)
    read = []
    real = Place.read
    monkeypatch.setattr(Place, "read", lambda place, name: (read.append(name), real(place, name))[1])
    assert scan(here).read == 0
    assert read == []
    program = (
        "import sys; from pathlib import Path; from tcpipe.formats.documents import *\n"
        "from tcpipe.formats.place import Place; from tcpipe.formats.runs import Tags\n"
        "place = Place(Path(sys.argv[1])); state = scan(place)\n"
        "put_document(place, state, 'tags', make_key('log 1'), Tags('log 1', {'by': 'another'}))\n"
        "put_document(place, state, 'tags', make_key('log 9'), Tags('log 9', {'by': 'another'}))\n"
    )
    subprocess.run([sys.executable, "-c", program, here.where()], check=True)
    found = scan(here)
    assert (found.find_tags("log 1"), found.find_tags("log 9")) == ({"by": "another"}, {"by": "another"})
    assert found.read == 2
    assert {name for name in read if name != INDEX} == {
        found.names["tags", make_key(log)] for log in ("log 1", "log 9")
    }


def test_a_document_that_is_deleted_does_not_count_although_this_process_has_read_it(here):
    state = put_many(here, 2)
    assert scan(here).find_tags("log 1")
    here.delete(state.names["tags", make_key("log 1")])
    assert scan(here).find_tags("log 1") == {}


# --- the index ------------------------------------------------------------------------------------------------------


def index(place):
    return place.read(INDEX)


def test_the_index_is_written_when_many_documents_are_not_in_it_and_no_document_is_read_then(place, monkeypatch):
    put_many(place, 16)
    assert scan_anew(place).read == 16
    assert index(place) is None, "16 documents are read as quickly"
    put_document(place, scan(place), "tags", make_key("one more"), tags(soil="dry"))
    first = scan_anew(place)
    assert first.read == 17
    data = index(place)
    assert data is not None
    monkeypatch.setattr(documents, "_read_document", lambda *_: pytest.fail("a document is read"))
    second = scan_anew(place)
    assert (second.read, describe(second)) == (0, describe(first))
    assert index(place) == data, "it is not written again"


@pytest.mark.parametrize("how", ["deleted", "cut", "no Parquet", "other columns", "other records"])
def test_an_index_that_is_deleted_or_damaged_is_made_again_and_changes_no_state(place, how):
    put_many(place, 20)
    first, data = scan_anew(place), index(place)
    if how == "deleted":
        place.delete(INDEX)
    else:
        wrong = {"cut": data[:-100], "no Parquet": b"PAR1 and then nothing"}
        place.put(INDEX, wrong[how] if how in wrong else make_wrong_index(first, how))
    second = scan_anew(place)
    assert describe(second) == describe(first)
    assert index(place) == data
    assert scan_anew(place).read == 0


def make_wrong_index(state, how):
    """Return an index as another program, or another version of tcpipe, would have written it."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = [*state.names.values()]
    facts = "facts" if how == "other records" else "facts of another version"
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table({"name": names, facts: [b'{"written": "otherwise"}'] * len(names)}), sink)
    return sink.getvalue().to_pybytes()


def test_an_index_of_another_version_is_not_used(here, monkeypatch):
    """A field that a version adds to a record would have its default instead of what the document says."""
    put_many(here, 20)
    with monkeypatch.context() as later:
        later.setattr(documents, "__version__", "9.9.9")
        scan_anew(here)
        assert scan_anew(here).read == 0
    assert scan_anew(here).read == 20


def test_an_index_that_names_documents_which_are_gone_gives_none_of_them(here):
    state = put_many(here, 20)
    scan_anew(here)
    gone = state.names["tags", make_key("log 3")]
    here.delete(gone)
    found = scan_anew(here)
    assert found.find_tags("log 3") == {}
    assert gone not in found.names.values()
    assert found.read == 0


def test_a_store_in_a_bucket_whose_index_is_there_is_scanned_by_listings_and_one_request(tmp_path, served):
    place, counts = Place("s3://tests/store"), []
    for count in (20, 60):
        put_many(place, count)
        scan_anew(place)
        before, served.requests = len(served), 0
        assert scan_anew(place).read == 0
        counts.append((served[before:], served.requests))
    assert counts == [(["store/index.parquet"], len(KINDS) + 2)] * 2, "a listing of each kind, and of the payload"


def test_a_document_that_is_removed_while_a_store_is_scanned_is_not_damaged(tmp_path, monkeypatch):
    place = Place(tmp_path)
    put_document(place, scan(place), "tags", "0" * 16, Tags("log", {"a": "b"}))
    documents._DECODED.clear()
    monkeypatch.setattr(Place, "read", lambda self, name: self.delete(name))
    found = scan(place)
    assert (found.damaged, found.facts["tags"]) == ([], {})


def test_a_record_that_was_put_is_as_another_process_reads_it_down_to_the_order_of_its_keys(here):
    """Sums over its values would differ in the last bit."""
    state = scan(here)
    put(here, state, tags(z="1", a="2"))
    for found in (state, scan(here), scan_anew(here)):
        assert list(found.find_tags("a log").items()) == [("a", "2"), ("z", "1")]
