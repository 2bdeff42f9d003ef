"""A world that is known exactly at every point: height, slope, terrain class, colour.

Height is a sum of smooth hills and waves, classes are bands (roads) and ellipses (mud, trees, a pond) on grass, colour follows the class
with soft borders and a band-limited texture. Every function takes map coordinates of any shapes that broadcast; hills are separable,
so that a raster costs an outer product.

Classes are the ids of `tcpipe.terrain.classes.PAPER_CLASSES`; the last four are traversable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tcpipe.simulation.random_fields import Wave, sum_waves
from tcpipe.simulation.site import Float, Site
from tcpipe.simulation.surface import Surface
from tcpipe.tables.facts import ABSENT

OBSTACLE, TREE, VEGETATION, GRASS, MUD, UNPAVED, PAVED = range(1, 8)

_COLOUR = np.array(
    [
        [0, 0, 0],
        [120, 60, 56],
        [32, 52, 30],
        [58, 84, 44],
        [96, 134, 62],
        [104, 82, 58],
        [168, 150, 122],
        [122, 124, 128],
    ],
    dtype=np.float64,
)
"""RGB by class id; 0 is nothing."""

_SOFT_BORDER_M = 0.3


@dataclass(frozen=True, slots=True)
class Hill:
    """A Gaussian bump; lengths along the map's axes, position from the site's south-west corner."""

    x_m: float
    y_m: float
    height_m: float
    x_sigma_m: float
    y_sigma_m: float


@dataclass(frozen=True, slots=True)
class Ellipse:
    """An ellipse, from the site's south-west corner."""

    class_id: int
    x_m: float
    y_m: float
    x_radius_m: float
    y_radius_m: float
    rotation_rad: float = 0.0

    def depth_m(self, u: Float, v: Float) -> Float:
        """Return the depth inside, as the protocol says."""
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        a = (c * (u - self.x_m) + s * (v - self.y_m)) / self.x_radius_m
        b = (c * (v - self.y_m) - s * (u - self.x_m)) / self.y_radius_m
        return np.asarray((1.0 - np.hypot(a, b)) * min(self.x_radius_m, self.y_radius_m))

    def may_touch(self, box: tuple[float, float, float, float]) -> bool:
        """Compare the circumscribed circle with the box."""
        reach = max(self.x_radius_m, self.y_radius_m) * (1.0 + 1.0 / min(self.x_radius_m, self.y_radius_m))
        return box[0] - reach < self.x_m < box[2] + reach and box[1] - reach < self.y_m < box[3] + reach


@dataclass(frozen=True, slots=True)
class Band:
    """A road: a band of constant width about a sine whose axis runs through (x, y)."""

    class_id: int
    x_m: float
    y_m: float
    direction_rad: float
    width_m: float
    amplitude_m: float = 0.0
    wavelength_m: float = 60.0
    phase_rad: float = 0.0

    def depth_m(self, u: Float, v: Float) -> Float:
        """Return the depth inside, as the protocol says."""
        c, s = np.cos(self.direction_rad), np.sin(self.direction_rad)
        along, across = c * (u - self.x_m) + s * (v - self.y_m), c * (v - self.y_m) - s * (u - self.x_m)
        k = 2.0 * np.pi / self.wavelength_m
        angle = k * along + self.phase_rad
        offset = across - self.amplitude_m * np.sin(angle)
        return np.asarray(self.width_m / 2.0 - np.abs(offset) / np.hypot(1.0, self.amplitude_m * k * np.cos(angle)))

    def may_touch(self, box: tuple[float, float, float, float]) -> bool:
        """Compare the straight strip that holds the band with the box."""
        c, s = np.cos(self.direction_rad), np.sin(self.direction_rad)
        u, v = (box[0] + box[2]) / 2 - self.x_m, (box[1] + box[3]) / 2 - self.y_m
        reach = abs(s) * (box[2] - box[0]) / 2 + abs(c) * (box[3] - box[1]) / 2
        stretch = np.hypot(1.0, self.amplitude_m * 2.0 * np.pi / self.wavelength_m)
        return bool(abs(c * v - s * u) < reach + abs(self.amplitude_m) + (self.width_m / 2 + 1.0) * stretch)


@dataclass(frozen=True, slots=True)
class World:
    """The ground truth of a site. Lengths of its parts are map metres from the site's south-west corner."""

    site: Site
    base_m: float
    """Height above the geoid without hills [m]."""
    hills: tuple[Hill, ...] = ()
    waves: tuple[Wave, ...] = ()
    """Ripples of the height [m]."""
    regions: tuple[Ellipse | Band, ...] = ()
    """Later ones lie on earlier ones; the rest is grass."""
    holes: tuple[Ellipse, ...] = ()
    """Where the rasters hold nothing (the white areas of the paper's figure 1)."""
    texture: tuple[Wave, ...] = ()
    """Ripples of the brightness, as a fraction."""
    resistance: tuple[Wave, ...] = field(default=())
    """Ripples of the rolling resistance that no map shows, as a fraction."""
    surface: Surface | None = field(default=None, metadata=ABSENT)
    """What the ground of a class is like from metre to metre; None: everywhere the same."""
    sun: tuple[float, float, float] | None = field(default=None, metadata=ABSENT)
    """Unit vector east, north, up to the sun that the orthophoto was taken in; None: under an even sky."""

    def height_m(self, x_map_m: Float, y_map_m: Float) -> Float:
        """Return the height above the geoid [m]."""
        u, v = x_map_m - self.site.west_m, y_map_m - self.site.south_m
        total = np.full(np.broadcast_shapes(np.shape(u), np.shape(v)), self.base_m)
        for hill in self.hills:
            total += (
                hill.height_m
                * _evaluate_bell(u - hill.x_m, hill.x_sigma_m)
                * _evaluate_bell(v - hill.y_m, hill.y_sigma_m)
            )
        return total + sum_waves(self.waves, u, v)

    def mapped_height_m(self, x_map_m: Float, y_map_m: Float) -> Float:
        """Return the height that a raster holds: with bumps and ridges, which wheels feel and the pose does not, and the map's noise."""
        height = self.height_m(x_map_m, y_map_m)
        if self.surface is None:
            return height
        u, v = x_map_m - self.site.west_m, y_map_m - self.site.south_m
        classes = self.terrain_class(x_map_m, y_map_m)
        return height + self.surface.relief_m(classes, u, v) + self.surface.map_noise_m(u, v)

    def gradient(self, x_map_m: Float, y_map_m: Float) -> tuple[Float, Float]:
        """Return the rise per map metre along the map's x and y."""
        u, v = x_map_m - self.site.west_m, y_map_m - self.site.south_m
        gx, gy = np.zeros(np.broadcast_shapes(np.shape(u), np.shape(v))), np.zeros(())
        for hill in self.hills:
            bump = (
                hill.height_m
                * _evaluate_bell(u - hill.x_m, hill.x_sigma_m)
                * _evaluate_bell(v - hill.y_m, hill.y_sigma_m)
            )
            gx = gx - bump * (u - hill.x_m) / hill.x_sigma_m**2
            gy = gy - bump * (v - hill.y_m) / hill.y_sigma_m**2
        for wave in self.waves:
            k = 2.0 * np.pi / wave.wavelength_m
            kx, ky = k * np.cos(wave.direction_rad), k * np.sin(wave.direction_rad)
            rise = wave.amplitude * np.cos(kx * u + ky * v + wave.phase_rad)
            gx, gy = gx + kx * rise, gy + ky * rise
        return gx, gy

    def terrain_class(self, x_map_m: Float, y_map_m: Float) -> NDArray[np.uint8]:
        """Return the class id, everywhere (the holes of the rasters do not matter here)."""
        u, v = x_map_m - self.site.west_m, y_map_m - self.site.south_m
        classes = np.full(np.broadcast_shapes(np.shape(u), np.shape(v)), GRASS, dtype=np.uint8)
        for region in self._near(self.regions, u, v):
            classes[region.depth_m(u, v) > 0.0] = region.class_id
        return classes

    def ortho(self, x_map_m: Float, y_map_m: Float) -> Float:
        """Return red, green, blue in 0 … 255, last axis; classes blend over 0.3 m at their borders."""
        u, v = x_map_m - self.site.west_m, y_map_m - self.site.south_m
        rgb = np.broadcast_to(_COLOUR[GRASS], (*np.broadcast_shapes(np.shape(u), np.shape(v)), 3)).copy()
        for region in self._near(self.regions, u, v):
            share = np.clip(region.depth_m(u, v) / _SOFT_BORDER_M + 0.5, 0.0, 1.0)
            share = (share * share * (3.0 - 2.0 * share))[..., None]
            rgb += share * (_COLOUR[region.class_id] - rgb)
        shade = 1.0 + sum_waves(self.texture, u, v)
        if self.surface is not None:
            shade = shade * self.surface.shade(self.terrain_class(x_map_m, y_map_m), u, v)
        if self.sun is not None:
            gx, gy = self.gradient(x_map_m, y_map_m)
            east, north, up = self.sun
            shade = shade * np.maximum(1.0 - (east * gx + north * gy) / up, 0.0) / np.sqrt(1.0 + gx**2 + gy**2)
        return rgb * shade[..., None]

    def mapped(self, x_map_m: Float, y_map_m: Float) -> NDArray[np.bool_]:
        """Return whether the rasters hold data here."""
        u, v = x_map_m - self.site.west_m, y_map_m - self.site.south_m
        inside = (u >= 0) & (u <= self.site.width_m) & (v >= 0) & (v <= self.site.height_m)
        for hole in self._near(self.holes, u, v):
            inside = inside & (hole.depth_m(u, v) <= 0.0)
        return inside

    def resistance_factor(self, x_map_m: Float, y_map_m: Float) -> Float:
        """Return what the class's rolling resistance is multiplied with here: what the orthophoto shows, and what nothing does."""
        u, v = x_map_m - self.site.west_m, y_map_m - self.site.south_m
        hidden = sum_waves(self.resistance, u, v)
        if self.surface is None:
            return 1.0 + hidden
        return 1.0 + hidden + self.surface.resistance(self.terrain_class(x_map_m, y_map_m), u, v)

    @staticmethod
    def _near(regions: Sequence[Ellipse | Band], u: Float, v: Float) -> Sequence[Ellipse | Band]:
        box = (
            (float(np.min(u)), float(np.min(v)), float(np.max(u)), float(np.max(v)))
            if np.size(u) and np.size(v)
            else None
        )
        return [region for region in regions if box is not None and region.may_touch(box)]


def _evaluate_bell(offset_m: Float, sigma_m: float) -> Float:
    return np.exp(-0.5 * (offset_m / sigma_m) ** 2)
