"""The paper's forward filter on a drive over rough ground whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from rough_drive import drive, initial, measured
from unit.fusion import se3_reference as reference

from tcpipe.fusion.densities import fit_noise
from tcpipe.fusion.error_state import make_tests
from tcpipe.fusion.filter_kernel import allocate_steps, filter_ticks
from tcpipe.fusion.measurements import GNSS, VISUAL, WHEELS
from tcpipe.fusion.pair_residuals import find_residuals
from tcpipe.fusion.parameters import make_model, make_priors, make_start
from tcpipe.fusion.smoother_kernel import STD_INTERVAL
from tcpipe.fusion.state import Error
from tcpipe.fusion.ticks import build_ticks
from tcpipe.fusion.ukf15 import filter_forward, run_ukf15
from tcpipe.geometry.rotation import invert, rotate, rpy_from_matrix, rpy_from_quat, wrap_to_pi

SETTLED = 100  # rows, 5 s: the start is wrong on purpose


@pytest.fixture(scope="module")
def truth():
    return drive(seconds=17.0, seed=3)


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


def test_all_sensors_reach_centimetres_and_know_it(truth):
    trajectory = _run(truth, measured(truth, 1))
    errors, scaled = _errors(truth, trajectory)
    assert _rms(np.hypot(errors[:, 0], errors[:, 1])) < 0.03
    assert (_rms(errors)[2:] < [0.04, 0.02, np.radians(0.8)]).all()
    assert (_rms(scaled) < 1.5).all()  # few errors of one drive are independent
    assert (_rms(scaled) > 0.2).all()  # σ holds errors of hours, which one drive does not have
    assert set(trajectory.facts.measurements) == {GNSS, WHEELS, VISUAL}
    assert 0.7 < trajectory.facts.nis_mean[GNSS] < 1.2


@pytest.mark.parametrize(
    ("absent", "within_m"), [(("wheels", "visual"), 0.06), (("imu", "wheels", "visual"), 0.2), (("gnss",), 5.0)]
)
def test_goes_on_without_a_sensor(truth, absent, within_m):
    trajectory = _run(truth, replace(measured(truth, 2), **dict.fromkeys(absent)))
    errors, scaled = _errors(truth, trajectory)
    assert _rms(np.hypot(errors[:, 0], errors[:, 1])) < within_m
    assert (_rms(scaled) < 1.7).all()


def test_a_jump_of_the_gnss_is_refused_and_listed(truth):
    measurements = measured(truth, 5)
    gnss = measurements.gnss
    jump = (gnss.stamp_ns >= truth.stamp_ns[2400]) & (gnss.stamp_ns < truth.stamp_ns[2800])
    position = gnss.position_enu_m + jump[:, None] * [3.0, -2.0, 0.0]
    trajectory = _run(truth, replace(measurements, gnss=replace(gnss, position_enu_m=position)))
    rejections = trajectory.rejections
    refused = rejections["stamp_ns"][rejections["role"] == GNSS]
    assert set(gnss.stamp_ns[jump].tolist()) <= set(refused.tolist())
    assert refused.size < jump.sum() + 5
    assert (rejections["reason"] == "gate").all()
    assert (rejections["normalized_innovation_squared"] > rejections["threshold"]).all()
    assert rejections["threshold"][rejections["role"] == GNSS] == pytest.approx(16.27, abs=0.01)
    assert trajectory.facts.rejected[GNSS] == refused.size
    assert _rms(_errors(truth, trajectory)[0])[0] < 0.03


@pytest.mark.parametrize(("yaw_error", "yaw_std_rad"), [(2.0, np.pi), (1.0, 0.1)])
def test_finds_a_heading_that_it_does_not_know_or_of_which_it_was_wrongly_sure(truth, yaw_error, yaw_std_rad):
    start = replace(initial(truth, yaw_error=yaw_error), yaw_std_rad=yaw_std_rad)
    errors, _ = _errors(truth, _run(truth, measured(truth, 7), start))
    assert np.abs(errors[-40:, 4]).max() < np.radians(3.0)


def _prepare(truth, m, start):
    """Return ticks, model and start of the filter over seven seconds of the drive."""
    output_ns = truth.stamp_ns[200:1600:10]
    noise = fit_noise(m, find_residuals(m))
    ticks = build_ticks(
        m, noise, np.empty((0, 2), np.int64), int(output_ns[0]), int(output_ns[-1]), output_ns=output_ns
    )
    std, walk, time_s = make_priors(m, noise, ticks)
    model = make_model(m, std, walk, (), period_s=ticks.inputs.period_s, gate_probability=0.999, time_s=time_s)
    return ticks, model, make_start(start, std, (0.0, 0.0, 0.0) if m.gnss is None else m.gnss.lever_arm_m).select(model.active)  # fmt: skip


@pytest.mark.parametrize("absent", [(), ("imu",), ("imu", "wheels", "visual"), ("gnss",)])
def test_filterpy_and_the_compiled_kernel_agree(truth, absent):
    """Two implementations of unscented filtering, one with all errors in each sigma point, estimate the same."""
    ticks, model, start = _prepare(truth, replace(measured(truth, 1), **dict.fromkeys(absent)), initial(truth))
    forward, estimate = filter_forward(ticks, model, start)
    size = ticks.stamp_ns.size
    steps, tests = allocate_steps(size, model.active.size), make_tests(size)
    filter_ticks(0, size, ticks.inputs, model, start.copy(), steps, tests)
    std = np.sqrt(np.diagonal(steps.P, axis1=1, axis2=2))
    assert estimate.stds == pytest.approx(std[::STD_INTERVAL], rel=0.01)
    apart = np.concatenate([reference.minus(*pair)[None] for pair in zip(estimate.states, steps.x, strict=True)])
    assert np.abs(apart[:, model.active] / std).max() < 0.6
    assert _rms(apart[:, model.active] / std).max() < 0.2
    np.testing.assert_array_equal(forward.tests.verdict, tests.verdict)
    # Beside them the kernel adds the product of two errors, of yaw and distance, to the variance of a fix.
    assert forward.tests.nis == pytest.approx(tests.nis, rel=0.35, abs=0.2, nan_ok=True)


def test_an_estimate_uses_the_past_only(truth):
    ticks, model, start = _prepare(truth, measured(truth, 8), initial(truth))
    value = ticks.inputs.value.copy()
    value[100:] = np.nan
    past = replace(ticks, inputs=ticks.inputs._replace(value=value))
    whole, part = (filter_forward(of, model, start)[1].states for of in (ticks, past))
    np.testing.assert_array_equal(whole[:100], part[:100])
    assert (whole[100:, 9:12] != part[100:, 9:12]).any(axis=1).all()


def test_a_lasting_offset_of_the_fixes_is_followed_after_five_seconds(truth):
    measurements = measured(truth, 12)
    late = measurements.gnss.stamp_ns >= truth.stamp_ns[2000]
    shifted = measurements.gnss.position_enu_m + late[:, None] * [5.0, 0.0, 0.0]
    trajectory = _run(truth, replace(measurements, gnss=replace(measurements.gnss, position_enu_m=shifted)))
    refused = trajectory.rejections["stamp_ns"][trajectory.rejections["role"] == GNSS]
    assert refused.max() - truth.stamp_ns[2000] == pytest.approx(5e9, abs=0.2e9)
    assert trajectory.position_enu_m[-1, 0] - truth.position[-1, 0] == pytest.approx(5.0, abs=0.5)


def test_a_covariance_that_rounding_has_made_useless_keeps_its_variances(truth):
    """A correlation of two between forward and sideways velocity."""
    ticks, model, start = _prepare(truth, measured(truth, 1), initial(truth))
    start.P[Error.U, Error.U + 1] = start.P[Error.U + 1, Error.U] = 2.0 * start.P[Error.U, Error.U]
    _, estimate = filter_forward(ticks, model, start)
    assert np.isfinite(estimate.states).all()
    assert (estimate.variances > 0.0).all()
    assert np.linalg.norm(estimate.states[-1, 9:12] - truth.position[truth.at(ticks.stamp_ns[-1])]) < 0.1
