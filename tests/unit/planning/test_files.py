"""What predict-path and plan-path write: once, whole, and again only when something changed."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pyarrow.csv
import pytest
from map_worlds import ArrayMap
from physics_model import PhysicsModel
from planning_worlds import lonlat, plane

from tcpipe.errors import ModelError, PathError, UsageError
from tcpipe.formats.geojson import make_line_feature, read_line
from tcpipe.formats.json_files import write_json
from tcpipe.planning.cost_map import make_cost_map
from tcpipe.planning.path_files import find_doubts, make_summary_path, plan, predict_path
from tcpipe.planning.path_options import PlanPathOptions
from tcpipe.tables.findings import Subject

MODEL = PhysicsModel(patch_px=8)


@pytest.fixture
def source() -> ArrayMap:
    return plane(24.0, rise_east=0.1)


@pytest.fixture
def path(source, tmp_path: Path) -> Path:
    _write_path(tmp_path / "path.geojson", lonlat(source, (3.0, 12.0), (20.0, 14.0)))
    return tmp_path / "path.geojson"


def _write_path(path: Path, points) -> None:
    write_json(path, {"type": "FeatureCollection", "features": [make_line_feature(points, {})]})


@pytest.mark.parametrize("ending", ["csv", "geojson"])
def test_the_table_is_the_same_in_every_format(source, path, ending):
    out = path.with_name(f"path-segments.{ending}")
    found = predict_path(MODEL, source, path, out)
    assert found.status == "done"
    assert found.exit_code == 0
    rows = {
        "csv": lambda: pyarrow.csv.read_csv(out).to_pylist(),
        "geojson": lambda: [feature["properties"] for feature in json.loads(out.read_text())["features"]],
    }[ending]()
    assert len(rows) == found.path_segments == 18
    assert sum(row["energy_joule"] for row in rows) == pytest.approx(found.energy_joule, rel=1e-9)
    assert rows[0]["terrain_name"] == "grass"
    assert json.loads(make_summary_path(out).read_text())["duration_s"] == found.duration_s
    if ending == "geojson":  # the lines join up
        lines = [feature["geometry"]["coordinates"] for feature in json.loads(out.read_text())["features"]]
        assert all(one[1] == other[0] for one, other in pairwise(lines))


def test_a_second_call_does_nothing_until_something_changes(source, path):
    out = path.with_name("path-segments.csv")
    first = predict_path(MODEL, source, path, out)
    second = predict_path(MODEL, source, path, out)
    assert second.status == "unchanged"
    assert "nothing to do" in str(second)
    assert second.energy_joule == first.energy_joule
    out.write_text(out.read_text()[:-30])
    assert predict_path(MODEL, source, path, out).status == "done"
    assert predict_path(replace(MODEL, checksum="1" * 64), source, path, out).status == "done"


def test_a_way_there_and_back_is_one_path(source, tmp_path):
    request = _request(source, objective="distance", cell_size_m=2.0, out=tmp_path / "plan.geojson", round_trip=True)
    found = plan(MODEL, source, request)
    both = predict_path(MODEL, source, tmp_path / "plan.geojson", None)
    ways = found.plans["distance"].length_m, found.together.back.length_m
    assert both.length_m == pytest.approx(sum(ways), rel=1e-3)
    assert both.energy_joule == pytest.approx(found.together.energy_joule, rel=0.02)
    _write_path(tmp_path / "one.geojson", lonlat(source, (3.0, 12.0), (20.0, 14.0)))
    apart = json.loads((tmp_path / "one.geojson").read_text())
    apart["features"] *= 2
    (tmp_path / "apart.geojson").write_text(json.dumps(apart))
    with pytest.raises(PathError, match="of which one does not begin where another ends"):
        predict_path(MODEL, source, tmp_path / "apart.geojson", None)


def test_bends_on_trusted_ground_are_no_warning(source, tmp_path):
    _write_path(tmp_path / "bend.geojson", lonlat(source, (4.0, 4.0), (8.5, 4.0), (8.5, 8.0)))
    found = predict_path(MODEL, source, tmp_path / "bend.geojson", None)
    assert found.reasons == {"curved": 1}
    assert [of.severity for of in find_doubts(found, Subject("file", "bend"))] == ["note"]


def test_a_path_that_leaves_the_map_is_done_in_part(source, tmp_path):
    _write_path(tmp_path / "off.geojson", lonlat(source, (12.0, 12.0), (30.0, 12.0)))
    found = predict_path(MODEL, source, tmp_path / "off.geojson", None)
    assert found.exit_code == 3
    assert "outside map" in str(found)
    assert f"without {found.path_segments_without_cost} of {found.path_segments} path segments" in str(found)


def _request(source, **options) -> PlanPathOptions:
    start, goal = lonlat(source, (3.0, 3.0), (20.0, 18.0)).tolist()
    return PlanPathOptions("model", tuple(start), tuple(goal), **options)


def test_a_plan_is_found_once_and_again_when_its_picture_is_gone(source, tmp_path):
    out, picture = tmp_path / "plan.geojson", tmp_path / "plan.png"
    request = _request(source, objective="distance", cell_size_m=2.0, out=out, picture=picture)
    first = plan(MODEL, source, request)
    assert list(first.plans) == ["distance", "energy", "time"]
    assert len(read_line(out)) == 2
    second = plan(MODEL, source, request)
    assert second.status == "unchanged"
    assert list(second.plans) == list(first.plans)
    assert "nothing to do" in str(second)
    picture.unlink()
    assert plan(MODEL, source, request).status == "done"
    other = _request(source, objective="time", cell_size_m=2.0, out=out)
    assert plan(MODEL, source, other).status == "done"
    found = json.loads(out.read_text())["features"][0]["properties"]
    assert found["objective"] == "time"
    assert found["complete"]


def test_a_cost_map_gives_the_same_plan_and_one_of_another_model_is_refused(source, tmp_path):
    costs = tmp_path / "costs"
    make_cost_map(MODEL, source, costs, cell_size_m=2.0)
    plans = [
        plan(MODEL, source, _request(source, cell_size_m=2.0, cost_map=given, out=tmp_path / name))
        for name, given in (("with.geojson", costs), ("without.geojson", None))
    ]
    ours, theirs = (found.plans["energy"] for found in plans)
    assert ours.energy_joule == pytest.approx(theirs.energy_joule, rel=1e-9)
    with pytest.raises(ModelError, match="made from another model or map"):
        plan(replace(MODEL, checksum="1" * 64), source, _request(source, cost_map=costs, out=tmp_path / "p.json"))
    with pytest.raises(UsageError, match="not a cost map"):
        plan(MODEL, source, _request(source, cost_map=tmp_path, out=tmp_path / "p.json"))


def test_a_cost_map_of_other_cells_gives_another_plan_and_a_damaged_one_is_refused(source, tmp_path):
    costs, out = tmp_path / "costs", tmp_path / "plan.geojson"
    request = _request(source, cost_map=costs, out=out)
    for cell_size_m in (2.0, 3.0):
        make_cost_map(MODEL, source, costs, cell_size_m=cell_size_m)
        assert plan(MODEL, source, request).status == "done"
        assert plan(MODEL, source, request).status == "unchanged"
    (costs / "cost-map.json").write_text("{}")
    with pytest.raises(ModelError, match="has changed since it was written"):
        plan(MODEL, source, request)


def test_files_of_the_user_are_left_alone(source, path):
    before = path.read_bytes()
    with pytest.raises(UsageError, match="is no plan; it is not changed"):
        plan(MODEL, source, _request(source, cell_size_m=2.0, out=path))
    with pytest.raises(UsageError, match="is the file of the path"):
        predict_path(MODEL, source, path, path)
    assert path.read_bytes() == before


def test_names_and_points_that_cannot_be_are_one_line(source, path, tmp_path):
    with pytest.raises(UsageError, match=r"ends in \.csv"):
        predict_path(MODEL, source, path, tmp_path / "path-segments.xlsx")
    with pytest.raises(UsageError, match=r"ends in \.geojson"):
        plan(MODEL, source, _request(source, out=tmp_path / "plan.kml"))
    with pytest.raises(UsageError, match=r"ends in \.png"):
        plan(MODEL, source, _request(source, out=tmp_path / "plan.json", picture=tmp_path / "plan.svg"))
    with pytest.raises(PathError, match="no lon/lat"):
        plan(MODEL, source, PlanPathOptions("model", (200.0, 47.0), (15.0, 47.0), out=tmp_path / "plan.json"))
