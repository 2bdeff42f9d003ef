"""Where the simulated world lies on Earth: map coordinates, WGS84, a local plane, and the metres of each.

A map metre is no ground metre, and grid north is not north: both follow here from pyproj's projection by differences, without any
formula of the pipeline, so that the truth is independent of what it judges.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

Float = NDArray[np.float64]

_SEMI_MAJOR_M = 6378137.0
_ECCENTRICITY2 = 0.0066943799901413165
_STEP_M = 10.0


@dataclass(frozen=True)
class Site:
    """A rectangle of a projected CRS, and how high the geoid lies above the ellipsoid there.

    The default lies at 17.6° E, 47° N in UTM zone 33, where grid north is 1.9° off true north.
    """

    epsg: int = 32633
    west_m: float = 697600.0
    south_m: float = 5208400.0
    width_m: float = 120.0
    height_m: float = 80.0
    geoid_m: float = 45.7

    @cached_property
    def _to_wgs84(self) -> Transformer:
        return Transformer.from_crs(f"EPSG:{self.epsg}", "EPSG:4326", always_xy=True)

    @cached_property
    def datum(self) -> tuple[float, float, float]:
        """Origin of the local plane: longitude [deg], latitude [deg], ellipsoidal height [m] (the site's middle, at the geoid)."""
        lon, lat = self._to_wgs84.transform(self.west_m + self.width_m / 2, self.south_m + self.height_m / 2)
        return float(lon), float(lat), self.geoid_m

    @cached_property
    def _to_enu(self) -> Transformer:
        lon, lat, alt = self.datum
        steps = f"+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 +lon_0={lon!r} +lat_0={lat!r} +h_0={alt!r}"
        return Transformer.from_pipeline(f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad {steps}")

    def lonlat_deg(self, x_map_m: Float, y_map_m: Float) -> tuple[Float, Float]:
        """Return longitude and latitude [deg] of map coordinates [m]."""
        lon, lat = self._to_wgs84.transform(x_map_m, y_map_m)
        return np.asarray(lon), np.asarray(lat)

    def map_xy_m(self, lon_deg: Float, lat_deg: Float) -> tuple[Float, Float]:
        """Return map coordinates [m] of longitude and latitude [deg]."""
        x, y = self._to_wgs84.transform(lon_deg, lat_deg, direction="INVERSE")
        return np.asarray(x), np.asarray(y)

    def enu_m(self, lon_deg: Float, lat_deg: Float, alt_m: Float) -> Float:
        """Return east, north, up of the datum [m], shape (N, 3)."""
        return np.stack(self._to_enu.transform(lon_deg, lat_deg, alt_m), axis=-1)

    def lonlatalt(self, enu_m: Float) -> tuple[Float, Float, Float]:
        """Return longitude, latitude [deg] and ellipsoidal height [m] of points of the local plane, shape (N, 3)."""
        lon, lat, alt = self._to_enu.transform(enu_m[..., 0], enu_m[..., 1], enu_m[..., 2], direction="INVERSE")
        return np.asarray(lon), np.asarray(lat), np.asarray(alt)

    def ground_from_map(self, x_map_m: Float, y_map_m: Float, alt_m: Float) -> tuple[Float, Float]:
        """Return ground metres per map metre, and the true direction of the map's x axis from east [rad].

        Ground metres are horizontal metres at the height ``alt_m`` above the ellipsoid.
        """
        lon0, lat0 = self.lonlat_deg(x_map_m - _STEP_M / 2, y_map_m)
        lon1, lat1 = self.lonlat_deg(x_map_m + _STEP_M / 2, y_map_m)
        lat = np.radians((lat0 + lat1) / 2)
        curvature = 1.0 - _ECCENTRICITY2 * np.sin(lat) ** 2
        prime_vertical_m = _SEMI_MAJOR_M / np.sqrt(curvature)
        meridian_m = prime_vertical_m * (1.0 - _ECCENTRICITY2) / curvature
        east = np.radians(lon1 - lon0) * (prime_vertical_m + alt_m) * np.cos(lat)
        north = np.radians(lat1 - lat0) * (meridian_m + alt_m)
        return np.hypot(east, north) / _STEP_M, np.arctan2(north, east)
