"""A world known exactly at every point: position on Earth, height, slope, terrain class, colour, and cost of ground.

Height is a sum of smooth hills and waves, classes are bands (roads) and ellipses (mud, trees, a pond) on grass, colour
follows the class with soft borders and a band-limited texture. Every function takes map coordinates of any shapes that
broadcast; hills are separable, so that a raster costs an outer product. Classes are the ids of
`tcpipe.terrain.layers.PAPER_CLASSES`; the last four are traversable.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field
from functools import cached_property

import numpy as np
from pyproj import Transformer
from scipy.special import erf

from tcpipe.arrays import Box, Bytes, Floats, Mask
from tcpipe.tables.findings import omit

_SEMI_MAJOR_M = 6378137.0
_ECCENTRICITY2 = 0.0066943799901413165
_STEP_M = 10.0


@dataclass(frozen=True)
class Site:
    """A rectangle of a projected CRS, and the height of the geoid over the ellipsoid there.

    A map metre differs from a ground metre, and grid north from true north: both follow from differences of pyproj's
    projection, without any formula of the pipeline, so that the truth is independent of it.

    The default site is at 17.6° E, 47° N in UTM zone 33, where grid north is 1.9° off true north.
    """

    epsg: int = 32633
    west_m: float = 697600.0
    south_m: float = 5208400.0
    width_m: float = 120.0
    height_m: float = 80.0
    geoid_m: float = 45.7

    @cached_property
    def _to_wgs84(self) -> Transformer:
        return Transformer.from_crs(f"EPSG:{self.epsg}", "EPSG:4326", always_xy=True)

    @cached_property
    def datum(self) -> tuple[float, float, float]:
        """Origin of the local plane: longitude, latitude [deg], ellipsoidal height [m] (middle of the site, geoid)."""
        lon, lat = self._to_wgs84.transform(self.west_m + self.width_m / 2, self.south_m + self.height_m / 2)
        return float(lon), float(lat), self.geoid_m

    @cached_property
    def _to_enu(self) -> Transformer:
        lon, lat, alt = self.datum
        steps = (
            "+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
            f"+lon_0={lon!r} +lat_0={lat!r} +h_0={alt!r}"
        )
        return Transformer.from_pipeline(f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad {steps}")

    def uv_m(self, x_map_m: Floats, y_map_m: Floats) -> tuple[Floats, Floats]:
        """Return map coordinates [m] counted from the south-west corner."""
        return x_map_m - self.west_m, y_map_m - self.south_m

    def lonlat_deg(self, x_map_m: Floats, y_map_m: Floats) -> tuple[Floats, Floats]:
        """Return longitude and latitude [deg] of map coordinates [m]."""
        lon, lat = self._to_wgs84.transform(x_map_m, y_map_m)
        return np.asarray(lon), np.asarray(lat)

    def map_xy_m(self, lon_deg: Floats, lat_deg: Floats) -> tuple[Floats, Floats]:
        """Return map coordinates [m] of longitude and latitude [deg]."""
        x, y = self._to_wgs84.transform(lon_deg, lat_deg, direction="INVERSE")
        return np.asarray(x), np.asarray(y)

    def enu_m(self, lon_deg: Floats, lat_deg: Floats, alt_m: Floats) -> Floats:
        """Return east, north, up of the datum [m], shape (N, 3)."""
        return np.stack(self._to_enu.transform(lon_deg, lat_deg, alt_m), axis=-1)

    def lonlatalt(self, enu_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Return longitude, latitude [deg] and ellipsoidal height [m] of points of the local plane, shape (N, 3)."""
        lon, lat, alt = self._to_enu.transform(enu_m[..., 0], enu_m[..., 1], enu_m[..., 2], direction="INVERSE")
        return np.asarray(lon), np.asarray(lat), np.asarray(alt)

    def ground_from_map(self, x_map_m: Floats, y_map_m: Floats, alt_m: Floats) -> tuple[Floats, Floats]:
        """Return horizontal metres at height ``alt_m`` per map metre, and the map's x axis from true east [rad]."""
        lon0, lat0 = self.lonlat_deg(x_map_m - _STEP_M / 2, y_map_m)
        lon1, lat1 = self.lonlat_deg(x_map_m + _STEP_M / 2, y_map_m)
        lat = np.radians((lat0 + lat1) / 2)
        curvature = 1.0 - _ECCENTRICITY2 * np.sin(lat) ** 2
        prime_vertical_m = _SEMI_MAJOR_M / np.sqrt(curvature)
        meridian_m = prime_vertical_m * (1.0 - _ECCENTRICITY2) / curvature
        east = np.radians(lon1 - lon0) * (prime_vertical_m + alt_m) * np.cos(lat)
        north = np.radians(lat1 - lat0) * (meridian_m + alt_m)
        return np.hypot(east, north) / _STEP_M, np.arctan2(north, east)


@dataclass(frozen=True, slots=True)
class Wave:
    """A plane wave: amplitude in the unit of its field."""

    amplitude: float
    wavelength_m: float
    direction_rad: float
    phase_rad: float


Waves = tuple[Wave, ...]


def draw_waves(
    seed: int,
    *,
    count: int,
    total: float,
    wavelength_m: tuple[float, float],
    direction_rad: tuple[float, float] = (0.0, np.pi),
) -> Waves:
    """Return plane waves of random direction, phase, log-uniform wavelength; squared amplitudes sum to ``total``²."""
    rng = np.random.default_rng(seed)
    amplitude = total * np.sqrt(2.0 / count)
    ranges = (*np.log(wavelength_m),), direction_rad, (0.0, 2.0 * np.pi)
    drawn = ([float(rng.uniform(*ends)) for ends in ranges] for _ in range(count))
    return tuple(Wave(amplitude, float(np.exp(log_m)), direction, phase) for log_m, direction, phase in drawn)


def sum_waves(waves: Sequence[Wave], u: Floats, v: Floats) -> Floats:
    """Sum the waves; sin(a + b) is expanded, so that row and column vectors meet in outer products only."""
    total = np.zeros(np.broadcast(u, v).shape)
    for wave in waves:
        k = 2.0 * np.pi / wave.wavelength_m
        a = k * np.cos(wave.direction_rad) * u + wave.phase_rad
        b = k * np.sin(wave.direction_rad) * v
        total += wave.amplitude * (np.sin(a) * np.cos(b) + np.cos(a) * np.sin(b))
    return total


def evaluate_field(waves: Sequence[Wave], u: Floats, v: Floats) -> Floats:
    """Sum many waves: a row and a column meet in one product of matrices, anything else wave by wave."""
    if np.ndim(u) == np.ndim(v) == 2 and np.shape(u)[0] == np.shape(v)[1] == 1:
        amplitude, length, direction, phase = np.array([astuple(wave) for wave in waves]).T
        a = 2.0 * np.pi / length * np.cos(direction) * u.T + phase
        b = 2.0 * np.pi / length * np.sin(direction) * v
        return np.asarray((amplitude * np.cos(b)) @ np.sin(a).T + (amplitude * np.sin(b)) @ np.cos(a).T)
    total = np.zeros(np.broadcast(u, v).shape)
    for wave in waves:
        k = 2.0 * np.pi / wave.wavelength_m
        total += wave.amplitude * np.sin(
            k * np.cos(wave.direction_rad) * u + k * np.sin(wave.direction_rad) * v + wave.phase_rad
        )
    return total


def state(waves: Sequence[Wave], u: Floats, v: Floats) -> Floats:
    """Return a field with uniformly distributed values from -1 to 1, from waves whose squares sum to 1."""
    return np.asarray(erf(evaluate_field(waves, u, v) / np.sqrt(2.0)))


@dataclass(frozen=True, slots=True)
class SurfaceEffect:
    """Effects of the states on one class of ground where they are 1; where they are -1, the opposite."""

    wet_shade: float = 0.0  # brightness taken away, as a fraction
    wet_resistance: float = 0.0  # rolling resistance added, as a fraction; so with cover
    cover_resistance: float = 0.0
    grain: float = 0.0  # deviation of the brightness from pixel to pixel where cover is 0, as a fraction
    bump_m: float = 0.0  # deviation of the height by bumps where roughness is 0; so with ridges
    ridge_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Surface:
    """The states of a site's ground; the waves of each have a deviation of 1 together."""

    looks: dict[int, SurfaceEffect]  # by class id; a class that is not named has none
    wetness: Waves
    cover: Waves
    roughness: Waves
    grain: Waves
    bumps: Waves
    ridges: Waves
    noise: Waves
    map_noise_std_m: float  # of the height raster, which costs nothing
    swing: float  # by how much grain, bumps and ridges grow where their state is 1, as a fraction

    def shade(self, classes: Bytes, u: Floats, v: Floats) -> Floats:
        """Return the factor of brightness at offsets from the site's corner [m]."""
        grain = 1.0 + self.swing * state(self.cover, u, v)
        grain *= self._by_class("grain")[classes] * evaluate_field(self.grain, u, v)
        return (1.0 - self._by_class("wet_shade")[classes] * state(self.wetness, u, v)) * (1.0 + grain)

    def resistance(self, classes: Bytes, u: Floats, v: Floats) -> Floats:
        """Return the added rolling resistance, as a fraction of that of the class."""
        wet = self._by_class("wet_resistance")[classes] * state(self.wetness, u, v)
        return wet + self._by_class("cover_resistance")[classes] * state(self.cover, u, v)

    def relief_m(self, classes: Bytes, u: Floats, v: Floats) -> Floats:
        """Return the height of bumps and ridges [m]."""
        relief = self._by_class("bump_m")[classes] * evaluate_field(self.bumps, u, v)
        relief += self._by_class("ridge_m")[classes] * evaluate_field(self.ridges, u, v)
        return relief * (1.0 + self.swing * state(self.roughness, u, v))

    def _by_class(self, name: str) -> Floats:
        """Return a property of the appearance of every class, by class id, shape (256,)."""
        table = np.zeros(256)
        table[list(self.looks)] = [getattr(look, name) for look in self.looks.values()]
        return table


OBSTACLE, TREE, VEGETATION, GRASS, MUD, UNPAVED, PAVED = range(1, 8)

_COLOUR = np.array([
    [0, 0, 0], [120, 60, 56], [32, 52, 30], [58, 84, 44],
    [96, 134, 62], [104, 82, 58], [168, 150, 122], [122, 124, 128],
], dtype=float)  # fmt: skip
"""RGB by class id; 0 is no data."""

_SOFT_BORDER_M = 0.3


@dataclass(frozen=True, slots=True)
class Hill:
    """A Gaussian bump; lengths along the map's axes, position from the site's south-west corner."""

    x_m: float
    y_m: float
    height_m: float
    x_sigma_m: float
    y_sigma_m: float

    def rise_m(self, u: Floats, v: Floats) -> Floats:
        """Return its height there [m]."""
        x, y = (u - self.x_m) / self.x_sigma_m, (v - self.y_m) / self.y_sigma_m
        return self.height_m * np.exp(-0.5 * x**2) * np.exp(-0.5 * y**2)


@dataclass(frozen=True, slots=True)
class Ellipse:
    """An ellipse, from the site's south-west corner."""

    class_id: int
    x_m: float
    y_m: float
    x_radius_m: float
    y_radius_m: float
    rotation_rad: float = 0.0

    def depth_m(self, u: Floats, v: Floats) -> Floats:
        """Return the depth [m] of points inside the border; negative outside."""
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        a = (c * (u - self.x_m) + s * (v - self.y_m)) / self.x_radius_m
        b = (c * (v - self.y_m) - s * (u - self.x_m)) / self.y_radius_m
        return np.asarray((1.0 - np.hypot(a, b)) * min(self.x_radius_m, self.y_radius_m))

    def may_touch(self, box: Box) -> bool:
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

    def depth_m(self, u: Floats, v: Floats) -> Floats:
        """Return the depth [m] of points inside the border; negative outside."""
        c, s = np.cos(self.direction_rad), np.sin(self.direction_rad)
        along, across = c * (u - self.x_m) + s * (v - self.y_m), c * (v - self.y_m) - s * (u - self.x_m)
        k = 2.0 * np.pi / self.wavelength_m
        angle = k * along + self.phase_rad
        offset = across - self.amplitude_m * np.sin(angle)
        return np.asarray(self.width_m / 2.0 - np.abs(offset) / np.hypot(1.0, self.amplitude_m * k * np.cos(angle)))

    def may_touch(self, box: Box) -> bool:
        """Return whether the straight strip around the band overlaps the box."""
        c, s = np.cos(self.direction_rad), np.sin(self.direction_rad)
        u, v = (box[0] + box[2]) / 2 - self.x_m, (box[1] + box[3]) / 2 - self.y_m
        reach = abs(s) * (box[2] - box[0]) / 2 + abs(c) * (box[3] - box[1]) / 2
        stretch = np.hypot(1.0, self.amplitude_m * 2.0 * np.pi / self.wavelength_m)
        return bool(abs(c * v - s * u) < reach + abs(self.amplitude_m) + (self.width_m / 2 + 1.0) * stretch)


@dataclass(frozen=True, slots=True)
class World:
    """The ground truth of a site. Lengths of its parts are map metres from the site's south-west corner."""

    site: Site
    base_m: float  # height above the geoid without hills [m]
    hills: tuple[Hill, ...] = ()
    waves: Waves = ()  # ripples of the height [m]
    regions: tuple[Ellipse | Band, ...] = ()  # later classes cover earlier ones; all other ground is grass
    holes: tuple[Ellipse, ...] = ()  # areas without data in the rasters (white in the paper's figure 1)
    texture: Waves = ()  # ripples of the brightness, as a fraction
    resistance: Waves = field(default=())
    """Ripples of the rolling resistance that no map shows, as a fraction."""
    surface: Surface | None = omit()
    """Variation of the ground of a class from metre to metre; None: everywhere the same."""
    sun: tuple[float, float, float] | None = omit()
    """Unit vector east, north, up to the sun that the orthophoto was taken in; None: under an even sky."""

    def height_m(self, x_map_m: Floats, y_map_m: Floats) -> Floats:
        """Return the height above the geoid [m]."""
        u, v = self.site.uv_m(x_map_m, y_map_m)
        total = np.full(np.broadcast(u, v).shape, self.base_m)
        for hill in self.hills:
            total += hill.rise_m(u, v)
        return total + sum_waves(self.waves, u, v)

    def mapped_height_m(self, x_map_m: Floats, y_map_m: Floats) -> Floats:
        """Return a raster's height: with map noise, and bumps and ridges that affect wheels but not the pose."""
        height = self.height_m(x_map_m, y_map_m)
        if self.surface is None:
            return height
        u, v = self.site.uv_m(x_map_m, y_map_m)
        classes = self.terrain_class(x_map_m, y_map_m)
        noise_m = self.surface.map_noise_std_m * evaluate_field(self.surface.noise, u, v)
        return height + self.surface.relief_m(classes, u, v) + noise_m

    def gradient(self, x_map_m: Floats, y_map_m: Floats) -> tuple[Floats, Floats]:
        """Return the rise per map metre along the map's x and y."""
        u, v = self.site.uv_m(x_map_m, y_map_m)
        gx, gy = np.zeros(np.broadcast(u, v).shape), np.zeros(())
        for hill in self.hills:
            bump = hill.rise_m(u, v)
            gx = gx - bump * (u - hill.x_m) / hill.x_sigma_m**2
            gy = gy - bump * (v - hill.y_m) / hill.y_sigma_m**2
        for wave in self.waves:
            k = 2.0 * np.pi / wave.wavelength_m
            kx, ky = k * np.cos(wave.direction_rad), k * np.sin(wave.direction_rad)
            rise = wave.amplitude * np.cos(kx * u + ky * v + wave.phase_rad)
            gx, gy = gx + kx * rise, gy + ky * rise
        return gx, gy

    def terrain_class(self, x_map_m: Floats, y_map_m: Floats) -> Bytes:
        """Return the class id, everywhere (the holes of the rasters do not matter here)."""
        u, v = self.site.uv_m(x_map_m, y_map_m)
        classes = np.full(np.broadcast(u, v).shape, GRASS, dtype=np.uint8)
        for region in self._near(self.regions, u, v):
            classes[region.depth_m(u, v) > 0.0] = region.class_id
        return classes

    def ortho(self, x_map_m: Floats, y_map_m: Floats) -> Floats:
        """Return red, green, blue in 0 … 255, last axis; classes blend over 0.3 m at their borders."""
        u, v = self.site.uv_m(x_map_m, y_map_m)
        rgb = np.broadcast_to(_COLOUR[GRASS], (*np.broadcast(u, v).shape, 3)).copy()
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

    def mapped(self, x_map_m: Floats, y_map_m: Floats) -> Mask:
        """Return whether the rasters have data here."""
        u, v = self.site.uv_m(x_map_m, y_map_m)
        inside = (u >= 0) & (u <= self.site.width_m) & (v >= 0) & (v <= self.site.height_m)
        for hole in self._near(self.holes, u, v):
            inside = inside & (hole.depth_m(u, v) <= 0.0)
        return inside

    def resistance_factor(self, x_map_m: Floats, y_map_m: Floats) -> Floats:
        """Return the factor on the class's rolling resistance: a part that the orthophoto shows, and a hidden part."""
        u, v = self.site.uv_m(x_map_m, y_map_m)
        hidden = sum_waves(self.resistance, u, v)
        if self.surface is None:
            return 1.0 + hidden
        return 1.0 + hidden + self.surface.resistance(self.terrain_class(x_map_m, y_map_m), u, v)

    @staticmethod
    def _near(regions: Sequence[Ellipse | Band], u: Floats, v: Floats) -> Sequence[Ellipse | Band]:
        if not (np.size(u) and np.size(v)):
            return ()
        box = (float(np.min(u)), float(np.min(v)), float(np.max(u)), float(np.max(v)))
        return [region for region in regions if region.may_touch(box)]
