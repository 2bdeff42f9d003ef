"""Maps on disk: the rasters and polygons that people have, and the one grid of Zarr arrays that is made of them."""
