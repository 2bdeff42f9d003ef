"""Energies by hand: every rule, several rails, records that do not reach."""

import numpy as np
import pytest
from made_tracks import stamps

from tcpipe.power.energy import count_samples_inside, integrate_energy, integrate_recorded_energy
from tcpipe.power.rails import compute_power_watt, make_rail, make_samples

ZERO = stamps(1)[0]


def seconds(*values):
    return ZERO + np.round(np.array(values) * 1e9).astype(np.int64)


def made_rail(t, volt, amp, *, averaged=False):
    return make_rail(
        "drive", make_samples(seconds(*t), np.array(volt)), make_samples(seconds(*t), np.array(amp)), averaged=averaged
    )


def test_rules_differ_as_they_must():
    # V rises 20 to 22, I falls 10 to 4, over 1 s: product at t is (20 + 2t)(10 - 6t) = 200 - 100 t - 12 t².
    straight, steps = (made_rail((0, 1), (20.0, 22.0), (10.0, 4.0), averaged=a) for a in (False, True))
    span = seconds(0.0), seconds(1.0)
    assert integrate_energy([straight], *span, rule="exact") == pytest.approx([200 - 50 - 4])
    assert integrate_energy([straight], *span, rule="right_endpoint") == pytest.approx([88])
    assert integrate_energy([steps], *span, rule="averaged") == pytest.approx([88])
    half = seconds(0.0), seconds(0.5)
    assert integrate_energy([straight], *half, rule="exact") == pytest.approx([100 - 12.5 - 0.5])
    assert integrate_energy([straight], *half, rule="right_endpoint") == pytest.approx([44])


def test_rails_add_up_and_regeneration_counts():
    left, right = made_rail((0, 2), (24.0, 24.0), (5.0, 5.0)), made_rail((0, 2), (24.0, 24.0), (-1.0, -1.0))
    assert integrate_energy([left, right], seconds(0.5), seconds(1.5), rule="exact") == pytest.approx([96])
    assert compute_power_watt([left, right], seconds(1.0)) == pytest.approx([96])


def test_energy_is_unknown_where_a_rail_is():
    left, right = made_rail((0, 2), (24.0, 24.0), (5.0, 5.0)), made_rail((1, 2), (24.0, 24.0), (5.0, 5.0))
    got = integrate_energy([left, right], seconds(0.5, 1.0), seconds(1.5, 2.0), rule="exact")
    assert np.isnan(got[0])
    assert got[1] == pytest.approx(240)
    assert integrate_recorded_energy([left, right], seconds(0.5), seconds(1.5), rule="exact") == pytest.approx(
        [120 + 60]
    )
    assert np.isnan(integrate_energy([], seconds(0.5), seconds(1.5), rule="exact")).all()


def test_a_rail_whose_signals_never_overlap_has_no_energy():
    apart = make_rail(
        "x", make_samples(seconds(0, 1), np.ones(2)), make_samples(seconds(2, 3), np.ones(2)), averaged=False
    )
    assert len(apart.stamp_ns) == 0
    assert np.isnan(integrate_energy([apart], seconds(0.5), seconds(2.5), rule="exact")).all()
    assert np.isnan(compute_power_watt([apart], seconds(1.0))).all()


def test_samples_inside_are_counted_and_averaged():
    source = made_rail((0, 1, 2, 3), (10.0,) * 4, (1.0, 2.0, 4.0, 8.0))
    count, mean = count_samples_inside([source], seconds(0.0, 0.5, 1.2), seconds(2.0, 3.0, 1.8))
    assert count.tolist() == [2, 3, 0]
    assert mean[:2] == pytest.approx([30, 140 / 3])
    assert np.isnan(mean[2])


def test_a_record_counts_from_its_first_sample_to_its_last():
    source = made_rail((1, 2, 3), (10.0,) * 3, (1.0, 1.0, 3.0))
    assert integrate_recorded_energy([source], seconds(0.0), seconds(5.0), rule="exact") == pytest.approx([10 + 20])
    assert integrate_energy([source], seconds(1.0), seconds(3.0), rule="exact") == pytest.approx([30])
    assert np.isnan(integrate_energy([source], seconds(1.0), seconds(3.5), rule="exact")).all()
