"""Generations at a URL: each appears whole, two writers are never mixed, and a killed one blocks nobody."""

import uuid
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime

import obstore
import pytest
from object_gateway import open_bucket
from tcpipe.formats.commit_log import Stamp, put_commit, read_state
from tcpipe.formats.commits import Entries, Generation, Process, State

from tcpipe.errors import UsageError
from tcpipe.formats.bucket_directories import GENERATIONS, find_newest
from tcpipe.formats.place import Place
from tcpipe.pipeline import generations
from tcpipe.pipeline.generations import write_generation

CARD = "c.json"


@pytest.fixture(params=["served", "gateway"])
def place(request, tmp_path, monkeypatch):
    """An empty place in a bucket."""
    url = open_bucket(request.param, request, monkeypatch, tmp_path)
    return Place(f"{url}/{uuid.uuid4().hex}/a b")


def write(place, text, card=CARD, more=()):
    with write_generation(place.root, card) as directory:
        for name in (card, "data", *more):
            (directory / name).write_text(text)


def seen(place):
    """What a reader finds: the card, and the file beside it."""
    found = find_newest(place.root, [CARD])
    return found and (found.data.decode(), (found.place.read("data") or b"").decode())


def folders(place):
    """The files of each generation's folder, by number."""
    found = {}
    for entry in place.entries(GENERATIONS):
        _, folder, name = entry.name.split("/")
        found.setdefault(folder, {})[name] = place.read(entry.name).decode()
    return found


def kept(place):
    return [of.folder.rpartition("/")[2] for of in read_state(place).generations]


def outrun(monkeypatch, place, text):
    """Have another call write a generation just before the next commit."""
    commit = generations.put_commit

    def put(*how):
        monkeypatch.setattr(generations, "put_commit", commit)
        write(place, text)
        return commit(*how)

    monkeypatch.setattr(generations, "put_commit", put)


def test_of_two_at_once_the_second_is_the_next_generation_and_nothing_is_mixed(place):
    with write_generation(place.root, CARD) as mine:
        write(place, "theirs")
        for name in (CARD, "data"):
            (mine / name).write_text("mine")
    assert list(folders(place).values()) == [{CARD: text, "data": text} for text in ("theirs", "mine")]
    assert seen(place) == ("mine", "mine")


def test_a_call_that_is_outrun_between_its_files_and_its_commit_puts_them_again(place, monkeypatch):
    outrun(monkeypatch, place, "theirs")
    write(place, "mine", more=["more"])
    first, second = folders(place).values()
    assert first == {CARD: "theirs", "data": "theirs"}, "what the slower one left of number 1 is gone"
    assert second == {CARD: "mine", "data": "mine", "more": "mine"}
    assert kept(place) == list(folders(place))


def test_a_call_that_is_outrun_by_the_same_finds_it_done(place, monkeypatch):
    outrun(monkeypatch, place, "same")
    write(place, "same")
    assert list(folders(place).values()) == [{CARD: "same", "data": "same"}]


def test_what_is_there_is_not_put_again_unless_a_file_of_it_is_gone(place):
    write(place, "same")
    before = place.entries()
    write(place, "same")
    assert place.entries() == before
    (folder,) = folders(place)
    place.delete(f"{GENERATIONS}/{folder}/data")
    write(place, "same")
    assert seen(place) == ("same", "same")
    assert len(kept(place)) == 2


def test_many_at_once_all_become_generations(place):
    texts = [str(number) for number in range(6)]
    with ThreadPoolExecutor(len(texts)) as pool:
        list(pool.map(lambda text: write(place, text), texts))
    found = folders(place)
    assert sorted(files[CARD] for files in found.values()) == texts
    assert all(files == {CARD: files[CARD], "data": files[CARD]} for files in found.values())
    assert kept(place) == list(found)
    assert read_state(place).problems == ()


class _Killed(BaseException):
    pass


@pytest.mark.parametrize("next_text", ["new", "other"])
def test_killed_at_any_request_nobody_sees_half_and_the_next_call_is_not_blocked(place, monkeypatch, next_text):
    left = [10_000]

    def killing(act):
        def acts(*args, **how):
            if not left[0]:
                raise _Killed
            left[0] -= 1
            return act(*args, **how)

        return acts

    for name in ("put", "delete"):
        monkeypatch.setattr(obstore, name, killing(getattr(obstore, name)))
    for steps in range(100):
        each, done = Place(f"{place.root}/{steps}"), True
        write(each, "old")
        each.put(f"{GENERATIONS}/0000000001-{'f' * 16}/data", b"of a killed call")
        left[0] = steps
        try:
            write(each, "new")
        except _Killed:
            done = False
        left[0] = 10_000
        assert seen(each) == (("old", "old") if steps < 3 else ("new", "new")), "two files, the commit, what is removed"
        write(each, next_text)
        assert seen(each) == (next_text, next_text)
        assert all(files[CARD] == files["data"] for files in folders(each).values())
        assert kept(each) == list(folders(each)), "nothing is left of killed calls"
        if done:
            break
    assert steps == 4


def test_killed_before_the_first_commit_there_is_nothing_and_the_next_call_builds(place, monkeypatch):
    def killed(*_):
        raise _Killed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generations, "put_commit", killed)
        with pytest.raises(_Killed):
            write(place, "killed")
    assert seen(place) is None
    write(place, "new")
    assert list(folders(place).values()) == [{CARD: "new", "data": "new"}]


class Clock:
    """A clock that shows a day of November each time it is read."""

    def __init__(self, *days):
        self.days = iter(days)

    def now(self, zone):
        return datetime(2026, 11, next(self.days), tzinfo=zone)


def test_generations_go_a_week_after_they_were_replaced_and_two_stay(served, monkeypatch):
    place = Place("s3://tests/x")
    monkeypatch.setattr(generations, "datetime", Clock(1, 2, 3, 9, 30))
    found = []
    for number in range(1, 6):
        write(place, str(number))
        found.append("".join(files["data"] for files in folders(place).values()))
        assert kept(place) == list(folders(place))
    assert found == ["1", "12", "123", "1234", "45"]


def test_a_reader_asks_as_often_of_many_generations_as_of_one(served):
    place, state, asked = Place("s3://tests/x"), State(), set()
    stamp = Stamp(Process("", "", "", "", 0, ""), "2026-11-24T00:00:00+00:00")
    for number in range(1, 70):  # a snapshot is written meanwhile
        built = Generation(f"{GENERATIONS}/{number:010}-{'0' * 16}", CARD, stamp.at)
        state = put_commit(place, state, stamp, "built", lambda _, of=built: Entries(generations=(of,)))
        if number in (1, 2, 69):
            place.put(f"{built.folder}/{CARD}", str(number).encode())
            before = served.requests
            assert find_newest(place.root, [CARD]).data == str(number).encode()
            asked.add(served.requests - before)
    assert asked == {3}


def test_what_is_of_another_kind_is_left_alone(served):
    place = Place("s3://tests/x")
    write(place, "a model", card="model.json")
    with pytest.raises(UsageError, match=r"s3://tests/x: contains model.json and no c.json; it is not changed"):
        write(place, "mine")
