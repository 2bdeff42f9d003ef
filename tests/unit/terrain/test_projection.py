"""The geoid's height at a place, from a grid of PROJ."""

import subprocess
import sys

import numpy as np
import pytest
import rasterio
from map_worlds import write_tif
from rasterio import Affine


def test_the_geoid_is_known_where_proj_has_its_grid(tmp_path):
    """A grid under the name of EGM96's, 54 m at the north pole, 36 m at the south pole; in another process, as PROJ keeps it."""
    values = np.linspace(54.0, 36.0, 181, dtype=np.float32)[:, None].repeat(361, axis=1)[None]
    path = write_tif(tmp_path / "us_nga_egm96_15.tif", values, "EPSG:4326", Affine(1.0, 0.0, -180.5, 0.0, -1.0, 90.5))
    with rasterio.open(path, "r+") as grid:
        grid.update_tags(AREA_OR_POINT="Point", TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL")
        grid.set_band_unit(1, "metre")
        grid.set_band_description(1, "geoid_undulation")
    code = (
        "import sys, pyproj; pyproj.datadir.append_data_dir(sys.argv[1])\n"
        "from tcpipe.terrain.projection import compute_geoid_height\n"
        "print(compute_geoid_height(15.4, 47.0))"
    )
    said = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True, capture_output=True, text=True)
    assert float(said.stdout) == pytest.approx(45.0 + 47.0 * 0.1, abs=1e-3)
