"""A model that is a plain function."""

import numpy as np


def predict(patches, features):
    velocity = np.full(len(patches), 0.8)
    power = 60.0 + velocity * (90.0 + 400.0 * np.tan(features.slope_rad))
    return np.column_stack([power, velocity])
