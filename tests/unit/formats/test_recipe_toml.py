"""The recipe: found, checked with all errors at once, written with comments."""

from pathlib import Path

import pytest

from tcpipe.errors import RecipeError
from tcpipe.formats.recipe_toml import (
    commented_toml,
    find_recipe,
    ingest_key,
    load_recipe,
    parse_recipe,
    read_key,
    recipe_id,
)
from tcpipe.recipe import Recipe


def test_commented_recipe_is_the_default_recipe(tmp_path: Path) -> None:
    path = tmp_path / "tcpipe.toml"
    path.write_text(commented_toml())
    assert load_recipe(path) == Recipe()


def test_uncommented_keys_parse_to_the_same_defaults(tmp_path: Path) -> None:
    lines = [
        line[2:] if line.startswith("# ") and " = " in line and not line.endswith("=") else line
        for line in commented_toml().splitlines()
    ]
    path = tmp_path / "tcpipe.toml"
    path.write_text("\n".join(line for line in lines if not line.startswith("#") and not line[:1].isupper()))
    assert load_recipe(path) == Recipe()


def test_every_wrong_key_is_one_problem() -> None:
    wrong = {"fuse": {"bogus": 1, "rate_hz": -1}, "read": {"placement": {"gnss": {"xyz": 1}}}, "zz": 2}
    with pytest.raises(RecipeError) as caught:
        parse_recipe(wrong, where="r.toml")
    assert len(caught.value.problems) == 4
    text = str(caught.value)
    assert "unknown key fuse.bogus; known here: estimator" in text
    assert "fuse.rate_hz is -1" in text
    assert "known here: xyz_m, rpy_rad" in text
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(("text", "said"), [("robot = ", "not valid TOML"), (None, "cannot be read")])
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


def test_dataset_keys_do_not_rename_runs_but_ingest_keys_do() -> None:
    default = Recipe()
    split = parse_recipe({"split": {"seed": 7}, "sample": {"patch_px": 20}}, where="r")
    fused = parse_recipe({"label": {"velocity": "fused"}}, where="r")
    assert ingest_key(default) == ingest_key(split) != ingest_key(fused)
    assert recipe_id(default, "husky") == recipe_id(split, "husky") != recipe_id(default, "warthog")
    assert read_key(default, None) == read_key(fused, None) != read_key(default, "husky")
