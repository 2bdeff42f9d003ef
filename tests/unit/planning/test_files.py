"""The files that predict-path and plan-path write, and files that they do not replace."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow.csv
import pyproj
import pytest
from map_worlds import ArrayMap
from physics_model import PhysicsModel
from planning_worlds import lonlat, plane

from tcpipe.errors import ModelError, PathError, UsageError
from tcpipe.formats.geojson import make_line_feature, read_line
from tcpipe.formats.json_files import write_json
from tcpipe.planning.cost_map import make_cost_map
from tcpipe.planning.path_files import make_summary_path, plan, predict_path
from tcpipe.planning.path_options import PlanPathOptions

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


def test_a_path_that_leaves_the_map_is_done_in_part(source, tmp_path):
    _write_path(tmp_path / "off.geojson", lonlat(source, (12.0, 12.0), (30.0, 12.0)))
    found = predict_path(MODEL, source, tmp_path / "off.geojson", None)
    assert found.exit_code == 3
    assert "outside map" in str(found)
    assert f"without {found.path_segments_without_cost} of {found.path_segments} path segments" in str(found)


def _request(source, **options) -> PlanPathOptions:
    start, goal = lonlat(source, (3.0, 3.0), (20.0, 18.0)).tolist()
    return PlanPathOptions("model", tuple(start), tuple(goal), **options)


def test_a_plan_is_written_with_its_messages_and_replaced_by_another(source, tmp_path):
    out = tmp_path / "plan.geojson"
    first = plan(MODEL, source, _request(source, objective="distance", cell_size=2.0, out=out))
    assert len(read_line(out)) == 2
    assert first.lonlat_deg == pytest.approx(read_line(out))
    assert (first.nav2_path, first.nav2_waypoints) == (tmp_path / "plan.path.json", tmp_path / "plan.waypoints.json")
    assert str(first).splitlines()[-3:] == [str(path) for path in (out, first.nav2_path, first.nav2_waypoints)]
    plan(MODEL, source, _request(source, objective="time", cell_size=2.0, out=out))
    found = json.loads(out.read_text())["features"][0]["properties"]
    assert found["objective"] == "time"
    assert found["complete"]


def test_messages_for_nav2_are_along_the_path_in_true_east_and_north(tmp_path):
    """Read by the definitions of nav_msgs/Path and nav2_msgs/FollowGPSWaypoints; 2.9 degrees off the central meridian."""
    source = plane(24.0, classes=lambda east, north: np.where((np.abs(east - 12.0) < 1.5) & (north < 16.0), 2, 4))
    source = replace(source, grid=replace(source.grid, x_min_m=720_000.0))
    ends = lonlat(source, (4.0, 4.0), (20.0, 4.0))
    options = PlanPathOptions(
        "model", *map(tuple, ends.tolist()), out=tmp_path / "p.geojson", origin=tuple(ends[0].tolist())
    )
    found = plan(MODEL, source, options)
    message = json.loads(found.nav2_path.read_text())
    assert message["header"]["frame_id"] == "map"
    poses = [pose["pose"] for pose in message["poses"]]
    xy = np.array([[pose["position"]["x"], pose["position"]["y"]] for pose in poses])
    steps = np.diff(xy, axis=0)
    assert np.linalg.norm(steps, axis=1).max() <= 0.25 + 1e-6
    assert np.linalg.norm(steps, axis=1).sum() == pytest.approx(found.length_m, rel=1e-4)
    yaw = [2.0 * np.arctan2(pose["orientation"]["z"], pose["orientation"]["w"]) for pose in poses]
    np.testing.assert_allclose(np.exp(1j * np.array(yaw[:-1])), np.exp(1j * np.arctan2(*steps.T[::-1])), atol=1e-9)
    geod = pyproj.Geod(ellps="WGS84")
    azimuth, _, away = geod.inv(*ends[0], *ends[1])
    assert xy[0] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert xy[-1] == pytest.approx([away * np.sin(np.radians(azimuth)), away * np.cos(np.radians(azimuth))], abs=1e-3)
    goal = json.loads(found.nav2_waypoints.read_text())
    assert set(goal) == {"number_of_loops", "goal_index", "gps_poses"}
    places = np.array([[pose["position"][name] for name in ("longitude", "latitude")] for pose in goal["gps_poses"]])
    np.testing.assert_allclose(places, found.lonlat_deg[1:], atol=1e-9)
    assert len(places) >= 2
    for pose, start, end in zip(goal["gps_poses"], found.lonlat_deg[:-1], found.lonlat_deg[1:], strict=True):
        yaw = 2.0 * np.arctan2(pose["orientation"]["z"], pose["orientation"]["w"])
        course = np.radians(90.0 - geod.inv(*start, *end)[0])
        assert np.exp(1j * yaw) == pytest.approx(np.exp(1j * course), abs=1e-3)


def test_a_cost_map_gives_the_same_plan_and_one_of_another_model_is_refused(source, tmp_path):
    costs = tmp_path / "costs"
    make_cost_map(MODEL, source, costs, cell_size_m=2.0)
    plans = [
        plan(MODEL, source, _request(source, cell_size=2.0, cost_map=given, out=tmp_path / name))
        for name, given in (("with.geojson", costs), ("without.geojson", None))
    ]
    ours, theirs = plans
    assert ours.energy_joule == pytest.approx(theirs.energy_joule, rel=1e-9)
    with pytest.raises(ModelError, match="made from another model or map"):
        plan(replace(MODEL, checksum="1" * 64), source, _request(source, cost_map=costs, out=tmp_path / "p.json"))
    with pytest.raises(UsageError, match="not a cost map"):
        plan(MODEL, source, _request(source, cost_map=tmp_path, out=tmp_path / "p.json"))


def test_files_of_the_user_are_left_alone(source, path):
    before = path.read_bytes()
    with pytest.raises(UsageError, match="is no plan; it is not changed"):
        plan(MODEL, source, _request(source, cell_size=2.0, out=path))
    with pytest.raises(UsageError, match="is the file of the path"):
        predict_path(MODEL, source, path, path)
    assert path.read_bytes() == before


def test_names_and_points_that_cannot_be_are_one_line(source, path, tmp_path):
    with pytest.raises(UsageError, match=r"ends in \.csv"):
        predict_path(MODEL, source, path, tmp_path / "path-segments.xlsx")
    with pytest.raises(UsageError, match=r"ends in \.geojson"):
        plan(MODEL, source, _request(source, out=tmp_path / "plan.kml"))
    with pytest.raises(PathError, match="no lon/lat"):
        plan(MODEL, source, PlanPathOptions("model", (200.0, 47.0), (15.0, 47.0), out=tmp_path / "plan.json"))
