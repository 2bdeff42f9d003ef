"""The audit of the power sensor, against batteries whose resistance and currents are known."""

import numpy as np
import pytest

from tcpipe.power.audit import (
    estimate_offset_std,
    find_gain_change,
    find_lost_signs,
    measure_rest_currents,
    measure_sag,
)
from tcpipe.power.rails import make_rail, make_samples

ZERO = 1_700_000_000_000_000_000
HZ, SECONDS = 20, 400
T = np.arange(0, SECONDS, 1 / HZ)
STAMPS = ZERO + np.round(T * 1e9).astype(np.int64)


def make_current(seed):
    """Terrain, turns and starts: what a drive draws [A], as rough as ground is."""
    rng = np.random.default_rng(seed)
    rough = np.convolve(rng.normal(size=len(T)), np.exp(-np.arange(20) / 5.0), mode="same")
    return 5.0 + 2.0 * np.sin(T / 3.1) + 1.5 * np.sin(T / 17.0 + seed) + 0.4 * rough


def record(amp, *, resistance_ohm=0.05, gain=1.0, seed=0):
    """A rail whose battery sags by the true current, while the sensor reads ``gain`` times it, both with noise and rounding."""
    rng = np.random.default_rng(seed + 100)
    volt = 26.4 - 4e-5 * T - resistance_ohm * amp + 0.02 * rng.normal(size=len(T))
    read = gain * amp + 0.08 * rng.normal(size=len(T))
    volt, read = np.round(volt / 0.01) * 0.01, np.round(read / 0.05) * 0.05
    return make_rail("drive", make_samples(STAMPS, volt), make_samples(STAMPS, read), averaged=False)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("ratio", "at"), [(1.1, 0.5), (0.9, 0.4), (1.12, 0.6)])
def test_a_change_of_gain_is_found_with_its_time_and_ratio(seed, ratio, at):
    found = find_gain_change(
        measure_sag([record(make_current(seed), gain=np.where(at * SECONDS < T, ratio, 1.0), seed=seed)])
    )
    assert found.ratio == pytest.approx(ratio, abs=0.04)
    assert (found.at_ns - ZERO) * 1e-9 == pytest.approx(at * SECONDS, abs=15.0)


@pytest.mark.parametrize(
    ("resistance_ohm", "gain"),
    [(0.05, 1.0), (0.05, 1.3), (0.05 * (1.0 - 0.15 * T / SECONDS), 1.0), (0.0, np.where(T > 200, 1.2, 1.0))],
    ids=["right", "wrong throughout", "battery warms up", "voltage is stiff"],
)
@pytest.mark.parametrize("seed", range(4))
def test_no_change_is_found_where_none_is_or_none_can_be_known(resistance_ohm, gain, seed):
    rail = record(make_current(seed), resistance_ohm=resistance_ohm, gain=gain, seed=seed)
    assert find_gain_change(measure_sag([rail])) is None


def test_two_drives_on_one_battery_are_judged_together():
    amp, other = make_current(1), make_current(2)
    true = amp + other
    volt = make_samples(STAMPS, 26.0 - 0.04 * true + 0.02 * np.random.default_rng(3).normal(size=len(T)))
    gain = np.where(T > 200, 1.1, 1.0)
    rails = [
        make_rail(name, volt, make_samples(STAMPS, gain * of), averaged=False)
        for name, of in (("left", amp), ("right", other))
    ]
    assert find_gain_change(measure_sag(rails)).ratio == pytest.approx(1.1, abs=0.02)


def cut(amp):
    """Return begin and end of segments of 1.25 s, and a slope that falls where the true current is negative."""
    start_ns = STAMPS[::25][:-1]
    mean = amp[: len(start_ns) * 25].reshape(-1, 25).mean(axis=1)
    return start_ns, start_ns + 1_250_000_000, 0.05 * (mean - 1.0), mean


@pytest.mark.parametrize("seed", range(4))
def test_a_current_without_sign_is_found_where_it_flows_back(seed):
    amp = make_current(seed) - 4.0
    start_ns, end_ns, rise, mean = cut(amp)
    rail = record(amp, seed=seed)
    assert not find_lost_signs(measure_sag([rail]), start_ns, end_ns, rise).any()
    unsigned = make_rail("drive", rail.voltage, make_samples(STAMPS, np.abs(rail.current.value)), averaged=False)
    lost = find_lost_signs(measure_sag([unsigned]), start_ns, end_ns, rise)
    assert (mean < -0.5).sum() > 20
    assert lost[mean < -0.5].mean() > 0.9
    assert not lost[mean > 1.0].any()


@pytest.mark.parametrize(
    ("rest_amp", "ends"),
    [
        ([0.54, 0.55], None),  # within what the drives take
        ([0.7], None),  # above by less than the prior
        ([0.5, 0.5, 0.5, 0.5, 0.5, 3.0], None),  # held on a slope once
        ([1.5, 1.5, 1.6], (0.9, 1.5)),
        ([-0.5], (-1.1, -0.5)),
    ],
)
def test_an_offset_is_as_uncertain_as_what_the_drives_may_take_at_rest(rest_amp, ends):
    got = estimate_offset_std(np.array(rest_amp), (0.0, 0.6), 0.2)
    assert got == pytest.approx(0.2 if ends is None else np.sqrt(np.mean(np.linspace(*ends, 100_001) ** 2)), rel=1e-4)


def test_a_zero_that_moves_between_halts_is_uncertain_by_the_move():
    moved = np.array([0.3, 0.3, 0.3, 1.3, 1.3, 1.3])
    assert estimate_offset_std(moved, (0.0, 0.6), 0.2) == pytest.approx(1.0 / np.sqrt(2))
    assert estimate_offset_std(np.empty(0), (0.0, 0.6), 0.2) == 0.2


def test_currents_at_rest_are_those_of_settled_halts():
    amp = np.where((T > 100.0) & (T < 102.5), 0.5, np.where((T > 200.0) & (T < 201.0), 9.0, 5.0))
    rail = make_rail("drive", make_samples(STAMPS, 24 + 0 * T), make_samples(STAMPS, amp), averaged=False)
    halts = np.array([[100, 102.5], [200, 201]])
    still_ns = ZERO + np.round(halts * 1e9).astype(np.int64)
    assert measure_rest_currents(rail, still_ns) == pytest.approx([0.5])
