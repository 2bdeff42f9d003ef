"""Energies of random records add up over any division and agree with a dense sum; their deviation is finite and in proportion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_tracks import stamps

from tcpipe.power.noise import estimate_energy_noise
from tcpipe.power.rails import integrate_energy, integrate_recorded_energy, make_rail, make_samples


@st.composite
def rails(draw, averaged=None):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    averaged = draw(st.booleans()) if averaged is None else averaged
    made = []
    for name in "ab"[: draw(st.integers(1, 2))]:
        signals = []
        for level, noise in ((24.0, 0.5), (6.0, 6.0)):
            count = draw(st.integers(2, 80))
            stamp_ns = stamps(1)[0] + np.cumsum(rng.integers(1, 2 * 4_000_000_000 // count, count))
            signals.append(make_samples(stamp_ns, level + rng.normal(0, noise, count)))
        made.append(make_rail(name, *signals, averaged=averaged))
    return made, averaged


@settings(max_examples=60, deadline=None)
@given(rails(), st.lists(st.integers(-(10**9), 5 * 10**9), min_size=2, max_size=8), st.booleans())
def test_energy_of_the_parts_is_the_energy_of_the_whole(given_rails, offsets, paper):
    made, averaged = given_rails
    rule = "averaged" if averaged else ("right_endpoint" if paper else "exact")
    cuts = stamps(1)[0] + np.sort(np.array(offsets))
    parts = integrate_recorded_energy(made, cuts[:-1], cuts[1:], rule=rule)
    whole = integrate_recorded_energy(made, cuts[:1], cuts[-1:], rule=rule)
    np.testing.assert_allclose(parts.sum(), whole[0], rtol=1e-9, atol=1e-9)
    known = integrate_energy(made, cuts[:-1], cuts[1:], rule=rule)
    inside = np.isfinite(known)
    np.testing.assert_array_equal(known[inside], parts[inside])


@settings(max_examples=30, deadline=None)
@given(rails(averaged=False))
def test_energy_is_that_of_a_dense_sum(given_rails):
    (first, *_), _ = given_rails
    if len(first.stamp_ns) < 2:
        return
    ends = first.stamp_ns[[0, -1]]
    dense = np.linspace(0, ends[1] - ends[0], 40_001)
    t = (first.stamp_ns - ends[0]).astype(float)
    power = np.interp(dense, t, first.voltage_volt) * np.interp(dense, t, first.current_amp)
    wanted = np.trapezoid(power, dense * 1e-9)
    got = integrate_energy([first], ends[:1], ends[1:], rule="exact")[0]
    scale = np.abs(power).max() * (ends[1] - ends[0]) * 1e-9
    assert abs(got - wanted) < 1e-3 * scale + 1e-9


@st.composite
def records(draw):
    """Return stamps, current, spans and standing sections of a short, odd record, and whether it averages."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count, period_s = draw(st.sampled_from([2, 3, 5, 12, 60])), draw(st.sampled_from([0.001, 0.05, 0.3, 1.0, 10.0]))
    step_s = period_s * draw(st.sampled_from([rng.exponential(1, count), rng.uniform(0.9, 1.1, count)]))
    stamp_ns = stamps(1)[0] + np.cumsum(np.maximum((step_s * 1e9).astype(np.int64), 1))
    white = rng.normal(0, 1, count)
    amp = draw(st.sampled_from([white, np.cumsum(white), np.round(white), np.full(count, 3.0)]))
    length_ns = stamp_ns[-1] - stamp_ns[0]
    start_ns = np.sort(stamp_ns[0] + (rng.uniform(-0.2, 1.1, draw(st.integers(0, 5))) * length_ns).astype(np.int64))
    end_ns = start_ns + (rng.uniform(0.1, 3.0, len(start_ns)) * 1e9).astype(np.int64)
    still_ns = np.sort(rng.integers(stamp_ns[0], stamp_ns[-1] + 1, 2 * draw(st.integers(0, 2)))).reshape(-1, 2)
    return stamp_ns, amp, (start_ns, end_ns, still_ns), draw(st.booleans())


def noise_of(stamp_ns, amp, spans, *, averaged, rate_hz=None):
    signals = (make_samples(stamp_ns, value) for value in (np.full(len(stamp_ns), 24.0), amp))
    return estimate_energy_noise([make_rail("drive", *signals, averaged=averaged)], *spans, rate_hz=rate_hz)


@settings(max_examples=80, deadline=None)
@given(records(), st.sampled_from([None, 20.0]))
def test_finite_and_in_proportion(record, rate_hz):
    stamp_ns, amp, spans, averaged = record
    once, twice = (noise_of(stamp_ns, k * amp, spans, averaged=averaged, rate_hz=rate_hz) for k in (1.0, 2.0))
    assert np.isfinite(once.std_joule()).all()
    assert twice.std_joule() == pytest.approx(2.0 * once.std_joule(), rel=1e-6, abs=1e-9)
