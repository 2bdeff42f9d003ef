"""The paper's forward filter on a drive over rough ground whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from rough_drive import drive, initial, measured

from tcpipe.fusion.measurements import GNSS, IMU, VISUAL, WHEELS, Measurements
from tcpipe.fusion.ukf15 import collect_sources, run_ukf15
from tcpipe.fusion.ukf15_kernel import SELECT
from tcpipe.geometry.rotation import invert, rotate, rpy_from_matrix, rpy_from_quat, wrap_to_pi

SETTLED = 100  # rows, 5 s: the start is wrong on purpose


@pytest.fixture(scope="module")
def truth():
    return drive(seconds=90.0, seed=3)


def _run(truth, measurements, start=None, *, engine="compiled", end=-1):
    output_ns = truth.stamp_ns[200:end:10]
    start = initial(truth) if start is None else start
    return run_ukf15(measurements, start, output_ns=output_ns, gate_probability=0.999, engine=engine)


def _errors(truth, trajectory):
    """Error over deviation and error, of the settled rows: east and north [m], up [m], forward velocity [m/s], yaw [rad]."""
    at = truth.at(trajectory.stamp_ns)
    position = trajectory.position_enu_m - truth.position[at]
    forward = rotate(invert(trajectory.quat_xyzw), trajectory.velocity_enu_mps)[:, 0] - truth.body_velocity[at, 0]
    yaw = wrap_to_pi(rpy_from_quat(trajectory.quat_xyzw)[:, 2] - rpy_from_matrix(truth.rotation[at])[:, 2])
    errors = np.column_stack((position, forward, yaw))[SETTLED:]
    std = np.column_stack((trajectory.position_std_m, trajectory.forward_velocity_std_mps, trajectory.yaw_std_rad))[
        SETTLED:
    ]
    return errors, errors / std


def _rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))


@pytest.mark.parametrize("orientation", [True, False])
def test_all_sensors_reach_centimetres_and_know_it(truth, orientation):
    errors, scaled = _errors(truth, _run(truth, measured(truth, 1, orientation=orientation)))
    assert _rms(np.hypot(errors[:, 0], errors[:, 1])) < 0.02
    assert (_rms(errors)[2:] < [0.02, 0.03, np.radians(0.8)]).all()
    assert (_rms(scaled) < 1.3).all()
    assert (_rms(scaled) > 0.3).all()


@pytest.mark.parametrize(
    ("absent", "within_m"),
    [
        (("visual",), 0.03),
        (("wheels",), 0.03),
        (("wheels", "visual"), 0.03),
        (("imu",), 0.10),
        (("imu", "visual"), 0.12),
        (("imu", "wheels", "visual"), 0.12),
        (("gnss",), 5.0),
    ],
)
def test_goes_on_without_a_sensor(truth, absent, within_m):
    trajectory = _run(truth, replace(measured(truth, 2), **dict.fromkeys(absent)))
    errors, scaled = _errors(truth, trajectory)
    assert _rms(np.hypot(errors[:, 0], errors[:, 1])) < within_m
    assert (_rms(scaled) < 1.7).all()


def test_a_jump_of_the_gnss_is_refused_and_listed(truth):
    measurements = measured(truth, 5)
    gnss = measurements.gnss
    jump = (gnss.stamp_ns >= truth.stamp_ns[6000]) & (gnss.stamp_ns < truth.stamp_ns[6400])
    position = gnss.position_enu_m + jump[:, None] * [3.0, -2.0, 0.0]
    trajectory = _run(truth, replace(measurements, gnss=replace(gnss, position_enu_m=position)))
    rejections = trajectory.rejections
    refused = rejections.stamp_ns[rejections.role == GNSS]
    assert set(gnss.stamp_ns[jump].tolist()) <= set(refused.tolist())
    assert refused.size < jump.sum() + 5
    assert (rejections.reason == "gate").all()
    assert (rejections.normalized_innovation_squared > rejections.threshold).all()
    assert rejections.threshold[rejections.role == GNSS] == pytest.approx(16.27, abs=0.01)
    assert trajectory.facts.rejected[GNSS] == refused.size
    assert _rms(_errors(truth, trajectory)[0])[0] < 0.03


@pytest.mark.parametrize(("yaw_error", "yaw_std_rad", "found_after"), [(0.5, np.pi, 100), (2.0, 0.1, 600)])
def test_finds_a_heading_that_it_does_not_know_or_of_which_it_was_wrongly_sure(
    truth, yaw_error, yaw_std_rad, found_after
):
    start = replace(initial(truth, yaw_error=yaw_error), yaw_std_rad=yaw_std_rad)
    errors, _ = _errors(truth, _run(truth, measured(truth, 7), start))
    assert np.abs(errors[found_after:, 4]).max() < np.radians(3.0)


def test_an_estimate_uses_the_past_only(truth):
    measurements = measured(truth, 8)
    cut = truth.stamp_ns[3000]

    def before(part):
        keep = part.stamp_ns <= cut
        arrays = {name: getattr(part, name) for name in part.__slots__}
        return replace(part, **{name: array[keep] for name, array in arrays.items() if isinstance(array, np.ndarray)})

    past = Measurements(*(before(getattr(measurements, name)) for name in ("gnss", "imu", "wheels", "visual")))
    whole, part = _run(truth, measurements, end=3001), _run(truth, past, end=3001)
    np.testing.assert_array_equal(whole.position_enu_m, part.position_enu_m)


def test_entries_that_a_camera_does_not_give_are_left_out(truth):
    measurements = measured(truth, 11)
    velocity, variance = measurements.visual.velocity_mps.copy(), measurements.visual.variance_m2ps2.copy()
    velocity[::2, 1:] = variance[::2, 1:] = np.nan
    visual = replace(measurements.visual, velocity_mps=velocity, variance_m2ps2=variance)
    sources = collect_sources(replace(measurements, visual=visual), initial(truth), end_ns=int(truth.stamp_ns[-1]))
    shapes = {source.z.shape for source in sources if source.role == VISUAL and source.kind != SELECT}
    n = visual.stamp_ns.size
    assert shapes == {((n + 1) // 2, 1), (n // 2, 3)}
    assert all(np.isfinite(source.z).all() and (source.variance > 0).all() for source in sources)


def test_blocks_change_nothing(truth, monkeypatch):
    measurements = measured(truth, 12)
    late = measurements.gnss.stamp_ns >= truth.stamp_ns[6000]
    shifted = measurements.gnss.position_enu_m + late[:, None] * [5.0, 0.0, 0.0]
    measurements = replace(measurements, gnss=replace(measurements.gnss, position_enu_m=shifted))
    whole = _run(truth, measurements)
    monkeypatch.setattr("tcpipe.fusion.ukf15._BLOCK", 37)
    blocks = _run(truth, measurements)
    np.testing.assert_array_equal(whole.position_enu_m, blocks.position_enu_m)
    np.testing.assert_array_equal(whole.rejections.stamp_ns, blocks.rejections.stamp_ns)
    assert whole.facts == blocks.facts
    assert whole.facts.recovered[GNSS] >= 1


def test_the_facts_count_what_was_fused(truth):
    facts = _run(truth, measured(truth, 10)).facts
    assert set(facts.measurements) == {GNSS, IMU, WHEELS, VISUAL}
    assert 0.7 < facts.nis_mean[GNSS] < 1.2
    assert facts.recovered == dict.fromkeys((GNSS, IMU, WHEELS, VISUAL), 0)


def test_both_engines_agree_on_a_drive():
    truth = drive(seconds=2.0, seed=9)
    measurements = measured(truth, 9)
    ours, theirs = (_run(truth, measurements, engine=engine, end=300) for engine in ("compiled", "filterpy"))
    np.testing.assert_allclose(ours.position_enu_m, theirs.position_enu_m, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.quat_xyzw, theirs.quat_xyzw, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.yaw_std_rad, theirs.yaw_std_rad, rtol=0, atol=1e-9)
    assert ours.facts.nis_mean == pytest.approx(theirs.facts.nis_mean)
