"""TOML files: recipes, read, checked (all errors together) and written with comments; the package's robot profiles."""

import os
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from tcpipe.errors import RecipeError
from tcpipe.formats.atomic import Location
from tcpipe.formats.json_files import Json, digest, to_plain
from tcpipe.recipe import IngestSections, Recipe, TableMapping
from tcpipe.recipe.checking import TO_MEASURE, as_toml, describe, format_values, from_values, read_annotations
from tcpipe.robots import GENERIC, PowerSource, Profiles, Robot

FILE_NAME = "tcpipe.toml"
_MOST_BYTES = 1_000_000
_OWN_TABLES = ("robots", "power_sources", "tables")


def find_recipe(explicit: Path | None, directory: Path) -> Path | None:
    """Return the recipe in use: the given one, ``TCPIPE_RECIPE``, the nearest tcpipe.toml upward, or the defaults."""
    if explicit is not None:
        return explicit
    if os.environ.get("TCPIPE_RECIPE"):
        return Path(os.environ["TCPIPE_RECIPE"])
    for folder in (directory.resolve(), *directory.resolve().parents):
        if (folder / FILE_NAME).is_file():
            return folder / FILE_NAME
    return None


def load_recipe(path: Path | None) -> Recipe:
    """Read and check a recipe; without a path return the defaults. `RecipeError` has one line for every wrong key."""
    if path is None:
        return Recipe()
    try:
        with path.open("rb") as stream:
            data = stream.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise RecipeError(f"{path}: is larger than {_MOST_BYTES / 1e6:g} MB, the most that tcpipe reads")
        return parse_recipe(parse_toml(data.decode("utf-8")), where=str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise RecipeError(f"{path}: the recipe cannot be read ({getattr(error, 'strerror', None) or error})") from None
    except RecursionError:
        raise RecipeError(f"{path}: not a recipe: its values are nested too deep") from None
    except ValueError as error:  # no TOML, or a number of thousands of digits
        raise RecipeError(f"{path}: not valid TOML: {error}") from None


def resolve_recipe(given: Recipe | Location | None) -> Recipe:
    """Return the given recipe, itself or by its path, else the one that `find_recipe` finds."""
    if isinstance(given, Recipe):
        return given
    return load_recipe(find_recipe(None if given is None else Path(given), Path.cwd()))


def parse_recipe(values: Mapping[str, Any], *, where: str) -> Recipe:
    """Check recipe values; `RecipeError` carries one line for every wrong key."""
    return from_values(Recipe, values, where=where)


def ingest_key(recipe: Recipe | Mapping[str, Json]) -> str:
    """Return the hash (hex) of the keys of a recipe, or of a manifest's part of it, that affect a run's files."""
    if not isinstance(recipe, Recipe):
        return _hash_values(recipe)
    known = _KEYS.get(id(recipe))
    if known is None:
        known = recipe, _hash_values(to_plain(recipe.ingest))
        _KEYS.clear()
        _KEYS[id(recipe)] = known
    return known[1]


# The last recipe and its key, since many logs ask for the same one; the recipe is kept so that its id stays unique.
_KEYS: dict[int, tuple[Recipe, str]] = {}


def _hash_values(values: Mapping[str, Json]) -> str:
    names = [section.name for section in fields(IngestSections)]
    return digest({name: values.get(name) for name in names if values.get(name) or name not in _OWN_TABLES})


def read_key(recipe: Recipe | IngestSections, robot: str | None, *, definitions: str) -> str:
    """Return the hash (hex) of all settings that determine the streams of a log: read section, robot, definitions."""
    own = {name: values for name in _OWN_TABLES if (values := getattr(recipe, name))}
    return digest({"read": recipe.read, "robot": robot, "definitions": definitions, **own})


def make_recipe_id(recipe: Recipe | Mapping[str, Json], robot: str) -> str:
    """Return the name of a run's recipe directory: first 8 hex of the hash of the ingest sections and the robot."""
    return digest({"ingest": ingest_key(recipe), "robot": robot})[:8]


def format_commented_toml() -> str:
    """Return every key with its default and meaning as TOML, commented out."""
    return "\n".join(_iterate_toml_lines(describe(Recipe)[1])) + "\n"


def _iterate_toml_lines(definitions: Mapping[str, Any]) -> Iterator[str]:
    yield "# The recipe of tcpipe. Every key with its default, commented out; remove the # to change one."
    yield "# Names end in the unit. Reasons: docs/explanation/rulings.md"
    default = Recipe()
    names = f"one of {', '.join(sorted(load_shipped_profiles().robots))}, or of [robots]"
    yield from _iterate_key_lines(definitions["Recipe"]["properties"]["robot"], "robot", default.robot, names)
    for section in fields(default):
        if is_dataclass(values := getattr(default, section.name)):
            yield from _iterate_table_lines(f"[{section.name}]", values, definitions)
    others = {"[robots.NAME]": Robot(), "[[power_sources]]": PowerSource(""), "[tables.ROLE]": TableMapping()}
    for head, values in others.items():  # behind two #, since its keys alone would be another table's
        yield from _iterate_table_lines(f"## {head}", values, definitions, mark="#")


def _iterate_table_lines(head: str, values: Any, definitions: Mapping[str, Any], *, mark: str = "") -> Iterator[str]:
    cls: type = type(values)
    definition = definitions[cls.__name__]
    yield from ("", *(f"# {line}" for line in definition["description"].splitlines() if line), head)
    for name, kind in read_annotations(cls).items():
        lines = _iterate_key_lines(definition["properties"][name], name, getattr(values, name), format_values(kind))
        yield from (f"{mark}{line}" for line in lines)


def _iterate_key_lines(schema: Mapping[str, Any], name: str, value: Any, choices: str) -> Iterator[str]:
    yield f"# {schema.get('description', '')}"
    note = choices and f"  # {choices}"
    yield f"# {name} ={note}" if value is None else f"# {name} = {as_toml(value)}{note}"


@cache
def load_shipped_profiles() -> Profiles:
    """Return the profiles in the package."""
    known = Profiles({GENERIC: Robot()})
    for file in sorted(files("tcpipe.robots").iterdir(), key=lambda file: file.name):
        if file.name.endswith(".toml"):
            known = known.before(from_values(Profiles, parse_toml(file.read_text(encoding="utf-8")), where=file.name))
    return known


def load_profiles(recipe: Recipe | IngestSections) -> Profiles:
    """Return the profiles of a recipe, and the package's profiles that it does not replace."""
    of_tables = [source for name, table in recipe.tables.items() if (source := table.make_power_source(name))]
    return Profiles(recipe.robots, [*recipe.power_sources, *of_tables]).before(load_shipped_profiles())


_MOST_DOTS = 1000  # on one line: the time of a key grows with the square of its parts


def parse_toml(text: str) -> dict[str, Any]:
    """Return the values of a TOML document; `ValueError` for other text, deep nesting, or a line with many dots."""
    for number, line in enumerate(text.splitlines(), 1):
        if (dots := line.count(".")) > _MOST_DOTS:
            raise ValueError(f"line {number} has {dots} dots, at most {_MOST_DOTS}")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("its values are nested too deep") from None
    except tomllib.TOMLDecodeError as error:
        hint = f"; measure it and write the value in place of {TO_MEASURE}" if f"[{TO_MEASURE}" in text else ""
        raise ValueError(f"{error}{hint}") from None
