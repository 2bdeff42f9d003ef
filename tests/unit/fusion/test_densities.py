"""Densities that were put into a drive come out again, and no set of sensors is too poor for an answer."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from unit.fusion import drive

from tcpipe.fusion.densities import GaussMarkov, make_prior_model
from tcpipe.fusion.measurements import (
    BodyVelocities,
    InertialMeasurements,
    Measurements,
    Positions,
    select_measurements,
)
from tcpipe.fusion.pair_residuals import find_residuals

LONG_S, SHORT_S = 660.0, 90.0


def make_noise(t, white_m, correlated_m, time_s, rng):
    """Return white and Gauss-Markov noise at irregular times, shape (n, 3); 1.6 times as large upwards."""
    kept = np.exp(-np.diff(t, prepend=t[0] - 1e3) / time_s)
    drawn = rng.normal(size=(t.size, 3)) * np.sqrt(1.0 - kept**2)[:, None]
    process = np.zeros((t.size, 3))
    process[0] = drawn[0]
    for k in range(1, t.size):
        process[k] = kept[k] * process[k - 1] + drawn[k]
    return (correlated_m * process + white_m * rng.normal(size=(t.size, 3))) * [1.0, 1.0, 1.6]


def measure(seed=0, white_m=0.015, correlated_m=0.0, time_s=10.0, *, seconds=LONG_S, **how):
    """Return measurements whose fixes err by that, and claim so in total."""
    whole = drive.measure(
        drive.make_drive(seconds), seed, gnss_std=1e-9, gnss_outliers=0.005, slip=0.03, imu_hz=100.0, **how
    )
    gnss = whole.gnss
    t = (gnss.stamp_ns - gnss.stamp_ns[0]) * 1e-9
    error = make_noise(t, white_m, correlated_m, time_s, np.random.default_rng([seed, 1]))
    claimed = (white_m**2 + correlated_m**2) * np.array([1.0, 1.0, 1.6**2])
    made = replace(gnss, position_enu_m=gnss.position_enu_m + error, variance_m2=np.tile(claimed, (t.size, 1)))
    return replace(whole, gnss=made)


def compute_change_std(noise, time_s):
    """Return the standard deviation of the change of a fix's error over a time [s]."""
    return float(np.sqrt(2.0 * noise.white + noise.correlated.difference_variance(np.array(time_s))))


def numbers(value):
    """Yield every number of a model."""
    if isinstance(value, float | int):
        yield float(value)
    elif isinstance(value, dict):
        for each in value.values():
            yield from numbers(each)
    elif isinstance(value, tuple):
        for each in value:
            yield from numbers(each)
    elif hasattr(value, "__dataclass_fields__"):
        for name in value.__dataclass_fields__:
            yield from numbers(getattr(value, name))


@pytest.mark.parametrize(
    ("seed", "correlated_m", "time_s", "visual"), [(0, 0.008, 5.0, True), (1, 0.015, 10.0, False), (0, 0.03, 5.0, True)]
)
def test_correlated_noise_of_fixes_is_recovered(seed, correlated_m, time_s, visual):
    model = drive.estimate_noise(measure(seed, 0.006, correlated_m, time_s, visual=visual))
    true = GaussMarkov(correlated_m**2, time_s)
    for after_s in (10.0, 40.0):
        wanted = np.sqrt(2.0 * 0.006**2 + true.difference_variance(np.array(after_s)))
        assert 0.75 < compute_change_std(model.horizontal, after_s) / wanted < 1.4
        assert 0.75 < compute_change_std(model.vertical, after_s) / wanted / 1.6 < 1.6
    assert model.horizontal.white == pytest.approx(0.006**2, rel=0.4)


def test_white_noise_is_hardly_taken_for_correlated():
    model = drive.estimate_noise(measure())
    assert np.sqrt(model.horizontal.white) == pytest.approx(0.015, rel=0.1)
    assert np.sqrt(model.horizontal.correlated.variance) < 0.007
    assert np.sqrt(model.vertical.correlated.variance) < 0.018


def test_odometries_are_recovered():
    model = drive.estimate_noise(measure(seed=3, visual_scale=1.05))
    assert model.odometries["visual_odometry"].white == pytest.approx(0.03**2 / 30.0, rel=0.6)
    slip = model.odometries["wheel_odometry"].correlated
    assert 0.002 < np.sqrt(slip.variance) < 0.03  # 3 % at most, which comes and goes


def test_jumps_and_an_outage_do_not_enter():
    clean = measure(1, 0.006, 0.015)
    gnss = clean.gnss
    t = (gnss.stamp_ns - gnss.stamp_ns[0]) * 1e-9
    wrong = gnss.position_enu_m + np.where((t > 200.0) & (t < 230.0), 0.5, 0.0)[:, None]
    kept = (t < 400.0) | (t > 440.0)
    faulty = replace(gnss, stamp_ns=gnss.stamp_ns[kept], position_enu_m=wrong[kept], variance_m2=gnss.variance_m2[kept])
    before, after = drive.estimate_noise(clean).horizontal, drive.estimate_noise(replace(clean, gnss=faulty)).horizontal
    for time_s in (1.0, 10.0):
        assert compute_change_std(after, time_s) == pytest.approx(compute_change_std(before, time_s), rel=0.3)


@pytest.fixture(scope="module")
def short():
    return measure(seconds=SHORT_S)


@pytest.mark.parametrize("present", [each for each in product([True, False], repeat=4) if each[0] or any(each[2:])])
def test_no_set_of_sensors_fails(present, short):
    names = ("gnss", "imu", "wheels", "visual")
    sensors = {name: getattr(short, name) if here else None for name, here in zip(names, present, strict=True)}
    model = drive.estimate_noise(Measurements(**sensors))
    assert (model.horizontal is not None) == (model.vertical is not None) == present[0]
    assert set(model.odometries) == {
        role
        for role, name in (("wheel_odometry", "wheels"), ("visual_odometry", "visual"))
        if sensors[name] is not None
    }
    assert all(np.isfinite(number) for number in numbers(model))


@pytest.mark.parametrize("length_s", [0.0, 0.3, 2.0, 20.0])
def test_short_sections_keep_the_larger_of_fit_and_prior(length_s, short):
    start_ns = int(short.gnss.stamp_ns[100])
    section = select_measurements(short, start_ns, start_ns + int(length_s * 1e9))
    model, prior = drive.estimate_noise(section), make_prior_model(section)
    assert all(np.isfinite(number) for number in numbers(model))
    assert compute_change_std(model.horizontal, 40.0) > 0.9 * compute_change_std(prior.horizontal, 40.0)


def test_an_odometry_that_nothing_is_compared_with_errs_as_it_claims(short):
    alone = replace(short, gnss=None, visual=None)
    claimed = [
        replace(alone.wheels, variance_m2ps2=np.full_like(alone.wheels.variance_m2ps2, std_mps**2))
        for std_mps in (0.001, 0.4, 0.8)
    ]
    none, some, twice = (
        drive.estimate_noise(replace(alone, wheels=wheels)).odometries["wheel_odometry"].white for wheels in claimed
    )
    assert none < some
    assert twice == pytest.approx(4.0 * some)


def change_fixes(whole, **columns):
    return replace(whole, gnss=replace(whole.gnss, **columns))


DEGENERATE = {
    "frozen fixes": lambda m: change_fixes(m, position_enu_m=np.zeros_like(m.gnss.position_enu_m)),
    "one fix": lambda m: replace(m, gnss=select_measurements(m, 0, int(m.gnss.stamp_ns[0])).gnss),
    "wheels at zero": lambda m: replace(m, wheels=replace(m.wheels, velocity_mps=0.0 * m.wheels.velocity_mps)),
    "wheels backwards": lambda m: replace(m, wheels=replace(m.wheels, velocity_mps=-m.wheels.velocity_mps)),
    "no force": lambda m: replace(m, imu=replace(m.imu, accelerometer_usable=False)),
    "float and fixed": lambda m: change_fixes(
        m, variance_m2=np.where(np.arange(m.gnss.stamp_ns.size)[:, None] % 300 < 100, 1.0, 2e-4) * np.ones(3)
    ),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_input_gives_finite_noise(name, short):
    model = drive.estimate_noise(DEGENERATE[name](short))
    assert all(np.isfinite(number) and number >= 0.0 for number in numbers(model))


def test_fixes_without_claims_keep_the_prior(short):
    unclaimed = change_fixes(
        short, unclaimed=np.ones(short.gnss.stamp_ns.size, np.bool_), variance_m2=np.ones_like(short.gnss.variance_m2)
    )
    model = drive.estimate_noise(unclaimed)
    assert model.horizontal == make_prior_model(unclaimed).horizontal
    assert model.horizontal.white + model.horizontal.correlated.variance == pytest.approx(1.0)


def test_fixes_without_claims_do_not_enter_the_noise_of_those_with(short):
    unclaimed = np.random.default_rng(4).random(short.gnss.stamp_ns.size) < 0.43
    variance_m2 = np.where(unclaimed[:, None], 1.0, short.gnss.variance_m2)
    mixed = drive.estimate_noise(change_fixes(short, unclaimed=unclaimed, variance_m2=variance_m2))
    assert mixed.horizontal.white == pytest.approx(drive.estimate_noise(short).horizontal.white, rel=0.3)


def test_fixes_at_one_hertz_and_of_metres():
    whole = measure(2, 0.2, 1.2, 60.0)
    rows = slice(None, None, 10)
    gnss = whole.gnss
    slow = replace(
        gnss, stamp_ns=gnss.stamp_ns[rows], position_enu_m=gnss.position_enu_m[rows], variance_m2=gnss.variance_m2[rows]
    )
    model = drive.estimate_noise(replace(whole, gnss=slow))
    true = np.sqrt(2.0 * 0.2**2 + GaussMarkov(1.2**2, 60.0).difference_variance(np.array(10.0)))
    assert 0.7 < compute_change_std(model.horizontal, 10.0) / true < 1.5


def test_features_of_a_straight_drive_are_those_of_the_analytic_integrals():
    t_ns = np.arange(0, 100_000_000_000, 50_000_000)
    t = t_ns * 1e-9
    nothing = np.full(t.size, np.nan)
    speed = np.column_stack((np.full(t.size, 1.5), nothing, nothing))
    wheels = BodyVelocities(t_ns, speed, np.where(np.isfinite(speed), 1e-3, np.nan), nothing)
    force = np.tile([0.0, 0.0, 9.81], (t.size, 1))
    imu = InertialMeasurements(t_ns, np.zeros((t.size, 3)), force, np.full((t.size, 4), np.nan), 1e-3, 1e-2)
    east = np.column_stack((1.5 * t, np.zeros(t.size), np.zeros(t.size)))
    gnss = Positions(t_ns, east, np.full((t.size, 3), 1e-4))
    for each in find_residuals(Measurements(gnss=gnss, imu=imu, wheels=wheels)):
        length_s = each.time_s
        assert np.abs(each.value).max() < 1e-6
        if length_s < 0.5 or each.axis not in {"along", "across"}:
            continue
        for tau in (3.0, 30.0):
            # Variance of the integral of a Gauss-Markov process of variance 1 (Gelb 1974, section 3.6).
            integral = 1.5**2 * 2.0 * tau**2 * (length_s / tau - 1.0 + np.exp(-length_s / tau))
            along, across = (integral, 0.0) if each.axis == "along" else (0.0, integral)
            assert each.features[f"wheel_odometry scale {tau:g}"] == pytest.approx(along, rel=0.03, abs=1e-9)
            assert each.features[f"heading scale {tau:g}"] == pytest.approx(across, rel=0.03, abs=1e-9)
        assert each.features["fix process 10"] == pytest.approx(2.0 - 2.0 * np.exp(-length_s / 10.0))
        assert each.features["wheel_odometry velocity"] == pytest.approx(length_s if each.axis == "along" else 0.0)
