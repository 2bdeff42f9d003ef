"""Geodetic coordinates, earth-centred coordinates, and the east-north-up plane of a datum, on the WGS84 ellipsoid.

Other geodetic systems in use (GDA2020, ETRS89, NAD83) are on GRS80, whose semi-minor axis differs by 0.1 mm: their
coordinates keep their meaning here; ``Datum.crs`` names the system, and nothing here changes it.

Source: B. Hofmann-Wellenhof, H. Lichtenegger, E. Wasle, "GNSS", Springer 2008, section 8.2 (eq. 8.4 to 8.6) and 8.2.2
(eq. 8.10); latitude by Bowring's iteration (B. R. Bowring, Survey Review 23 (181), 1976), repeated until it is exact to
rounding.
"""

import numpy as np
from numpy.typing import ArrayLike

from tcpipe.arrays import Floats

SEMI_MAJOR_AXIS_M = 6378137.0
FLATTENING = 1 / 298.257223563
_SEMI_MINOR_AXIS_M = SEMI_MAJOR_AXIS_M * (1 - FLATTENING)
_E2 = FLATTENING * (2 - FLATTENING)
_E2_PRIME = _E2 / (1 - _E2)


def ecef_from_geodetic(lon_deg: ArrayLike, lat_deg: ArrayLike, alt_m: ArrayLike) -> Floats:
    """Return earth-centred, earth-fixed coordinates.

    Parameters
    ----------
    lon_deg, lat_deg : [deg], longitude east and geodetic latitude north, any one shape.
    alt_m : [m], height above the ellipsoid, the same shape.

    Returns
    -------
    [m], shape (..., 3).
    """
    lon, lat, alt = np.radians(lon_deg), np.radians(lat_deg), np.asarray(alt_m, float)
    prime_vertical_m = SEMI_MAJOR_AXIS_M / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
    across_m = (prime_vertical_m + alt) * np.cos(lat)
    return np.stack(
        (across_m * np.cos(lon), across_m * np.sin(lon), (prime_vertical_m * (1 - _E2) + alt) * np.sin(lat)), -1
    )


def geodetic_from_ecef(ecef_m: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Return longitude [deg] in [-180, 180], latitude [deg] and height above the ellipsoid [m], each of shape (...).

    Parameters
    ----------
    ecef_m : [m], shape (..., 3), not nearer than 100 km to the earth's centre.
    """
    x, y, z = np.moveaxis(np.asarray(ecef_m, float), -1, 0)
    across_m = np.hypot(x, y)
    reduced = np.arctan2(SEMI_MAJOR_AXIS_M * z, _SEMI_MINOR_AXIS_M * across_m)
    for _ in range(3):  # one suffices near the ground (1e-11 rad); three reach rounding at any height
        lat = np.arctan2(
            z + _E2_PRIME * _SEMI_MINOR_AXIS_M * np.sin(reduced) ** 3,
            across_m - _E2 * SEMI_MAJOR_AXIS_M * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2((1 - FLATTENING) * np.sin(lat), np.cos(lat))
    # This form of the height is exact at the poles as well as at the equator.
    alt = across_m * np.cos(lat) + z * np.sin(lat) - SEMI_MAJOR_AXIS_M * np.sqrt(1 - _E2 * np.sin(lat) ** 2)
    return np.degrees(np.arctan2(y, x)), np.degrees(lat), alt


def ecef_from_enu_rotation(lon_deg: float, lat_deg: float) -> Floats:
    """Return the rotation (3, 3) from local to earth-centred axes; its columns are east, north and up."""
    sl, cl = np.sin(np.radians(lon_deg)), np.cos(np.radians(lon_deg))
    sp, cp = np.sin(np.radians(lat_deg)), np.cos(np.radians(lat_deg))
    return np.array([[-sl, -sp * cl, cp * cl], [cl, -sp * sl, cp * sl], [0.0, cp, sp]])


def enu_from_geodetic(
    lon_deg: ArrayLike, lat_deg: ArrayLike, alt_m: ArrayLike, *, datum_deg_m: tuple[float, float, float]
) -> Floats:
    """Return coordinates in the east-north-up frame of a datum.

    Parameters
    ----------
    lon_deg, lat_deg, alt_m : [deg], [deg], [m above the ellipsoid], any one shape.
    datum_deg_m : longitude [deg], latitude [deg] and height above the ellipsoid [m] of the origin.

    Returns
    -------
    [m], shape (..., 3): east, north, up. A frame, not a map projection: up is that of the origin.
    """
    offset = ecef_from_geodetic(lon_deg, lat_deg, alt_m) - ecef_from_geodetic(*datum_deg_m)
    return offset @ ecef_from_enu_rotation(datum_deg_m[0], datum_deg_m[1])


def geodetic_from_enu(enu_m: ArrayLike, *, datum_deg_m: tuple[float, float, float]) -> tuple[Floats, Floats, Floats]:
    """Return longitude, latitude [deg] and ellipsoidal height [m] of points (..., 3) in a datum's frame [m]."""
    rotation = ecef_from_enu_rotation(datum_deg_m[0], datum_deg_m[1])
    return geodetic_from_ecef(np.asarray(enu_m, float) @ rotation.T + ecef_from_geodetic(*datum_deg_m))
