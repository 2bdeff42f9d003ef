"""A power table whose messages repeat readings becomes the readings, quantity by quantity; any other table stays as it is."""

import numpy as np
import pytest
from made_tracks import power_streams, stamps, with_columns

from tcpipe.power.noise import compute_median_period_s, estimate_energy_noise
from tcpipe.power.rails import integrate_energy
from tcpipe.simulation import find_scenario, simulate_readings
from tcpipe.simulation.scenarios import make_small_world
from tcpipe.simulation.sensors import Faults, Noise, Power, Sensors, record
from tcpipe.stages.message_arrays import make_rails
from tcpipe.stages.read_power import find_repeats, remove_repeats
from tcpipe.tables.levels import Streams

COUNT = 4000
STAMP_NS = stamps(COUNT)


def held(values, rows):
    """Return values of which each is repeated for so many rows, from the middle of the first."""
    return values[(np.arange(COUNT) + rows // 2) // rows]


def drawn(seed, *, step=0.01, scale=2.0):
    return np.round((6.0 + scale * np.random.default_rng(seed).standard_normal(COUNT)) / step) * step


def read(rails):
    streams, repeats = remove_repeats(power_streams(rails).tables)
    return make_rails(Streams(streams, {}, "husky"), 0), repeats


def rates_hz(rails):
    return [
        round(1.0 / compute_median_period_s(signal), 1) for each in rails for signal in (each.current, each.voltage)
    ]


def test_voltage_and_current_may_be_read_at_rates_of_their_own():
    rails, repeats = read({"battery": (STAMP_NS, held(drawn(1) + 20, 20), held(drawn(2), 5))})
    assert rates_hz(rails) == [4.0, 1.0]
    assert [(each.quantity, round(each.reading_hz, 1)) for each in repeats] == [("current", 4.0), ("voltage", 1.0)]


@pytest.mark.parametrize("volt", [np.full(COUNT, 25.0), held(np.round(25 + 0.1 * drawn(3), 1), 10)])
def test_a_voltage_that_hardly_changes_comes_with_the_current(volt):
    rails, _ = read({"battery": (STAMP_NS, volt, held(drawn(2), 10))})
    assert rates_hz(rails) == [2.0, 2.0]


def test_a_voltage_alone_on_its_topic_is_told_by_itself():
    nothing = np.full(COUNT, np.nan)
    volt, amp = held(drawn(1) + 20, 20), drawn(2)
    both = (np.concatenate((STAMP_NS, STAMP_NS + 7)), np.append(volt, nothing), np.append(nothing, amp))
    rails, repeats = read({"battery": both})
    assert rates_hz(rails) == [20.0, 1.0]
    assert [each.quantity for each in repeats] == ["voltage"]
    (found,) = find_repeats(repeats)
    assert (found.code, found.names["quantity"]) == ("power-readings-repeated", "voltage")


def test_clock_epochs_are_told_together_and_kept_apart():
    table = power_streams({"battery": (STAMP_NS, drawn(1) + 20, held(drawn(2), 20))}).tables["power"]
    clock_epoch = (np.arange(COUNT) >= COUNT - 300).astype(np.int16)  # 15 readings are too few to tell by themselves
    back_ns = np.where(clock_epoch, STAMP_NS - 30_000_000_000, STAMP_NS)
    streams, _ = remove_repeats({"power": with_columns(table, clock_epoch=clock_epoch, stamp_ns=back_ns)})
    assert [rates_hz(make_rails(Streams(streams, {}, "husky"), number))[0] for number in (0, 1)] == [1.0, 1.0]


@pytest.fixture(scope="module")
def truth():
    return simulate_readings(find_scenario("hills12"))[0]


@pytest.mark.parametrize("reading_hz", [1.0, 2.0, 4.0, 5.0])
def test_energies_are_as_wrong_as_they_say(truth, reading_hz):
    faults, sensors = Faults.only("power_noise"), Sensors(power=Power(reading_hz=reading_hz))
    reading = record(truth, make_small_world().site, sensors, faults, Noise(1, 0))["power"]
    amp = reading.values["left_amp"] + reading.values["right_amp"]
    streams = power_streams({"drive": (reading.stamp_ns, reading.values["voltage_volt"], amp)}).tables
    start_ns = np.arange(truth.stamp_ns[0] + 10**10, truth.stamp_ns[-1] - 10**10, 1_200_000_000)
    end_ns = start_ns + 1_200_000_000
    steady = truth.at(start_ns).forward_velocity_mps * truth.at(end_ns).forward_velocity_mps > 0.3
    start_ns, end_ns = start_ns[steady], end_ns[steady]
    true_joule = truth.at(end_ns).energy_joule - truth.at(start_ns).energy_joule
    inside, rms = {}, {}
    for name, table in (("messages", streams), ("readings", remove_repeats(streams)[0])):
        rails = make_rails(Streams(table, {}, "husky"), 0)
        error = integrate_energy(rails, start_ns, end_ns, rule="exact") - true_joule
        std = estimate_energy_noise(rails, start_ns, end_ns, np.empty((0, 2), np.int64)).std_joule()
        inside[name] = [float(np.mean(np.abs(error) <= k * std)) for k in (1, 2)]
        rms[name] = float(np.sqrt(np.mean(error**2)))
    assert inside["messages"][1] < 0.6
    assert 0.5 < inside["readings"][0] < 0.95
    assert inside["readings"][1] > 0.85
    assert rms["readings"] < 0.85 * rms["messages"]
