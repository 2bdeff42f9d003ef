"""A receiver's own velocity beside the fixes: what is true is fused, what lies stays out and is named."""

from dataclasses import replace

import numpy as np
import pytest
from rough_drive import ANTENNA_M, measured

from tcpipe.fusion.checks.clock_offsets import find_clock_offsets
from tcpipe.fusion.checks.sanity import check_ground_velocity
from tcpipe.fusion.measurements import GroundVelocities

STD_MPS = 0.05


def doppler(truth, *, late_ns=0, hz=10):
    """Return the antenna's true velocity, the slope of its true places, with noise."""
    at = np.arange(7, truth.stamp_ns.size, 200 // hz)
    places = truth.position + truth.rotation @ np.array(ANTENNA_M)
    velocity = np.gradient(places, 1 / 200, axis=0)[at]
    noise = np.random.default_rng(4).normal(0, STD_MPS, velocity.shape)
    return GroundVelocities(truth.stamp_ns[at] + late_ns, velocity + noise, np.full(velocity.shape, STD_MPS**2))


def with_velocity(sensors, truth, change=lambda v: v, **how):
    told = doppler(truth, **how)
    return replace(sensors, doppler=replace(told, velocity_enu_mps=change(told.velocity_enu_mps)))


def test_the_true_velocity_is_not_doubted_by_any_set_of_sensors(truth, sensors):
    whole = with_velocity(sensors, truth)
    assert check_ground_velocity(whole) is None
    assert check_ground_velocity(replace(whole, wheels=None, visual=None, imu=None)) is None
    assert check_ground_velocity(with_velocity(sensors, truth, hz=1)) is None


def test_fixes_of_metres_take_longer_windows_and_still_tell(truth):
    rough = with_velocity(measured(truth, 3, gnss_std=1.0), truth)
    assert check_ground_velocity(rough) is None
    turned = replace(rough.doppler, velocity_enu_mps=rough.doppler.velocity_enu_mps[:, [1, 0, 2]])
    assert check_ground_velocity(replace(rough, doppler=turned)) is not None


@pytest.mark.parametrize(
    ("change", "code", "said"),
    [
        (lambda v: 0.0 * v, "frozen", {"quantity": "velocity"}),
        (lambda v: v[:, [1, 0, 2]] * [1.0, 1.0, -1.0], "velocity-frame", {"frame": "north-east-down"}),
        (lambda v: np.hypot(v[:, :1], v[:, 1:2]) * [1.0, 0.0, 0.0], "velocity-frame", {"frame": "unknown"}),
        (lambda v: 3.6 * v, "distance-contradicted", {"reference": "gnss"}),
    ],
)
def test_what_lies_is_named(truth, sensors, change, code, said):
    doubt = check_ground_velocity(with_velocity(sensors, truth, change))
    assert doubt is not None
    assert (doubt.code, doubt.names) == (code, said)
    assert doubt.numbers.get("distance_ratio", 3.6) == pytest.approx(3.6, rel=0.01)


def test_stamps_that_are_not_of_the_fixes_time_are_corrected(truth, sensors):
    """On this drive the speed changes too slowly for the wheels to tell a lag; the course does not."""
    late = with_velocity(sensors, truth, late_ns=300_000_000)
    offset = find_clock_offsets(replace(late, imu=None)).offsets["gnss_velocity"]
    assert offset.noted
    assert offset.offset_s == pytest.approx(0.3, abs=0.02)


def test_where_nothing_confirms_it_stays_out(truth, sensors):
    assert check_ground_velocity(sensors) is None  # there is none
    alone = check_ground_velocity(replace(with_velocity(sensors, truth), gnss=None))
    assert alone is not None
    assert alone.code == "velocity-unverified"
    still = replace(sensors.gnss, position_enu_m=0.0 * sensors.gnss.position_enu_m)
    unmoved = check_ground_velocity(replace(with_velocity(sensors, truth), gnss=still))
    assert unmoved is not None
    assert unmoved.code == "velocity-unverified"
