"""Splits: regions with a buffer, holdouts by rank of a hash, row order, and the leakage audit, in the map's plane."""
