"""Graphs of Nav2's route server: read as its loader reads them, costed as predict-path costs, proposed from what was driven."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
from map_worlds import ArrayMap
from physics_model import PhysicsModel
from planning_worlds import NORTH_M, WEST_M, lonlat, plane
from shared_data import shared_data

from tcpipe.errors import PathError, UsageError
from tcpipe.formats.maps.nav2 import read_route_graph
from tcpipe.planning.path_cost import compute_path_cost
from tcpipe.planning.route_graph import write_route_graph
from tcpipe.terrain.target_grid import MapGrid

MODEL = PhysicsModel()


def _feature(kind, coordinates, **properties):
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def _write(path, *features, **more):
    path.write_text(json.dumps({"type": "FeatureCollection", **more, "features": features}))
    return path


def _edge(number, start, end, **properties):
    return _feature("MultiLineString", [[[0.0, 0.0], [1.0, 0.0]]], id=number, startid=start, endid=end, **properties)


def _load_as_nav2_does(path):
    """Return metadata by edge, as `GeoJsonGraphFileLoader` reads them: ids are unsigned, a number is a float by its decimal point."""
    document = json.loads(path.read_text(), parse_int=np.uint32, parse_float=np.float32)
    nodes, edges = {}, {}
    for feature in document["features"]:
        properties, kind = feature["properties"], feature["geometry"]["type"]
        if kind == "Point":
            assert isinstance(properties["id"], np.uint32)
            nodes[properties["id"]] = feature["geometry"]["coordinates"][:2]
        elif kind in {"LineString", "MultiLineString"}:
            assert isinstance(properties["id"], np.uint32)
            edges[properties["startid"], properties["endid"]] = properties.get("metadata", {})
    assert nodes
    assert all(start in nodes and end in nodes for start, end in edges)
    return edges


@pytest.fixture(scope="module")
def hill():
    return plane(24.0, rise_east=0.1, classes=lambda east, _: np.where(east > 20.0, 2, 4))


def test_each_direction_costs_what_predict_path_says_and_nothing_else_changes(hill, tmp_path):
    origin = tuple(lonlat(hill, (0.0, 0.0))[0].tolist())
    nodes = [_feature("Point", list(at), id=number, frame="map") for number, at in ((3, (4.0, 4.0)), (7, (14.0, 4.0)))]
    slow = {"speed_limit": 0.85, "aisle_number": 14, "door": {"id": 5}}
    edges = [_edge(9, 3, 7, metadata=slow, overridable=False, cost=10.0), _edge(10, 7, 3)]
    given = _write(tmp_path / "graph.geojson", *nodes, *edges, name="yard", crs={"type": "name"})
    result = write_route_graph(MODEL, hill, tmp_path / "out.geojson", graph=given, origin_deg=origin)
    assert (result.nodes, result.edges, result.one_way_edges, result.exit_code) == (2, 2, 0, 0)
    found = _load_as_nav2_does(tmp_path / "out.geojson")
    for way, ends in {(3, 7): [(4.0, 4.0), (14.0, 4.0)], (7, 3): [(14.0, 4.0), (4.0, 4.0)]}.items():
        wanted = compute_path_cost(MODEL, hill, lonlat(hill, *ends), where="edge")
        assert found[way]["energy_joule"] == pytest.approx(
            wanted.totals.energy_joule, rel=1e-3
        )  # ends are in metres of the map
        assert found[way]["abs_time_taken"] == pytest.approx(wanted.totals.duration_s, rel=1e-3)
        low, high = wanted.totals.energy_interval_joule
        assert found[way]["energy_std_joule"] == pytest.approx((high - low) / 2.0 / 1.645, rel=1e-3)
        assert all(
            isinstance(found[way][name], np.float32) for name in ("energy_joule", "abs_time_taken", "time_std_s")
        )
    assert found[3, 7]["energy_joule"] > 1.3 * found[7, 3]["energy_joule"]
    before, after = json.loads(given.read_text()), json.loads((tmp_path / "out.geojson").read_text())
    for feature in after["features"]:
        metadata = feature["properties"].get("metadata", {})
        for name in ("abs_time_taken", "energy_joule", "energy_std_joule", "length_m", "time_std_s"):
            metadata.pop(name, None)
    after["features"][3]["properties"].pop("metadata")
    assert after == before


def test_edges_are_true_enu_lines_far_from_the_central_meridian(tmp_path):
    """Costs of an edge are those of the line that a robot drives in its east-north-up map frame, by pyproj's own transformation."""
    grid = MapGrid("EPSG:32633", 720_000.0, 5_200_400.0, 2.0, 200, 200)
    rows = np.arange(200)[:, None] * np.ones(200)
    arrays = {
        "height": (50.0 + 0.2 * rows + 30.0 * np.sin(rows.T / 12.0)).astype(np.float32),
        "ortho": np.full(rows.shape, 128, np.uint8), "terrain": np.full(rows.shape, 4, np.uint8),
    }  # fmt: skip
    ground, model = ArrayMap(grid, arrays, 64), replace(MODEL, patch_px=4)
    origin = pyproj.Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True).transform(720_030.0, 5_200_030.0)
    ends = [(20.0, 10.0), (300.0, 300.0)]
    nodes = [_feature("Point", list(at), id=number) for number, at in enumerate(ends)]
    given = _write(tmp_path / "graph.geojson", *nodes, _edge(5, 0, 1))
    write_route_graph(model, ground, tmp_path / "out.geojson", graph=given, origin_deg=origin)
    found = _load_as_nav2_does(tmp_path / "out.geojson")[0, 1]
    enu = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={origin[0]!r} +lat_0={origin[1]!r} +h_0=0 "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    east, north = np.array(ends).T
    lon, lat, _ = enu.transform(east, north, np.zeros(2))
    wanted = compute_path_cost(model, ground, np.column_stack([lon, lat]), where="edge").totals
    assert found["energy_joule"] == pytest.approx(wanted.energy_joule, rel=1e-3)
    assert found["length_m"] == pytest.approx(wanted.length_m, rel=1e-4)


def test_edges_without_a_cost_are_left_out_and_named_short_ones_have_one(hill, tmp_path):
    places = {1: (4.0, 4.0), 2: (4.3, 4.0), 3: (23.0, 4.0), 4: (400.0, 4.0), 5: (12.0, 4.0)}
    nodes = [_feature("Point", [x + WEST_M, y + NORTH_M - 24.0], id=number) for number, (x, y) in places.items()]
    given = _write(
        tmp_path / "g.json", *nodes, _edge(11, 1, 2), _edge(12, 1, 3), _edge(13, 1, 4), _edge(14, 4, 4), _edge(15, 1, 5)
    )
    result = write_route_graph(MODEL, hill, tmp_path / "out.json", graph=given, two_way=True)
    assert result.edges_without_cost[:3] == (12, 13, 14)
    assert result.exit_code == 3
    assert "edges have no cost and are left out: 12, 13, 14" in str(result)
    found = _load_as_nav2_does(tmp_path / "out.json")
    assert set(found) == {(1, 2), (2, 1), (1, 5), (5, 1)}
    assert found[1, 2]["length_m"] == pytest.approx(0.3, rel=1e-3)
    assert found[1, 2]["energy_joule"] == pytest.approx(0.3 / 8.0 * found[1, 5]["energy_joule"], rel=0.02)
    steep = replace(MODEL, training_range=MODEL.training_range | {"slope_rad": (-0.5, 0.01)})
    told = write_route_graph(steep, hill, tmp_path / "out.json", graph=given)
    assert told.unreliable_edges == 2
    assert _load_as_nav2_does(tmp_path / "out.json")[1, 5]["unreliable"] == "slope_outside_training"
    with pytest.raises(PathError, match="check the frame of the graph and --origin"):
        write_route_graph(MODEL, hill, tmp_path / "o.json", graph=_write(tmp_path / "h.json", *nodes, _edge(13, 1, 4)))


@pytest.mark.parametrize(
    ("features", "words"),
    [
        ([_feature("Point", [0.0, 0.0], id=1), _edge(2, 1, 5)], "edge 2: there is no node 5"),
        ([_feature("Point", [0.0, 0.0], id=-1), _edge(2, 1, 1)], "node -1: its id is not a whole number from 0"),
        ([_feature("Point", [0.0, 0.0], id=1), _edge("a", 1, 1)], "edge 'a': has .*, expected whole numbers"),
        ([_feature("Point", [0.0, 0.0], id=1), _feature("Point", [0.0, 1.0], id=1)], "several nodes have the same id"),
        ([_feature("Point", [0.0], id=1)], "expected x and y in metres"),
        ([_feature("Point", ["x", 0.0], id=1)], "expected x and y in metres"),
        (
            [_feature("Point", [0, 0], id=1, frame="map"), _feature("Point", [0, 0], id=2, frame="odom")],
            "frames map, odom",
        ),
        ([_feature("Point", [0.0, 0.0], id=1)], "has 1 nodes and 0 edges"),
        ([3, None, {"geometry": 5, "properties": []}], "has 0 nodes and 0 edges"),
    ],
)
def test_what_the_loader_would_reject_is_one_line(tmp_path, features, words):
    with pytest.raises(PathError, match=words):
        read_route_graph(_write(tmp_path / "graph.geojson", *features))


def test_files_that_are_no_graph_and_outputs_that_cannot_be(hill, tmp_path):
    for text in ("[1]", "{", '{"features": 3}'):
        (tmp_path / "graph.geojson").write_text(text)
        with pytest.raises(PathError, match=r"graph\.geojson: not"):
            read_route_graph(tmp_path / "graph.geojson")
    with pytest.raises(PathError, match="cannot be read"):
        read_route_graph(tmp_path / "gone.geojson")
    for out, words in (("graph.geojson", "is the graph itself"), ("graph.xml", "ends in .geojson or .json")):
        with pytest.raises(UsageError, match=words):
            write_route_graph(MODEL, hill, tmp_path / out, graph=tmp_path / "graph.geojson")


_OURS = Path(__file__).parents[2] / "data" / "route_graph.geojson"
"""Every member that the format's documentation names: frames, costs, nested metadata, operations, a loop, both kinds of lines."""


@pytest.mark.parametrize("name", ["ours", "depot", "turtlebot3", "warehouse", "aws", "sample"])
def test_graphs_of_the_format_and_those_of_nav2_are_read_and_written_whole(name, tmp_path):
    path = _OURS if name == "ours" else shared_data(f"nav2_graphs/{name}_graph.geojson")
    found = read_route_graph(path)
    document = json.loads(path.read_text())
    assert len(found.nodes) + len(found.edges) == len(document["features"])
    (tmp_path / "out.geojson").write_text(json.dumps(found.make_document([edge.feature for edge in found.edges])))
    assert _load_as_nav2_does(tmp_path / "out.geojson") == _load_as_nav2_does(path)
    xy_m = np.array(list(found.nodes.values()))
    side = 4.0 + float(np.ptp(xy_m, axis=0).max())
    ground = plane(side, pixel_size_m=0.25, tile_px=256)
    shift = np.array([WEST_M, NORTH_M - side]) + 2.0 - xy_m.min(axis=0)
    origin = tuple(lonlat(ground, shift - [WEST_M, NORTH_M - side])[0].tolist())
    model = replace(MODEL, patch_px=8)
    result = write_route_graph(model, ground, tmp_path / "out.geojson", graph=path, origin_deg=origin)
    costed = _load_as_nav2_does(tmp_path / "out.geojson")
    loops = [edge.edge_id for edge in found.edges if edge.start == edge.end]
    assert result.edges == len(found.edges) - len(loops)
    assert list(result.edges_without_cost) == loops
    assert all(metadata["energy_joule"] > 0.0 for metadata in costed.values())
    before, after = (
        {of["properties"]["id"]: of for of in json.loads(each.read_text())["features"]}
        for each in (path, tmp_path / "out.geojson")
    )
    for number, feature in after.items():  # nothing but metadata is added, and none is changed
        metadata = before[number]["properties"].get("metadata", {})
        assert feature["properties"].get("metadata", {}).items() >= metadata.items()
        feature["properties"].pop("metadata", None)
        before[number]["properties"].pop("metadata", None)
        assert feature == before[number]
