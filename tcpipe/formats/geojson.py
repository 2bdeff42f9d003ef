"""GeoJSON (RFC 7946: WGS84, lon before lat): polygons such as the regions of a split, and lines such as paths."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import GeometryType
from shapely.geometry.base import BaseGeometry
from shapely.validation import explain_validity

from tcpipe.arrays import Floats
from tcpipe.errors import PathError, RegionError
from tcpipe.formats.json_files import Json
from tcpipe.splits.regions import Regions

KINDS = ("train_test", "unseen", "exclude")
"""Values of the property ``split``; a feature without it is ``train_test``."""

_GEOMETRIES = ("Point", "MultiPoint", "LineString", "MultiLineString", "Polygon", "MultiPolygon", "GeometryCollection")
_WGS84_NAMES = ("CRS84", "4326")
_MAX_OVERLAP_M2 = 0.01
_MAX_WIDTH_KM, _KM_PER_DEG = 1_000.0, 111.32
MAX_BYTES = 50_000_000
"""Largest GeoJSON file [byte]."""

MAX_VALUES = 1_500_000
"""Lists and objects of a file, nearly all of them positions."""

_SIMPLER = "; simplify it: ogr2ogr -simplify 0.000001 out.geojson in.geojson"
_SHOWN_CHARACTERS = 200
_SHOWN = 5  # problems of one kind that an error lists


def read_regions(path: Path) -> Regions:
    """Read the regions of a split, in WGS84 lon/lat [deg].

    Inside (``train_test``) is the union of the polygons, unless features carry the property ``split``: ``train_test``,
    ``unseen`` or ``exclude``. No other property is interpreted. ``exclude`` may lie over the other two and carves out
    of them.

    One `RegionError` lists all problems.
    """
    polygons: dict[str, list[BaseGeometry]] = {kind: [] for kind in KINDS}
    features, problems = read_polygons(path)
    for feature in features:
        kind = feature.properties.get("split")
        kind = "train_test" if kind is None else kind
        if kind in KINDS:
            polygons[str(kind)] += feature.polygons
        else:
            problems.append(
                f"{feature.where}: property split is {shorten_value(kind)}, expected one of {', '.join(KINDS)}"
            )
    if not problems and not any(polygons.values()):
        problems.append(f"{path}: no polygon in it; draw the region that trains and tests as a polygon")
    if not problems and not polygons["train_test"]:
        problems.append(
            f"{path}: every feature is unseen or exclude: no region is left for training; add a train_test polygon"
        )
    if not problems:
        problems += _find_disagreements(path, polygons)
    if problems:
        raise RegionError(*shorten_problems(problems))
    return Regions(*(shapely.normalize(shapely.union_all(polygons[kind])) for kind in KINDS))


@dataclass(frozen=True, slots=True)
class PolygonFeature:
    """A feature: file and number, properties, polygons in WGS84 lon/lat [deg], and how many of these were repaired."""

    where: str
    properties: Mapping[str, Json]
    polygons: tuple[BaseGeometry, ...]
    repaired: int = 0


@dataclass(frozen=True, slots=True)
class PolygonGeometry:
    """A GeoJSON Polygon or MultiPolygon in WGS84 lon, lat [deg]."""

    type: str
    coordinates: tuple[tuple[tuple[float | tuple[float, ...], ...], ...], ...]


def read_polygons(path: Path, *, is_terrain: bool = False) -> tuple[list[PolygonFeature], list[str]]:
    """Read the polygon features of a file in their order, and one line for every unsound geometry.

    Of terrain, features without a geometry have no polygons, and polygons that cross or touch themselves are repaired.

    `RegionError`: not GeoJSON, or in another CRS.
    """
    features: list[PolygonFeature] = []
    problems: list[str] = []
    for where, properties, geometry in _iterate_features(path):
        invalid: list[BaseGeometry] = []
        is_empty = geometry is None or (isinstance(geometry, dict) and geometry.get("coordinates") == [])
        polygons: list[BaseGeometry] = []
        if not (is_terrain and is_empty):
            polygons += _iterate_polygons(where, geometry, problems, invalid if is_terrain else None)
        repaired = shapely.get_parts(shapely.get_parts(shapely.make_valid(np.array(invalid, dtype=object))))
        polygons += [part for part in repaired if part.geom_type == "Polygon"]
        features.append(PolygonFeature(where, properties, tuple(polygons), len(invalid)))
    return features, problems


def shorten_value(value: object) -> str:
    """Return a value as a file has it, cut if it is long."""
    text = repr(value)
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]}…"


def shorten_problems(problems: list[str], shown: int = _SHOWN) -> list[str]:
    """Return the first few problems, and how many more there are."""
    more = len(problems) - shown
    return problems if more <= 0 else [*problems[:shown], f"… and {more} more"]


def _parse_document(path: Path) -> Mapping[str, Json]:
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise RegionError(
                f"{path}: {size / 1e6:.0f} MB of GeoJSON, expected at most {MAX_BYTES // 10**6}{_SIMPLER}"
            )
        text = path.read_text(encoding="utf-8-sig")
        values = text.count("[") + text.count("{")
        if values > MAX_VALUES:
            raise RegionError(f"{path}: {values} positions, rings and objects, expected at most {MAX_VALUES}{_SIMPLER}")
        document = json.loads(text, parse_constant=_reject_constant)
    except OSError as error:
        raise RegionError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise RegionError(f"{path}: not GeoJSON: not JSON ({error})") from None
    if not isinstance(document, dict) or "type" not in document:
        raise RegionError(f"{path}: not GeoJSON: expected an object with a 'type' such as FeatureCollection")
    crs = json.dumps(document.get("crs"))[:_SHOWN_CHARACTERS]
    if crs != "null" and not any(name in crs for name in _WGS84_NAMES):
        raise RegionError(
            f"{path}: declares the CRS {crs}; GeoJSON is WGS84 lon/lat (RFC 7946): export it again as EPSG:4326"
        )
    return document


def _reject_constant(name: str) -> Json:
    raise ValueError(f"{name} is not a number in JSON")


def _iterate_features(path: Path) -> Iterator[tuple[str, Mapping[str, Json], Json]]:
    """Yield the place, properties and geometry object of every feature; `RegionError` if it is not GeoJSON in WGS84."""
    document = _parse_document(path)
    name, listed = document["type"], document.get("features")
    features: Sequence[Json]
    if name == "FeatureCollection" and isinstance(listed, list):
        features = listed
    elif name == "Feature":
        features = [document]
    elif name in _GEOMETRIES:
        features = [{"type": "Feature", "properties": None, "geometry": document}]
    else:
        raise RegionError(
            f"{path}: not GeoJSON: type {shorten_value(name)}, expected FeatureCollection, Feature or a geometry"
        )
    for number, feature in enumerate(features):
        where = f"{path}: feature {number}"
        if not isinstance(feature, dict) or feature.get("type") != "Feature":
            raise RegionError(f"{where}: not GeoJSON: expected an object of type Feature")
        properties = feature.get("properties")
        yield where, properties if isinstance(properties, dict) else {}, feature.get("geometry")


def _iterate_polygons(
    where: str, geometry: Json, problems: list[str], invalid: list[Any] | None
) -> Iterator[BaseGeometry]:
    """Yield the sound polygons of one geometry object; add others to ``invalid``, or a line to ``problems``."""
    try:
        parts = _read_geometry(geometry)
    except ValueError as error:
        problems.append(f"{where}: {error}")
        return
    while (shapely.get_type_id(parts) >= GeometryType.MULTIPOLYGON).any():
        parts = shapely.get_parts(parts)
    for part in parts:
        if part.geom_type != "Polygon":
            problems.append(f"{where}: geometry is {part.geom_type!r}, expected Polygon or MultiPolygon")
        elif problem := _find_lonlat_problem(shapely.get_coordinates(part)):
            problems.append(f"{where}: {problem}")
        elif invalid is not None and not shapely.is_valid(part):
            invalid.append(part)
        elif not shapely.is_valid(part):
            reason = explain_validity(part)
            problems.append(f"{where}: not a sound polygon: {reason} (lon lat); redraw it without crossing itself")
        else:
            yield part


def _read_geometry(geometry: Json) -> NDArray[np.object_]:
    """Return a geometry object in two dimensions, shape (1,); `ValueError` states the problem."""
    try:
        shape = None if geometry is None else shapely.from_geojson(json.dumps(geometry))
    except shapely.GEOSException as error:
        reason = str(error).partition(": ")[2].rpartition("] ")[2].rstrip("'")
        raise ValueError(
            f"its geometry cannot be read ({reason}); expected [lon, lat] positions, and closed rings"
        ) from None
    if shape is None or shape.is_empty:
        raise ValueError("its geometry is empty; draw it or remove the feature")
    return np.array([shapely.force_2d(shape)])


def _find_disagreements(path: Path, polygons: Mapping[str, list[BaseGeometry]]) -> Iterator[str]:
    """Yield problems of regions together: overlaps, and an extent too large for a site (metres read as degrees)."""
    west, south, east, north = shapely.total_bounds([part for parts in polygons.values() for part in parts])
    width_km = (east - west) * np.cos(np.radians(np.clip(0.0, south, north))) * _KM_PER_DEG
    height_km = (north - south) * _KM_PER_DEG
    if max(width_km, height_km) > _MAX_WIDTH_KM:
        yield (
            f"{path}: its regions are {width_km:.0f} x {height_km:.0f} km, expected at most {_MAX_WIDTH_KM:.0f}; GeoJSON is in degrees: "
            "if these are metres, export the regions as EPSG:4326 (rio bounds height.tif gives the map's outline so)"
        )
    train_test, unseen = shapely.union_all(polygons["train_test"]), shapely.union_all(polygons["unseen"])
    both = shapely.intersection(train_test, unseen)
    if shapely.is_empty(both):
        return
    at = shapely.point_on_surface(both)
    overlap_m2 = shapely.area(both) * 111_320.0**2 * np.cos(np.radians(at.y))
    if overlap_m2 > _MAX_OVERLAP_M2:
        yield (
            f"{path}: train_test and unseen regions overlap by {overlap_m2:.3g} m² around {at.x:.6f}, {at.y:.6f} (lon, lat); "
            "redraw one of them, or mark the ground between as exclude"
        )


P = TypeVar("P")

_DECIMALS = 9  # A tenth of a millimetre


@dataclass(frozen=True, slots=True)
class LineString:
    """A line's points, longitude and latitude [deg]."""

    coordinates: tuple[tuple[float, float], ...]
    type: Literal["LineString"] = "LineString"


@dataclass(frozen=True, slots=True)
class LineFeature(Generic[P]):
    """A line and its properties."""

    properties: P
    geometry: LineString
    type: Literal["Feature"] = "Feature"


def read_line(path: Path) -> Floats:
    """Read the path of a file, WGS84 lon/lat [deg], shape (P, 2), P >= 2; `PathError` without exactly one line."""
    try:
        features = list(_iterate_features(path))
    except RegionError as error:
        raise PathError(*error.problems) from None
    if len(features) != 1:
        raise PathError(f"{path}: has {len(features)} features; expected one LineString")
    where, _, geometry = features[0]
    try:
        (line, *more) = shapely.get_parts(_read_geometry(geometry))
    except ValueError as error:
        raise PathError(f"{where}: {error}") from None
    if more or line.geom_type != "LineString":
        name = "several lines or other parts" if more else repr(line.geom_type)
        raise PathError(f"{where}: geometry is {name}, expected one LineString")
    lonlat: Floats = shapely.get_coordinates(line)
    if (lonlat == lonlat[0]).all():
        raise PathError(f"{where}: its line is one point; expected a path from one point to another")
    check_lonlat(where, lonlat)
    return lonlat


def check_lonlat(where: str, lonlat_deg: Floats) -> None:
    """Raise `PathError` for positions, shape (P, 2), that are no longitude and latitude."""
    if problem := _find_lonlat_problem(lonlat_deg):
        raise PathError(f"{where}: {problem}")


def _find_lonlat_problem(lonlat_deg: Floats) -> str | None:
    lon, lat = lonlat_deg[np.argmax(np.abs(lonlat_deg).max(axis=1))]
    if 90.0 < abs(lat) <= 180.0 and abs(lon) <= 90.0:
        return f"coordinates ({lon:g}, {lat:g}) are no lon/lat: the axes look swapped; longitude comes first"
    if abs(lon) > 180.0 or abs(lat) > 90.0:
        return (
            f"coordinates ({lon:g}, {lat:g}) are no lon/lat degrees: they look projected; expected WGS 84 (EPSG:4326)"
        )
    return None


def make_line_feature(lonlat_deg: Floats, properties: P) -> LineFeature[P]:
    """Return a line through points, shape (P, 2), as a feature of GeoJSON."""
    points = np.round(lonlat_deg, _DECIMALS).tolist()
    return LineFeature(properties, LineString(tuple((lon, lat) for lon, lat in points)))


def regions_to_json(regions: Regions) -> dict[str, PolygonGeometry]:
    """Return the regions as GeoJSON geometries by kind."""
    kinds = {"train_test": regions.train_test, "unseen": regions.unseen, "exclude": regions.exclude}
    return {
        kind: PolygonGeometry(**shapely.geometry.mapping(area))
        for kind, area in kinds.items()
        if not shapely.is_empty(area)
    }
