"""A store that does not answer: the first request fails soon, later ones wait, and one log's upload costs no other log."""

import time
from pathlib import Path

import pytest
from wheel_drives import START_NS, drive_at

from tcpipe.errors import StoreError
from tcpipe.formats.place import Place, open_place
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.options import IngestOptions
from tcpipe.pipeline.status import find_log_states
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe

LIBRARY = ("Generic", "reqwest", "Error performing", "retries", "HTTP error")


def test_the_first_request_fails_within_seconds_and_says_what_to_check(served, monkeypatch):
    began, served.away_until = time.monotonic(), time.monotonic() + 60
    with pytest.raises(StoreError) as away:
        open_place("s3://tests/x").check()
    assert time.monotonic() - began < 5
    (line,) = away.value.problems
    assert line.startswith("s3://tests/x: it cannot be read (no answer from http://127.0.0.1:")
    assert "check that it runs" in line
    assert not any(word in line for word in LIBRARY)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    with pytest.raises(StoreError, match=r"no answer from http://127.0.0.1:9: connection refused; check"):
        open_place("s3://tests/x").read("a")


def test_later_requests_are_repeated_until_there_is_an_answer(served):
    place = open_place("s3://tests/x")
    place.put("a", b"before")
    served.away_until = time.monotonic() + 1.5
    place.put("a", b"after")
    place.put("b", b"new")
    assert (place.read("a"), place.read("b")) == (b"after", b"new")


def test_after_waiting_in_vain_the_next_requests_fail_soon_until_there_is_an_answer(served, monkeypatch):
    monkeypatch.setenv("TCPIPE_RETRY_MINUTES", "0.02")
    place = open_place("s3://tests/x")
    place.put("a", b"content")
    served.away_until = time.monotonic() + 60
    with pytest.raises(StoreError, match="no answer"):
        place.read("a")
    monkeypatch.setenv("TCPIPE_RETRY_MINUTES", "10")
    began = time.monotonic()
    with pytest.raises(StoreError, match="no answer"):
        place.read("a")
    assert time.monotonic() - began < 5
    served.away_until = 0.0
    assert place.read("a") == b"content"


def test_a_store_that_stays_busy_is_named_by_its_answer(served, monkeypatch):
    monkeypatch.setenv("TCPIPE_RETRY_MINUTES", "0.01")
    served.busy = "a"
    with pytest.raises(StoreError) as busy:
        open_place("s3://tests/x").put("a", b"")
    assert busy.value.problems == (
        "s3://tests/x/a: it cannot be written (the store answers 503 Service Unavailable, SlowDown)",
    )


def test_a_time_that_is_no_number_is_named(served, monkeypatch):
    place = open_place("s3://tests/x")
    place.read("a")
    monkeypatch.setenv("TCPIPE_RETRY_MINUTES", "soon")
    monkeypatch.setattr("tcpipe.formats.object_storage.multiprocessing.parent_process", object)
    with pytest.raises(StoreError, match="TCPIPE_RETRY_MINUTES is 'soon', expected a number of minutes"):
        place.read("a")


@pytest.fixture
def logs(tmp_path):
    """Two logs."""
    drive_at(tmp_path / "logs" / "one.mcap")
    drive_at(tmp_path / "logs" / "two.mcap", seed=1, start_ns=START_NS + 10**13)
    return tmp_path / "logs"


def _ingest(logs):
    return {Path(of.log).stem: of for of in ingest([logs], store="s3://tests/store", recipe=Recipe()).results}


def _finish(logs):
    """Expect that the next call makes up for the log that failed, and that nothing is left to do."""
    assert {name: of.status for name, of in _ingest(logs).items()} == {"one": "done", "two": "unchanged"}
    assert find_log_states(IngestOptions([logs], store="s3://tests/store", recipe=Recipe(), min_age=0.0)).counts == {
        "done": 2
    }
    left = verify("s3://tests/store").problems
    assert all("/blobs/" in line and "'tcpipe prune' removes it" in line for line in left), left


@pytest.mark.parametrize("verb", ["put_files", "put"])
def test_a_failed_upload_costs_its_own_log(served, logs, monkeypatch, verb):
    """The store is busy for the first payload, or for the first document that names one."""
    monkeypatch.setenv("TCPIPE_RETRY_MINUTES", "0.01")
    write, folder = getattr(Place, verb), {"put_files": "blobs/", "put": "runs/"}[verb]

    def refuse_first(place, name, content):
        served.busy = served.busy or (name if name.startswith(folder) else "")
        write(place, name, content)

    with monkeypatch.context() as patch:
        patch.setattr(Place, verb, refuse_first)
        found = _ingest(logs)
    assert {name: of.status for name, of in found.items()} == {"one": "failed", "two": "done"}
    assert "it cannot be written (the store answers 503" in found["one"].problems[0]
    assert found["one"].transient
    served.busy = ""
    _finish(logs)
