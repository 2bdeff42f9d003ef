"""A model of scikit-learn, kept as its coefficients."""

import numpy as np
from sklearn.linear_model import Ridge


class RidgeModel:
    features = ("turn_radpm",)  # planning then asks for turns, and adds no cost of turning

    def __init__(self, weights, offset):
        self.weights, self.offset = weights, offset

    @staticmethod
    def describe(patches, features):
        turn = np.nan_to_num(features.turn_radpm)  # NaN in datasets without it
        roughness = patches.std(axis=(1, 2))
        return np.column_stack([features.slope_rad, np.abs(features.slope_rad), turn, roughness])

    @classmethod
    def fit(cls, samples):
        ridge = Ridge(1e-3).fit(cls.describe(samples.patches, samples.features), samples.labels)
        return cls(ridge.coef_, ridge.intercept_)

    def predict(self, patches, features):
        return self.describe(patches, features) @ self.weights.T + self.offset

    def to_arrays(self):
        return {"weights": self.weights, "offset": self.offset}

    @classmethod
    def from_arrays(cls, arrays, inputs):
        return cls(arrays["weights"], arrays["offset"])
