"""Energies by hand: every rule, several rails, records that do not reach."""

import numpy as np
import pytest
from made_tracks import stamps

from tcpipe.power.rails import (
    count_samples_inside,
    estimate_idle_power,
    integrate_energy,
    integrate_recorded_energy,
    make_rail,
    make_samples,
)

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


def test_energy_is_unknown_where_a_rail_is():
    left, right = made_rail((0, 2), (24.0, 24.0), (5.0, 5.0)), made_rail((1, 2), (24.0, 24.0), (5.0, 5.0))
    got = integrate_energy([left, right], seconds(0.5, 1.0), seconds(1.5, 2.0), rule="exact")
    assert np.isnan(got[0])
    assert got[1] == pytest.approx(240)
    assert integrate_recorded_energy([left, right], seconds(0.5), seconds(1.5), rule="exact") == pytest.approx(
        [120 + 60]
    )
    assert np.isnan(integrate_energy([], seconds(0.5), seconds(1.5), rule="exact")).all()


def test_samples_inside_are_counted_and_averaged():
    source = made_rail((0, 1, 2, 3), (10.0,) * 4, (1.0, 2.0, 4.0, 8.0))
    count, mean = count_samples_inside([source], seconds(0.0, 0.5, 1.2), seconds(2.0, 3.0, 1.8))
    assert count.tolist() == [2, 3, 0]
    assert mean[:2] == pytest.approx([30, 140 / 3])
    assert np.isnan(mean[2])


def halts(*watts, rows=60):
    """Halts of three seconds at 20 Hz."""
    return np.repeat(np.array(watts, float), rows), np.repeat(np.arange(len(watts)), rows)


def test_halts_that_differ_tell_how_unsure_it_is():
    power, halt = halts(80.0, 90.0, 100.0)
    found = estimate_idle_power(power, halt, window_rows=20, step_watt=0.0)
    assert found.watt == 90.0
    assert found.std_watt == pytest.approx(np.sqrt(200 / 3 * (1 + 1 / 9) + (0.1 * 90.0 / 9) ** 2))


def test_one_second_does_not_tell_what_another_would():
    found = estimate_idle_power(np.full(40, 390.0), np.zeros(40, int), window_rows=40, step_watt=0.0)
    assert (found.watt, found.std_watt) == (390.0, pytest.approx(39.0))


def test_noise_of_samples_is_not_held_against_the_robot():
    rng, wrong, told = np.random.default_rng(0), [], []
    for _ in range(300):
        lasting = rng.normal(14.0, 0.5, 12)
        power, halt = halts(*lasting)
        found = estimate_idle_power(power + rng.normal(0.0, 3.0, power.size), halt, window_rows=20, step_watt=0.0)
        wrong.append(found.watt - rng.normal(14.0, 0.5))  # what it draws at another time
        told.append(found.std_watt)
    assert np.sqrt(np.mean(np.square(told))) == pytest.approx(np.std(wrong), rel=0.15)


def test_short_halts_are_noisier_and_do_not_count_as_change():
    rng, told = np.random.default_rng(2), []
    sizes = np.array([60, 12, 5, 51, 4, 71, 3, 15, 6, 38])
    for _ in range(100):
        halt = np.repeat(np.arange(sizes.size), sizes)
        power = 14.0 + rng.normal(0.0, 3.0, halt.size)
        told.append(estimate_idle_power(power, halt, window_rows=20, step_watt=0.0).std_watt)
    assert np.median(told) < 0.45  # 3 W of 265 rows are 0.2 W


def test_rows_between_two_samples_are_as_noisy_as_these():
    rng, told = np.random.default_rng(3), []
    for _ in range(100):
        power, halt = halts(*[14.0] * 10)
        noisy = power + rng.normal(0.0, 3.0, power.size)
        between = 0.5 * (noisy + np.roll(noisy, 1))
        told.append(estimate_idle_power(between, halt, window_rows=20, step_watt=0.0).std_watt)
    assert np.median(told) < 0.35  # 3 W of 600 rows are 0.12 W, of a second 0.67 W


def test_a_mean_is_finer_than_the_step_of_the_record():
    rng = np.random.default_rng(1)
    power, halt = halts(*[14.0] * 20)
    told = np.round((power + rng.normal(0.0, 2.0, power.size)) / 1.3) * 1.3
    found = estimate_idle_power(told, halt, window_rows=20, step_watt=1.3)
    assert found.watt == pytest.approx(14.0, abs=0.2)
    assert np.median(told) == pytest.approx(14.3)
    assert found.std_watt < 0.3


def test_a_record_that_stays_on_one_level_is_unsure_by_its_step():
    power, halt = halts(14.0, 14.0)
    assert estimate_idle_power(power, halt, window_rows=20, step_watt=1.2).std_watt == pytest.approx(
        np.hypot(1.2 / np.sqrt(12), 1.4 / 6)
    )


def test_motors_at_the_edges_of_a_halt_are_left_out_where_anything_else_is_known():
    power, halt = halts(14.0, 14.0)
    halt[:6] = halt[54:66] = halt[-6:] = -1
    power[halt < 0] = 60.0
    assert estimate_idle_power(power, halt, window_rows=20, step_watt=0.0).watt == 14.0
    edges = estimate_idle_power(np.full(50, 20.0), np.full(50, -1), window_rows=20, step_watt=0.0)
    assert edges.watt == 20.0


@pytest.mark.parametrize("known", [0, 39])
def test_a_robot_that_hardly_stood_has_none(known):
    power, halt = halts(14.0)
    power[known:] = np.nan
    found = estimate_idle_power(power, halt, window_rows=20, step_watt=0.0)
    assert np.isnan([found.watt, found.std_watt]).all()
