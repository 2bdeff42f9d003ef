"""Turn, slip and attitude of segments of a track that is written down by formula."""

import numpy as np
import pytest
from made_tracks import make_track, power_streams, stamps, straight_track

from tcpipe.recipe import LabelConfig, MaskConfig, SegmentConfig
from tcpipe.stages.label import label_segments
from tcpipe.stages.mask import mask_track
from tcpipe.stages.segment import segment_track
from tcpipe.tables.columns import to_floats
from tcpipe.tables.levels import IMU, Sensor, Streams

T = np.arange(0, 30, 0.05)


def labelled(track, streams=None):
    masked = mask_track(track, MaskConfig(), max_velocity_mps=1.0, chord_m=1.0)
    segments = segment_track(masked, SegmentConfig())
    given = streams or Streams({}, {}, "husky")
    table = label_segments(segments, masked, given, LabelConfig(), voltage_range_volt=None).table
    assert table.num_rows > 10
    return table


@pytest.mark.parametrize("side", [1, -1])
def test_a_circle_turns_by_its_radius_across_the_cut_of_the_yaw(side):
    angle = 0.8 * T / 4.0
    circle = 4.0 * np.column_stack((np.cos(angle), side * np.sin(angle), 0 * angle))
    velocity = 0.8 * np.column_stack((-np.sin(angle), side * np.cos(angle), 0 * angle))
    table = labelled(make_track(circle, velocity, yaw_rate_radps=np.full(len(T), side * 0.2)))
    duration_s = 2 * np.arcsin(1 / 8) * 4.0 / 0.8
    assert to_floats(table, "yaw_change_rad") == pytest.approx(side * 0.2 * duration_s, rel=1e-4)
    assert to_floats(table, "mean_abs_yaw_rate_radps") == pytest.approx(0.2)
    assert to_floats(table, "curvature_radpm") == pytest.approx(side / 4.0, rel=1e-4)
    assert np.isnan(to_floats(table, "yaw_change_std_rad")).all()
    assert table["vibration_mps2"].null_count == table.num_rows


def test_turns_that_cancel_are_a_turn_rate_and_no_turn():
    rate = 0.3 * np.sign(np.sin(2 * np.pi * T / 0.4 + 0.1))
    table = labelled(straight_track(np.full(len(T), 0.8), yaw_rate_radps=rate))
    assert to_floats(table, "yaw_change_rad") == pytest.approx(0.0, abs=1e-9)
    assert (to_floats(table, "mean_abs_yaw_rate_radps") > 0.2).all()


def test_slip_is_of_the_wheels_and_unknown_without_them():
    speed = np.full(len(T), 0.8)
    table = labelled(straight_track(speed, wheel_mps=np.full(len(T), 1.0)))
    assert to_floats(table, "slip_fraction") == pytest.approx(0.2)
    assert to_floats(table, "slip_std_fraction") == pytest.approx(
        0.8 * to_floats(table, "velocity_std_mps") / to_floats(table, "velocity_mps")
    )
    assert labelled(straight_track(speed))["slip_fraction"].null_count > 10
    standing = labelled(straight_track(speed, wheel_mps=np.zeros(len(T))))
    assert standing["slip_fraction"].null_count == standing.num_rows


@pytest.mark.parametrize(("gravity", "known"), [(9.81, True), (1.0, False), (0.0, False)])
def test_an_accelerometer_in_another_unit_or_without_gravity_tells_no_vibration(gravity, known):
    n = 6000
    shake = np.random.default_rng(0).normal(0.0, 0.3, (n, 3)) + np.array([0.0, 0.0, gravity])
    stamp_ns = stamps(n, step_ns=5_000_000)
    given = {name: np.zeros(n) for name in IMU.names()}
    given |= {f"linear_acceleration_{axis}_mps2": shake[:, k] for k, axis in enumerate("xyz")}
    given |= {"stamp_ns": stamp_ns, "log_time_ns": stamp_ns, "clock_epoch": np.zeros(n, np.int16)}
    sensor = Sensor("/imu", "sensor_msgs/msg/Imu", "imu_link", "why")
    streams = Streams({"imu": IMU.table(**given)}, {"imu": sensor}, "husky")
    found = to_floats(labelled(straight_track(np.full(len(T), 0.8)), streams), "vibration_mps2")
    wanted = 0.3 * np.sqrt(3 * 14.4 / 100) if known else np.nan  # white noise passes the band as 14.4 Hz of 100
    assert np.median(found) == pytest.approx(wanted, rel=0.05, nan_ok=True)


def test_power_above_standing_of_a_robot_that_stands_first():
    speed = np.where(T < 6, 0.0, np.minimum((T - 6) * 0.8, 0.8))
    watts = np.where(T < 6, 90.0, 240.0)
    stamp_ns = stamps(len(T))
    streams = power_streams({"pack": (stamp_ns, np.full(len(T), 24.0), watts / 24.0)})
    table = labelled(straight_track(speed, power_watt=watts), streams)
    assert to_floats(table, "idle_power_watt") == pytest.approx(90.0)
    assert to_floats(table, "net_power_watt") == pytest.approx(150.0)
    assert to_floats(table, "net_energy_joule") == pytest.approx(150.0 * 1.25)
    never = labelled(straight_track(np.full(len(T), 0.8), power_watt=watts), streams)
    assert never["net_energy_joule"].null_count == never.num_rows
    assert never["energy_joule"].null_count == 0
