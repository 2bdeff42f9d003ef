"""Outputs at a URL: a build is seen whole or not at all, two writers are never mixed, and a killed writer blocks no other."""

import hashlib
import json
import os
import re
import uuid

import obstore
import pytest
from object_gateway import open_bucket

from tcpipe.errors import StoreError, UsageError
from tcpipe.formats.place import Place
from tcpipe.formats.published_outputs import check_kind, find_newest, find_unlisted_files, write_output

CARD = "dataset.json"
DAY_S = 24 * 3600


@pytest.fixture(params=["served", "gateway"])
def place(request, tmp_path, monkeypatch):
    """An empty place in a bucket."""
    url = open_bucket(request.param, request, monkeypatch, tmp_path)
    return Place(f"{url}/{uuid.uuid4().hex}/a b")


@pytest.fixture
def aged(served, tmp_path):
    """An empty place, and a function that makes all there older by some days."""

    def age(days):
        for path in (tmp_path / "served" / "tests").rglob("*"):
            if path.is_file():
                at = path.stat().st_mtime - days * DAY_S
                os.utime(path, (at, at))

    return Place("s3://tests/x"), age


def write(place, text, card=CARD):
    with write_output(place.root, card) as directory:
        listed = {"data": {"size_bytes": len(text), "sha256": hashlib.sha256(text.encode()).hexdigest()}}
        (directory / card).write_text(json.dumps({"text": text, "checksums": listed}))
        (directory / "data").write_text(text)


def seen(place):
    """Return the text of the card, and of its file, as a reader finds them."""
    found = find_newest(place.root, [CARD])
    return found and (json.loads(found.data)["text"], (found.place.read("data") or b"").decode())


def builds(place):
    """The texts of the builds that are there, each of which is whole."""
    found = {}
    for name in place.list("builds"):
        card, data = place.read(f"builds/{name}/{CARD}"), place.read(f"builds/{name}/data")
        assert card is not None
        assert json.loads(card)["text"] == data.decode()
        found[data.decode()] = name
    return found


def pointers(place):
    return [name for name in place.list() if name.startswith("current.")]


def point(place, number, folder):
    """Write a pointer as another writer does."""
    data = json.dumps({"folder": f"builds/{folder}", "card": CARD}).encode()
    digest = hashlib.sha256(data).hexdigest()[:16]
    place.put(f"current.{number}.{digest}.json", data)
    return digest


def test_a_build_is_a_folder_and_one_small_pointer_that_its_digest_proves(place):
    write(place, "first")
    write(place, "second")
    assert seen(place) == ("second", "second")
    assert sorted(builds(place)) == ["first", "second"]
    assert place.list() == ["builds", *sorted(pointers(place))]
    for number, (name, text) in enumerate(zip(sorted(pointers(place)), ("first", "second"), strict=True), 1):
        data = place.read(name)
        assert re.fullmatch(rf"current\.{number}\.{hashlib.sha256(data).hexdigest()[:16]}\.json", name)
        assert json.loads(data) == {"folder": f"builds/{builds(place)[text]}", "card": CARD}
        assert re.fullmatch("[0-9a-f]{16}", builds(place)[text])
    assert find_unlisted_files(place.root) == []


def test_of_two_at_once_one_wins_and_none_mixes(place):
    with write_output(place.root, CARD) as mine:
        write(place, "theirs")
        (mine / CARD).write_text('{"text": "mine", "checksums": {}}')
        (mine / "data").write_text("mine")
    assert sorted(builds(place)) == ["mine", "theirs"]
    assert seen(place) == ("mine", "mine"), "it saw theirs before it wrote its pointer"


def test_a_reader_keeps_its_build_while_it_is_replaced(place):
    write(place, "old")
    found = find_newest(place.root, [CARD])
    write(place, "new")
    assert found.place.read("data") == b"old"


def test_a_damaged_pointer_is_no_pointer_and_its_number_is_not_used_again(place):
    write(place, "first")
    write(place, "second")
    (newest,) = (name for name in pointers(place) if name.startswith("current.2."))
    place.put(newest, place.read(newest)[:-3])
    assert seen(place) == ("first", "first")
    assert find_unlisted_files(place.root) == [place.where(newest)]
    write(place, "third")
    assert seen(place) == ("third", "third")
    assert any(name.startswith("current.3.") for name in pointers(place))


class _Killed(BaseException):
    pass


def test_killed_at_any_request_nobody_sees_half_and_the_next_call_is_not_blocked(place, monkeypatch):
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
        left[0] = steps
        try:
            write(each, "new")
        except _Killed:
            done = False
        left[0] = 10_000
        assert seen(each) == (("old", "old") if steps < 3 else ("new", "new")), "two files, then the pointer"
        assert find_unlisted_files(each.root) == []
        write(each, "next")
        assert seen(each) == ("next", "next")
        if done:
            break
    assert steps == 3


def test_a_build_goes_seven_days_after_its_replacement_by_the_clock_of_the_bucket(aged):
    place, age = aged
    found = []
    for days, text in ((0, "1"), (6, "2"), (2, "3"), (6, "4"), (30, "5"), (0, "6")):
        age(days)
        write(place, text)
        found.append("".join(sorted(builds(place))))
        assert len(pointers(place)) == len(builds(place))
        assert seen(place) == (text, text)
    assert found == ["1", "12", "123", "234", "45", "456"], "1 was replaced on day 6, 2 on day 8, 3 on day 14"


def test_what_no_pointer_names_goes_when_it_is_seven_days_older_than_the_newest_build(aged):
    place, age = aged
    place.put("builds/0123456789abcdef/c/data", b"of a killed call")
    place.put("dataset.json", b'{"text": "a copy of a directory", "checksums": {}}')
    place.put("builds/notes.txt", b"not ours")
    for number, folder in ((1, "a" * 16), (1, "b" * 16), (2, "c" * 16)):
        point(place, number, folder)
    age(6)
    write(place, "1")
    assert place.list("builds/0123456789abcdef") == ["c"], "its writer may be about to name it"
    age(2)
    write(place, "2")
    assert place.list("builds/0123456789abcdef") == []
    assert place.read("builds/notes.txt") == b"not ours"
    assert place.read("dataset.json") is not None, "nothing goes that no build has made"
    assert [name.split(".")[1] for name in pointers(place)] == ["2", "3", "4"], "both of number 1 lost 8 days ago"


def test_a_reader_asks_three_times_however_many_builds_there_are(served):
    place, asked = Place("s3://tests/x"), set()
    for number in range(12):
        write(place, str(number))
        before = served.requests
        assert seen(place) == (str(number), str(number))
        asked.add(served.requests - before - 1)
    assert asked == {3}


def test_what_is_of_another_kind_is_left_alone(place):
    write(place, "a model", card="model.json")
    before = place.entries()
    with pytest.raises(UsageError, match=r"a b: contains model.json and no dataset.json; it is not changed"):
        write(place, "mine")
    place.put("b/notes.txt", b"")
    with pytest.raises(UsageError, match=r"a b/b: contains notes.txt and no dataset.json; it is not changed"):
        check_kind(place.where("b"), CARD)
    place.delete("b")
    assert place.entries() == before
    assert find_newest(place.root, [CARD]) is None
    with pytest.raises(StoreError, match="no such bucket"):
        check_kind("s3://nowhere-at-all/x", CARD)
