"""Calls that are killed before any of their requests, and pairs of calls that interrupt each other: nothing is lost or half visible.

With TCPIPE_TEST_OPERATIONS (make test-operations): at every request, and kills with files that ingestion makes anew; else at some.
"""

import os
import tempfile
from itertools import product

import pytest
from store_attacks import OLD, World, expect, write_logs

from tcpipe.pipeline import prune

DRAWS_DATASET_PAGES = True  # no dataset is built here

IS_WHOLE = bool(os.environ.get("TCPIPE_TEST_OPERATIONS"))
SPARSE = 8
"""`make test` chooses every eighth request that writes, and those that write a document that names payload."""


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    return write_logs(tmp_path_factory.mktemp("attacks"))


@pytest.fixture(params=["directory", "bucket"])
def world(request, logs, tmp_path, monkeypatch):
    monkeypatch.setenv("TCPIPE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    made = World(tmp_path / "store" if request.param == "directory" else "s3://tests/store", logs)
    made.patch(monkeypatch, is_light=not IS_WHOLE or "killed" not in request.node.name)
    return made


_OLD: dict[type, dict[str, bytes]] = {}


def make_old(world):
    """Make a store in which each command has something to do: a superseded run, an old recipe, a replaced map, what a kill left."""
    if type(world.root) not in _OLD:
        world.run(lambda: world.ingest("long.mcap", "other.mcap", recipe=OLD))
        world.run(lambda: world.ingest("short.mcap", "long.mcap", "junk.mcap", tag={"load": "12"}))
        world.run(lambda: world.build("/first"))
        world.run(lambda: world.ingest("other.mcap"))
        for text in ("first", "second"):
            world.run(lambda text=text: world.add_map(text))
        world.run(lambda: world.ingest("other.mcap", force=True), kill_at=26)
        _OLD[type(world.root)] = world.save()
    world.restore(_OLD[type(world.root)])


CALLS = {
    "ingest": lambda world: world.ingest("short.mcap", "junk.mcap", tag={"load": "12"}),
    "ingest a longer log": lambda world: world.ingest("long.mcap"),
    "ingest again": lambda world: world.ingest("long.mcap", tag={"surface": "wet"}, force=True),
    "ingest under another recipe": lambda world: world.ingest("short.mcap", "long.mcap", recipe=OLD),
    "fail": lambda world: world.ingest("junk.mcap"),
    "add-map": lambda world: world.add_map("third"),
    "build": lambda world: world.build(),
    "prune": lambda world: world.prune(),
    "prune a run": lambda world: world.prune(world.name_run("other")),
    "acknowledge": lambda world: world.acknowledge(),
}
MAKERS = ("ingest", "ingest a longer log", "ingest again", "ingest under another recipe", "fail", "add-map")
"""Calls that make a store."""
PAIRS = [
    ("ingest", "ingest"), ("ingest", "ingest a longer log"), ("ingest under another recipe", "prune"),
    ("ingest again", "prune"), ("add-map", "prune"), ("add-map", "add-map"), ("build", "prune"), ("prune", "prune"),
    ("acknowledge", "ingest"), ("fail", "ingest a longer log"),
]  # fmt: skip
PAIRS += [(b, a) for a, b in PAIRS if a != b and IS_WHOLE]
ON_NEW = [names for names in PAIRS if {*names} & {*MAKERS}]


def choose(world, number):
    """Return requests of the last call before which something happens: all, or some that write, other ones for another ``number``."""
    some = {*world.writes[number % SPARSE :: SPARSE], *world.namings}
    return range(world.requests) if IS_WHOLE else sorted(some or world.writes[:1])


@pytest.mark.parametrize(("store", "name"), [*(("new", name) for name in MAKERS), *(("old", name) for name in CALLS)])
def test_a_call_that_is_killed_loses_nothing_shows_nothing_by_halves_and_completes(world, store, name):
    def call():
        CALLS[name](world)

    if store == "old":
        make_old(world)
    saved, before = world.save(), world.see()
    world.run(call)
    cuts, after = choose(world, [*CALLS].index(name)), world.see()
    assert len(cuts) > 0
    for kill_at in cuts:
        world.restore(saved)
        world.run(call, kill_at=kill_at)
        seen = world.see()
        assert before & after <= seen <= before | after, kill_at
        world.run(call)
        assert world.see() == after, kill_at
        if IS_WHOLE or kill_at == cuts[-1]:
            world.check_end(saved)


@pytest.mark.parametrize(
    ("store", "names"), [*(("new", names) for names in ON_NEW), *(("old", names) for names in PAIRS)]
)
def test_two_calls_at_once_end_as_if_one_came_after_the_other(world, store, names):
    if store == "old":
        make_old(world)
    calls = [lambda name=name: CALLS[name](world) for name in names]
    saved, before, orders, cuts, counts = world.save(), world.see(), list[set](), [], []
    for order in (calls, calls[::-1]):
        world.restore(saved)
        for call in order:
            errors = world.interleave([call], [])
            expect(errors)
            counts.append(world.requests)
            cuts.append([[(0, at)] for at in choose(world, len(names[0]))])
        orders.append(world.see())
    pairs = product(range(0, counts[0], 9), range(0, counts[2], 9)) if IS_WHOLE else ()
    attacks = [*cuts[0], *([(0, a), (1, b)] for a, b in pairs)]
    for turns in attacks:
        world.restore(saved)
        expect(world.interleave(calls, [*turns, (1, 10**9)] if len(turns) == 1 else turns))
        seen = world.see()
        assert orders[0] & orders[1] <= seen <= orders[0] | orders[1] | before, turns
        for call in calls:
            expect(world.interleave([call], []))
        assert orders[0] & orders[1] <= world.see(), turns
        if IS_WHOLE or turns == attacks[-1]:
            world.check_end(saved)


def test_the_attack_shows_a_prune_that_does_not_wait_for_calls(world, monkeypatch):
    monkeypatch.setattr(prune, "_find_running", lambda *_: None)
    for _ in range(2):  # the first time it may make its files
        world.restore({})
        world.run(lambda: world.ingest("long.mcap"))
    (at,) = world.namings
    world.restore({})
    expect(world.interleave([lambda: world.ingest("long.mcap"), world.prune], [(0, at), (1, 10**9)]))
    with pytest.raises(AssertionError, match="runs/"):
        world.see()


def test_a_failing_call_beside_a_working_one_on_a_new_store_destroys_nothing(world):
    """In 1.0 the failing call removed the store that the working one had begun to write to."""
    (world.logs.parent / "empty").mkdir(exist_ok=True)

    def fail():
        world.ingest("junk.mcap", "../empty")

    for at in (8, 14, 20):
        world.restore({})
        expect(world.interleave([lambda: world.ingest("long.mcap"), fail], [(0, at), (1, 10**9)]))
        assert {kind for kind, *_ in world.see()} == {"run", "failed"}
        world.check_end({})
