"""Terrain drawn by hand: GeoJSON polygons with a property ``class``, as QGIS saves an annotated orthophoto.

The property is a class name of the class table (case, '_' and '-' do not matter), or a number: a value of the table, as
in a raster, else an id. Where polygons overlap, the later feature covers the earlier one, as drawn. A map pixel has the
class of the polygon that contains its centre; ground outside all polygons has no data.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS

from tcpipe.arrays import Box, Bytes
from tcpipe.errors import MapError, RegionError
from tcpipe.formats.geojson import PolygonFeature, read_polygons, shorten_problems, shorten_value
from tcpipe.formats.maps.geotiff import burn_polygons
from tcpipe.formats.maps.layer_building import Tally, label_files
from tcpipe.splits.regions import project_near
from tcpipe.tables.findings import Findings, Subject, make_finding, read_threshold
from tcpipe.terrain.layers import ClassScheme, Layer, Pixels, make_paper_layers, name_key
from tcpipe.terrain.projection import Projection, compute_area
from tcpipe.terrain.target_grid import MapGrid

PROPERTY = "class"
"""The property with a polygon's class, in any case."""

SUFFIXES = (".geojson", ".json")
"""A terrain file that ends so is polygons."""

_MARGIN_DEG = 0.001  # polygons are cut no nearer than this to a map

_TERRAIN = Subject("layer", "terrain")

_LOOKED_AT = 5_000_000  # most vertices of pairs of polygons that are compared for overlaps

_TOGETHER = 32  # polygons that are compared with all others at one time

_DETAILED = 10_000
"""Most vertices of a polygon before it is cut to the burnt part of the map: each pixel row visits every edge."""


@dataclass(frozen=True, slots=True)
class PolygonLayer:
    """Polygons as the terrain layer: in the map's CRS, in the order they are drawn, with their class ids."""

    layer: Layer
    label: str
    name: str
    grid: MapGrid
    polygons: NDArray[np.object_]
    ids: Bytes
    findings: Findings
    values: Sequence[int]
    """Numbers of classes in the file, if it has no names."""
    _tree: shapely.STRtree = field(repr=False)
    tally: Tally = field(default_factory=Tally)

    def shard(self, row0: int, col0: int, rows: int, cols: int) -> Pixels:
        """Return class ids of a part of the map, shape (rows, cols); 0 if no polygon is."""
        side_m = self.grid.pixel_size_m
        left, top = self.grid.x_min_m + col0 * side_m, self.grid.y_max_m - row0 * side_m
        part = replace(self.grid, x_min_m=left, y_max_m=top, rows=rows, cols=cols)
        box = shapely.box(*part.bounds_m)
        drawn = np.sort(self._tree.query(box))
        polygons = self.polygons[drawn].copy()
        detailed = shapely.get_num_coordinates(polygons) > _DETAILED
        polygons[detailed] = shapely.intersection(polygons[detailed], shapely.buffer(box, side_m, join_style="mitre"))
        kept = ~shapely.is_empty(polygons)
        return burn_polygons(polygons[kept], self.ids[drawn][kept], part)

    def list_findings(self) -> Findings:
        """Return the findings of placing the polygons on the map."""
        return self.findings


def is_drawn(paths: Sequence[Path]) -> bool:
    """Return whether terrain files are polygons; `MapError` if some are and some are not."""
    drawn = [path for path in paths if path.suffix.lower() in SUFFIXES]
    if drawn and len(drawn) != len(paths):
        other = next(path for path in paths if path not in drawn)
        raise MapError(f"terrain: {drawn[0]} contains polygons, {other} does not; expected one kind")
    return bool(drawn)


def place_polygons(paths: Sequence[Path], scheme: ClassScheme, crs: CRS, grid: MapGrid) -> PolygonLayer:
    """Read terrain polygons and project them to the CRS of a map's grid; later features have priority.

    `MapError`: not GeoJSON, another CRS, invalid geometry, a class that the table does not have, or nothing on the map:
    all problems in one error.
    """
    every, problems = _read_all(paths)
    features = [feature for feature in every if feature.polygons and _find_class(feature) is not None] or every
    label, name = label_files(paths), label_files([Path(path.name) for path in paths])
    numbers: set[int] = set()
    ids = [_read_class_id(feature, scheme, problems, numbers) for feature in features]
    if not problems and not any(feature.polygons for feature in features):
        problems.append(f"{label}: no polygon in it; draw the terrain as polygons")
    if problems:
        raise MapError(*shorten_problems(problems))
    flat = [polygon for feature in features for polygon in feature.polygons]
    id_of_each = np.repeat(np.array(ids, np.uint8), [len(feature.polygons) for feature in features])
    projection = Projection(CRS.from_epsg(4326), crs, compute_area(crs, grid.bounds_m))
    polygons = _project_polygons(label, np.array(flat, dtype=object), projection, grid.bounds_m)
    on_map = ~shapely.is_empty(polygons)
    polygons, id_of_each = polygons[on_map], id_of_each[on_map]
    findings = (*projection.find_rough_shift(_TERRAIN), *_find_overlaps(polygons, id_of_each, scheme))
    repaired, skipped = sum(feature.repaired for feature in features), len(every) - len(features)
    if repaired or skipped:
        changed = make_finding("polygons-changed", _TERRAIN, repaired_count=repaired, skipped_count=skipped)
        findings = (changed, *findings)
    terrain = make_paper_layers(["terrain"], scheme.table)["terrain"]
    tree = shapely.STRtree(polygons)
    return PolygonLayer(terrain, label, name, grid, polygons, id_of_each, findings, sorted(numbers), tree)


def _read_all(paths: Sequence[Path]) -> tuple[list[PolygonFeature], list[str]]:
    features: list[PolygonFeature] = []
    problems: list[str] = []
    for path in paths:
        try:
            found, unsound = read_polygons(path, is_terrain=True)
        except RegionError as error:
            raise MapError(*error.problems) from None
        features += found
        problems += unsound
    return features, problems


def _find_class(feature: PolygonFeature) -> Any:
    """Return the property that names a feature's class; None if it is missing or empty."""
    found = next((value for name, value in feature.properties.items() if name.casefold() == PROPERTY), None)
    return None if found == "" else found


def _read_class_id(feature: PolygonFeature, scheme: ClassScheme, problems: list[str], numbers: set[int]) -> int:
    """Return a feature's class id; 0 and a line in ``problems`` without one. Numeric names are added to ``numbers``."""
    given = _find_class(feature)
    if given is None:
        properties = shorten_value(", ".join(sorted(feature.properties)) or "none")[1:-1]
        problems.append(
            f"{feature.where}: has no property {PROPERTY!r} that names its terrain (its properties: {properties})"
        )
        return 0
    by_name = {name_key(entry.name): entry.id for entry in scheme.table.classes}
    found = by_name.get(name_key(str(given)))
    number = _parse_integer(given)
    if found is None and number is not None:
        known = {entry.id: entry.id for entry in scheme.table.classes} | dict(scheme.id_by_value)
        found = known.get(number)
        numbers.add(number)
    if found is None:
        names = ", ".join(entry.name for entry in scheme.table.classes)
        problems.append(f"{feature.where}: {PROPERTY} {shorten_value(given)} is not in the class table ({names})")
    return found or 0


def _parse_integer(given: Any) -> int | None:
    try:
        number = float(given)
    except (TypeError, ValueError):
        return None
    return int(number) if number.is_integer() and not isinstance(given, bool) else None


def _project_polygons(
    label: str, polygons: NDArray[np.object_], projection: Projection, bounds_m: Box
) -> NDArray[np.object_]:
    """Return the polygons in the map's CRS, empty where they are not on the map; `MapError` if none is."""
    west, south, east, north = projection.area_deg
    margin_deg = max(east - west, north - south, _MARGIN_DEG)
    window_deg = (west - margin_deg, south - margin_deg, east + margin_deg, north + margin_deg)
    placed = project_near(polygons, projection.forward, window_deg)
    on_map = shapely.intersects(placed, shapely.box(*bounds_m))
    if on_map.any():
        return np.where(on_map, placed, shapely.Polygon())
    lon, lat = shapely.get_coordinates(polygons).mean(axis=0)
    swapped = shapely.transform(polygons, lambda lonlat: lonlat[:, ::-1])
    if shapely.intersects(swapped, shapely.box(west, south, east, north)).any():
        raise MapError(
            f"{label}: none of its polygons is on the map, but would be with the axes swapped: GeoJSON is lon before lat (RFC 7946)"
        )
    raise MapError(
        f"{label}: none of its polygons is on the map: they are around {lon:.5f}, {lat:.5f} (lon, lat), "
        f"the map covers {west:.5f} to {east:.5f}, {south:.5f} to {north:.5f}"
    )


def _find_overlaps(polygons: NDArray[np.object_], ids: Bytes, scheme: ClassScheme) -> Findings:
    """Return the ground that polygons of different classes share; of many or detailed ones only some are compared."""
    tree, shared_m2, worst_m2, left = shapely.STRtree(polygons), 0.0, 0.0, _LOOKED_AT
    names: dict[str, str] = {}
    vertices = shapely.get_num_coordinates(polygons)
    for first in range(0, len(polygons), _TOGETHER):
        above, below = tree.query(polygons[first : first + _TOGETHER], predicate="intersects")
        above += first
        pairs = (below < above) & (ids[below] != ids[above])
        above, below = above[pairs], below[pairs]
        looked_at = np.cumsum(vertices[above] + vertices[below]) <= left
        above, below = above[looked_at], below[looked_at]
        left -= int((vertices[above] + vertices[below]).sum())
        areas_m2 = shapely.area(shapely.intersection(polygons[below], polygons[above]))
        shared_m2 += float(areas_m2.sum())
        if areas_m2.size and areas_m2.max() > worst_m2:
            at = int(np.argmax(areas_m2))
            worst_m2 = float(areas_m2[at])
            names = {key: scheme.table.name(int(ids[part[at]])) for key, part in (("above", above), ("below", below))}
        if not looked_at.all():
            break
    if shared_m2 <= read_threshold("polygons-overlap", "min_overlap_m2"):
        return ()
    return (make_finding("polygons-overlap", _TERRAIN, names=names, overlap_m2=shared_m2),)
