"""Write the meadow of site-a as OpenDroneMap and QGIS write a survey (docs/tutorials/drone-map.md)."""

import json
from pathlib import Path

import numpy as np
import rasterio
from pyproj import Transformer


def as_odm(source, target, **profile):
    Path(target).parent.mkdir(parents=True, exist_ok=True)
    with rasterio.open(source) as raster:
        profile = {
            "driver": "GTiff",
            "width": raster.width,
            "height": raster.height,
            "crs": raster.crs,
            "transform": raster.transform,
            **profile,
        }
        with rasterio.open(
            target, "w", count=raster.count, compress="lzw", tiled=True, blockxsize=256, blockysize=256, **profile
        ) as out:
            out.write(raster.read())
            out.colorinterp = raster.colorinterp


as_odm("../site-a/field/maps/height.tif", "odm_dem/dsm.tif", dtype="float32", nodata=-9999)
as_odm("../site-a/field/maps/ortho.tif", "odm_orthophoto/odm_orthophoto.tif", dtype="uint8")
to_wgs84 = Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True)


def polygon(name, *corners):
    ring = [to_wgs84.transform(697600 + x, 5208400 + y) for x, y in (*corners, corners[0])]
    return {"type": "Feature", "properties": {"class": name}, "geometry": {"type": "Polygon", "coordinates": [ring]}}


def round_place(name, x, y, radius):
    return polygon(
        name, *((x + radius * np.cos(a), y + radius * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 12, endpoint=False))
    )


drawn = [
    polygon("grass", (0, 2.5), (120, 2.5), (120, 76.5), (0, 76.5)),
    polygon(
        "paved road",
        (0, 16),
        (16, 14),
        (34, 15.5),
        (58, 25),
        (72, 29),
        (96, 25),
        (120, 26),
        (120, 30.5),
        (96, 29.5),
        (72, 33.5),
        (58, 29.5),
        (34, 20),
        (16, 18.5),
        (0, 20.5),
    ),
    polygon(
        "unpaved road",
        (51, 0),
        (57, 13),
        (59, 26),
        (59, 44),
        (61, 58),
        (66, 70),
        (71, 80),
        (75, 80),
        (70, 68),
        (65, 57),
        (63, 44),
        (63, 26),
        (61, 13),
        (55, 0),
    ),
    round_place("mud", 22, 22, 6),
    round_place("mud", 100, 48, 7),
    round_place("mud", 50, 66, 5),
    round_place("vegetation", 9, 70, 7),
    round_place("vegetation", 112, 12, 7),
    round_place("tree", 74, 52, 2.5),
    round_place("tree", 40, 36, 2.5),
]
Path("terrain.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": drawn}))
