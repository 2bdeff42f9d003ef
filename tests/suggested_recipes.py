"""What messages suggest for the recipe, read out of their text as a person would."""

import re
import tomllib
from collections.abc import Mapping
from typing import Any

from tcpipe.formats.recipe_toml import parse_recipe
from tcpipe.recipe import Recipe

_LINE = re.compile(r"under \[([\w.]+)\]: ")


def suggestions_in(message: str) -> list[dict[str, Any]]:
    """The recipe values that a message suggests, one for each alternative, by its printed lines."""
    found = []
    for alternative in message.split("write in the recipe ")[1:]:
        parts = _LINE.split(alternative)[1:]
        values: dict[str, Any] = {}
        for table, text in zip(parts[::2], parts[1::2], strict=True):
            values = merged(values, tomllib.loads(f"[{table}]\n{_longest_toml(text)}"))
        found.append(values)
    return found


def merged(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Two recipes' values together; the other's go first."""
    both = {**one, **other}
    for key in one.keys() & other.keys():
        if isinstance(one[key], Mapping) and isinstance(other[key], Mapping):
            both[key] = merged(one[key], other[key])
    return both


def recipe_that_follows(message: str, *, alternative: int = 0, before: Mapping[str, Any] | None = None) -> Recipe:
    """A recipe with what a message suggests; RecipeError where it is refused."""
    return parse_recipe(merged(before or {}, suggestions_in(message)[alternative]), where="followed")


def _longest_toml(text: str) -> str:
    """The longest beginning that is TOML and ends where a clause does."""
    ends = [len(text), *(at.start() for at in reversed(list(re.finditer(r" and $|; ", text))))]
    for end in ends:
        try:
            tomllib.loads(text[:end])
        except tomllib.TOMLDecodeError:
            continue
        return text[:end]
    raise AssertionError(f"no TOML: {text}")
