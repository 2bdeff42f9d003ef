"""The longest run counts of those of one robot that begin with the same measurements: each scan finds it."""

import numpy as np
import pytest
from synthetic_store import add_run, lanes, segments
from wheel_drives import START_NS, drive_at, wheel_drive

from tcpipe.formats.logs.writing import write_mcap
from tcpipe.formats.runs import LogOrigin, Recording
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.problems import forget_tables
from tcpipe.recipe import ReadConfig, Recipe, TableMapping
from tcpipe.store import Store, open_store
from tcpipe.tables.findings import Subject, make_finding

OTHER = Recipe(read=ReadConfig(ignore_topics=["/none"]))
DAMAGE = (make_finding("file-cut", Subject("file", "a.mcap")),)


def put(store, name, length_s=10, *, robot="husky", beginning="b", first_ns=0, **how):
    """Put a run whose recording is so long into a store."""
    recording = Recording(first_ns, first_ns + length_s * 10**9, 50 * length_s, beginning)
    table = segments(name, *lanes(0.0, 0.0, 5.0), robot=robot)
    origin = LogOrigin((f"/logs/{name}.mcap",), how.pop("sha256", name), 1)
    add_run(store, name, table, recording=recording, log=origin, **how)


@pytest.fixture
def store(tmp_path):
    return open_store(tmp_path / "store", create=True)


def superseded(store):
    return {row.run_id: row.superseded_by for row in store.scan().list_rows() if row.superseded_by}


def counted(store):
    return [run.run_id for run in store.runs()]


@pytest.mark.parametrize(
    "order", [("short", "middle", "long"), ("long", "short", "middle"), ("middle", "long", "short")]
)
def test_the_longest_recording_counts_in_whatever_order_they_come(store, order):
    for name in order:
        put(store, name, {"short": 5, "middle": 7, "long": 9}[name])
    assert superseded(store) == {"short": "long", "middle": "long"}
    assert counted(store) == ["long"]


def test_when_the_longest_is_given_up_the_next_one_counts_again(store):
    for name, length_s in (("short", 5), ("middle", 7), ("long", 9)):
        put(store, name, length_s)
    state = store.scan()
    (row,) = state.list_rows("long")
    store.place.delete(state.names["runs", next(key for key, of in state.runs.items() if of.run_id == "long")])
    assert superseded(store) == {"short": "middle"}
    put(store, "long", 9)
    assert superseded(store) == {"short": "long", "middle": "long"}
    (row,) = store.scan().list_rows("long")
    forget_tables(store, store.scan(), row)
    assert superseded(store) == {"short": "middle"}, "what has no tables takes the place of nothing"
    assert counted(store) == ["middle"]


@pytest.mark.parametrize(
    "other",
    [
        {"robot": "jackal"},
        {"beginning": "another"},
        {"first_ns": 1},
        {"recipe": OTHER},
    ],
    ids=str,
)
def test_another_robot_other_values_another_begin_or_another_recipe_supersede_nothing(store, other):
    put(store, "one", 5)
    put(store, "two", 9, **other)
    assert superseded(store) == {}
    assert counted(store) == ["one", "two"]


def test_of_two_that_are_as_long_the_one_without_damage_counts(store):
    put(store, "damaged", 9, damage=DAMAGE, findings=DAMAGE)
    put(store, "repaired", 9)
    assert superseded(store) == {"damaged": "repaired"}
    put(store, "damaged, longer", 10, damage=DAMAGE, findings=DAMAGE)
    assert counted(store) == ["damaged, longer"]


# --- of logs --------------------------------------------------------------------------------------------------------


def run_ids(summary):
    return [result.run.run_id for result in summary.results]


def test_a_shorter_log_that_comes_later_is_superseded_at_once_and_says_by_which(tmp_path):
    store, long, short = tmp_path / "store", drive_at(tmp_path / "long.mcap"), tmp_path / "short.mcap"
    write_mcap(short, wheel_drive(rows=900))
    (first,) = run_ids(ingest([long], store=store, recipe=Recipe()))
    (result,) = ingest([short], store=store, recipe=Recipe()).results
    assert result.notes == (f"run {first} supersedes it: its log begins in the same way and is longer",)
    assert counted(Store(store)) == [first]
    (result,) = ingest([short], store=store, recipe=Recipe()).results
    assert (result.status, result.notes) == ("unchanged", ())


@pytest.mark.parametrize("later", [{"seed": 1}, {"start_ns": START_NS + 10**12}, {"seed": 1, "rows": 700}])
def test_a_name_used_again_for_another_drive_supersedes_nothing(tmp_path, later):
    log, store = drive_at(tmp_path / "latest.mcap"), tmp_path / "store"
    before = run_ids(ingest([log], store=store, recipe=Recipe()))
    drive_at(log, **later)
    summary = ingest([log], store=store, recipe=Recipe())
    assert summary.results[0].notes == ()
    assert counted(Store(store)) == sorted(before + run_ids(summary))


@pytest.mark.parametrize("rest_s", [0.0, 3.0])
def test_drives_in_tables_whose_time_starts_at_0_do_not_supersede_each_other(tmp_path, rest_s):
    """Also where each robot rests at first, so that its odometer gives the same values in each drive."""
    wheels = TableMapping("drive_*.csv", stamp="t", stamp_unit="s", columns={"linear_x": "v", "angular_z": "w"})
    recipe = Recipe(tables={"wheel_odometry": wheels})
    (tmp_path / "logs").mkdir()
    for seed in range(2):
        t = np.arange(0.0, 40.0, 0.05)
        v = np.where(t < rest_s, 0.0, 1.0 + 0.01 * np.random.default_rng(seed).standard_normal(len(t)))
        lines = (f"{time:.2f},{speed:.6f},0.0" for time, speed in zip(t, v, strict=True))
        (tmp_path / "logs" / f"drive_{seed}.csv").write_text("\n".join(["t,v,w", *lines]))
    summary = ingest([tmp_path / "logs"], store=tmp_path / "store", recipe=recipe)
    assert [result.status for result in summary.results] == ["done", "done"], summary.results
    assert superseded(Store(tmp_path / "store")) == {}
