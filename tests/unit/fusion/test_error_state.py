"""The estimator against the truth of a simulated drive over hills, with every sensor fault on."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from unit.fusion import drive

from tcpipe.errors import FusionError
from tcpipe.fusion.error_state import run_error_state
from tcpipe.fusion.error_state_pass import FilterPass, compute_lag_rows
from tcpipe.fusion.gnss_faults import find_fix_errors
from tcpipe.fusion.initial import find_initial_state, find_stationary_intervals
from tcpipe.fusion.measurements import GNSS, VISUAL, WHEELS
from tcpipe.fusion.process import WHEEL_SCALE_STD, estimate_slope_std_rad
from tcpipe.fusion.timeline import build_timeline
from tcpipe.geometry.rotation import matrix_from_quat

PERIOD_NS = 50_000_000


def truth():
    return drive.make_drive(150.0)


def fuse(measurements, **options):
    motion = [s for s in (measurements.gnss, measurements.wheels, measurements.visual) if s is not None]
    start, end = int(min(s.stamp_ns[0] for s in motion)), int(max(s.stamp_ns[-1] for s in motion))
    initial = find_initial_state(measurements, find_stationary_intervals(measurements), start)
    output = np.arange(-(-start // PERIOD_NS) * PERIOD_NS, end, PERIOD_NS, dtype=np.int64)
    return run_error_state(measurements, initial, output_ns=output, **options)


@cache
def smoothed(**faults):
    return fuse(drive.measure(truth(), 1, **faults))


def test_figures_with_every_fault_on():
    found = drive.errors(truth(), smoothed())
    assert found["xy"] <= 0.006
    assert found["z"] <= 0.006
    assert found["forward"] <= 0.004
    assert found["yaw_deg"] <= 0.15
    assert found["max_xy"] <= 0.03
    assert found["yaw_rate"] <= 0.005


def test_the_smoother_beats_the_filter_and_both_are_honest():
    forward = drive.errors(truth(), fuse(drive.measure(truth(), 1), smooth=False), after_s=10.0)
    both = drive.errors(truth(), smoothed(), after_s=10.0)
    assert both["forward"] <= 0.6 * forward["forward"]
    assert both["xy"] <= 0.7 * forward["xy"]
    for found in (forward, both):
        assert 0.5 <= found["nees_position"] <= 1.6
        assert 0.1 <= found["nees_yaw"] <= 2.0
        assert 0.25 <= found["nees_forward"] <= 1.6


@pytest.mark.parametrize("faults", [{}, {"gnss_std": 0.05}, {"visual": False}], ids=str)
def test_the_error_of_a_displacement_is_as_large_as_it_says(faults):
    found = smoothed(**faults)
    t = (found.stamp_ns - drive.ZERO_NS) * 1e-9
    error = (found.position_enu_m - truth().at(truth().position, t))[:, :2]
    for column, lag in enumerate((10, 20, 40)):
        way = found.position_enu_m[lag:, :2] - found.position_enu_m[:-lag, :2]
        length = np.linalg.norm(way, axis=1)
        moving = length > 0.3
        along = (np.sum((error[lag:] - error[:-lag]) * way, axis=1) / length)[moving]
        std = found.displacement_std_m[:-lag, column][moving]
        assert 0.55 < np.mean(np.abs(along) < std) < 0.95
        assert np.mean(np.abs(along) < 2 * std) > 0.88


def test_facts_name_what_the_sensors_were():
    facts = smoothed().facts
    assert facts.gyro_bias_radps == pytest.approx([0.006, -0.004, 0.008], abs=1e-3)
    assert facts.visual_scale == pytest.approx(1.02, abs=0.01)
    assert set(facts.nis_mean) == {GNSS, WHEELS, VISUAL}
    assert all(0.7 < facts.nis_mean[role] < 1.3 for role in (GNSS, VISUAL))
    assert 0.05 < facts.nis_mean[WHEELS] < 1.0  # beyond noise they claim nothing here; slip is a state
    assert facts.covariance_repairs == 0


def test_outliers_are_refused_and_listed():
    found = smoothed()
    role = found.rejections.role
    assert found.facts.rejected == {r: int((role == r).sum()) for r in (GNSS, WHEELS, VISUAL)}
    # 2 % of the fixes were thrown 1.5 m away in each axis; a few of them land near enough to pass.
    assert 15 <= found.facts.rejected[GNSS] <= 50
    assert (np.diff(found.rejections.stamp_ns) >= 0).all()
    assert (found.rejections.normalized_innovation_squared > found.rejections.threshold).all()
    assert found.rejections.threshold[role == GNSS] == pytest.approx(16.266, abs=1e-3)
    assert found.rejections.threshold[role == WHEELS] == pytest.approx(10.828, abs=1e-3)


@pytest.mark.parametrize(
    ("faults", "xy_m", "forward_mps", "yaw_deg"),
    [
        ({"visual": False}, 0.01, 0.01, 0.4),
        ({"wheels": False}, 0.01, 0.01, 0.3),
        ({"wheels": False, "visual": False}, 0.01, 0.01, 0.5),
        ({"imu": False}, 0.10, 0.05, 6.0),
        ({"imu": False, "visual": False}, 0.15, 0.05, 6.0),
        ({"gnss_std": 1.0, "gnss_hz": 1.0}, 0.6, 0.01, 0.5),
        ({"imu_hz": 20.0}, 0.01, 0.01, 0.4),
    ],
    ids=["no visual", "no wheels", "gnss and imu", "no imu", "gnss and wheels", "sbas", "slow imu"],
)
def test_any_sensor_may_be_missing_or_weak(faults, xy_m, forward_mps, yaw_deg):
    found = drive.errors(truth(), smoothed(**faults))
    assert found["xy"] <= xy_m
    assert found["forward"] <= forward_mps
    assert found["yaw_deg"] <= yaw_deg
    assert found["nees_position"] <= 3.5
    assert found["nees_yaw"] <= 2.0


def test_an_outage_of_a_minute_shows_in_the_deviations():
    outage = smoothed(gnss_outages=((50.0, 110.0),))
    found = drive.errors(truth(), outage)
    assert found["xy"] <= 0.10
    assert 0.3 <= found["nees_position"] <= 2.5
    t = (outage.stamp_ns - drive.ZERO_NS) * 1e-9
    inside, outside = outage.position_std_m[(t > 70) & (t < 90), 0], outage.position_std_m[(t > 20) & (t < 45), 0]
    assert np.median(inside) > 4 * np.median(outside)


def displaced(measurements, start_s, end_s, offset_m, *, ramp_s=0.0):
    """Return the measurements with fixes that are off by ``offset_m`` (3,) for some time, growing to it over ``ramp_s``."""
    t = (measurements.gnss.stamp_ns - drive.ZERO_NS) * 1e-9
    share = np.clip((t - start_s) / max(ramp_s, 1e-9), 0.0, 1.0) * (t < end_s)
    fixes = measurements.gnss.position_enu_m + share[:, None] * np.asarray(offset_m)
    return replace(measurements, gnss=replace(measurements.gnss, position_enu_m=fixes))


def normalized(found, *, first_s, last_s):
    """Return the horizontal error over its deviation between two times, shape (N,), and the largest error [m]."""
    t = (found.stamp_ns - drive.ZERO_NS) * 1e-9
    rows = (t > first_s) & (t < last_s)
    error = (found.position_enu_m - truth().at(truth().position, t))[rows, :2]
    return np.hypot(*(error / found.position_std_m[rows, :2]).T), np.hypot(*error.T).max()


@pytest.mark.parametrize(("start_s", "end_s", "ramp_s"), [(70, 80, 0), (65, 110, 0), (65, 110, 10)], ids=str)
def test_fixes_that_err_together_move_neither_the_track_nor_what_it_claims(start_s, end_s, ramp_s):
    found = fuse(displaced(drive.measure(truth(), 1), start_s, end_s, (0.4, -0.3, 0.2), ramp_s=ramp_s))
    off, most_m = normalized(found, first_s=5, last_s=145)
    assert most_m < 0.1
    assert np.mean(off < 2 * np.sqrt(2)) > 0.85
    first = next(r for r in found.facts.reopenings if r.role == GNSS)
    assert start_s - 5 < (first.start_ns - drive.ZERO_NS) * 1e-9 <= start_s  # with what leads up to it
    assert (first.end_ns - drive.ZERO_NS) * 1e-9 == pytest.approx(end_s, abs=0.5)
    if not ramp_s:
        assert first.size == pytest.approx(0.5, abs=0.1)
        assert np.median(found.position_std_m[-100:, 0]) < 0.02  # the fixes are right again, and count again


def test_a_jump_that_stays_is_taken_for_an_error_of_the_fixes():
    found = fuse(displaced(drive.measure(truth(), 1), 70.0, 1e9, (3.0, 0.0, 0.0)))
    (reopening,) = [r for r in found.facts.reopenings if r.role == GNSS]
    assert reopening.size == pytest.approx(3.0, abs=0.1)
    off, most_m = normalized(found, first_s=5, last_s=145)
    assert most_m < 0.5
    assert np.mean(off < 2 * np.sqrt(2)) > 0.85
    assert found.position_std_m[-1, 0] > 5 * np.median(found.position_std_m[200:1000, 0])


def test_a_noisy_minute_counts_as_noisy_there_alone():
    measurements = drive.measure(truth(), 1)
    t = (measurements.gnss.stamp_ns - drive.ZERO_NS) * 1e-9
    noise = np.random.default_rng(3).normal(size=(t.size, 3)) * 0.06 * ((t > 60) & (t < 100))[:, None]
    fixes = replace(measurements.gnss, position_enu_m=measurements.gnss.position_enu_m + noise)
    errors = find_fix_errors(replace(measurements, gnss=fixes))
    assert np.sqrt(np.median(errors.white_m2[(t > 65) & (t < 95), 0])) == pytest.approx(0.062, rel=0.25)
    assert np.sqrt(errors.white_m2[(t < 50) | (t > 110), 0]) == pytest.approx(0.015, rel=0.01)
    assert not errors.matters


def test_fixes_that_claim_nothing_are_as_good_as_they_scatter():
    measurements = drive.measure(truth(), 1)
    unknown = np.ones(measurements.gnss.stamp_ns.size, bool)
    fixes = replace(measurements.gnss, variance_m2=np.full_like(measurements.gnss.variance_m2, 0.05**2))
    silent = replace(fixes, unclaimed=unknown)
    errors = find_fix_errors(replace(measurements, gnss=silent))
    assert np.sqrt(np.median(errors.white_m2[:, 0])) == pytest.approx(0.015, rel=0.15)
    assert not errors.matters
    # A receiver that says five centimetres means them.
    assert np.sqrt(np.median(find_fix_errors(replace(measurements, gnss=fixes)).lasting_m2[:, 0])) > 0.04
    t = (silent.stamp_ns - drive.ZERO_NS) * 1e-9
    wave = 0.5 * np.sin(t[:, None] / 4.0) * ((t > 60) & (t < 110))[:, None] * [1.0, 0.0, 0.0]
    bent = find_fix_errors(replace(measurements, gnss=replace(silent, position_enu_m=silent.position_enu_m + wave)))
    assert np.sqrt(np.median(bent.lasting_m2[(t > 65) & (t < 105), 0])) > 0.5


def test_without_gnss_the_track_starts_at_the_origin_and_keeps_its_shape():
    found = smoothed(gnss=False)
    assert np.linalg.norm(found.position_enu_m[0]) < 0.01
    assert abs(found.quat_xyzw[0, 2]) < 0.02
    assert drive.errors(truth(), found)["forward"] <= 0.02
    # Nothing tells how long a metre of odometry is, and the deviations say so.
    moving = np.linalg.norm(found.velocity_enu_mps, axis=1) > 0.5
    assert found.forward_velocity_std_mps[moving].min() > 0.025
    assert np.nanmin(found.displacement_std_m[moving, 1][:-20]) > 0.025
    t = (found.stamp_ns - drive.ZERO_NS) * 1e-9
    true = truth().at(truth().position, t)
    # Laid over the truth by the best rotation and shift, the path differs by little.
    a, b = (
        complex(1, 0) * p[:, 0] + 1j * p[:, 1]
        for p in (found.position_enu_m - found.position_enu_m.mean(0), true - true.mean(0))
    )
    turned = a * np.exp(1j * np.angle(np.vdot(a, b)))
    assert np.sqrt(np.mean(np.abs(turned - b) ** 2)) < 0.5


@pytest.mark.parametrize("kept", ["wheels", "wheels and imu"])
def test_without_gnss_a_metre_of_the_wheels_stays_one(kept):
    measurements = drive.measure(truth(), 1, gnss=False, visual=False, imu=kept != "wheels")
    imu = measurements.imu
    if imu is not None:  # a unit that looks 3 degrees down: what it adds up to is no length
        down = Rotation.from_euler("y", 3.0, degrees=True)
        tilted = down.apply(imu.specific_force_mps2), down.apply(imu.angular_velocity_radps)
        imu = replace(imu, specific_force_mps2=tilted[0], angular_velocity_radps=tilted[1])
    found = fuse(replace(measurements, imu=imu))
    wheels = measurements.wheels
    own_m = np.sum(np.abs(wheels.velocity_mps[1:, 0]) * np.diff(wheels.stamp_ns) * 1e-9)
    driven_m = np.sum(np.linalg.norm(np.diff(found.position_enu_m, axis=0), axis=1))
    assert driven_m == pytest.approx(own_m, rel=0.02)
    assert found.facts.wheel_scale == pytest.approx(1.0, abs=1e-6)
    assert found.facts.common_scale_std == found.facts.wheel_scale_std == WHEEL_SCALE_STD
    moving = np.linalg.norm(found.velocity_enu_mps, axis=1) > 0.5
    assert (found.forward_velocity_std_mps[moving] > 0.1 * np.linalg.norm(found.velocity_enu_mps, axis=1)[moving]).all()
    assert np.linalg.norm(found.position_std_m[-1]) > 0.1 * np.linalg.norm(found.position_enu_m[-1])


def test_a_speed_without_a_yaw_rate_goes_where_the_fixes_go():
    measurements = drive.measure(truth(), 1, imu=False, visual=False, gnss_std=0.05)
    nothing = np.full_like(measurements.wheels.yaw_rate_radps, np.nan)
    speed_only = replace(measurements.wheels, yaw_rate_radps=nothing, yaw_rate_var=nothing)
    found = fuse(replace(measurements, wheels=speed_only))
    figures = drive.errors(truth(), found)
    assert figures["xy"] < 0.3
    assert figures["forward"] < 0.1
    assert figures["nees_position"] < 4.0
    # The course takes a roll for a turn: across the way nobody knows where below its antenna the robot is.
    rotation = matrix_from_quat(found.quat_xyzw)
    across = np.sqrt(np.sum((rotation[:, :2, 1] * found.position_std_m[:, :2]) ** 2, axis=1))
    slope = estimate_slope_std_rad(measurements)
    assert slope is not None
    sway_m = slope * abs(measurements.gnss.lever_arm_m[2])
    assert (across > sway_m * (1.0 - rotation[:, 2, 1] ** 2) / np.sqrt(2.0)).all()


def test_the_noise_of_a_turn_rate_is_no_scale_of_it():
    """A camera off base_link feels each turn as a velocity: there the noise of its rate would pull the rate's scale towards nothing."""
    measurements = drive.measure(truth(), 1, imu=False, wheels=False)
    at_s = (measurements.visual.stamp_ns - drive.ZERO_NS) * 1e-9
    rate = truth().at(truth().rate, at_s)
    rate = rate + np.random.default_rng(3).normal(size=rate.shape) * 0.02
    turning = replace(
        measurements.visual, turn_rate_radps=rate, yaw_rate_radps=rate[:, 2], yaw_rate_var=np.full(at_s.size, 0.02**2)
    )
    output_ns = np.arange(int(measurements.gnss.stamp_ns[-1]) - 10**9, int(measurements.gnss.stamp_ns[-1]), 10**8)
    seen = replace(measurements, visual=turning)
    run = FilterPass(
        build_timeline(seen, find_stationary_intervals(seen), output_ns), seen, 0.999, lags=compute_lag_rows(output_ns)
    )
    run.filtered(find_initial_state(seen, find_stationary_intervals(seen), int(seen.gnss.stamp_ns[0])))
    scale, std = run.last.x[9:12], np.sqrt(np.diag(run.last.P)[3:6])
    assert std[0] < 0.08
    assert (np.abs(scale) < 2.0 * std).all()


@pytest.mark.parametrize("span_s", [(60.0, 90.0), (0.0, 40.0)])
def test_a_pass_that_goes_on_from_another_ones_checkpoint_is_the_pass_itself(span_s):
    measurements = drive.measure(truth(), 1)
    standing, output_ns = find_stationary_intervals(measurements), measurements.gnss.stamp_ns[:1]
    timeline = build_timeline(measurements, standing, output_ns)
    first_ns = int(timeline.stamp_ns[0])
    initial = find_initial_state(measurements, standing, first_ns)
    errors = find_fix_errors(measurements)
    spans = (tuple(first_ns + int(at_s * 1e9) for at_s in span_s),)

    def made(spans):
        run = FilterPass(timeline, measurements, 0.999, lags=[1, 2, 4, 8])
        run.doubt_fixes(errors, spans, follows=False)
        return run

    plain, whole, resumed = made(()), made(spans), made(spans)
    plain.filtered(initial)
    whole.filtered(initial)
    resumed.filtered_like(plain, initial)
    assert (whole.nis != plain.nis).any()
    for name in ("nis", "innovation", "verdict"):
        np.testing.assert_array_equal(getattr(resumed, name), getattr(whole, name))


def test_noisy_fixes_alone_say_that_they_hardly_tell_a_speed():
    measurements = drive.measure(truth(), 1, imu=False, visual=False, wheels=False, gnss_std=2.3, gnss_hz=1.0)
    found = fuse(measurements)
    true = truth().at(truth().velocity, (found.stamp_ns - drive.ZERO_NS) * 1e-9)
    assert np.linalg.norm(found.velocity_enu_mps, axis=1).max() < 2.5
    moving = np.linalg.norm(true, axis=1) > 0.5
    error = np.abs(np.linalg.norm(found.velocity_enu_mps, axis=1) - np.linalg.norm(true, axis=1))[moving]
    assert np.mean(error < found.displacement_std_m[moving, 1]) > 0.6
    turned = drive.integral(found.stamp_ns, found.angular_velocity_radps[:, 2])
    yaw = Rotation.from_quat(found.quat_xyzw).as_euler("ZYX")[:, 0]
    assert np.abs(np.angle(np.exp(1j * (turned - yaw + yaw[0]))))[20:-20].mean() < 0.3  # what turns says so


def test_an_estimate_that_is_not_finite_is_an_error():
    measurements = drive.measure(truth(), 1)
    broken = replace(measurements.gnss, position_enu_m=measurements.gnss.position_enu_m.copy())
    broken.position_enu_m[5] = np.nan
    wanted = replace(measurements, gnss=broken)
    initial = find_initial_state(
        measurements, find_stationary_intervals(measurements), int(measurements.gnss.stamp_ns[0])
    )
    output = np.array([measurements.gnss.stamp_ns[100]])
    found = run_error_state(wanted, initial, output_ns=output)  # the gate refuses what compares to nothing
    assert np.isfinite(found.position_enu_m).all()
    with pytest.raises(FusionError) as error:
        run_error_state(wanted, replace(initial, position_enu_m=np.full(3, np.nan)), output_ns=output)
    assert [of.code for of in error.value.findings] == ["estimate-not-finite"]


def test_a_receiver_whose_clock_is_off_is_trusted_less_rather_than_refused():
    late = drive.measure(truth(), 1)
    shifted = replace(late.gnss, stamp_ns=late.gnss.stamp_ns + 250_000_000)
    found = fuse(replace(late, gnss=shifted))
    assert found.facts.rejected[GNSS] < 0.2 * found.facts.measurements[GNSS]
    assert max(r.size for r in found.facts.reopenings) > 0.1
    error = drive.errors(truth(), found, after_s=5.0)
    assert 0.1 < error["xy"] < 0.3  # a quarter of a second of way, but no more
    assert error["forward"] < 0.03
    assert smoothed().facts.reopenings == ()


def test_two_fixes_close_together_say_nothing_of_how_long_a_metre_is():
    all_of_it = drive.measure(truth(), 1)
    first = {name: getattr(all_of_it.gnss, name)[:2] for name in ("stamp_ns", "position_enu_m", "variance_m2")}
    found = fuse(replace(all_of_it, gnss=replace(all_of_it.gnss, **first)))
    moving = np.linalg.norm(found.velocity_enu_mps, axis=1) > 0.5
    unplaced = smoothed(gnss=False)
    assert found.forward_velocity_std_mps[moving].min() > 0.025
    assert np.median(found.forward_velocity_std_mps[moving]) > 0.9 * np.median(
        unplaced.forward_velocity_std_mps[moving]
    )
    assert np.median(smoothed().forward_velocity_std_mps[moving]) < 0.01


def test_an_error_of_a_metre_that_lasts_leaves_the_scale_open():
    all_of_it = drive.measure(truth(), 1)
    slow = np.cumsum(
        np.random.default_rng(2).normal(0, 0.16 * np.sqrt(0.1), all_of_it.gnss.position_enu_m.shape), axis=0
    )
    claims = np.full_like(all_of_it.gnss.variance_m2, 1.5**2)
    fixes = replace(all_of_it.gnss, position_enu_m=all_of_it.gnss.position_enu_m + slow, variance_m2=claims)
    found = fuse(replace(all_of_it, gnss=fixes))
    true = drive.errors(truth(), found)["forward"]
    moving = np.linalg.norm(found.velocity_enu_mps, axis=1) > 0.5
    assert found.facts.gnss_lasting_error_m > 1.0
    assert np.median(found.forward_velocity_std_mps[moving]) > true
