"""Frames of robots on maps: true east-north-up metres at an origin (robot_localization), or the plane of the map's CRS.

The grid of a CRS is turned against true north by the meridian convergence, up to 3° in a UTM zone: 10 m at 300 m.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tcpipe.arrays import Floats, Ints, Mask
from tcpipe.errors import UsageError
from tcpipe.geometry.datum import enu_from_geodetic, geodetic_from_enu
from tcpipe.terrain.projection import Projection
from tcpipe.terrain.target_grid import MapGrid
from tcpipe.terrain.tiles import MapReader, find_map_projection

# From the map. A frame that begins further away has its longitude and latitude exchanged, or is of another site.
_FARTHEST_ORIGIN_M = 100_000.0


_SLIVER = 0.05  # largest share of a cell at the edge of a map that gets no own cell


def find_lonlat_projection(source: MapReader) -> Projection:
    """Return the operation from WGS 84 lon, lat [deg] to the map's CRS."""
    return find_map_projection(source, "EPSG:4326")


@dataclass(frozen=True)
class Frame:
    """A horizontal frame of a robot: true ENU at ``origin_deg``, or without one x and y of the map's CRS."""

    source: MapReader
    origin_deg: tuple[float, float] | None = None
    """Longitude and latitude."""

    @cached_property
    def _projection(self) -> Projection:
        return find_lonlat_projection(self.source)

    def to_lonlat(self, xy_m: Floats) -> Floats:
        """Return longitude and latitude [deg] of points of the frame, shape (N, 2)."""
        if self.origin_deg is None:
            return self._projection.inverse(xy_m)
        enu_m = np.column_stack([xy_m, np.zeros(len(xy_m))])
        lon, lat, _ = geodetic_from_enu(enu_m, datum_deg_m=(*self.origin_deg, 0.0))
        return np.column_stack([lon, lat])

    def from_lonlat(self, lonlat_deg: Floats) -> Floats:
        """Return points of the frame [m], shape (N, 2)."""
        if self.origin_deg is None:
            return self._projection.forward(lonlat_deg)
        lon_deg, lat_deg = lonlat_deg.T
        return enu_from_geodetic(lon_deg, lat_deg, 0.0, datum_deg_m=(*self.origin_deg, 0.0))[:, :2]

    def to_plane(self, xy_m: Floats) -> Floats:
        """Return points in the plane of the map's CRS [m], shape (N, 2)."""
        return xy_m if self.origin_deg is None else self._projection.forward(self.to_lonlat(xy_m))

    def from_plane(self, xy_m: Floats) -> Floats:
        """Return points of the frame by those in the plane of the map's CRS [m], shape (N, 2)."""
        return xy_m if self.origin_deg is None else self.from_lonlat(self._projection.inverse(xy_m))

    @property
    def description(self) -> str:
        """Return the meaning of x and y, as one line."""
        if self.origin_deg is None:
            crs = self.source.grid.crs
            return f"x and y of {crs if len(crs) < 40 else 'the map CRS'} [m]"
        return "true east and north [m] of longitude {!r}, latitude {!r}".format(*self.origin_deg)

    def cover(self, grid: MapGrid) -> MapGrid:
        """Return a grid of the frame, of cells of the same size, over a grid of the map's CRS."""
        if self.origin_deg is None:
            return grid
        x_min, y_min, x_max, y_max = grid.bounds_m
        corners = self.from_plane(np.array([(x, y) for x in (x_min, x_max) for y in (y_min, y_max)]))
        (left, bottom), (right, top) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
        size = grid.pixel_size_m
        rows, cols = (max(int(np.ceil(side / size - _SLIVER)), 1) for side in (top - bottom, right - left))
        return MapGrid("ENU", left, top, size, rows, cols)

    def find_cells(self, grid: MapGrid, own: MapGrid) -> tuple[Ints, Mask]:
        """Return the flat cell of ``grid`` under the middle of each ``own`` cell of the frame, and which are on it."""
        row, col = np.mgrid[: own.rows, : own.cols]
        middle = own.xy_from_px(np.stack([col, row], axis=-1).reshape(-1, 2).astype(float))
        px = np.rint(grid.px_from_xy(self.to_plane(middle))).astype(np.int64)
        is_on = np.asarray(((px >= 0) & (px < (grid.cols, grid.rows))).all(axis=1))
        return np.where(is_on, px[:, 1] * grid.cols + px[:, 0], 0), is_on


def make_frame(source: MapReader, origin_deg: tuple[float, float] | None) -> Frame:
    """Return the frame of a robot; `UsageError` if its origin is not near the map."""
    if origin_deg is not None:
        x_m, y_m = find_lonlat_projection(source).forward(np.array([origin_deg]))[0].tolist()
        x_min, y_min, x_max, y_max = source.grid.bounds_m
        off_m = np.hypot(x_m - np.clip(x_m, x_min, x_max), y_m - np.clip(y_m, y_min, y_max))
        if not off_m <= _FARTHEST_ORIGIN_M:
            raise UsageError(
                f"--origin {origin_deg[0]:g},{origin_deg[1]:g}: is {off_m / 1000.0:.0f} km from map {source.name}, "
                "expected at most "
                f"{_FARTHEST_ORIGIN_M / 1000.0:.0f}; give LON,LAT (longitude first) of the origin of the robot's map "
                "frame"
            )
    return Frame(source, origin_deg)
