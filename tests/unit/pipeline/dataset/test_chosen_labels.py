"""Datasets without power, without a map or without GNSS, and datasets of the labels that a user asks for."""

import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from synthetic_store import add_run, box, driven, lanes, open_world, region_file, segments

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError, UsageError
from tcpipe.formats.dataset_card import LOCAL
from tcpipe.formats.dataset_files import read_samples
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.diff import diff
from tcpipe.pipeline.explain import explain
from tcpipe.pipeline.report import report
from tcpipe.pipeline.verify import verify
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store
from tcpipe.tables.findings import select_findings


def with_null(table, *names, rows=slice(None)):
    """Return a table with nulls in some rows of columns."""
    for name in names:
        at = table.schema.get_field_index(name)
        values = table.column(name).to_pylist()
        for row in range(*rows.indices(len(values))):
            values[row] = None
        table = table.set_column(at, table.schema.field(at), pa.array(values, table.schema.field(at).type))
    return table


def make_segments(run_id, y_m, *, start_ns=0, powered=True):
    return segments(run_id, *lanes(np.array(y_m), -14.0, 14.0), start_ns=start_ns, powered=powered)


POSITIONS = (*(f"{end}_{axis}_deg" for end in ("start", "end") for axis in ("lon", "lat")), "geometry")


@pytest.fixture(scope="module")
def map_store(tmp_path_factory):
    return open_world(tmp_path_factory.mktemp("maps"))


@pytest.fixture
def store(map_store, tmp_path):
    return Store(shutil.copytree(map_store.root, tmp_path / "store"))


@pytest.fixture
def bare(tmp_path):
    return open_store(tmp_path / "bare", create=True)


@pytest.fixture
def region(tmp_path):
    return region_file(tmp_path / "region.geojson", box(-20.0, -20.0, 4.0, 20.0))


def build(store, out, **how):
    return build_dataset(out, store=store.root, recipe=Recipe(), **how)


def read(out):
    return {row["sample_id"]: row for row in read_samples(out).to_pylist()}


def test_runs_without_power_give_the_samples_splits_and_times_of_runs_with_it(store, tmp_path, region):
    powered, unpowered = store, Store(shutil.copytree(store.root, tmp_path / "other"))
    for each, has_power in ((powered, True), (unpowered, False)):
        for number in range(2):
            table = make_segments(f"run{number}", [1.0 + 2 * number, 9.0], start_ns=number * 10**12, powered=has_power)
            add_run(each, f"run{number}", table)
    build(powered, tmp_path / "with", split=region)
    result = build(unpowered, tmp_path / "without", split=region)
    ours, theirs = read(tmp_path / "without"), read(tmp_path / "with")
    names = ("split", "fold", "duration_s", "velocity_mps", "slip_fraction", "terrain_name")
    assert [[row[name] for name in names] for row in ours.values()] == [
        [row[name] for name in names] for row in theirs.values()
    ]
    assert list(ours) == list(theirs)
    assert {row["energy_joule"] for row in ours.values()} == {None}
    data = open_dataset(tmp_path / "without")
    assert data.labels == ("time", "slip", "vibration")
    assert data["train"].labels.shape == (len(data["train"]), 1)
    assert data["train"].label_columns == ("velocity_mps",)
    assert result.card.labels == {"energy": 0, "time": 112, "slip": 112, "vibration": 112}
    (absent,) = select_findings(result.card.findings, "labels-absent")
    assert absent.names["labels"] == "energy"
    report(tmp_path / "without")
    assert "none" in (tmp_path / "without" / "report.html").read_text()
    assert not verify(tmp_path / "without").problems


def test_samples_need_the_labels_that_were_asked_for(store, tmp_path):
    table = with_null(make_segments("a", [1.0]), "slip_fraction", rows=slice(0, 5))
    table = with_null(table, "power_watt", "energy_joule", rows=slice(3, 10))
    add_run(store, "a", table)
    assert build(store, tmp_path / "default").card.samples == 28 - 7
    result = build(store, tmp_path / "time", labels="time")
    assert result.card.samples == 28
    assert result.card.labels == {"energy": 21, "time": 28, "slip": 23, "vibration": 28}
    result = build(store, tmp_path / "both", labels=["slip", "energy"])
    assert result.card.samples == 28 - 10
    assert result.card.distance_by_reason_m["no_label"] == pytest.approx(3.0)  # five lack slip, two of them power, too
    assert sum(result.card.distance_by_reason_m.values()) == pytest.approx(28.0 + 2.5)
    with pytest.raises(UsageError, match="got speed"):
        build(store, tmp_path / "no", labels="time,speed")
    with pytest.raises(UsageError, match="--labels"):
        build(store, tmp_path / "time", labels="time,slip")
    assert build(store, tmp_path / "time", labels="time").status == "unchanged"


def test_a_label_that_no_segment_has_is_named_with_what_the_runs_lack(store, tmp_path):
    add_run(store, "a", with_null(make_segments("a", [1.0], powered=False), "slip_fraction"))
    with pytest.raises(DatasetError, match=r"none with power and wheel odometry; .*--labels"):
        build(store, tmp_path / "out", labels="energy,slip")
    assert build(store, tmp_path / "out").card.samples == 28


def test_without_a_map_the_dataset_is_a_table_with_the_same_split(store, bare, tmp_path, region):
    for each in (store, bare):
        for number in range(2):
            add_run(
                each, f"run{number}", make_segments(f"run{number}", [1.0, 2.0 + 9 * number], start_ns=number * 10**12)
            )
    build(store, tmp_path / "with", split=region)
    result = build(bare, tmp_path / "without", split=region)
    assert [finding.code for finding in result.findings if "map" in finding.code] == ["no-map"]
    ours, theirs = read(tmp_path / "without"), read(tmp_path / "with")
    assert {name: (row["split"], row["fold"]) for name, row in ours.items()} == {
        name: (row["split"], row["fold"]) for name, row in theirs.items()
    }
    assert result.card.split.audit == open_dataset(tmp_path / "with").card.split.audit
    assert {(row["map"], row["slope_rad"], row["terrain_name"]) for row in ours.values()} == {(None, None, None)}
    assert b"geo" in pq.read_schema(tmp_path / "without" / "samples.parquet").metadata
    assert not (tmp_path / "without" / "patches.zarr").exists()
    croissant = json.loads((tmp_path / "without" / "croissant.json").read_text())
    assert [each["name"] for each in croissant["recordSet"]] == ["samples"]
    data = open_dataset(tmp_path / "without")
    assert data["train"].labels.shape[1] == 2
    for refused in (lambda: data["train"].patches, lambda: data["train"].batches(8), lambda: data["train"][0]):
        with pytest.raises(DatasetError, match=r"has no patches; .*add-map"):
            refused()
    assert not verify(tmp_path / "without").problems


def test_runs_without_gnss_are_split_and_audited_each_in_its_own_frame(bare, tmp_path, region):
    for number in range(
        2
    ):  # both begin at their own origin: the same numbers, on ground that nobody knows to be the same
        table = with_null(make_segments(f"run{number}", [1.0, 12.0], start_ns=number * 10**12), *POSITIONS)
        for end, east in (("start", 0.0), ("end", 1.0)):
            at = table.schema.get_field_index(f"{end}_x_m")
            table = table.set_column(at, table.schema.field(at), pa.array(np.tile(np.arange(28.0), 2) + east))
            at = table.schema.get_field_index(f"{end}_y_m")
            table = table.set_column(at, table.schema.field(at), pa.array(np.repeat([0.0, 12.0], 28)))
        add_run(bare, f"run{number}", table)
    card = build(bare, tmp_path / "out", holdout="run").card
    assert card.plane == LOCAL
    assert card.splits == {"train": 56, "test": 56, "unseen": 0, "buffer": 0}
    (held,) = [part for part in card.split.audit if part.samples]
    assert held.overlapping_samples == 0
    assert select_findings(card.findings, "local-frames")
    assert {row["geometry"] for row in read(tmp_path / "out").values()} == {None}
    with pytest.raises(DatasetError, match=r"--split.*no GNSS"):
        build(bare, tmp_path / "other", split=region)
    with pytest.raises(DatasetError, match="--without-coordinates: the runs have no GNSS"):
        build(bare, tmp_path / "other", without_coordinates=True)
    add_run(bare, "run2", make_segments("run2", [1.0], start_ns=5 * 10**12))
    mixed = build(bare, tmp_path / "mixed").card
    assert mixed.samples == 28
    assert mixed.distance_by_reason_m["no_position"] == pytest.approx(112.0)


def test_a_map_needs_positions_and_the_error_says_how_to_go_without(store, tmp_path):
    add_run(store, "a", with_null(make_segments("a", [1.0]), *POSITIONS))
    with pytest.raises(DatasetError, match=r"none with GNSS; .*--without-patches"):
        build(store, tmp_path / "out")
    assert build(store, tmp_path / "out", without_patches=True).card.samples == 28


def test_every_command_on_a_dataset_does_without_patches_and_power(bare, tmp_path):
    start, end = lanes(np.array([1.0, 12.0]), -14.0, 14.0)
    table = segments("a", start, end, powered=False)
    add_run(bare, "a", table, track=driven(table, powered=False))
    for name in ("one", "two"):
        build(bare, tmp_path / name)
    assert "the same 56 samples" in str(diff(tmp_path / "one", tmp_path / "two"))
    build(bare, tmp_path / "fewer", labels="time", holdout="sample")
    assert "nan" not in str(diff(tmp_path / "one", tmp_path / "fewer"))
    name = next(iter(read(tmp_path / "one")))
    lines = str(explain(name, dataset=tmp_path / "one", store=bare.root)).splitlines()
    (labels,) = [line for line in lines if line.startswith("labels")]
    assert "velocity" in labels
    assert "power" not in labels
    assert not any(line.startswith("map ") for line in lines)
    (page,) = report(tmp_path / "one")
    assert page.changed
