"""Lines in GeoJSON."""

import json
from pathlib import Path

import numpy as np
import pytest

from tcpipe.errors import PathError
from tcpipe.formats.geojson import make_line_feature, read_line
from tcpipe.formats.json_files import write_json

LINE = {"type": "LineString", "coordinates": [[15.0, 47.0], [15.1, 47.1, 350.0]]}


def _file(tmp_path: Path, value) -> Path:
    path = tmp_path / "p.geojson"
    path.write_text(value if isinstance(value, str) else json.dumps(value))
    return path


@pytest.mark.parametrize(
    "document",
    [
        LINE,
        {"type": "Feature", "properties": None, "geometry": LINE},
        {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": LINE}]},
        {"type": "MultiLineString", "coordinates": [LINE["coordinates"]]},
    ],
)
def test_one_line_in_any_wrapping_is_read(tmp_path, document):
    np.testing.assert_array_equal(read_line(_file(tmp_path, document)), [[15.0, 47.0], [15.1, 47.1]])


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ("{", "not JSON"),
        ({"type": "FeatureCollection", "features": []}, "has 0 features"),
        ({"type": "LineString", "coordinates": []}, "is empty"),
        ({"type": "LineString", "coordinates": [[15.0, 47.0]]}, "must contain 0 or >1"),
        ({"type": "LineString", "coordinates": [[15.0, 47.0], [15.0, 47.0]]}, "one point"),
        ({"type": "LineString", "coordinates": [[15.0, None], [15.0, 47.0]]}, "type must be number, but is null"),
        ({"type": "LineString", "coordinates": [[15.0], [15.0, 47.0]]}, "positions"),
        ({"type": "LineString", "coordinates": [[47.0, 115.0], [47.0, 115.1]]}, "axes look swapped"),
        ({"type": "LineString", "coordinates": [[500000.0, 5200000.0], [500010.0, 5200000.0]]}, "projected"),
        ({"type": "Point", "coordinates": [15.0, 47.0]}, "expected one LineString"),
        ({"type": "MultiLineString", "coordinates": [LINE["coordinates"]] * 2}, "expected one LineString"),
        ({"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": LINE}] * 2}, "has 2 features"),
    ],
)
def test_what_is_no_path_is_one_line_of_error(tmp_path, document, words):
    with pytest.raises(PathError, match=words) as error:
        read_line(_file(tmp_path, document))
    assert len(error.value.problems) == 1


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(PathError, match=r"none\.geojson: cannot be read"):
        read_line(tmp_path / "none.geojson")


def test_what_is_written_is_read_back(tmp_path):
    points = np.array([[15.123456789, 47.0], [15.2, 47.1]])
    feature = make_line_feature(points, {"a": 1})
    write_json(tmp_path / "o.geojson", {"type": "FeatureCollection", "features": [feature]})
    np.testing.assert_array_equal(read_line(tmp_path / "o.geojson"), points)
    found = json.loads((tmp_path / "o.geojson").read_text())
    assert found["features"][0]["properties"] == {"a": 1}
