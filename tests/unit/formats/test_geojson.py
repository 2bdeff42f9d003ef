import json

import numpy as np
import pytest
import shapely

from tcpipe.errors import RegionError
from tcpipe.formats.geojson import MAX_VALUES, read_regions, regions_to_json
from tcpipe.formats.json_files import to_plain

SQUARE = [[15.0, 47.0], [15.001, 47.0], [15.001, 47.001], [15.0, 47.001], [15.0, 47.0]]
BESIDE = [[round(lon + 0.001, 7), lat] for lon, lat in SQUARE]
OVER = [[round(lon + 0.0005, 7), lat] for lon, lat in SQUARE]


def polygon(*rings):
    return {"type": "Polygon", "coordinates": list(rings)}


def feature(geometry, **properties):
    return {"type": "Feature", "properties": properties or None, "geometry": geometry}


def collection(*features):
    return {"type": "FeatureCollection", "features": list(features)}


def read(tmp_path, document):
    path = tmp_path / "region.geojson"
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return read_regions(path)


@pytest.mark.parametrize(
    "document",
    [
        polygon(SQUARE),
        feature(polygon(SQUARE)),
        collection(feature(polygon(SQUARE))),
        {"type": "MultiPolygon", "coordinates": [[SQUARE]]},
        {"type": "GeometryCollection", "geometries": [polygon(SQUARE)]},
        collection(feature(polygon(SQUARE), name="site", fill="#f00", split=None)),
        polygon([[*position, 412.5] for position in SQUARE]),
        {"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}, **polygon(SQUARE)},
    ],
)
def test_every_way_to_write_one_polygon_is_inside(tmp_path, document):
    regions = read(tmp_path, document)
    assert shapely.equals(regions.train_test, shapely.box(15, 47, 15.001, 47.001))
    assert regions.unseen.is_empty
    assert regions.exclude.is_empty


def test_inside_is_the_union_without_holes(tmp_path):
    regions = read(tmp_path, collection(feature(polygon(SQUARE)), feature(polygon(OVER))))
    assert shapely.equals(regions.train_test, shapely.box(15, 47, 15.0015, 47.001))
    hole = [[15.0004, 47.0004], [15.0004, 47.0006], [15.0006, 47.0006], [15.0006, 47.0004], [15.0004, 47.0004]]
    assert not read(tmp_path, polygon(SQUARE, hole)).train_test.contains(shapely.Point(15.0005, 47.0005))


@pytest.mark.parametrize("seed", range(5))
def test_regions_that_are_written_and_read_again_are_the_same(tmp_path, seed):
    """A card has the regions as they were read, and a rebuilt dataset has to have them too."""
    draw = np.random.default_rng(seed)
    features = []
    for kind, count in (("train_test", 6), ("exclude", 3)):
        for middle in draw.uniform((15.0, 47.0), (15.02, 47.02), (count, 2)):
            angle_rad, radius_deg = np.linspace(0.0, 5.5, 7) + draw.random(), draw.uniform(0.002, 0.008, 7)
            ring = middle + np.stack([np.cos(angle_rad), np.sin(angle_rad)], 1) * radius_deg[:, None]
            features.append(feature(polygon([*ring.tolist(), ring[0].tolist()]), split=kind))
    before = to_plain(regions_to_json(read(tmp_path, collection(*features))))
    again = collection(*(feature(area, split=kind) for kind, area in before.items()))
    assert to_plain(regions_to_json(read(tmp_path, again))) == before


def test_the_property_split_rules(tmp_path):
    document = collection(
        feature(polygon(SQUARE), split="train_test"),
        feature(polygon(BESIDE), split="unseen"),
        feature(polygon(OVER), split="exclude"),
    )
    regions = read(tmp_path, document)
    assert shapely.equals(regions.unseen, shapely.box(15.001, 47, 15.002, 47.001))
    assert shapely.equals(regions.exclude, shapely.box(15.0005, 47, 15.0015, 47.001))


@pytest.mark.parametrize(
    ("document", "says"),
    [
        ("{not json", "not GeoJSON: not JSON"),
        ("[1, 2]", "expected an object with a 'type'"),
        ('{"type": "Topology"}', "type 'Topology', expected FeatureCollection"),
        (collection(), "no polygon in it"),
        (collection(feature({"type": "Point", "coordinates": [15, 47]})), "'Point', expected Polygon"),
        (collection(feature(None)), "its geometry is empty"),
        (polygon(), "its geometry is empty"),
        ({"type": "MultiPolygon", "coordinates": []}, "its geometry is empty"),
        (polygon([[15, 47], [15.001, 47], [15, 47]]), "Too few points"),
        (polygon(SQUARE[:-1]), "do not form a closed linestring"),
        (polygon([SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3], SQUARE[0]]), "Self-intersection"),
        (polygon([SQUARE[0], SQUARE[1], SQUARE[2], SQUARE[1], SQUARE[0]]), "not a sound polygon"),
        (polygon([["a", "b"]] * 4), "type must be number, but is string"),
        (polygon([[533000, 5212000], [533100, 5212000], [533100, 5212100], [533000, 5212000]]), "they look projected"),
        (polygon([[-33.9, 151.2], [-33.9, 151.3], [-33.8, 151.3], [-33.9, 151.2]]), "axes look swapped"),
        (collection(feature(polygon(SQUARE), split="validation")), "split is 'validation', expected one of train_test"),
        (collection(feature(polygon(SQUARE), split="unseen")), "no region is left for training"),
        ({"crs": {"properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}, **polygon(SQUARE)}, "export it again"),
        (polygon([[15, float("nan")], *SQUARE[1:-1], [15, float("nan")]]), "NaN is not a number"),
        (polygon([[1e308, 1e308], *SQUARE[1:4], [1e308, 1e308]]), "no lon/lat degrees"),
        (polygon([{"a": 1}, {"a": 1}]), "type must be array"),
        ({"type": "GeometryCollection", "coordinates": [1]}, "key 'geometries' not found"),
        ({"type": "x" * 10**6}, "xxx…, expected"),
        ("[" * (MAX_VALUES + 1), "1500001 positions, rings and objects, expected at most 1500000; simplify it"),
        ('{"type":' + "[" * 200_000, "not JSON"),
    ],
    ids=lambda of: str(of)[:20],
)
def test_a_region_that_cannot_be_used_is_one_plain_line(tmp_path, document, says):
    with pytest.raises(RegionError) as caught:
        read(tmp_path, document)
    assert len(caught.value.problems) == 1
    assert says in caught.value.problems[0]
    assert "region.geojson" in caught.value.problems[0]
    assert len(caught.value.problems[0]) < 1000


def test_regions_that_disagree_are_refused_where_they_overlap_and_may_share_a_border(tmp_path):
    document = collection(feature(polygon(SQUARE)), feature(polygon(OVER), split="unseen"))
    with pytest.raises(RegionError, match=r"overlap by 4\.\d+e\+03 m²"):  # 38 m by 111 m
        read(tmp_path, document)
    read(tmp_path, collection(feature(polygon(SQUARE)), feature(polygon(BESIDE), split="unseen")))


def test_all_problems_come_at_once(tmp_path):
    with pytest.raises(RegionError) as caught:
        read(tmp_path, collection(feature(None), feature(polygon(SQUARE), split="val")))
    assert [problem.split(": ")[1] for problem in caught.value.problems] == ["feature 0", "feature 1"]


def test_a_missing_file_and_one_that_is_too_large_are_named(tmp_path):
    path = tmp_path / "region.geojson"
    with pytest.raises(RegionError, match="No such file"):
        read_regions(path)
    with path.open("wb") as stream:
        stream.truncate(10**12)
    with pytest.raises(RegionError, match="1000000 MB of GeoJSON, expected at most 50"):
        read_regions(path)
