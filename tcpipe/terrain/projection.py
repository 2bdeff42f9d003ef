"""Coordinate reference systems (CRS) of maps: tests for metric axes, and projection of points.

A map's CRS is right-handed, and its unit is within 1 % of a metre on the ellipsoid: a UTM zone or a national grid, but
not degrees, feet or Web Mercator. A CRS without an authority's code keeps the datum shift of its file (TOWGS84) as a
bound CRS.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.crs import BoundCRS
from pyproj.database import query_utm_crs_info
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import AreaOfInterest as TransformArea
from pyproj.transformer import TransformerGroup

from tcpipe.arrays import Box, Floats
from tcpipe.errors import MapError
from tcpipe.tables.findings import Findings, Subject, make_finding, read_threshold

MAX_SCALE_ERROR = 0.01
"""A CRS whose unit is further from a metre of ground than this share is not metric enough for patches."""

_EARTH_RADIUS_M = 6_371_000.0


def parse_crs(text: str, *, where: str) -> CRS:
    """Return the horizontal CRS of ``EPSG:n`` or WKT, with its datum shift; `MapError` names its source ``where``."""
    try:
        crs = CRS.from_user_input(text)
    except CRSError as error:
        raise MapError(f"{where}: {text[:60]!r} is not a CRS (expected EPSG:n or WKT)") from error
    bound: CRS | None = None
    while crs.is_compound or crs.is_bound:
        bound = crs if crs.is_bound else bound
        crs = crs.sub_crs_list[0] if crs.is_compound else CRS(crs.source_crs)
    crs = crs.to_2d()
    if crs.geodetic_crs is None or not (crs.is_projected or crs.is_geographic):
        raise MapError(
            f"{where}: the CRS {crs.name!r} is local, expected a projected or geographic one; "
            "if you know which, give --crs EPSG:n"
        )
    radius_m = _read_ellipsoid(crs)[0]
    if abs(radius_m / _EARTH_RADIUS_M - 1.0) > 0.02:
        raise MapError(
            f"{where}: the CRS {crs.name!r} is of another body (radius {radius_m / 1000:.0f} km), not the earth"
        )
    authority = crs.to_authority(min_confidence=100)
    if authority:  # as in GDAL, the authority's datum replaces the shift of the file
        return CRS.from_authority(*authority)
    return crs if bound is None else _bind_shift(crs, bound, where)


def _bind_shift(crs: CRS, bound: CRS, where: str) -> CRS:
    """Return a CRS with the datum shift of a bound one, without it if zero; `MapError` for a shift in a grid file."""
    shift = bound.coordinate_operation
    assert shift is not None  # noqa: S101  (a bound CRS has one)
    grids = {grid.short_name for grid in shift.grids}
    if grids - {"@null"}:
        raise MapError(
            f"{where}: the datum shift of its CRS is in the grid file {', '.join(grids)!r}, "
            "which tcpipe does not open; "
            "transform the raster: rio warp in.tif out.tif --dst-crs EPSG:n"
        )
    is_zero = bool(shift.towgs84) and not any(shift.towgs84)
    if grids or (is_zero and np.allclose(_read_ellipsoid(crs), _read_ellipsoid(CRS.from_epsg(4326)), rtol=1e-8)):
        return crs
    return BoundCRS(crs, CRS(bound.target_crs).to_2d(), shift)


def format_crs(crs: CRS) -> str:
    """Return ``AUTHORITY:code`` if the CRS is exactly that, else WKT 2."""
    authority = crs.to_authority(min_confidence=100)
    return ":".join(authority) if authority else crs.to_wkt()


def make_metres_from_plane(crs: CRS, xy: Floats) -> Floats:
    """Return the local map from the CRS plane to the ground, at points of the plane, shape (N, 2, 2).

    It is metres east and north on the ellipsoid per CRS unit in x and y; NaN where the CRS is not defined.
    """
    geodetic = CRS(crs.geodetic_crs)
    step = 1e-4 if crs.is_geographic else 10.0
    to_lonlat = Transformer.from_crs(crs, geodetic, always_xy=True)
    x, y = xy[:, 0], xy[:, 1]
    east, north = (np.array(to_lonlat.transform(x + dx, y + dy)) for dx, dy in ((step, 0.0), (0.0, step)))
    west, south = (np.array(to_lonlat.transform(x - dx, y - dy)) for dx, dy in ((step, 0.0), (0.0, step)))
    latitude = np.radians((north[1] + south[1]) / 2.0)
    a, e2 = _read_ellipsoid(crs)
    w = 1.0 - e2 * np.sin(latitude) ** 2
    per_degree = np.stack([a / np.sqrt(w) * np.cos(latitude), a * (1.0 - e2) / w**1.5]) * (math.pi / 180.0)
    differences = np.stack([east - west, north - south])
    differences[:, 0] = (differences[:, 0] + 180.0) % 360.0 - 180.0  # the short way around the earth
    found = (differences * per_degree / (2.0 * step)).T
    return np.where(np.isfinite(found), found, np.nan)


def _read_ellipsoid(crs: CRS) -> tuple[float, float]:
    ellipsoid = CRS(crs.geodetic_crs).ellipsoid
    assert ellipsoid is not None  # noqa: S101  (a geodetic CRS has one)
    a, b = ellipsoid.semi_major_metre, ellipsoid.semi_minor_metre
    return a, 1.0 - (b / a) ** 2


def is_metric(crs: CRS, xy: Floats) -> bool:
    """Return whether the CRS is right-handed and within one per cent of metres at all the given points of its plane."""
    if not crs.is_projected:
        return False
    ground = make_metres_from_plane(crs, xy)
    if not np.isfinite(ground).all():
        return False
    scales = np.linalg.svd(ground, compute_uv=False)
    return bool((np.linalg.det(ground) > 0.0).all() and (np.abs(scales - 1.0) < MAX_SCALE_ERROR).all())


def find_utm_crs(crs: CRS, xy: tuple[float, float]) -> CRS:
    """Return the UTM zone of a point, on its CRS's datum if that has UTM zones and no own shift, else on WGS 84."""
    geodetic = CRS(crs.geodetic_crs)
    lon, lat = Transformer.from_crs(crs, geodetic, always_xy=True).transform(*xy)
    if not (math.isfinite(lon) and math.isfinite(lat)):
        raise MapError(f"the point {xy} is outside the area where the CRS {crs.name!r} is defined")
    spot = AreaOfInterest(lon, lat, lon, lat)
    found = query_utm_crs_info(datum_name=geodetic.name, area_of_interest=spot)
    if found and not crs.is_bound:
        return CRS.from_authority(found[0].auth_name, found[0].code)
    zone = min(int((lon + 180.0) // 6.0) + 1, 60)
    return CRS.from_epsg((32600 if lat >= 0.0 else 32700) + zone)


@dataclass(frozen=True)
class Projection:
    """Operation from one CRS to another over one area: one for all points, so that neighbours agree.

    ``area_deg`` is west, south, east, north. Axes are always x (longitude, east) first.
    """

    source: CRS
    target: CRS
    area_deg: Box

    @cached_property
    def _transformer(self) -> Transformer:
        area = TransformArea(*self.area_deg)
        group = TransformerGroup(self.source, self.target, always_xy=True, area_of_interest=area)
        if not group.transformers:
            raise MapError(f"no transformation is known from {self.source.name!r} to {self.target.name!r}")
        return group.transformers[0]

    def forward(self, xy: Floats) -> Floats:
        """Return points of shape (..., 2) in the target CRS; infinite where the CRS is not defined."""
        return self._transform(xy, "FORWARD")

    def inverse(self, xy: Floats) -> Floats:
        """Return points of the target CRS, shape (..., 2), in the source CRS."""
        return self._transform(xy, "INVERSE")

    def _transform(self, xy: Floats, direction: str) -> Floats:
        try:
            x, y = self._transformer.transform(xy[..., 0], xy[..., 1], direction=direction)
        except ProjError as error:
            raise MapError(
                f"points cannot be transformed from {self.source.name!r} to {self.target.name!r}: {error}"
            ) from error
        return np.stack([np.asarray(x, float), np.asarray(y, float)], axis=-1)

    def find_rough_shift(self, subject: Subject) -> Findings:
        """Return a finding if the two datums differ and their shift is rough, unknown or given by a file."""
        source, target = (CRS(crs.geodetic_crs) for crs in (self.source, self.target))
        if source.datum == target.datum:
            return ()
        accuracy_m = self._transformer.accuracy
        is_ballpark = "ballpark" in self._transformer.description.lower()
        if not is_ballpark and 0.0 <= accuracy_m <= read_threshold("datum-shift-rough", "max_accuracy_m"):
            return ()
        names = {"source": source.name, "target": target.name}
        if not is_ballpark and (self.source.is_bound or self.target.is_bound):
            return (make_finding("datum-shift-stated", subject, names=names),)
        if accuracy_m <= 0.0:
            return (make_finding("datum-shift-unknown", subject, names=names),)
        return (make_finding("datum-shift-rough", subject, names=names, accuracy_m=accuracy_m),)


def compute_area(crs: CRS, bounds: Box) -> Box:
    """Return west, south, east, north [deg] of a rectangle (x min, y min, x max, y max) in a CRS."""
    transformer = Transformer.from_crs(crs, CRS(crs.geodetic_crs), always_xy=True)
    west, south, east, north = transformer.transform_bounds(*bounds)
    return west, south, east, north
