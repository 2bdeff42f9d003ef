"""Layers in many tiles, against the same layers merged into one GeoTIFF by rasterio."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
import rasterio.merge
from map_worlds import open_heights, write_tif
from rasterio import Affine

from tcpipe.errors import MapError
from tcpipe.formats.maps import geotiff
from tcpipe.formats.maps.building import build_map
from tcpipe.formats.maps.layer_building import open_raster
from tcpipe.formats.maps.map_files import open_map

LEFT, TOP, PITCH_M = 560_000.0, 5_215_000.0, 0.25
SIDE, STEP = 48, 40
"""Pixels of a tile, and from one to the next: they overlap."""


def corner(col, row, pitch=PITCH_M, left=LEFT, top=TOP):
    return Affine(pitch, 0.0, left + pitch * col, 0.0, -pitch, top - pitch * row)


def tiles(directory, *, rows=3, cols=3, without=((1, 2),), crs="EPSG:32633", pitch=PITCH_M, left=LEFT, top=TOP):
    """Tiles of noise that disagree where they overlap, one missing, with nodata inside: paths by role, in the order of their names."""
    rng = np.random.default_rng(3)
    paths = {"height": [], "ortho": [], "terrain": []}
    for role in paths:
        (directory / role).mkdir()
    for i, j in np.ndindex(rows, cols):
        if (i, j) in without:
            continue
        at = corner(j * STEP, i * STEP, pitch, left, top)
        height = rng.normal(300.0, 3.0, (1, SIDE, SIDE)).astype(np.float32)
        height[0, 5:9, -4:] = -9.0
        grey = rng.integers(1, 256, (1, SIDE, SIDE)).astype(np.uint8)
        ids = rng.integers(3, 8, (1, SIDE, SIDE)).astype(np.uint8)
        for role, values, nodata in (("height", height, -9.0), ("ortho", grey, None), ("terrain", ids, 3)):
            paths[role].append(write_tif(directory / role / f"t_{i}_{j}.tif", values, crs, at, nodata=nodata))
    return paths


def merged(directory, paths):
    """One file a role, made by rasterio; the last lies on top."""
    one = {}
    for role, files in paths.items():
        fill = {"height": -9.0, "ortho": 0, "terrain": 3}[role]
        values, affine = rasterio.merge.merge(files, method="last", nodata=fill)
        with rasterio.open(files[0]) as first:
            one[role] = write_tif(directory / f"{role}.tif", values, first.crs, affine, nodata=fill)
    return one


def layers_of(path):
    source = open_map(path)
    return source.grid, {layer: source.read(layer, 0, source.grid.rows, 0, source.grid.cols) for layer in source.layers}


@pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")
@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, id="on its own grid"),
        pytest.param({"pixel_size_m": 0.11}, id="interpolated across the seams"),
        pytest.param({"pixel_size_m": 0.6}, id="averaged across the seams"),
        pytest.param({"crs": "EPSG:31258"}, id="in another plane"),
    ],
)
def test_tiles_are_the_map_that_one_merged_raster_is(tmp_path, options, monkeypatch):
    monkeypatch.setattr(geotiff, "_MAX_OPEN", 2)
    many = tiles(tmp_path)
    build_map(tmp_path / "many.zarr", name="m", **many, **options)
    build_map(tmp_path / "one.zarr", name="m", **merged(tmp_path, many), **options)
    (grid, layers), (one_grid, one_layers) = (layers_of(tmp_path / f"{name}.zarr") for name in ("many", "one"))
    assert grid == one_grid
    for role, values in layers.items():
        np.testing.assert_array_equal(values, one_layers[role])
        present = np.isfinite(values) if role == "height" else values > 0
        assert 0.5 < present.mean() < 0.95, role


def test_tiles_in_degrees_lie_side_by_side_also_across_the_antimeridian(tmp_path):
    """Steps of a third of an arc second are no round number; 60 columns west of 180°, 60 east of it."""
    pitch = 1.0 / 10_800.0
    west = write_tif(
        tmp_path / "w.tif", np.full((1, 50, 60), 7.0, np.float32), "EPSG:4326", corner(-60, 0, pitch, 180.0, -16.5)
    )
    east = write_tif(
        tmp_path / "e.tif", np.full((1, 50, 60), 9.0, np.float32), "EPSG:4326", corner(0, 0, pitch, -180.0, -16.5)
    )
    with open_heights([west, east]) as raster:
        assert (raster.georeference.rows, raster.georeference.cols) == (50, 120)
        values, valid = raster.read(10, 12, 50, 70)
    assert valid.all()
    assert values[0].tolist() == [7.0] * 10 + [9.0] * 10


def test_few_files_are_open_however_many_there_are(tmp_path):
    paths = tiles(tmp_path, rows=8, cols=8, without=())["height"]
    before = len(list(Path("/dev/fd").iterdir()))
    with open_heights(paths) as raster:
        for row in range(0, raster.georeference.rows, STEP):
            raster.read(row, min(row + STEP, raster.georeference.rows), 0, raster.georeference.cols)
            assert len(list(Path("/dev/fd").iterdir())) - before <= geotiff._MAX_OPEN
        assert raster.name == "t_0_0.tif … t_7_7.tif (64 files)"


ODD = {
    "crs.tif": ("EPSG:32634", corner(STEP, 0), "another CRS .*UTM zone 34N, expected WGS 84 / UTM zone 33N"),
    "none.tif": (None, corner(STEP, 0), r"another CRS than the rest \(none"),
    "type.tif": ("EPSG:32633", corner(STEP, 0), r"int16 \(gray\), expected float32"),
    "pitch.tif": ("EPSG:32633", corner(0, 0, 0.5), "0.5 x 0.5, the rest 0.25 x 0.25.*rio merge --resampling bilinear"),
    "shift.tif": ("EPSG:32633", corner(STEP + 0.4, 0), "are not aligned with the pixels of the others"),
}


def test_tiles_that_are_odd_are_named_in_one_line(tmp_path):
    rest = tiles(tmp_path)["height"]
    for name, (crs, affine, wanted) in ODD.items():
        values = np.ones((1, SIDE, SIDE), np.int16 if name == "type.tif" else np.float32)
        path = write_tif(tmp_path / name, values, crs, affine)
        with pytest.raises(MapError, match=wanted) as caught, open_heights([path, *rest]):
            pass
        (line,) = caught.value.problems
        assert path.name in line
        assert "1 of 9 files" in line


def test_a_tile_in_another_unit_is_named_with_both_units(tmp_path):
    paths = []
    for n, unit in enumerate(("[m]", "[K]", "[m]")):
        ones = np.ones((1, SIDE, SIDE), np.float32)
        paths.append(write_tif(tmp_path / f"{n}.tif", ones, "EPSG:32633", corner(n * SIDE, 0)))
        with rasterio.open(paths[-1], "r+") as dataset:
            dataset.units = [unit]
    with geotiff.keep_open() as open_file, pytest.raises(MapError, match=r"\[K\]\), expected .*\[m\]\)\): .*1\.tif"):
        open_raster(paths, "soil", "numbers", open_file)


def test_a_damaged_tile_is_named_by_its_own_rows(tmp_path):
    paths = tiles(tmp_path)["height"]
    whole = paths[4].read_bytes()
    with open_heights(paths) as raster:
        paths[4].write_bytes(whole[:3000])
        with pytest.raises(MapError, match=r"t_1_1.tif: .*damaged"):
            raster.read(0, raster.georeference.rows, 0, raster.georeference.cols)
