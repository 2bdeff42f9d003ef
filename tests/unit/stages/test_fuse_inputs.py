"""Streams become measurements: a receiver's own velocity goes with its fixes, and the forward filter says that it does not take it."""

import numpy as np
import pytest

from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse_inputs import prepare_inputs
from tcpipe.tables.levels import STREAMS, Sensor, Streams

STAMP_NS = 1_700_000_000_000_000_000 + np.arange(4, dtype=np.int64) * 1_000_000_000


@pytest.fixture
def streams():
    times = {
        "stamp_ns": STAMP_NS,
        "log_time_ns": STAMP_NS,
        "clock_epoch": np.zeros(4, np.int16),
        "fix_status": np.full(4, 2, np.int8),
    }
    unknown = np.full(4, np.nan)
    place = {"lon_deg": 15.0 + np.arange(4) * 1e-5, "lat_deg": np.full(4, 47.0), "alt_m": np.full(4, 400.0)}
    axes = ("east", "north", "up")
    fixes = STREAMS["gnss"].table(**times, **place, **{f"{axis}_var_m2": np.full(4, 1e-4) for axis in axes})
    velocity = dict(
        zip([f"{axis}_velocity_mps" for axis in axes], (np.full(4, 0.76), np.zeros(4), unknown), strict=True)
    )
    told = STREAMS["gnss_velocity"].table(**times, **velocity, **{f"{axis}_var_m2ps2": unknown for axis in axes})
    roles = ("gnss", "gnss_velocity")
    sensors = {role: Sensor(f"/{role}", "x/msg/Y", "gps", "why", (0.1, 0.0, 0.9), placed_by="recipe") for role in roles}
    return Streams(dict(zip(roles, (fixes, told), strict=True)), sensors, "husky")


def test_what_no_receiver_claims_is_the_recipes(streams):
    (found,) = prepare_inputs(streams, FuseConfig(gnss_velocity_std_mps=0.2)).measurements.values()
    assert set(found.sensors()) == {"gnss", "gnss_velocity"}
    assert found.doppler.velocity_enu_mps[0].tolist() == [0.76, 0.0, 0.0]
    assert found.doppler.variance_m2ps2[0] == pytest.approx([0.04, 0.04, 1e6])


def test_the_forward_filter_says_that_it_does_not_use_it(streams):
    inputs = prepare_inputs(streams, FuseConfig(estimator="ukf"))
    assert [set(m.sensors()) for m in inputs.measurements.values()] == [{"gnss"}]
    assert [(of.code, of.subject.name) for of in inputs.findings] == [("unused-by-estimator", "gnss_velocity")]
