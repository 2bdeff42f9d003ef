"""A message of each robot family, written by rosbags from its own definition and read through a real log: the power that was put in."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.ros_types import load_shipped_definitions
from tcpipe.formats.recipe_toml import load_profiles, load_shipped_profiles
from tcpipe.power.readings import PowerReadings, read_power
from tcpipe.power.sources import list_power_lists
from tcpipe.recipe import Recipe
from tcpipe.robots import PowerSource
from tcpipe.stages.message_arrays import make_message_arrays
from tcpipe.tables.findings import select_findings

N = 60
VOLT = 25.0 + 0.1 * np.arange(N) / N
AMP = 5.0 + np.cos(np.arange(N))
STEP_NS = 50_000_000


def filled(types, name: str, given: dict):
    """Return a message of zeros but for what is given; nested messages as dicts, of lists each element."""
    empty = {"bool": False, "string": "", "float32": 0.0, "float64": 0.0}
    values = {}
    for field, (kind, of) in types.get_msgdef(name).fields:
        values[field] = made(types, kind, of, given.get(field), empty)
    return types.types[name](**values)


def made(types, kind, of, value, empty):
    if int(kind) == 1:
        return empty.get(of[0], 0) if value is None else value
    if int(kind) == 2:
        return filled(types, of, value or {})
    (inner, inner_of), length = of
    if int(inner) == 1:
        numbers = np.dtype(inner_of[0] if inner_of[0] != "string" else "O")
        return np.zeros(length, numbers) if value is None else np.asarray(value, numbers)
    return [filled(types, inner_of, each) for each in (value if value is not None else [{}] * length)]


def log_of(path: Path, name: str, rows: list[dict]) -> Path:
    types = get_typestore(Stores.ROS2_HUMBLE)
    found = {}
    for of, text in load_shipped_definitions().items():
        found.update(get_types_from_msg(text, of))
    types.register(found)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/power", name, typestore=types)
        for i, row in enumerate(rows):
            stamp_ns = 1_700_000_000_000_000_000 + i * STEP_NS
            header = {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}}
            message = filled(types, name, {"header": header, **row})
            writer.write(connection, stamp_ns, types.serialize_cdr(message, name))
    return path


def power_of(path: Path, robot: str = "generic", recipe: Recipe | None = None, **options) -> PowerReadings:
    known = load_profiles(recipe) if recipe else load_shipped_profiles()
    with open_log(path) as log:
        type_name = log.topics["/power"].type_name
        columns = make_message_arrays(
            log.tables(["/power"])["/power"], list_power_lists(type_name, known.power_sources)
        )
    platform = known.robots[robot].platform
    return read_power({"/power": (type_name, columns)}, known.power_sources, platform=platform, **options)


def watt(found: PowerReadings) -> np.ndarray:
    assert found.rails, found.findings
    return np.sum([rail.voltage_volt * rail.current_amp for rails in found.rails.values() for rail in rails], axis=0)


def husarion(drivers: int, sign: int = 1) -> list[dict]:
    return [
        {"driver_states": [{"state": {"voltage": volt, "current": sign * amp * (k + 1)}} for k in range(drivers)]}
        for volt, amp in zip(VOLT, AMP, strict=True)
    ]


@pytest.mark.parametrize(("drivers", "share"), [(1, 1), (2, 3)])
@pytest.mark.parametrize("sign", [1, -1])
def test_husarions_drivers_are_summed_however_many_there_are(drivers, share, sign, tmp_path):
    found = power_of(log_of(tmp_path / "a", "husarion_ugv_msgs/msg/RobotDriverState", husarion(drivers, sign)))
    np.testing.assert_allclose(watt(found), VOLT * share * AMP, rtol=1e-6)
    assert found.averaging_unknown
    assert found.facts.current_sign.startswith("drawn_positive" if sign > 0 else "drawn_negative")


def test_an_earlier_panther(tmp_path):
    rows = [
        {"front": {"voltage": v, "current": a}, "rear": {"voltage": v, "current": a / 2}}
        for v, a in zip(VOLT, AMP, strict=True)
    ]
    found = power_of(log_of(tmp_path / "a", "panther_msgs/msg/DriverState", rows))
    np.testing.assert_allclose(watt(found), VOLT * 1.5 * AMP, rtol=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_unitree_go2(sign, tmp_path):
    rows = [{"power_v": v, "power_a": sign * a} for v, a in zip(VOLT, AMP, strict=True)]
    found = power_of(log_of(tmp_path / "a", "unitree_go/msg/LowState", rows))
    np.testing.assert_allclose(watt(found), VOLT * AMP, rtol=1e-6)
    (loads,) = select_findings(found.findings, "power-includes-loads")
    assert "computers, sensors and payload" in loads.names["loads"]


def test_a_sign_that_neither_type_nor_record_tells_is_asked_for(tmp_path):
    rows = [{"power_v": v, "power_a": 4.0 * np.sin(i)} for i, v in enumerate(VOLT)]
    path = log_of(tmp_path / "a", "unitree_go/msg/LowState", rows)
    found = power_of(path)
    assert found.rails == {}
    (rejected,) = found.findings
    assert (rejected.code, rejected.names["reason"]) == ("power-rejected", "sign-unknown")
    assert [of.name for of in rejected.remedies] == ["drawn_negative", "drawn_positive"]
    assert power_of(path, current_sign="drawn_negative").rails


def a300(lynx: float, pack_amp: np.ndarray = AMP + 3.0) -> list[dict]:
    return [
        {
            "measured_voltages": [v, *[0.0] * 8, *[v] * 4],
            "measured_currents": [p, *[0.0] * 8, *(lynx * a * k for k in (1, 2, 3, 4))],
        }
        for v, a, p in zip(VOLT, AMP, pack_amp, strict=True)
    ]


@pytest.mark.parametrize(("lynx", "expected"), [(1.0, VOLT * 10 * AMP), (0.0, VOLT * (AMP + 3.0))])
def test_a_husky_a300_tells_its_drives_or_else_its_pack(lynx, expected, tmp_path):
    path = log_of(tmp_path / "a", "clearpath_platform_msgs/msg/Power", a300(lynx))
    found = power_of(path, "husky_a300")
    np.testing.assert_allclose(watt(found), expected, rtol=1e-6)
    assert found.facts.averaged
    codes = {of.code for of in found.findings}
    assert ({"power-fallback", "power-includes-loads"} <= codes) == (lynx == 0.0)
    assert power_of(path, "husky").findings[0].names["platforms"] == "A300"


def vesc(joule: np.ndarray, *, given_back: float = 0.0, amp: np.ndarray = AMP) -> list[dict]:
    back = given_back * np.arange(N)
    return [
        {"state": {"voltage_input": v, "current_input": a, "energy_drawn": (e + b) / 3600, "energy_regen": b / 3600}}
        for v, a, e, b in zip(VOLT, amp, joule, back, strict=True)
    ]


def test_a_vescs_watt_hours_are_its_power(tmp_path):
    joule = np.concatenate(([7.0], 7.0 + np.cumsum(VOLT[1:] * AMP[1:]) * STEP_NS / 1e9))
    path = log_of(tmp_path / "a", "vesc_msgs/msg/VescStateStamped", vesc(joule, given_back=0.1, amp=0.5 * AMP))
    found = power_of(path)
    np.testing.assert_allclose(watt(found)[1:], (VOLT * AMP)[1:], rtol=1e-6)
    assert np.isnan(watt(found)[0])
    assert found.facts.averaged


def test_a_vesc_that_counts_nothing_tells_its_mean_current(tmp_path):
    found = power_of(log_of(tmp_path / "a", "vesc_msgs/msg/VescStateStamped", vesc(np.zeros(N))))
    np.testing.assert_allclose(watt(found), VOLT * AMP, rtol=1e-6)
    (fallback,) = select_findings(found.findings, "power-fallback")
    assert fallback.names["reason"] == "current-constant"


SCOUT = PowerSource("scout_msgs/msg/ScoutStatus", "battery_voltage", "actuator_states[].current", sign="auto")


def test_what_nobody_knows_of_a_scout_is_asked_and_three_lines_answer(tmp_path):
    rows = [{"battery_voltage": v, "actuator_states": [{"current": a / 4}] * 4} for v, a in zip(VOLT, AMP, strict=True)]
    path = log_of(tmp_path / "a", "scout_msgs/msg/ScoutStatus", rows)
    refused = power_of(path)
    assert refused.rails == {}
    assert refused.findings[0].names["reason"] == "no-battery-current"
    np.testing.assert_allclose(watt(power_of(path, recipe=Recipe(power_sources=[SCOUT]))), VOLT * AMP, rtol=1e-6)


def test_a_list_named_without_its_brackets_is_asked_for(tmp_path):
    rows = a300(1.0)
    path = log_of(tmp_path / "a", "clearpath_platform_msgs/msg/Power", rows)
    mine = PowerSource("clearpath_platform_msgs/msg/Power", "measured_voltages[0]", "measured_currents")
    (rejected,) = power_of(path, recipe=Recipe(power_sources=[mine])).findings
    assert (rejected.names["reason"], rejected.names["field"]) == ("field-is-a-list", "measured_currents")
