"""The key ``geo`` of a Parquet file, which tells QGIS, GDAL, GeoPandas and DuckDB where its rows lie (GeoParquet 1.1, ADR-2)."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.formats.json_files import to_json_line
from tcpipe.tables.columns import read_lonlat_deg
from tcpipe.tables.levels import GEOMETRY, Datum

_WGS84 = "EPSG:4326"


def add_segments_metadata(table: pa.Table, datum: Datum | None) -> pa.Table:
    """Return a table of segments which says where it lies; ``datum`` is the track's."""
    ends = np.concatenate([read_lonlat_deg(table, "start"), read_lonlat_deg(table, "end")])
    return add_geo_metadata(table, "LineString", ends, crs=_WGS84 if datum is None else datum.crs)


def add_geo_metadata(
    table: pa.Table, kind: Literal["LineString", "Point"], points_deg: NDArray[np.float64], *, crs: str = _WGS84
) -> pa.Table:
    """Return a table whose metadata says what its column ``geometry`` holds.

    Parameters
    ----------
    table : with the column.
    kind : of all its geometries.
    points_deg : longitude and latitude of all their points, shape (N, 2), NaN where not known.
    crs : geographic CRS of the coordinates, of which longitude is the first whatever the CRS says.
    """
    known = points_deg[np.isfinite(points_deg).all(axis=1)]
    column: dict[str, Any] = {"encoding": "WKB", "geometry_types": [kind]}
    if crs != _WGS84:  # without the key it is OGC:CRS84: WGS 84, longitude first
        from pyproj import CRS  # noqa: PLC0415  few stores need it

        column["crs"] = CRS.from_user_input(crs).to_json_dict()
    if len(known):
        column["bbox"] = [*known.min(axis=0), *known.max(axis=0)]
    geo = {"version": "1.1.0", "primary_column": GEOMETRY, "columns": {GEOMETRY: column}}
    return table.replace_schema_metadata({**(table.schema.metadata or {}), b"geo": to_json_line(geo).encode()})
