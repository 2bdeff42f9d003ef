"""Where the rules about a power topic's numbers begin to hold, to the row and to the volt."""

import numpy as np
import pytest

from tcpipe.power.rails import integrate_energy, make_rail, make_samples
from tcpipe.power.sources import (
    RailReadings,
    count_energy,
    find_lone_side,
    find_quantity,
    find_rejection,
    find_unmeasured,
    make_rail_name,
    read_rails,
    sign_by_mean,
)
from tcpipe.robots import PowerSource

VARIED = np.array([5.0, 6.0])


def rejection(volt, amp, **columns):
    return find_rejection(RailReadings("b", np.asarray(volt, float), np.asarray(amp, float)), "/b", columns)


def reason(volt, amp, **columns):
    found = rejection(volt, amp, **columns)
    return None if found is None else found.names["reason"]


def source(**said):
    return PowerSource("my_msgs/msg/Battery", **{"voltage": "v", "current": "i", **said})


@pytest.mark.parametrize(
    ("volt", "why"),
    [
        (1000.0, None),
        (1000.1, "voltage-in-millivolts"),
        (1.0, None),
        (0.99, "voltage-too-small"),
        (-24.0, "voltage-too-small"),
        (0.0, "voltage-zero"),
    ],
)
def test_a_voltage_is_believed_from_one_volt_to_a_thousand(volt, why):
    assert reason([volt, volt], VARIED) == why


def test_a_current_that_never_changes_is_refused_beyond_twenty_rows():
    assert reason(np.full(20, 24.0), np.full(20, 5.0)) is None
    assert reason(np.full(21, 24.0), np.full(21, 5.0)) == "current-constant"
    assert reason(np.full(21, 24.0), [5.0] * 20 + [5.1]) is None


@pytest.mark.parametrize("factor", [1.0, 0.01])
def test_a_voltage_that_is_the_charge_is_refused_unless_one_row_differs(factor):
    charge = np.array([90.0, 80.0, 70.0])
    assert reason(charge, [5, 6, 7], percentage=factor * charge) == "voltage-is-charge"
    assert reason(charge, [5, 6, 7], percentage=factor * np.array([90.0, 80.0, 60.0])) is None


def test_a_current_wraps_beyond_half_of_its_range_and_what_nothing_can_be_is_unknown():
    columns = {"log_time_ns": np.arange(5), "v": np.full(5, 24.0), "i": np.array([50.0, 51.0, -1.0, 1e6, 1.1e6])}
    (wrapped,) = read_rails(columns, [source(wraps_amp=100.0)], "/b")
    assert wrapped.current_amp[:3].tolist() == [50.0, -49.0, -1.0]
    (plain,) = read_rails(columns, [source()], "/b")
    assert plain.current_amp[3] == 1e6
    assert np.isnan(plain.current_amp[4])


def test_a_list_of_currents_must_reach_to_the_last_that_is_wanted_and_be_as_long_as_the_platforms():
    columns = {"log_time_ns": np.arange(2), "v": np.full(2, 24.0), "i": np.array([[1.0, 2.0, 4.0]] * 2)}
    (found,) = read_rails(columns, [source(current="i[0] + i[2]", currents_listed=3)], "/b")
    assert found.current_amp.tolist() == [5.0, 5.0]
    for said, field, counts in (
        ({"current": "i[3]"}, "i", (3.0, 4.0)),
        ({"current": "i[2]", "currents_listed": 4}, "i", (3.0, 4.0)),
        ({"current": "i[1]", "voltage": "v[0]"}, "v", (0.0, 1.0)),
        ({"current": "j"}, "j", ()),
    ):
        found = read_rails(columns, [source(**said)], "/b")
        reason = "values-count-differs" if counts else "field-missing"
        numbers = dict(zip(("values_count", "expected_count"), counts, strict=False))
        assert (found.names["reason"], found.names["field"], found.numbers) == (reason, field, numbers)


def test_a_sign_is_clear_where_more_than_eight_tenths_flow_one_way():
    weight = np.ones(20)
    assert sign_by_mean(np.array([1.0] * 18 + [-1.0] * 2), weight) == (0, pytest.approx(0.8))
    assert sign_by_mean(np.array([1.0] * 19 + [-1.0]), weight) == (1, pytest.approx(0.9))
    assert sign_by_mean(np.array([-1.0] * 19 + [1.0]), weight) == (-1, pytest.approx(-0.9))
    assert sign_by_mean(np.zeros(20), weight) == (0, 0.0)
    assert sign_by_mean(np.array([-1.0, 1.0]), np.array([1.0, 99.0])) == (1, pytest.approx(0.98))
    assert sign_by_mean(np.array([1e-3, np.nan]), np.ones(2)) == (1, pytest.approx(1.0))


def test_the_last_word_of_a_topic_tells_its_quantity_and_the_rest_its_rail():
    assert find_quantity("/current_sensors/voltage") == "voltage"
    assert find_quantity("/volt_meter/amps") == "current"
    assert find_quantity("/power") is None
    assert make_rail_name("/battery/voltage_corrected") == make_rail_name("/battery/current") == "/battery"


N = 200
STAMP_NS = np.cumsum(np.random.default_rng(3).integers(10_000_000, 90_000_000, N))
VOLT = 24.0 + np.sin(np.arange(N))
TRUE_JOULE = np.cumsum(np.random.default_rng(4).uniform(0.5, 9.0, N))


def spent(counter, row) -> float:
    """Return the energy of a counter's rail between the second and the last row."""
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


AT_NS = 1_700_000_000_000_000_000 + 50_000_000 * np.arange(2000, dtype=np.int64)


def draw_currents(seed, step_amp):
    """Two drives over ground: their currents rise and fall together, with noise of their own; a halt every 20 s."""
    rng = np.random.default_rng(seed)
    shared = 4.0 + 2.0 * np.sin(np.arange(2000) / 37.0) + 1.5 * np.sin(np.arange(2000) / 11.0 + seed)
    drives = (np.arange(2000) % 400 > 60)[:, None] * (shared[:, None] + 0.3 * rng.standard_normal((2000, 2)))
    return np.round((drives + 0.08 * rng.standard_normal((2000, 2))) / step_amp) * step_amp


@pytest.mark.parametrize("step_amp", [0.05, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("seed", range(3))
def test_currents_that_are_measured_are_neither_clipped_nor_frozen(seed, step_amp):
    both = draw_currents(seed, step_amp)
    assert not find_unmeasured(both, AT_NS).any()
    assert not find_unmeasured(both[:, :1], AT_NS).any()
    assert not find_unmeasured(np.repeat(both[::20], 20, axis=0), AT_NS).any()  # a reading lasts for 20 messages
    assert not find_unmeasured(np.abs(both), AT_NS).any()


@pytest.mark.parametrize("frozen_amp", [0.0, 3.0])
def test_a_current_that_stands_still_while_the_other_drives_is_found_where_it_does(frozen_amp):
    both = draw_currents(1, 0.05)
    both[700:1500, 1] = frozen_amp
    found = find_unmeasured(both, AT_NS)
    assert found[700:1500].all()
    assert found.sum() <= 801


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_current_at_the_end_of_its_range_is_found(sign):
    both = draw_currents(2, 0.05)
    clipped = both.copy()
    clipped[:, 0] = np.minimum(both[:, 0], 5.0)
    found = find_unmeasured(sign * clipped, AT_NS)
    assert np.array_equal(found, clipped[:, 0] == 5.0)
    assert 100 < found.sum() < 1500


def test_the_drives_of_one_side_alone_are_found():
    both = ("/left_drive/battery_state", "/right_drive/battery_state")
    assert find_lone_side(both) is None
    assert find_lone_side(both[:1]) == both[0]
    assert find_lone_side(("/battery_state", "/left_pocket/battery_state")) is None
    assert find_lone_side(("/left_right_motor_currents",)) is None
