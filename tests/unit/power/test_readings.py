"""Which fields are propulsion, whose sign they have, and when numbers cannot be power."""

import numpy as np
import pytest

from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.power import readings
from tcpipe.power.readings import PowerReadings
from tcpipe.power.sources import BATTERY_STATE
from tcpipe.robots import PowerSource
from tcpipe.tables.findings import Subject, select_findings

HUSKY_STATUS = "husky_msgs/msg/HuskyStatus"
CLEARPATH_POWER = "clearpath_platform_msgs/msg/Power"

N = 40
TIMES = {"log_time_ns": np.arange(N) * 50_000_000}
VOLT = 26.0 + np.sin(np.arange(N))
AMP = 5.0 + np.cos(np.arange(N))


def read_power(topics, robot: str, **options) -> PowerReadings:
    known = load_shipped_profiles()
    return readings.read_power(topics, known.power_sources, platform=known.robots[robot].platform, **options)


def husky_status() -> dict[str, np.ndarray]:
    return TIMES | {
        "battery_voltage": VOLT,
        "left_driver_voltage": VOLT - 0.5,
        "right_driver_voltage": VOLT - 0.7,
        "left_driver_current": AMP,
        "right_driver_current": AMP + 1.0,
        "mcu_and_user_port_current": np.full(N, 100.0),
    }


def battery(voltage: np.ndarray, current: np.ndarray, percentage: float = np.nan) -> dict[str, np.ndarray]:
    return TIMES | {"voltage": voltage, "current": current, "percentage": np.full(N, percentage)}


def reasons(found: PowerReadings) -> list[str]:
    """Why power is rejected."""
    assert found.rails == {}
    assert found.is_rejected
    assert {of.code for of in found.findings} == {"power-rejected"}
    return [of.names["reason"] for of in found.findings]


def power_watt(found: PowerReadings) -> np.ndarray:
    assert found.rails, found.findings
    return np.sum([rail.voltage_volt * rail.current_amp for rails in found.rails.values() for rail in rails], axis=0)


def test_a_huskys_propulsion_is_battery_voltage_times_both_drivers() -> None:
    found = read_power({"/status": (HUSKY_STATUS, husky_status())}, "husky")
    np.testing.assert_allclose(power_watt(found), VOLT * (2 * AMP + 1.0), rtol=1e-14)
    assert not found.facts.averaged
    assert found.findings == ()


def test_a_huskys_drivers_can_be_taken_each_by_itself() -> None:
    found = read_power({"/status": (HUSKY_STATUS, husky_status())}, "husky", husky_power="drivers")
    expected = (VOLT - 0.5) * AMP + (VOLT - 0.7) * (AMP + 1.0)
    np.testing.assert_allclose(power_watt(found), expected, rtol=1e-14)


def clearpath(voltages: tuple, currents: tuple) -> dict[str, np.ndarray]:
    return TIMES | {"measured_voltages": np.stack(voltages, -1), "measured_currents": np.stack(currents, -1)}


@pytest.mark.parametrize(
    ("robot", "option", "expected"),
    [
        ("husky", "battery", VOLT * (3 * AMP)),
        ("husky", "drivers", (VOLT - 1) * AMP + (VOLT - 2) * 2 * AMP),
        ("jackal", "battery", VOLT * 2 * AMP),
        ("warthog", "battery", VOLT * 9.0),
        ("dingo", "battery", VOLT * 9.0),
        ("ridgeback", "battery", VOLT * 9.0),
    ],
)
def test_clearpath_power_by_platform(robot: str, option: str, expected: np.ndarray) -> None:
    columns = clearpath((VOLT, VOLT - 1, VOLT - 2), (np.full(N, 9.0) + 0.0 * AMP, AMP, 2 * AMP))
    columns["measured_currents"][:, 0] += np.where(np.arange(N) == 0, 1e-9, 0)  # a current that moves, if little
    found = read_power({"/power": (CLEARPATH_POWER, columns)}, robot, husky_power=option)
    np.testing.assert_allclose(power_watt(found), expected, rtol=1e-9)
    assert found.facts.averaged == (robot != "husky")  # a Husky's driver asks for the state of the moment
    assert bool(found.findings) == (robot not in ("husky", "jackal"))  # the total current feeds the computers too
    assert [("power-includes-loads", name) for name in found.facts.includes] == [
        (of.code, of.names["loads"]) for of in found.findings
    ]


def test_clearpath_power_that_does_not_fit_the_platform_is_refused() -> None:
    two = clearpath((VOLT,), (AMP, AMP))
    (found,) = read_power({"/p": (CLEARPATH_POWER, two)}, "husky").findings
    assert found.names == {"reason": "values-count-differs", "field": "measured_currents"}
    assert found.numbers["values_count"] == 2
    four = clearpath((VOLT, VOLT, VOLT), (AMP, AMP, AMP, AMP))  # a Jackal's, whose second and third are no drivers'
    a300 = clearpath((VOLT,) * 13, (AMP,) * 13)
    for columns, count, platforms in ((four, 4, {}), (a300, 13, {"platforms": "A300"})):
        (found,) = read_power({"/p": (CLEARPATH_POWER, columns)}, "husky").findings
        assert found.names == {"reason": "values-count-differs", "field": "measured_currents", **platforms}
        assert found.numbers == {"values_count": count, "expected_count": 3}
    unknown = read_power({"/p": (CLEARPATH_POWER, two)}, "generic")
    assert reasons(unknown) == ["robot-platform-unknown"]
    assert unknown.findings[0].names["platforms"] == "A200, A300, D100, J100, R100, W200"


@pytest.mark.parametrize(("recorded", "signs"), [(AMP, ["drawn_positive"]), (-AMP, [])])
def test_the_sign_of_a_battery_is_told_by_its_mean(recorded: np.ndarray, signs: list[str]) -> None:
    found = read_power({"/battery": (BATTERY_STATE, battery(VOLT, recorded))}, "generic")
    np.testing.assert_allclose(power_watt(found), VOLT * AMP, rtol=1e-14)
    assert [(of.code, of.severity, of.names["sign"]) for of in found.findings] == [
        ("current-sign-assumed", "note", sign) for sign in signs
    ]


def test_the_sign_is_told_by_all_rails_together() -> None:
    left, right = 3.0 - 0.5 * AMP, 5 * AMP  # one side is driven by the other now and then
    topics = {"/left": (BATTERY_STATE, battery(VOLT, left)), "/right": (BATTERY_STATE, battery(VOLT, right))}
    np.testing.assert_allclose(power_watt(read_power(topics, "generic")), VOLT * (left + right), rtol=1e-12)


def test_an_unclear_sign_follows_ros_and_says_so_and_the_recipe_settles_it() -> None:
    balanced = battery(VOLT, np.cos(np.pi * np.arange(N)) * 4.0)
    found = read_power({"/b": (BATTERY_STATE, balanced)}, "generic")
    (assumed,) = found.findings
    assert (assumed.code, assumed.severity, assumed.names["sign"]) == (
        "current-sign-assumed",
        "warning",
        "drawn_negative",
    )
    assert len(assumed.remedies) == 2
    np.testing.assert_allclose(power_watt(found), -VOLT * balanced["current"])
    settled = read_power({"/b": (BATTERY_STATE, balanced)}, "generic", current_sign="drawn_positive")
    np.testing.assert_allclose(power_watt(settled), VOLT * balanced["current"])
    assert settled.findings == ()


@pytest.mark.parametrize(
    ("columns", "reason", "evidence"),
    [
        (battery(np.zeros(N), np.zeros(N), 73.0), "voltage-zero", {"median_volt": 0.0, "median_amp": 0.0}),
        (battery(np.zeros(N), AMP), "voltage-zero", {"median_volt": 0.0, "rows_count": 40.0}),
        (battery(VOLT, np.full(N, np.nan)), "no-current", {}),
        (battery(np.full(N, np.nan), AMP), "no-voltage", {}),
        (battery(np.full(N, np.nan), np.full(N, np.nan)), "no-numbers", {"rows_count": 40.0}),
        (battery(VOLT, np.zeros(N)), "current-constant", {"median_amp": 0.0, "rows_count": 40.0}),
        (battery(np.full(N, 73.0), AMP, 0.73), "voltage-is-charge", {"median_volt": 73.0}),
        (battery(np.full(N, 73.0), AMP, 73.0), "voltage-is-charge", {"median_volt": 73.0}),
        (battery(1000 * VOLT, AMP), "voltage-in-millivolts", {}),
        (battery(VOLT, 1000 * AMP), "current-in-milliamperes", {}),
        (battery(np.full(N, 0.8), AMP), "voltage-too-small", {"median_volt": 0.8}),
        (battery(VOLT, 1e-4 * AMP), "power-too-small", {}),
        (TIMES | {"voltage": VOLT}, "field-missing", {}),
    ],
)
def test_numbers_that_cannot_be_power_are_refused_with_evidence(columns: dict, reason: str, evidence: dict) -> None:
    found = read_power({"/battery": (BATTERY_STATE, columns)}, "generic")
    assert reasons(found) == [reason]
    assert found.findings[0].subject == Subject("topic", "/battery")
    assert evidence.items() <= found.findings[0].numbers.items()


@pytest.mark.parametrize(
    ("volt", "amp", "scales"), [(1000, 1, {"voltage_scale": 0.001}), (1, 1000, {"current_scale": 0.001})]
)
def test_thousandths_are_proposed_as_tables_of_a_recipe(volt: int, amp: int, scales: dict) -> None:
    (found,) = read_power({"/battery": (BATTERY_STATE, battery(volt * VOLT, amp * AMP))}, "generic").findings
    (remedy,) = found.remedies
    (table,) = remedy.recipe["power_sources"]
    assert scales.items() <= table.items()
    assert table["type"] == BATTERY_STATE
    assert "topic" not in table


def test_voltage_and_current_on_two_topics_are_one_rail() -> None:
    voltage = {"log_time_ns": np.arange(N) * 50_000_000, "data": VOLT}
    current = {"log_time_ns": np.arange(N) * 50_000_000 + 7, "data": -AMP}
    topics = {"/bus_voltage": ("std_msgs/msg/Float32", voltage), "/motor_current": ("std_msgs/msg/Float64", current)}
    found = read_power(topics, "generic")
    (bus,), (motor,) = found.rails["/bus_voltage"], found.rails["/motor_current"]
    assert (bus.name, motor.name) == ("battery", "battery")
    np.testing.assert_array_equal(bus.voltage_volt, VOLT)
    assert np.isnan(bus.current_amp).all()
    np.testing.assert_array_equal(motor.current_amp, AMP)


@pytest.mark.parametrize(
    ("robot", "topic", "step_amp"),
    [
        ("warthog", "/left_drive/status/battery", 1 / 16),
        ("generic", "/motor/rear", 1 / 16),
        ("generic", "/motor/rear", 0.1),
    ],
)
def test_negative_currents_come_as_unsigned_on_any_topic(robot: str, topic: str, step_amp: float) -> None:
    current = step_amp * np.rint(np.where(np.arange(N) % 8 == 0, -2.0, AMP) / step_amp)
    topics = {
        f"{topic}_voltage": ("std_msgs/msg/Float64", TIMES | {"data": VOLT}),
        f"{topic}_current": ("std_msgs/msg/Float64", TIMES | {"data": current % (65536 * step_amp)}),
    }
    (rail,) = read_power(topics, robot).rails[f"{topic}_current"]
    assert rail.name == topic
    np.testing.assert_allclose(rail.current_amp, current, atol=1e-9)
    if robot == "generic":
        (wrapped,) = select_findings(read_power(topics, robot).findings, "current-wrapped")
        assert wrapped.numbers == {"currents_count": 5.0, "wraps_amp": 65536 * step_amp}


def test_a_large_current_that_is_no_wrap_stays_as_it_is() -> None:
    """On the grid of milliamperes, as a wrapped number of 16 bits is, but with values all the way up."""
    rising = np.round(np.linspace(0.0, 65.0, N), 3)
    (rail,) = read_power({"/b": (BATTERY_STATE, battery(VOLT, rising))}, "generic").rails["/b"]
    np.testing.assert_array_equal(rail.current_amp, rising)


@pytest.mark.parametrize(
    ("log_time_s", "reason", "numbers"),
    [
        ([0.0, 95.0], "too-few-messages", {"messages_count": 2.0}),
        (15.0 * np.arange(N), "too-slow", {"period_s": 15.0}),
        ([], "too-few-messages", {"messages_count": 0.0}),
    ],
)
def test_power_that_comes_too_seldom_is_refused(log_time_s, reason: str, numbers: dict) -> None:
    count = len(log_time_s)
    columns = {"log_time_ns": np.asarray(log_time_s) * 1e9, "voltage": VOLT[:count], "current": AMP[:count]}
    columns["percentage"] = np.full(count, np.nan)
    found = read_power({"/b": (BATTERY_STATE, columns)}, "generic")
    assert reasons(found) == [reason]
    assert found.findings[0].numbers == numbers


def test_rows_that_no_battery_has_are_excluded_and_counted() -> None:
    columns = battery(VOLT.copy(), AMP.copy())
    columns["voltage"][[4, 9]] = 65.535e3, 0.0
    columns["current"][7] = -32768.0
    columns["voltage"][12] = columns["current"][12] = 0.0
    found = read_power({"/b": (BATTERY_STATE, columns)}, "generic")
    (rail,) = found.rails["/b"]
    for values in (rail.voltage_volt, rail.current_amp):
        assert np.flatnonzero(np.isnan(values)).tolist() == [4, 7, 9, 12]
    (excluded,) = select_findings(found.findings, "power-values-excluded")
    assert excluded.numbers == {"rows_count": 4, "rows_fraction": 0.1}


@pytest.mark.parametrize("topic", [("/status", HUSKY_STATUS), ("/battery", BATTERY_STATE)])
def test_a_row_beside_a_hole_does_not_tell_the_sign(topic: tuple[str, str]) -> None:
    """Twelve hours without messages, and the row before them feeds back a little."""
    columns = husky_status() if topic[1] == HUSKY_STATUS else battery(VOLT, AMP.copy())
    hole = {"log_time_ns": TIMES["log_time_ns"] + np.where(np.arange(N) > 20, 43_200_000_000_000, 0)}
    currents = [name for name in columns if name.endswith("driver_current") or name == "current"]
    braking = {name: np.where(np.arange(N) == 20, -1.0, columns[name]) for name in currents}
    found = read_power({topic[0]: (topic[1], {**columns, **hole, **braking})}, "husky")
    watt = power_watt(found)
    assert np.sum(watt > 0) == N - 1
    assert not found.is_rejected


def source(**said) -> PowerSource:
    return PowerSource("my_msgs/msg/Battery", **{"voltage": "v", "current": "i", **said})


def test_a_type_whose_drawn_current_is_negative_needs_no_recipe_line() -> None:
    columns = TIMES | {"v": VOLT, "i": -AMP}
    topics, known = {"/b": ("my_msgs/msg/Battery", columns)}, [source(sign="drawn_negative")]
    found = readings.read_power(topics, known)
    np.testing.assert_allclose(power_watt(found), VOLT * AMP)
    assert found.facts.current_sign == "drawn_negative (message type)"
    against = readings.read_power({"/b": ("my_msgs/msg/Battery", columns | {"i": AMP})}, known)
    assert against.findings[0].remedies[0].recipe == {"read": {"current_sign": "drawn_positive"}}
    told = readings.read_power(
        {"/b": ("my_msgs/msg/Battery", columns | {"i": AMP})}, known, current_sign="drawn_positive"
    )
    np.testing.assert_allclose(power_watt(told), VOLT * AMP)


@pytest.mark.parametrize(("drawn", "factor", "other"), [("positive", -1, "negative"), ("negative", 1, "positive")])
def test_a_refusal_says_how_much_flows_back_and_which_sign_it_would_be(drawn: str, factor: int, other: str) -> None:
    topics = {"/b": ("my_msgs/msg/Battery", TIMES | {"v": VOLT, "i": factor * AMP})}
    (found,) = readings.read_power(topics, [source(sign=f"drawn_{drawn}")]).findings
    assert found.numbers == {"net_fraction": pytest.approx(1.0)}
    assert [of.name for of in found.remedies] == [f"drawn_{other}", f"drawn_{drawn}"]


@pytest.mark.parametrize(
    "type_name",
    [
        "clearpath_motor_msgs/msg/LynxMultiFeedback",
        "clearpath_motor_msgs/msg/PumaMultiFeedback",
        "clearpath_platform_msgs/msg/Feedback",
        "scout_msgs/msg/ScoutStatus",
    ],
)
def test_currents_that_are_not_known_to_be_drawn_are_refused_with_the_reason(type_name: str) -> None:
    found = read_power({"/motors": (type_name, TIMES)}, "generic")
    assert reasons(found) == ["no-battery-current"]
    assert found.findings[0].names["type"] == type_name


@pytest.mark.parametrize("unmeasured", [0.0, np.nan])
def test_the_state_of_charge_is_used_where_the_charge_is_not_measured(unmeasured):
    missing = np.full(N, unmeasured)
    left = 1.0 - np.cumsum(AMP) * 0.05 / 3600.0 / 0.02
    columns = battery(VOLT, -AMP) | {"percentage": left, "charge": missing, "capacity": missing}
    power = read_power({"/b": (BATTERY_STATE, columns | {"design_capacity": np.full(N, 0.02)})}, "husky")
    assert power.facts.charge_ratio == pytest.approx(1.0, abs=0.05)
