"""The check of a split of any table: hand-counted pairs, brute force, own datasets, and input that cannot be judged."""

import json
import re
from itertools import pairwise

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from installed_command import plain_lines, tcpipe
from synthetic_store import add_run, lanes, lonlat, open_world, segments

from tcpipe import check_split
from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError, UsageError
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe

TRACK = ["train", "test", "train", "train", "test", "test", "train", "buffer", "test", None, "val"]
"""Splits along a track of 1 m steps: three samples of test are next to one of train, the fourth and that of val to none."""


def write(path, x=tuple(range(11)), y=0.0, split=TRACK, run="a", **columns):
    """Write a table, CSV or Parquet by its name; ``y`` and ``run`` may be one value for all samples."""
    spread = {name: np.broadcast_to(np.asarray(value), len(split)) for name, value in (("y_m", y), ("run", run))}
    table = pl.DataFrame({"x_m": np.asarray(x, float), "split": split, **spread, **columns})
    getattr(table, {".csv": "write_csv", ".parquet": "write_parquet"}[path.suffix])(path)
    return path


def count(check):
    """Return of each held-out split its samples and how many leak, share ground, and are neighbours."""
    return {
        of.split: (of.samples, of.leaking_samples, of.overlapping_samples, of.neighbour_samples)
        for of in check.held_out
    }


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_random_split_of_one_track_is_caught(tmp_path, kind):
    path = write(tmp_path / f"track.{kind}")
    if kind == "csv":  # as a spreadsheet in many countries writes it
        path.write_text(path.read_text().replace(",", ";"))
    touching = check_split(path, xy="x_m,y_m", run="run")
    assert count(touching) == {"test": (4, 3, 0, 3), "val": (1, 0, 0, 0)}  # squares of 1 m touch, which is not to share
    assert (touching.train_samples, touching.unused_samples, touching.neighbours_within_m) == (4, 2, 1.5)
    assert touching.above_limit == ("test",)
    wide = check_split(path, xy=["x_m", "y_m"], footprint_m=2.5)
    assert count(wide) == {"test": (4, 4, 4, None), "val": (1, 0, 0, None)}
    test, val = wide.held_out
    assert (test.nearest_train_min_m, test.nearest_train_median_m, test.near_fraction) == (0.0, 0.0, 1.0)
    assert (val.nearest_train_min_m, val.near_fraction) == (1.5, 1.0)
    assert check_split(path, xy="x_m,y_m", run="run", limit_fraction=0.75).above_limit == ()
    judged = check_split(path, xy="x_m,y_m", run="run", unused=["val", "test"])
    assert count(judged) == {"buffer": (1, 1, 0, 1)}


def test_a_robot_at_rest_is_judged_in_no_time_and_counts_sample_by_sample(tmp_path):
    count_at_rest = 20_000
    x = np.r_[np.zeros(count_at_rest), np.zeros(count_at_rest), 50.0]
    split = ["train"] * count_at_rest + ["test"] * count_at_rest + ["test"]
    check = check_split(write(tmp_path / "rest.parquet", x=x, split=split), xy="x_m,y_m")
    assert count(check) == {"test": (count_at_rest + 1, count_at_rest, count_at_rest, None)}


def test_samples_follow_one_another_in_time_and_on_one_run(tmp_path):
    order = np.random.default_rng(1).permutation(len(TRACK))
    path = write(
        tmp_path / "mixed.csv",
        order,
        split=[TRACK[of] for of in order],
        stamp=[f"2026-01-01T00:00:{of:02d}Z" for of in order],
    )
    assert count(check_split(path, xy="x_m,y_m", run="run", time="stamp"))["test"] == (4, 3, 0, 3)
    path = write(tmp_path / "runs.parquet", run=np.arange(len(TRACK)))
    assert count(check_split(path, xy="x_m,y_m", run="run"))["test"] == (4, 0, 0, 0)


@pytest.mark.parametrize("has_buffer_rows", [True, False])
def test_a_split_by_a_polygon_with_a_buffer_passes(tmp_path, has_buffer_rows):
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(40.0), np.arange(0.0, 30.0, 2.0)))
    x = np.where(y % 4 == 0, x, 39.0 - x)  # lanes there and back
    split = np.select([x < 20, x > 24], ["train", "test"], "buffer")
    kept = np.full(len(x), True) if has_buffer_rows else split != "buffer"
    path = write(tmp_path / "lawn.parquet", x[kept], y[kept], split=split[kept].tolist())
    check = check_split(path, xy="x_m,y_m", run="run")
    assert count(check) == {"test": (225, 0, 0, 0)}
    assert check.above_limit == ()
    assert check.held_out[0].nearest_train_min_m == 5.0
    done = tcpipe("check-split", path, "--xy", "x_m,y_m", "--run", "run", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "above it: none" in done.stdout


def test_degrees_are_judged_in_metres_and_ends_turn_the_footprint(tmp_path):
    start = np.array([(0.0, 0.0), (0.948, 1.336), (0.0, 40.0), (1.3, 41.3)])
    end = start + np.array([(0.8, 0.6), (0.6, -0.8), (1.0, 0.0), (1.0, 0.0)])
    ends = {"start": lonlat(start), "end": lonlat(end)}
    degrees = {f"{name}_{axis}": at[:, k] for name, at in ends.items() for k, axis in enumerate(("lon", "lat"))}
    metres = {f"{name}_{axis}": at[:, k] for name, at in (("from", start), ("to", end)) for k, axis in enumerate("xy")}
    path = write(tmp_path / "ends.csv", start[:, 0], split=["train", "near", "train", "far"], **degrees, **metres)
    of_metres = check_split(path, xy="from_x,from_y,to_x,to_y", footprint_m=1.0)
    of_degrees = check_split(path, xy="start_lon,start_lat,end_lon,end_lat", footprint_m=1.0)
    assert count(of_metres) == count(of_degrees) == {"far": (1, 0, 0, None), "near": (1, 0, 0, None)}
    for ours, theirs in zip(of_degrees.held_out, of_metres.held_out, strict=True):
        assert ours.nearest_train_min_m == pytest.approx(theirs.nearest_train_min_m, abs=2e-3)
    assert of_metres.held_out[0].nearest_train_min_m == pytest.approx(np.hypot(0.3, 0.3))
    assert of_metres.held_out[1].nearest_train_min_m == pytest.approx(0.06)  # along the common direction (0.6, -0.8)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 40), st.sampled_from([3.0, 30.0]), st.sampled_from([0.5, 1.0, 4.0]))
def test_counts_are_those_of_brute_force(tmp_path_factory, seed, rows, extent_m, footprint_m):
    rng = np.random.default_rng(seed)
    xy, run, stamp = rng.uniform(0, extent_m, (rows, 2)), rng.integers(0, 3, rows), rng.permutation(rows)
    split = np.array(["train", "test", *rng.choice(["train", "test", "buffer"], rows - 2)])
    path = write(tmp_path_factory.mktemp("any") / "any.parquet", xy[:, 0], xy[:, 1], split.tolist(), run, stamp=stamp)
    check = check_split(path, xy="x_m,y_m", run="run", time="stamp", footprint_m=footprint_m)
    tracks = [[row for row in np.argsort(stamp) if run[row] == name] for name in range(3)]
    steps = [(a, b, np.linalg.norm(xy[a] - xy[b])) for track in tracks for a, b in pairwise(track)]
    within_m = 1.5 * max(footprint_m, np.median([apart for *_, apart in steps]) if steps else 0.0)
    adjacent = {frozenset((a, b)) for a, b, apart in steps if apart <= within_m}
    train, test = np.flatnonzero(split == "train"), np.flatnonzero(split == "test")
    across = np.abs(xy[test][:, None] - xy[train])
    common = np.clip(footprint_m - across, 0.0, None).prod(axis=2) / footprint_m**2 > 1e-3
    apart_m = np.linalg.norm(np.clip(across - footprint_m, 0.0, None), axis=2).min(axis=1)
    neighbour = np.array([any(frozenset((a, b)) in adjacent for b in train) for a in test])
    (found,) = check.held_out
    assert check.neighbours_within_m == pytest.approx(within_m)
    assert found.overlapping_samples == common.any(axis=1).sum()
    assert found.neighbour_samples == neighbour.sum()
    assert found.leaking_samples == (common.any(axis=1) | neighbour).sum()
    assert found.nearest_train_min_m == pytest.approx(apart_m.min(), abs=1e-9)
    assert found.nearest_train_median_m == pytest.approx(np.median(apart_m), abs=1e-9)
    assert found.near_fraction == pytest.approx((apart_m <= footprint_m).mean())


ENDS = "start_lon_deg,start_lat_deg,end_lon_deg,end_lat_deg"


def test_an_own_dataset_is_judged_as_its_card_says_and_every_option_is_heard(tmp_path):
    store, (start, end) = open_world(tmp_path), lanes(np.arange(-6.0, 6.0, 2.0), -14.0, 14.0)
    add_run(store, "out", segments("out", start, end))
    add_run(store, "back", segments("back", end[::-1] + 0.3, start[::-1] + 0.3, start_ns=10**15))
    build_dataset(tmp_path / "dataset", store=store.root, recipe=Recipe(), holdout="sample")
    card = open_dataset(tmp_path / "dataset").card
    of_card = {of.split: of for of in card.split.audit if of.samples}
    command = ("check-split", "dataset/samples.parquet", "--xy", ENDS, "--run", "run_id", "--time", "start_ns")
    done = tcpipe(*command, "--json", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (3, "")
    told = json.loads(done.stdout)
    assert {of["split"] for of in told["held_out"]} == set(of_card) == {"test"}
    for of in told["held_out"]:
        audit = of_card[of["split"]]
        assert (of["samples"], of["overlapping_samples"]) == (audit.samples, audit.overlapping_samples)
        assert 0 < audit.overlapping_samples < audit.samples
        assert 0.5 * audit.same_track_pairs <= of["neighbour_samples"] <= audit.same_track_pairs
        assert of["nearest_train_median_m"] == pytest.approx(audit.nearest_train_median_m, abs=0.01)
    more = [
        "--split",
        "split",
        "--train",
        "test",
        "--unused",
        "none",
        "--footprint",
        "0.5",
        "--limit",
        "1",
        "--html",
        "page.html",
    ]
    done = tcpipe(*command, *more, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "footprint 0.5 m; neighbours: adjacent on a run, at most 1.5 m apart" in done.stdout
    assert "limit: 1 of a split may leak; above it: none" in done.stdout
    assert re.search(r"\n +train +", done.stdout)
    page = (tmp_path / "page.html").read_text()
    for text in (*done.stdout.split("\n")[1:3], "<td>train</td>", "Held-out splits"):
        assert text in page


LATITUDE_FIRST = ["--xy lat,lon is from [47.0, 15.0]", "longitude before latitude"]
BAD = {
    "columns": ({}, {"xy": "lon,y_m", "run": "track", "time": "t"}, ["no column 'lon' (--xy); there are x_m", "'track'", "'t'"]),
    "no training": ({}, {"train": "tr"}, ["no training samples, 'tr': column split has buffer, test, train, val"]),
    "nothing held out": ({}, {"unused": ["buffer", "test", "val"]}, ["no held-out samples: column split has"]),
    "text": ({}, {"xy": "split,y_m", "train": "t"}, ["no training samples", "column split is large_string, as '"]),
    "NaN": ({"x": [*range(5), *[np.nan] * 3, 8, 9, 10]}, {}, ["column x_m has no value in 2 rows, first in row 6; fill them"]),
    "no run": ({"run": [*"aaa", None, *"aaaaaaa"]}, {"run": "run"}, ["column run has no value in 1 rows, first in row 4"]),
    "latitude first": ({"lat": [47.0] * 11, "lon": [15.0] * 11}, {"xy": "lat,lon"}, LATITUDE_FIRST),
    "no degrees": ({"lat": [5e6] * 11, "lon": [5e5] * 11}, {"xy": "lon,lat"}, LATITUDE_FIRST[1:]),
    "far apart": ({"lat": [0.0] * 11, "lon": [0.0, *[10.0] * 10]}, {"xy": "lon,lat"}, ["1112 km from the first one; expected at most"]),
}  # fmt: skip


@pytest.mark.parametrize("kind", ["csv", "parquet"])
@pytest.mark.parametrize("name", BAD)
def test_a_table_that_cannot_be_judged_is_an_error_with_all_its_problems(tmp_path, name, kind):
    content, options, expected = BAD[name]
    path = write(tmp_path / f"bad.{kind}", **content)
    with pytest.raises(DatasetError) as caught:
        check_split(path, **{"xy": "x_m,y_m", **options})
    assert len(caught.value.problems) == (len(expected) if name in {"columns", "text"} else 1)
    for part in expected:
        assert any(part in problem for problem in caught.value.problems), caught.value.problems
    assert all(str(path) in problem for problem in caught.value.problems)


def test_files_that_are_no_table_and_calls_that_make_no_sense(tmp_path):
    path = write(tmp_path / "track.csv")
    (tmp_path / "empty.csv").write_text("x_m,y_m,split\n")
    (tmp_path / "odd.parquet").write_text("x_m,y_m,split\n")
    (tmp_path / "table.xlsx").write_text("")
    for file, said in {
        "empty.csv": "has no rows",
        "odd.parquet": "not a readable table",
        "table.xlsx": "unknown type of file; expected a table that ends in .csv or .parquet",
    }.items():
        assert said in plain_lines(tcpipe("check-split", file, "--xy", "x_m,y_m", cwd=tmp_path), 1)
    for options in ({"xy": "x_m"}, {"xy": "x_m,y_m", "footprint_m": 0.0}, {"xy": "x_m,y_m", "limit_fraction": 1.5}):
        with pytest.raises(UsageError):
            check_split(path, **options)
    assert "no such file" in plain_lines(tcpipe("check-split", "gone.csv", "--xy", "x_m,y_m", cwd=tmp_path), 2)
    assert "--xy" in plain_lines(tcpipe("check-split", path, cwd=tmp_path), 2)
