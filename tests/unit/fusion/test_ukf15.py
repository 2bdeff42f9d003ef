"""The paper's forward filter on a drive over rough ground whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from rough_drive import drive, initial, measured

from tcpipe.fusion.measurements import GNSS, IMU, VISUAL, WHEELS, Measurements
from tcpipe.fusion.ukf15 import VX, SensorRows, collect_sources, filter_forward, run_ukf15
from tcpipe.geometry.rotation import invert, rotate, rpy_from_matrix, rpy_from_quat, wrap_to_pi

SETTLED = 100  # rows, 5 s: the start is wrong on purpose


@pytest.fixture(scope="module")
def truth():
    return drive(seconds=17.0, seed=3)


def _measured(truth, seed, **options):
    """Every eighth measurement of the IMU, 25 Hz: the filter takes 0.2 ms for each."""
    measurements = measured(truth, seed, **options)
    return replace(measurements, imu=_select(measurements.imu, slice(None, None, 8)))


def _select(part, rows):
    arrays = {name: getattr(part, name) for name in part.__slots__}
    return replace(part, **{name: array[rows] for name, array in arrays.items() if isinstance(array, np.ndarray)})


def _run(truth, measurements, start=None, *, end=-1):
    output_ns = truth.stamp_ns[200:end:10]
    start = initial(truth) if start is None else start
    return run_ukf15(measurements, start, output_ns=output_ns, gate_probability=0.999)


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
    trajectory = _run(truth, _measured(truth, 1, orientation=orientation))
    errors, scaled = _errors(truth, trajectory)
    assert _rms(np.hypot(errors[:, 0], errors[:, 1])) < 0.02
    assert (_rms(errors)[2:] < [0.02, 0.03, np.radians(0.8)]).all()
    assert (_rms(scaled) < 1.3).all()
    assert (_rms(scaled) > 0.3).all()
    assert set(trajectory.facts.measurements) == {GNSS, IMU, WHEELS, VISUAL}
    assert 0.7 < trajectory.facts.nis_mean[GNSS] < 1.2


@pytest.mark.parametrize(
    ("absent", "within_m"), [(("wheels", "visual"), 0.03), (("imu", "wheels", "visual"), 0.12), (("gnss",), 5.0)]
)
def test_goes_on_without_a_sensor(truth, absent, within_m):
    trajectory = _run(truth, replace(_measured(truth, 2), **dict.fromkeys(absent)))
    errors, scaled = _errors(truth, trajectory)
    assert _rms(np.hypot(errors[:, 0], errors[:, 1])) < within_m
    assert (_rms(scaled) < 1.7).all()


def test_a_jump_of_the_gnss_is_refused_and_listed(truth):
    measurements = _measured(truth, 5)
    gnss = measurements.gnss
    jump = (gnss.stamp_ns >= truth.stamp_ns[2400]) & (gnss.stamp_ns < truth.stamp_ns[2800])
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


@pytest.mark.parametrize(("yaw_error", "yaw_std_rad", "found_after"), [(0.5, np.pi, 160), (2.0, 0.1, 180)])
def test_finds_a_heading_that_it_does_not_know_or_of_which_it_was_wrongly_sure(
    truth, yaw_error, yaw_std_rad, found_after
):
    start = replace(initial(truth, yaw_error=yaw_error), yaw_std_rad=yaw_std_rad)
    errors, _ = _errors(truth, _run(truth, _measured(truth, 7), start))
    assert np.abs(errors[found_after:, 4]).max() < np.radians(3.0)


def test_an_estimate_uses_the_past_only(truth):
    measurements = _measured(truth, 8)
    cut = truth.stamp_ns[1500]

    def before(part):
        return _select(part, part.stamp_ns <= cut)

    past = Measurements(*(before(getattr(measurements, name)) for name in ("gnss", "imu", "wheels", "visual")))
    whole, part = _run(truth, measurements, end=1501), _run(truth, past, end=1501)
    np.testing.assert_array_equal(whole.position_enu_m, part.position_enu_m)


def test_entries_that_a_camera_does_not_give_are_left_out(truth):
    measurements = _measured(truth, 11)
    velocity, variance = measurements.visual.velocity_mps.copy(), measurements.visual.variance_m2ps2.copy()
    velocity[::2, 1:] = variance[::2, 1:] = np.nan
    visual = replace(measurements.visual, velocity_mps=velocity, variance_m2ps2=variance)
    sources = collect_sources(replace(measurements, visual=visual), initial(truth), end_ns=int(truth.stamp_ns[-1]))
    shapes = {source.z.shape for source in sources if source.role == VISUAL and source.entries[0] == VX}
    n = visual.stamp_ns.size
    assert shapes == {((n + 1) // 2, 1), (n // 2, 3)}
    assert all(np.isfinite(source.z).all() and (source.variance > 0).all() for source in sources)


def test_a_lasting_offset_of_the_fixes_is_followed_after_five_seconds(truth):
    measurements = _measured(truth, 12)
    late = measurements.gnss.stamp_ns >= truth.stamp_ns[2000]
    shifted = measurements.gnss.position_enu_m + late[:, None] * [5.0, 0.0, 0.0]
    trajectory = _run(truth, replace(measurements, gnss=replace(measurements.gnss, position_enu_m=shifted)))
    refused = trajectory.rejections.stamp_ns[trajectory.rejections.role == GNSS]
    assert refused.max() - truth.stamp_ns[2000] == pytest.approx(5e9, abs=0.2e9)
    assert trajectory.position_enu_m[-1, 0] - truth.position[-1, 0] == pytest.approx(5.0, abs=0.5)


def test_a_covariance_that_rounding_has_made_useless_keeps_its_variances():
    still = SensorRows("wheel_odometry", (VX,), np.array([10**8, 2 * 10**8]), np.zeros((2, 1)), np.full((2, 1), 0.01))
    P = 0.01 * np.eye(15)
    P[VX, VX + 1] = P[VX + 1, VX] = 0.02  # a correlation of two
    end_ns = np.array([2 * 10**8])
    found = filter_forward([still], [np.inf], x=np.zeros(15), P=P, q=np.zeros(15), start_ns=0, output_ns=end_ns)
    assert found.variance[0, VX] == pytest.approx(0.01 / 3, rel=0.1)
    assert np.isfinite(found.x).all()
