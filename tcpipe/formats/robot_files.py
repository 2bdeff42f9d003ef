"""The robots and power sources that come with the package: TOML beside `tcpipe.robots`, checked like a recipe."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from tcpipe.formats.toml_text import parse_toml
from tcpipe.recipe import IngestSections, Recipe
from tcpipe.recipe.checking import from_values
from tcpipe.robots.profiles import GENERIC, Profiles, Robot


@cache
def load_shipped_profiles() -> Profiles:
    """Return what the package knows."""
    known = Profiles({GENERIC: Robot()})
    for file in sorted(files("tcpipe.robots").iterdir(), key=lambda file: file.name):
        if file.name.endswith(".toml"):
            known = known.before(from_values(Profiles, parse_toml(file.read_text(encoding="utf-8")), where=file.name))
    return known


def load_profiles(recipe: Recipe | IngestSections) -> Profiles:
    """Return what a recipe knows, and beyond that the package."""
    return Profiles(recipe.robots, recipe.power_sources).before(load_shipped_profiles())
