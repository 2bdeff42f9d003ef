"""Analytic worlds for map tests: closed-form height, grey and class, written as GeoTIFFs, and segments inside them."""

from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyproj
import rasterio
from rasterio import Affine

from tcpipe.formats.maps.geotiff import keep_open
from tcpipe.formats.maps.layer_building import open_raster
from tcpipe.tables.columns import make_lines
from tcpipe.tables.levels import LABELLED_SEGMENTS
from tcpipe.terrain.layers import PAPER_CLASSES, PAPER_LAYERS, ClassTable, find_no_data_value, make_paper_layers
from tcpipe.terrain.resampling import iterate_levels, make_overview_grid
from tcpipe.terrain.target_grid import MapGrid


def make_waves(at_m, waves_m, steepness):
    """Return height [m] and class of a square site at places along its sides [m]: waves of these lengths, four classes, obstacles (2)."""
    rng = np.random.default_rng(3)
    east, north = np.meshgrid(at_m, at_m[::-1])
    height, field_of_class = np.zeros(east.shape), np.zeros(east.shape)
    for wave_m in waves_m:
        a, b = rng.uniform(0.0, 2.0 * np.pi, 2)
        height += steepness * wave_m * np.sin(east / wave_m * 2 + a) * np.cos(north / wave_m * 2 + b)
    for _ in range(12):
        wave_m, course, phase = rng.uniform(8.0, 60.0), rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0, 2.0 * np.pi)
        field_of_class += np.sin((east * np.cos(course) + north * np.sin(course)) / wave_m + phase)
    class_id = np.select([field_of_class < -4.2, field_of_class < -1.0, field_of_class < 2.0], [2, 4, 5], 6)
    return height, class_id.astype(np.uint8)


@dataclass(frozen=True)
class World:
    """A square site of ``side_m`` around a point of a projected CRS."""

    crs: str
    x_m: float
    y_m: float
    side_m: float = 60.0

    def height(self, x, y):
        u, v = x - self.x_m, y - self.y_m
        return 612.0 + 0.21 * u - 0.13 * v + 0.25 * np.sin(u / 1.3) * np.cos(v / 1.7)

    def bilinear_bound_m(self, pixel_size_m):
        """Largest error of bilinear interpolation: pitch² / 8 times the largest second derivatives."""
        return pixel_size_m**2 / 8.0 * 0.25 * (1.0 / 1.3**2 + 1.0 / 1.7**2)

    def grey(self, x, y):
        return 120.0 + 80.0 * np.sin((x - self.x_m) / 2.1) * np.sin((y - self.y_m) / 1.9)

    def terrain(self, x, y):
        u, v = x - self.x_m, y - self.y_m
        found = np.where(u + 0.3 * v < 0.0, 4, 6)
        found = np.where(np.hypot(u - 9.0, v - 4.0) < 8.0, 5, found)
        return np.where(v - 0.5 * u > 14.0, 7, found)

    def centres(self, pixel_size_m):
        count = round(self.side_m / pixel_size_m)
        offset = (np.arange(count) + 0.5) * pixel_size_m - self.side_m / 2.0
        return np.meshgrid(self.x_m + offset, self.y_m - offset)

    def write(self, directory: Path, pixel_size_m: float = 0.05) -> dict[str, Path]:
        """Write height (float32), ortho (RGB of equal grey) and terrain (ids) on one grid."""
        x, y = self.centres(pixel_size_m)
        corner = (self.x_m - self.side_m / 2.0, self.y_m + self.side_m / 2.0)
        transform = Affine(pixel_size_m, 0.0, corner[0], 0.0, -pixel_size_m, corner[1])
        grey = np.rint(self.grey(x, y)).astype(np.uint8)
        layers = {
            "height": self.height(x, y).astype(np.float32)[None],
            "ortho": np.stack([grey, grey, grey]),
            "terrain": self.terrain(x, y).astype(np.uint8)[None],
        }
        return {
            name: write_tif(directory / f"{name}.tif", values, self.crs, transform) for name, values in layers.items()
        }


def write_tif(path: Path, values, crs, transform, *, nodata=None, point=False, **options) -> Path:
    """Write bands (B, rows, cols) with rasterio itself, independent of the code under test."""
    bands, rows, cols = values.shape
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=rows,
        width=cols,
        count=bands,
        dtype=values.dtype,
        crs=crs,
        transform=transform,
        nodata=nodata,
        **options,
    ) as dataset:
        if point:
            dataset.update_tags(AREA_OR_POINT="Point")
        dataset.write(values)
    return path


def segments_from(crs: str, start_xy: np.ndarray, azimuth_deg: np.ndarray, *, gnss_crs: str, chord_m: float = 1.0):
    """Return labelled segments that begin at map points and run ``chord_m`` along geodesics of true azimuths."""
    geographic = pyproj.CRS(gnss_crs)
    to_lonlat = pyproj.Transformer.from_crs(crs, geographic, always_xy=True)
    lon, lat = to_lonlat.transform(start_xy[:, 0], start_xy[:, 1])
    length = np.full(len(start_xy), chord_m)
    end_lon, end_lat, _ = geographic.get_geod().fwd(lon, lat, azimuth_deg, length)
    return segment_table(np.stack([lon, lat], 1), np.stack([end_lon, end_lat], 1), azimuth_deg, chord_m)


def segment_table(
    start: np.ndarray, end: np.ndarray, azimuth_deg: Sequence[float], chord_m: float = 1.0, position_std_m=0.02
):
    """Return a labelled-segment table with the given ends [deg]; everything that no map needs is a plain number."""
    count = len(start)
    given = {
        "segment_id": [f"run-{n}" for n in range(count)],
        "run_id": ["run"] * count,
        "robot": ["husky"] * count,
        "start_lon_deg": start[:, 0],
        "start_lat_deg": start[:, 1],
        "end_lon_deg": end[:, 0],
        "end_lat_deg": end[:, 1],
        "chord_m": np.full(count, chord_m),
        "arc_length_m": np.full(count, 1.004 * chord_m),
        "course_rad": np.radians(90.0 - np.asarray(azimuth_deg)),
        "position_std_m": np.broadcast_to(position_std_m, count),
    }
    rest = {name: np.zeros(count) for name in LABELLED_SEGMENTS.names() if name not in given}
    whole = {c.name for c in LABELLED_SEGMENTS.columns if str(c.dtype).startswith(("int", "uint"))}
    rest = {name: values.astype(np.int64) if name in whole else values for name, values in rest.items()}
    return LABELLED_SEGMENTS.table(**given, **rest | {"geometry": make_lines(start, end)})


@contextmanager
def open_heights(paths):
    """Yield heights in many files as `build_map` opens them."""
    with keep_open() as open_file:
        yield open_raster(paths, "height", "metres", open_file)


@dataclass(frozen=True)
class ArrayMap:
    """A map in memory, for tests of sampling alone."""

    grid: MapGrid
    arrays: dict
    tile_px: int = 64
    height_reference_m: float = 0.0
    classes: ClassTable = PAPER_CLASSES
    name: str = "m"
    factors: tuple = (1,)
    more: dict = field(default_factory=dict)
    """Layers that are not the paper's."""

    @property
    def layers(self):
        return make_paper_layers([name for name in self.arrays if name not in self.more], self.classes) | self.more

    def summary(self):
        return {"name": self.name}

    def select(self, layers):
        assert set(self.layers) <= set(layers)
        return self

    def read(self, layer, row0, row1, col0, col1):
        return self.arrays[layer][row0:row1, col0:col1]

    def expect(self, tiles):
        pass

    def read_tile(self, layer, i, j, out):
        side = self.tile_px
        part = self.read(layer, i * side, (i + 1) * side, j * side, (j + 1) * side)
        out[...] = find_no_data_value(self.layers[layer].mapped)
        out[: part.shape[0], : part.shape[1]] = part


class LeveledMap(ArrayMap):
    """A map in memory with overviews."""

    def at(self, factor):
        arrays = {
            name: dict(iterate_levels(PAPER_LAYERS[name], layer, self.factors))[factor]
            for name, layer in self.arrays.items()
        }
        return ArrayMap(make_overview_grid(self.grid, factor), arrays, self.tile_px, self.height_reference_m)


def random_map(seed=0, rows=300, cols=260, pixel_size_m=0.05, tile_px=64) -> ArrayMap:
    """Rough random layers in UTM 33N, nothing missing."""
    rng = np.random.default_rng(seed)
    arrays = {
        "height": rng.normal(0.0, 0.3, (rows, cols)).astype(np.float32),
        "ortho": rng.integers(1, 256, (rows, cols)).astype(np.uint8),
        "terrain": rng.integers(4, 8, (rows, cols)).astype(np.uint8),
    }
    return ArrayMap(MapGrid("EPSG:32633", 500_000.0, 5_200_000.0, pixel_size_m, rows, cols), arrays, tile_px)
