"""Gate, segment and label over simulated drives, against the simulator's truth: what is dropped, what is kept, what each metre cost."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.geometry.rotation import rpy_from_quat
from tcpipe.recipe import FuseConfig, LabelConfig, MaskConfig, ReadConfig, SegmentConfig
from tcpipe.robots import Robot
from tcpipe.simulation import Faults, compute_true_cost, find_scenario, make_tiny, read_truth, simulate
from tcpipe.simulation.messages import Recorder
from tcpipe.simulation.robot import SimulatedRobot
from tcpipe.simulation.scenarios import RasterSpec
from tcpipe.simulation.sensors import Imu, WheelOdometry
from tcpipe.stages.fuse import fuse_run
from tcpipe.stages.label import label_segments
from tcpipe.stages.mask import mask_track
from tcpipe.stages.read import read_run
from tcpipe.stages.segment import segment_track
from tcpipe.tables.bits import DropReason
from tcpipe.tables.columns import to_floats, to_integers

COARSE = RasterSpec(1.0, 1.0, 1.0)
"""Rasters that no test looks at."""


def run(site):
    with open_log(site.logs[0]) as log:
        streams = read_run(log, ReadConfig(), robot="husky", known=load_shipped_profiles())
    track = fuse_run(streams, FuseConfig(), run_id="run")
    masked = mask_track(track, MaskConfig(), max_velocity_mps=1.0, chord_m=1.0)
    segments = segment_track(masked, SegmentConfig())
    labelled = label_segments(
        segments,
        masked,
        streams,
        LabelConfig(),
        robot=Robot(voltage_range_volt=(20.0, 30.0)),
    )
    return masked, labelled, read_truth(site.truths[0])


@pytest.fixture(scope="module")
def manoeuvres(tmp_path_factory):
    """One of each manoeuvre, with noisy, slipping sensors."""
    plan = find_scenario("manoeuvres")
    noisy = Faults(
        gnss_noise=True, imu_noise=True, wheel_noise=True, wheel_slip=True, visual_noise=True, power_noise=True
    )
    plan = replace(plan, drives=tuple(replace(drive, faults=noisy) for drive in plan.drives), rasters=COARSE)
    return run(simulate(tmp_path_factory.mktemp("manoeuvres"), scenario=plan, seed=3))


def row_truth(masked, truth):
    return truth.at(to_integers(masked.table, "stamp_ns"))


def dropped(masked, reason):
    return (masked.table["dropped_by"].to_numpy() & np.uint32(reason)) != 0


def test_each_manoeuvre_is_dropped_for_its_own_reason(manoeuvres):
    masked, _, truth = manoeuvres
    at = row_truth(masked, truth)
    v, w = at.forward_velocity_mps, at.angular_velocity_radps[:, 2]
    kinds = {
        DropReason.STUCK: (at.wheel_velocity_mps > 0.35) & (np.abs(v) < 0.02),
        DropReason.STATIONARY: (np.abs(v) < 0.01) & (np.abs(w) < 0.01) & (np.abs(at.wheel_velocity_mps) < 0.05),
        DropReason.TURNING_IN_PLACE: (np.abs(v) < 0.03) & (np.abs(w) > 0.2),
        DropReason.REVERSING: v < -0.1,
        DropReason.BELOW_FULL_SPEED: (at.command_velocity_mps < 0.9) & (v > 0.1),
    }
    for reason, truly in kinds.items():
        assert truly.sum() > 30
        assert dropped(masked, reason)[truly].mean() > 0.95, reason
        assert not dropped(masked, reason)[kept_by_truth(at)].any(), reason


def kept_by_truth(at):
    """Rows of steady full speed: commanded so for the last 2.2 s and the next 0.6 s, on no tight curve."""
    full = at.command_velocity_mps > 0.96
    steady = full & (np.abs(at.forward_velocity_mps) > 2.0 * np.abs(at.angular_velocity_radps[:, 2]))
    return np.array([steady[max(k - 44, 0) : k + 12].all() for k in range(len(steady))])


def test_steady_driving_is_kept(manoeuvres):
    masked, labelled, truth = manoeuvres
    steady = kept_by_truth(row_truth(masked, truth))
    assert (masked.table["dropped_by"].to_numpy()[steady] == 0).mean() > 0.99
    assert sum(labelled.distance_by_reason_m.values()) == pytest.approx(truth.distance_m[-1], rel=0.02)


def test_no_segment_contains_standing_or_turning_in_place(manoeuvres):
    _, labelled, truth = manoeuvres
    v, w = np.abs(truth.forward_velocity_mps), np.abs(truth.angular_velocity_radps[:, 2])
    bad = ((v < 0.05) & (w < 0.05)) | ((v < 0.10) & (w > 0.10)) | (v < 0.5 * w) | (truth.forward_velocity_mps < 0)
    sums = np.concatenate(([0], np.cumsum(bad)))
    first, last = (
        np.searchsorted(truth.stamp_ns, to_integers(labelled.table, name)) for name in ("start_ns", "end_ns")
    )
    assert len(first) > 20
    assert (sums[last] == sums[first]).all()


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    """Two minutes with every sensor fault, from a ROS 1 bag; the demo of test_whole_pipeline.py is a ROS 2 log."""
    plan = make_tiny(Faults.every(), recorder=Recorder("ros1", "husky_status"), seconds=110.0)
    return run(simulate(tmp_path_factory.mktemp("faulty"), scenario=replace(plan, rasters=COARSE), seed=4))


def spans(labelled):
    return tuple(to_integers(labelled.table, name) for name in ("start_ns", "end_ns"))


def meant(truth, values, labelled):
    """Return the mean of a series of the truth over every segment."""
    total = np.concatenate(([0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(truth.stamp_ns))))
    start_ns, end_ns = spans(labelled)
    at = [np.interp(at_ns, truth.stamp_ns, total) for at_ns in (start_ns, end_ns)]
    return (at[1] - at[0]) / (end_ns - start_ns)


def test_net_energy_is_as_wrong_as_it_says(faulty):
    _, labelled, truth = faulty
    true, idle = compute_true_cost(truth, spans(labelled)[0]), SimulatedRobot().idle_watt
    for name, wanted in (
        ("idle_power_watt", np.full(labelled.table.num_rows, idle)),
        ("net_power_watt", true.power_watt - idle),
        ("net_energy_joule", true.energy_joule - idle * true.duration_s),
    ):
        quantity, unit = name.rsplit("_", 1)
        normalized = (to_floats(labelled.table, name) - wanted) / to_floats(labelled.table, f"{quantity}_std_{unit}")
        assert np.sqrt(np.mean(normalized**2)) < 1.5, name
    assert to_floats(labelled.table, "idle_power_std_watt").max() < 2.0
    identity = to_floats(labelled.table, "net_power_watt") * to_floats(labelled.table, "duration_s")
    assert to_floats(labelled.table, "net_energy_joule") == pytest.approx(identity)
    assert to_floats(labelled.table, "voltage_volt") == pytest.approx(
        meant(truth, truth.voltage_volt, labelled), abs=0.02
    )


def test_turns_attitude_slip_and_vibration_are_the_robots(faulty):
    _, labelled, truth = faulty
    table, (start_ns, end_ns) = labelled.table, spans(labelled)
    roll, pitch, yaw = rpy_from_quat(truth.quat_xyzw).T
    turn = np.interp(end_ns, truth.stamp_ns, np.unwrap(yaw)) - np.interp(start_ns, truth.stamp_ns, np.unwrap(yaw))
    arc = np.interp(end_ns, truth.stamp_ns, truth.distance_m) - np.interp(start_ns, truth.stamp_ns, truth.distance_m)
    turn_rate = meant(truth, np.abs(truth.angular_velocity_radps[:, 2]), labelled)
    wheel_mps = meant(truth, truth.wheel_velocity_mps, labelled)
    slip = 1 - meant(truth, truth.forward_velocity_mps, labelled) / (WheelOdometry().scale * wheel_mps)
    for name, wanted in (
        ("yaw_change_rad", turn),
        ("mean_abs_yaw_rate_radps", turn_rate),
        ("curvature_radpm", turn / arc),
        ("slip_fraction", slip),
    ):
        quantity, unit = name.rsplit("_", 1)
        normalized = (to_floats(table, name) - wanted) / to_floats(table, f"{quantity}_std_{unit}")
        assert 0.5 < np.sqrt(np.mean(normalized**2)) < 1.5, name
    middle_ns = start_ns + (end_ns - start_ns) // 2
    for name, angle in (("roll_rad", roll), ("pitch_rad", pitch)):
        # The mounting of an IMU is stated to a degree.
        assert to_floats(table, name) == pytest.approx(np.interp(middle_ns, truth.stamp_ns, angle), abs=0.0175)
    # White noise of three axes at 100 Hz, of which the band, half passed at its edges, passes 14.4 of 50 Hz.
    white = np.hypot(Imu().vibration_mps2 * wheel_mps, Imu().accelerometer_std_mps2)
    ratio = to_floats(table, "vibration_mps2") / (white * np.sqrt(3 * 14.4 / 50))
    assert np.median(ratio) == pytest.approx(1.0, abs=0.03)
    assert ratio.std() < 0.12
