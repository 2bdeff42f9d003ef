"""Readings against the truth they were made from: exact without faults, and each fault as strong as it says."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation
from simulated_streams import log_of, streams_of

from tcpipe.fusion.preparation import find_datum
from tcpipe.geometry.datum import enu_from_geodetic
from tcpipe.simulation.robot import GRAVITY_MPS2
from tcpipe.simulation.scenarios import HUSKY_ROS1, HUSKY_ROS2, make_small_world, make_tiny
from tcpipe.simulation.sensors import (
    CLOCK_STEP_NS,
    EXACT_GNSS,
    Doppler,
    Faults,
    Gnss,
    Noise,
    Sensors,
    record,
)
from tcpipe.tables.columns import to_floats, to_integers

SITE = make_small_world().site


def readings(truth, *names, sensors=None, seed=1):
    faults = Faults.only(*names)
    return record(truth, SITE, (sensors or Sensors()).mounted(faults), faults, Noise(seed, 0))


@pytest.fixture(scope="module")
def exact(truth):
    """The readings without a fault."""
    return readings(truth)


def alone(gnss):
    return Sensors(gnss, *[None] * 5)


def local(reading):
    return SITE.enu_m(*(reading.values[name] for name in ("lon_deg", "lat_deg", "alt_m")))


def test_without_faults_every_sensor_tells_the_truth(truth):
    said = readings(truth)
    for reading in said.values():
        np.testing.assert_array_equal(reading.stamp_ns, reading.log_time_ns)
    gnss = said["gnss"]
    np.testing.assert_allclose(local(gnss), truth.at(gnss.stamp_ns).enu_m, atol=1e-6)
    wheels = said["wheels"]
    np.testing.assert_allclose(
        wheels.values["velocity_mps"], truth.at(wheels.stamp_ns).forward_velocity_mps, atol=1e-12
    )
    at = truth.at(said["power"].stamp_ns)
    np.testing.assert_allclose(said["power"].values["voltage_volt"], at.voltage_volt, atol=1e-12)
    drawn = said["power"].values["left_amp"] + said["power"].values["right_amp"]
    np.testing.assert_allclose(drawn, at.current_amp, atol=1e-9)
    command = said["command"].values["velocity_mps"]
    assert set(np.unique(np.round(command, 12))) == {-1.0, 0.0, 0.5, 1.0}


def test_lever_arm_and_mounting_turn_with_the_robot(truth):
    gnss = readings(truth, "gnss_lever_arm")["gnss"]
    at = truth.at(gnss.stamp_ns)
    np.testing.assert_allclose(
        local(gnss) - at.enu_m, Rotation.from_quat(at.quat_xyzw).apply([0.1, 0.0, 0.9]), atol=1e-6
    )
    imu = readings(truth, "imu_mounting")["imu"]
    at = truth.at(imu.stamp_ns)
    base_from_unit = Rotation.from_euler("xyz", [np.pi, 0.0, np.pi / 2])
    np.testing.assert_allclose(
        base_from_unit.apply(imu.values["angular_velocity_radps"]), at.angular_velocity_radps, atol=1e-9
    )
    wanted = Rotation.from_quat(at.quat_xyzw) * base_from_unit
    off = (wanted.inv() * Rotation.from_quat(imu.values["orientation_xyzw"])).magnitude()
    assert off.max() < 1e-6
    still = imu.stamp_ns < truth.stamp_ns[0] + 2_500_000_000
    felt = wanted[still].apply(imu.values["specific_force_mps2"][still])
    np.testing.assert_allclose(felt[:, 2], GRAVITY_MPS2, atol=1e-5)


@pytest.mark.parametrize("name", [field.name for field in fields(Faults)])
def test_each_fault_changes_its_sensor_alone(truth, exact, name):
    plain, faulty = exact, readings(truth, name)
    changed = {sensor for sensor in plain if not same(plain[sensor], faulty[sensor])}
    everyone = set(plain)
    wanted = {"transport_delay": everyone, "duplicates": everyone, "clock_step": everyone}
    assert changed == wanted.get(name, {name.split("_")[0].replace("wheel", "wheels")})


def same(one, other):
    return (
        np.array_equal(one.stamp_ns, other.stamp_ns)
        and np.array_equal(one.log_time_ns, other.log_time_ns)
        and all(np.array_equal(one.values[key], other.values[key], equal_nan=True) for key in one.values)
    )


def test_noise_is_as_strong_as_said(long_truth):
    every = {"gnss_noise", "wheel_noise", "imu_noise", "visual_noise", "power_noise", "gnss_stamp_jitter"}
    sensors = Sensors(gnss=EXACT_GNSS)
    plain, noisy = (readings(long_truth, *names, sensors=sensors) for names in ((), every))
    error = local(noisy["gnss"]) - local(plain["gnss"])
    np.testing.assert_allclose(error.std(axis=0), [0.015, 0.015, 0.025], rtol=0.05)
    assert np.abs(error.mean(axis=0)).max() < 0.001
    moving = np.abs(plain["wheels"].values["velocity_mps"]) > 0.3
    wheel = (noisy["wheels"].values["velocity_mps"] - plain["wheels"].values["velocity_mps"])[moving]
    assert wheel.std() == pytest.approx(sensors.wheels.std_mps, rel=0.05)
    gyro = noisy["imu"].values["angular_velocity_radps"] - plain["imu"].values["angular_velocity_radps"]
    assert gyro.std() == pytest.approx(sensors.imu.gyro_std_radps, rel=0.02)
    force = noisy["imu"].values["specific_force_mps2"] - plain["imu"].values["specific_force_mps2"]
    assert force.std() == pytest.approx(sensors.imu.accelerometer_std_mps2, rel=0.02)
    visual = noisy["visual"].values["linear_mps"] - plain["visual"].values["linear_mps"]
    assert visual.std() == pytest.approx(sensors.visual.std_mps, rel=0.03)
    current = noisy["power"].values["left_amp"] - plain["power"].values["left_amp"]
    assert current.std() == pytest.approx(np.hypot(0.08, 0.05 / np.sqrt(12)), rel=0.05)
    steps = noisy["power"].values["left_amp"] / sensors.power.current_step_amp
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    jitter = (noisy["gnss"].stamp_ns - plain["gnss"].stamp_ns) * 1e-9
    assert jitter.std() == pytest.approx(0.002, rel=0.1)


def test_fixes_err_as_their_covariance_claims_whatever_lasts(truth):
    """Each drive draws the size and the correlation time of the lasting part; claimed is what errs."""
    claimed, normalized, steps = [], [], []
    for seed in range(200):
        fixes, plain = (readings(truth, *on, sensors=alone(Gnss()), seed=seed)["gnss"] for on in (("gnss_noise",), ()))
        std_m = np.sqrt(fixes.values["covariance"][:, [0, 4, 8]])
        error = local(fixes) - local(plain)
        claimed.append(std_m[0])
        normalized.append(error[0] / std_m[0])
        steps.append(np.diff(error, axis=0).std(axis=0))
    assert np.sqrt(np.mean(np.square(normalized))) == pytest.approx(1.0, abs=0.08)
    east_m = np.array(claimed)[:, 0]
    assert 0.0094 <= east_m.min() < 0.011
    assert 0.019 < east_m.max() <= 0.0207
    white_m = np.array(steps)[:, 0] / np.sqrt(2.0)
    assert (white_m > 0.0045).all()
    assert (white_m < 0.0065).all(), "neighbouring fixes err alike but for the white part"


def test_outliers_outages_and_gaps(long_truth):
    said = readings(long_truth, "gnss_outliers", "gnss_outage", "visual_dropouts", "visual_outliers", "power_gap")
    plain = readings(long_truth)
    gnss = said["gnss"]
    blind = gnss.values["status"] < 0
    assert blind.sum() == pytest.approx(50, abs=1)
    assert np.isnan(gnss.values["lat_deg"][blind]).all()
    assert np.diff(gnss.stamp_ns).max() == pytest.approx(5.1e9, abs=0.15e9)
    at = long_truth.at(gnss.stamp_ns[~blind]).enu_m
    far = np.linalg.norm(local(gnss)[~blind] - at, axis=1) > 0.2
    assert 0.004 < far.mean() < 0.016
    assert np.diff(said["visual"].stamp_ns).max() == pytest.approx(3.0e9, abs=0.1e9)
    assert np.diff(said["power"].stamp_ns).max() == pytest.approx(1.5e9, abs=0.1e9)
    common = np.isin(plain["visual"].stamp_ns, said["visual"].stamp_ns)
    off = (
        np.linalg.norm(said["visual"].values["linear_mps"] - plain["visual"].values["linear_mps"][common], axis=1) > 0.5
    )
    assert 0.001 < off.mean() < 0.008


def test_clock_step_moves_headers_only(truth):
    stepped, plain = readings(truth, "clock_step")["imu"], readings(truth)["imu"]
    moved = stepped.stamp_ns - plain.stamp_ns
    assert set(np.unique(moved)) == {0, CLOCK_STEP_NS}
    assert (np.diff(moved) >= 0).all()
    np.testing.assert_array_equal(stepped.log_time_ns, plain.log_time_ns)


@pytest.mark.parametrize("container", ["mcap", "bag"])
def test_a_receivers_velocity_is_that_of_its_antenna_within_what_it_claims(container, tmp_path):
    """Through a log on disk: the mean of the fixes' way is the integral of the velocity, and its scatter is what is claimed."""
    quiet = Faults.only("gnss_noise", "gnss_lever_arm")
    recorder = HUSKY_ROS2 if container == "mcap" else HUSKY_ROS1
    made = make_tiny(
        quiet, container=container, recorder=recorder, sensors=replace(Sensors(), doppler=Doppler()), seconds=20.0
    )
    told = streams_of(log_of(made, made.drives[0], tmp_path))
    velocity, fixes = told.tables["gnss_velocity"], told.tables["gnss"]
    assert velocity["stamp_ns"].to_pylist() == fixes["stamp_ns"].to_pylist()  # one receiver
    variance = to_floats(velocity, "east_var_m2ps2")
    assert variance == pytest.approx(np.full(variance.size, 0.03**2 + 0.04**2))
    lonlatalt = [to_floats(fixes, name) for name in ("lon_deg", "lat_deg", "alt_m")]
    place = enu_from_geodetic(*lonlatalt, datum_deg_m=find_datum(*lonlatalt))
    at_s = (to_integers(fixes, "stamp_ns") - to_integers(fixes, "stamp_ns")[0]) * 1e-9
    for axis, name in enumerate(("east", "north")):
        way_m = cumulative_trapezoid(to_floats(velocity, f"{name}_velocity_mps"), at_s, initial=0.0)
        drift_m = way_m - (place[:, axis] - place[0, axis])
        assert np.abs(drift_m).max() < 4 * np.sqrt(variance[0] * 3.0 * at_s[-1])
        assert np.ptp(place[:, axis]) > 1.0
    assert np.isfinite(to_floats(velocity, "up_velocity_mps")).all()
