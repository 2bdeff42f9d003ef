"""The compiled 15-state filter against the same model run through filterpy 2.0.0: equal to 1e-9 whatever is measured."""

import numpy as np
import pytest

from tcpipe.fusion import filterpy_engine, ukf15_kernel
from tcpipe.fusion.ukf15_kernel import (
    ACCEPTED,
    ANTENNA,
    RECOVERED,
    REJECTED,
    SELECT,
    SENSOR_VELOCITY,
    SPECIFIC_FORCE,
    Events,
    FilterState,
    Outputs,
    Sources,
)

Q = np.array([0.05, 0.05, 0.06, 0.03, 0.03, 0.06, 0.025, 0.025, 0.04, 0.01, 0.01, 0.02, 0.3, 0.3, 0.3])
ENGINES = (ukf15_kernel.run, filterpy_engine.run)


def _belief(seed, *, std):
    rng = np.random.default_rng(seed)
    x, P = np.zeros(16), np.zeros((15, 16))
    x[:15] = rng.normal(0.0, 0.3, 15)
    spread = rng.normal(size=(15, 15))
    P[:, :15] = std**2 * (spread @ spread.T / 15 + 0.5 * np.eye(15))
    return FilterState(x, P, np.zeros(1), np.zeros((5, 2)))


def _sources(*rows, gate=np.inf):
    """Rows of (kind, index, lever)."""
    index = np.zeros((len(rows), 6), np.int64)
    for at, (_, which, _) in enumerate(rows):
        index[at, : len(which)] = which
    return Sources(
        np.array([kind for kind, _, _ in rows]),
        np.array([len(which) for _, which, _ in rows]),
        index,
        np.array([lever for _, _, lever in rows], float),
        np.full(len(rows), gate),
    )


def _events(sources, time_s, seed, *, std, scale=1.0):
    rng = np.random.default_rng(seed)
    source = rng.integers(0, sources.kind.size, time_s.size).astype(np.int8)
    width = sources.width[source]
    at = (np.cumsum(width) - width).astype(np.int64)
    size = int(width.sum())
    return Events(time_s, source, at, rng.normal(0.0, scale, size), std**2 * rng.uniform(0.5, 2.0, size))


def _run_both(belief, events, sources, output_s):
    found = []
    for run in ENGINES:
        b = FilterState(*(array.copy() for array in belief))
        n, k = events.time_s.size, output_s.size
        outputs = Outputs(output_s, np.zeros((k, 15)), np.zeros((k, 15)), np.zeros(n), np.zeros(n, np.int8))
        assert run(b, Q, events, sources, outputs) == 0
        found.append((b, outputs))
    return found


def _assert_equal(found):
    (compiled, ours), (reference, theirs) = found
    np.testing.assert_allclose(compiled.x, reference.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(compiled.P, reference.P, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.x, theirs.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.variance, theirs.variance, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.nis, theirs.nis, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(ours.outcome, theirs.outcome)


def test_linear_case_upright_at_rest_measured_entry_by_entry():
    belief = FilterState(np.zeros(16), np.zeros((15, 16)), np.zeros(1), np.zeros((5, 2)))
    belief.P[np.arange(15), np.arange(15)] = 1e-6
    sources = _sources(
        (SELECT, (0, 1, 2), (0, 0, 0)), (SELECT, (6, 7, 8, 11), (0, 0, 0)), (SELECT, (12, 13, 14), (0, 0, 0))
    )
    events = _events(sources, np.linspace(0.01, 1.0, 100), 1, std=0.1, scale=1e-3)
    _assert_equal(_run_both(belief, events, sources, np.linspace(0.05, 1.0, 20)))


@pytest.mark.parametrize("std", [0.03, 0.2])
def test_non_linear_case_tilted_turning_with_levers(std):
    sources = _sources(
        (SELECT, (3, 4, 5, 9, 10, 11), (0, 0, 0)),
        (ANTENNA, (0, 1, 2), (0.4, -0.2, 0.9)),
        (SPECIFIC_FORCE, (0, 1, 2), (0.1, 0.05, 0.3)),
        (SENSOR_VELOCITY, (0, 1, 2), (0.5, 0.1, 0.2)),
        (SENSOR_VELOCITY, (0,), (0.5, 0.1, 0.2)),
    )
    events = _events(sources, np.cumsum(np.random.default_rng(5).exponential(0.01, 200)), 2, std=0.3)
    _assert_equal(_run_both(_belief(3, std=std), events, sources, np.linspace(0.05, events.time_s[-1] + 0.4, 20)))


def test_yaw_across_the_cut_of_the_circle():
    belief = _belief(4, std=0.3)
    belief.x[5] = 3.1
    sources = _sources((SELECT, (5,), (0, 0, 0)), (SELECT, (9, 10, 11), (0, 0, 0)))
    events = _events(sources, np.linspace(0.02, 2.0, 100), 6, std=0.3)
    z = np.where(np.repeat(events.source, sources.width[events.source]) == 0, np.pi + events.z * 0.2, events.z)
    _assert_equal(_run_both(belief, events._replace(z=z), sources, np.linspace(0.1, 2.0, 20)))


def test_gates_refuse_and_recover_alike():
    everything_else = (SELECT, (3, 4, 6, 7, 8, 11), (0, 0, 0))
    sources = _sources((SELECT, (0, 1, 2), (0, 0, 0)), (ANTENNA, (0, 1), (1.0, 0.5, 0.0)), everything_else, gate=25.0)
    events = _events(sources, np.linspace(0.1, 12.0, 120), 7, std=0.05, scale=0.03)
    late = np.repeat((events.time_s > 3.0) & (events.source < 2), sources.width[events.source])
    belief = _belief(8, std=0.1)
    belief.x[:] = 0.0
    found = _run_both(belief, events._replace(z=events.z + 40.0 * late), sources, np.linspace(0.1, 12.0, 20))
    _assert_equal(found)
    outcome = found[0][1].outcome
    assert {ACCEPTED, REJECTED, RECOVERED} == set(outcome.tolist())
    assert found[0][1].x[-1, 0] == pytest.approx(40.0, abs=1.2)  # the lever arm, whose direction nothing measures
