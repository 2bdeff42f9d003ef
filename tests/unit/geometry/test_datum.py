"""Geodetic conversions against PROJ."""

import numpy as np
import pyproj
import pytest

from tcpipe.geometry.datum import ecef_from_geodetic, enu_from_geodetic, geodetic_from_ecef, geodetic_from_enu

RNG = np.random.default_rng(4)
LON = RNG.uniform(-180, 180, 500)
LAT = np.concatenate((RNG.uniform(-90, 90, 496), [0.0, 90.0, -90.0, 1e-9]))
ALT = RNG.uniform(-500, 9000, 500)
PROJ_ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def test_ecef_is_projs():
    assert np.allclose(ecef_from_geodetic(LON, LAT, ALT), np.stack(PROJ_ECEF.transform(LON, LAT, ALT), -1), atol=1e-8)


def test_geodetic_of_ecef_comes_back_also_at_the_poles_and_in_orbit():
    for alt in (ALT, np.full(500, 2.0e7)):
        lon, lat, height = geodetic_from_ecef(np.stack(PROJ_ECEF.transform(LON, LAT, alt), -1))
        assert np.allclose(lat, LAT, atol=1e-12)
        assert np.allclose(height, alt, atol=1e-8)
        inside = np.abs(LAT) < 89.9
        assert np.allclose(lon[inside], LON[inside], atol=1e-12)


@pytest.mark.parametrize("datum", [(15.46, 47.06, 400.0), (150.6, -33.1, 40.0), (-179.9999, 0.1, 0.0)])
def test_enu_is_projs_topocentric_frame(datum):
    lon = datum[0] + RNG.uniform(-0.02, 0.02, 100)
    lat = datum[1] + RNG.uniform(-0.02, 0.02, 100)
    alt = datum[2] + RNG.uniform(-100, 100, 100)
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={datum[0]} +lat_0={datum[1]} +h_0={datum[2]}"
    )
    enu = enu_from_geodetic(lon, lat, alt, datum_deg_m=datum)
    assert np.allclose(enu, np.stack(pipeline.transform(lon, lat, alt), -1), atol=1e-7)
    back = geodetic_from_enu(enu, datum_deg_m=datum)
    assert np.allclose((back[0] - lon + 180) % 360 - 180, 0, atol=1e-12)
    assert np.allclose(back[1], lat, atol=1e-12)
    assert np.allclose(back[2], alt, atol=1e-8)
