"""Quality of labels: what a voltage outside its range touches."""

import numpy as np
import pytest

from tcpipe.cost.quality import voltage_outside
from tcpipe.power.rails import rail, samples


@pytest.mark.parametrize(("volt", "outside"), [(19.9, True), (20.0, False), (30.0, False), (30.1, True)])
def test_a_voltage_below_or_above_the_range_is_outside_and_the_ends_are_not(volt, outside):
    at = 1_000_000_000 * np.arange(5)
    made = rail(
        "drive", samples(at, np.array([24.0, 24.0, volt, 24.0, 24.0])), samples(at, np.zeros(5)), averaged=False
    )
    found = voltage_outside([made], at[1:2] + 500_000_000, at[2:3] + 500_000_000, range_volt=(20.0, 30.0))
    assert found.tolist() == [outside]
