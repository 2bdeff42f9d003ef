"""Rows that are no measurement, isolated values and overflows, in the record of a drive whose energy is known."""

import numpy as np
import pytest

from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.power import readings
from tcpipe.power.rails import integrate_energy, make_rail, make_samples
from tcpipe.power.sources import BATTERY_STATE
from tcpipe.robots import PowerSource
from tcpipe.tables.findings import select_findings

HZ, SECONDS = 20, 60
COUNT = HZ * SECONDS
ROW = np.arange(COUNT)
TIME_NS = 1_700_000_000_000_000_000 + ROW * (1_000_000_000 // HZ)


def make_amp(seed: int = 1) -> np.ndarray:
    """Return the current of a drive with halts [A], as rough as ground is."""
    rng = np.random.default_rng(seed)
    rough = np.convolve(rng.normal(size=COUNT), np.exp(-np.arange(30) / 8.0), mode="same")
    driving = np.clip(np.minimum((ROW - 80) / 10, (COUNT - 80 - ROW) / 10), 0.0, 1.0)
    amp = 0.5 + driving * (5.5 + 1.5 * np.sin(ROW / 70) + 0.25 * rough) + 0.08 * rng.normal(size=COUNT)
    return np.round(amp / 0.05) * 0.05


AMP = make_amp()
VOLT = np.round(26.2 - 0.03 * AMP + 0.01 * np.random.default_rng(2).normal(size=COUNT), 2)


def read(volt=VOLT, amp=AMP, **columns):
    """Read messages of a battery that reports drawn currents as negative."""
    fields = {
        "log_time_ns": TIME_NS,
        "voltage": volt,
        "current": -np.asarray(amp),
        "percentage": np.full(COUNT, np.nan),
    }
    known = load_shipped_profiles().power_sources
    return readings.read_power({"/battery": (BATTERY_STATE, fields | columns)}, known)


def compute_energy(found) -> float:
    """Return the energy from second 2 to second 58 [J]."""
    (rail,) = found.rails["/battery"]
    parts = (make_samples(TIME_NS, values) for values in (rail.voltage_volt, rail.current_amp))
    span = TIME_NS[[2 * HZ]], TIME_NS[[58 * HZ]]
    return float(integrate_energy([make_rail("", *parts, averaged=False)], *span, rule="exact")[0])


RIGHT = compute_energy(read())


def find_reasons(found) -> list[str]:
    return [finding.names["reason"] for finding in select_findings(found.findings, "power-rejected")]


def change(values, rows, new):
    return np.where(rows, new, values)


@pytest.mark.parametrize("rows", [ROW % 5 == 0, np.random.default_rng(3).random(COUNT) < 0.3], ids=["fifth", "random"])
@pytest.mark.parametrize(
    ("volt", "amp"),
    [
        (-1.0, 1.0),
        (np.nan, 0.0),
        (np.nan, 1.0),
        (0.0, 0.0),
        (-1.0, 0.0),
        (65.535, 0.0),
        (655.35, 327.67),
        (np.nan, 9.0),
    ],
)
def test_a_row_whose_voltage_is_marked_as_missing_is_no_measurement(rows, volt, amp):
    found = read(change(VOLT, rows, volt), change(AMP, rows, amp))
    assert compute_energy(found) == pytest.approx(RIGHT, rel=0.005)
    (rail,) = found.rails["/battery"]
    assert np.isnan(rail.current_amp[rows]).all()
    assert np.isfinite(rail.current_amp[~rows]).all()


@pytest.mark.parametrize("mark", [1.0, -1.0, 32.767, -32.768, 65.535])
def test_a_marked_current_beside_a_right_voltage_is_no_measurement(mark):
    found = read(amp=change(AMP, (ROW % 5 == 0) & (ROW > 100) & (ROW < COUNT - 100), mark))
    assert compute_energy(found) == pytest.approx(RIGHT, rel=0.02)


def test_a_current_that_passes_through_a_mark_is_real():
    slow = np.round(1.0 + 0.8 * np.sin(ROW / 50.0), 2)
    larger = np.round((32.767 + 9.0 * np.sin(ROW / 50.0)) * 1000) / 1000
    for amp in (slow, change(slow, ROW < COUNT // 2, 1.0), larger):
        (rail,) = read(amp=amp).rails["/battery"]
        np.testing.assert_array_equal(rail.current_amp, amp)


def test_rows_of_a_table_may_hold_a_voltage_or_a_current():
    """Two sensors of different rates in one table: most rows have only one of both."""
    at_voltage = ROW % 4 == 0
    (rail,) = read(change(VOLT, ~at_voltage, np.nan), change(AMP, at_voltage, np.nan)).rails["/battery"]
    np.testing.assert_array_equal(np.isfinite(rail.voltage_volt), at_voltage)
    np.testing.assert_array_equal(np.isfinite(rail.current_amp), ~at_voltage)


@pytest.mark.parametrize("share", [0.01, 0.04])
@pytest.mark.parametrize("spike", [lambda amp: 10 * amp, lambda amp: -30 * amp, lambda amp: 0 * amp + 327.67])
@pytest.mark.parametrize("held", [1, 4, 20])
def test_isolated_values_are_no_measurement(share, spike, held):
    first = ROW // held * held
    rows = (np.random.default_rng(5).random(COUNT) < share)[first] & (AMP[first] > 4.5)
    volt, amp = VOLT[first], AMP[first]
    right, found = read(volt, amp), read(volt, change(amp, rows, spike(amp)))
    assert compute_energy(found) == pytest.approx(compute_energy(right), rel=0.03)


def test_a_drive_has_no_isolated_values():
    for seed in range(8):
        assert read(amp=make_amp(seed)).findings == ()


@pytest.mark.parametrize(
    "rows", [np.isin(ROW % 200, (7, 8, 9)), ROW % 5 == 0, ROW % 8 == 0], ids=["3 in a row", "1/5", "1/8"]
)
def test_too_many_isolated_values_reject_the_power(rows):
    assert find_reasons(read(amp=change(AMP, rows, 12 * AMP))) == ["isolated-values"]


def wrap(amp, span):
    return (amp + span / 2) % span - span / 2


@pytest.mark.parametrize("span", [8.0, 10.0, 12.0, 13.3])
def test_an_overflow_that_the_voltage_confirms_is_undone(span):
    found = read(amp=wrap(AMP, span))
    assert compute_energy(found) == pytest.approx(RIGHT, rel=0.002)
    (finding,) = select_findings(found.findings, "current-wrapped")
    assert finding.numbers["wraps_amp"] == pytest.approx(span, abs=0.11)


def test_an_overflow_that_nothing_confirms_rejects_the_power():
    constant, apart = np.full(COUNT, 24.0), np.random.default_rng(6).normal(26.0, 0.1, COUNT)
    for volt in (constant, apart):
        assert find_reasons(read(volt, wrap(AMP, 10.0))) == ["current-overflow"]


def test_currents_between_symmetric_limits_are_no_overflow_where_the_voltage_follows_them():
    """A robot that brakes as hard as it drives."""
    amp = np.clip(np.round(60.0 * np.sin(ROW / 12.0)) / 10.0 + np.where(np.sin(ROW / 12.0) > 0, 4.0, -4.0), -9.0, 9.0)
    amp = amp + 0.05 * (ROW % 3)
    found = read(26.2 - 0.03 * amp, amp)
    assert not select_findings(found.findings, "current-wrapped", "power-rejected")


@pytest.mark.parametrize("volt", [np.full(COUNT, 24.0), np.where(ROW < 300, 26.0, 25.0)], ids=["one level", "two"])
def test_a_voltage_of_fewer_than_three_levels_is_a_nominal_one(volt):
    found, measured = read(volt), read()
    (finding,) = select_findings(found.findings, "voltage-assumed")
    assert finding.severity == "warning"
    assert found.facts.gain_std_fraction == pytest.approx(np.hypot(measured.facts.gain_std_fraction, 0.08))
    assert not select_findings(measured.findings, "voltage-assumed")


def test_a_stated_nominal_voltage_is_reported_once():
    source = PowerSource("my_msgs/msg/Current", current="amp", nominal_voltage_volt=24.0)
    found = readings.read_power({"/c": (source.type, {"log_time_ns": TIME_NS, "amp": AMP})}, [source])
    assert len(select_findings(found.findings, "voltage-assumed")) == 1
    assert found.facts.gain_std_fraction == pytest.approx(np.hypot(0.02, 0.1))


@pytest.mark.parametrize(("status", "charging"), [(1, True), (2, False), (0, False)])
def test_a_battery_states_that_it_is_charged(status, charging):
    assert read(power_supply_status=np.full(COUNT, status)).facts.charging is charging
