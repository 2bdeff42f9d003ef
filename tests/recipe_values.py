"""Other values for every key of the recipe, found by walking its annotations."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from tcpipe.recipe import Recipe
from tcpipe.recipe.checking import read_annotations
from tcpipe.robots import PowerSource
from tcpipe.tables.bounds import Bounds


def keys() -> list[str]:
    """Return every key of the recipe, by dots."""
    default, found = Recipe(), ["robot", "robots", "power_sources", "tables"]
    for section in fields(default):
        of = getattr(default, section.name)
        found += [f"{section.name}.{name}" for name in read_annotations(type(of))] if is_dataclass(of) else []
    return found


def other_values(key: str) -> list[Any]:
    """Return valid values of a key that are not its default: of a number both ends, of a choice all others."""
    section, _, name = key.rpartition(".")
    holder = getattr(Recipe(), section) if section else Recipe()
    return [value for value in _values(read_annotations(type(holder))[name]) if value != getattr(holder, name)]


def with_value(recipe: Recipe, key: str, value: Any) -> Recipe:
    """Return the recipe with one key set."""
    section, _, name = key.rpartition(".")
    changed = {name: value} if not section else {section: replace(getattr(recipe, section), **{name: value})}
    return replace(recipe, **changed)


def _values(kind: Any, bounds: tuple[Any, ...] = ()) -> Iterator[Any]:
    origin, of = get_origin(kind), get_args(kind)
    if origin is Annotated:
        yield from _values(of[0], of[1:])
    elif origin in (Union, UnionType):
        yield from _values(next(each for each in of if each is not NoneType))
    elif origin is Literal:
        yield from of
    elif origin is dict:
        yield from ({role: value} for role in get_args(of[0]) or ("scout",) for value in _values(of[1]))
    elif origin is list:
        yield from ([value] for value in (_values(of[0]) if of[0] is not str else ["/another"]))
    elif origin is tuple:
        yield from zip(*(list(_values(each)) for each in of), strict=True)
    elif is_dataclass(kind):
        made = PowerSource("a/msg/B", "v", "i") if kind is PowerSource else kind()
        others = (
            replace(made, **{name: value}) for name, each in read_annotations(kind).items() for value in _values(each)
        )
        yield from (
            other for other in others if not hasattr(other, "contradictions") or not any(other.contradictions())
        )
    elif kind is bool:
        yield from (False, True)
    elif kind is str:
        yield "another"
    else:
        yield from _ends(kind, bounds)


def _ends(kind: Any, bounds: tuple[Bounds, ...]) -> Iterator[Any]:
    for bound in bounds:
        ends = (bound.ge, bound.le, None if bound.lt is None else bound.lt - 1e-15)
        yield from (kind(end) for end in ends if end is not None)
