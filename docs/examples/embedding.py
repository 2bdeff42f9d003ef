"""Write an embedding of an orthophoto as a raster of many bands: python embedding.py ORTHO.tif EMBEDDING.tif."""

import sys

import numpy as np
import rasterio
from rasterio import Affine

STEP = 5  # pixels of the orthophoto in one pixel of the embedding


def encode(windows):
    """Your model: windows (N, STEP, STEP, 3) in [0, 1] to vectors (N, bands)."""
    texture = [np.abs(np.diff(windows, axis=axis)).mean(axis=(1, 2)) for axis in (1, 2)]
    return np.concatenate([windows.mean(axis=(1, 2)), windows.std(axis=(1, 2)), *texture], axis=1)


source, target = sys.argv[1:]
with rasterio.open(source) as ortho:
    rows, cols = ortho.height // STEP, ortho.width // STEP
    bands = []
    for row in range(rows):
        window = ((row * STEP, (row + 1) * STEP), (0, cols * STEP))
        strip = ortho.read((1, 2, 3), window=window) / 255.0
        vectors = encode(strip.reshape(3, STEP, cols, STEP).transpose(2, 1, 3, 0))
        seen = ortho.dataset_mask(window=window).reshape(STEP, cols, STEP).all(axis=(0, 2))
        bands.append(np.where(seen, vectors.T, np.nan))
    transform = ortho.transform * Affine.scale(STEP)
    profile = {"driver": "GTiff", "crs": ortho.crs, "transform": transform, "height": rows, "width": cols}
values = np.stack(bands, axis=1).astype(np.float32)
with rasterio.open(target, "w", count=len(values), dtype="float32", nbits=16, nodata=np.nan, **profile) as out:
    out.write(values)
