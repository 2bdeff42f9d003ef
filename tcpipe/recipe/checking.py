"""Check and conversion of a frozen dataclass's values by its annotations, with the same rules for TOML and Python.

msgspec checks each value and describes the annotations as JSON Schema. It stops at the first error; the walk over
tables and keys here finds all of them. A whole number may be written as a float and a float as a whole number, as in
JSON Schema; numpy's scalars and arrays become Python's; text is no number, nor is a truth value.
"""

import ast
import inspect
import json
import re
from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields, is_dataclass
from datetime import UTC, datetime, timedelta
from functools import cache
from itertools import pairwise
from math import isfinite
from textwrap import dedent
from typing import Any, TypeVar, cast, get_args, get_origin, get_type_hints

import msgspec

from tcpipe.errors import RecipeError

T = TypeVar("T")

_SHOWN_CHARACTERS = 80
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_DECIMAL_BITS = 4096
"""Longer whole numbers Python does not write in decimal."""
_TYPES = {
    "number": "a number", "integer": "a whole number", "boolean": "true or false",
    "string": "text in quotes", "object": "a table of keys",
}  # fmt: skip


def validate_fields(made: Any, section: str) -> None:
    """Check every field of a frozen dataclass and keep it as a plain value; `RecipeError` lists every wrong field.

    ``section`` is the name of its keys before the dot, "" if they have none.
    """
    problems: list[str] = []
    cls: type = type(made)
    for name, kind in read_annotations(cls).items():
        object.__setattr__(made, name, _check_value(kind, getattr(made, name), _join_key(section, name), problems))
    if problems:
        raise RecipeError(*(f"recipe: {problem}" for problem in problems))


def from_values(cls: type[T], values: Mapping[str, Any], *, where: str) -> T:
    """Return a checked dataclass of nested plain values, as TOML gives them.

    `RecipeError` has a line for every wrong or unknown key, which begins with ``where``.
    """
    problems: list[str] = []
    made: T = _check_value(cls, values, "", problems)
    if problems:
        raise RecipeError(*(f"{where}: {problem}" for problem in problems))
    return made


@cache
def read_annotations(cls: type) -> Mapping[str, Any]:
    """Return the annotation of every field of a dataclass."""
    hints = get_type_hints(cls, include_extras=True)
    return {entry.name: hints[entry.name] for entry in fields(cls)}


def describe(*kinds: Any, file: str = "") -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]]]:
    """Return the JSON Schema of each annotation, and its definitions; docstrings describe dataclasses and keys.

    ``file`` contains the definitions; "" is the file of the schema itself.
    """
    template, text = f"{file}#/$defs/{{name}}", {"type": "string"}
    schemas, definitions = msgspec.json.schema_components(kinds, schema_hook=lambda _: text, ref_template=template)
    for definition in definitions.values():
        if "description" in definition:  # a docstring, whose indentation Python 3.13 takes away when it compiles it
            definition["description"] = inspect.cleandoc(definition["description"])
    for cls in _find_dataclasses(kinds, set()):
        properties = definitions.get(cls.__name__, {}).get("properties", {})
        for name, docstring in _read_key_docstrings(cls).items():
            properties.get(name, {})["description"] = docstring
    return [*schemas], definitions


def format_values(kind: Any) -> str:
    """Return the choices or the bounds of an annotation, "" if it has none."""
    ((schema,), _) = describe(kind)
    schema = schema.get("anyOf", [schema])[0]
    return _format_schema(schema) if "enum" in schema else _format_range(schema)


def _find_dataclasses(kind: Any, found: set[type]) -> set[type]:
    """Return those that were found, and the dataclasses that an annotation, or each of several, is made of."""
    parts = kind if isinstance(kind, tuple) else get_args(kind)
    if isinstance(kind, type) and is_dataclass(kind) and kind not in found:
        found.add(kind)
        parts = tuple(read_annotations(kind).values())
    for part in parts:
        _find_dataclasses(part, found)
    return found


@cache
def _read_key_docstrings(cls: type) -> Mapping[str, str]:
    """Return the docstring of each field of a dataclass."""
    body = cast("ast.ClassDef", ast.parse(dedent(inspect.getsource(cls))).body[0]).body
    found = {}
    for statement, text in pairwise(body):
        match statement, text:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str() as docstring)):
                found[name] = docstring
    return found


def _format_range(schema: Mapping[str, Any]) -> str:
    """Return the bounds of a number by its JSON Schema, "" if it has none."""
    words = {"minimum": "from", "exclusiveMinimum": "above", "maximum": "to", "exclusiveMaximum": "to below"}
    bounds = ((word, schema[key]) for key, word in words.items() if key in schema)
    return " ".join(f"{word} {bound if isinstance(bound, int) else f'{bound:.12g}'}" for word, bound in bounds)


def _format_schema(schema: Mapping[str, Any]) -> str:
    """Return the expectation of a JSON Schema as text."""
    match schema:
        case {"anyOf": [first, *_]}:
            return _format_schema(first)
        case {"enum": choices}:
            return f"one of {', '.join(choices)}"
        case {"prefixItems": [item, *_] as items}:
            return f"{len(items)} values in a list, each {_format_schema(item)}"
        case {"type": "array"}:
            return f"a list, each item {_format_schema(schema.get('items', {}))}"
    return f"{_TYPES.get(schema.get('type', ''), 'another value')} {_format_range(schema)}".strip()


TO_MEASURE = "?"
"""Number in a suggested recipe that the user must measure. It is not TOML, so that it is not used unread."""


def as_toml(value: Any) -> str:
    """Return a value in TOML; `TO_MEASURE` unchanged."""
    if isinstance(value, bool | str):
        text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        return TO_MEASURE if value == TO_MEASURE else text
    if isinstance(value, list | tuple):
        return "[" + ", ".join(as_toml(item) for item in value) + "]"
    if isinstance(value, Mapping):
        keys = ((str(name) if _BARE_KEY.fullmatch(str(name)) else as_toml(str(name)), value[name]) for name in value)
        return "{" + ", ".join(f"{key} = {as_toml(item)}" for key, item in keys) + "}"
    if is_dataclass(value) and not isinstance(value, type):
        return as_toml({name: item for name, item in asdict(value).items() if item is not None})
    if isinstance(value, int) and value.bit_length() > _DECIMAL_BITS:
        return hex(value)
    return repr(value)


def parse_utc_ns(text: str) -> int:
    """Return a time in ISO 8601 as [ns since 1970], UTC where it names no zone; `ValueError` for other text."""
    moment = datetime.fromisoformat(text)
    since = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)) - datetime(1970, 1, 1, tzinfo=UTC)
    return 1000 * (since // timedelta(microseconds=1))


def _check_value(kind: Any, value: Any, key: str, problems: list[str]) -> Any:
    """Return the plain value of an annotation; errors become problems."""
    origin, arguments = get_origin(kind), get_args(kind)
    if is_dataclass(kind):
        return _find_dataclass(kind, value, key, problems)
    if origin is dict and isinstance(value, Mapping):
        known = None if arguments[0] is str else get_args(arguments[0])
        items = ((name, item) for name, item in value.items() if _is_known(name, known, key, problems))
        return {name: _check_value(arguments[1], item, _join_key(key, name), problems) for name, item in items}
    if origin is list and isinstance(value, list | tuple):
        return [_check_value(arguments[0], item, f"{key}.{place}", problems) for place, item in enumerate(value)]
    try:
        return msgspec.convert(_to_plain(value), kind)
    except (msgspec.ValidationError, ValueError):  # a number of thousands of digits is the latter
        return _reject(key, value, _format_schema(describe(kind)[0][0]), problems)


def _to_plain(value: Any) -> Any:
    """Return a value for msgspec: whole numbers as int (-0.0 is 0); no type accepts NaN, infinity and sets."""
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        value = value.tolist()
    match value:
        case float() if isfinite(value):
            return int(value) if value.is_integer() else value
        case str():
            return str.__str__(value)
        case datetime():  # a time as TOML has it
            return value.isoformat()
        case list() | tuple():
            return [_to_plain(item) for item in value]
        case float() | set() | frozenset():
            return object()
    return value


def _find_dataclass(cls: Any, values: Any, key: str, problems: list[str]) -> Any:
    if isinstance(values, cls):
        if hasattr(cls, "__post_init__"):  # it has checked itself
            return values
        values = {entry.name: getattr(values, entry.name) for entry in fields(cls)}
    if not isinstance(values, Mapping):
        return _reject(key, values, "a table of keys", problems)
    kinds, before = read_annotations(cls), len(problems)
    items = ((name, value) for name, value in values.items() if _is_known(name, kinds, key, problems))
    made = {name: _check_value(kinds[name], value, _join_key(key, name), problems) for name, value in items}
    needed = (entry.name for entry in fields(cls) if entry.default is MISSING and entry.default_factory is MISSING)
    problems += [f"{_join_key(key, name)} is missing" for name in needed if name not in values]
    if len(problems) > before:
        return None
    whole = cls(**made)
    for name, expected in whole.contradictions() if hasattr(cls, "contradictions") else ():
        _reject(_join_key(key, name), getattr(whole, name), expected, problems)
    return whole


def _is_known(name: Any, known: Any, key: str, problems: list[str]) -> bool:
    if known is not None and name not in known:
        problems.append(f"unknown key {_join_key(key, name)}; known here: {', '.join(known)}")
    return known is None or name in known


def _reject(key: str, value: Any, expected: str, problems: list[str]) -> None:
    shown = repr(value) if value is None else as_toml(value)
    shown = shown if len(shown) <= _SHOWN_CHARACTERS else f"{shown[:_SHOWN_CHARACTERS]} …"
    problems.append(f"{key} is {shown}; expected {expected}")


def _join_key(above: str, name: Any) -> str:
    return f"{above}.{name}" if above else str(name)
