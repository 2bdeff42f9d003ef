"""A directory and a bucket behind the same verbs: each test is made of both, and of a real gateway where there is one."""

import hashlib
import pickle
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from object_gateway import open_bucket
from storage_server import FORBIDDEN, READ_ONLY, SKEWED, Fetched

from tcpipe.errors import StoreError
from tcpipe.formats.integrity import Checksum
from tcpipe.formats.place import FileEntry, Place, open_place

NAMES = ("a.json", "drives of May/ü ñ #1?.json", "runs/100%/track.parquet", "runs/x/[1] & 'two'+~.bin")


@pytest.fixture(params=["directory", "bucket", "gateway"])
def place(request, tmp_path, monkeypatch):
    if request.param == "directory":
        return open_place(tmp_path / "place")
    url = open_bucket(request.param, request, monkeypatch, tmp_path)
    return open_place(f"{url}/below this/")


def _names(entries: list[FileEntry]) -> list[str]:
    return [entry.name for entry in entries]


def test_what_is_put_is_there(place: Place) -> None:
    for name in NAMES:
        assert place.read(name) is None
        assert place.size(name) is None
        place.put(name, b"old")
        place.put(name, name.encode())
        assert place.read(name) == name.encode()
        assert place.size(name) == len(name.encode())
        assert place.read_range(name, 2, 3) == name.encode()[2:5]
    assert _names(place.entries()) == sorted(NAMES)
    assert _names(place.entries("runs/x")) == [NAMES[3]]
    assert [entry.size_bytes for entry in place.entries("runs/100%")] == [len(NAMES[2])]
    assert place.list() == ["a.json", "drives of May", "runs"]
    assert place.list("runs") == ["100%", "x"]
    assert place.list("runs/x") == ["[1] & 'two'+~.bin"]
    assert place.list("nowhere") == place.list("a.json") == place.entries("nowhere") == []
    there = pickle.loads(pickle.dumps(place))  # noqa: S301  as a worker gets it
    assert there.below("runs").read("100%/track.parquet") == NAMES[2].encode()


def test_of_many_writers_one_stays_and_no_reader_sees_a_half(place: Place) -> None:
    written = {bytes([number]) * 100_000 for number in range(12)}
    with ThreadPoolExecutor(12) as pool:
        writing = [pool.submit(place.put, "document.json", data) for data in written]
        while not all(done.done() for done in writing):
            assert place.read("document.json") in {None, *written}
        assert [done.result() for done in writing] == [None] * 12
    assert place.read("document.json") in written
    assert place.list() == ["document.json"]


def test_a_folder_is_deleted_with_all_in_it_and_nothing_beside_it(place: Place) -> None:
    for name in ("blobs/a/1", "blobs/a/c/0", "blobs/a b/1", "blobs/ab"):
        place.put(name, b"")
    for _ in range(2):
        place.delete("blobs/a")
        assert _names(place.entries()) == ["blobs/a b/1", "blobs/ab"]
    place.delete("blobs/ab/below a file")
    place.delete("blobs/ab")
    assert place.list("blobs") == ["a b"]
    assert place.read("blobs/a b/1") == b""


def test_what_a_killed_deletion_or_writer_left_is_not_listed_and_goes_when_cleared(tmp_path: Path) -> None:
    place = Place(tmp_path / "store")
    for name in ("blobs/a/1", "runs/x.json"):
        place.put(name, b"")
    program = (
        "import os, shutil, sys; from pathlib import Path; from tcpipe.formats.place import Place\n"
        "place = Place(Path(sys.argv[1]))\n"
        "os.fsync = shutil.rmtree = lambda *_, **__: os._exit(9)\n"
        "place.delete('blobs/a') if sys.argv[2] == 'delete' else place.below('runs').put('y.json', b'')\n"
    )
    for number, act in enumerate(("put", "delete")):
        killed = subprocess.run([sys.executable, "-c", program, place.where(), act], check=False)
        assert killed.returncode == 9
        assert sum(path.name.startswith(".tmp-") for path in (tmp_path / "store").iterdir()) == 1, number
        assert _names(place.entries()) == (["blobs/a/1", "runs/x.json"] if act == "put" else ["runs/x.json"])
        assert place.list() == ["blobs", "runs"]
        place.clear()
        assert sorted(path.name for path in (tmp_path / "store").iterdir()) == ["blobs", "runs"]


def test_a_folder_costs_a_request_however_many_files_lie_deeper(served: Fetched) -> None:
    place = open_place("s3://tests/x")
    for number in range(20):
        place.put(f"blobs/{number:02}/a/b", b"")
    before = served.requests
    assert len(place.list("blobs")) == 20
    assert served.requests - before == 1


def test_nothing_is_a_file_too_and_what_is_gone_is_told(place: Place) -> None:
    place.put("empty", b"")
    assert place.read("empty") == b""
    assert place.size("empty") == 0
    place.delete("empty")
    place.delete("empty")
    assert place.read("empty") is None
    with pytest.raises(StoreError, match="nowhere: is missing"):
        place.read_range("nowhere", 0, 1)
    assert place.entries() == []


def test_files_are_put_together_and_had_here(place: Place) -> None:
    data = {"track.parquet": b"1" * 1000, "c/0/1": b""}
    with place.workshop() as directory:
        for name, content in data.items():
            (directory / name).parent.mkdir(parents=True, exist_ok=True)
            (directory / name).write_bytes(content)
        assert place.entries() == place.list() == []
        place.put_files("runs/x", directory)
    assert not directory.exists()
    assert [(entry.name, entry.size_bytes) for entry in place.entries()] == [
        ("runs/x/c/0/1", 0),
        ("runs/x/track.parquet", 1000),
    ]
    checksum = Checksum(1000, hashlib.sha256(data["track.parquet"]).hexdigest())
    for _ in range(2):
        assert place.fetch("runs/x/track.parquet", checksum).read_bytes() == data["track.parquet"]


def test_a_file_is_proved_when_it_is_fetched_and_an_altered_copy_is_fetched_again(place: Place) -> None:
    place.put("a", b"content")
    checksum = Checksum(7, hashlib.sha256(b"content").hexdigest())
    held = place.fetch("a", checksum)
    held.chmod(0o600)
    held.write_bytes(b"altered")
    assert place.fetch("a", checksum, proved=False).read_bytes() == b"altered"
    if place.path is None:
        assert place.fetch("a", checksum).read_bytes() == b"content"
    else:
        with pytest.raises(StoreError, match=r"its sha256 is .*; 'tcpipe verify .*place' lists all changed files"):
            place.fetch("a", checksum)


@pytest.mark.parametrize("name", ["../outside", "/etc/passwd"])
def test_no_name_leads_outside(place: Place, name: str) -> None:
    with pytest.raises(StoreError):
        place.put(name, b"")


@pytest.mark.usefixtures("served")
def test_a_bucket_that_cannot_be_used_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "served" / READ_ONLY).mkdir()
    with pytest.raises(StoreError, match=r"^s3://nowhere/x: it cannot be read \(there is no such bucket\)$"):
        open_place("s3://nowhere/x").check()
    with pytest.raises(StoreError, match="requires credentials; set AWS_ACCESS_KEY_ID"):
        open_place(f"s3://{FORBIDDEN}/x").check()
    with pytest.raises(
        StoreError, match=r"skewed/x: it cannot be read \(the clock of this machine is wrong; set it\)$"
    ):
        open_place(f"s3://{SKEWED}/x").check()
    with monkeypatch.context() as keys:
        keys.setenv("AWS_ACCESS_KEY_ID", "a")
        keys.setenv("AWS_SECRET_ACCESS_KEY", "b")
        with pytest.raises(StoreError, match=r"rejects the credentials, or the clock of this machine is wrong"):
            open_place(f"s3://{SKEWED}/x").size("a")
    with pytest.raises(StoreError, match=r"it contains no bucket; expected s3://bucket/name"):
        open_place("s3:///x").check()
    with monkeypatch.context() as half:
        half.delenv("AWS_SKIP_SIGNATURE")
        half.setenv("AWS_ACCESS_KEY_ID", "a")
        with pytest.raises(StoreError, match="requires credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"):
            open_place("s3://tests/x").check()
    open_place(f"s3://{READ_ONLY}").check()
    with pytest.raises(StoreError, match=r"read-only/x/a: it cannot be written \(the credentials do not allow it\)"):
        open_place(f"s3://{READ_ONLY}/x").put("a", b"")
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    began = time.monotonic()
    with pytest.raises(StoreError, match="cannot be read"):
        open_place("s3://tests/x").check()
    assert time.monotonic() - began < 10


def test_what_is_written_counts_also_where_the_answer_is_lost(served: Fetched) -> None:
    place = open_place("s3://tests")
    served.lost = 2
    place.put("a", b"data")
    assert (place.read("a"), served.lost) == (b"data", 0)


@pytest.mark.usefixtures("served")
def test_the_cache_is_bounded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TCPIPE_CACHE_BYTES", "2500")
    monkeypatch.setattr("tcpipe.formats.cache._IN_USE_S", -1.0)
    place = open_place("s3://tests")
    for number in range(5):
        data = bytes([number]) * 1000
        place.put("a", data)
        place.fetch("a", Checksum(1000, hashlib.sha256(data).hexdigest()))
    assert sum(path.is_file() for path in (tmp_path / "cache").rglob("*")) == 2


@pytest.mark.usefixtures("served")
def test_a_cache_that_cannot_be_is_named_with_what_names_another(tmp_path: Path) -> None:
    place = open_place("s3://tests")
    place.put("a", b"content")
    (tmp_path / "cache").touch()
    with pytest.raises(
        StoreError, match=r"cache/../.*: cannot be written \(.*\); set TCPIPE_CACHE to use another directory"
    ):
        place.fetch("a", Checksum(7, hashlib.sha256(b"content").hexdigest()))
