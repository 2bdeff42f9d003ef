"""A redacted dataset: the same metres and labels elsewhere, and nothing that names where and by whom."""

import hashlib
import json
import re
import struct
from dataclasses import replace
from typing import get_args

import numpy as np
import pyarrow.parquet as pq
import pytest
from made_tracks import with_columns
from pyproj import Transformer
from synthetic_store import add_run, box, lanes, open_world, region_file, segments
from written_bytes import written_bytes

from tcpipe.errors import DatasetError
from tcpipe.formats.dataset_files import read_card, read_samples
from tcpipe.formats.json_files import to_json
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.dataset.redaction import PLANE, compute_plane_per_chord, find_leaks, redact_findings
from tcpipe.pipeline.verify import verify
from tcpipe.tables.findings import Finding, Remedy, Subject, SubjectKind, make_finding, read_catalogue, select_findings

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


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    here = tmp_path_factory.mktemp("redaction")
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
            segments(name, start, end, start_ns=int(1e18 + first * 1e12)),
            sha256=sha256,
            findings=(Finding("topic-not-used", "note", Subject("topic", f"/{run_id}/fix"), "kept"), slow, *LEAKING),
            includes=(NAMES[0],),
            tags={"season": "autumn"},
        )
    (here / "secretstation.csv").write_text("time,temp_c\n1000000000,3.5\n1000000001,\n,4\n")
    how = {
        "store": here / "store",
        "split": region_file(here / "region.geojson", box(-18, -18, 18, 0)),
        "file_format": "parquet",
        "covariates": here / "secretstation.csv",
    }
    told = build_dataset(here / "told", **how)
    return here, told, build_dataset(here / "redacted", redact=True, **how)


def places_m(directory, gnss_crs, plane):
    samples = pq.read_table(directory / "samples.parquet")
    to_plane = Transformer.from_crs(gnss_crs, plane, always_xy=True)
    ends = [
        np.stack(to_plane.transform(*(samples[f"{end}_{axis}_deg"].to_numpy() for axis in ("lon", "lat"))), -1)
        for end in ("start", "end")
    ]
    return samples, np.concatenate(ends)


def test_all_of_it_is_moved_by_one_offset_in_the_plane_of_the_map(built):
    here, *_ = built
    crs = read_card(here / "told").maps[0].crs
    told, was_m = places_m(here / "told", "EPSG:4326", crs)
    redacted, is_m = places_m(here / "redacted", "EPSG:4326", PLANE)
    moved_m = was_m - is_m
    assert np.hypot(*moved_m[0]) > 1e5
    np.testing.assert_allclose(moved_m, np.broadcast_to(moved_m.mean(axis=0), moved_m.shape), atol=0.012)  # 1e-7 deg
    assert np.abs(is_m).max() < 100.0
    start, end = np.split(is_m, 2)
    np.testing.assert_allclose(redacted["course_rad"], np.arctan2(*(end - start).T[::-1]), atol=0.03)
    grid = read_card(here / "redacted").maps[0]
    before = read_card(here / "told").maps[0]
    np.testing.assert_allclose(
        [before.x_min_m - grid.x_min_m, before.y_max_m - grid.y_max_m], moved_m.mean(axis=0), atol=0.001
    )
    lift_m = told["height_min_m"].to_numpy() - redacted["height_min_m"].to_numpy()
    assert np.ptp(lift_m) < 1e-9
    assert 0.0 <= redacted["height_min_m"].to_numpy().min() < 1.0


def test_samples_patches_splits_and_labels_are_as_they_were(built):
    here, *_ = built
    for old, new in zip(
        sorted((here / "told/data").iterdir()), sorted((here / "redacted/data").iterdir()), strict=True
    ):
        was, now = pq.read_table(old), pq.read_table(new)
        axes = {f"{end}_{axis}_m" for end in ("start", "end") for axis in "xy"}
        changed = axes | {"sample_id", "segment_id", "run_id", "map", "course_rad", "height_min_m", "geometry"}
        same = [name for name in was.column_names if name not in changed and not name.endswith("_deg")]
        assert {"ortho", "power_watt", "split", "start_ns", "slope_rad"} <= set(same)
        assert now.select(same).equals(was.select(same))


def test_no_frame_of_it_is_turned_against_another(built):
    """A run's own east against the grid's tells the convergence of the meridians, and so the latitude: x and y are along the grid, too."""
    here, *_ = built
    samples, plane_m = places_m(here / "redacted", "EPSG:4326", PLANE)
    own_m = np.concatenate([np.stack([samples[f"{end}_{axis}_m"] for axis in "xy"], -1) for end in ("start", "end")])
    np.testing.assert_allclose(own_m, plane_m, atol=0.012)
    np.testing.assert_allclose(own_m, own_m.round(2), atol=1e-9)


def test_nothing_names_logs_maps_places_or_paths(built):
    here, *_ = built
    crs = read_card(here / "told").maps[0].crs
    secrets = ("north-", "/north", "south-", str(here), "/logs/", ".mcap", crs, "site", "15.43", "47.07")
    for file in (
        path
        for path in (here / "redacted").rglob("*")
        if path.is_file() and path.suffix in (".json", ".md", ".geojson")
    ):
        text = re.sub(r"[0-9a-f]{64}|composite|\\d+\\.\\d{4,}", "", file.read_text())
        assert [secret for secret in secrets if secret in text] == [], file.name
    page = (here / "redacted/report.html").read_text()
    assert [
        secret for secret in ("north-", "south-", "/north/", str(here), "/logs/", ".mcap", crs) if secret in page
    ] == []
    for file in (here / "redacted").rglob("*.parquet"):
        columns = pq.read_table(file)
        texts = {value for name in ("sample_id", "segment_id", "run_id", "map") for value in columns[name].to_pylist()}
        assert not [text for text in texts if not re.fullmatch(r"run000\d-[0-9a-f]{8}(-\d+)?|map1", text)]
    card = read_card(here / "redacted")
    assert [run.run_id for run in card.runs] == [f"run000{n}-{run.sha256[:8]}" for n, run in enumerate(card.runs, 1)]


def test_a_column_of_geometry_is_moved_too(built):
    samples = pq.read_table(built[0] / "redacted/samples.parquet")
    points = np.array([struct.unpack("<BI2d", value)[2:] for value in samples["geometry"].to_pylist()])
    assert np.abs(points).max() < 0.01
    geo = json.loads(samples.schema.metadata[b"geo"])
    assert np.abs(geo["columns"]["geometry"]["bbox"]).max() < 0.01


def test_verify_says_that_it_is_redacted_and_finds_what_is_told_all_the_same(built):
    here, *_ = built
    found = verify(here / "redacted")
    assert found.problems == ()
    assert found.notes[0] == "It is redacted."
    assert verify(here / "told").notes == ()
    card, samples = read_card(here / "redacted"), read_samples(here / "redacted")
    assert list(find_leaks(card, samples)) == []
    assert len(list(find_leaks(card, read_samples(here / "told")))) == 7
    found = list(find_leaks(replace(card, findings=(*card.findings, LEAKING[0])), samples))
    assert found == ["a finding topic-not-used contains more than is public"]
    assert list(find_leaks(replace(card, maps=read_card(here / "told").maps), samples))


def test_no_text_of_a_log_is_in_anything_that_is_written(built):
    here, *_ = built
    in_told = b"".join(data for _, data in written_bytes(here / "told"))
    secrets = (*NAMES, "secretstation.csv", "7041.5", "log_in", "scp ")
    for name in secrets:
        assert name.encode() in in_told or json.dumps(name)[1:-1].encode() in in_told, name
    in_redacted = b""
    for path, data in written_bytes(here / "redacted"):
        assert [name for name in secrets if name.encode() in data or json.dumps(name)[1:-1].encode() in data] == [], (
            path
        )
        in_redacted += data
    for kept in ("secretstation_temp_c", "tag_season", "autumn", "husky", "paved road", "ortho"):  # as the page lists
        assert kept.encode() in in_redacted


def test_a_redacted_finding_keeps_its_code_and_what_is_public(built):
    here, *_ = built
    told, card = read_card(here / "told"), read_card(here / "redacted")
    for was, now in zip(told.runs, card.runs, strict=True):
        kept = [(of.code, of.severity, of.action) for of in was.findings]
        assert [(of.code, of.severity, of.action) for of in now.findings] == kept
        (slow,) = select_findings(now.findings, "driven-below-limit")
        assert slow == select_findings(was.findings, "driven-below-limit")[0]
        assert {of.subject.name for of in select_findings(now.findings, "topic-not-used")} == {
            *("topic", "log", "frame", "call", "file", "run")
        }
    grades = [[getattr(of.verdict, name) for name in ("position", "time", "energy")] for of in (told, card)]
    assert grades[0] == grades[1]


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
        (redacted,) = redact_findings([finding])
        text = to_json(redacted)
        assert (PRIVATE in text) == (kind in {"role", "class", "layer", "slope", "split"}), code
        assert set(redacted.numbers) | set(redacted.names) <= set(public), code
        assert redact_findings([redacted]) == (redacted,), code


def test_distances_do_not_tell_the_scale_of_the_plane(built):
    """The scale of UTM tells the distance from the central meridian: places against chords and courses, all segments together."""
    here, *_ = built
    redacted = read_samples(here / "redacted")
    ratio, std, _ = compute_plane_per_chord(redacted)
    assert std < 5e-5
    assert abs(ratio - 1.0) < 3.0 * std
    length_m = np.hypot(
        *(redacted[f"end_{axis}_m"].to_numpy() - redacted[f"start_{axis}_m"].to_numpy() for axis in "xy")
    )
    assert abs(np.mean(length_m / redacted["chord_m"].to_numpy()) - 1.0) < 1e-4
    k = 0.99  # a plane of another scale
    names = ("start_x_m", "start_y_m", "end_x_m", "end_y_m")
    scaled = {name: (redacted[name].to_numpy() * k / 0.01).round() * 0.01 for name in names}
    as_before = with_columns(redacted, **scaled)
    assert compute_plane_per_chord(as_before)[0] == pytest.approx(k, abs=5 * std)
    assert any(
        "the scale of the maps' plane reveals the place" in line
        for line in find_leaks(read_card(here / "redacted"), as_before)
    )


def test_the_line_that_publishes_it_is_printed_and_a_second_build_has_nothing_to_do(built):
    here, told, redacted = built
    assert f"publish it with: hf upload OWNER/NAME {here}/redacted . --repo-type dataset" in str(redacted)
    assert "hf upload" not in str(told)
    how = {"store": here / "store", "split": here / "region.geojson", "file_format": "parquet"}
    how["covariates"] = here / "secretstation.csv"
    assert build_dataset(here / "redacted", redact=True, **how).status == "unchanged"
    with pytest.raises(DatasetError, match="is redacted, its samples have other names"):
        build_dataset(here / "other", keep_split=here / "redacted", **how)
