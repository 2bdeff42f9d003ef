"""Patches per second: the sampler against scipy and rasterio, and against a gather of nearest pixels (a floor).

    python benchmarks/sample_patches.py [PATCHES]

Interleaved repeats in one process, CPU time, three layers at 0.05 m over 596 m x 305 m (the paper's maps), patches of
40 px at 25 mm along a winding drive. All samplers return three layers of 40 x 40; only tcpipe also checks validity,
stores height in half millimetres above the lowest pixel, and returns slopes and the class under the chord. Ratios are
medians over the repeats.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import rasterio
from rasterio.windows import Window
from scipy.ndimage import map_coordinates

from tcpipe.compiled import compile_kernel
from tcpipe.formats.maps.building import build_map
from tcpipe.formats.maps.geotiff import write_geotiff
from tcpipe.formats.maps.map_files import open_map
from tcpipe.terrain.layers import PAPER_CLASSES, ClassTable, make_paper_layers
from tcpipe.terrain.sampling import make_patch_frames, map_px_from_patch, sample_patches
from tcpipe.terrain.target_grid import MapGrid
from tcpipe.terrain.tiles import TilePool, group_by_tile

ROWS, COLS, PX = 6100, 11920, 40
REPEATS = 7
GRID = MapGrid("EPSG:32633", 500_000.0, 5_200_000.0, 0.05, ROWS, COLS)
LAYERS = ("height", "ortho", "terrain")
WANTED = {
    "map_coordinates, map in memory": (10.0, "at least"),
    "rasterio window + scipy": (20.0, "at least"),
    "nearest gather": (1.0 / 2.2, "at least"),
}


@dataclass(frozen=True)
class MemoryMap:
    """A map in memory (`tcpipe.terrain.tiles.MapReader`)."""

    arrays: dict[str, Any]
    grid: MapGrid = GRID
    classes: ClassTable = PAPER_CLASSES
    layers: dict[str, Any] = field(default_factory=lambda: make_paper_layers(LAYERS, PAPER_CLASSES))
    tile_px: int = 512
    height_reference_m: float = 600.0
    name: str = "memory"
    factors: tuple[int, ...] = (1,)

    def expect(self, tiles):
        """Hold all tiles already."""

    def read_tile(self, layer, i, j, out):
        """Put a tile into ``out``."""
        side = self.tile_px
        found = self.arrays[layer][i * side : (i + 1) * side, j * side : (j + 1) * side]
        out[...] = 0
        out[: found.shape[0], : found.shape[1]] = found


@compile_kernel
def gather(  # noqa: PLR0917
    height, ortho, terrain, width, frames, out_height, out_ortho, out_terrain
):
    """One load a layer and pixel from flat arrays, no interpolation, no validity: what any sampler must at least do."""
    side = out_height.shape[1]
    for n in range(frames.shape[0]):
        left, top = np.int64(frames[n, 0]) - 64, np.int64(frames[n, 1]) - 64
        base = np.int32(top * width + left)
        lx, ly = np.float32(frames[n, 0] - left + 0.5), np.float32(frames[n, 1] - top + 0.5)
        ax, ay = np.float32(frames[n, 2]), np.float32(frames[n, 3])
        bx, by = np.float32(frames[n, 4]), np.float32(frames[n, 5])
        for r in range(side):
            rx, ry = lx + bx * np.float32(r), ly + by * np.float32(r)
            for c in range(side):
                row, col = np.int32(ry + ay * np.float32(c)), np.int32(rx + ax * np.float32(c))
                i = base + row * np.int32(width) + col
                out_height[n, r, c] = np.uint16(height[i])
                out_ortho[n, r, c] = ortho[i]
                out_terrain[n, r, c] = terrain[i]


def world() -> MemoryMap:
    """Return rolling ground with a centimetre of roughness, a mottled photo, classes in patches of a few metres."""
    rng = np.random.default_rng(0)
    row, col = np.arange(ROWS, dtype=np.float32)[:, None], np.arange(COLS, dtype=np.float32)[None, :]
    height = 5.0 + 2.0 * np.sin(col / 180.0) * np.cos(row / 260.0) + rng.normal(0.0, 0.01, (ROWS, COLS))
    ortho = 120.0 + 40.0 * np.sin(col / 31.0 + row / 47.0) + rng.integers(-12, 12, (ROWS, COLS))
    terrain = 4 + (col // 140 + row // 220) % 4
    return MemoryMap(
        {"height": height.astype(np.float32), "ortho": ortho.astype(np.uint8), "terrain": terrain.astype(np.uint8)}
    )


def segments(source: MemoryMap, count: int):
    """Return the ends of 1 m chords, one after another along a meandering drive that turns back at the edges."""
    rng = np.random.default_rng(1)
    x_min, y_min, x_max, y_max = source.grid.bounds_m
    low, high = np.array([x_min + 6.0, y_min + 6.0]), np.array([x_max - 6.0, y_max - 6.0])
    points = np.empty((count + 1, 2))
    points[0], course = (low + high) / 2.0, 0.0
    for n in range(count):
        course += rng.normal(0.0, 0.08)
        ahead = points[n] + np.array([np.cos(course), np.sin(course)])
        if (ahead < low).any() or (ahead > high).any():
            to_middle = (low + high) / 2.0 - points[n]
            course = np.arctan2(to_middle[1], to_middle[0]) + rng.normal(0.0, 0.8)
            ahead = points[n] + np.array([np.cos(course), np.sin(course)])
        points[n + 1] = ahead
    return points[:-1], points[1:]


def positions(frame):
    """Return rows and columns of the map that one patch's pixels lie at, (2, PX, PX)."""
    c, r = np.meshgrid(np.arange(PX), np.arange(PX))
    x0, y0, ax, ay, bx, by = frame
    return np.stack([y0 + ay * c + by * r, x0 + ax * c + bx * r])


def with_scipy(arrays, frames):
    for frame in frames:
        at = positions(frame)
        for layer, order in zip(LAYERS, (1, 1, 0), strict=True):
            map_coordinates(arrays[layer], at, order=order)


def with_rasterio(datasets, frames):
    for frame in frames:
        at = positions(frame)
        corner = np.floor(at.min(axis=(1, 2))).astype(int) - 1
        rows, cols = np.ceil(at.max(axis=(1, 2))).astype(int) + 2 - corner
        window = Window(corner[1], corner[0], cols, rows)
        for layer, order in zip(LAYERS, (1, 1, 0), strict=True):
            map_coordinates(datasets[layer].read(1, window=window), at - corner[:, None, None], order=order)


def files(source: MemoryMap, directory: Path) -> dict[str, Path]:
    """Write each layer as a deflated GeoTIFF in tiles."""
    for layer, values in source.arrays.items():
        write_geotiff(
            directory / f"{layer}.tif",
            lambda first, last, values=values: values[None, first:last],
            GRID,
            dtype=values.dtype.name,
        )
    return {layer: directory / f"{layer}.tif" for layer in LAYERS}


def decode_only(disk, placed):
    """Read only the tiles that contain the patches."""
    for group in group_by_tile(disk.grid.px_from_xy(placed.centre_xy_m), disk):
        i, j = np.floor(disk.grid.px_from_xy(placed.centre_xy_m[group[:1]]))[0, ::-1].astype(int)
        TilePool(disk).hold(np.array([(i, j, i + 1, j + 1)]))


def measure(contestants: dict[str, tuple[Callable[[], Any], int]]) -> dict[str, list[float]]:
    """Return microseconds of CPU a patch of every contestant in every repeat, the contestants taking turns."""
    for run, _ in contestants.values():
        run()
    spent: dict[str, list[float]] = {name: [] for name in contestants}
    for _ in range(REPEATS):
        for name, (run, patches) in contestants.items():
            began = time.process_time()
            run()
            spent[name].append((time.process_time() - began) / patches * 1e6)
    return spent


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10_886
    source = world()
    chord_m = np.ones(count)
    placed = make_patch_frames(*segments(source, count), chord_m)
    frames = map_px_from_patch(placed, GRID, patch_m=1.0, patch_px=PX)
    outs = [np.empty((count, PX, PX), dtype) for dtype in (np.uint16, np.uint8, np.uint8)]
    flat = [source.arrays[layer].reshape(-1) for layer in LAYERS]
    few = min(count, 400)
    stretches = cycle(
        frames[first : first + few] for first in range(0, count - few + 1, few)
    )  # never the same blocks twice
    with tempfile.TemporaryDirectory() as name:
        paths = files(source, Path(name))
        build_map(Path(name) / "m.zarr", name="m", **paths)
        disk = open_map(Path(name) / "m.zarr")
        datasets = {layer: rasterio.open(path) for layer, path in paths.items()}

        def sampler(of):
            return lambda: sample_patches(of, placed, chord_m, patch_m=1.0, patch_px=PX)

        spent = measure(
            {
                "tcpipe, map in memory": (sampler(source), count),
                "nearest gather": (lambda: gather(*flat, COLS, frames, *outs), count),
                "map_coordinates, map in memory": (lambda: with_scipy(source.arrays, next(stretches)), few),
                "rasterio window + scipy": (lambda: with_rasterio(datasets, next(stretches)), few),
                "tcpipe, decoding the map's tiles": (sampler(disk), count),
                "decoding those tiles alone": (lambda: decode_only(disk, placed), count),
            }
        )
    ours = spent["tcpipe, map in memory"]
    for contestant, micros in spent.items():
        ratio = median(theirs / mine for theirs, mine in zip(micros, ours, strict=True))
        wanted = WANTED.get(contestant)
        goal = f"   (goal {wanted[1]} {wanted[0]:.2f})" if wanted else ""
        print(f"{contestant:34s} {median(micros):8.1f} us a patch   {ratio:6.2f} x tcpipe in memory{goal}")


if __name__ == "__main__":
    main()
