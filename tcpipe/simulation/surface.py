"""What the ground of a class is like from metre to metre: wet or dry, high or short, even or rough; what shows it, and what it costs.

Three states vary smoothly over the site, each spread evenly over -1 … 1. Wetness darkens, and makes soil yield. Cover (grass that is
high, gravel that is loose, asphalt that is worn) is texture in the orthophoto, and resists. Roughness is bumps every way and ridges
one way, in the height raster; what they cost depends on how a wheel meets them (`tcpipe.simulation.wheels`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.simulation.random_fields import Wave, evaluate_field, state
from tcpipe.simulation.site import Float


@dataclass(frozen=True, slots=True)
class SurfaceEffect:
    """What the states do to one class of ground, where they are 1; where they are -1 the opposite."""

    wet_shade: float = 0.0
    """Brightness taken away, as a fraction."""
    wet_resistance: float = 0.0
    """Rolling resistance added, as a fraction; so with cover."""
    cover_resistance: float = 0.0
    grain: float = 0.0
    """Deviation of the brightness from pixel to pixel where cover is 0, as a fraction."""
    bump_m: float = 0.0
    """Deviation of the height by bumps where roughness is 0; so with ridges."""
    ridge_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Surface:
    """The states of a site's ground; the waves of each have a deviation of 1 together."""

    looks: dict[int, SurfaceEffect]
    """By class id; a class that is not named has none."""
    wetness: tuple[Wave, ...]
    cover: tuple[Wave, ...]
    roughness: tuple[Wave, ...]
    grain: tuple[Wave, ...]
    bumps: tuple[Wave, ...]
    ridges: tuple[Wave, ...]
    noise: tuple[Wave, ...]
    map_noise_std_m: float
    """Of the height raster, which costs nothing."""
    swing: float
    """By how much grain, bumps and ridges grow where their state is 1, as a fraction."""

    def shade(self, classes: NDArray[np.uint8], u: Float, v: Float) -> Float:
        """Return what the brightness is multiplied with, at offsets from the site's corner [m]."""
        grain = 1.0 + self.swing * state(self.cover, u, v)
        grain *= self._by_class("grain")[classes] * evaluate_field(self.grain, u, v)
        return np.asarray((1.0 - self._by_class("wet_shade")[classes] * state(self.wetness, u, v)) * (1.0 + grain))

    def resistance(self, classes: NDArray[np.uint8], u: Float, v: Float) -> Float:
        """Return the rolling resistance that is added, as a fraction of the class's."""
        wet = self._by_class("wet_resistance")[classes] * state(self.wetness, u, v)
        return np.asarray(wet + self._by_class("cover_resistance")[classes] * state(self.cover, u, v))

    def relief_m(self, classes: NDArray[np.uint8], u: Float, v: Float) -> Float:
        """Return the height of bumps and ridges [m]."""
        relief = self._by_class("bump_m")[classes] * evaluate_field(self.bumps, u, v)
        relief += self._by_class("ridge_m")[classes] * evaluate_field(self.ridges, u, v)
        return np.asarray(relief * (1.0 + self.swing * state(self.roughness, u, v)))

    def map_noise_m(self, u: Float, v: Float) -> Float:
        """Return what the height raster errs by [m]."""
        return self.map_noise_std_m * evaluate_field(self.noise, u, v)

    def _by_class(self, name: str) -> Float:
        """Return one number of every class's look, by class id."""
        table = np.zeros(256)
        table[list(self.looks)] = [getattr(look, name) for look in self.looks.values()]
        return table
