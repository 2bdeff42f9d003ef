"""GeoTIFFs that are written: what other readers find in them."""

import logging
import resource

import numpy as np
import pytest
import rasterio

from tcpipe.errors import StoreError
from tcpipe.formats.maps.geotiff import write_cog, write_geotiff
from tcpipe.terrain.target_grid import MapGrid


def test_a_palette_is_written_before_the_pixels_and_gdal_has_nothing_to_say(tmp_path, caplog):
    """Larger than GDAL's cache, so that pixels are on disk before the last strip."""
    side, palette = 1500, {1: (10, 20, 30), 7: (70, 80, 90)}
    pixels = np.random.default_rng(0).integers(0, 8, (1, side, side), dtype=np.uint8)
    with caplog.at_level(logging.INFO, "rasterio"), rasterio.Env(GDAL_CACHEMAX=1):
        write_geotiff(
            tmp_path / "terrain.tif",
            lambda first, last: pixels[:, first:last],
            MapGrid("EPSG:32633", 500_000.0, 5_200_000.0, 0.05, side, side),
            dtype="uint8",
            nodata=0,
            palette=palette,
        )
    assert caplog.messages == []
    with rasterio.open(tmp_path / "terrain.tif") as dataset:
        assert dataset.colorinterp == (rasterio.enums.ColorInterp.palette,)
        assert {value: dataset.colormap(1)[value][:3] for value in palette} == palette
        assert dataset.xy(0, 0) == (500_000.025, 5_199_999.975)
        np.testing.assert_array_equal(dataset.read(), pixels)


@pytest.mark.parametrize("lacking", [1, 300, 20_000, 200_000, 1_000_000])
@pytest.mark.parametrize("kind", ["plain", "cog"])
def test_a_disk_that_is_full_is_one_error_that_names_the_output_and_nothing_is_left(tmp_path, kind, lacking):
    """GDAL closes a file of which the end is missing without a word."""
    side = 600
    pixels = np.random.default_rng(0).random((1, side, side), dtype=np.float32)
    grid = MapGrid("EPSG:32633", 500_000.0, 5_200_000.0, 0.05, side, side)

    def write(path):
        if kind == "plain":
            write_geotiff(path, lambda first, last: pixels[:, first:last], grid, dtype="float32")
        else:
            write_cog(path, lambda first, last: pixels[:, first:last], grid, dtype="float32", bands=[("cost", "J")])

    write(tmp_path / "whole.tif")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((tmp_path / "whole.tif").stat().st_size - lacking, before[1]))
    try:
        with pytest.raises(StoreError, match=r"cost\.tif: cannot be written"):
            write(tmp_path / "cost.tif")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [path.name for path in tmp_path.iterdir()] == ["whole.tif"]
