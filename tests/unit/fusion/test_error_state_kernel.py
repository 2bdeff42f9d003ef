"""Filter and smoother against the same written out in plain numpy and scipy."""

import numpy as np
import pytest
from unit.fusion import dense_reference, drive

from tcpipe.fusion import error_state_pass
from tcpipe.fusion.fix_errors import FixErrors
from tcpipe.fusion.initial import find_initial_state
from tcpipe.fusion.measurements import part
from tcpipe.fusion.standing import standing_intervals
from tcpipe.fusion.timeline import build_timeline


def _short_run():
    truth = drive.make_drive(12.0, stand_s=1.0)
    measurements = drive.measure(truth, 3, gnss_outliers=0.0)
    start = int(min(s.stamp_ns[0] for s in (measurements.gnss, measurements.wheels, measurements.visual)))
    standing = standing_intervals(measurements)
    initial = find_initial_state(measurements, standing, start)
    period = 50_000_000
    output = np.arange(-(-start // period) * period, drive.ns(2.2), period, dtype=np.int64)
    return measurements, standing, initial, output


@pytest.mark.parametrize("doubted", [False, True])
def test_filter_and_smoother_are_those_written_out(monkeypatch, doubted):
    measurements, standing, initial, output = _short_run()
    timeline = build_timeline(part(measurements, 0, int(output[-1])), standing, output)
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
