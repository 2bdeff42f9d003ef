"""Where the rules about a power topic's numbers begin to hold, to the row and to the volt."""

import numpy as np
import pytest

from tcpipe.power.sources import (
    LARGEST_AMP,
    RailReadings,
    quantity,
    rail_of,
    read_rails,
    sign_by_mean,
    why_refused,
    with_sign,
)
from tcpipe.robots.profiles import PowerSource

VARIED = np.array([5.0, 6.0])


def refused(volt, amp, **columns):
    return why_refused(RailReadings("b", np.asarray(volt, float), np.asarray(amp, float)), columns)


def source(**said):
    return PowerSource("my_msgs/msg/Battery", **{"voltage": "v", "current": "i", **said})


@pytest.mark.parametrize(
    ("volt", "why"),
    [
        (1000.0, None),
        (1000.1, "millivolts"),
        (1.0, None),
        (0.99, "share of charge"),
        (-24.0, "reversed"),
        (0.0, "zero"),
    ],
)
def test_a_voltage_is_believed_from_one_volt_to_a_thousand(volt, why):
    found = refused([volt, volt], VARIED)
    assert found is None if why is None else why in found


def test_a_voltage_of_zeros_says_whether_the_current_is_too():
    assert "the voltage is zero on all 2 rows" in refused([0, 0], VARIED)
    assert "the voltage and the current are zero on all 2 rows" in refused([0, 0], [0, 0])
    assert "the voltage is zero" in refused([0, 0], [np.nan, np.nan])
    assert refused([0, 24, 24], [5, 6, 7]) is None


def test_a_current_alone_and_a_voltage_alone_are_judged():
    nothing = [np.nan, np.nan]
    assert refused([24, 25], nothing) is None
    assert refused(nothing, VARIED) is None
    assert "neither voltage nor current is a number on any of 2 rows" in refused(nothing, nothing)
    assert refused([24, 25], [LARGEST_AMP, LARGEST_AMP]) is None
    assert "milliamperes" in refused(nothing, [-LARGEST_AMP - 1, -LARGEST_AMP - 2])


def test_a_current_that_never_changes_is_refused_beyond_twenty_rows():
    assert refused(np.full(20, 24.0), np.full(20, 5.0)) is None
    assert "the current is 5 A on all 21 rows" in refused(np.full(21, 24.0), np.full(21, 5.0))
    assert refused(np.full(21, 24.0), [5.0] * 20 + [5.1]) is None


@pytest.mark.parametrize("factor", [1.0, 0.01])
def test_a_voltage_that_is_the_charge_is_refused_unless_one_row_differs(factor):
    charge = np.array([90.0, 80.0, 70.0])
    assert "percentage of charge on all 3 rows (first 90)" in refused(charge, [5, 6, 7], percentage=factor * charge)
    assert refused(charge, [5, 6, 7], percentage=factor * np.array([90.0, 80.0, 60.0])) is None


def test_a_current_wraps_beyond_half_of_its_range_and_what_nothing_can_be_is_unknown():
    columns = {"v": np.full(5, 24.0), "i": np.array([50.0, 51.0, -1.0, 1e6, 1.1e6])}
    (wrapped,) = read_rails(columns, [source(wraps_amp=100.0)], "/b")
    assert wrapped.current_amp[:3].tolist() == [50.0, -49.0, -1.0]
    (plain,) = read_rails(columns, [source()], "/b")
    assert plain.current_amp[3] == 1e6
    assert np.isnan(plain.current_amp[4])


def test_a_list_of_currents_must_reach_to_the_last_that_is_wanted_and_be_as_long_as_the_platforms():
    columns = {"v": np.full(2, 24.0), "i": np.array([[1.0, 2.0, 4.0]] * 2)}
    (found,) = read_rails(columns, [source(current="i[0] + i[2]", currents_listed=3)], "/b")
    assert found.current_amp.tolist() == [5.0, 5.0]
    assert read_rails(columns, [source(current="i[3]")], "/b") == "/b: i holds 3 values, the robot's platform needs 4"
    assert "i holds 3 values, this platform's 4" in read_rails(
        columns, [source(current="i[2]", currents_listed=4)], "/b"
    )
    assert read_rails(columns, [source(current="i[1]", voltage="v[0]")], "/b").startswith("/b: v holds 0 values")
    assert read_rails(columns, [source(current="j")], "/b") == "/b: its messages have no field j"


def test_a_sign_is_clear_where_more_than_eight_tenths_flow_one_way():
    weight = np.ones(20)
    assert sign_by_mean(np.array([1.0] * 18 + [-1.0] * 2), weight) == (0, pytest.approx(0.8))
    assert sign_by_mean(np.array([1.0] * 19 + [-1.0]), weight) == (1, pytest.approx(0.9))
    assert sign_by_mean(np.array([-1.0] * 19 + [1.0]), weight) == (-1, pytest.approx(-0.9))
    assert sign_by_mean(np.zeros(20), weight) == (0, 0.0)
    assert sign_by_mean(np.array([-1.0, 1.0]), np.array([1.0, 99.0])) == (1, pytest.approx(0.98))
    assert sign_by_mean(np.array([1e-3, np.nan]), np.ones(2)) == (1, pytest.approx(1.0))


def test_with_sign_turns_the_current_alone():
    rail = with_sign(RailReadings("b", VARIED, VARIED), -1)
    assert rail.current_amp.tolist() == [-5.0, -6.0]
    assert rail.voltage_volt.tolist() == [5.0, 6.0]


def test_the_last_word_of_a_topic_tells_its_quantity_and_the_rest_its_rail():
    assert quantity("/current_sensors/voltage") == "voltage"
    assert quantity("/volt_meter/amps") == "current"
    assert quantity("/power") is None
    assert rail_of("/battery/voltage_corrected") == rail_of("/battery/current") == "/battery"
