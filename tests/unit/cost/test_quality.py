"""Quality of labels: what a voltage outside its range touches."""

import numpy as np
import pytest

from tcpipe.cost.labels import has_low_power_rate, touches_voltage_outside
from tcpipe.power.rails import make_rail, make_samples


@pytest.mark.parametrize(("volt", "outside"), [(19.9, True), (20.0, False), (30.0, False), (30.1, True)])
def test_a_voltage_below_or_above_the_range_is_outside_and_the_ends_are_not(volt, outside):
    at = 1_000_000_000 * np.arange(5)
    made = make_rail(
        "drive",
        make_samples(at, np.array([24.0, 24.0, volt, 24.0, 24.0])),
        make_samples(at, np.zeros(5)),
        averaged=False,
    )
    found = touches_voltage_outside([made], at[1:2] + 500_000_000, at[2:3] + 500_000_000, range_volt=(20.0, 30.0))
    assert found.tolist() == [outside]


@pytest.mark.parametrize(
    ("current_hz", "voltage_hz", "swing_volt", "slow"),
    [(20, 20, 2.0, False), (20, 1, 0.1, False), (20, 1, 1.0, True), (5, 20, 0.1, True), (5, 1, 0.1, True)],
)
def test_the_rate_is_that_of_the_current_and_of_a_voltage_that_varies(current_hz, voltage_hz, swing_volt, slow):
    def sampled(hz, values):
        return make_samples((np.arange(30 * hz) * (1_000_000_000 // hz)).astype(np.int64), values(np.arange(30 * hz)))

    voltage = sampled(voltage_hz, lambda i: 24.0 + swing_volt * (i % 2))
    made = make_rail("drive", voltage, sampled(current_hz, lambda i: 5.0 + i % 3), averaged=False)
    assert has_low_power_rate([made]) is slow
