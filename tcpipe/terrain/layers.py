"""Layers of maps and patches: interpolation, storage and tensor channels of each (section IV-B).

============  ==============  ============================  =======================================
kind          taken from map  in a patch                    in the tensor
============  ==============  ============================  =======================================
continuous    bilinear        the value, in steps           (value - low) / (high - low)
categorical   nearest         class id, 0 = no data         (C - 1) / (c - 1)
relative      bilinear        steps above the patch's       the same, in its range
                              smallest
============  ==============  ============================  =======================================

The paper has one of each: ortho O / 255, terrain (C - 1) / (c - 1), height (H - min H) / 1 m, all clipped to [0, 1]. A
user's own rasters are continuous or categorical (docs/how-to/your-maps.md). A pixel without data in any layer is 0 in
every channel; only a recipe with ``min_valid_fraction`` below 1 keeps such pixels.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import AnyInts, Bytes, Floats, Floats32, Mask, Texts

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
    color: str | None = field(default=None, compare=False, repr=False, metadata={"json": (None,)})
    """Colour on pages, ``#rrggbb``; None: by its name."""


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

    def names(self) -> Texts:
        """Return names by id, shape (256,); empty where the table has no such id."""
        names = [""] * (MAX_ID + 1)
        for entry in self.classes:
            names[entry.id] = entry.name
        return np.array(names)

    def traversable(self) -> Mask:
        """Return whether each id may be driven over, shape (256,)."""
        found = np.zeros(MAX_ID + 1, bool)
        for entry in self.classes:
            found[entry.id] = entry.traversable
        return found

    def differences(self, other: ClassTable) -> tuple[str, ...]:
        """Return how this table differs from another, one clause for each id; () if they are equal."""
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
    """A class table together with the raster values of its ids (several values may share an id)."""

    table: ClassTable
    id_by_value: Mapping[int, int]

    def ids(self, values: AnyInts, valid: Mask) -> Bytes:
        """Return class ids of raster values of any integer type and shape; 0 where not ``valid`` or not named."""
        known = np.array(sorted(self.id_by_value), np.int64)
        id_of = np.array([self.id_by_value[int(value)] for value in known], np.uint8)
        wide = values.astype(np.int64, copy=False)
        at = np.minimum(np.searchsorted(known, wide), known.size - 1)
        return np.where(valid & (known[at] == wide), id_of[at], np.uint8(NODATA_ID)).astype(np.uint8, copy=False)


def name_key(name: str) -> str:
    """Return a class name in a common spelling: case, '_' and '-' do not matter."""
    return " ".join(name.casefold().replace("_", " ").replace("-", " ").split())


def find_named_scheme(name_by_value: Mapping[int, str], table: ClassTable) -> ClassScheme | None:
    """Return the scheme of a raster that names its values; None if no name is in the table."""
    by_name = {name_key(entry.name): entry.id for entry in table.classes}
    found = {value: by_name[name_key(name)] for value, name in name_by_value.items() if name_key(name) in by_name}
    return ClassScheme(table, found) if found else None


def make_own_scheme(name_by_value: Mapping[int, str]) -> ClassScheme | None:
    """Return the classes that a raster names, all traversable; None without names, or with more than there are ids.

    A class's id is its value if all values can be ids, else its place in the order of values; values of one name are
    one class.
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
"""The default: a raster with the paper's ids as values."""


Pixels: TypeAlias = NDArray[np.uint8 | np.uint16 | np.float16 | np.float32 | np.float64]
"""Pixels of a layer: bytes or floats in a map, steps above the lowest pixel in a patch."""

LayerPixels: TypeAlias = NDArray[np.uint8 | np.uint16 | np.float16 | np.float32]
"""Stored patches of one layer, shape (N, px, px)."""
Kind = Literal["continuous", "categorical", "relative"]
Stack = Literal["relative", "floats", "greys", "classes"]

LAYERS = ("ortho", "terrain", "height")
"""The paper's order of channels: O, C, H."""

COLOURS = ("ortho_red", "ortho_green", "ortho_blue")
"""Layers of an orthophoto that is kept in colour, beside its grey."""

STACKS: dict[Stack, type[np.generic]] = {
    "relative": np.float32,
    "floats": np.float32,
    "greys": np.uint8,
    "classes": np.uint8,
}
"""Layers of the map's own pixels that are sampled together, and their type in a map."""

HEIGHT_STEP_M = 0.0005
"""One step of a stored height [m]."""

HEIGHT_NODATA = 65535
"""A stored height without data; occurs only where a recipe allows invalid pixels."""

HEIGHT_RANGE_M = 1.0
"""Height difference that the tensor scales onto [0, 1] [m]."""

LUMA_RGB = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in grey (ITU-R BT.601)."""

_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
_TAKEN = (*LAYERS, *COLOURS, *("classes", "row", "column", "sample", "spatial_ref", "x", "y", "overviews"))
"""Names that layers must not have, in addition to those of columns of samples."""


@dataclass(frozen=True, slots=True)
class Layer:
    """One layer; values are in ``unit``, those of a relative one above the patch's smallest."""

    name: str
    kind: Kind
    long_name: str
    mapped: np.dtype[Any]
    """Type in a map: float32 with NaN as no data, or bytes with 0."""
    stored: np.dtype[Any]
    """Type in a patch."""
    unit: str = "1"
    step: float = 1.0
    """Step of a stored number [unit]."""
    low: float = 0.0
    high: float = 1.0
    """Values that become 0 and 1 in the tensor [unit]."""
    classes: ClassTable | None = None
    """Class table of a categorical layer."""

    def compute_means(self, pixels: Pixels) -> Floats:
        """Return the mean of stored patches, or the share of each class, shape (N, 1 or classes); without data: 0."""
        if self.classes is not None:
            ids = np.arange(1, self.classes.count + 1)
            return np.stack([np.mean(pixels == class_id, axis=(1, 2)) for class_id in ids], axis=1)
        values = pixels.reshape(len(pixels), 1, -1).astype(float)
        has_data = np.isfinite(values) if np.isnan(self.nodata) else values != self.nodata
        return np.asarray(np.where(has_data, values, 0.0).sum(axis=2) / np.maximum(has_data.sum(axis=2), 1))

    @property
    def signature(self) -> str:
        """Properties, other than classes, that layers of one name share wherever their patches are used together."""
        return f"{self.kind} [{self.unit}]"

    @property
    def nodata(self) -> float:
        """Return the value of a patch pixel without data: 0, NaN, or the largest number of a relative layer."""
        return HEIGHT_NODATA if self.kind == "relative" else find_no_data_value(self.stored)

    @property
    def stack(self) -> Stack:
        """Return the stack of layers with which it is sampled."""
        if self.kind == "continuous":
            return "greys" if self.mapped == np.uint8 else "floats"
        return "relative" if self.kind == "relative" else "classes"

    def has_data(self, pixels: Pixels) -> Mask:
        """Return which pixels of the map have data."""
        return np.isfinite(pixels) if self.mapped.kind == "f" else pixels != 0

    @property
    def channel_of_bytes(self) -> Floats32:
        """Return the tensor value of each byte of a layer of bytes, in [0, 1], shape (256,)."""
        one = np.float32
        above = np.maximum(np.arange(256, dtype=one) - one(self.low / self.step), one(0.0))
        return np.asarray(np.minimum(above / one(max((self.high - self.low) / self.step, 1.0)), one(1.0)))

    @property
    def scaling(self) -> tuple[float, float]:
        """Return the factor and offset that convert stored numbers so that low and high become 0 and 1."""
        width = (self.high - self.low) or 1.0
        return self.step / width, -self.low / width


Layers: TypeAlias = Mapping[str, Layer]
"""Layers of a map or a dataset, by name."""


def find_no_data_value(dtype: np.dtype[np.generic]) -> float:
    """Return the value of no data in a map's pixels of a type."""
    return float("nan") if dtype.kind == "f" else 0


_BYTE, _STEPS, _FLOAT = (np.dtype(kind) for kind in (np.uint8, np.uint16, np.float32))

_ORTHO = Layer("ortho", "continuous", "orthophoto, grey", _BYTE, _BYTE, step=1 / 255)

PAPER_LAYERS: dict[str, Layer] = {
    "ortho": _ORTHO,
    "terrain": Layer(
        "terrain", "categorical", "terrain class id", _BYTE, _BYTE, low=1.0, high=7.0, classes=PAPER_CLASSES
    ),
    "height": Layer(
        "height",
        "relative",
        "height above height_min_m of the sample",
        _FLOAT,
        _STEPS,
        unit="m",
        step=HEIGHT_STEP_M,
        high=HEIGHT_RANGE_M,
    ),
    **{name: replace(_ORTHO, name=name, long_name=f"orthophoto, {name[6:]}") for name in COLOURS},
}
"""Layers that a map may have by their names alone; `make_continuous_layer` and `make_categorical_layer` make those of a
user."""


def make_continuous_layer(name: str, *, unit: str, low: float, high: float) -> Layer:
    """Return a user's continuous layer, whose values from ``low`` to ``high`` [unit] are scaled onto [0, 1]."""
    return Layer(name, "continuous", name.replace("_", " "), _FLOAT, _FLOAT, unit=unit or "1", low=low, high=high)


def make_categorical_layer(name: str, classes: ClassTable) -> Layer:
    """Return a categorical layer with its own classes."""
    long_name = f"{name.replace('_', ' ')} class id"
    return Layer(name, "categorical", long_name, _BYTE, _BYTE, low=1.0, high=float(classes.count), classes=classes)


def make_paper_layers(names: Iterable[str], classes: ClassTable) -> dict[str, Layer]:
    """Return layers of `PAPER_LAYERS` by name, in the order given; ``classes`` are those of terrain."""
    terrain = make_categorical_layer("terrain", classes)
    known = {**PAPER_LAYERS, "terrain": replace(terrain, long_name=PAPER_LAYERS["terrain"].long_name)}
    return {name: known[name] for name in names}


def sort_layers(layers: Layers) -> dict[str, Layer]:
    """Return layers in the order of channels: the paper's first, then the others as they come."""
    return {name: layers[name] for name in LAYERS if name in layers} | dict(layers)


def join_layers(maps: Sequence[Layers]) -> dict[str, Layer]:
    """Return the layers that maps have in common, each with the range of all."""
    return {
        name: replace(layer, low=min(each[name].low for each in maps), high=max(each[name].high for each in maps))
        for name, layer in maps[0].items()
    }


def group_stacks(layers: Layers) -> dict[Stack, list[str]]:
    """Return the names of layers by their stack."""
    return {stack: [name for name, layer in layers.items() if layer.stack == stack] for stack in STACKS}


def find_wrong_name(name: str, *, taken: Collection[str]) -> str | None:
    """Return the reason why a user's layer cannot have a name, given the used names; None if it can."""
    if name in _TAKEN or name in taken or name.endswith("_one_hot"):
        return f"layer {name}: the name is taken; choose another"
    if not _NAME.fullmatch(name):
        return f"layer {name!r}: expected small letters, digits and '_', beginning with a letter, 40 at most"
    return None
