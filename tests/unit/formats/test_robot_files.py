"""The robots and power sources that come with the package, and those of a recipe before them."""

from importlib.resources import files

import pytest

from tcpipe.errors import RecipeError
from tcpipe.formats.recipe_toml import format_commented_toml, load_profiles, load_shipped_profiles, parse_recipe
from tcpipe.recipe import Recipe
from tcpipe.robots import GENERIC, FieldPath, PowerSource, Robot, parse_fields


def test_a_robot_has_a_file_of_its_name_and_stands_in_the_recipe_that_init_writes():
    stems = {file.name.removesuffix(".toml") for file in files("tcpipe.robots").iterdir() if file.name.endswith("toml")}
    robots = load_shipped_profiles().robots
    assert set(robots) == stems - {"power_sources"} | {GENERIC}
    assert f"one of {', '.join(sorted(robots))}" in format_commented_toml()


def test_what_is_shipped_can_be_told_apart_and_is_of_a_robots_size():
    robots = load_shipped_profiles().robots.values()
    for key in ("platform", "status_types", "topic_words"):
        said = [value for of in robots for value in ([getattr(of, key)] if key == "platform" else getattr(of, key))]
        assert len(said) == len(set(said)), key
    for of in robots:
        assert of.width_m is None or 0.3 < of.width_m < of.length_m < 2.0
        assert of.max_velocity_mps is None or 0.5 <= of.max_velocity_mps <= 5.0
    platforms = {of.platform for of in load_shipped_profiles().power_sources}
    assert platforms <= {of.platform for of in robots}


def test_a_recipes_own_come_before_the_packages():
    source = PowerSource("sensor_msgs/msg/BatteryState", "v", "i")
    known = load_profiles(
        Recipe(robots={"husky": Robot(max_velocity_mps=0.5), "scout": Robot()}, power_sources=[source])
    )
    assert known.robots["husky"] == Robot(max_velocity_mps=0.5)
    assert {"scout", "warthog", GENERIC} <= set(known.robots)
    assert known.types()[0] == source.type
    assert [of for of in known.power_sources if of.type == source.type] == [source]
    assert len(known.types()) == len(load_shipped_profiles().types())


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("", []),
        ("current", [FieldPath("current")]),
        ("a.b[0]+a.b[12] - c", [FieldPath("a.b", 0), FieldPath("a.b", 12), FieldPath("c", sign=-1)]),
        ("drivers[].state.amp", [FieldPath("drivers[].state.amp", every=True)]),
        ("drivers[1].amp + amps[]", [FieldPath("drivers[].amp", 1), FieldPath("amps", every=True)]),
    ],
)
def test_fields_are_joined_by_plus_and_minus(text, wanted):
    assert parse_fields(text) == wanted


def test_everything_that_is_wrong_with_a_robot_is_said_at_once_by_its_key():
    with pytest.raises(RecipeError) as caught:
        parse_recipe(
            {
                "robots": {
                    "mine": {"width_m": -1, "speed_mps": 3.0},
                    "yours": {"voltage_range_volt": [30, 20]},
                    "theirs": 4,
                },
                "power_sources": [
                    {"voltage": "v"},
                    {"type": "Foo", "current": "i["},
                    {"type": "a/msg/B"},
                    {"type": "a/msg/B", "voltage": "v", "sign": "plus"},
                    {"type": "a/msg/B", "energy": "e", "current": "i"},
                    {"type": "a/msg/B", "voltage": "v", "unsupported_reason": "tells phases"},
                    {"type": "sensor_msgs/msg/JointState", "joints": "((left"},
                ],
            },
            where="tcpipe.toml",
        )
    said = [line.removeprefix("tcpipe.toml: ") for line in caught.value.problems]
    keys = [
        "robots.mine.width_m is -1; expected a number from 0.05",
        "unknown key robots.mine.speed_mps",
        "robots.yours.voltage_range_volt is [30.0, 20.0]; expected the lower",
        "robots.theirs is 4; expected a table of keys",
        "power_sources.0.type is missing",
        'power_sources.1.type is "Foo"; expected package/msg/Name',
        'power_sources.1.current is "i["; expected fields joined by +',
        "power_sources.2.current",
        'power_sources.3.sign is "plus"; expected one of auto',
        'power_sources.4.current is "i"; expected one of current, power, energy and joints',
        'power_sources.5.unsupported_reason is "tells phases"; expected no field besides it',
        'power_sources.6.joints is "((left"; expected a regular expression',
    ]
    assert len(said) == len(keys)
    assert all(line.startswith(key) for line, key in zip(said, keys, strict=True)), said


def test_a_robot_made_in_python_is_checked_where_a_recipe_takes_it():
    with pytest.raises(RecipeError, match=r"robots\.mine\.width_m"):
        Recipe(robots={"mine": Robot(width_m=-1.0)})
    assert Recipe(robots={"mine": Robot(width_m=1)}).robots["mine"].width_m == 1.0
