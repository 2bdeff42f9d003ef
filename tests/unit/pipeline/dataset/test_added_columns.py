"""Tags and covariates as columns of the samples; holdouts by tag; robots that are wider than their patches."""

import json

import numpy as np
import pytest
from synthetic_store import add_run, lanes, open_world, segments

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError, RecipeError
from tcpipe.formats.dataset_files import read_card, read_samples
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.dataset.content import find_narrow_patches
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import CovariateConfig, Recipe, SplitConfig
from tcpipe.robots import Robot
from tcpipe.store import Store
from tcpipe.tables.findings import Subject, select_findings

START_NS = 1_760_000_000 * 10**9
DAY_NS = 86_400 * 10**9
SEASONS = {"a": "summer", "b": "winter", "c": "summer", "d": "autumn"}
LOADS = {"a": "0", "b": "12.5", "c": "0", "d": "2e1"}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Four runs of a lane and a day each, tagged."""
    directory = tmp_path_factory.mktemp("tagged")
    store = open_world(directory)
    for day, run_id in enumerate(SEASONS):
        table = segments(run_id, *lanes(np.array([3.0 * day]), -10.0, 10.0), start_ns=START_NS + day * DAY_NS)
        tags = {"season": SEASONS[run_id], "load_kg": LOADS[run_id]} | ({"driver": "7"} if day else {"note": "x"})
        add_run(store, run_id, table, tags=tags)
    return store


def build(store, out, **keywords):
    return build_dataset(out, store=store.root, **{"recipe": Recipe(), **keywords})


def weather(path, days=4):
    rows = [(START_NS // 10**9 + day * 86_400 - 600, 10.0 + day, "" if day == 1 else "dry") for day in range(days)]
    path.write_text("time,temp_c,ground\n" + "".join(f"{stamp},{temp},{word}\n" for stamp, temp, word in rows))
    return path


def missing(result):
    """Return how many of how many samples lack the values of a table or a column."""
    found = select_findings(result.findings, "covariates-missing")
    return {of.subject: (of.numbers["missing_count"], of.numbers["sample_count"]) for of in found}


@pytest.mark.parametrize("file_format", ["zarr", "parquet"])
def test_tags_and_covariates_are_columns_of_the_samples(store, tmp_path, file_format):
    result = build(store, tmp_path / "out", covariates=weather(tmp_path / "weather.csv"), format=file_format)
    rows = read_samples(tmp_path / "out").to_pylist()
    assert len(rows) == result.card.samples == 80
    for row in rows:
        day = "abcd".index(row["run_id"])
        assert row["tag_season"] == SEASONS[row["run_id"]]
        assert row["tag_load_kg"] == float(LOADS[row["run_id"]])
        assert row["tag_driver"] == (7.0 if day else None)
        assert row["weather_temp_c"] == 10.0 + day
        assert row["weather_ground"] == (None if day == 1 else "dry")
    assert missing(result) == {Subject("column", "weather_ground"): (20, 80)}
    card = read_card(tmp_path / "out")
    assert [(of.name, of.rows, of.samples_without) for of in card.covariates] == [
        ("weather.csv", 4, {"weather_temp_c": 0, "weather_ground": 20})
    ]
    assert card.added_columns["tag_season"] == "tag season of the run"
    assert not verify(tmp_path / "out").problems
    fields = json.loads((tmp_path / "out/croissant.json").read_text())["recordSet"][0]["field"]
    assert {"tag_load_kg", "weather_temp_c"} <= {field["name"] for field in fields}
    train = open_dataset(tmp_path / "out")["train"]
    assert np.isfinite(next(iter(train.batches(8, features=("tag_load_kg", "weather_temp_c"))))[-1]).all()


def test_samples_that_no_row_reaches_are_null_counted_and_said(store, tmp_path):
    result = build(store, tmp_path / "out", covariates=[weather(tmp_path / "weather.csv", days=2)])
    assert missing(result) == {Subject("file", "weather.csv"): (40, 80), Subject("column", "weather_ground"): (20, 80)}
    older = Recipe(covariates=CovariateConfig(max_age_s=3e5))
    build(store, tmp_path / "out", covariates=tmp_path / "weather.csv", recipe=older, force=True)
    assert read_samples(tmp_path / "out")["weather_temp_c"].null_count == 0


def test_columns_of_one_name_are_refused(store, tmp_path):
    path = weather(tmp_path / "tag.csv")
    path.write_text(path.read_text().replace("ground", "season"))
    with pytest.raises(DatasetError, match="columns tag_season would occur twice"):
        build(store, tmp_path / "out", covariates=path)
    with pytest.raises(DatasetError, match="tag is given twice"):
        build(store, tmp_path / "out", covariates=[path, path])


def test_a_tag_that_is_a_word_in_one_run_is_text_in_all(tmp_path, store):
    import shutil

    shutil.copytree(store.root, tmp_path / "store")
    mine = Store(tmp_path / "store")
    table = segments("e", *lanes(np.array([12.0]), -10.0, 10.0), start_ns=START_NS + 5 * DAY_NS)
    add_run(mine, "e", table, tags={"season": "summer", "load_kg": "heavy"})
    result = build(mine, tmp_path / "out")
    (found,) = select_findings(result.findings, "column-is-text")
    assert (found.subject, found.names["example"]) == (Subject("tag", "load_kg"), "heavy")
    assert set(read_samples(tmp_path / "out")["tag_load_kg"].to_pylist()) == {"0", "12.5", "2e1", "heavy"}


def test_a_tag_is_held_out_whole(store, tmp_path):
    build(store, tmp_path / "out", holdout="tag:season")
    rows = read_samples(tmp_path / "out").to_pylist()
    splits = {season: {row["split"] for row in rows if row["tag_season"] == season} for season in SEASONS.values()}
    assert all(len(of) == 1 for of in splits.values())
    assert set().union(*splits.values()) == {"train", "test"}
    folds = {row["run_id"]: row["fold"] for row in rows}
    assert folds["a"] == folds["c"]
    rules = read_card(tmp_path / "out").recipe.split
    assert (rules.holdout, rules.holdout_tag) == ("tag", "season")
    result = build(store, tmp_path / "other", recipe=Recipe(split=SplitConfig(holdout="tag", holdout_tag="season")))
    assert {row["sample_id"]: row["split"] for row in rows} == {
        row["sample_id"]: row["split"] for row in read_samples(tmp_path / "other").to_pylist()
    }
    assert result.card.splits["test"] in {20, 40}
    # A fit to 20 segments and more; that of the card must not know the labels that are held out.
    assert {fit.segments for fit in result.card.physics.values()} == {result.card.splits["train"]}


def test_a_holdout_wants_a_tag_that_all_runs_carry(store, tmp_path):
    with pytest.raises(DatasetError, match=r"1 of 4 runs do not have it \(a\)"):
        build(store, tmp_path / "out", holdout="tag:driver")
    with pytest.raises(RecipeError, match=r"expected split\.holdout_tag too"):
        build(store, tmp_path / "out", holdout="tag")


def test_a_robot_wider_than_a_patch_or_of_unknown_width_is_named(store, tmp_path):
    known = {"husky": Robot(width_m=0.67), "warthog": Robot(width_m=1.38), "dingo": Robot()}
    unknown, narrow = "robot-width-unknown", "patch-narrower-than-robot"
    found = find_narrow_patches(["husky", "warthog", "dingo", "mine", "husky"], known, patch_m=1.0)
    assert [(of.code, of.subject.name) for of in found] == [(unknown, "dingo"), (unknown, "mine"), (narrow, "warthog")]
    assert found[2].numbers == {"width_m": 1.38, "patch_m": 1.0}
    assert found[2].remedies[0].recipe == {"sample": {"patch_m": 1.38}}
    assert find_narrow_patches(["warthog"], known, patch_m=1.5) == []
