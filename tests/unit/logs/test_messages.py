"""Values of messages, row by row."""

import numpy as np
import pytest

from tcpipe.logs import roles
from tcpipe.logs.messages import Readings, count_frames, find_utc_offset, read_messages
from tcpipe.stages.read_sources import convert_imu_to_si

S = 1_000_000_000
N = 12


def with_times(rows: int = N, **columns) -> dict[str, np.ndarray]:
    stamps = 1_700_000_000 * S + np.arange(rows) * S // 10
    return {
        "log_time_ns": stamps + 1_000_000,
        "header.stamp.sec": (stamps // S).astype(np.int32),
        "header.stamp.nanosec": (stamps % S).astype(np.uint32),
        "header.frame_id": np.full(rows, "/sensor"),
        **columns,
    }


def vectors(prefix: str, values: np.ndarray, names: str = "xyz") -> dict[str, np.ndarray]:
    return {f"{prefix}.{c}": values[:, i] for i, c in enumerate(names)}


def covariance(size: int, *diagonal: float) -> np.ndarray:
    matrix = np.zeros((N, size * size))
    for i, value in enumerate(diagonal):
        matrix[:, i * (size + 1)] = value
    return matrix


def nav_sat_fix() -> dict[str, np.ndarray]:
    return with_times(
        latitude=np.linspace(47.0, 47.1, N),
        longitude=np.full(N, 15.4),
        altitude=np.full(N, 400.0),
        **{"status.status": np.ones(N, np.int8)},
        position_covariance=covariance(3, 0.01, 0.02, 0.09),
        position_covariance_type=np.full(N, 2, np.uint8),
    )


def test_fixes_are_kept_and_everything_else_is_counted_once() -> None:
    columns = nav_sat_fix()
    columns["status.status"][0] = -1
    columns["latitude"][0] = np.nan  # no fix already
    columns["longitude"][1] = np.inf
    columns["latitude"][2] = columns["longitude"][2] = 0.0
    columns["longitude"][3] = 181.0
    found = read_messages(columns, "gnss", roles.NAV_SAT_FIX)
    assert found.dropped == {"no_fix": 1, "not_finite": 1, "null_island": 1, "outside_the_globe": 1}
    assert found.row.tolist() == list(range(4, N))
    assert found.header_ns is not None
    assert (found.log_time_ns - found.header_ns == 1_000_000).all()
    assert found.columns["east_var_m2"][0] == 0.01
    assert found.columns["north_var_m2"][0] == 0.02
    assert found.columns["up_var_m2"][0] == 0.09
    assert found.columns["fix_status"].dtype == np.int8


def test_a_covariance_that_says_nothing_is_null() -> None:
    columns = nav_sat_fix()
    columns["status.status"][:] = 0  # says nothing either
    columns["position_covariance_type"][:4] = 0
    columns["position_covariance"][4:8] = 0.0
    columns["position_covariance"][8, 8] = -1.0
    found = read_messages(columns, "gnss", roles.NAV_SAT_FIX)
    assert np.isnan(found.columns["east_var_m2"]).tolist() == [True] * 8 + [False] * 4
    assert np.isnan(found.columns["up_var_m2"]).tolist() == [True] * 9 + [False] * 3
    assert found.notes["without_covariance"] == 8


@pytest.mark.parametrize("count", [3, 200])
def test_a_fix_without_altitude_is_a_fix(count: int) -> None:
    """NavSatFix has NaN then; a receiver in two dimensions repeats one height."""
    columns = {name: np.resize(values, (count, *values.shape[1:])) for name, values in nav_sat_fix().items()}
    columns["altitude"] = 400.0 + np.zeros(count)
    columns["altitude"][1] = np.nan
    found = read_messages(columns, "gnss", roles.NAV_SAT_FIX)
    assert found.row.size == count
    assert (found.columns["alt_m"] == 400.0).all()
    without = found.columns["up_var_m2"] > 1e5
    assert without.sum() == (1 if count == 3 else count)
    (missing,) = found.findings
    assert missing.code == "altitude-missing"
    assert missing.numbers == {"missing_count": without.sum(), "fixes_count": count}
    assert np.isfinite(found.columns["east_var_m2"]).all()


GGA = "$GPGGA,123519,4807.038,N,01131.000,E,{},08,{},545.4,M,{},M,,"


def test_gga_heights_are_ellipsoidal_and_hdop_gives_a_rough_variance() -> None:
    sentences = [
        GGA.format(4, 0.5, 46.9),
        "$GPRMC,1,A*00",
        GGA.format(0, 0.9, 46.9),
        GGA.format(5, "", ""),
        GGA.format(1, 2.0, 46.9),
    ]
    columns = with_times(5, sentence=np.array(sentences))
    found = read_messages(columns, "gnss", roles.NMEA_SENTENCE)
    assert found.row.tolist() == [0, 3, 4]
    assert found.dropped == {"not_gga": 1, "no_fix": 1}
    np.testing.assert_allclose(found.columns["alt_m"], 592.3)  # the second takes the others' separation
    assert found.notes == {"without_separation": 1, "std_by_quality": 3}
    assert found.columns["fix_status"].tolist() == [2, 2, 0]
    np.testing.assert_allclose(found.columns["east_var_m2"], [0.01**2, 0.5**2, 8.0**2])
    np.testing.assert_allclose(found.columns["up_var_m2"], [0.02**2, 1.0**2, 16.0**2])
    assert found.own_time_ns is not None
    assert (found.own_time_ns % (86_400 * S) == 45_319 * S).all()


def test_gga_whose_clock_is_not_the_computers_warns() -> None:
    noon = 1_700_000_000 * S // (86_400 * S) * (86_400 * S) + 45_319 * S  # 12:35:19 of that day
    for late_ns, warned in ((100_000_000, False), (700_000_000, True)):
        stamps = np.full(3, noon + late_ns)
        columns = {
            "log_time_ns": stamps,
            "header.stamp.sec": stamps // S,
            "header.stamp.nanosec": stamps % S,
            "sentence": np.full(3, GGA.format(1, 1.0, 46.9)),
        }
        found = read_messages(columns, "gnss", roles.NMEA_SENTENCE)
        assert found.own_time_ns.tolist() == [noon] * 3
        offsets = [of.numbers["offset_s"] for of in find_utc_offset(found)]
        assert offsets == ([pytest.approx(-0.7)] if warned else [])


def test_gga_without_any_separation_warns() -> None:
    found = read_messages(with_times(2, sentence=np.full(2, GGA.format(1, 1.0, ""))), "gnss", roles.NMEA_SENTENCE)
    assert found.columns["alt_m"].tolist() == [545.4, 545.4]
    assert [of.code for of in found.findings] == ["geoid-separation-missing"]


def imu() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    yaw = np.linspace(0.1, 0.6, N)
    quat = np.stack((0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)), -1)
    return with_times(
        **vectors("angular_velocity", rng.normal(size=(N, 3))),
        **vectors("linear_acceleration", rng.normal((0.0, 0.0, 9.8), size=(N, 3))),
        **vectors("orientation", quat, "xyzw"),
        angular_velocity_covariance=covariance(3, 1.0, 2.0, 6.0),
        linear_acceleration_covariance=covariance(3),
        orientation_covariance=covariance(3, 0.1, 0.1, 0.1),
    )


def test_imu_values_variances_and_orientation() -> None:
    columns = imu()
    found = read_messages(columns, "imu", roles.IMU)
    np.testing.assert_array_equal(found.columns["linear_acceleration_z_mps2"], columns["linear_acceleration.z"])
    assert (found.columns["angular_velocity_var"] == 3.0).all()
    assert np.isnan(found.columns["linear_acceleration_var"]).all()
    np.testing.assert_allclose(found.columns["quat_z"], columns["orientation.z"], rtol=1e-14)
    assert found.findings == ()


def test_an_orientation_that_is_absent_zero_or_no_unit_is_null() -> None:
    columns = imu()
    columns["orientation_covariance"][0, 0] = -1
    for c in "xyzw":
        columns[f"orientation.{c}"][1] = 0.0
        columns[f"orientation.{c}"][2] *= 1.5
    found = read_messages(columns, "imu", roles.IMU)
    assert np.isnan(found.columns["quat_w"]).tolist() == [True] * 3 + [False] * (N - 3)
    assert np.isnan(found.columns["orientation_var"]).tolist() == [True] * 3 + [False] * (N - 3)
    assert found.notes == {"without_orientation": 1, "bad_quaternions": 2}
    assert len(found.row) == N


def test_an_orientation_that_never_changes_is_no_orientation() -> None:
    columns = imu() | vectors("orientation", np.tile([0.0, 0.0, 0.0, 1.0], (N, 1)), "xyzw")
    found = read_messages(columns, "imu", roles.IMU)
    assert np.isnan(found.columns["quat_w"]).all()
    assert [of.code for of in found.findings] == ["orientation-constant"]


def odometry(speed_mps: float = 0.5) -> dict[str, np.ndarray]:
    linear = np.tile([speed_mps, 0.0, 0.0], (N, 1))
    position = np.stack((np.arange(N) * 0.05, np.zeros(N), np.zeros(N)), -1)
    return with_times(
        child_frame_id=np.full(N, "/base_link"),
        **vectors("twist.twist.linear", linear),
        **vectors("twist.twist.angular", np.tile([0.0, 0.0, 0.1 * speed_mps], (N, 1))),
        **{"twist.covariance": covariance(6, 0.01, 0.02, 0.0, 0.04, 0.05, 0.06), "pose.covariance": covariance(6)},
        **vectors("pose.pose.position", position),
        **vectors("pose.pose.orientation", np.tile([0.0, 0.0, 0.0, 1.0], (N, 1)), "xyzw"),
    )


@pytest.mark.parametrize("role", ["wheel_odometry", "visual_odometry"])
def test_odometry_gives_twist_and_pose(role: str) -> None:
    found = read_messages(odometry(), role, roles.ODOMETRY)
    assert (found.columns["velocity_x_mps"] == 0.5).all()
    assert (found.columns["angular_velocity_z_radps"] == 0.05).all()
    assert found.columns["velocity_var_x_m2ps2"][0] == 0.01
    assert np.isnan(found.columns["velocity_var_z_m2ps2"]).all()  # zero is not trust
    assert found.columns["yaw_rate_var"][0] == 0.06
    np.testing.assert_array_equal(found.columns["x_m"], np.arange(N) * 0.05)


@pytest.mark.parametrize("word", [-1.0, 1e3, 1e6, 1e9])
def test_what_a_covariance_calls_unmeasured_is_null(word: float) -> None:
    columns = odometry()
    columns["twist.covariance"] = covariance(6, 0.01, 0.02, word, word, word, 0.06)
    columns["twist.covariance"][0, 35] = word
    columns["twist.twist.angular.x"][:] = 0.2
    found = read_messages(columns, "visual_odometry", roles.ODOMETRY).columns
    for name in ("velocity_z_mps", "angular_velocity_x_radps", "angular_velocity_y_radps"):
        assert np.isnan(found[name]).all()
    assert np.isnan(found["angular_velocity_z_radps"]).tolist() == [True] + [False] * (N - 1)
    assert (found["velocity_x_mps"] == 0.5).all()
    turned = imu()
    turned["orientation_covariance"][:] = word
    assert np.isnan(read_messages(turned, "imu", roles.IMU).columns["quat_w"]).all()


def test_an_axis_that_is_zero_throughout_while_the_robot_moves_is_not_measured() -> None:
    few, many = odometry(), {name: np.concatenate([values] * 4) for name, values in odometry().items()}
    many["twist.twist.angular.z"][:] = 0.0
    assert (read_messages(few, "wheel_odometry", roles.ODOMETRY).columns["velocity_y_mps"] == 0.0).all()
    found = read_messages(many, "wheel_odometry", roles.ODOMETRY).columns
    for name in ("velocity_y_mps", "angular_velocity_x_radps", "angular_velocity_z_radps", "yaw_rate_var"):
        assert np.isnan(found[name]).all()
    many["twist.twist.linear.x"][:] = 0.0  # a robot that rests turns at 0
    many["pose.pose.position.x"][:] = 3.0
    assert (read_messages(many, "wheel_odometry", roles.ODOMETRY).columns["angular_velocity_z_radps"] == 0.0).all()


def test_an_empty_twist_is_standstill_on_a_resting_pose_alone() -> None:
    columns = odometry(speed_mps=0.0)
    found = read_messages(columns, "visual_odometry", roles.ODOMETRY)
    assert np.isnan(found.columns["velocity_x_mps"]).all()
    assert np.isnan(found.columns["velocity_var_x_m2ps2"]).all()
    assert np.isfinite(found.columns["quat_w"]).all()
    (zero,) = found.findings
    assert (zero.code, zero.subject.name) == ("twist-zero", "visual_odometry")
    assert zero.numbers["moved_m"] == pytest.approx(0.55)  # 11 steps of 5 cm
    columns["pose.pose.position.x"][:] = 3.0
    found = read_messages(columns, "wheel_odometry", roles.ODOMETRY)
    assert (found.columns["velocity_x_mps"] == 0.0).all()
    assert found.findings == ()


def test_twists_measured_and_commanded() -> None:
    linear, angular = np.tile([0.3, 0.0, 0.0], (N, 1)), np.tile([0.0, 0.0, -0.2], (N, 1))
    stamped = with_times(**vectors("twist.linear", linear), **vectors("twist.angular", angular))
    measured = read_messages(stamped, "wheel_odometry", roles.TWIST_STAMPED)
    assert (measured.columns["velocity_x_mps"] == 0.3).all()
    assert np.isnan(measured.columns["x_m"]).all()
    assert np.isnan(measured.columns["yaw_rate_var"]).all()
    commanded = read_messages(stamped, "command", roles.TWIST_STAMPED)
    bare = {"log_time_ns": stamped["log_time_ns"], **vectors("linear", linear), **vectors("angular", angular)}
    without_header = read_messages(bare, "command", roles.TWIST)
    for found in (commanded, without_header):
        assert (found.columns["forward_velocity_mps"] == 0.3).all()
        assert (found.columns["yaw_rate_radps"] == -0.2).all()
    assert without_header.header_ns is None


def test_frames_lose_their_slash_and_the_most_frequent_leads() -> None:
    columns = odometry()
    columns["child_frame_id"] = np.array(["a"] * 4 + ["/base_link", "base_link"] * 4)
    assert count_frames(columns, roles.ODOMETRY) == {"base_link": 8, "a": 4}
    assert count_frames(columns, roles.TWIST_STAMPED) == {"sensor": N}


def ground_twist(velocity, *diagonal) -> dict[str, np.ndarray]:
    return with_times(**vectors("twist.twist.linear", velocity), **{"twist.covariance": covariance(6, *diagonal)})


def test_a_receivers_twist_is_east_north_up() -> None:
    velocity = np.column_stack((np.linspace(0.1, 0.5, N), np.linspace(-1.0, 1.0, N), np.full(N, 0.02)))
    columns = ground_twist(velocity, 0.01, 0.02, 0.03, -1.0)
    columns["twist.covariance"][0, 0] = -1.0
    columns["twist.covariance"][1, 14] = 1e6
    columns["twist.covariance"][2] = 0.0
    columns["twist.twist.linear.y"][3] = np.nan
    found = read_messages(columns, "gnss_velocity", roles.TWIST_WITH_COVARIANCE_STAMPED)
    assert found.dropped == {"not_measured": 1, "not_finite": 1}
    assert found.columns["east_velocity_mps"].tolist() == velocity[[1, 2, *range(4, N)], 0].tolist()
    assert np.isnan(found.columns["up_velocity_mps"]).tolist() == [True] + [False] * (N - 3)
    assert np.isnan(found.columns["east_var_m2ps2"]).tolist() == [False, True] + [False] * (N - 4)
    assert (found.columns["fix_status"] == -1).all()


def test_a_twist_that_never_goes_aside_is_of_the_body() -> None:
    count = 40
    velocity = np.column_stack((np.linspace(0.1, 1.0, count), np.zeros(count), np.zeros(count)))
    columns = with_times(count, **vectors("twist.linear", velocity))
    found = read_messages(columns, "gnss_velocity", roles.TWIST_STAMPED)
    assert found.dropped == {"of_the_body": count}
    assert [of.code for of in found.findings] == ["velocity-not-over-ground"]
    velocity[:, 1] = 0.1
    found = read_messages(with_times(count, **vectors("twist.linear", velocity)), "gnss_velocity", roles.TWIST_STAMPED)
    assert not found.dropped
    assert np.isnan(found.columns["up_velocity_mps"]).all()  # nmea_navsat_driver leaves it zero


def test_gps_fix_tells_speed_and_track_with_their_errors() -> None:
    columns = with_times(
        speed=np.full(N, 2.0), track=np.full(N, 90.0), climb=np.full(N, 0.1), err_speed=np.full(N, 0.2),
        err_track=np.full(N, np.degrees(0.05)), err_climb=np.zeros(N), **{"status.status": np.full(N, 18)},
    )  # fmt: skip
    columns["speed"][0], columns["track"][0] = 0.2, np.nan
    columns["status.status"][1] = -1
    found = read_messages(columns, "gnss_velocity", "gps_common/msg/GPSFix")
    assert found.dropped == {"no_fix": 1}
    assert found.columns["east_velocity_mps"][[0, 1]].tolist() == [0.0, 2.0]
    assert found.columns["north_velocity_mps"][1] == pytest.approx(0.0, abs=1e-12)
    assert found.columns["up_velocity_mps"][1] == 0.1
    assert found.columns["east_var_m2ps2"][[0, 1]] == pytest.approx(
        [0.2**2 / 2 + 0.1**2, 0.1**2]
    )  # 95 per cent: two deviations
    assert np.isnan(found.columns["up_var_m2ps2"]).all()
    assert found.columns["fix_status"].tolist() == [2] * (N - 1)


def test_vtg_takes_the_time_of_the_fix_that_came_with_it() -> None:
    """The receiver sends VTG just before GGA: the nearest in the log is that of the same epoch, not the one before."""
    second = ("$GPVTG,90.0,T,,M,2.0,N,3.7,K,A", "$GPGGA,101325,4807.038,N,01131.000,E,4,08,0.9,545.4,M,46.9,M,,")
    later = ("$GPVTG,90.0,T,,M,2.0,N,3.7,K,A", "$GPGGA,101326,4807.038,N,01131.000,E,4,08,0.9,545.4,M,46.9,M,,")
    day = 1_699_920_000 * S
    at = day + (36_805 * S) + np.array([0, 5_000_000, S, S + 5_000_000])
    columns = {"log_time_ns": at, "sentence": np.array([*second, *later])}
    found = read_messages(columns, "gnss_velocity", roles.NMEA_SENTENCE)
    assert found.row.tolist() == [0, 2]
    assert found.own_time_ns.tolist() == [day + 36_805 * S, day + 36_806 * S]
    assert found.dropped == {"no_velocity": 2}


SI_NAMES = (
    "angular_velocity_z_radps",
    "angular_velocity_var",
    "linear_acceleration_x_mps2",
    "linear_acceleration_var",
    "quat_w",
)


@pytest.mark.parametrize(
    ("units", "wanted"),
    [
        ("si", (1.0, 1.0, 1.0, 1.0, 1.0)),
        ("deg", (0.0174532925, 0.000304617419, 1.0, 1.0, 1.0)),
        ("g", (1.0, 1.0, 9.80665, 96.1703842, 1.0)),
        ("deg_g", (0.0174532925, 0.000304617419, 9.80665, 96.1703842, 1.0)),
    ],
)
def test_imu_units_become_si(units, wanted):
    row = np.arange(2)
    readings = Readings(row, row, None, {name: np.ones(2) for name in SI_NAMES})
    found = convert_imu_to_si(readings, units)
    assert [found.columns[name][1] for name in SI_NAMES] == pytest.approx(wanted)
    assert found.row is row
