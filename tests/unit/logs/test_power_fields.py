"""Which fields are the power of what drives, by their names."""

import pytest

from tcpipe.logs.power_fields import match_power_fields


@pytest.mark.parametrize(
    ("names", "rails", "is_sure"),
    [
        (["voltage", "current", "rpm", "temperature"], [{"voltage": "voltage", "current": "current"}], True),
        (["bus_mv", "motors_ma[]"], [{"voltage": "bus_mv", "current": "motors_ma[]"}], False),
        (["curL", "curR", "velL", "velR"], [{"current": "curL + curR"}], True),
        (["left_voltage", "left_current", "right_voltage", "right_current"],
         [{"voltage": f"{side}_voltage", "current": f"{side}_current"} for side in ("left", "right")], True),
        (["state.voltage_input", "state.current_motor", "state.current_input", "state.avg_iq"],
         [{"voltage": "state.voltage_input", "current": "state.current_input"}], True),
        (["vbat", "computer_current", "wifi_current"], [{"voltage": "vbat", "current": "computer_current"}], False),
        (["drivers[].voltage", "drivers[].current"], [{"voltage": "drivers[0].voltage", "current": "drivers[].current"}], True),
        (["Power (w)", "energy_per_m", "speed (m/s)"], [{"power": "Power (w)"}], True),
        (["battery_voltage", "current_limit", "state_of_charge"], None, True),
        (["wheel_v", "wheel_w", "lin_v", "acc_a"], None, True),
    ],
)  # fmt: skip
def test_names_say_what_drives(names, rails, is_sure):
    found = match_power_fields(names)
    assert (None if found is None else list(found.rails)) == rails
    assert found is None or (found.doubt == "") is is_sure


def test_units_in_names_are_factors():
    assert match_power_fields(["bus_mv", "bus_ma"]).scales == {"voltage": 0.001, "current": 0.001}
