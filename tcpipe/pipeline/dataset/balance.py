"""Balance of a dataset: cells of class, slope and speed, repeatability, and undersampled ground to drive next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from tcpipe.balance.cells import (
    CELL_M,
    CLOSED,
    SLOPE_EDGES_DEG,
    SLOPE_NAMES,
    Cell,
    MapGround,
    Patch,
    cells_available,
    choose_speed_edges,
    count_cells,
    find_cell_classes,
    find_slope_ranges,
    find_undersampled_ground,
    fit_cell_gradients,
)
from tcpipe.balance.correlation import (
    Correlation,
    Floor,
    compute_slope_residuals,
    estimate_repeatability,
    find_repeated_pairs,
    fit_correlation,
)
from tcpipe.formats.dataset_card import Balance, CellRow
from tcpipe.formats.geojson import Feature, FeatureCollection, PolygonGeometry
from tcpipe.formats.maps.map_files import MapFile
from tcpipe.splits.assignment import SPLITS
from tcpipe.splits.regions import Regions
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.findings import read_threshold
from tcpipe.terrain.projection import Projection, compute_area, parse_crs

BALANCE_COLUMNS = (
    *("run_id", "split", "start_ns", "course_rad", "terrain_class", "slope_rad"),
    *("power_watt", "velocity_mps", "fused_velocity_mps", "duration_s", "energy_joule"),
)
"""Columns of samples.parquet that the balance is made from."""

_EDGE_STEP_DEG = 1e-4
_DECIMALS = 8
"""Of a degree: a millimetre."""

_USED = tuple(name for name in SPLITS if name != "buffer")

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def measure_balance(
    table: pa.Table,
    xy_m: Floats,
    sources: Sequence[MapFile],
    *,
    velocity_column: str,
    chord_m: float,
    regions: Regions | None,
    buffer_m: float,
) -> tuple[Balance, FeatureCollection]:
    """Return the balance of the samples, and polygons of ground to drive next.

    Parameters
    ----------
    table : `BALANCE_COLUMNS` of the samples, in the dataset's order, which is random.
    xy_m : centres of their footprints in the first map's plane [m], shape (N, 2).
    sources : the maps; the first counts where they overlap.
    regions, buffer_m : of the split, in WGS84 lon/lat [deg] and [m]: excluded ground and the buffer are not worth driving.
    """
    slope, splits = to_floats(table, "slope_rad"), {name: _is_in(table, name) for name in SPLITS}
    terrain = table.column("terrain_class").fill_null(0).to_numpy()
    run = table.column("run_id").combine_chunks().dictionary_encode().indices.to_numpy()
    start_ns = to_integers(table, "start_ns")
    repeated = find_repeated_pairs(xy_m, to_floats(table, "course_rad"), terrain, chord_m=chord_m)
    correlations, repeatability = dict[str, Correlation | None](), dict[str, Floor | None]()
    for name in ("power_watt", velocity_column, "duration_s", "energy_joule"):  # one after another: each takes memory
        values = to_floats(table, name)
        residual = compute_slope_residuals(values, terrain, slope)
        repeatability[name] = estimate_repeatability(values, residual, repeated, xy_m, chord_m=chord_m)
        if name in ("power_watt", velocity_column):
            correlations[name] = fit_correlation(residual, xy_m, run, start_ns, chord_m=chord_m)
    known = [correlation for correlation in correlations.values() if correlation is not None]
    velocity_mps = to_floats(table, velocity_column)
    slopes, edges = find_slope_ranges(slope), choose_speed_edges(velocity_mps)
    speeds = np.searchsorted(edges, velocity_mps, side="right").astype(np.int8)
    used = {name: splits[name] for name in _USED}
    pairs = count_cells((terrain, slopes), used, xy_m, known)
    cells = count_cells((terrain, slopes, speeds), used, xy_m, known)
    grounds = [
        _OpenGround(source, sources[:number], sources[0], regions, buffer_m) for number, source in enumerate(sources)
    ]
    names = dict(enumerate(sources[0].classes.names().tolist()))
    rows, features = _count_by_ground(pairs, grounds, (terrain, slopes, xy_m, ~splits["buffer"]), names)
    balance = Balance(
        slope_edges_deg=SLOPE_EDGES_DEG,
        speed_edges_mps=tuple(edges),
        enough_effective=read_threshold("thin-ground", "enough_count"),
        correlation=correlations,
        by_class_and_slope=tuple(rows),
        cells=tuple(_make_row(cell, names, edges) for cell in cells),
        repeatability=repeatability,
    )
    return balance, FeatureCollection(tuple(features))


def _is_in(table: pa.Table, split: str) -> NDArray[np.bool_]:
    return np.asarray(pc.equal(table.column("split"), split).to_numpy(), np.bool_)


def _make_row(cell: Cell, names: Mapping[int, str], edges: Sequence[float]) -> CellRow:
    found: CellRow = {
        "class": names[cell.terrain_class] or None,
        "class_id": cell.terrain_class,
        "slope": SLOPE_NAMES[cell.slope],
        "samples": cell.samples,
        "effective": cell.effective,
        "effective_train": cell.effective_train,
        "rare": cell.is_undersampled,
    }
    if cell.speed is not None:
        ends = ("0", *(f"{edge:g}" for edge in edges))
        last = cell.speed == len(edges)
        found["speed_mps"] = f"above {ends[-1]}" if last else f"{ends[cell.speed]} to {ends[cell.speed + 1]}"
    return found


class _OpenGround:
    """Ground of one map that is worth driving: outside earlier maps, excluded regions and the buffer."""

    def __init__(
        self, source: MapFile, earlier: Sequence[MapFile], first: MapFile, regions: Regions | None, buffer_m: float
    ) -> None:
        plane, own = parse_crs(first.grid.crs, where="map"), parse_crs(source.grid.crs, where="map")
        area_deg = compute_area(own, source.grid.bounds_m)
        self._from_plane = Projection(plane, own, area_deg)
        self._to_lonlat = Projection(own, CRS.from_epsg(4326), area_deg)
        self.ground = _read_ground(source)
        taken = [shapely.box(*_project_bounds(other, own)) for other in earlier]
        for area, reach_m in () if regions is None else ((regions.exclude, 0.0), (regions.borders(), buffer_m)):
            near = shapely.segmentize(shapely.intersection(area, shapely.box(*area_deg)), _EDGE_STEP_DEG)
            taken.append(shapely.buffer(shapely.transform(near, self._to_lonlat.inverse), reach_m))
        _close(self.ground, taken)

    def area_m2(self, terrain_class: int, slope: int) -> float:
        """Return the area of ground of a class and a range of slope."""
        return float(cells_available(self.ground, terrain_class, slope).sum()) * self.ground.cell_m**2

    def patches(self, terrain_class: int, slope: int, driven_xy_m: Floats) -> Iterator[tuple[Patch, BaseGeometry]]:
        """Yield the patches of `find_undersampled_ground` with polygons in WGS84; ``driven_xy_m`` is in the first map's plane."""
        for patch in find_undersampled_ground(self.ground, terrain_class, slope, self._from_plane.forward(driven_xy_m)):
            lonlat = shapely.transform(patch.polygon, self._to_lonlat.forward)
            yield patch, orient(shapely.transform(lonlat, lambda deg: np.round(deg, _DECIMALS)))


def _project_bounds(source: MapFile, crs: CRS) -> tuple[float, float, float, float]:
    from_crs = parse_crs(source.grid.crs, where="map")
    corners = shapely.segmentize(shapely.box(*source.grid.bounds_m), 50.0)
    projection = Projection(from_crs, crs, compute_area(from_crs, source.grid.bounds_m))
    found: tuple[float, float, float, float] = tuple(shapely.bounds(shapely.transform(corners, projection.forward)))
    return found


def _close(ground: MapGround, taken: Sequence[BaseGeometry]) -> None:
    """Close the cells that any of the areas reaches into."""
    rows, cols = np.nonzero(ground.terrain_class != CLOSED)
    x_m, y_m = ground.x_min_m + (cols + 0.5) * ground.cell_m, ground.y_max_m - (rows + 0.5) * ground.cell_m
    for area in taken:
        reached = shapely.buffer(area, ground.cell_m / np.sqrt(2.0))
        shapely.prepare(reached)
        inside = shapely.contains_xy(reached, x_m, y_m)
        ground.terrain_class[rows[inside], cols[inside]] = CLOSED


def _read_ground(source: MapFile) -> MapGround:
    """Read the cells of a map from its coarsest level, strip by strip."""
    level = source.at(source.factors[-1]) if len(source.factors) > 1 else source
    grid = level.grid
    pixels = max(2, round(CELL_M / grid.pixel_size_m))
    classes, gradients = [], []
    strip = max(pixels, level.tile_px // pixels * pixels)
    for row in range(0, grid.rows - pixels + 1, strip):
        last = min(row + strip, grid.rows)
        heights = level.read("height", row, last, 0, grid.cols)
        gradient = fit_cell_gradients(heights.astype(np.float64), pixels, grid.pixel_size_m)
        known = np.isfinite(gradient).all(axis=-1)
        kinds = np.zeros(known.shape, np.int16)
        if "terrain" in level.layers:
            terrain = level.read("terrain", row, last, 0, grid.cols)
            kinds = find_cell_classes(terrain, pixels, level.classes.traversable())
        classes.append(np.where(known, kinds, np.int16(CLOSED)))
        gradients.append(gradient)
    shape = (0, grid.cols // pixels)
    return MapGround(
        np.concatenate([np.empty(shape, np.int16), *classes]),
        np.concatenate([np.empty((*shape, 2)), *gradients]),
        grid.x_min_m,
        grid.y_max_m,
        pixels * grid.pixel_size_m,
    )


def _count_by_ground(
    pairs: Sequence[Cell],
    grounds: Sequence[_OpenGround],
    driven_by: tuple[NDArray[np.integer], NDArray[np.int8], Floats, NDArray[np.bool_]],
    names: Mapping[int, str],
) -> tuple[list[CellRow], list[Feature]]:
    """Return a row for each class and slope that was driven or that the maps offer, and the polygons to drive next.

    ``driven_by`` has class, range of slope and place [m] of each sample, and whether it is outside the buffer.
    """
    terrain, slopes, xy_m, counts = driven_by
    driven = {(cell.terrain_class, cell.slope): cell for cell in pairs}
    kinds = {int(kind) for part in grounds for kind in np.unique(part.ground.terrain_class)} - {CLOSED}
    rows, thin = list[CellRow](), []
    for kind in sorted(kinds | {kind for kind, _ in driven}):
        for slope in range(len(SLOPE_NAMES)):
            cell = driven.get((kind, slope)) or Cell(kind, slope, None, dict.fromkeys(_USED, 0), 0.0, 0.0)
            area_m2 = sum(part.area_m2(kind, slope) for part in grounds)
            if area_m2 == 0.0 and (kind, slope) not in driven:
                continue
            rows.append({**_make_row(cell, names, ()), "offered_m2": area_m2})
            if cell.is_undersampled and area_m2 > 0.0:
                near = xy_m[(terrain == kind) & (slopes == slope) & counts]
                thin += [(cell, patch, lonlat) for part in grounds for patch, lonlat in part.patches(kind, slope, near)]
    thin.sort(key=lambda found: (found[0].effective or 0.0, found[0].terrain_class, found[0].slope, -found[1].area_m2))
    features = [
        _make_feature(rank, cell, patch, lonlat, names) for rank, (cell, patch, lonlat) in enumerate(thin, start=1)
    ]
    return rows, features


def _make_feature(rank: int, cell: Cell, patch: Patch, lonlat: BaseGeometry, names: Mapping[int, str]) -> Feature:
    properties = {
        "rank": rank,
        "class": names[cell.terrain_class] or None,
        "slope": SLOPE_NAMES[cell.slope],
        "drive_towards": patch.towards,
        "samples": sum(cell.samples.values()),
        "effective_samples": None if cell.effective is None else round(cell.effective, 1),
        "area_m2": round(patch.area_m2, 1),
    }
    return Feature(properties, PolygonGeometry(**shapely.geometry.mapping(lonlat)))
