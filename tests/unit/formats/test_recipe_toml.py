"""The recipe: found, checked with all errors at once, written with comments."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tcpipe.errors import RecipeError
from tcpipe.formats.recipe_toml import (
    find_recipe,
    format_commented_toml,
    ingest_key,
    load_recipe,
    parse_recipe,
)
from tcpipe.recipe import Extrinsics, FuseConfig, ReadConfig, Recipe, SegmentConfig, SplitConfig


def test_uncommented_keys_parse_to_the_same_defaults(tmp_path: Path) -> None:
    lines = [
        line[2:] if line.startswith("# ") and " = " in line and not re.search(r"=( +#|$)", line) else line
        for line in format_commented_toml().splitlines()
    ]
    path = tmp_path / "tcpipe.toml"
    path.write_text("\n".join(line for line in lines if not line.startswith("#") and not line[:1].isupper()))
    assert load_recipe(path) == Recipe()


def test_every_wrong_key_is_one_problem() -> None:
    wrong = {"fuse": {"bogus": 1, "rate_hz": -1}, "read": {"extrinsics": {"gnss": {"xyz": 1}}}, "zz": 2}
    with pytest.raises(RecipeError) as caught:
        parse_recipe(wrong, where="r.toml")
    assert len(caught.value.problems) == 4
    text = str(caught.value)
    assert "unknown key fuse.bogus; known here: estimator" in text
    assert "fuse.rate_hz is -1" in text
    assert "known here: xyz_m, rpy_rad" in text
    assert caught.value.exit_code == 2


WRONG = {
    "robot = 3": "robot is 3; expected text in quotes",
    'read.topics.gnsss = ["/a"]': "unknown key read.topics.gnsss; known here: gnss, gnss_velocity, imu, wheel_odometry, visual_odometry",
    'read.topics.imu = "/a"': 'read.topics.imu is "/a"; expected a list',
    "read.topics.imu = [1]": "read.topics.imu.0 is 1; expected text in quotes",
    "read.extrinsics.imu.xyz_m = [1, 2]": "read.extrinsics.imu.xyz_m is [1, 2]; expected 3 values",
    'read.extrinsics.imu.xyz_m = [1, 2, "up"]': 'read.extrinsics.imu.xyz_m is [1, 2, "up"]; expected 3 values in a list, each a number',
    "read.extrinsics.imu = 3": "read.extrinsics.imu is 3; expected a table of keys",
    "read.extrinsics.imu.xyz_m = 3": "read.extrinsics.imu.xyz_m is 3; expected 3 values in a list, each a number from -1000 to 1000",
    'read.imu_units = "kg"': 'read.imu_units is "kg"; expected one of deg, deg_g, g, si',
    "fuse.rate_hz = -1": "fuse.rate_hz is -1; expected a number from 1 to 500",
    "fuse.rate_hz = true": "fuse.rate_hz is true; expected a number",
    'fuse.rate_hz = "20"': 'fuse.rate_hz is "20"; expected a number',
    "split.test_fraction = 1.0": "split.test_fraction is 1.0; expected a number from 0 to below 1",
    "split.seed = -1": "split.seed is -1; expected a whole number from 0 to 4294967295",
    "fuse.rate_hz = nan": "fuse.rate_hz is nan; expected a number from 1 to 500",
    'mask.keep_reversing = "maybe"': "expected true or false",
    "split.folds = 2.5": "split.folds is 2.5; expected a whole number",
    "covariates.max_age_s = 0": "covariates.max_age_s is 0; expected a number from 0.001",
}


@pytest.mark.parametrize("line", WRONG)
def test_what_is_wanted_is_said_plainly(tmp_path: Path, line: str) -> None:
    path = tmp_path / "r.toml"
    path.write_text(line)
    with pytest.raises(RecipeError) as caught:
        load_recipe(path)
    (problem,) = caught.value.problems
    assert WRONG[line] in problem
    assert "another value" not in problem


@pytest.mark.parametrize("line", [line for line in WRONG if "." in line.partition("=")[0]])
def test_a_recipe_made_in_python_is_refused_in_the_same_words(line: str) -> None:
    ((section, keys),) = tomllib.loads(line).items()
    with pytest.raises(RecipeError) as caught:
        type(getattr(Recipe(), section))(**keys)
    (problem,) = caught.value.problems
    assert WRONG[line] in problem


def test_all_wrong_values_of_a_section_are_said_at_once_also_by_replace() -> None:
    with pytest.raises(RecipeError) as caught:
        replace(FuseConfig(), estimator="UKF", wheel_std_mps=-1, rate_hz=10**5000)  # type: ignore[arg-type]
    assert len(caught.value.problems) == 3
    assert all(problem.startswith("recipe: fuse.") and len(problem) < 200 for problem in caught.value.problems)


def test_one_value_is_one_recipe_however_it_is_written() -> None:
    plain = Recipe(segment=SegmentConfig(chord_m=2.0), read=ReadConfig(extrinsics={"imu": Extrinsics((0.0, 0.0, 1.0))}))
    same = (
        Recipe(segment=SegmentConfig(chord_m=2), read=ReadConfig(extrinsics={"imu": {"xyz_m": [0, -0.0, 1]}})),  # type: ignore[dict-item]
        Recipe(
            segment=SegmentConfig(chord_m=np.float32(2)),  # type: ignore[arg-type]
            read=ReadConfig(extrinsics={"imu": Extrinsics(np.array([0, 0, 1]))}),  # type: ignore[arg-type]
        ),
        parse_recipe({"segment": {"chord_m": 2}, "read": {"extrinsics": {"imu": {"xyz_m": [0, 0, 1]}}}}, where="r"),
    )
    for other in same:
        assert other == plain
        assert ingest_key(other) == ingest_key(plain)
    assert SplitConfig(folds=np.int64(3)).folds == SplitConfig(folds=3.0).folds == 3  # type: ignore[arg-type]
    assert type(SplitConfig(folds=np.int64(3)).folds) is int  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [{1.0, 2.0, 3.0}, (0.0, float("nan"), 0.0), (0.0, 0.0, float("inf")), b"abc", "abc"])
def test_no_value_of_another_kind_is_a_position(value: object) -> None:
    with pytest.raises(RecipeError, match=r"extrinsics.xyz_m is .*; expected 3 values in a list, each a number"):
        Extrinsics(value)  # type: ignore[arg-type]


def test_a_recipe_does_not_change_with_the_lists_it_was_made_of() -> None:
    topics = {"imu": ["/imu"]}
    config = ReadConfig(topics=topics)  # type: ignore[arg-type]
    topics["imu"].append("/other")
    assert config.topics == {"imu": ["/imu"]}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("robot = ", "not valid TOML"),
        (None, "cannot be read"),
        ("robot = " + "[" * 100_000, "nested too deep"),
        ("read.topics.imu = " + "[" * 200 + "]" * 200, "expected text in quotes|nested too deep"),
        ("split.seed = " + "9" * 5000, "not valid TOML"),
        ("# " + "x" * 1_000_001, "larger than 1 MB"),
        ("[" + ".".join("a" * 450_000) + "]\n", "line 1 has 449999 dots, at most 1000"),
    ],
    ids=lambda of: str(of)[:20],
)
def test_unreadable_recipe_is_one_plain_line(tmp_path: Path, text: str | None, said: str) -> None:
    path = tmp_path / "r.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(RecipeError, match=said):
        load_recipe(path)


def test_the_nearest_recipe_upward_rules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TCPIPE_RECIPE", raising=False)
    deep = tmp_path / "a" / "b"
    deep.mkdir(parents=True)
    (tmp_path / "tcpipe.toml").touch()
    assert find_recipe(None, deep) == tmp_path / "tcpipe.toml"
    (deep / "tcpipe.toml").touch()
    assert find_recipe(None, deep) == deep / "tcpipe.toml"
    monkeypatch.setenv("TCPIPE_RECIPE", "other.toml")
    assert find_recipe(None, deep) == Path("other.toml")
    assert find_recipe(Path("mine.toml"), deep) == Path("mine.toml")


def test_the_commented_recipe_is_toml_whatever_its_docstrings_say() -> None:
    text = format_commented_toml()
    assert parse_recipe(tomllib.loads(text), where="init") == Recipe()
    assert all(line.startswith(("#", "[")) for line in text.splitlines() if line)
