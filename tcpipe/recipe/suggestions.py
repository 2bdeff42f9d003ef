"""Recipe parts that messages suggest; made only here, by the recipe's own rules, so that the recipe accepts them."""

import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import isfinite
from typing import TypeAlias

from tcpipe.errors import RecipeError
from tcpipe.recipe import Recipe
from tcpipe.recipe.checking import TO_MEASURE, as_toml, from_values, read_annotations
from tcpipe.tables.findings import Remedy

TomlValue: TypeAlias = "bool | float | str | Sequence[TomlValue] | Mapping[str, TomlValue]"
Keys: TypeAlias = Mapping[str, TomlValue]


@dataclass(frozen=True, slots=True)
class RecipeFragment:
    """Part of a recipe: keys by dotted name of their table, as ``read.time_offset_s``; arrays of tables as lists.

    ``is_checked``: this recipe, or that of the version that wrote it, has accepted it. `RecipeError`: the recipe
    rejects it.
    """

    tables: Mapping[str, Keys | Sequence[Keys]]
    is_checked: bool = False

    def __post_init__(self) -> None:
        """Check that the fragment alone is a valid recipe."""
        if not self.is_checked:
            try:
                from_values(Recipe, tomllib.loads(self.toml().replace(TO_MEASURE, "0.0")), where="suggested recipe")
            except tomllib.TOMLDecodeError as error:
                raise RecipeError(f"suggested recipe: {error}") from None

    def inline(self) -> str:
        """Return it inside a sentence, as ``[read] imu_units = "deg"``."""
        return " and ".join(f"{head} {', '.join(lines)}" for head, lines in self._format_tables())

    def toml(self) -> str:
        """Return it as lines of a recipe."""
        return "\n".join(line for head, lines in self._format_tables() for line in (head, *lines))

    def _format_tables(self) -> Iterator[tuple[str, list[str]]]:
        for name, tables in self.tables.items():
            is_one = isinstance(tables, Mapping)
            for keys in [tables] if isinstance(tables, Mapping) else tables:
                lines = [f"{key} = {as_toml(value)}" for key, value in keys.items()]
                yield f"[{name}]" if is_one else f"[[{name}]]", lines


def make_place_to_measure(role: str) -> Keys:
    """Return the extrinsics of a sensor as keys with values for the user to measure; an antenna has no rotation."""
    return dict.fromkeys(("xyz_m",) if role == "gnss" else ("xyz_m", "rpy_rad"), (TO_MEASURE,) * 3)


def format_first(values: Iterable[float]) -> str:
    """Return the first number that is not zero, as a sample."""
    return f"{next((value for value in map(float, values) if value and isfinite(value)), 0.0):.7g}"


def suggest(name: str, tables: Mapping[str, Keys | Sequence[Keys]]) -> tuple[Remedy, ...]:
    """Return a remedy that changes keys of the recipe; none if the recipe would reject them.

    ``name``: key in ``remedies`` of the finding's code in the catalogue; ``tables``: as in `RecipeFragment`.
    """
    try:
        RecipeFragment(tables)
    except RecipeError:
        return ()
    return (Remedy(name, recipe=tables),)


@cache
def format_recipe_key(name: str) -> str:
    """Return the dotted name of a key that only the user can fill in, for messages; `RecipeError` if unknown."""
    section, _, key = name.partition(".")
    known = read_annotations(Recipe)
    if section not in known or (key and key not in read_annotations(known[section])):
        raise RecipeError(f"there is no key {name} in a recipe")
    return f"recipe key {name}"
