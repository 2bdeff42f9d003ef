"""The recipe as TOML: found, read and checked (all errors at once), written with comments, described as JSON Schema."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from tcpipe.errors import RecipeError
from tcpipe.formats.json_files import digest
from tcpipe.recipe import Recipe

FILE_NAME = "tcpipe.toml"
_INGEST_SECTIONS = ("read", "fuse", "gate", "segment", "label")
_ADAPTER = TypeAdapter(Recipe)


def find_recipe(explicit: Path | None, directory: Path) -> Path | None:
    """Return the recipe that rules: the one given, ``TCPIPE_RECIPE``, the nearest tcpipe.toml upward, or none (defaults)."""
    if explicit is not None:
        return explicit
    if os.environ.get("TCPIPE_RECIPE"):
        return Path(os.environ["TCPIPE_RECIPE"])
    for folder in (directory.resolve(), *directory.resolve().parents):
        if (folder / FILE_NAME).is_file():
            return folder / FILE_NAME
    return None


def load_recipe(path: Path | None) -> Recipe:
    """Read and check a recipe; without a path return the defaults. `RecipeError` carries one line for every wrong key."""
    if path is None:
        return Recipe()
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise RecipeError(f"{path}: the recipe cannot be read ({getattr(error, 'strerror', None) or error})") from None
    except tomllib.TOMLDecodeError as error:
        raise RecipeError(f"{path}: not valid TOML: {error}") from None
    return parse_recipe(values, where=str(path))


def parse_recipe(values: Mapping[str, Any], *, where: str) -> Recipe:
    """Check recipe values; `RecipeError` carries one line for every wrong key."""
    try:
        return _ADAPTER.validate_python(values)
    except ValidationError as error:
        raise RecipeError(*(_problem(where, item) for item in error.errors(include_url=False))) from None


def _problem(where: str, item: Mapping[str, Any]) -> str:
    *above, last = item["loc"]
    if last == "[key]":
        key = ".".join(map(str, above))
        return f"{where}: unknown key {key}; known here: {_choices(item)}"
    key = ".".join(map(str, item["loc"]))
    if item["type"] == "unexpected_keyword_argument":
        known = ", ".join(_keys_beside(item["loc"]))
        return f"{where}: unknown key {key}; known here: {known}"
    if item["type"] == "missing":
        return f"{where}: {'.'.join(map(str, above))} is {_plain_value(item['input'])}; wanted more values, the one at {last} is missing"
    return f"{where}: {key} is {_plain_value(item['input'])}; wanted {_wanted(item)}"


def _plain_value(value: Any) -> str:
    """Return a value as TOML writes it, where it can."""
    return repr(value) if value is None else _toml(value)


_WANTED = {
    "string_type": "text in quotes",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "list_type": 'a list, for example ["/topic"]',
    "tuple_type": "a list of numbers, for example [0.0, 0.0, 0.0]",
    "dict_type": "a table of keys",
    "dataclass_type": "a table of keys",
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "{ge:g} or more",
    "less_than": "less than {lt:g}",
    "less_than_equal": "{le:g} or less",
    "too_short": "{min_length} values or more, got {actual_length}",
    "too_long": "{max_length} values, got {actual_length}",
}
"""What the checker's findings want, by their type, in our words."""


def _wanted(item: Mapping[str, Any]) -> str:
    if item["type"] == "literal_error":
        return f"one of {_choices(item)}"
    words = _WANTED.get(item["type"], "another value (docs/reference/recipe.md)")
    return words.format(**item.get("ctx", {}))


def _choices(item: Mapping[str, Any]) -> str:
    return str(item["ctx"]["expected"]).replace("'", "").replace(" or ", ", ")


def _keys_beside(location: tuple[Any, ...]) -> list[str]:
    schema = recipe_schema()
    here: Mapping[str, Any] = schema
    for part in location[:-1]:
        here = here.get("properties", {}).get(str(part)) or here.get("additionalProperties", {})
        if "$ref" in here:
            here = schema["$defs"][here["$ref"].rsplit("/", 1)[-1]]
    return list(here.get("properties", ()))


def ingest_key(recipe: Recipe) -> str:
    """Return the hash (hex) of the recipe's sections that rule a run's files; the dataset's own sections are left out."""
    values = asdict(recipe)
    return digest({name: values[name] for name in _INGEST_SECTIONS})


def read_key(recipe: Recipe, robot: str | None) -> str:
    """Return the hash (hex) of what rules the streams: the read section and the robot asked for."""
    return digest({"read": asdict(recipe)["read"], "robot": robot})


def recipe_id(recipe: Recipe, robot: str) -> str:
    """Return the name of a run's recipe directory: first 8 hex of the hash of the ingest sections and the robot."""
    return digest({"ingest": ingest_key(recipe), "robot": robot})[:8]


def recipe_schema() -> dict[str, Any]:
    """Return the recipe's JSON Schema."""
    return _ADAPTER.json_schema()


def commented_toml(recipe: Recipe | None = None) -> str:
    """Return every key with its default and meaning as TOML; keys at their default are commented out."""
    schema = recipe_schema()
    return "\n".join(_toml_lines(recipe or Recipe(), schema)) + "\n"


def _toml_lines(recipe: Recipe, schema: Mapping[str, Any]) -> Iterator[str]:
    yield "# The recipe of tcpipe. Every key is here with its default, commented out; remove the # to change one."
    yield "# Units stand in the names. Reasons: docs/explanation/rulings.md"
    default = Recipe()
    yield from _key_lines(schema["properties"]["robot"], "robot", recipe.robot, default.robot)
    for section in fields(recipe):
        here = getattr(recipe, section.name)
        if not is_dataclass(here):
            continue
        definition = schema["$defs"][type(here).__name__]
        yield ""
        yield f"# {definition['description']}"
        yield f"[{section.name}]"
        for key in fields(here):
            value, usual = getattr(here, key.name), getattr(getattr(default, section.name), key.name)
            yield from _key_lines(definition["properties"][key.name], key.name, value, usual)


def _key_lines(schema: Mapping[str, Any], name: str, value: Any, usual: Any) -> Iterator[str]:
    yield f"# {schema.get('description', '')}"
    choices = schema.get("enum") or next((c["enum"] for c in schema.get("anyOf", ()) if "enum" in c), None)
    note = f"  # one of {', '.join(map(str, choices))}" if choices else ""
    if value is None:
        yield f"# {name} ="
    else:
        yield f"{'# ' if value == usual else ''}{name} = {_toml(value)}{note}"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_toml(str(key))} = {_toml(item)}" for key, item in value.items()) + "}"
    if is_dataclass(value) and not isinstance(value, type):
        return _toml(asdict(value))
    return repr(value)
