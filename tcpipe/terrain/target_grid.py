"""Choice of the grid of a map's rasters, and projection of its pixels into each raster.

The grid's CRS is the height raster's if that is metric and upright over the whole raster, else the UTM zone of its
middle. Its pitch is that of the finest raster (of the height, if none is more than 5 % finer), and its pixels coincide
with that raster's where possible, so that the finest layer passes unchanged. Its extent is the height raster's.

The grid all layers of a map share: a projected, metric CRS, square pixels, rows from north to south.

Pixel (row i, column j) covers x from ``x_min_m + j·pitch`` and y downward from ``y_max_m - i·pitch``; its centre is
half a pitch further. *Pixel coordinates* count centres: (0, 0) is the centre of the first pixel, x along columns, y
along rows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from tcpipe.arrays import Box, Floats, Mask
from tcpipe.errors import MapError
from tcpipe.terrain.projection import Projection, compute_area, find_utm_crs, format_crs, is_metric

LATTICE_STEP_PX = 16
"""Spacing of projected pixels, positions between are interpolated: error 1e-7 px for a site, 1e-3 px for a country."""

MAX_PIXELS = 2**32
"""Most pixels of a map: 3.3 km a side at 5 cm; 21 GB before compression."""

MAX_SIDE_PX = 2**18
"""Longest side of a map [px]: 13 km at 5 cm."""

_FINER = 0.95
_TURN = 1e-9
_EDGE_POINTS = 21


@dataclass(frozen=True, slots=True)
class Georeference:
    """A raster's horizontal CRS, affine (x = a·col + b·row + c, y = d·col + e·row + f at corners), size and name."""

    crs: CRS
    affine: tuple[float, float, float, float, float, float]
    rows: int
    cols: int
    name: str

    def xy_from_px(self, px: Floats) -> Floats:
        """Return points in the raster's CRS of pixel *corner* coordinates (col, row), shape (..., 2)."""
        a, b, c, d, e, f = self.affine
        col, row = px[..., 0], px[..., 1]
        return np.stack([a * col + b * row + c, d * col + e * row + f], axis=-1)

    def px_from_xy(self, xy: Floats) -> Floats:
        """Return pixel *centre* coordinates (col, row; centres: integers) of points in the raster's CRS, (..., 2)."""
        a, b, c, d, e, f = self.affine
        x, y = xy[..., 0] - c, xy[..., 1] - f
        determinant = a * e - b * d
        return np.stack([(e * x - b * y) / determinant, (a * y - d * x) / determinant], axis=-1) - 0.5

    def outline(self) -> Floats:
        """Return points along the raster's outer edges in its CRS, shape (N, 2)."""
        t = np.linspace(0.0, 1.0, _EDGE_POINTS)
        zero, one = np.zeros_like(t), np.ones_like(t)
        edges = [np.stack(pair, axis=1) for pair in ((t, zero), (one, t), (1 - t, one), (zero, 1 - t))]
        return self.xy_from_px(np.concatenate(edges) * (self.cols, self.rows))

    def centre(self) -> Floats:
        """Return the middle of the raster in its CRS, shape (2,)."""
        return self.xy_from_px(np.array([self.cols / 2.0, self.rows / 2.0]))

    def is_square_in(self, crs: CRS) -> bool:
        """Return whether pixels are square and upright in ``crs``, so that a grid can coincide with them."""
        a, b, _, d, e, _ = self.affine
        upright = max(abs(b), abs(d)) < _TURN * abs(a)
        return self.crs == crs and upright and math.isclose(abs(a), abs(e), rel_tol=1e-6)


def find_projection(raster: Georeference, crs: CRS) -> Projection | None:
    """Return the operation from a raster's CRS to the map's; None if they are the same."""
    if raster.crs == crs:
        return None
    outline = raster.outline()
    bounds = (*outline.min(axis=0).tolist(), *outline.max(axis=0).tolist())
    return Projection(raster.crs, crs, compute_area(raster.crs, bounds))


def _project(raster: Georeference, points: Floats, crs: CRS) -> Floats:
    """Return points of a raster's CRS in another."""
    projection = find_projection(raster, crs)
    return points if projection is None else projection.forward(points)


def choose_crs(height: Georeference, wanted: CRS | None) -> CRS:
    """Return the map's CRS: the wanted one, else the height raster's, else the UTM zone of its middle.

    `MapError`: the wanted CRS is not metric over the raster, or the raster is too large for any.
    """
    points = np.vstack([height.outline(), height.centre()])
    if wanted is None and is_metric(height.crs, points):
        return height.crs
    x, y = height.centre().tolist()
    crs = wanted or find_utm_crs(height.crs, (x, y))
    placed = _project(height, points, crs)
    if np.isfinite(placed).all() and is_metric(crs, placed):
        return crs
    if wanted is not None:
        raise MapError(
            f"{height.name}: the CRS {crs.name!r} is not metric there "
            "(its unit is more than 1 % off a metre of ground, "
            "or it is mirrored); expected a UTM zone or a national grid"
        )
    raise MapError(
        f"{height.name}: too large for one metric map: "
        f"in {crs.name} its edges would be more than 1 % out of scale; cut out the site first"
    )


def choose_grid(
    height: Georeference, others: Sequence[Georeference], crs: CRS, pixel_size_m: float | None = None
) -> MapGrid:
    """Return the common grid in ``crs``; ``pixel_size_m`` overrides the finest raster's [m]."""
    rasters = [height, *others]
    sides = [_compute_pixel_side(raster, crs) for raster in rasters]
    finest = int(np.argmin(sides)) if min(sides) < _FINER * sides[0] else 0
    base, pitch = rasters[finest], sides[finest]
    coincide = base.is_square_in(crs) and pixel_size_m in {None, pitch}
    if pixel_size_m is not None:
        pitch = pixel_size_m
    elif not coincide:
        pitch = float(f"{pitch:.3g}")
    outline = _project(height, height.outline(), crs)
    (x_min, y_min), (x_max, y_max) = outline.min(axis=0).tolist(), outline.max(axis=0).tolist()
    x_base, y_base = 0.0, 0.0
    if coincide:
        corners = base.outline()
        x_base, y_base = float(corners[:, 0].min()), float(corners[:, 1].max())
    elif height.is_square_in(crs):
        x_base, y_base = x_min, y_max
    _refuse_huge(height, (x_max - x_min, y_max - y_min), pitch)
    return _cover(format_crs(crs), (x_min, y_min, x_max, y_max), (x_base, y_base), pitch)


def _cover(crs: str, bounds_m: Box, base_m: tuple[float, float], pitch: float) -> MapGrid:
    """Return the smallest grid over ``bounds_m`` that has a corner of a pixel at ``base_m``."""
    (x_min, y_min, x_max, y_max), (x_base, y_base), slack = bounds_m, base_m, 1e-3
    left = x_base + math.floor((x_min - x_base) / pitch + slack) * pitch
    top = y_base + math.ceil((y_max - y_base) / pitch - slack) * pitch
    cols = max(math.ceil((x_max - left) / pitch - slack), 1)
    rows = max(math.ceil((top - y_min) / pitch - slack), 1)
    return MapGrid(crs, left, top, pitch, rows, cols)


def _refuse_huge(height: Georeference, sides_m: tuple[float, float], pixel_size_m: float) -> None:
    """Reject a grid that is too large for a disk or for one night of computing."""
    cols, rows = (side_m / pixel_size_m if pixel_size_m > 0.0 else math.inf for side_m in sides_m)
    if not (max(cols, rows) <= MAX_SIDE_PX and cols * rows <= MAX_PIXELS):
        raise MapError(
            f"{height.name}: the map would have {cols:.3g} x {rows:.3g} pixels of {pixel_size_m:.3g} m, at most "
            f"{MAX_PIXELS:.2g} in all and {MAX_SIDE_PX} a side; cut out the site "
            "(rio clip in.tif out.tif --bounds 'x_min y_min x_max y_max') or give coarser rasters"
        )


def _compute_pixel_side(raster: Georeference, crs: CRS) -> float:
    """Return the shorter side of the raster's middle pixel in the map's CRS [m]."""
    if raster.is_square_in(crs):
        return abs(raster.affine[0])
    middle = np.array([raster.cols / 2.0, raster.rows / 2.0])
    points = raster.xy_from_px(middle + np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]))
    placed = _project(raster, points, crs)
    side = float(np.linalg.norm(placed[1:] - placed[0], axis=1).min())
    if not math.isfinite(side):
        raise MapError(f"{raster.name}: is outside the area where the map's CRS {crs.name!r} is defined")
    return side


def compute_source_lattice(  # noqa: PLR0917
    grid: MapGrid, raster: Georeference, projection: Projection | None, row0: int, rows: int, col0: int, cols: int
) -> Floats:
    """Return the raster's pixel coordinates at every `LATTICE_STEP_PX`-th pixel of a grid block, shape (A, B, 2).

    They begin one step above and left of the block, end at least one step beyond, and are not finite where the raster's
    CRS is undefined.
    """
    step = LATTICE_STEP_PX
    i = row0 - step + step * np.arange(-(-rows // step) + 3)
    j = col0 - step + step * np.arange(-(-cols // step) + 3)
    px = np.stack(np.broadcast_arrays(j[None, :].astype(float), i[:, None].astype(float)), axis=-1)
    xy_m = grid.xy_from_px(px)
    if projection is None:
        return raster.px_from_xy(xy_m)
    xy = projection.inverse(xy_m)
    if raster.crs.is_geographic:  # a raster across the antimeridian counts on beyond 180°
        xy[..., 0] += 360.0 * np.round((raster.centre()[0] - xy[..., 0]) / 360.0)
    return raster.px_from_xy(xy)


@dataclass(frozen=True, slots=True)
class MapGrid:
    """Pixel grid of a map.

    ``crs``: ``EPSG:n`` or WKT 2, horizontal, in metres, x east-like and y north-like; ``x_min_m``, ``y_max_m``: outer
    corner of pixel (0, 0) (not its centre); ``pixel_size_m``: side of a pixel in CRS units.
    """

    crs: str
    x_min_m: float
    y_max_m: float
    pixel_size_m: float
    rows: int
    cols: int

    @property
    def bounds_m(self) -> Box:
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

    def px_from_xy(self, xy_m: Floats) -> Floats:
        """Return pixel coordinates (x along columns, y along rows; centres are integers) of map points, (..., 2)."""
        corner = np.array([self.x_min_m, self.y_max_m])
        return np.asarray((np.asarray(xy_m) - corner) * np.array([1.0, -1.0]) / self.pixel_size_m - 0.5)

    def xy_from_px(self, px: Floats) -> Floats:
        """Return map points [m] of pixel coordinates, shape (..., 2): the inverse of `px_from_xy`."""
        corner = np.array([self.x_min_m, self.y_max_m])
        return np.asarray(corner + (np.asarray(px) + 0.5) * np.array([1.0, -1.0]) * self.pixel_size_m)

    def contains(self, xy_m: Floats) -> Mask:
        """Return whether map points, shape (..., 2) [m], are finite and on the grid, outer edges included."""
        x_min, y_min, x_max, y_max = self.bounds_m
        x, y = xy_m[..., 0], xy_m[..., 1]
        return (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
