"""Angles live on a circle."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def wrap_to_pi(angle_rad: ArrayLike) -> NDArray[np.float64]:
    """Return the same directions in [-pi, pi).

    Parameters
    ----------
    angle_rad : [rad], any shape.

    Returns
    -------
    [rad], the same shape; what is not finite stays so.
    """
    angle = np.asarray(angle_rad, np.float64)
    wrapped = angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))
    # Rounding may land on +pi itself, or a hair below -pi.
    return np.maximum(np.where(wrapped >= np.pi, -np.pi, wrapped), -np.pi)
