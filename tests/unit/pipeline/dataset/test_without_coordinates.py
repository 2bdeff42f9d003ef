"""A dataset without coordinates: the same samples and labels in local metres, and nothing that names where, when and by whom."""

import hashlib
import json
import re
from dataclasses import replace
from typing import get_args

import numpy as np
import pyarrow.parquet as pq
import pytest
from stored_files import read_files
from synthetic_store import add_run, box, lanes, open_world, region_file, segments
from written_bytes import written_bytes

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError
from tcpipe.formats.dataset_files import read_card, read_samples
from tcpipe.formats.integrity import compute_checksum, write_sealed
from tcpipe.formats.json_files import to_json
from tcpipe.geometry.datum import enu_from_geodetic
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.dataset.without_coordinates import keep_public
from tcpipe.pipeline.explain import explain
from tcpipe.pipeline.verify import verify
from tcpipe.report.dataset_report import find_nearest_train_m
from tcpipe.splits.assignment import SPLITS
from tcpipe.tables.findings import Finding, Remedy, Subject, SubjectKind, make_finding, read_catalogue

DRAWS_DATASET_PAGES = True

NAMES = ("gnss_roof", "robotlab7", "imu_link_b", "anna.field", "nas03", "frame-left.07", "übung")
"""A topic without a slash, bare hosts, frames, a user, in no form that a pattern could find."""
LEAKING = tuple(
    Finding(
        "topic-not-used",
        "warning",
        Subject(kind, name),
        "kept",
        span_s=(7041.5, 7042.5),
        numbers={"longitude_deg": 15.43},
        names={"host": name},
        remedies=(Remedy("log_in", recipe={"read.topics": {"gnss": [name]}}, command=f"scp {name}:/log ."),),
    )
    for name, kind in zip(NAMES, ("topic", "log", "frame", "call", "file", "frame", "run"), strict=True)
)
COORDINATES = {f"{end}_{axis}_deg" for end in ("start", "end") for axis in ("lon", "lat")} | {"geometry"}
EARLIEST_NS = int(1e18 - 15.5e12)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    here = tmp_path_factory.mktemp("published")
    store = open_world(here)
    rng = np.random.default_rng(5)
    for run_id, first in (("north", 1.0), ("south", -15.5)):
        each = [
            lanes(first + 2.0 * n, low, low + 27.0) for n, low in enumerate(-14.0 + rng.random(8))
        ]  # ends round as they may
        start, end = (np.concatenate(ends) for ends in zip(*each, strict=True))
        sha256 = hashlib.sha256(run_id.encode()).hexdigest()
        name = f"{run_id}-{sha256[:8]}"
        slow = make_finding(
            "driven-below-limit", Subject("role", "command"), slow_fraction=0.6, limit_mps=0.95, top_mps=0.5
        )
        add_run(
            store,
            name,
            segments(name, start, end, start_ns=int(1e18 + first * 1e12), robot="annas_digger"),
            sha256=sha256,
            findings=(Finding("topic-not-used", "note", Subject("topic", f"/{run_id}/fix"), "kept"), slow, *LEAKING),
            includes=(NAMES[0],),
            tags={"season": "autumn"},
        )
    (here / "secretstation.csv").write_text("time,temp_c\n1000000000,3.5\n1000000001,\n,4\n")
    how = {
        "store": here / "store",
        "split": region_file(here / "region.geojson", box(-18, -18, 18, 0)),
        "format": "parquet",
        "covariates": here / "secretstation.csv",
    }
    return here, build_dataset(here / "full", **how), build_dataset(here / "public", without_coordinates=True, **how)


def read_ends_m(directory):
    """Start and end of each sample in one plane [m], shape (2, N, 2): of coordinates by another way than the code under test."""
    samples = read_samples(directory)
    if not set(samples.column_names) >= COORDINATES:
        return np.stack([np.stack([samples[f"{end}_{axis}_m"] for axis in "xy"], -1) for end in ("start", "end")])
    lonlat = [[samples[f"{end}_{axis}_deg"].to_numpy() for axis in ("lon", "lat")] for end in ("start", "end")]
    return np.stack([enu_from_geodetic(*each, 0.0, datum_deg_m=(15.43, 47.07, 0.0))[:, :2] for each in lonlat])


def test_places_are_shifted_to_an_origin_at_their_own_corner(built):
    here, *_ = built
    was_m, is_m = read_ends_m(here / "full"), read_ends_m(here / "public")
    low_m = is_m.reshape(-1, 2).min(axis=0)
    assert ((low_m >= 0.0) & (low_m < 1.0)).all()
    shift_m = was_m - is_m
    np.testing.assert_allclose(shift_m, np.broadcast_to(shift_m.mean(axis=(0, 1)), shift_m.shape), atol=0.001)
    full, public = read_samples(here / "full"), read_samples(here / "public")
    lift_m = full["height_min_m"].to_numpy() - public["height_min_m"].to_numpy()
    assert np.ptp(lift_m) < 1e-9
    assert 0.0 <= public["height_min_m"].to_numpy().min() < 1.0
    for name in ("start_ns", "end_ns"):
        np.testing.assert_array_equal(public[name].to_numpy(), full[name].to_numpy() - EARLIEST_NS)


def test_courses_are_those_of_the_places_to_a_tenth_of_a_milliradian(built):
    """A run's own east against that of all places reveals the convergence of the meridians, and so the latitude."""
    samples, (start_m, end_m) = read_samples(built[0] / "public"), read_ends_m(built[0] / "public")
    course_rad = samples["course_rad"].to_numpy()
    np.testing.assert_allclose(course_rad, np.arctan2(*(end_m - start_m).T[::-1]), atol=3e-4)
    np.testing.assert_allclose(course_rad, course_rad.round(4), atol=1e-12)
    np.testing.assert_allclose(start_m, start_m.round(4), atol=1e-9)
    ratio = np.hypot(*(end_m - start_m).T) / samples["chord_m"].to_numpy()
    assert abs(ratio.mean() - 1.0) < 1e-5, "metres of chord_m, not of the maps' plane"


def test_the_split_is_audited_with_the_same_distances(built):
    here, *_ = built
    apart = []
    for name in ("full", "public"):
        split = read_samples(here / name)["split"].to_pylist()
        numbers = np.array([SPLITS.index(each) for each in split])
        apart.append(find_nearest_train_m(read_ends_m(here / name).mean(axis=0), numbers)[0])
    assert np.isfinite(apart[0]).sum() > 100
    np.testing.assert_allclose(apart[1], apart[0], atol=0.001)
    for was, now in zip(read_card(here / "full").split.audit, read_card(here / "public").split.audit, strict=True):
        counts = [name for name in was.__slots__ if not name.startswith("nearest")]
        assert [getattr(now, name) for name in counts] == [getattr(was, name) for name in counts]
        assert now.nearest_train_median_m == pytest.approx(was.nearest_train_median_m, rel=1e-3, abs=1e-4)


def test_samples_patches_splits_and_labels_are_as_they_were(built):
    here, *_ = built
    for old, new in zip(sorted((here / "full/data").iterdir()), sorted((here / "public/data").iterdir()), strict=True):
        was, now = pq.read_table(old), pq.read_table(new)
        assert set(was.column_names) - set(now.column_names) == {*COORDINATES, "tag_season", "secretstation_temp_c"}
        assert set(now.column_names) - set(was.column_names) == {"covariates1_temp_c"}
        changed = {f"{end}_{name}" for end in ("start", "end") for name in ("x_m", "y_m", "ns")}
        changed |= {"sample_id", "segment_id", "run_id", "robot", "map", "course_rad", "height_min_m"}
        same = [name for name in now.column_names if name in was.column_names and name not in changed]
        assert {"ortho", "power_watt", "split", "fold", "slope_rad"} <= set(same)
        assert now.select(same).equals(was.select(same))
        assert now["covariates1_temp_c"].equals(was["secretstation_temp_c"])
        assert b"geo" not in (now.schema.metadata or {})


def test_ids_are_numbers(built):
    here, *_ = built
    for file in (here / "public").rglob("*.parquet"):
        columns = pq.read_table(file)
        texts = {
            value
            for name in ("sample_id", "segment_id", "run_id", "map", "robot")
            for value in columns[name].to_pylist()
        }
        assert not [text for text in texts if not re.fullmatch(r"run000\d(-\d+)?|map1|robot1", text)]
    card = read_card(here / "public")
    assert [run.run_id for run in card.runs] == ["run0001", "run0002"]
    assert sum(run.samples for run in card.runs) == card.samples
    assert card.robots == ("robot1",)


def test_a_shipped_robot_keeps_its_name_and_a_held_out_tag_does_not(tmp_path):
    store = open_world(tmp_path)
    for number, (run_id, site) in enumerate((("north", "annas_field"), ("south", "meadow"))):
        table = segments(run_id, *lanes(8.0 * number - 4.0, -10.0, 10.0), start_ns=(number + 1) * 10**18)
        add_run(store, run_id, table, tags={"plotname": site})
    build_dataset(tmp_path / "public", store=store.root, holdout="tag:plotname", without_coordinates=True)
    card = open_dataset(tmp_path / "public").card
    assert card.robots == ("husky",)
    assert (card.recipe.split.holdout, card.recipe.split.holdout_tag) == ("tag", "")
    text = b"".join(data for _, data in written_bytes(tmp_path / "public"))
    assert [name for name in (b"annas_field", b"plotname") if name in text] == []


def test_the_card_has_the_listed_fields_alone(built):
    here, *_ = built
    full, public = (json.loads((here / name / "dataset.json").read_text()) for name in ("full", "public"))
    gone = {"added_columns", "covariates", "document_sha256", "run_tags"}
    assert set(public) - {"without_coordinates", "added_columns", "document_sha256"} == set(full) - gone
    assert public["without_coordinates"] is True
    assert public["maps"] == []
    assert public["split"]["region"] is None
    assert not {"logs", "tags", "segments_sha256"} & {key for run in public["runs"] for key in run if run[key]}
    assert all(run["sha256"] == run["recipe_id"] == "" for run in public["runs"])
    assert public["label"].get("includes") is None
    for name in ("samples", "splits", "folds_of_train", "terrain", "layers", "classes", "repeatability"):
        assert public[name] == full[name], name
    for name in ("overview.png", "relief.png", "classes.png"):
        assert (here / "full" / name).exists()
        assert not (here / "public" / name).exists()


def test_nothing_that_is_written_names_logs_maps_places_paths_or_times(built):
    here, *_ = built
    crs = read_card(here / "full").maps[0].crs
    names = [*NAMES, "secretstation", "log_in", "scp ", "season", "autumn", "annas_digger"]
    numbers = ["7041.5", "15.43", "47.06", "1000000000", str(EARLIEST_NS)[:9]]
    paths = ["/north/", "south-", "/logs/", ".mcap", crs, str(here)]
    in_full = b"".join(data for _, data in written_bytes(here / "full"))
    for name in (*names, *numbers):
        assert name.encode() in in_full or json.dumps(name)[1:-1].encode() in in_full, name
    in_public = b""
    for path, data in written_bytes(here / "public"):
        secrets = [*names, *paths, *([*numbers, "north", "site"] if path.suffix in (".json", ".md") else [])]
        assert [name for name in secrets if name.encode() in data or json.dumps(name)[1:-1].encode() in data] == [], (
            path
        )
        in_public += data
    for kept in ("covariates1_temp_c", "paved road", "ortho", "run0002"):
        assert kept.encode() in in_public


def test_verify_finds_coordinates(built, tmp_path):
    here, *_ = built
    assert verify(here / "public").problems == ()
    assert verify(here / "public").notes == ()
    for name, data in read_files(here / "public").items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(data)
    (tmp_path / "samples.parquet").write_bytes((here / "full/samples.parquet").read_bytes())
    reseal(tmp_path)
    (problem,) = verify(tmp_path).problems
    assert "states that it has no coordinates, but samples.parquet has the columns start_lon_deg" in problem
    assert "geometry" in problem


def reseal(directory):
    """Write the card of a dataset as if its table of samples were that of the build."""
    card = read_card(directory)
    checksums = {**card.checksums, "samples.parquet": compute_checksum(directory / "samples.parquet")}
    (directory / "dataset.json").unlink()
    write_sealed(directory / "dataset.json", replace(card, checksums=checksums))


PRIVATE = "anna@nas03:/data/anna"
KINDS = [kind for of in get_args(SubjectKind) for kind in (of if isinstance(of, tuple) else (of,))]


@pytest.mark.parametrize("kind", KINDS)
def test_no_field_of_a_finding_passes_unless_the_catalogue_calls_it_public(kind):
    for code in (*read_catalogue(), "code-of-another-version"):
        public = read_catalogue()[code].public if code in read_catalogue() else ()
        fields = [*(read_catalogue()[code].fields if code in read_catalogue() else ()), "other"]
        numbers = dict.fromkeys(fields, 7041.5)
        names = {name: PRIVATE for name in fields if name not in public}
        remedy = Remedy("x", {"read": {"gnss_crs": PRIVATE}}, PRIVATE)
        finding = Finding(code, "warning", Subject(kind, PRIVATE), "kept", (7041.5, 7042.5), numbers, names, (remedy,))
        (kept,) = keep_public([finding], {})
        text = to_json(kept)
        assert (PRIVATE in text) == (kind in {"role", "class", "layer", "slope", "split"}), code
        assert set(kept.numbers) | set(kept.names) <= set(public), code
        assert keep_public([kept], {}) == (kept,), code
    (run,) = keep_public([Finding("topic-not-used", "note", Subject("run", "north"), "kept")], {"north": "run0001"})
    assert run.subject.name == "run0001"


def test_what_needs_coordinates_or_names_says_so(built):
    here, *_ = built
    with pytest.raises(DatasetError, match="public: has no coordinates, so the source of its samples is unknown"):
        explain("north-1", dataset=here / "public", store=here / "store")


def test_the_line_that_publishes_it_is_printed_and_a_second_build_has_nothing_to_do(built):
    here, full, public = built
    assert f"publish it with: hf upload OWNER/NAME {here}/public . --repo-type dataset" in str(public)
    assert "hf upload" not in str(full)
    how = {"store": here / "store", "split": here / "region.geojson", "format": "parquet"}
    how["covariates"] = here / "secretstation.csv"
    assert build_dataset(here / "public", without_coordinates=True, **how).status == "unchanged"
