"""The log of a store: commits add up to a state, and a snapshot says the same; what is missing is said; no writer loses anything."""

import subprocess
import sys
from dataclasses import replace

import pytest
from object_gateway import open_bucket

from tcpipe.formats import commit_log
from tcpipe.formats.commit_log import Stamp, put_commit, read_commit, read_state, refresh
from tcpipe.formats.commits import (
    Begun,
    CallRecord,
    Commit,
    Dataset,
    Entries,
    Failure,
    Generation,
    LogSnapshot,
    Problem,
    Process,
    State,
    Superseded,
    compact_state,
    fold,
)
from tcpipe.formats.place import Place
from tcpipe.tables.findings import Finding, Subject

STAMP = Stamp(Process("lab", "m", "b", "n", 1, "2"), "2026-11-24T00:00:00.000+00:00")


@pytest.fixture(params=["directory", "bucket"])
def place(request, tmp_path, monkeypatch):
    if request.param == "directory":
        return Place(tmp_path / "store")
    url = open_bucket(request.param, request, monkeypatch, tmp_path)
    return Place(f"{url}/store")


def saw(number):
    return Entries(seen=(LogSnapshot(("/logs/a.mcap",), ((number, 1),), f"{number:064}"),))


def write(place, count, state=None):
    state = read_state(place) if state is None else state
    for number in range(count):
        state = put_commit(place, state, STAMP, "seen", lambda _, number=number: saw(number))
    return state


def settled(state):
    """A state but for which snapshot it was read from."""
    return replace(state, snapshot=0, tail_bytes=0)


EVERYTHING = (
    Entries(begun=(Begun("ingest", "1", ("/logs",), "o"),)),
    saw(1),
    Entries(failed=(Failure("k", "c", ("/logs/b.bag",), ("cut",), "1"),)),
    Entries(acknowledged=(Problem(Finding("log-failed", "error", Subject("log", "/logs/b.bag"), "rejected"), "c"),)),
    Entries(superseded=(Superseded("a", "b"), Superseded("c", "b"))),
    Entries(superseded=(Superseded("c", None),)),
    Entries(datasets=(Dataset("/out", "1", (("a", "r"),)), Dataset("/out", "2"))),
    Entries(forgotten=(Dataset("/out", "1"),), calls=(CallRecord("build-dataset", "1", 0, {"samples": 3}),)),
    Entries(generations=(Generation("generations/0000000009-0", "model.json", "2026-11-01T00:00:00+00:00"),)),
    Entries(generations=(Generation("generations/0000000010-1", "model.json", "2026-11-30T00:00:00+00:00"),)),
    Entries(ended=(1,), calls=(CallRecord("ingest", "1", 3, {"failed": 1}, failed={"/logs/c.bag": "full"}),)),
    Entries(removed=(("a", "r"), ("c", "r"))),
)


def test_a_state_is_the_fold_of_commits_and_of_the_one_commit_that_it_is_compacted_to():
    state, digest = State(), ""
    for number, entries in enumerate(EVERYTHING, 1):
        state = fold([Commit(number, digest, "seen", STAMP.who, STAMP.at, entries)], state)
        snapshot = Commit(number, digest, "snapshot", STAMP.who, STAMP.at, compact_state(state))
        compacted = fold([snapshot])
        assert replace(compacted, pruned=state.pruned) == state, entries
        assert compacted.pruned.keys() == state.pruned.keys(), "the number of its commit is that of the snapshot"
    commits = [Commit(number, "", "seen", STAMP.who, STAMP.at, of) for number, of in enumerate(EVERYTHING, 1)]
    assert fold(commits) == state
    assert state.superseded == {"a": "b"}
    assert state.parties == {"a", "b", "c"}
    assert list(state.datasets) == [("/out", "2")]
    assert state.begun == {}
    assert state.pruned == {("a", "r"): len(EVERYTHING), ("c", "r"): len(EVERYTHING)}
    assert [call.command for call in state.calls] == ["ingest", "build-dataset"]


def test_what_is_written_is_read_and_nothing_is_written_where_nothing_is_added(place):
    state = State()
    for entries in EVERYTHING:
        state = put_commit(place, state, STAMP, "seen", lambda _, of=entries: of)
    assert put_commit(place, state, STAMP, "seen", lambda _: Entries()) == state
    assert read_state(place) == state
    assert len(place.below("log").files()) == len(EVERYTHING)


def test_snapshots_say_what_the_commits_say_and_two_of_them_stay(place, monkeypatch):
    monkeypatch.setattr(commit_log, "_EVERY", 4)
    state = write(place, 18)
    log = place.below("log")
    snapshots = [name for name in log.files() if name.startswith("snapshot-")]
    assert snapshots == [f"snapshot-{number:010}.json.zst" for number in (12, 16)]
    assert read_state(place) == state
    log.put(snapshots[-1], b"not a snapshot")
    assert settled(read_state(place)) == settled(state), "an earlier one is taken"
    log.put(snapshots[0], (log.read(snapshots[0]) or b"")[:-5])
    assert settled(read_state(place)) == settled(state), "or all commits"


@pytest.mark.parametrize("how", ["missing", "damaged", "mixed"])
def test_a_commit_that_is_missing_damaged_or_of_another_store_is_a_problem_until_somebody_acknowledges_it(
    place, monkeypatch, how
):
    monkeypatch.setattr(commit_log, "_EVERY", 4)
    write(place, 2)
    log = place.below("log")
    if how == "missing":
        log.delete("0000000002.json")
        log.put_new("0000000003.json", (log.read("0000000001.json") or b""))
        log.delete("0000000003.json")
        state = put_commit(place, replace(read_state(place), number=2), STAMP, "seen", lambda _: saw(3))
    elif how == "damaged":
        log.put(
            "0000000002.json", (log.read("0000000002.json") or b"").replace(b'"size', b'"sice').replace(b"1,", b"2,")
        )
        state = write(place, 1)
    else:
        state = put_commit(place, replace(read_state(place), digest="f" * 64), STAMP, "seen", lambda _: saw(3))
    state = read_state(place)
    assert [of.finding.code for of in state.problems] == ["commit-missing" if how == "missing" else "commit-damaged"]
    state = write(place, 4, state)
    assert not [name for name in log.files() if name.startswith("snapshot-")], "a snapshot would hide it"
    assert [of.key for of in read_state(place).problems] == [of.key for of in state.problems]
    state = put_commit(place, state, STAMP, "acknowledged", lambda of: Entries(acknowledged=of.problems))
    assert [name for name in log.files() if name.startswith("snapshot-")]
    assert read_state(place).problems == ()


def test_of_two_writers_none_loses_anything_and_the_second_is_asked_again(place):
    first = second = write(place, 1)
    first = put_commit(place, first, STAMP, "seen", lambda _: saw(8))
    asked = []

    def make(state):
        asked.append(state.number)
        return saw(9)

    second = put_commit(place, second, STAMP, "seen", make)
    assert asked == [1, 2]
    assert second == refresh(place, first) == read_state(place)
    assert len(second.seen["/logs/a.mcap"]) == 3


def test_many_writers_lose_nothing(tmp_path):
    program = (
        "import sys; from pathlib import Path; from tcpipe.formats.place import Place\n"
        "from tcpipe.formats.commits import *; from tcpipe.formats.commit_log import *\n"
        "place, who = Place(Path(sys.argv[1])), Process('lab', 'm', 'b', 'n', int(sys.argv[2]), '')\n"
        "state = read_state(place)\n"
        "for n in range(30):\n"
        "    of = Entries(seen=(LogSnapshot((sys.argv[2],), ((n, 1),), '0'),))\n"
        "    state = put_commit(place, state, Stamp(who, ''), 'seen', lambda _, of=of: of)\n"
    )
    writers = [subprocess.Popen([sys.executable, "-c", program, str(tmp_path), str(by)]) for by in range(3)]
    assert [writer.wait(timeout=120) for writer in writers] == [0, 0, 0]
    state = read_state(Place(tmp_path))
    assert (state.number, state.problems) == (90, ())
    assert {log: len(seen) for log, seen in state.seen.items()} == {"0": 30, "1": 30, "2": 30}


class _Killed(BaseException):
    pass


def test_killed_at_any_put_the_log_is_whole(tmp_path, monkeypatch):
    monkeypatch.setattr(commit_log, "_EVERY", 2)
    place, real, left = Place(tmp_path), Place.put_new, [0]

    def put_new(self, name, data):
        for act in (lambda: None, lambda: real(self, name, data)):
            done = act()
            if not left[0]:
                raise _Killed
            left[0] -= 1
        return done

    monkeypatch.setattr(Place, "put_new", put_new)
    for steps in range(12):
        left[0] = steps
        with pytest.raises(_Killed):
            write(place, 9)
        state = read_state(place)
        assert state.problems == ()
        numbers = range(1, state.number + 1)
        assert [read_commit(place.below("log"), number)[0].number for number in numbers] == [*numbers]


def test_a_lost_answer_is_no_second_commit(served):
    place = Place("s3://tests/store")
    served.lost = 3
    state = write(place, 2)
    assert (state.number, read_state(place)) == (2, state)


def test_reading_a_log_in_a_bucket_takes_a_constant_number_of_requests(monkeypatch, served):
    monkeypatch.setattr(commit_log, "_EVERY", 8)
    place, counts = Place("s3://tests/store"), []
    state = State()
    for _ in range(5):
        state = write(place, 16, state)
        before, served.requests = len(served), 0
        assert read_state(place) == state
        counts.append((len(served) - before, served.requests))
    assert counts == [(1, 3)] * 5, "the snapshot; and two listings"
    served.requests = 0
    assert refresh(place, state) == state
    assert served.requests == 1
