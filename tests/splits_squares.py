"""Footprints for tests of the splits."""

import numpy as np


def squares(centres_xy_m, course_rad=0.0, side_m=1.0):
    """Corners of squares around the centres, turned by course, shape (N, 4, 2)."""
    centres = np.atleast_2d(np.asarray(centres_xy_m, dtype=float))
    course = np.broadcast_to(np.asarray(course_rad, dtype=float), len(centres))
    half = side_m / 2
    local = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    cos, sin = np.cos(course)[:, None], np.sin(course)[:, None]
    x = centres[:, :1] + local[:, 0] * cos - local[:, 1] * sin
    y = centres[:, 1:] + local[:, 0] * sin + local[:, 1] * cos
    return np.stack([x, y], axis=-1)
