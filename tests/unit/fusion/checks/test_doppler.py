"""A receiver's own velocity beside the fixes: what is true is fused, what lies stays out and is named."""

from dataclasses import replace

import numpy as np
import pytest
from rough_drive import ANTENNA_M, measured

from tcpipe.fusion.checks.clock_offsets import shift_sensors
from tcpipe.fusion.checks.sanity import check_ground_velocity
from tcpipe.fusion.measurements import GroundVelocities
from tcpipe.tables.facts import ClockOffset

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
    "change",
    [
        lambda v: 0.0 * v,
        lambda v: v[:, [1, 0, 2]] * [1.0, 1.0, -1.0],
        lambda v: np.hypot(v[:, :1], v[:, 1:2]) * [1.0, 0.0, 0.0],
        lambda v: 3.6 * v,
    ],
    ids=["frozen", "NED", "body", "km/h"],
)
def test_a_velocity_that_the_fixes_do_not_confirm_stays_out(truth, sensors, change):
    doubt = check_ground_velocity(with_velocity(sensors, truth, change))
    assert doubt is not None
    assert doubt.code == "velocity-unverified"


def test_a_late_receiver_is_corrected_with_its_velocity(truth, sensors):
    whole = with_velocity(sensors, truth)
    shifted = shift_sensors(whole, {"gnss": ClockOffset(0.3, 0.01, is_significant=True)}, 0)
    for name in ("gnss", "doppler"):
        assert (getattr(whole, name).stamp_ns - getattr(shifted, name).stamp_ns == 300_000_000).all()


def test_where_nothing_confirms_it_stays_out(truth, sensors):
    assert check_ground_velocity(sensors) is None  # there is none
    alone = check_ground_velocity(replace(with_velocity(sensors, truth), gnss=None))
    assert alone is not None
    assert alone.code == "velocity-unverified"
    still = replace(sensors.gnss, position_enu_m=0.0 * sensors.gnss.position_enu_m)
    unmoved = check_ground_velocity(replace(with_velocity(sensors, truth), gnss=still))
    assert unmoved is not None
    assert unmoved.code == "velocity-unverified"
