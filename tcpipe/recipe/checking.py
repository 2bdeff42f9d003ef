"""Values checked by the annotations of the frozen dataclass that holds them, and made plain: one truth for TOML and Python.

Known annotations: bool, int, float, str, Literal, ``X | None``, ``list[X]``, ``tuple[X, X]``, ``dict[K, V]``, another such dataclass, and
numbers with bounds (``Annotated[float, Ge(0), Le(1)]``). A whole number becomes a float where one is wanted, and a float that is whole
an int, as in JSON Schema; numpy's scalars and arrays become Python's; text is no number, and a truth value neither.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, asdict, fields, is_dataclass
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from annotated_types import Ge, Gt, Le, Lt

from tcpipe.errors import RecipeError

T = TypeVar("T")

_SHOWN_CHARACTERS = 80
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_DECIMAL_BITS = 4096
"""Longer whole numbers Python does not write in decimal."""


def settle(made: Any, section: str) -> None:
    """Check every field of a dataclass and keep it as a plain value; its ``__post_init__``.

    Parameters
    ----------
    made : a frozen dataclass.
    section : what its keys are called before the dot; "" where they have none.

    Raises
    ------
    RecipeError : one line for every wrong value.
    """
    problems: list[str] = []
    for name, kind in kinds_of(type(made)).items():
        object.__setattr__(made, name, _settled(kind, getattr(made, name), _below(section, name), problems))
    if problems:
        raise RecipeError(*(f"recipe: {problem}" for problem in problems))


def from_values(cls: type[T], values: Mapping[str, Any], *, where: str) -> T:
    """Return a checked dataclass of nested plain values, as TOML gives them.

    Raises
    ------
    RecipeError : one line for every wrong or unknown key, beginning with ``where``.
    """
    problems: list[str] = []
    made: T = _dataclass(cls, values, "", problems)
    if problems:
        raise RecipeError(*(f"{where}: {problem}" for problem in problems))
    return made


def kinds_of(cls: type) -> dict[str, Any]:
    """Return the annotation of every field of a dataclass."""
    hints = get_type_hints(cls, include_extras=True)
    return {of.name: hints[of.name] for of in fields(cls)}


def range_of(kind: Any) -> str:
    """Return the bounds of a number in words, "" where it has none."""
    low, high = "", ""
    for bound in _parts(kind)[1]:
        match bound:
            case Ge():
                low = f"from {_number(bound.ge)} "
            case Gt():
                low = f"above {_number(bound.gt)} "
            case Le():
                high = f"to {_number(bound.le)}"
            case Lt():
                high = f"to below {_number(bound.lt)}"
    return (low + high).strip()


def _number(bound: Any) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:.12g}"


def as_toml(value: Any) -> str:
    """Return a value as TOML writes it."""
    if isinstance(value, bool | str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list | tuple):
        return "[" + ", ".join(as_toml(item) for item in value) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(str(name))} = {as_toml(item)}" for name, item in value.items()) + "}"
    if is_dataclass(value) and not isinstance(value, type):
        return as_toml(asdict(value))
    if isinstance(value, int) and value.bit_length() > _DECIMAL_BITS:
        return hex(value)
    return repr(value)


def _key(name: str) -> str:
    return name if _BARE_KEY.fullmatch(name) else as_toml(name)


def _parts(kind: Any) -> tuple[Any, tuple[Any, ...], bool]:
    """Return an annotation without bounds and None, its bounds, and whether None is a value of it."""
    bounds: tuple[Any, ...] = ()
    optional = False
    while (origin := get_origin(kind)) in (Annotated, Union, UnionType):
        if origin is Annotated:
            kind, *more = get_args(kind)
            bounds += tuple(more)
        else:
            (kind,) = (of for of in get_args(kind) if of is not NoneType)
            optional = True
    return kind, bounds, optional


def _settled(kind: Any, value: Any, key: str, problems: list[str]) -> Any:
    """Return the plain value of an annotation; what is wrong becomes a problem."""
    kind, bounds, optional = _parts(kind)
    if value is None and optional:
        return None
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        value = value.tolist()
    if isinstance(kind, type) and is_dataclass(kind):
        if isinstance(value, kind) and hasattr(kind, "__post_init__"):  # it has settled itself
            return value
        plain = {name: getattr(value, name) for name in kinds_of(kind)} if isinstance(value, kind) else value
        return _dataclass(kind, plain, key, problems)
    origin = get_origin(kind)
    if origin is Literal:
        wanted = None if isinstance(value, str) and value in get_args(kind) else f"one of {', '.join(get_args(kind))}"
    elif origin in _CONTAINERS:
        return _CONTAINERS[origin](get_args(kind), value, key, problems)
    else:
        plain, wanted = _PLAIN[kind](value)
        if not (wanted := wanted or _outside(bounds, plain)):
            return plain
    if wanted:
        _refuse(key, value, wanted, problems)
    return value


def _dataclass(cls: Any, values: Any, key: str, problems: list[str]) -> Any:
    if not isinstance(values, Mapping):
        return _refuse(key, values, "a table of keys", problems)
    known, before = kinds_of(cls), len(problems)
    made = {
        name: _settled(known[name], value, _below(key, name), problems)
        for name, value in values.items()
        if _is_known(name, known, key, problems)
    }
    needed = (of.name for of in fields(cls) if of.default is MISSING and of.default_factory is MISSING)
    problems += [f"{_below(key, name)} is missing" for name in needed if name not in values]
    if len(problems) > before:
        return None
    whole = cls(**made)
    for name, wanted in whole.contradictions() if hasattr(cls, "contradictions") else ():
        _refuse(_below(key, name), getattr(whole, name), wanted, problems)
    return whole


def _table(kinds: tuple[Any, ...], value: Any, key: str, problems: list[str]) -> Any:
    if not isinstance(value, Mapping):
        return _refuse(key, value, "a table of keys", problems)
    return {
        name: _settled(kinds[1], item, _below(key, name), problems)
        for name, item in value.items()
        if kinds[0] is str or _is_known(name, get_args(kinds[0]), key, problems)
    }


def _list(kinds: tuple[Any, ...], value: Any, key: str, problems: list[str]) -> Any:
    if not isinstance(value, list | tuple):
        return _refuse(key, value, 'a list, for example ["/topic"]', problems)
    return [_settled(kinds[0], item, f"{key}.{place}", problems) for place, item in enumerate(value)]


def _tuple(kinds: tuple[Any, ...], value: Any, key: str, problems: list[str]) -> Any:
    if not isinstance(value, list | tuple):
        return _refuse(key, value, "a list of numbers, for example [0.0, 0.0, 0.0]", problems)
    if len(value) != len(kinds):
        return _refuse(key, value, f"{len(kinds)} values, got {len(value)}", problems)
    each = enumerate(zip(kinds, value, strict=True))
    return tuple(_settled(kind, item, f"{key}.{place}", problems) for place, (kind, item) in each)


def _bool(value: Any) -> tuple[Any, str | None]:
    return value, None if isinstance(value, bool) else "true or false"


def _int(value: Any) -> tuple[Any, str | None]:
    whole = isinstance(value, Integral) or (isinstance(value, float) and value.is_integer())
    return (int(value), None) if whole and not isinstance(value, bool) else (value, "a whole number")


def _float(value: Any) -> tuple[Any, str | None]:
    if isinstance(value, bool) or not isinstance(value, Real):
        return value, "a number"
    try:
        number = float(value) + 0.0  # -0.0 is 0.0: the same value is the same bytes
    except OverflowError:
        return value, "a finite number"
    return (number, None) if math.isfinite(number) else (value, "a finite number")


def _str(value: Any) -> tuple[Any, str | None]:
    return (str.__str__(value), None) if isinstance(value, str) else (value, "text in quotes")


_PLAIN: dict[Any, Callable[[Any], tuple[Any, str | None]]] = {bool: _bool, int: _int, float: _float, str: _str}
_CONTAINERS: dict[Any, Callable[..., Any]] = {dict: _table, list: _list, tuple: _tuple}


def _outside(bounds: tuple[Any, ...], value: Any) -> str | None:
    """Return the bounds in words where a number is outside them."""
    for bound in bounds:
        match bound:
            case Ge():
                inside = value >= bound.ge
            case Gt():
                inside = value > bound.gt
            case Le():
                inside = value <= bound.le
            case Lt():
                inside = value < bound.lt
        if not inside:
            return range_of(Annotated[(float, *bounds)])
    return None


def _is_known(name: Any, known: Any, key: str, problems: list[str]) -> bool:
    if name not in known:
        problems.append(f"unknown key {_below(key, name)}; known here: {', '.join(known)}")
    return name in known


def _refuse(key: str, value: Any, wanted: str, problems: list[str]) -> None:
    shown = repr(value) if value is None else as_toml(value)
    shown = shown if len(shown) <= _SHOWN_CHARACTERS else f"{shown[:_SHOWN_CHARACTERS]} …"
    problems.append(f"{key} is {shown}; wanted {wanted}")


def _below(above: str, name: Any) -> str:
    return f"{above}.{name}" if above else str(name)
