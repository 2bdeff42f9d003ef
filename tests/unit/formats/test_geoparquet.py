"""Geometry metadata of a Parquet file."""

import json

import numpy as np
import pyarrow as pa
from pyproj import CRS

from tcpipe.formats.parquet import add_geo_metadata
from tcpipe.tables.columns import make_points

POINTS = np.array([[15.5, 47.0], [np.nan, np.nan], [15.25, 47.5]])


def told(points, **how):
    table = pa.table({"geometry": make_points(points)}).replace_schema_metadata({b"tcpipe": b"{}"})
    metadata = add_geo_metadata(table, "Point", points, **how).schema.metadata
    assert metadata[b"tcpipe"] == b"{}"
    return json.loads(metadata[b"geo"])


def test_the_keys_are_those_of_geoparquet_1_1():
    column = {"encoding": "WKB", "geometry_types": ["Point"], "bbox": [15.25, 47.0, 15.5, 47.5]}
    assert told(POINTS) == {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}


def test_another_crs_is_told_in_full():
    found = told(POINTS, crs="EPSG:4258")["columns"]["geometry"]["crs"]
    assert CRS.from_json_dict(found) == CRS.from_epsg(4258)
    assert found["id"] == {"authority": "EPSG", "code": 4258}


def test_nothing_that_lies_somewhere_has_no_bounds():
    assert "bbox" not in told(POINTS[1:2])["columns"]["geometry"]
    assert "bbox" not in told(POINTS[:0])["columns"]["geometry"]
