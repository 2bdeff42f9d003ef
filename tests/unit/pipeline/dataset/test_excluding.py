"""Samples that a list excludes: gone and counted, while all others keep their split, also when runs are added later."""

import csv
import json
import math
import shutil

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from synthetic_store import add_run, box, lanes, open_world, region_file, segments

from tcpipe.cli import cli
from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError, UsageError
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.diff import diff
from tcpipe.pipeline.explain import explain
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe
from tcpipe.store import Store
from tcpipe.tables.findings import select_findings

WHY = "the robot pushed a fence"


def add(store, run_id, y_m, start_ns):
    add_run(store, run_id, segments(run_id, *lanes(np.array([y_m]), -10.0, 10.0), start_ns=start_ns))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A store of two runs, a region, and the dataset without an exclusion."""
    here = tmp_path_factory.mktemp("made")
    opened = open_world(here)
    add(opened, "a", 0.0, 10**18)
    add(opened, "b", 3.0, 2 * 10**18)
    region = region_file(here / "region.geojson", box(-20, -20, 5, 20))
    build_dataset(here / "plain", store=opened.root, recipe=Recipe(), split=region)
    return here


@pytest.fixture
def store(made, tmp_path):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True, copy_function=shutil.copy2)
    return Store(tmp_path / "store")


@pytest.fixture(scope="module")
def plain(made):
    """The samples of the dataset without an exclusion."""
    return pq.read_table(made / "plain/samples.parquet")


def build(store, tmp_path, *, ids=None, **more):
    if ids is not None:
        (tmp_path / "ids.csv").write_text("split,sample_id\n" + "".join(f"any,{name}\n" for name in ids))
    settings = {
        "recipe": Recipe(),
        "exclude": tmp_path / "ids.csv",
        "reason": WHY,
        "split": tmp_path / "region.geojson",
    }
    return build_dataset(tmp_path / "out", store=store.root, **{**settings, **more})


def samples(tmp_path):
    return pq.read_table(tmp_path / "out/samples.parquet")


def outcomes(tmp_path):
    return list(csv.DictReader((tmp_path / "out/excluded.csv").read_text().splitlines()))


def choose(plain):
    """Three samples of different splits, of which one is in the buffer."""
    return [
        plain["sample_id"][pc.index(plain["split"], name).as_py()].as_py() for name in ("train", "unseen", "buffer")
    ]


@pytest.mark.parametrize("file_format", ["zarr", "parquet"])
def test_the_listed_ones_are_gone_and_counted_and_nothing_else_changes(store, plain, tmp_path, file_format):
    ids = choose(plain)
    result = build(store, tmp_path, ids=ids, file_format=file_format)
    rest = plain.filter(np.isin(plain["sample_id"].to_numpy(), ids, invert=True))
    assert samples(tmp_path).equals(rest)
    patches = open_dataset(tmp_path / "plain")["train"].select(
        rest.filter(pc.equal(rest["split"], "train"))["sample_id"].to_pylist()
    )
    np.testing.assert_array_equal(open_dataset(tmp_path / "out")["train"].patches, patches.patches)
    card, without = result.card, open_dataset(tmp_path / "plain").card
    gone_m = plain.filter(np.isin(plain["sample_id"].to_numpy(), ids))["arc_length_m"].to_pylist()
    assert card.distance_by_reason_m["excluded"] == pytest.approx(sum(gone_m))
    assert "excluded" not in without.distance_by_reason_m
    assert math.fsum(card.distance_by_reason_m.values()) == pytest.approx(
        math.fsum(without.distance_by_reason_m.values())
    )
    assert [(of.name, of.reason, of.listed, of.samples) for of in card.exclusions] == [("ids.csv", WHY, 3, 3)]
    assert f"3 m excluded\nids.csv: 3 samples excluded: {WHY}\n" in str(result)
    assert (verify(tmp_path / "out").problems, result.exit_code) == ((), 0)


def test_it_is_made_again_where_the_list_has_changed_and_only_there(store, plain, tmp_path):
    ids = choose(plain)
    assert build(store, tmp_path, ids=ids).status == "done"
    assert build(store, tmp_path, ids=ids).status == "unchanged"
    assert build(store, tmp_path, ids=ids[:1]).status == "done"
    assert samples(tmp_path).num_rows == plain.num_rows - 1
    assert build(store, tmp_path, reason="another").card.exclusions[0].reason == "another"
    with pytest.raises(UsageError) as caught:
        build(store, tmp_path, exclude=(), reason=())
    assert "--exclude: ids.csv in the dataset, none now" in caught.value.problems[1]


def test_it_survives_new_runs(store, plain, tmp_path):
    ids = choose(plain)
    build(store, tmp_path, ids=ids)
    before = samples(tmp_path)
    add(store, "c", 6.0, 3 * 10**18)
    result = build(store, tmp_path, keep_split=tmp_path / "out")
    after = samples(tmp_path)
    assert result.status == "done"
    assert after.filter(pc.not_equal(after["run_id"], "c")).equals(before)
    assert after.num_rows == before.num_rows + 20
    assert result.card.exclusions[0].samples == 3


def test_ids_that_match_nothing_are_named(store, plain, tmp_path):
    result = build(store, tmp_path, ids=[*choose(plain), "b-7", "gone-1"])
    (found,) = select_findings(result.findings, "exclusion-unmatched")
    assert found.names["example"] == "b-7"
    rows = outcomes(tmp_path)
    assert [row["outcome"] for row in rows] == [*["excluded"] * 3, *["no segment"] * 2]
    assert [row["sample_id"] for row in rows[3:]] == ["b-7", "gone-1"]
    assert (found.numbers["unmatched_count"], found.numbers["listed_count"]) == (2, 5)
    assert found.severity == "warning"


def test_explain_and_diff_tell_it(store, plain, tmp_path):
    ids = choose(plain)
    build(store, tmp_path, ids=ids)
    with pytest.raises(DatasetError, match=f"{ids[1]} was excluded when the dataset was built, by ids.csv: {WHY}"):
        explain(ids[1], dataset=tmp_path / "out", store=store.root)
    found = diff(tmp_path / "plain", tmp_path / "out")
    assert "exclusion: added ids.csv" in found.causes
    assert found.samples["only in a"] == 3
    assert (found.moved, found.samples["other fold"]) == ({}, 0)
    (tmp_path / "out").rename(tmp_path / "earlier")
    build(store, tmp_path, ids=ids[:1])
    assert "exclusion: ids.csv.sha256 is another one" in diff(tmp_path / "earlier", tmp_path / "out").causes


def test_its_own_list_makes_the_same_dataset_without_the_first(store, plain, tmp_path):
    build(store, tmp_path, ids=choose(plain))
    first = samples(tmp_path)
    (tmp_path / "out/excluded.csv").rename(tmp_path / "kept.csv")
    result = build(store, tmp_path, exclude=str(tmp_path / "kept.csv"), force=True)
    assert samples(tmp_path).equals(first)
    assert result.card.exclusions[0].listed == 3


def test_two_lists_have_two_reasons_and_a_sample_counts_once(store, plain, tmp_path):
    ids = choose(plain)
    other = next(name for name in plain["sample_id"].to_pylist() if name not in ids)
    (tmp_path / "more.txt").write_text(f"{ids[0]}\n\n{other}\r\n")
    lists = [tmp_path / "ids.csv", tmp_path / "more.txt"]
    card = build(store, tmp_path, ids=ids, exclude=lists, reason=["one", "two"]).card
    assert [(of.reason, of.listed, of.samples) for of in card.exclusions] == [("one", 3, 3), ("two", 2, 1)]


def test_a_segment_that_is_no_sample_is_said_to_be_none(store, plain, tmp_path):
    add_run(store, "far", segments("far", *lanes(np.array([500.0]), 0.0, 2.0), start_ns=4 * 10**18))
    add(store, "c", 6.0, 3 * 10**18)
    card = build(store, tmp_path, ids=["far-4000000000000000000", "c-3000000000000000000"]).card
    assert [(of.listed, of.samples) for of in card.exclusions] == [(2, 1)]
    assert [row["outcome"] for row in outcomes(tmp_path)] == ["no sample", "excluded"]


def test_without_coordinates_the_metres_alone_are_published(store, plain, tmp_path):
    ids = choose(plain)
    card = build(store, tmp_path, ids=ids, without_coordinates=True).card
    assert not (tmp_path / "out/excluded.csv").exists()
    assert card.exclusions == ()
    assert card.distance_by_reason_m["excluded"] == pytest.approx(3.0)
    text = (tmp_path / "out/dataset.json").read_text() + (tmp_path / "out/report.html").read_text()
    assert not any(secret in text for secret in (WHY, "ids.csv", *ids))
    assert verify(tmp_path / "out").problems == ()


@pytest.mark.parametrize(
    ("text", "reason", "said"),
    [
        ("a-1\n", (), "1 lists of samples and 0 reasons"),
        ("a-1\n", " ", "1 lists of samples and 0 reasons"),
        ("run;quality\na;0\n", WHY, "its columns are run, quality; expected sample_id or segment_id"),
        ("sample_id\n\n", WHY, "contains no sample id"),
        ("", WHY, "contains no sample id"),
        ("\xff", WHY, "cannot be read"),
    ],
)
def test_a_list_that_cannot_be_used_is_said_to_be(store, tmp_path, text, reason, said):
    (tmp_path / "ids.csv").write_bytes(text.encode("latin-1"))
    with pytest.raises((DatasetError, UsageError), match=said):
        build(store, tmp_path, reason=reason, split=None)
    assert not (tmp_path / "out").exists()


def test_two_lists_of_one_name_are_refused(store, tmp_path):
    (tmp_path / "ids.csv").write_text("a-1\n")
    with pytest.raises(UsageError, match="two lists have one name"):
        build(store, tmp_path, exclude=[tmp_path / "ids.csv", tmp_path / "ids.csv"], reason=["a", "b"], split=None)


def test_nothing_is_written_where_a_list_names_everything(store, plain, tmp_path):
    with pytest.raises(DatasetError, match="name all 40 samples"):
        build(store, tmp_path, ids=plain["sample_id"].to_pylist(), split=None)
    assert not (tmp_path / "out").exists()


def test_the_command_takes_lists_with_semicolons_and_names_of_segments(store, plain, tmp_path):
    (tmp_path / "ids.csv").write_text("\ufeffsegment_id; split\n" + "".join(f"{name};x\n" for name in choose(plain)))
    call = ["build-dataset", str(tmp_path / "out"), "--store", str(store.root), "--exclude", str(tmp_path / "ids.csv")]
    found = CliRunner().invoke(cli, [*call, "--reason", WHY, "--json", "--quiet"])
    assert json.loads(found.stdout)["card"]["exclusions"][0]["samples"] == 3
