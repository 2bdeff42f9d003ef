"""Energies against scipy's adaptive quadrature of the interpolated signals."""

from itertools import pairwise

import numpy as np
import pytest
from made_tracks import stamps
from scipy.integrate import quad

from tcpipe.power.rails import integrate_energy, make_rail, make_samples


def uneven(rng, count, mean_ns):
    return stamps(1)[0] + np.cumsum(rng.integers(mean_ns // 2, 2 * mean_ns, count))


@pytest.mark.parametrize("averaged", [False, True])
def test_voltage_and_current_at_their_own_stamps(averaged):
    rng = np.random.default_rng(3)
    volt_ns, amp_ns = uneven(rng, 40, 300_000_000), uneven(rng, 300, 40_000_000)
    volt, amp = 24 + rng.normal(0, 1, 40), 6 + rng.normal(0, 5, 300)
    rails = [make_rail("drive", make_samples(volt_ns, volt), make_samples(amp_ns, amp), averaged=averaged)]
    zero = stamps(1)[0]
    volt_s, amp_s = (volt_ns - zero) * 1e-9, (amp_ns - zero) * 1e-9

    def power(t):
        if averaged:
            return volt[np.searchsorted(volt_s, t)] * amp[np.searchsorted(amp_s, t)]
        return np.interp(t, volt_s, volt) * np.interp(t, amp_s, amp)

    start = np.array([1.0, 2.34, 5.001])
    end = np.array([2.1, 2.36, 7.7])
    got = integrate_energy(
        rails,
        zero + (start * 1e9).astype(np.int64),
        zero + (end * 1e9).astype(np.int64),
        rule="averaged" if averaged else "exact",
    )
    for a, b, energy in zip(start, end, got, strict=True):
        knots = np.sort(np.concatenate(([a, b], volt_s, amp_s)))
        knots = knots[(knots >= a) & (knots <= b)]
        wanted = sum(quad(power, x, y)[0] for x, y in pairwise(knots))
        assert energy == pytest.approx(wanted, rel=1e-9)
