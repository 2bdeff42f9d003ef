"""Columns to measurements, by hand and against PROJ and scipy."""

from dataclasses import replace

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from tcpipe.fusion.measurements import STATED_ARM_STD_M, BodyVelocities, Positions
from tcpipe.fusion.preparation import (
    drop_repeated_fixes,
    find_datum,
    prepare_body_velocities,
    prepare_ground_velocities,
    prepare_imu,
    prepare_positions,
)

NAN = np.nan
ARM = (0.1, 0.2, 0.3)
DATUM = (15.0, 47.0, 400.0)


def stamps(count, period=100_000_000):
    return np.arange(count, dtype=np.int64) * period + 1_700_000_000_000_000_000


def gnss_columns(lon, lat, alt, variance=0.0004):
    lon = np.asarray(lon, float)
    columns = {"lon_deg": lon, "lat_deg": np.asarray(lat, float), "alt_m": np.asarray(alt, float)}
    return columns | {f"{axis}_var_m2": np.full(lon.size, variance) for axis in ("east", "north", "up")}


def fixes(stamp_ns, columns):
    rules = {"lever_arm_m": ARM, "lever_arm_std_m": STATED_ARM_STD_M, "default_std_m": 0.05, "floor_std_m": 0.01}
    return prepare_positions(stamp_ns, columns, datum_deg_m=DATUM, **rules)


def test_fixes_become_enu_and_a_fix_at_null_island_is_set_aside():
    columns = gnss_columns([15.0, 0.0, 15.001, 15.002], [47.0, 0.0, 47.001, 47.002], [400.0, 0.0, 410.0, 420.0])
    stamp = stamps(4)
    stamp[3] = stamp[2]
    found, prepared = fixes(stamp, columns)
    assert found.stamp_ns.tolist() == stamp[[0, 2]].tolist()
    assert prepared.invalid_ns.tolist() == [stamp[1]]
    assert prepared.repeated == 1
    assert found.lever_arm_m == ARM
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        "+step +proj=topocentric +ellps=WGS84 +lon_0=15 +lat_0=47 +h_0=400"
    )
    assert found.position_enu_m[1] == pytest.approx(pipeline.transform(15.001, 47.001, 410.0), abs=1e-6)


@pytest.mark.parametrize(
    ("claimed", "taken", "replaced"),
    [*((nothing, [0.0025, 0.0025, 0.01], 1) for nothing in (NAN, 0.0, -1.0, np.inf)), (1e-12, [1e-4] * 3, 0)],
)
def test_a_variance_that_says_nothing_is_the_recipes_and_one_too_good_is_floored(claimed, taken, replaced):
    found, prepared = fixes(stamps(1), gnss_columns([15.0], [47.0], [400.0], claimed))
    assert found.variance_m2[0] == pytest.approx(taken)
    assert prepared.variances_replaced == replaced


@pytest.mark.parametrize(("decimals", "most_m"), [(5, 2.0), (6, 0.1), (12, 0.0101)])
def test_rounded_coordinates_err_as_much_as_their_variance(decimals, most_m):
    at_s = np.arange(400) * 0.2
    lon, lat = 15.0 + 1e-5 * at_s, 47.0 + 2e-5 * np.sin(at_s / 7.0)
    exact, _ = fixes(stamps(400), gnss_columns(lon, lat, 400.0 + 0.0 * lat, 1e-4))
    rounded, _ = fixes(stamps(400), gnss_columns(lon.round(decimals), lat.round(decimals), 400.0 + 0.0 * lat, 1e-4))
    error = (rounded.position_enu_m - exact.position_enu_m)[:, :2]
    std = np.sqrt(rounded.variance_m2[:, :2])
    assert (np.abs(error - np.median(error, axis=0)) < 2.5 * std).all()
    assert std.max() < most_m
    assert (rounded.unclaimed is not None) == (decimals < 12)  # the stated variance is not that of the rounded fix


def test_datum_is_the_median_of_the_first_fixes_also_at_the_date_line():
    lon = np.array([179.99999, -179.99999, 179.99998, 0.0, -179.99998, 90.0, 180.0])
    lat = np.array([10.0, 10.0, 10.0, 0.0, 10.0, 10.0, 10.0])
    found = find_datum(lon, lat, np.array([1.0, 2.0, 3.0, 0.0, 4.0, 500.0, 6.0]))
    assert abs(found[0]) == pytest.approx(180.0, abs=1e-4)
    assert found[1:] == (10.0, 3.5)
    assert find_datum(np.zeros(3), np.zeros(3), np.zeros(3)) is None


def odometry_columns(count, **known):
    names = [f"velocity_{a}_mps" for a in "xyz"] + [f"angular_velocity_{a}_radps" for a in "xyz"]
    names += [f"velocity_var_{a}_m2ps2" for a in "xyz"] + ["yaw_rate_var", "x_m", "y_m", "z_m"]
    names += [f"quat_{c}" for c in "xyzw"]
    return {name: np.full(count, NAN) for name in names} | {k: np.asarray(v, float) for k, v in known.items()}


def twists(columns, **options):
    given = {"xyz_m": ARM, "quat_xyzw": (0, 0, 0, 1), "default_std_mps": 0.05, "only_forward": False}
    return prepare_body_velocities(stamps(len(columns["x_m"])), columns, **given | options)


def test_a_twist_is_turned_into_base_link_with_its_variance():
    # A camera with x right, y down, z forward.
    quat = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]).as_quat()
    columns = odometry_columns(1)
    for axis, speed, turn, variance in (("x", 0.1, 0.0, 0.01), ("y", 0.2, -0.5, 0.04), ("z", 1.0, 0.0, 0.09)):
        columns[f"velocity_{axis}_mps"][:] = speed
        columns[f"angular_velocity_{axis}_radps"][:] = turn
        columns[f"velocity_var_{axis}_m2ps2"][:] = variance
    found, _ = twists(columns, quat_xyzw=tuple(quat))
    assert found.velocity_mps[0] == pytest.approx([1.0, -0.1, -0.2])
    assert found.variance_m2ps2[0] == pytest.approx([0.09, 0.01, 0.04])
    assert found.yaw_rate_radps[0] == pytest.approx(0.5)
    assert found.lever_arm_m == ARM


def test_an_axis_that_is_not_measured_stays_so_whichever_way_the_sensor_is_turned():
    columns = odometry_columns(
        2, velocity_x_mps=[0.5, 0.6], velocity_y_mps=[NAN, NAN], velocity_z_mps=[0.0, 0.0],
        angular_velocity_x_radps=[NAN, NAN], angular_velocity_y_radps=[NAN, NAN], angular_velocity_z_radps=[0.3, 0.4],
    )  # fmt: skip
    about_x = tuple(Rotation.from_euler("x", 90, degrees=True).as_quat())
    for quat, sideways in (((0.0, 0.0, 0.0, 1.0), 1), (about_x, 2)):
        found, _ = twists(columns, quat_xyzw=quat, default_std_mps=0.1)
        assert found.velocity_mps[:, 0].tolist() == [0.5, 0.6]
        assert found.variance_m2ps2[:, sideways].tolist() == [1e6, 1e6]
        assert found.variance_m2ps2[0, 3 - sideways] == pytest.approx(0.01)
        assert found.turn_rate_radps is None
        assert np.isnan(found.yaw_rate_radps).all() == (sideways == 2)


def test_wheels_measure_forward_only_and_rows_without_velocity_are_set_aside():
    columns = odometry_columns(
        3, velocity_x_mps=[1.0, NAN, 99.0], velocity_y_mps=[0.3, NAN, 0.0], velocity_z_mps=[0, NAN, 0]
    )
    found, prepared = twists(columns, only_forward=True)
    assert found.velocity_mps[0, 0] == 1.0
    assert np.isnan(found.velocity_mps[0, 1:]).all()
    assert found.variance_m2ps2[0, 0] == pytest.approx(0.05**2)
    assert prepared.invalid_ns.size == 2
    assert prepared.variances_replaced == 1


@pytest.mark.parametrize("twist", [NAN, 0.0])
def test_poses_become_the_velocity_of_a_circle_where_the_twist_is_empty(twist):
    # 2 m radius at 0.5 rad/s: forward 1 m/s, in an odom frame of its own; the quaternion's sign flips on the way.
    t = np.arange(50) * 0.1
    turn = Rotation.from_euler("ZYX", np.column_stack((0.5 * t + 2.0, 0 * t, 0 * t)))
    xy = 2.0 * np.column_stack((np.sin(0.5 * t + 2.0), -np.cos(0.5 * t + 2.0)))
    quat = turn.as_quat() * np.where(np.arange(50) % 3 == 0, -1, 1)[:, None]
    columns = odometry_columns(50, x_m=xy[:, 0], y_m=xy[:, 1], z_m=0 * t)
    columns |= {f"quat_{c}": quat[:, k] for k, c in enumerate("xyzw")}
    columns |= {f"velocity_{axis}_mps": np.full(50, twist) for axis in "xyz"}
    found, prepared = twists(columns)
    assert [(of.code, of.subject.name) for of in prepared.findings] == [("pose-increments", "visual_odometry")]
    chord = 2 * 2.0 * np.sin(0.025) / 0.1  # a chord is shorter than its arc
    assert found.velocity_mps == pytest.approx(np.tile([chord, 0, 0], (49, 1)), abs=1e-9)
    assert found.yaw_rate_radps == pytest.approx(np.full(49, 0.5), abs=1e-9)
    assert found.stamp_ns.tolist() == (stamps(50)[:-1] + 50_000_000).tolist()


def test_a_robot_that_stands_has_a_twist_of_zero():
    columns = odometry_columns(5, x_m=np.ones(5), y_m=np.ones(5), z_m=np.zeros(5))
    found, prepared = twists(columns | {f"velocity_{axis}_mps": np.zeros(5) for axis in "xyz"}, only_forward=True)
    assert prepared.findings == ()
    assert found.velocity_mps[:, 0].tolist() == [0.0] * 5


def prepared_imu(force, rate, quat=None, *, period_ns=100_000_000, **placed):
    columns = imu_columns(force, rate, quat)
    given = {"xyz_m": ARM, "quat_xyzw": (0, 0, 0, 1), "gyro_std_radps": 0.003, "accelerometer_std_mps2": 0.1}
    return prepare_imu(stamps(len(force), period_ns), columns, **given | placed)


def imu_columns(force, rate, quat=None):
    count = len(force)
    columns = {f"linear_acceleration_{a}_mps2": np.asarray(force, float)[:, k] for k, a in enumerate("xyz")}
    columns |= {f"angular_velocity_{a}_radps": np.asarray(rate, float)[:, k] for k, a in enumerate("xyz")}
    quat = np.full((count, 4), NAN) if quat is None else np.asarray(quat, float)
    return columns | {f"quat_{c}": quat[:, k] for k, c in enumerate("xyzw")}


def test_imu_is_turned_by_its_mounting_orientation_too():
    # robot_localization's test1: rolled by +90° and yawed by -90°, so that the unit's y axis points up.
    mounting = Rotation.from_euler("xyz", [np.pi / 2, 0, -np.pi / 2])
    attitude = Rotation.from_euler("ZYX", [0.5, 0.1, -0.2])
    up = attitude.inv().apply([0, 0, 9.8])
    force, rate = mounting.inv().apply(np.tile(up, (9, 1))), mounting.inv().apply(np.tile([0.1, 0.2, 0.3], (9, 1)))
    quat = np.tile((attitude * mounting).as_quat(), (9, 1))
    found, prepared = prepared_imu(force, rate, quat, quat_xyzw=tuple(mounting.as_quat()))
    assert found.specific_force_mps2[0] == pytest.approx(up)
    assert found.angular_velocity_radps[0] == pytest.approx([0.1, 0.2, 0.3])
    assert found.quat_xyzw[0] == pytest.approx(attitude.as_quat(canonical=True))
    assert found.accelerometer_usable
    assert prepared.findings == ()


def test_noise_is_what_the_samples_show_where_that_is_more():
    rng = np.random.default_rng(7)
    force = [0, 0, 9.8] + rng.normal(size=(5000, 3)) * [0.2, 0.5, 0.1]
    found, _ = prepared_imu(force, rng.normal(size=(5000, 3)) * 0.001)
    assert found.accelerometer_std_mps2 == pytest.approx(0.5, rel=0.05)
    assert found.gyro_std_radps == 0.003


def test_the_force_is_moved_to_base_link():
    # Turning at 0.5 rad/s and faster by 0.2 rad/s each second: a unit 2 m ahead feels -0.5 m/s² along and 0.4 m/s² across.
    t = np.arange(200) * 0.01
    rate = np.column_stack((0 * t, 0 * t, 0.2 * t + 0.5))
    force = np.column_stack((-2.0 * rate[:, 2] ** 2, 0 * t + 0.4, 0 * t + 9.8))
    found, _ = prepared_imu(force, rate, period_ns=10_000_000, xyz_m=(2.0, 0.0, 0.3))
    assert found.specific_force_mps2[3:-3] == pytest.approx(np.tile([0.0, 0.0, 9.8], (194, 1)), abs=1e-9)


@pytest.mark.parametrize("norm", [1.0, 0.05])
def test_a_force_in_g_or_without_gravity_is_not_used(norm):
    found, prepared = prepared_imu(np.tile([0, 0, norm], (9, 1)), np.zeros((9, 3)))
    assert not found.accelerometer_usable
    (finding,) = prepared.findings
    assert (finding.code, finding.numbers) == ("specific-force-implausible", {"force_mps2": pytest.approx(norm)})


def test_a_receivers_velocity_has_a_deviation_always_and_a_vast_one_where_it_tells_no_climb():
    velocity = np.array([[1.0, 2.0, NAN], [1.0, 2.0, 0.1], [NAN, 0.0, 0.0], [99.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    variance = np.array([[0.04, 0.04, NAN], [NAN, NAN, NAN], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1e-9, 0.09, 0.16]])
    columns = {f"{axis}_velocity_mps": velocity[:, i] for i, axis in enumerate(("east", "north", "up"))}
    columns |= {f"{axis}_var_m2ps2": variance[:, i] for i, axis in enumerate(("east", "north", "up"))}
    found, prepared = prepare_ground_velocities(stamps(5), columns, default_std_mps=0.1)
    assert found.stamp_ns.tolist() == stamps(5)[[0, 1, 4]].tolist()
    assert prepared.invalid_ns.tolist() == stamps(5)[[2, 3]].tolist()
    assert found.velocity_enu_mps.tolist() == [[1.0, 2.0, 0.0], [1.0, 2.0, 0.1], [1.0, 1.0, 0.0]]
    wanted = [[0.04, 0.04, 1e6], [0.02, 0.065, 0.16], [0.0004, 0.09, 0.16]]  # unknown: the median of the stated
    assert found.variance_m2ps2 == pytest.approx(np.array(wanted))


def driven_fixes(repeat, speed=1.0):
    """Fixes at 10 Hz along x, of which each in ``repeat`` is the one before; and wheels."""
    stamp = stamps(100)
    place = np.column_stack((0.1 * speed * np.arange(100), np.zeros((100, 2))))
    for row in repeat:
        place[row] = place[row - 1]
    wheels = BodyVelocities(stamp, *(np.full((100, 3), speed),) * 2, np.zeros(100))
    return Positions(stamp, place, np.ones((100, 3)), unclaimed=np.arange(100) > 50), wheels


def test_fixes_that_hang_while_the_robot_drives_are_left_out_and_named():
    gnss, wheels = driven_fixes(range(30, 51))
    found, repeats = drop_repeated_fixes(gnss, wheels)
    assert found.stamp_ns.tolist() == np.delete(gnss.stamp_ns, range(30, 51)).tolist()
    assert found.unclaimed.sum() == 49
    assert repeats == [[int(gnss.stamp_ns[29]), int(gnss.stamp_ns[50]), 21]]


@pytest.mark.parametrize("often", [2, 12])
def test_a_slow_receiver_that_is_published_more_often_is_slow(often):
    """Every second fix, or one in 1.2 s, is new: nothing hangs."""
    gnss, wheels = driven_fixes(row for row in range(100) if row % often)
    for odometry in (wheels, None):
        found, repeats = drop_repeated_fixes(gnss, odometry)
        assert found.stamp_ns.tolist() == gnss.stamp_ns[::often].tolist()
        assert repeats == []


def test_fixes_of_a_stationary_robot_may_repeat():
    gnss, wheels = driven_fixes(range(30, 51))
    at_rest = replace(wheels, velocity_mps=0.0 * wheels.velocity_mps)
    assert drop_repeated_fixes(gnss, at_rest)[1] == []
    assert drop_repeated_fixes(gnss, None) == (gnss, [])
    never = replace(gnss, position_enu_m=np.zeros((100, 3)))
    assert drop_repeated_fixes(never, wheels) == (never, [])
