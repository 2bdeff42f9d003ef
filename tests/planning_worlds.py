"""Small maps of closed form for planning: a plane of any slope, classes of straight borders."""

import numpy as np
from map_worlds import ArrayMap

from tcpipe.planning.frames import find_lonlat_projection
from tcpipe.terrain.target_grid import MapGrid

WEST_M, NORTH_M = 500_000.0, 5_200_000.0


def plane(side_m=24.0, *, rise_east=0.0, rise_north=0.0, classes=None, pixel_size_m=0.1, tile_px=64):
    """Return a square map whose class is ``classes(east, north)`` (grass without it), east and north from the south-west corner [m]."""
    count = round(side_m / pixel_size_m)
    offset = (np.arange(count) + 0.5) * pixel_size_m
    east, north = np.meshgrid(offset, offset[::-1])
    terrain = np.full(east.shape, 4) if classes is None else classes(east, north)
    arrays = {
        "height": (50.0 + rise_east * east + rise_north * north).astype(np.float32),
        "ortho": np.full(east.shape, 128, np.uint8),
        "terrain": terrain.astype(np.uint8),
    }
    return ArrayMap(MapGrid("EPSG:32633", WEST_M, NORTH_M, pixel_size_m, count, count), arrays, tile_px)


def lonlat(source, *points):
    """Return lon, lat [deg] of points given east and north of the map's south-west corner [m], shape (P, 2)."""
    x_min, y_min, _, _ = source.grid.bounds_m
    return find_lonlat_projection(source).inverse(np.array(points, np.float64) + np.array([x_min, y_min]))
