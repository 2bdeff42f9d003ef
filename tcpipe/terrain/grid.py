"""The grid all layers of a map share: a projected, metric CRS, square pixels, rows from north to south.

Pixel (row i, column j) covers x from ``x_min_m + j·pitch`` and y downward from ``y_max_m - i·pitch``; its centre lies half a
pitch further. *Pixel coordinates* count centres: (0, 0) is the centre of the first pixel, x along columns, y along rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class MapGrid:
    """Where a map's pixels lie.

    ``crs`` is ``EPSG:n`` or WKT 2, horizontal, in metres, x east-like and y north-like; ``x_min_m`` and ``y_max_m`` are the outer
    corner of pixel (0, 0) (not its centre); ``pixel_size_m`` is the side of a pixel in CRS units.
    """

    crs: str
    x_min_m: float
    y_max_m: float
    pixel_size_m: float
    rows: int
    cols: int

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Outer edges: x min, y min, x max, y max [m] in the map's CRS."""
        return (
            self.x_min_m,
            self.y_max_m - self.rows * self.pixel_size_m,
            self.x_min_m + self.cols * self.pixel_size_m,
            self.y_max_m,
        )

    @property
    def geotransform(self) -> tuple[float, float, float, float, float, float]:
        """GDAL's six numbers: x min, dx/dcol, dx/drow, y max, dy/dcol, dy/drow."""
        return (self.x_min_m, self.pixel_size_m, 0.0, self.y_max_m, 0.0, -self.pixel_size_m)

    def px_from_xy(self, xy_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return pixel coordinates (x along columns, y along rows; centres are integers) of map points, shape (..., 2)."""
        corner = np.array([self.x_min_m, self.y_max_m])
        px: NDArray[np.float64] = (np.asarray(xy_m) - corner) * np.array([1.0, -1.0]) / self.pixel_size_m - 0.5
        return px

    def xy_from_px(self, px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return map points [m] of pixel coordinates, shape (..., 2): the inverse of `px_from_xy`."""
        corner = np.array([self.x_min_m, self.y_max_m])
        xy_m: NDArray[np.float64] = corner + (np.asarray(px) + 0.5) * np.array([1.0, -1.0]) * self.pixel_size_m
        return xy_m

    def contains(self, xy_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether map points, shape (..., 2) [m], lie on the grid, its outer edges included."""
        x_min, y_min, x_max, y_max = self.bounds_m
        x, y = xy_m[..., 0], xy_m[..., 1]
        inside: NDArray[np.bool_] = (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
        return inside
