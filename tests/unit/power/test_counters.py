"""Counters of energy: what they counted over wraps and resets, and the current that makes it."""

import numpy as np
import pytest

from tcpipe.power.energy import integrate_energy
from tcpipe.power.rails import make_rail, make_samples
from tcpipe.power.sources import count_energy

N = 200
STAMP_NS = np.cumsum(np.random.default_rng(3).integers(10_000_000, 90_000_000, N))
VOLT = 24.0 + np.sin(np.arange(N))
TRUE_JOULE = np.cumsum(np.random.default_rng(4).uniform(0.5, 9.0, N))


def spent(counter, row) -> float:
    """What the rail of a counter says was spent between the second and the last of the rows that came."""
    amp = counter.mean_amp(STAMP_NS[row], VOLT[row])
    made = make_rail("drive", make_samples(STAMP_NS[row], VOLT[row]), make_samples(STAMP_NS[row], amp), averaged=True)
    return float(integrate_energy([made], STAMP_NS[[1]], STAMP_NS[[N - 1]], rule="averaged")[0])


@pytest.mark.parametrize("lost", [0, 40])
def test_a_rail_spends_what_was_counted_whatever_messages_are_lost(lost):
    """Times are uneven, and a run of messages may be missing: the counter knows what passed."""
    came = np.setdiff1d(np.arange(N), np.arange(80, 80 + lost))
    counter = count_energy([(3600.0, TRUE_JOULE[came] / 3600.0)], wraps=None)
    assert spent(counter, came) == pytest.approx(TRUE_JOULE[-1] - TRUE_JOULE[1], rel=1e-9)


def test_what_was_given_back_is_subtracted():
    back = 0.3 * TRUE_JOULE
    counter = count_energy([(1.0, 1.3 * TRUE_JOULE), (-1.0, back)], wraps=None)
    assert spent(counter, np.arange(N)) == pytest.approx(TRUE_JOULE[-1] - TRUE_JOULE[1], rel=1e-9)


@pytest.mark.parametrize("wraps", [100.0, 400.0])
def test_a_counter_that_wraps_goes_on(wraps):
    counter = count_energy([(1.0, TRUE_JOULE % wraps)], wraps=wraps)
    assert not counter.resets.any()
    np.testing.assert_allclose(counter.energy_joule, TRUE_JOULE - TRUE_JOULE[0], atol=1e-9)


def test_a_fall_that_no_wrap_explains_is_a_reset():
    reading = TRUE_JOULE.copy()
    reading[90:] -= reading[90]
    for wraps in (None, 1e6):
        counter = count_energy([(1.0, reading)], wraps=wraps)
        assert counter.resets.max() == 1
        assert np.flatnonzero(np.isnan(counter.mean_amp(STAMP_NS, VOLT))).tolist() == [0, 90]


def test_time_that_stands_still_and_a_voltage_of_zero_make_no_current():
    counter = count_energy([(1.0, np.array([0.0, 1.0, 2.0, 3.0]))], wraps=None)
    amp = counter.mean_amp(
        np.array([0, 1_000_000_000, 1_000_000_000, 2_000_000_000]), np.array([10.0, 10.0, 10.0, 0.0])
    )
    np.testing.assert_array_equal(amp, [np.nan, 0.1, np.nan, np.nan])
