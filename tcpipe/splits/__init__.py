"""Who trains and who tests: regions with a buffer, holdouts by rank of a hash, row order, and the leakage audit.

Everything here works on arrays in one metric plane (the map's projected CRS); lon/lat is projected by the caller.
"""
