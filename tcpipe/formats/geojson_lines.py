"""Lines in GeoJSON (RFC 7946: always WGS84, lon before lat): a path that is given, paths that were found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import PathError, RegionError
from tcpipe.formats.geojson import read_features, shorten_value
from tcpipe.formats.json_files import Json

P = TypeVar("P")

_DECIMALS = 9
"""A tenth of a millimetre."""


@dataclass(frozen=True, slots=True)
class LineString:
    """A line's points, longitude and latitude [deg]."""

    coordinates: tuple[tuple[float, float], ...]
    type: Literal["LineString"] = "LineString"


@dataclass(frozen=True, slots=True)
class LineFeature(Generic[P]):
    """A line and what is said of it."""

    properties: P
    geometry: LineString
    type: Literal["Feature"] = "Feature"


def read_line(path: Path) -> NDArray[np.float64]:
    """Read the one line of a file, WGS84 lon/lat [deg], shape (P, 2), P >= 2.

    Raises
    ------
    PathError : not GeoJSON, in another CRS, no line or several, a line of one point, coordinates that are no lon/lat.
    """
    try:
        features = list(read_features(path))
    except RegionError as error:
        raise PathError(*error.problems) from None
    if not features:
        raise PathError(f"{path}: is empty; wanted one LineString")
    if len(features) > 1:
        raise PathError(f"{path}: has {len(features)} features, wanted one LineString; a path is one line")
    where, _, geometry = features[0]
    name = geometry.get("type") if isinstance(geometry, dict) else None
    coordinates = geometry.get("coordinates") if isinstance(geometry, dict) else None
    if name == "MultiLineString" and isinstance(coordinates, list) and len(coordinates) == 1:
        name, coordinates = "LineString", coordinates[0]
    if name != "LineString":
        raise PathError(f"{where}: geometry is {shorten_value(name)}, wanted one LineString")
    return _read_positions(where, coordinates)


def _read_positions(where: str, coordinates: Json) -> NDArray[np.float64]:
    if not isinstance(coordinates, list) or not coordinates:
        raise PathError(f"{where}: its line has no points; wanted at least two")
    try:
        lonlat = np.array([position[:2] for position in coordinates], dtype=np.float64)
    except (TypeError, ValueError, KeyError, OverflowError):
        raise PathError(f"{where}: its coordinates are not [lon, lat] positions") from None
    if lonlat.ndim != 2 or lonlat.shape[1] != 2 or not np.isfinite(lonlat).all():
        raise PathError(f"{where}: its coordinates are not finite [lon, lat] positions")
    if len(lonlat) < 2 or (lonlat == lonlat[0]).all():
        raise PathError(f"{where}: its line is one point; wanted a path from one point to another")
    check_lonlat(where, lonlat)
    return lonlat


def check_lonlat(where: str, lonlat_deg: NDArray[np.float64]) -> None:
    """Raise `PathError` for positions, shape (P, 2), that are no longitude and latitude."""
    lon, lat = lonlat_deg[np.argmax(np.abs(lonlat_deg).max(axis=1))]
    if 90.0 < abs(lat) <= 180.0 and abs(lon) <= 90.0:
        raise PathError(f"{where}: ({lon:g}, {lat:g}) is no lon, lat: the axes look swapped; longitude comes first")
    if abs(lon) > 180.0 or abs(lat) > 90.0:
        raise PathError(
            f"{where}: ({lon:g}, {lat:g}) is no lon, lat in degrees: it looks projected; wanted WGS 84 (EPSG:4326)"
        )


def make_line_feature(lonlat_deg: NDArray[np.float64], properties: P) -> LineFeature[P]:
    """Return a line through points, shape (P, 2), as a feature of GeoJSON."""
    points = np.round(lonlat_deg, _DECIMALS).tolist()
    return LineFeature(properties, LineString(tuple((lon, lat) for lon, lat in points)))
