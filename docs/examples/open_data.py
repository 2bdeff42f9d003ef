"""Write the newest rasters of a STAC API around a track as one GeoTIFF: open_data.py API COLLECTION TRACK.parquet OUT.tif [ASSET]."""

import sys

import pyarrow.parquet as pq
import rasterio
from pystac_client import Client
from rasterio.merge import merge
from rasterio.warp import transform_bounds

MARGIN_DEG = 0.0005
api, collection, track, out, *asset = sys.argv[1:]
table = pq.read_table(track, columns=["lon_deg", "lat_deg"]).drop_null()
lon, lat = (table.column(name).to_numpy() for name in ("lon_deg", "lat_deg"))
west, south, east, north = (
    lon.min() - MARGIN_DEG,
    lat.min() - MARGIN_DEG,
    lon.max() + MARGIN_DEG,
    lat.max() + MARGIN_DEG,
)
found = Client.open(api).search(collections=[collection], bbox=(west, south, east, north)).items()
newest_first = sorted(found, key=lambda item: item.properties.get("datetime") or "", reverse=True)
assets = [of for item in newest_first for name, of in item.assets.items() if [name] == asset or not asset]
rasters = [rasterio.open(of.href) for of in assets if str(of.media_type).startswith("image/tiff")]
bounds = transform_bounds("EPSG:4326", rasters[0].crs, west, south, east, north)
merge(rasters, bounds=bounds, dst_path=out)  # where they overlap, the first
