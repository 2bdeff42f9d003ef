"""Regions of a split, and the side of each patch footprint (paper section IV-C; docs/explanation/rulings.md, Split).

A footprint belongs to a region only if the whole rotated square is inside; one that straddles a border, or is nearer to
it than the buffer, belongs to none. Ground outside all regions is unseen.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TypeVar

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from tcpipe.arrays import Bytes, Floats, Mask, number_within

Project = Callable[[Floats], Floats]
Geometries = TypeVar("Geometries", BaseGeometry, NDArray[np.object_])

_EDGE_STEP_DEG = 0.001
"""Edges are straight in lon/lat; at this step (100 m) the projected edge is straight to 1 mm below 70° latitude."""

_CHUNK = 65_536  # footprints that are geometries at one time (0.5 kB each)

_PIECE_EDGES = 16  # edges of a piece of a border


class Side(IntEnum):
    """Region of a footprint."""

    INSIDE = 0
    """In a train_test region: trains or tests."""
    UNSEEN = 1
    """In an unseen region, or outside every region."""
    BUFFER = 2
    """On a border, or nearer to one than the buffer: in no split."""
    EXCLUDED = 3
    """In an exclude region: not in the dataset."""


@dataclass(frozen=True, slots=True)
class Regions:
    """Polygons of each kind, dissolved, in one plane; ``exclude`` carves out of the other two."""

    train_test: BaseGeometry
    unseen: BaseGeometry = field(default_factory=shapely.MultiPolygon)
    exclude: BaseGeometry = field(default_factory=shapely.MultiPolygon)

    def borders(self) -> BaseGeometry:
        """Return every border, as lines."""
        carved = (shapely.difference(self.train_test, self.exclude), shapely.difference(self.unseen, self.exclude))
        return shapely.union_all([shapely.boundary(part) for part in (*carved, self.exclude)])


def project_regions(regions: Regions, project: Project, *, window_deg: tuple[float, float, float, float]) -> Regions:
    """Return regions in a metric plane [m]; their edges are straight in lon/lat (RFC 7946).

    Parameters
    ----------
    regions : in WGS84 lon/lat [deg].
    project : from lon and lat [deg], shape (N, 2), to x and y [m], shape (N, 2).
    window_deg : west, south, east, north to which regions are cut, since a projection is valid only near its zone.
    """
    parts = (regions.train_test, regions.unseen, regions.exclude)
    return Regions(*(project_near(part, project, window_deg) for part in parts))


def project_near(geometry: Geometries, project: Project, window_deg: tuple[float, float, float, float]) -> Geometries:
    """Return the part of geometries, or one, in a window of lon/lat [deg] in a metric plane [m], edge by edge."""
    near = shapely.intersection(geometry, shapely.box(*window_deg))
    placed: Geometries = shapely.transform(shapely.segmentize(near, _EDGE_STEP_DEG), project)
    return placed


def classify_footprints(corners_xy_m: Floats, regions: Regions, *, buffer_m: float) -> Bytes:
    """Return the `Side` of every footprint, shape (N,).

    Parameters
    ----------
    corners_xy_m : corners of the footprints in order around each square [m], shape (N, 4, 2).
    regions : in the same plane [m].
    buffer_m : a footprint nearer than this to any border is in the buffer [m].
    """
    usable = shapely.difference(regions.train_test, regions.exclude)
    borders = shapely.STRtree(_cut_lines(regions.borders()))
    for geometry in (usable, regions.exclude):
        shapely.prepare(geometry)
    sides = np.full(len(corners_xy_m), Side.UNSEEN, np.uint8)
    for first in range(0, len(sides), _CHUNK):
        part = sides[first : first + _CHUNK]
        squares = shapely.polygons(corners_xy_m[first : first + _CHUNK])
        centres = shapely.points(corners_xy_m[first : first + _CHUNK].mean(axis=1))
        part[shapely.contains(usable, centres)] = Side.INSIDE
        part[_is_on_border(squares, borders, buffer_m=buffer_m)] = Side.BUFFER
        part[shapely.covers(regions.exclude, squares)] = Side.EXCLUDED
    return sides


def _cut_lines(borders: BaseGeometry) -> NDArray[np.object_]:
    """Return lines in pieces of a few edges, so that a square is compared with near edges only."""
    lines = shapely.get_parts(borders)
    xy_m, line = shapely.get_coordinates(lines, return_index=True)
    begins = np.flatnonzero(np.diff(line, prepend=-1))
    within = np.arange(len(line)) - begins[line]
    first = np.flatnonzero((within % _PIECE_EDGES == 0) & np.append(line[1:] == line[:-1], False))
    last = np.minimum(first + _PIECE_EDGES, np.append(begins[1:], len(line))[line[first]] - 1)
    counts = last - first + 1
    at = np.repeat(first, counts) + number_within(counts)
    return np.asarray(shapely.linestrings(xy_m[at], indices=np.repeat(np.arange(len(first)), counts)))


def _is_on_border(squares: NDArray[np.object_], borders: shapely.STRtree, *, buffer_m: float) -> Mask:
    """Return which squares are crossed by a border, or nearer to it than the buffer."""
    found = np.zeros(len(squares), bool)
    if buffer_m > 0.0:
        (square, _), distance_m = borders.query_nearest(
            squares, max_distance=buffer_m, return_distance=True, all_matches=False
        )
        found[square] = distance_m < buffer_m
    square, piece = borders.query(squares, predicate="intersects")
    found[square[~shapely.touches(borders.geometries[piece], squares[square])]] = True
    return found
