"""Geometry of the plane and the globe in numpy alone: angles, rotations, datums, polylines."""
