"""docs/examples/open_data.py writes the file that add-map takes; where pystac-client is absent, a module of its name answers here."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import rasterio
from map_worlds import write_tif
from rasterio import Affine
from rasterio.warp import transform

from tcpipe import add_map

SCRIPT = Path(__file__).parents[2] / "docs" / "examples" / "open_data.py"
STAND_IN = """
from types import SimpleNamespace as Record

class Client:
    @classmethod
    def open(cls, api):
        assert api == "https://stac.example.org/v1"
        return cls()

    def search(self, collections, bbox):
        assert collections == ["terrain"] and bbox[0] < bbox[2] and bbox[1] < bbox[3]
        return self

    def items(self):
        for name, date in (("old", "2019-05-01"), ("new", "2024-05-01")):
            picture = Record(media_type="image/png", href="no.png")
            raster = Record(media_type="image/tiff; application=geotiff", href=f"{name}.tif")
            yield Record(properties={"datetime": date}, assets={"preview": picture, "dem": raster})
"""


def test_the_newest_heights_around_a_track_become_a_file_that_add_map_takes(tmp_path: Path) -> None:
    (tmp_path / "pystac_client.py").write_text(STAND_IN)
    corner = Affine(1.0, 0.0, 500_000.0, 0.0, -1.0, 5_200_400.0)
    write_tif(tmp_path / "old.tif", np.full((1, 400, 400), 500.0, np.float32), "EPSG:32633", corner, nodata=-9999.0)
    half = np.full((1, 400, 200), 600.0, np.float32)
    write_tif(tmp_path / "new.tif", half, "EPSG:32633", corner, nodata=-9999.0)
    lonlat = transform("EPSG:32633", "EPSG:4326", [500_150.0, 500_250.0], [5_200_200.0] * 2)
    pq.write_table(pa.table(dict(zip(("lon_deg", "lat_deg"), lonlat, strict=True))), tmp_path / "track.parquet")
    call = [sys.executable, SCRIPT, "https://stac.example.org/v1", "terrain", "track.parquet", "dem.tif"]
    subprocess.run(call, cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)}, check=True)
    with rasterio.open(tmp_path / "dem.tif") as raster:
        found = raster.read(1)
        at = [raster.index(x, 5_200_200.0) for x in (500_150.0, 500_250.0)]
    assert [found[row, column] for row, column in at] == [600.0, 500.0], "the newest where there is one"
    assert found.shape[1] < 300, "only what lies around the track"
    assert add_map("site", height=tmp_path / "dem.tif", store=tmp_path / "store").map.height_max_m == 600.0
