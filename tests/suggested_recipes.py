"""Recipes that follow the proposals of findings, as a person would."""

import tomllib
from collections.abc import Mapping
from typing import Any

from tcpipe.formats.recipe_toml import parse_recipe
from tcpipe.recipe import Recipe
from tcpipe.recipe.suggestions import RecipeFragment
from tcpipe.tables.findings import Finding


def proposed(finding: Finding, *, alternative: int = 0) -> dict[str, Any]:
    """The recipe values that a remedy of a finding proposes, by its lines of a recipe."""
    recipe = finding.remedies[alternative].recipe
    return tomllib.loads(RecipeFragment(recipe, is_checked=True).toml()) if recipe else {}


def merged(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Two recipes' values together; the other's go first."""
    both = {**one, **other}
    for key in one.keys() & other.keys():
        if isinstance(one[key], Mapping) and isinstance(other[key], Mapping):
            both[key] = merged(one[key], other[key])
    return both


def recipe_that_follows(finding: Finding, *, alternative: int = 0, before: Mapping[str, Any] | None = None) -> Recipe:
    """A recipe with what a finding proposes; RecipeError where it is refused."""
    return parse_recipe(merged(before or {}, proposed(finding, alternative=alternative)), where="followed")
