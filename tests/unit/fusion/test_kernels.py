"""The compiled kernels against the same written out in plain numpy and scipy."""

import numpy as np
import pytest
from unit.fusion import dense_reference, drive
from unit.fusion.dense_reference import FORCE, LEVER, RATE, P, X

from tcpipe.fusion import error_state_kernel, error_state_pass, state_kernel
from tcpipe.fusion.gnss_faults import FixErrors
from tcpipe.fusion.initial import find_initial_state, find_stationary_intervals
from tcpipe.fusion.measurements import select_measurements
from tcpipe.fusion.timeline import build_timeline


def test_deviations_of_yaw_and_forward_velocity_are_those_of_a_cloud():
    out = np.zeros(state_kernel.SAVED)
    small = P * 1e-4
    state_kernel.save_state(X, small, out)
    cloud = np.random.default_rng(6).multivariate_normal(np.zeros(17), small, 20_000)
    states = np.array([dense_reference.plus(X, d) for d in cloud])
    yaw = np.arctan2(states[:, 3], states[:, 0])
    forward = np.sum(states[:, [0, 3, 6]] * states[:, 15:18], axis=1)
    assert np.var(yaw) == pytest.approx(out[26], rel=0.05)
    assert np.var(forward) == pytest.approx(out[27], rel=0.05)


@pytest.mark.parametrize(("mode", "scaled"), [(0, 0), (1, 0), (1, 1), (2, 0), (3, 0)])
def test_prediction_is_the_unscented_transform(mode, scaled):
    x, covariance, moved = X.copy(), P.copy(), np.zeros((12, 9))
    work, _ = state_kernel.allocate_workspace(17)
    q = np.concatenate((np.linspace(0.01, 0.02, 19), [scaled, 0.03]))
    state_kernel.predict(x, covariance, q, 0.03, 0.4, RATE, FORCE, mode, moved, work)
    wanted_x, wanted_P, cross = dense_reference.predict(X, P, q, 0.03, 0.4, RATE, FORCE, mode)
    assert np.allclose(x, wanted_x, atol=1e-13)
    assert np.allclose(covariance, wanted_P, atol=1e-13)
    transposed = np.linalg.solve(P, cross)  # the linear map with the sigma points' second moments
    among = [0, 1, 2, *range(9, 15)]
    assert np.allclose(moved, transposed[:12, among], atol=1e-9)
    transposed[np.ix_(range(12), among)] = 0.0
    stays = np.array([0, 0, 0, *[1] * 6, *[0] * 3, *[1] * 3, 1 - 0.4 * q[17], 1])
    assert np.allclose(transposed, np.diag(stays), atol=1e-9)


def test_a_covariance_that_is_none_is_repaired_and_counted():
    work, _ = state_kernel.allocate_workspace(17)
    broken = P.copy()
    broken[3, 3] = -1e-12
    state_kernel.predict(X.copy(), broken, np.zeros(21), 0.0, 0.1, RATE, FORCE, 3, np.zeros((12, 9)), work)
    assert work[8][0] > 0
    assert np.isfinite(broken).all()
    assert np.linalg.eigvalsh(broken).min() > 0


@pytest.mark.parametrize("kind", [1, 2, 3, 4, 5, 6, 7, 8])
def test_update_is_the_unscented_transform(kind):
    work, gain = state_kernel.allocate_workspace(17)
    z, r = np.array([0.2, -0.1, 0.3]), np.array([0.02, 0.03, 0.04])
    if kind in {state_kernel.SIDEWAYS, state_kernel.LEVEL}:
        z[2] = 0.0
    x, covariance = X.copy(), P.copy()
    nis = error_state_kernel.compute_innovation(kind, x, covariance, z, r, RATE, LEVER, 1.0, work, gain)
    error_state_kernel.correct(x, covariance, work, gain, np.zeros((3, 3)))
    wanted = dense_reference.update(kind, X, P, z, r, RATE, LEVER)
    assert np.allclose(x, wanted[0], atol=1e-13)
    assert np.allclose(covariance, wanted[1], atol=1e-9)
    if kind == state_kernel.WHEEL_VELOCITY:  # only the wheels' own velocity is judged, not the constraint with it
        d, wm, wc = dense_reference.sigma(P)
        forward = np.array([dense_reference.expect(kind, dense_reference.plus(X, e), RATE, LEVER)[0] for e in d])
        wanted_nis = (z[0] - wm @ forward) ** 2 / (wc @ (forward - wm @ forward) ** 2 + r[0])
        assert nis == pytest.approx(wanted_nis, rel=1e-12)
    else:
        assert nis == pytest.approx(wanted[2], rel=1e-10)


def _short_run():
    truth = drive.make_drive(12.0, stand_s=1.0)
    measurements = drive.measure(truth, 3, gnss_outliers=0.0)
    start = int(min(s.stamp_ns[0] for s in (measurements.gnss, measurements.wheels, measurements.visual)))
    standing = find_stationary_intervals(measurements)
    initial = find_initial_state(measurements, standing, start)
    period = 50_000_000
    output = np.arange(-(-start // period) * period, drive.ns(2.2), period, dtype=np.int64)
    return measurements, standing, initial, output


@pytest.mark.parametrize("doubted", [False, True])
def test_filter_and_smoother_are_those_written_out(monkeypatch, doubted):
    measurements, standing, initial, output = _short_run()
    timeline = build_timeline(select_measurements(measurements, 0, int(output[-1])), standing, output)
    monkeypatch.setattr(error_state_pass, "_BLOCK", 40)  # several blocks,
    monkeypatch.setattr(error_state_pass, "_KEPT_BLOCKS", 2)  # some of them filtered twice
    run = error_state_pass.FilterPass(timeline, measurements, 0.999, lags=(3, 10))
    run.gates[:] = np.inf
    if doubted:
        shape = measurements.gnss.variance_m2.shape
        sizes = np.where(np.arange(shape[0]) % 8 < 4, 0.3, 0.1)[:, None] * [1.0, 1.2, 1.5]  # fixes of two kinds
        run.doubt_fixes(FixErrors(measurements.gnss.variance_m2, sizes**2, np.full(shape[0], 2.0)), ())
        assert np.unique(run.kept_error.round(2)).size > 2
    memory = error_state_pass._start(initial, (0.12, 0.05), 0.0, run.start_error_m2)
    after, smoothed, gains = dense_reference.filter_and_smooth(
        timeline, run._densities, run._levers, memory.x, memory.P, kept=run.kept_error, noise=run.error_noise_m2
    )
    events = np.flatnonzero(timeline.output >= 0)
    filtered, got = run.filtered(initial), run.smoothed(initial)
    assert np.allclose(filtered[:, :23], [after[e][0][:23] for e in events], atol=1e-9)
    for outputs, wanted in ((filtered, after), (got, smoothed)):
        variances = np.array([np.diag(wanted[e][1]) for e in events])
        assert np.allclose(outputs[:, 23:26], variances[:, 12:15], rtol=1e-6)
        assert np.allclose(outputs[:, 28:30], variances[:, 15:17], rtol=1e-6)
    # The reference goes back along the manifold, the kernel along its tangents.
    states = np.column_stack((got[:, :23], got[:, 30:33])) if doubted else got[:, :23]
    apart = [dense_reference.minus(x, smoothed[e][0]) for x, e in zip(states, events, strict=True)]
    assert np.abs(apart / np.sqrt(variances)).max() < 0.01
    assert run.repairs == 0
    for column, lag in enumerate(run.lags):
        pairs = zip(events[:-lag], events[lag:], strict=True)
        wanted = [dense_reference.displacement_variance(smoothed, gains, *pair) for pair in pairs]
        moved = np.hypot(*(got[lag:, 18:20] - got[:-lag, 18:20]).T) > 0.05  # one that is nothing has no direction
        found = run.displacement_variance_m2[:-lag, column]
        assert np.allclose(found[moved], np.array(wanted)[moved], rtol=1e-6)
        assert np.allclose(found, wanted, rtol=5e-3)
        assert np.isnan(run.displacement_variance_m2[-lag:, column]).all()
