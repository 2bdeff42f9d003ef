"""Errors over time differences: sums of the fitted noise as defined, against integrals of its covariance by quadrature."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import dblquad
from unit.fusion import drive

from tcpipe.fusion.densities import GaussMarkov, SensorNoise, describe_noise, make_prior_model

TIMES_S = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 80.0)


@pytest.fixture(scope="module")
def measured():
    return drive.measure(drive.make_drive(20.0), 1)


def at(facts, time_s):
    row = facts.time_s.index(time_s)
    return facts.std[row], facts.claimed_std[row], facts.data_share[row]


def test_a_fix_changes_by_white_noise_and_by_what_its_process_forgets(measured):
    process = GaussMarkov(0.02**2, 10.0, data_share=0.5)
    fixes = SensorNoise(white=0.01**2, correlated=process, claimed_m2=0.03**2, white_data_share=1.0)
    noise = replace(make_prior_model(measured), horizontal=fixes)
    found = describe_noise(measured, noise)["gnss"]
    assert found.time_s == TIMES_S
    std, claimed, share = at(found, 10.0)
    white, lasting = 2 * 0.01**2, 2 * 0.02**2 * (1 - np.exp(-1.0))
    assert std == pytest.approx(np.sqrt(white + lasting), rel=1e-3)
    assert claimed == pytest.approx(np.sqrt(2) * 0.03, rel=1e-3)
    assert share == pytest.approx((white + 0.5 * lasting) / (white + lasting), rel=1e-3)


@pytest.mark.parametrize("time_s", [1.0, 40.0])
def test_a_distance_errs_by_the_integral_of_velocity_noise_and_scale(measured, time_s):
    scale, none = GaussMarkov(0.02**2, 15.0, data_share=1.0), GaussMarkov(0.0, 10.0)
    prior = make_prior_model(measured)
    odometries = prior.odometries | {"wheel_odometry": SensorNoise(1e-4, scale)}
    found = describe_noise(measured, replace(prior, odometries=odometries, shared_scale=none))["wheel_odometry"]
    speed = np.abs(measured.wheels.velocity_mps[:, 0])
    usual = np.median(speed[speed > 0.1])
    # The variance of an integral is the double integral of the covariance; half of the square has no kink.
    half, _ = dblquad(lambda b, a: np.exp(-(a - b) / 15.0), 0.0, time_s, 0.0, lambda a: a)
    by_scale = 2.0 * half * (0.02 * usual) ** 2
    std, claimed, share = at(found, time_s)
    assert std == pytest.approx(np.sqrt(1e-4 * time_s + by_scale), rel=1e-3)
    assert share == pytest.approx(by_scale / (1e-4 * time_s + by_scale), rel=2e-3)
    # Velocities that err independently of each other err by a random walk of the distance.
    period_s = 1e-9 * np.median(np.diff(measured.wheels.stamp_ns))
    assert claimed == pytest.approx(
        np.sqrt(np.median(measured.wheels.variance_m2ps2[:, 0]) * period_s * time_s), rel=1e-3
    )


def test_every_sensor_of_a_section_has_its_curve(measured):
    alone = replace(measured, gnss=None, imu=None, visual=None)
    assert set(describe_noise(measured, make_prior_model(measured))) == {
        "gnss", "gnss height", "wheel_odometry", "visual_odometry"
    }  # fmt: skip
    assert set(describe_noise(alone, make_prior_model(alone))) == {"wheel_odometry"}
