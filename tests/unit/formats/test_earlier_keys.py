"""Keys of recipes that tcpipe 0.8 named otherwise."""

from pathlib import Path

import pytest

from tcpipe.errors import RecipeError
from tcpipe.formats.recipe_toml import load_recipe, parse_recipe
from tcpipe.tables.options import rename_keys

EARLIER = """
[gate]
standing_velocity_mps = 0.1
[read]
time = {imu = "log"}
placement = {imu = {xyz_m = [1.0, 0.0, 0.0]}}
pose_from = ["imu"]
[robots.scout]
called = ["scout"]
[[power_sources]]
type = "a/msg/B"
voltage = "v"
includes = "the arm"
unknown = "its sign"
"""


def test_keys_of_0_8_are_read_with_one_note(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "tcpipe.toml"
    path.write_text(EARLIER)
    recipe = load_recipe(path)
    assert recipe.mask.stationary_velocity_mps == 0.1
    assert (recipe.read.time_source, recipe.read.pose_sources) == ({"imu": "log"}, ["imu"])
    assert recipe.read.extrinsics["imu"].xyz_m == (1.0, 0.0, 0.0)
    assert recipe.robots["scout"].topic_words == ["scout"]
    assert (recipe.power_sources[0].other_loads, recipe.power_sources[0].open_questions) == ("the arm", "its sign")
    (note,) = caplog.messages
    assert "gate is mask" in note
    assert "read.time is time_source" in note


def test_a_key_by_both_names_is_an_error() -> None:
    with pytest.raises(RecipeError, match="unknown key gate; known here"):
        parse_recipe({"gate": {}, "mask": {}}, where="r")


def test_terms_of_physics_and_reasons_of_the_distance_breakdown_have_their_own_names() -> None:
    terms = {"terms": [{"term": "standing", "value": 14.0}], "energy_share": {"standing": 0.1}, "usual_turn_radpm": 0.2}
    found = rename_keys({"ledger_m": {"standing": 1.0}, "physics": {"husky": terms}})
    assert found["distance_by_reason_m"] == {"stationary": 1.0}
    assert found["physics"]["husky"] == {
        "terms": [{"term": "idle", "value": 14.0}], "energy_share": {"idle": 0.1}, "mean_turn_radpm": 0.2,
    }  # fmt: skip
