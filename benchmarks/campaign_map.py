"""The campaign's one cell that is a map's: a height raster in a CRS of US survey feet, its heights in feet, and no word of that unit.

A tiny drive is ingested and a dataset built on the map. Right is a refusal, or a word about feet, or slopes that are
true all the same.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio
from campaign_drives import said_of
from rasterio import Affine

from tcpipe import add_map, build_dataset, ingest, open_dataset
from tcpipe.errors import TcpipeError
from tcpipe.simulation import Faults, make_tiny, read_truth, simulate
from tcpipe.simulation.scenarios import RasterSpec
from tcpipe.simulation.world import World
from tcpipe.tables.columns import to_floats, to_integers

NAME = "map: heights in feet"
_FOOT_M = 1200.0 / 3937.0
_FEET = "+proj=utm +zone=33 +datum=WGS84 +units=us-ft"
_PITCH_FT = 1.0


@dataclass(frozen=True)
class MapResult:
    """Messages, whether there is no dataset, and the RMS error of its slopes [deg]."""

    said: list[str]
    refused: bool
    slope_rms_deg: float

    @property
    def failures(self) -> list[str]:
        """Return what differs from the expectation."""
        told = self.refused or any(re.search(r"\b(feet|foot)\b|map-height-scale", line) for line in self.said)
        return [] if told or self.slope_rms_deg < 2.0 else [f"slopes {self.slope_rms_deg:.0f} deg off, feet not named"]


def map_in_feet(*, in_feet: bool = True) -> MapResult:
    """Add the map, build a dataset on it, and compare its slopes; the other way round the raster's heights are metres and say so."""
    scenario = replace(make_tiny(Faults.every(), seconds=60.0), rasters=RasterSpec(0.3, 0.3, 0.3))
    with tempfile.TemporaryDirectory() as folder:
        site = simulate(Path(folder) / "site", scenario=scenario, seed=1)
        store, height = Path(folder) / "store", site.rasters["height"]
        if in_feet:
            height = _write_feet(Path(folder) / "dem.tif", scenario.world)
        said = [line for result in ingest(site.logs, store=store).results for line in said_of(result.findings)]
        try:
            added = add_map("site", height=height, store=store)
            built = build_dataset(Path(folder) / "dataset", store=store)
        except TcpipeError as error:
            return MapResult([*said, *error.problems], True, float("nan"))
        truth = read_truth(site.truths[0])
        samples = open_dataset(built.path)["train"].samples
        true_rad = truth.at(to_integers(samples, "start_ns")).slope_rad
        off = np.degrees(to_floats(samples, "slope_rad") - true_rad)
        said += [*str(added).splitlines()[1:], *str(built).splitlines()[1:]]  # the first lines hold paths
        return MapResult(said, False, float(np.sqrt(np.mean(off**2))) if off.size else float("nan"))


def _write_feet(path: Path, world: World) -> Path:
    """Write the world's heights in feet on a grid of feet."""
    site = world.site
    cols, rows = (int(size_m / _FOOT_M / _PITCH_FT) for size_m in (site.width_m, site.height_m))
    west_ft, north_ft = site.west_m / _FOOT_M, (site.south_m + site.height_m) / _FOOT_M
    x_ft = west_ft + (np.arange(cols) + 0.5) * _PITCH_FT
    y_ft = north_ft - (np.arange(rows) + 0.5) * _PITCH_FT
    height_ft = world.height_m(x_ft[None, :] * _FOOT_M, y_ft[:, None] * _FOOT_M) / _FOOT_M
    where = Affine(_PITCH_FT, 0.0, west_ft, 0.0, -_PITCH_FT, north_ft)
    options = {"driver": "GTiff", "count": 1, "dtype": "float32", "crs": _FEET, "transform": where}
    with rasterio.open(path, "w", height=rows, width=cols, **options) as raster:
        raster.write(height_ft.astype(np.float32), 1)
    return path
