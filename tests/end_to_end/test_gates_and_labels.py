"""Gate, segment and label over simulated drives, against the simulator's truth: what is dropped, what is kept, what each metre cost."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.robot_files import shipped_profiles
from tcpipe.recipe import FuseConfig, GateConfig, LabelConfig, ReadConfig, SegmentConfig
from tcpipe.simulation import Faults, read_truth, scenario, simulate, tiny, true_cost
from tcpipe.simulation.messages import Recorder
from tcpipe.stages.fuse import fuse_run
from tcpipe.stages.gate import gate_track
from tcpipe.stages.label import label_segments
from tcpipe.stages.read import read_run
from tcpipe.stages.segment import segment_track
from tcpipe.tables.bits import DropReason
from tcpipe.tables.columns import floats, integers


def run(site, *, config=None):
    with open_log(site.logs[0]) as log:
        streams = read_run(log, ReadConfig(), robot="husky", known=shipped_profiles())
    track = fuse_run(streams, FuseConfig(), run_id="run")
    gated = gate_track(track, config or GateConfig(), max_velocity_mps=1.0, chord_m=1.0)
    segments = segment_track(gated, SegmentConfig())
    labelled = label_segments(
        segments,
        gated,
        streams,
        LabelConfig(),
        voltage_range_volt=(20.0, 30.0),
    )
    return gated, labelled, read_truth(site.truths[0])


@pytest.fixture(scope="module")
def manoeuvres(tmp_path_factory):
    """One of each manoeuvre, with noisy, slipping sensors."""
    plan = scenario("manoeuvres")
    noisy = Faults(
        gnss_noise=True, imu_noise=True, wheel_noise=True, wheel_slip=True, visual_noise=True, power_noise=True
    )
    plan = replace(plan, drives=tuple(replace(drive, faults=noisy) for drive in plan.drives))
    return run(simulate(tmp_path_factory.mktemp("manoeuvres"), scenario=plan, seed=3))


def row_truth(gated, truth):
    return truth.at(integers(gated.table, "stamp_ns"))


def dropped(gated, reason):
    return (gated.table["dropped_by"].to_numpy() & np.uint32(reason)) != 0


def test_each_manoeuvre_is_dropped_for_its_own_reason(manoeuvres):
    gated, _, truth = manoeuvres
    at = row_truth(gated, truth)
    v, w = at.forward_velocity_mps, at.angular_velocity_radps[:, 2]
    kinds = {
        DropReason.STUCK: (at.wheel_velocity_mps > 0.35) & (np.abs(v) < 0.02),
        DropReason.STANDING: (np.abs(v) < 0.01) & (np.abs(w) < 0.01) & (np.abs(at.wheel_velocity_mps) < 0.05),
        DropReason.TURNING_IN_PLACE: (np.abs(v) < 0.03) & (np.abs(w) > 0.2),
        DropReason.REVERSING: v < -0.1,
        DropReason.BELOW_LIMIT: (at.command_velocity_mps < 0.9) & (v > 0.1),
    }
    for reason, truly in kinds.items():
        assert truly.sum() > 30
        assert dropped(gated, reason)[truly].mean() > 0.95, reason
        assert not dropped(gated, reason)[kept_by_truth(at)].any(), reason


def kept_by_truth(at):
    """Rows of steady full speed: commanded so for the last 2.2 s and the next 0.6 s, on no tight curve."""
    full = at.command_velocity_mps > 0.96
    steady = full & (np.abs(at.forward_velocity_mps) > 2.0 * np.abs(at.angular_velocity_radps[:, 2]))
    return np.array([steady[max(k - 44, 0) : k + 12].all() for k in range(len(steady))])


def test_steady_driving_is_kept(manoeuvres):
    gated, labelled, truth = manoeuvres
    steady = kept_by_truth(row_truth(gated, truth))
    assert (gated.table["dropped_by"].to_numpy()[steady] == 0).mean() > 0.99
    assert sum(labelled.ledger_m.values()) == pytest.approx(truth.distance_m[-1], rel=0.02)


def test_no_segment_contains_standing_or_turning_in_place(manoeuvres):
    _, labelled, truth = manoeuvres
    v, w = np.abs(truth.forward_velocity_mps), np.abs(truth.angular_velocity_radps[:, 2])
    bad = ((v < 0.05) & (w < 0.05)) | ((v < 0.10) & (w > 0.10)) | (v < 0.5 * w) | (truth.forward_velocity_mps < 0)
    sums = np.concatenate(([0], np.cumsum(bad)))
    first, last = (np.searchsorted(truth.stamp_ns, integers(labelled.table, name)) for name in ("start_ns", "end_ns"))
    assert len(first) > 20
    assert (sums[last] == sums[first]).all()


@pytest.mark.parametrize("power", ["husky_status", "clearpath_power"])
def test_labels_are_as_wrong_as_they_say(power, tmp_path_factory):
    plan = tiny(Faults.every(), recorder=Recorder("ros1" if power == "husky_status" else "ros2", power), seconds=240.0)
    _, labelled, truth = run(simulate(tmp_path_factory.mktemp(power), scenario=plan, seed=4))
    true = true_cost(truth, integers(labelled.table, "start_ns"))
    for name in ("duration_s", "velocity_mps", "power_watt", "energy_joule"):
        quantity, unit = name.rsplit("_", 1)
        error = floats(labelled.table, name) - getattr(true, name)
        assert np.abs(error).sum() < 0.015 * np.abs(getattr(true, name)).sum()
        normalized = error / floats(labelled.table, f"{quantity}_std_{unit}")
        assert len(normalized) > 120
        assert 0.5 < np.sqrt(np.mean(normalized**2)) < 1.5, name
