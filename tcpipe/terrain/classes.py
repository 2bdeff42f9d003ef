"""Terrain classes: the table a store shares, and how a raster's values become its ids.

The paper (section IV-A) annotates seven classes with the labels of Valada et al. 2016, the last four traversable. It names only
those four; the first three carry Valada's names for what a robot cannot drive over. Id 0 is never a class: it is "no data".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NODATA_ID = 0
"""The id of pixels without a class."""

MAX_ID = 255
"""Ids are stored in one byte."""


@dataclass(frozen=True, slots=True)
class TerrainClass:
    """One class: its id (1 to 255), its name, and whether the robot may drive over it."""

    id: int
    name: str
    traversable: bool


@dataclass(frozen=True, slots=True)
class ClassTable:
    """The classes of a store, by rising id; ``count`` is the paper's c, which the class layer is scaled by."""

    classes: tuple[TerrainClass, ...]

    @property
    def count(self) -> int:
        """Return c: the largest id, so that ids from 1 to c scale onto 0 to 1."""
        return self.classes[-1].id

    def name(self, class_id: int) -> str:
        """Return the name of an id of the table."""
        return next(entry.name for entry in self.classes if entry.id == class_id)

    def names(self) -> NDArray[np.str_]:
        """Return names by id, shape (256,); empty where the table has no such id."""
        names = [""] * (MAX_ID + 1)
        for entry in self.classes:
            names[entry.id] = entry.name
        return np.array(names)

    def traversable(self) -> NDArray[np.bool_]:
        """Return whether each id may be driven over, shape (256,)."""
        found = np.zeros(MAX_ID + 1, np.bool_)
        for entry in self.classes:
            found[entry.id] = entry.traversable
        return found

    def differences(self, other: ClassTable) -> tuple[str, ...]:
        """Return how this table differs from another, one plain clause an id; nothing where they are the same."""
        mine, theirs = ({entry.id: entry for entry in table.classes} for table in (self, other))
        clauses = []
        for class_id in sorted(mine | theirs):
            here, there = mine.get(class_id), theirs.get(class_id)
            if here != there:
                clauses.append(f"id {class_id} is {_describe_class(here)}, but {_describe_class(there)} in the other")
        return tuple(clauses)


def _describe_class(entry: TerrainClass | None) -> str:
    return "nothing" if entry is None else f"{entry.name} ({'' if entry.traversable else 'not '}traversable)"


@dataclass(frozen=True, slots=True)
class ClassScheme:
    """A class table together with the raster values that stand for its ids (several values may share an id)."""

    table: ClassTable
    id_by_value: Mapping[int, int]

    def ids(self, values: NDArray[np.integer], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """Return class ids of raster values of any integer type and shape; 0 where not ``valid`` or not named."""
        known = np.array(sorted(self.id_by_value), np.int64)
        id_of = np.array([self.id_by_value[int(value)] for value in known], np.uint8)
        wide = values.astype(np.int64, copy=False)
        at = np.minimum(np.searchsorted(known, wide), known.size - 1)
        return np.where(valid & (known[at] == wide), id_of[at], np.uint8(NODATA_ID)).astype(np.uint8, copy=False)


def name_key(name: str) -> str:
    """Return what two spellings of a class name have in common: case, '_' and '-' do not matter."""
    return " ".join(name.casefold().replace("_", " ").replace("-", " ").split())


def find_named_scheme(name_by_value: Mapping[int, str], table: ClassTable) -> ClassScheme | None:
    """Return the scheme in which a raster's own names say what its values are; None if none of them is a name of the table."""
    by_name = {name_key(entry.name): entry.id for entry in table.classes}
    found = {value: by_name[name_key(name)] for value, name in name_by_value.items() if name_key(name) in by_name}
    return ClassScheme(table, found) if found else None


def make_own_scheme(name_by_value: Mapping[int, str]) -> ClassScheme | None:
    """Return classes as a raster itself names them, all traversable; None where it names none, or more than there are ids.

    A class's id is its value where all values can be ids, else its place in the order of the values; values of one name are one class.
    """
    first = {name: value for value, name in sorted(name_by_value.items(), reverse=True)}
    values = sorted(first.values())
    plain = all(0 < value <= MAX_ID for value in values)
    id_of = {name_by_value[value]: value if plain else place for place, value in enumerate(values, 1)}
    if not 0 < len(id_of) <= MAX_ID:
        return None
    entries = sorted(
        (TerrainClass(number, name, traversable=True) for name, number in id_of.items()), key=lambda entry: entry.id
    )
    return ClassScheme(ClassTable(tuple(entries)), {value: id_of[name] for value, name in name_by_value.items()})


PAPER_CLASSES = ClassTable(
    (
        TerrainClass(1, "obstacle", traversable=False),
        TerrainClass(2, "tree", traversable=False),
        TerrainClass(3, "vegetation", traversable=False),
        TerrainClass(4, "grass", traversable=True),
        TerrainClass(5, "mud", traversable=True),
        TerrainClass(6, "unpaved road", traversable=True),
        TerrainClass(7, "paved road", traversable=True),
    )
)
"""The paper's seven classes."""

PAPER_SCHEME = ClassScheme(PAPER_CLASSES, {entry.id: entry.id for entry in PAPER_CLASSES.classes})
"""The default: a raster that holds the paper's ids themselves."""
